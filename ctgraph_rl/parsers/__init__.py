"""The arguments of commands, and the defaults and choices that their help names.

The command line answers ``--help`` and refuses wrong arguments with these parsers before it imports torch. They import
nothing of ours.
"""

from __future__ import annotations

import argparse
from argparse import ArgumentParser
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Any

import yaml

BOUND = 1e-4
"""Largest difference that counts as rounding, as a share of the largest value that the field has in either run."""

CHANGES: dict[str, type] = {
    "branching_factor": int,
    "depth": int,
    "wait_prob": float,
    "image_seed": int,
    "read_noise": int,
    "read_rotation": int,
}
"""Arguments of `ctgraph_rl.tasks.configurations.make_task` that are plain numbers."""

DPI = 160
"""Pixels an inch of a figure."""

EXPORT_FORMATS = ("l2logger", "parquet")
LEVELS = ("rescored", "rerun", "held_out")
"""How far a submission is verified."""

LIMIT_TIMES = 5
"""The time limit of a process of a verification, as a multiple of what the submitted run took."""

POLICIES = ("random", "navigation", "optimal")

STATISTICS = {
    "exact": "intervals that hold for few seeds of bounded values, where the others are too narrow",
    "t": "Student's intervals of means",
    "std": "standard deviations over seeds",
    "iqm": "interquartile means with rliable's stratified bootstrap",
}
"""What means over seeds are shown with; times are medians and solved seeds are shares with exact intervals in all."""

TABLE_FORMATS = ("text", "markdown", "latex")


def board() -> ArgumentParser:
    """Write a page with tables of submissions, and the same tables for programs.

    board.html needs nothing else and no network; board.md and tables.tex have the same tables; board.json,
    entries.csv and scores.csv have their numbers, croissant.json describes the CSV files, and model-index.yaml is
    the results file that model hubs read. The exit code is 1 if something was left out.
    """
    parser = _parser(board)
    parser.add_argument(
        "submissions", type=Path, nargs="+", metavar="DIR", help="submissions, or folders that hold them"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="where the files go")
    parser.add_argument("--config-dir", type=Path, metavar="DIR", help="folder with your own tracks, track/NAME.yaml")
    parser.add_argument("--date", type=date.fromisoformat, help="the day that the metadata names (default: today)")
    return parser


def collectives() -> ArgumentParser:
    """Write a page on runs with exchange=NAME.

    It has a table of learning time, returns and messages of each collective, a figure of learning time over the number
    of members, and who helped whom; the same as tidy CSV files. ctgraph-rl report takes members like other runs.
    """
    parser = _parser(collectives)
    parser.add_argument("runs", type=Path, nargs="+", help="directories of collectives, or folders that hold them")
    parser.add_argument(
        "--out", type=Path, default=Path("collectives"), help="where the page goes (default: collectives/)"
    )
    return parser


def compare() -> ArgumentParser:
    """Compare two runs: all measurements but their times, and the weights of the agents.

    The exit code is 0 for equal runs, 1 for different ones, 3 for runs that are equal up to rounding, and 2 for
    what is no run.
    """
    parser = _parser(compare)
    parser.add_argument("one", type=Path, metavar="A", help="a run directory")
    parser.add_argument("other", type=Path, metavar="B", help="another one")
    within = (
        "largest difference that counts as rounding, as a share of the field's largest value (default: %(default)g)"
    )
    parser.add_argument("--bound", type=float, default=BOUND, help=within)
    return parser


def draw() -> ArgumentParser:
    """Draw a task; with a policy, what it does there."""
    parser = _parser(draw)
    _add_task(parser)
    what = "what a figure has: observation ids in the states, their kinds, or the images"
    parser.add_argument("--show", choices=("ids", "kinds", "images"), default="ids", help=f"{what}; default: ids")
    parser.add_argument("--figure", type=Path, metavar="FILE", help="write a figure (.png, .pdf, .svg)")
    parser.add_argument("--dpi", type=int, default=DPI, help=f"pixels an inch of a .png; default: {DPI}")
    parser.add_argument("--dot", type=Path, metavar="FILE", help="write the graph for Graphviz")
    parser.add_argument("--gif", type=Path, metavar="FILE", help="write an episode of the policy as a film")
    parser.add_argument("--episodes", type=int, default=1000, help="episodes used to count visits; default: 1000")
    return parser


