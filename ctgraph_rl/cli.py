"""The console script ``ctgraph-rl``: a first word chooses a command, a setting starts a run."""

from __future__ import annotations

import atexit
import gc
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

from ctgraph_rl import __version__, parsers
from ctgraph_rl.checks import nearest
from ctgraph_rl.log.escape import terminal_lines
from ctgraph_rl.packages import check_packages, conf_dir


class Command(NamedTuple):
    """A command: the module of its ``main``, imported when called, and a line about it."""

    module: str
    about: str


RUN = "ctgraph_rl.run"

COMMANDS = {
    "run": Command(RUN, "train an agent on a curriculum (default command)"),
    "agents": Command("baselines.__main__", "list the agents"),
    "board": Command("ctgraph_rl.board.standings.board_page", "make a page with tables of submissions"),
    "collectives": Command("ctgraph_rl.collective.report", "make a page of figures and tables of learners that share"),
    "compare": Command("ctgraph_rl.compare", "say whether two runs are equal, bit for bit; report compares agents"),
    "curricula": Command("curricula.__main__", "list the curricula, or describe one"),
    "draw": Command("ctgraph_rl.play.pictures", "draw a task, and what a policy does there"),
    "export": Command("ctgraph_rl.log.export", "write a run in the format of another program"),
    "methods": Command("baselines.methods.__main__", "list the lifelong-learning methods"),
    "play": Command("ctgraph_rl.play.game", "play a CT-graph, or watch a policy play it"),
    "profile": Command("ctgraph_rl.profile.__main__", "score an agent on ten learning properties"),
    "report": Command("ctgraph_rl.report.page", "make a page of figures and tables of runs"),
    "results": Command("ctgraph_rl.report.results", "print a table of runs over seeds"),
    "submit": Command("ctgraph_rl.board.submit", "make a submission of runs, a folder that others can check"),
    "verify": Command("ctgraph_rl.board.verify", "check a submission by its files, reruns and held-out seeds"),
}

SETTINGS = {
    "curriculum=NAME": "what is learned; ctgraph-rl curricula lists them",
    "agent=NAME": "who learns; ctgraph-rl agents lists them",
    "method=NAME": "a lifelong-learning method; ctgraph-rl methods lists them",
    "seed=0": "decides weights, exploration and environments",
    "curriculum.num_frames=1e5": "environment steps of each task",
    "agent.learning_rate=1e-3": "a hyperparameter of the agent",
}

PARTS = {
    **{part: f"curricula {part}" for part in ("describe", "list", "probabilities")},
    **dict.fromkeys(("fit", "learn", "start", "train"), "run"),
    **dict.fromkeys(("evaluate", "plot", "show"), "report"),
    "sweep": "-m",
    **{option: f"--{option}" for option in ("help", "version")},
}

USAGE = """usage: ctgraph-rl COMMAND ...         each command has --help
       ctgraph-rl SETTING=VALUE ...    one run, such as ctgraph-rl curriculum=su_b1_4tasks agent=dqn
       ctgraph-rl -m SETTING=A,B ...   a run for each combination

An agent learns a curriculum of CT-graph tasks, and its transfer and forgetting are measured.

commands:
{commands}

settings of a run:
{settings}

options:
  -h, --help     show this text; ctgraph-rl run --help shows all settings
  --version      show the versions of ctgraph_rl and what it is built on
  --hydra-help   show the options that Hydra adds to a run"""

FULL_COLLECTIONS = 100
"""Middle collections between two full ones; Python's default is 10."""


def main() -> None:
    """Run one of `COMMANDS`, or with settings only `ctgraph_rl.run`."""
    with quiet_where_nobody_reads():
        _call()


def _call() -> None:
    words = sys.argv[1:]
    word = words[0] if words else "--help"
    if word in ("-h", "--help"):
        print(usage())
    elif word == "--version":
        print(versions())
    elif word in COMMANDS:
        sys.argv = [f"ctgraph-rl {word}".removesuffix(" run"), *words[1:]]
        parser = getattr(parsers, word, None)
        if parser is not None:
            parser().parse_args()  # --help and what it refuses need no torch
        _start(COMMANDS[word].module)
    elif word[:1].isalpha() and word.replace("-", "_").isidentifier():  # settings have a sign: seed=1, ~logger, -m
        print(f"error: {terminal_lines(_unknown(word))}", file=sys.stderr)
        sys.exit(2)
    else:
        _start(RUN)


def command(module: str) -> Callable[[], None]:
    """Return the ``main`` of a module of this package, of `curricula` or of `baselines`.

    Raises:
        ValueError: as `check_packages`.
    """
    if not module.startswith("ctgraph_rl."):
        check_packages()
    with first_imports():
        return import_module(module).main


def _start(module: str) -> None:
    try:
        main = command(module)
    except ValueError as error:
        sys.exit(f"error: {error}")
    main()


@contextmanager
def first_imports() -> Iterator[None]:
    """Pause garbage collection while torch is imported for the first time, and leave its objects out of later ones.

    A full collection visits torch's 300,000 objects, without garbage, several times in an import. Later full
    collections are ten times as rare: the objects of `torch.compile` take 0.3 s to visit and last, too.
    """
    pauses = gc.isenabled() and "torch" not in sys.modules
    if pauses:
        gc.disable()
    try:
        yield
    finally:
        if pauses:
            gc.freeze()
            if "triton" in sys.modules:  # it lists what is left at the exit
                atexit.register(gc.unfreeze)
            young, middle, _ = gc.get_threshold()
            gc.set_threshold(young, middle, FULL_COLLECTIONS)
            gc.enable()


@contextmanager
def quiet_where_nobody_reads() -> Iterator[None]:
    """Exit quietly with code 1 once standard output has no reader, as in ``ctgraph-rl results | head``."""
    try:
        yield
        if sys.stdout is not None:
            sys.stdout.flush()
    except BrokenPipeError:
        if _has_reader():
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is left has nowhere to go
        sys.exit(1)


def _has_reader() -> bool:
    try:
        print(flush=True)
    except BrokenPipeError:
        return False
    return True


def usage() -> str:
    """Return the text of ``ctgraph-rl`` without arguments."""
    commands = {name: each.about for name, each in COMMANDS.items()}
    return USAGE.format(commands=_table(commands), settings=_table(SETTINGS))


def _table(lines: Mapping[str, str]) -> str:
    width = max(map(len, lines))
    return "\n".join(f"  {name:{width}}  {about}" for name, about in lines.items())


def versions() -> str:
    """Return the versions of this package and of what decides a run's numbers, without importing them."""
    others = ", ".join(f"{name} {version(name)}" for name in ("torch", "torchrl", "hydra-core"))
    return f"ctgraph_rl {__version__} ({others})"


def _unknown(word: str) -> str:
    conf = Path(conf_dir())
    groups = {path.name: f"{path.name}=NAME" for path in conf.iterdir() if path.is_dir()}
    files = {path.stem: f"{path.parent.name}={path.stem}" for path in conf.glob("*/*.yaml")}
    meant = {**files, **PARTS, **dict(zip(COMMANDS, COMMANDS, strict=True))}
    near = groups.get(word) or meant.get(nearest(word, meant) or "")
    hint = "" if near is None else f"; did you mean ctgraph-rl {near}?"
    return f"unknown command {word!r}{hint}\nCommands: {', '.join(COMMANDS)}; settings of a run are written as seed=1"


if __name__ == "__main__":
    main()
