"""``python -m baselines.methods``: the methods, and what each must be told."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import yaml

from baselines.methods.method import Method
from ctgraph_rl.packages import conf_dir


def methods() -> Iterator[tuple[str, type[Method], str, str]]:
    """Name, class, when it needs task ids and what it is, of every yaml that names a class."""
    for path in sorted(Path(conf_dir(), "method").glob("*.yaml")):
        text = path.read_text(encoding="utf-8")
        settings = yaml.safe_load(text)
        if "_target_" not in settings:  # another's with other values
            continue
        module, _, name = settings["_target_"].rpartition(".")
        kind = getattr(import_module(module), name)
        ids = "yes" if kind.needs_task_id else "heads=multi" if "heads" in settings else "no"
        yield path.stem, kind, ids, text.splitlines()[0].removeprefix("# ")


def main() -> None:
    """Print a line for every method."""
    argparse.ArgumentParser(prog="ctgraph-rl methods", description=main.__doc__).parse_args()
    print("method=NAME  needs ids    boundaries  what it is")
    for name, kind, ids, words in methods():
        print(f"{name:<12} {ids:<12} {'yes' if kind.needs_boundaries else 'no':<11} {words}")


if __name__ == "__main__":
    main()
