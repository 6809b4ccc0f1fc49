"""``python -m baselines``: the agents, and what each can solve in principle."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from importlib import import_module
from pkgutil import iter_modules

import baselines
from baselines.learner import Learner


def agents() -> Iterator[tuple[str, type[Learner]]]:
    """Name and class of every agent: a class that says what it ``solves``, in the file of that name."""
    for module in iter_modules(baselines.__path__):
        if module.name.startswith("_"):
            continue
        for kind in vars(import_module(f"baselines.{module.name}")).values():
            own = isinstance(kind, type) and kind.__module__ == f"baselines.{module.name}"
            if own and issubclass(kind, Learner) and hasattr(kind, "solves"):
                yield module.name, kind


def main() -> None:
    """Print a line for every agent."""
    argparse.ArgumentParser(prog="ctgraph-rl agents", description=main.__doc__).parse_args()
    print("agent=NAME   memory  can solve in principle")
    for name, kind in agents():
        print(f"{name:<12} {'yes' if kind.memory else 'no':<7} {kind.solves}")


if __name__ == "__main__":
    main()