def export() -> ArgumentParser:
    """Write a run in the format of another program.

    parquet: the tidy tables of a run as Parquet and CSV. l2logger: log format 1.1, which l2metrics reads; a
    training interval, and an evaluation of a task, is one experience with its mean return as reward; time stamps
    count experiences, so runtimes mean nothing.
    """
    parser = _parser(export)
    parser.add_argument("run", type=Path, help="a run directory")
    parser.add_argument("--format", choices=EXPORT_FORMATS, default=EXPORT_FORMATS[0], help="the format to write")
    parser.add_argument("--out", type=Path, required=True, help="the folder to write; for l2logger new or empty")
    return parser


def play() -> ArgumentParser:
    """Play a CT-graph in the terminal, or watch a policy play it."""
    parser = _parser(play)
    _add_task(parser)
    parser.add_argument("--episodes", type=int, default=3, help="of a policy; default: 3")
    parser.add_argument("--delay", type=float, default=0.5, help="seconds between a policy's steps; default: 0.5")
    return parser


def profile() -> ArgumentParser:
    """Train an agent on ten small curricula, one for each learning property of the paper, and score it.

    Settings are those of ctgraph-rl -m, such as agent=lstm_ppo seed=range(5). Cells use all cores, and the same command
    resumes. Runs go to runs/profile, and the page shows every agent there. Folders in place of settings only score the
    runs in them, those of a Recorder, too. A score is 0 at the floor of an agent without the property and 1 at the
    optimum. The exit code is 1 if cells are not done.
    """
    parser = _parser(profile)
    parser.add_argument("words", nargs="+", metavar="SETTING=VALUE|FOLDER", help="what to train, or runs to score")
    parser.add_argument("--config-dir", type=Path, help="a folder with an agent of your own, agent/NAME.yaml")
    parser.add_argument("--out", type=Path, help="where the page goes (default: profile/ within the first folder)")
    _add_agent(parser)
    return parser


def report() -> ArgumentParser:
    """Write a page of figures and tables of runs."""
    parser = _parser(report)
    parser.add_argument("runs", type=Path, nargs="+", help="run directories, or folders that hold them")
    parser.add_argument("--out", type=Path, help="where the report goes (default: report/ within the one folder given)")
    _add_agent(parser)
    parser.add_argument("--width", default="text", help="of figures: text of a page, or column, one of its two")
    parser.add_argument(
        "--colour",
        action="append",
        default=[],
        metavar="NAME=COLOUR",
        help="of an agent in figures; repeat it for each",
    )
    return parser


def results() -> ArgumentParser:
    """Print a table of runs: each agent on each curriculum, with intervals over seeds.

    Every seed that any agent has on a curriculum is expected of all: one without a run, with an unfinished run or
    with an undefined metric is counted, as in n = 9/10. The exit code is 1 if a run cannot be read, or if the code
    of one configuration has changed between runs; these runs are named and shown separately.
    """
    parser = _parser(results)
    parser.add_argument("runs", type=Path, nargs="+", help="run directories, or folders that hold them")
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--all", action="store_true", help="show every measure instead of the most important")
    which.add_argument("--metrics", metavar="A,B", help="show these measures; 'solved' is one of each task")
    parser.add_argument("--format", choices=TABLE_FORMATS, default="text", help="of what is printed (default: text)")
    kinds = "; ".join(f"{kind}: {what}" for kind, what in STATISTICS.items())
    of_seeds = parser.add_mutually_exclusive_group()
    of_seeds.add_argument("--statistics", choices=STATISTICS, default="exact", help=f"{kinds} (default: exact)")
    of_seeds.add_argument("--per-seed", action="store_true", help="show single runs, a row for each measure")
    parser.add_argument("--csv", type=Path, help="also write the table with every measure into this file")
    parser.add_argument(
        "--tidy", type=Path, metavar="FILE", help="also write every evaluation as a row into this .csv or .parquet file"
    )
    _add_agent(parser)
    parser.add_argument("--compare", metavar="METRIC", help="also compare every two agents, seed by seed")
    parser.add_argument("--difference", type=float, help="how many seeds would find a true difference of this size")
    return parser


def submit() -> ArgumentParser:
    """Make a submission of finished runs: a folder of files that anybody can check.

    --template > method.yaml prints what an author says about a method, to fill in once.
    """
    parser = _parser(submit)
    parser.add_argument("runs", type=Path, nargs="*", help="run directories, or folders that hold them")
    parser.add_argument("--to", type=Path, metavar="DIR", help="the folder to make")
    about = "what you say about the method (default: %(default)s)"
    parser.add_argument("--method", type=Path, default=Path("method.yaml"), metavar="FILE", help=about)
    parser.add_argument("--track", metavar="NAME", help="the track; default: as the file says")
    only = "leave out runs with another value, such as --only curriculum.depth=4"
    parser.add_argument("--only", metavar="SETTING=VALUE", nargs="+", type=_setting, default=[], help=only)
    parser.add_argument("--config-dir", type=Path, metavar="DIR", help="folder with your own track, track/NAME.yaml")
    parser.add_argument("--template", action="store_true", help="print a method.yaml to fill in, and do nothing else")
    return parser


