"""The arguments of commands, and the defaults and choices that their help names.

The command line answers ``--help`` and refuses wrong arguments with these parsers before it imports torch. They import
nothing of ours.
"""

from __future__ import annotations

import argparse
from argparse import ArgumentParser
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import yaml
from typing_extensions import override

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

DPI = 160

EXPORT_FORMATS = ("l2logger", "parquet", "csv")
LEVELS = ("rescored", "rerun", "held_out")

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

    board.html needs nothing else and no network; entries.csv and scores.csv have its numbers. The exit code is 1 if
    something was left out.
    """
    parser = _parser(board)
    _add(parser, "submissions", "submissions, or folders that hold them", nargs="+", metavar="DIR")
    _add(parser, "--out", "where the files go", required=True, metavar="FOLDER")
    _add(parser, "--config-dir", "folder with your own tracks, track/NAME.yaml", metavar="DIR")
    return parser


def collectives() -> ArgumentParser:
    """Write a page on runs with exchange=NAME.

    It has a table of learning time, returns and messages of each collective, a figure of learning time over the number
    of members, and who helped whom; the same as tidy CSV files. ctgraph-rl report takes members like other runs.
    """
    parser = _parser(collectives)
    _add(parser, "runs", "directories of collectives, or folders that hold them", type=existing, nargs="+")
    _add(parser, "--out", "where the page goes (default: collectives/)", default=Path("collectives"))
    return parser


def compare() -> ArgumentParser:
    """Say whether two runs are equal: all measurements but their times, and the agents' weights, bit for bit.

    ctgraph-rl report and ctgraph-rl results compare agents. The exit code is 0 for equal runs, 1 for different ones,
    3 for runs that are equal up to rounding, and 2 for what is no run.
    """
    parser = _parser(compare)
    _add(parser, "one", "a run directory", metavar="A")
    _add(parser, "other", "another one", metavar="B")
    within = (
        "largest difference that counts as rounding, as a share of the field's largest value (default: %(default)g)"
    )
    _add(parser, "--bound", within, default=BOUND, type=float)
    return parser


def draw() -> ArgumentParser:
    """Draw a task; with a policy, what it does there."""
    parser = _parser(draw)
    _add_task(parser)
    what = "what a figure has: observation ids in the states, their kinds, or the images; default: ids"
    parser.add_argument("--show", choices=("ids", "kinds", "images"), default="ids", help=what)
    _add(parser, "--figure", "write a figure (.png, .pdf, .svg)", metavar="FILE")
    _add(parser, "--dpi", f"pixels an inch of a .png; default: {DPI}", default=DPI, type=int)
    _add(parser, "--dot", "write the graph for Graphviz", metavar="FILE")
    _add(parser, "--gif", "write an episode of the policy as a film", metavar="FILE")
    _add(parser, "--episodes", "episodes used to count visits; default: 1000", default=1000, type=int)
    return parser


def export() -> ArgumentParser:
    """Write the tables of a run, or its log in the format of another program.

    csv: performance.csv, the performance matrix, with evaluations.csv and training.csv. parquet: these, and the last
    two also as Parquet. l2logger: log format 1.1, which l2metrics reads; a training interval, and an evaluation of a
    task, is one experience with its mean return as reward; time stamps count experiences, so runtimes mean nothing.
    """
    parser = _parser(export)
    _add(parser, "run", "a run directory")
    parser.add_argument("--format", choices=EXPORT_FORMATS, default=EXPORT_FORMATS[0], help="the format to write")
    _add(parser, "--out", "the folder to write; for l2logger new or empty", required=True)
    return parser


def play() -> ArgumentParser:
    """Play a CT-graph in the terminal, or watch a policy play it."""
    parser = _parser(play)
    _add_task(parser)
    _add(parser, "--episodes", "of a policy; default: 3", default=3, type=int)
    _add(parser, "--delay", "seconds between a policy's steps; default: 0.5", default=0.5, type=float)
    return parser


def profile() -> ArgumentParser:
    """Train an agent on small curricula for the ten learning properties of the paper, and score it.

    Settings are those of ctgraph-rl -m, such as agent=lstm_ppo seed=range(5). Cells use all cores, and the same command
    resumes. Runs go to runs/profile, and the page shows every agent there. Folders in place of settings only score the
    runs in them, those of a Recorder, too. A score is 0 at the floor of an agent without the property and 1 at the
    optimum. One seed of agent=ppo takes about 45 CPU seconds in all. The exit code is 1 if runs are not done or left
    out.
    """
    parser = _parser(profile)
    parser.add_argument("words", nargs="+", metavar="SETTING=VALUE|FOLDER", help="what to train, or runs to score")
    _add(parser, "--config-dir", "a folder with an agent of your own, agent/NAME.yaml")
    _add(parser, "--out", "where the page goes (default: profile/ within the first folder)")
    _add_agent(parser, "order and rename agents of the page, as in results; agent=NAME is what to train; repeatable")
    return parser


def report() -> ArgumentParser:
    """Write a page of figures and tables of runs."""
    parser = _parser(report)
    _add(parser, "runs", "run directories, or folders that hold them", type=existing, nargs="+")
    _add(parser, "--out", "where the report goes (default: report/ within the one folder given)")
    _add_agent(parser)
    parser.add_argument("--width", default="text", help="of figures: text of a page, or column, one of its two")
    parser.add_argument(
        "--colour",
        action="append",
        default=[],
        metavar="NAME=COLOUR",
        help="of an agent in figures; repeat it for each",
    )
    _add_tuning(parser)
    return parser


def results() -> ArgumentParser:
    """Print a table of runs: each agent on each curriculum, with intervals over seeds.

    Every seed that any agent has on a curriculum is expected of all: one without a run, with an unfinished run or
    with an undefined metric is counted, as in n = 9/10. Agents have the names of their classes: LSTMPPO is
    agent=lstm_ppo. The page docs/reference/metrics.md explains measures. The exit code is 1 if a run cannot be read, or
    if the code of one configuration has changed between runs; these runs are named and shown separately.
    """
    parser = _parser(results)
    _add(parser, "runs", "run directories, or folders that hold them", type=existing, nargs="+")
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--all", action="store_true", help="show every measure instead of the most important")
    which.add_argument(
        "--metrics", metavar="A,B", help="show these measures; solved: each task's share of seeds that solved it"
    )
    parser.add_argument("--format", choices=TABLE_FORMATS, default="text", help="of what is printed (default: text)")
    kinds = "; ".join(f"{kind}: {what}" for kind, what in STATISTICS.items())
    of_seeds = parser.add_mutually_exclusive_group()
    of_seeds.add_argument("--statistics", choices=STATISTICS, default="exact", help=f"{kinds} (default: exact)")
    of_seeds.add_argument("--per-seed", action="store_true", help="show single runs, a row for each measure")
    _add(parser, "--csv", "also write the table with every measure into this file")
    _add(parser, "--tidy", "also write every evaluation as a row into this .csv or .parquet file", metavar="FILE")
    _add_agent(parser)
    _add_tuning(parser)
    parser.add_argument("--compare", metavar="METRIC", help="also compare every two agents, seed by seed")
    _add(parser, "--difference", "how many seeds would find a true difference of this size", type=float)
    return parser


def submit() -> ArgumentParser:
    """Make a submission of finished runs: a folder of files that others can check.

    --template > method.yaml prints what an author says about a method, to fill in once.
    """
    parser = _parser(submit)
    _add(parser, "runs", "run directories, or folders that hold them", nargs="*")
    _add(parser, "--to", "the folder to make", metavar="DIR")
    about = "what you say about the method (default: %(default)s)"
    _add(parser, "--method", about, default=Path("method.yaml"), metavar="FILE")
    parser.add_argument("--track", metavar="NAME", help="the track; default: as the file says")
    only = "leave out runs with another value, such as --only curriculum.depth=4"
    _add(parser, "--only", only, metavar="SETTING=VALUE", nargs="+", default=[], type=_setting)
    _add(parser, "--config-dir", "folder with your own track, track/NAME.yaml", metavar="DIR")
    parser.add_argument("--template", action="store_true", help="print a method.yaml to fill in, and do nothing else")
    return parser


def verify() -> ArgumentParser:
    """Verify a submission up to a level; each level includes those before it.

    rescored: its logs give its numbers; no code runs. rerun: drawn runs are trained again and give the same bits,
    or scores that are no lower where bits are not promised. held_out: other seeds, images and goals are learned,
    and the scores are no lower.
    """
    parser = _parser(verify)
    _add(parser, "submission", "the folder of a submission", metavar="DIR")
    parser.add_argument("--level", choices=LEVELS, default=LEVELS[1], help="how far to verify (default: %(default)s)")
    _add(parser, "--cells", "runs of each level (default: %(default)s)", default=2, metavar="N", type=int)
    drawn = "draws the runs and the held-out seeds, in 0..2^63-1 (default: a random one, which is printed)"
    _add(parser, "--number", drawn, type=int)
    _add(parser, "--code", "folder of modules that are not installed", metavar="DIR")
    _add(parser, "--hours", f"time limit of a process (default: {LIMIT_TIMES} times the submitted run's)", type=float)
    _add(
        parser,
        "--memory",
        "memory limit of all processes of a rerun (default: %(default)g)",
        default=8.0,
        metavar="GB",
        type=float,
    )
    _add(parser, "--disk", "disk limit of a process (default: %(default)g)", default=4.0, metavar="GB", type=float)
    parser.add_argument("--yes", action="store_true", help="skip the prompt despite incomplete isolation")
    _add(parser, "--folder", "folder of the reruns (default: %(default)s)", default=Path("verify"), metavar="DIR")
    _add(parser, "--config-dir", "folder with your own track, track/NAME.yaml", metavar="DIR")
    return parser


class OneLineParser(ArgumentParser):
    """Refuses arguments in one line; ``--help`` shows the usage."""

    @override
    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: error: {message}\n")


def _parser(command: Callable[[], ArgumentParser]) -> ArgumentParser:
    return OneLineParser(prog=f"ctgraph-rl {command.__name__}", description=command.__doc__)


def _add(parser: Any, name: str, help: str, type: Any = Path, **how: Any) -> None:
    """Add an argument that is a path unless ``type`` says otherwise."""
    parser.add_argument(name, help=help, type=type, **how)


def _add_agent(parser: ArgumentParser, about: str = "order and rename agents; repeatable") -> None:
    parser.add_argument("--agent", action="append", default=[], metavar="NAME[=SHOWN]", help=about)


def _add_tuning(parser: ArgumentParser) -> None:
    parser.add_argument("--tuning", action="store_true", help="also show tuning runs, those with objective_until")


def _add_task(parser: ArgumentParser) -> None:
    about = "a configuration of the paper, such as CT-SU-B1; a configuration file of the authors (.json); a curriculum"
    parser.add_argument("name", nargs="?", help=f"{about}. Default: only numbers")
    _add(parser, "--config-dir", "also knows the curricula of this directory", metavar="DIR")
    _add(parser, "--task", "number of a curriculum's task, from 1", default=1, metavar="N", type=int)
    for name, kind in CHANGES.items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=kind, metavar="N")
    _add(parser, "--goal", "the decisions to the goal", metavar="1.2", type=str)
    parser.add_argument("--surjective", action="store_true", help="with numbers only: one image for each kind of state")
    who = parser.add_mutually_exclusive_group()
    who.add_argument("--policy", choices=POLICIES, help="who acts")
    _add(who, "--run", "the trained agent of a run acts, in a task of its curriculum")
    parser.add_argument("--sampled", action="store_true", help="the trained agent samples and explores")
    _add(parser, "--seed", "of the environment", default=0, type=int)


def existing(text: str) -> Path:
    """Read a path of runs that exists."""
    path = Path(text)
    if not path.exists():
        fix = "name a run directory, or a folder that holds some"
        raise argparse.ArgumentTypeError(f"{text} holds no run: there is no such directory; {fix}")
    return path


def _setting(text: str) -> tuple[str, Any]:
    key, sign, value = text.partition("=")
    if not (key and sign):
        raise argparse.ArgumentTypeError(f"settings are written as in curriculum.depth=4, got {text!r}")
    return key, yaml.safe_load(value)
