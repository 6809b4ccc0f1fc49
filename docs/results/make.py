"""Makes the pages of results and their figures from the raw results beside this file; and raw results from runs.

``python docs/results/make.py`` makes all pages but ``statistics``, whose simulations take long; with a NAME it makes
one. ``make.py collect TABLE RUNS`` writes TABLE.csv from the runs under the folders RUNS. Tables of `GROWING` grow
under ``runs/results``, which git ignores, and are written once, when all of their runs are there.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

PAGES = {
    "adaptation": "studies.adaptation",
    "baselines": "studies.baselines.page",
    "board": "studies.board",
    "claims": "studies.claims",
    "collectives": "studies.collectives.page",
    "lifelong": "studies.lifelong.page",
    "memory": "studies.memory.page",
    "no_labels": "studies.no_labels.page",
    "profile": "studies.profile",
}
"""Pages, and the modules that make them."""

APART = {"statistics": "studies.coverage"}
"""What is made only by its name: the page of intervals."""

OF_AGENTS = ("main_job", "baselines_b1", "baselines_fo_b2", "depth_ladder")
OF_METHODS = ("masks_ct8_md", "masks_ct8", "masks_ct12", "methods")

TABLES = {
    **dict.fromkeys(OF_AGENTS, "studies.baselines.runs"),
    **dict.fromkeys(("rnd_depth", "rnd_co_b1", "baselines_b1_instances", "memory_b1"), "studies.baselines.runs"),
    **dict.fromkeys(("rl2_search", "rewards_met"), "studies.baselines.runs"),
    **dict.fromkeys(OF_METHODS, "studies.lifelong.runs"),
    "memory_cells": "studies.memory.page",
    "mohqa_published": "studies.memory.published",
    "collectives": "studies.collectives.runs",
    "no_labels": "studies.no_labels.runs",
    "rl2_swap": "studies.baselines.swap",
    "adaptation": "studies.adaptation",
    "adaptation_swap": "studies.adaptation_swap",
    "claim_runs": "studies.claim_runs",
    "every_curriculum": "studies.every_curriculum",
    "profile": "studies.profile",
    "task_free": "studies.no_labels.task_free",
    "together_fo_b1": "studies.together",
}
"""Tables of raw results, and the modules that collect them."""

GROWING = (*OF_METHODS, "claim_runs", "collectives", "memory_cells", "no_labels")


def main(arguments: Sequence[str] | None = None) -> None:
    """Do what the command line says; errors are one message."""
    parser = _parser()
    options = parser.parse_args(arguments)
    try:
        options.run(options)
    except (OSError, KeyError, ValueError) as error:
        parser.error(str(error))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python docs/results/make.py", description=__doc__)
    parser.set_defaults(run=lambda options: _make(*PAGES.values()))
    commands = parser.add_subparsers(metavar="NAME")
    for name, module in {**PAGES, **APART}.items():
        commands.add_parser(name).set_defaults(run=lambda options, module=module: _make(module))

    _add_tables(commands)

    submitting = commands.add_parser("submit", help="make submissions to the board from runs of a track")
    submitting.add_argument("runs", type=Path, help="folder with run directories")
    submitting.add_argument("commit", help="of the code that ran them")
    submitting.add_argument("--track", default="small", help="that the runs are of")
    submitting.add_argument("--given", default="", help="ends the names of submissions, such as -at_boundaries")
    submitting.set_defaults(run=_submit)

    measuring = commands.add_parser("gpu", help="measure a GPU for four minutes, into gpu.json and its page")
    measuring.add_argument("--minutes", type=float, default=4.0, help="limit of a call; the next call continues")
    measuring.add_argument("--commit", default="", help="what is measured, where the checkout has no .git")
    measuring.add_argument("--seconds", type=float, default=1.0, help="least time of a measurement")
    measuring.add_argument("--rows", type=int, nargs="+", default=[65536, 262144], help="of the environment")
    measuring.add_argument("--envs", type=int, nargs="+", default=[256, 4096, 65536], help="of one agent")
    measuring.add_argument("--together", type=int, nargs="+", default=[64, 1024], help="seeds of one job")
    measuring.set_defaults(run=lambda options: _module("studies.gpu").measure(options))
    return parser


def _add_tables(commands: Any) -> None:
    """Add the commands on tables of raw results."""
    collecting = commands.add_parser("collect", help="write a table of raw results from runs")
    collecting.add_argument("table", choices=TABLES, help="as its experiment's name")
    collecting.add_argument("runs", type=Path, nargs="+", help="folders with runs")
    collecting.add_argument("--add", action="store_true", help="keep the stored cells that are not under the folders")
    collecting.set_defaults(run=_collect)

    comparing = commands.add_parser("reruns", help="compare runs with the raw results of the same cells")
    comparing.add_argument("table", choices=[*OF_AGENTS, *OF_METHODS], help="of raw results")
    comparing.add_argument("runs", type=Path, help="folder with runs")
    comparing.set_defaults(run=lambda options: _module("studies.reruns").compare(options.table, options.runs))


def _module(name: str) -> Any:
    """Return a module of a study, which is imported when it is needed: most import PyTorch."""
    return import_module(name)


def _make(*modules: str) -> None:
    """Make pages and their figures."""
    for name in modules:
        _module(name).make()


def _collect(options: argparse.Namespace) -> None:
    """Write a table from runs.

    Raises:
        ValueError: for ``--add`` with a table that does not grow.
    """
    collect = _module(TABLES[options.table]).collect
    if options.table in GROWING:
        collect(options.table, options.runs, options.add)
    elif options.add:
        raise ValueError(f"--add is for {', '.join(GROWING)}; {options.table} is of all runs under its folders")
    else:
        collect(options.table, options.runs)


def _submit(options: argparse.Namespace) -> None:
    """Submit the runs of a folder."""
    _module("studies.board").submit_all(options.runs, options.commit, options.given, options.track)


if __name__ == "__main__":
    main()
