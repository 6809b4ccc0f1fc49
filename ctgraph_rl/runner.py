"""What a configuration runs: a single run, seeds as one batch, or a collective; then its results show."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig

from ctgraph_rl.collective.job import run_collective
from ctgraph_rl.log.escape import terminal_text
from ctgraph_rl.log.files import LOG, list_members
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.packages import makes_page
from ctgraph_rl.report.objective import check_objective, objective_of
from ctgraph_rl.report.style import require_packages
from ctgraph_rl.report.terminal import print_summary
from ctgraph_rl.runs import job
from ctgraph_rl.runs.config import in_sweep


def run_configuration(cfg: Any, run_dir: Path) -> float | None:
    """Run a configuration in an existing directory, and show its results; as `ctgraph_rl.run.run`."""
    if cfg.objective is not None or cfg.objective_until is not None:
        check_objective(cfg.objective, cfg.experts, cfg.objective_until)
    if cfg.report:
        require_packages()
    if "exchange" in cfg:
        run_collective(cfg, run_dir)
        run_dirs = list_members(run_dir)
    elif "seeds" in cfg:
        run_dirs = job.run_seeds(cfg, run_dir)
    else:
        job.run_job(cfg, run_dir)
        run_dirs = [run_dir]
    if "exchange" not in cfg and (cfg.report or not in_sweep()):
        for each in run_dirs:
            show(each, cfg.report, cfg.objective_until is not None)
    searches = not in_sweep() or HydraConfig.get().runtime.choices["hydra/sweeper"] != "cells"
    if cfg.objective is None or not searches:
        return None
    value = objective_of(cfg.objective, run_dirs)
    if cfg.objective_until is not None and not in_sweep():
        ended = int(RunLog.read(run_dirs[0] / LOG).training("frames")[-1])
        print(f"{cfg.objective} after {ended:,} frames (objective_until={cfg.objective_until:g}): {value:.4f}")
    return value


def show(run_dir: Path, report: bool, tuning: bool = False) -> None:
    """Print a finished run's results, and make its report or say how; ``tuning`` tells whether it is a tuning run."""
    print_summary(run_dir)
    here = Path.cwd()
    shown = run_dir.relative_to(here) if run_dir.is_relative_to(here) else run_dir
    print(f"results: {terminal_text(shown)}")
    if not report:
        print(makes_page(f"report {'--tuning ' * tuning}{shlex.quote(str(shown))}"))
        return
    from ctgraph_rl.report.page import write_report  # here: most runs make no page

    print(f"report: {write_report([shown], tuning=True).page}")
