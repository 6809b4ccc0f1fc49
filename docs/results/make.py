"""Makes the pages of results and their figures from the raw results beside this file.

``python docs/results/make.py`` makes all pages, with a NAME one. Raw results of a study that is finished are collected
by the commit that `how_made.md` names.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

HERE = Path(__file__).resolve().parent

PAGES = {
    "adaptation": "studies.adaptation",
    "baselines": "studies.baselines.page",
    "board": "studies.board",
    "claims": "studies.claims",
    "collectives": "studies.collectives.page",
    "lifelong": "studies.lifelong.page",
    "memory": "studies.memory.page",
    "no_labels": "studies.no_labels.page",
    "plasticity": "studies.plasticity.page",
    "profile": "studies.profile",
    "streams": "studies.streams",
}
"""Pages, and the modules that make them."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Do what the command line says; errors are one message."""
    parser = argparse.ArgumentParser(prog="python docs/results/make.py", description=__doc__)
    parser.set_defaults(run=lambda options: _make(*PAGES))
    commands = parser.add_subparsers(metavar="NAME")
    for name in PAGES:
        commands.add_parser(name).set_defaults(run=lambda options, name=name: _make(name))
    what = "measure a GPU for four minutes, into gpu.json and its page; the next call continues"
    measuring = commands.add_parser("gpu", help=what)
    measuring.add_argument("--commit", default="", help="what is measured, where the checkout has no .git")
    measuring.set_defaults(run=lambda options: import_module("studies.gpu").measure(options.commit))
    options = parser.parse_args(arguments)
    try:
        options.run(options)
    except (OSError, KeyError, ValueError) as error:
        parser.error(str(error))


def _make(*names: str) -> None:
    """Write pages and their figures; a module is imported when it is needed, as most import PyTorch."""
    for name in names:
        study = import_module(PAGES[name])
        (HERE / f"{name}.md").write_text(study.page(), encoding="utf-8")
        if hasattr(study, "draw"):
            study.draw(HERE)


if __name__ == "__main__":
    main()