def verify() -> ArgumentParser:
    """Verify a submission up to a level; each level includes those before it.

    rescored: its logs give its numbers; no code runs. rerun: drawn runs are trained again and give the same bits,
    or scores that are no lower where bits are not promised. held_out: other seeds, images and goals are learned,
    and the scores are no lower.
    """
    parser = _parser(verify)
    parser.add_argument("submission", type=Path, metavar="DIR", help="the folder of a submission")
    parser.add_argument("--level", choices=LEVELS, default=LEVELS[1], help="how far to verify (default: %(default)s)")
    parser.add_argument("--cells", type=int, default=2, metavar="N", help="runs of each level (default: %(default)s)")
    drawn = "draws the runs and the held-out seeds, in 0..2^63-1 (default: a random one, which is printed)"
    parser.add_argument("--number", type=int, help=drawn)
    parser.add_argument("--code", type=Path, metavar="DIR", help="folder of modules that are not installed")
    parser.add_argument(
        "--hours", type=float, help=f"time limit of a process (default: {LIMIT_TIMES} times the submitted run's)"
    )
    parser.add_argument(
        "--memory", type=float, default=8.0, metavar="GB", help="memory limit of a process (default: %(default)g)"
    )
    parser.add_argument(
        "--disk", type=float, default=4.0, metavar="GB", help="disk limit of a process (default: %(default)g)"
    )
    parser.add_argument("--yes", action="store_true", help="skip the prompt despite incomplete isolation")
    parser.add_argument("--not-isolated", action="store_true", help="run without bubblewrap")
    parser.add_argument(
        "--folder", type=Path, default=Path("verify"), metavar="DIR", help="folder of the reruns (default: %(default)s)"
    )
    parser.add_argument("--config-dir", type=Path, metavar="DIR", help="folder with your own track, track/NAME.yaml")
    return parser


def _parser(command: Callable[[], ArgumentParser]) -> ArgumentParser:
    """Return an empty parser, whose description is what the function that fills it says."""
    return ArgumentParser(prog=f"ctgraph-rl {command.__name__}", description=command.__doc__)


def _add_agent(parser: ArgumentParser) -> None:
    """Add the names and the order of agents."""
    parser.add_argument(
        "--agent", action="append", default=[], metavar="NAME[=SHOWN]", help="order and rename agents; repeatable"
    )


def _add_task(parser: ArgumentParser) -> None:
    """Add the arguments that name a task and a policy."""
    about = "a configuration of the paper, such as CT-SU-B1; a configuration file of the authors (.json); a curriculum"
    parser.add_argument("name", nargs="?", help=f"{about}. Default: only numbers")
    parser.add_argument("--config-dir", type=Path, metavar="DIR", help="also knows the curricula of this directory")
    parser.add_argument("--task", type=int, default=1, metavar="N", help="number of a curriculum's task, from 1")
    for name, kind in CHANGES.items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=kind, metavar="N")
    parser.add_argument("--goal", type=decisions, metavar="1.2", help="the decisions to the goal")
    surjective = "with numbers only: one image for each kind of state"
    parser.add_argument("--surjective", action="store_true", help=surjective)
    who = parser.add_mutually_exclusive_group()
    who.add_argument("--policy", choices=POLICIES, help="who acts")
    who.add_argument("--run", type=Path, help="the trained agent of a run acts, in a task of its curriculum")
    parser.add_argument("--sampled", action="store_true", help="the trained agent samples and explores")
    parser.add_argument("--seed", type=int, default=0, help="of the environment")


def decisions(text: str) -> tuple[int, ...]:
    """Read ``1.2``, or ``1,2``, as a goal."""
    parts = text.replace(",", ".").split(".")
    if not all(part.isdecimal() for part in parts):
        raise argparse.ArgumentTypeError(f"a goal is the decisions on the way to it, such as 1.2, got {text!r}")
    return tuple(map(int, parts))


def _setting(text: str) -> tuple[str, Any]:
    """Return a setting of the command line with its value."""
    key, sign, value = text.partition("=")
    if not (key and sign):
        raise argparse.ArgumentTypeError(f"settings are written as in curriculum.depth=4, got {text!r}")
    return key, yaml.safe_load(value)
