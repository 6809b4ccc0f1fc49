"""What several test files use: configurations as a run composes them, and agents of them.

What needs torch is imported where it is used: the process that hands tests to others starts without it.
"""

from __future__ import annotations

import gc
import json
import os
import pickle
import shlex
import shutil
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hydra
import pytest
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig

from ctgraph_rl import packages
from ctgraph_rl.runs.config import of_hydra

if TYPE_CHECKING:
    from ctgraph_rl.tasks.task import Task


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """One for each core this process may use; none for single files, which start sooner without, and for SLURM."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    folders_only = all(os.path.isdir(argument) for argument in config.args)
    slurm = "slurm" in config.option.markexpr.replace("not slurm", "")
    return cores if cores > 1 and folders_only and not slurm else 0


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip what needs a C compiler where there is none."""
    if shutil.which(shlex.split(os.environ.get("CC", "cc"))[0]):
        return
    for item in items:
        required = hasattr(item, "callspec") and item.callspec.params.get("kernel") == "required"
        if required or "test_native.py" in item.nodeid or "test_kernel.py" in item.nodeid or "compiled" in item.nodeid:
            item.add_marker(pytest.mark.skip(reason="no C compiler"))


def pytest_configure() -> None:
    """Collect no garbage until all tests are collected: what imports make stays."""
    gc.disable()


def pytest_collection_finish() -> None:
    """Leave imports and collected tests out of garbage collections, and make all of these rarer."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 100)
    gc.enable()


@pytest.fixture(autouse=True, scope="session")
def one_thread() -> None:
    """Small networks gain nothing from more."""
    import torch

    torch.set_num_threads(1)
    torch.set_flush_denormal(True)


@pytest.fixture(autouse=True, scope="session")
def hydra_reads_once() -> Iterator[None]:
    """Hydra finds, reads and merges the files of equal choices once in a process."""
    from helpers.sweeping import compose_once

    with pytest.MonkeyPatch.context() as patch:
        compose_once(patch)
        yield


@pytest.fixture(autouse=True, scope="session")
def no_waiting_for_the_disk() -> Iterator[None]:
    """No file of a test needs to survive a loss of power; tests of this count the calls."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda number: None)
        yield


@pytest.fixture(autouse=True)
def errors_as_users_see_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """Restore the variable that a run sets, so that no test leaves it to processes of another."""
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")


@pytest.fixture(scope="session")
def composed() -> dict[tuple[str, ...], bytes]:
    """What ``compose`` has made of overrides."""
    return {}


@pytest.fixture
def compose(composed: dict[tuple[str, ...], bytes]) -> Iterator[Callable[..., DictConfig]]:
    """Composes a configuration from overrides, as the command line does, and those of the same overrides once."""
    GlobalHydra.instance().clear()
    with of_hydra(hydra.initialize_config_dir)(packages.conf_dir()):

        def compose(*overrides: str, **how: Any) -> DictConfig:
            if how:
                return hydra.compose("config", overrides=[*overrides], **how)
            if overrides not in composed:
                composed[overrides] = pickle.dumps(hydra.compose("config", overrides=[*overrides]))
            return pickle.loads(composed[overrides])

        yield compose


@pytest.fixture
def compile_by(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[Any], None]]:
    """Sets the backend that compiles gradient steps; steps of other tests are compiled again."""
    import torch

    from baselines.update.compiled import compiled

    def set_backend(backend: Any) -> None:
        monkeypatch.setattr(torch, "compile", partial(torch.compile, backend=backend))
        compiled.cache_clear()

    yield set_backend
    compiled.cache_clear()


@pytest.fixture
def build_agent(compose: Callable[..., DictConfig]) -> Callable[..., Any]:
    """Builds ``conf/agent/NAME.yaml`` for tasks, with overrides; equal weights for every call."""
    import torch

    from ctgraph_rl.env import CTGraphEnv
    from ctgraph_rl.runs import config

    def build(name: str, tasks: Sequence[Task], *overrides: str) -> Any:
        cfg = compose(f"agent={name}", *overrides)
        env = CTGraphEnv(tasks)
        torch.manual_seed(cfg.seed)
        return config.target(cfg, "agent")(env.observation_spec_unbatched, env.action_spec_unbatched)

    return build


@pytest.fixture
def small_agent(build_agent: Callable[..., Any]) -> Callable[..., Any]:
    """As ``build_agent``, with a small network, few rows and short batches."""
    from helpers.small_agents import SMALL_AGENT

    return lambda name, tasks, *overrides: build_agent(name, tasks, *SMALL_AGENT[name], *overrides)


@pytest.fixture(scope="session")
def checkout() -> Path:
    """The folder with the packages."""
    return Path(__file__).resolve().parents[1]


@pytest.fixture
def console_script(checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets other processes find ``ctgraph-rl``, as this checkout has it, and use one thread."""
    script = tmp_path / "bin" / "ctgraph-rl"
    script.parent.mkdir()
    script.write_text(f"#!{sys.executable}\nfrom ctgraph_rl.cli import main\n\nmain()\n")
    script.chmod(0o755)
    monkeypatch.setenv("PATH", str(script.parent), prepend=os.pathsep)
    monkeypatch.setenv("PYTHONPATH", str(checkout))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")


@pytest.fixture
def learned(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[Path]:
    """The cells that were run, in a folder of their own, by a learner that needs no time; it fails for one seed."""
    from helpers.sweeping import UNLUCKY

    from ctgraph_rl.log.sums import write_metrics
    from ctgraph_rl.runs import config, job

    cells: list[Path] = []

    def learn(session, given, *_):
        [(cfg, run_dir)] = given
        cells.append(run_dir)
        first = {"kind": "run", "config": config.plain(cfg), **job.code_of(cfg, {})}
        (run_dir / "run.jsonl").write_text(json.dumps(first) + "\n")
        if cfg.seed == UNLUCKY:
            raise FloatingPointError("the loss is NaN")
        write_metrics(run_dir / "metrics.json", {})
        return {}

    monkeypatch.setattr(job, "learn", learn)
    monkeypatch.chdir(tmp_path)
    return cells


@pytest.fixture
def default_sigterm() -> Iterator[None]:
    """SIGTERM as a new process has it; libraries that other tests use may handle it."""
    before = signal.signal(signal.SIGTERM, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGTERM, before)
