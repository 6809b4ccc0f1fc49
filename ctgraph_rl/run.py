"""The main job: a configuration becomes a curriculum and an agent, which learns it; results are files.

``python -m ctgraph_rl.run curriculum=su_b1_4tasks agent=lstm_ppo seed=0``
"""

from __future__ import annotations

import io
import os
import shlex
import sys
from contextlib import nullcontext, redirect_stdout, suppress
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from ctgraph_rl.log.escape import terminal_lines, terminal_text
from ctgraph_rl.packages import check_packages, conf_dir
from ctgraph_rl.portable import Restart, become_portable, restart
from ctgraph_rl.runs.config import check_one_cell, explain, in_sweep, sweepable


def run(cfg: DictConfig, run_dir: Path) -> None:
    """Learn the configured curriculum with the configured agent and write the results to a directory.

    Args:
        cfg: the composed configuration.
        run_dir: an existing directory.

    Raises:
        ValueError: before any work, for a value out of range.
        FileExistsError: if the directory holds results that ``overwrite`` does not allow to replace.
    """
    check_packages()
    from ctgraph_rl.report.style import require_packages  # here: --help and a wrong setting need no torch
    from ctgraph_rl.runs.job import run_job  # here: as above

    if cfg.report:
        require_packages()
    run_job(cfg, run_dir)
    if cfg.report or not in_sweep():
        show(run_dir, cfg.report)


def show(run_dir: Path, report: bool) -> None:
    """Print the results of a finished run, and make its report or say how."""
    from ctgraph_rl.report.page import write_report  # here: --help and a wrong setting need no torch
    from ctgraph_rl.report.terminal import print_summary  # here: as above

    print_summary(run_dir)
    here = Path.cwd()
    shown = run_dir.relative_to(here) if run_dir.is_relative_to(here) else run_dir
    print(f"results: {terminal_text(shown)}")
    how = f"ctgraph-rl report {shlex.quote(str(shown))}"
    print(f"report: {write_report([shown]).page}" if report else f"{how} makes a page of figures and tables")


@hydra.main(version_base="1.3", config_path=conf_dir(), config_name="config")
def _job(cfg: DictConfig) -> None:
    run_dir = Path(HydraConfig.get().runtime.output_dir)
    try:
        check_one_cell()
        if cfg.portable is True and not in_sweep():
            become_portable()
        with redirect_stdout(io.StringIO()) if in_sweep() else nullcontext():
            run(cfg, run_dir)
    except BaseException as error:
        with suppress(OSError):
            run_dir.rmdir()  # only a directory that nothing was written into
        if in_sweep() and isinstance(error, Exception):  # not every exception can travel between processes
            raise RuntimeError(f"{type(error).__name__}: {explain(error)}") from None
        raise


def main() -> None:
    """Entry point: a user's error is one message and exit code 1; HYDRA_FULL_ERROR=1 shows where it came from."""
    environment, arguments = dict(os.environ), sys.argv[1:]
    full_error = os.environ.setdefault("HYDRA_FULL_ERROR", "0") not in ("", "0")
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra then leaves errors to us
    sys.argv[1:] = sweepable(sys.argv[1:])
    sys.path.append(os.getcwd())  # where a user's own agent may be, for the console script too
    try:
        try:
            _job()
        except Restart:
            restart(environment, arguments)
    except (HydraException, OmegaConfBaseException, ValueError, ImportError, OSError, FloatingPointError) as error:
        if full_error:
            raise
        print(f"error: {terminal_lines(explain(error))}", file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:
        print("interrupted; the same command resumes from the last checkpoint", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":  # not this module's own: other processes of a sweep import what is in it
    import ctgraph_rl.run

    ctgraph_rl.run.main()
