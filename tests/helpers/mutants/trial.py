"""Trials: a copy of the checkout, in it one mutant at a time, and tests that run in forks of one process."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import signal
import sys
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from helpers.mutants.operators import replaced
from helpers.mutants.sample import CHECKOUT, Mutant

THIRD_PARTY = ("torch", "tensordict", "torchrl.envs", "torchrl.modules", "torchrl.data", "torchrl.objectives", "hydra")
THIRD_PARTY += (
    "gymnasium",
    "hypothesis",
    "matplotlib",
    "omegaconf",
    "pytest",
    "rich.progress",
    "scipy.stats",
    "torch.func",
)
THIRD_PARTY += ("torchrl.record", "xdist", "_hypothesis_pytestplugin")
"""Imported once, before the forks; our packages are not, so that each fork reads them with its mutant."""

LEFT_OUT = (".git", ".venv", ".hypothesis", ".mypy_cache", ".pytest_cache", ".ruff_cache", "_build")

CPU_SECONDS = 30
"""After which a test has failed: the mutant runs without end."""

SECONDS = 1800
"""After which a run of tests is stopped, so that one that waits for nothing ends, too."""


class FirstFailure:
    """A plugin of pytest that remembers the first test that failed, and lets none run without end."""

    def __init__(self) -> None:
        self.test = ""
        signal.signal(signal.SIGPROF, self._stop)

    def pytest_runtest_logstart(self) -> None:
        """Start to count."""
        signal.setitimer(signal.ITIMER_PROF, CPU_SECONDS)

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Note a failed test."""
        if report.failed and not self.test:
            self.test = report.nodeid

    def _stop(self, *_: Any) -> None:
        raise TimeoutError(f"over {CPU_SECONDS} s of the processor")


def import_third_party() -> None:
    """Import what all forks share."""
    os.environ["OMP_NUM_THREADS"] = "1"
    for name in THIRD_PARTY:
        import_module(name)
    import_module("torch").set_num_threads(1)


def copy_checkout(folder: Path) -> Path:
    """Copy the checkout, with the times of its files, so that compiled modules stay valid."""
    return Path(shutil.copytree(CHECKOUT, folder / "checkout", ignore=shutil.ignore_patterns(*LEFT_OUT)))


@contextmanager
def mutated(copy: Path, mutant: Mutant) -> Iterator[None]:
    """Put a mutant into the copy, and restore the module afterwards."""
    path, change = copy / mutant.path, mutant.change(copy)
    source, times = path.read_text(), path.stat()
    assert change is not None
    path.write_text(replaced(source, change))
    stamp = zlib.crc32(path.read_bytes())  # a time of its own, so that no compiled module of another mutant is read
    os.utime(path, (stamp, stamp))
    try:
        yield
    finally:
        path.write_text(source)
        os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))


def first_failure(copy: Path, tests: Sequence[str], workers: str = "0") -> str | None:
    """Run tests in a fork until one fails, and return it: "" if none does, None if they cannot run or do not end."""
    context = multiprocessing.get_context("fork")
    ours, its = context.Pipe(duplex=False)
    process = context.Process(target=_run, args=(copy, tests, workers, its))
    process.start()
    its.close()
    process.join(SECONDS)
    if process.is_alive():
        process.kill()
        process.join()
    answer = ours.recv() if process.exitcode == 0 and ours.poll() else (None, "")
    ours.close()
    status, test = answer
    return "" if status == 0 else test or None


def _run(copy: Path, tests: Sequence[str], workers: str, answer: Any) -> None:
    """What a fork does."""
    for name in [name for name in sys.modules if name.partition(".")[0] in ("helpers", "tests")]:
        del sys.modules[name]
    os.chdir(copy)
    sys.path.insert(0, str(copy))
    os.environ["PYTHONPATH"] = str(copy)
    log = os.open(os.environ.get("MUTANTS_LOG", os.devnull), os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(log, 1)
    os.dup2(log, 2)
    failure = FirstFailure()
    options = ["-n", workers, "-x", "-q", "--tb=line", "-p", "no:cacheprovider", "-W", "ignore"]
    status = int(import_module("pytest").main([*options, *tests], plugins=[failure]))
    answer.send((status, failure.test))
