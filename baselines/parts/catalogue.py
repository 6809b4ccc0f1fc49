"""The agents, cells and methods that the yaml files in ``conf`` name."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from ctgraph_rl.checks import NamedValues
from ctgraph_rl.packages import class_named, conf_dir
from ctgraph_rl.parsers import OneLineParser

ROOT = Path(__file__).resolve().parents[2]


class CatalogueEntry(NamedTuple):
    """A yaml file and the class that it names."""

    name: str
    target: str  # dotted name of the class
    settings: NamedValues
    comment: str  # its first line, but for that which says where its settings go

    @property
    def kind(self) -> Any:
        """The class; its import loads torch, which takes seconds."""
        module, _, name = self.target.rpartition(".")
        return class_named(module, name)

    @property
    def facts(self) -> NamedValues:
        """The class's constants, read from its source without an import; empty for yours."""
        return constants(self.target) if self.target.startswith("baselines.") else {}

    def says(self, fact: str) -> str:
        """Return ``yes`` or ``no`` of a fact of our class, ``-`` of yours."""
        return "-" if fact not in self.facts else "yes" if self.facts[fact] else "no"


def config_dir_of(command: str, description: str | None) -> Path | None:
    """Return the ``--config-dir`` of a listing command."""
    parser = OneLineParser(prog=f"ctgraph-rl {command}", description=description)
    parser.add_argument("--config-dir", type=Path, metavar="DIR", help="also lists those of this directory")
    folder: Path | None = parser.parse_args().config_dir
    if folder is not None and not folder.is_dir():
        parser.error(f"--config-dir must be a directory, got {folder}")
    return folder


def catalogue(group: str, config_dir: Path | None = None) -> Iterator[CatalogueEntry]:
    """Yield an entry for each yaml file in ``conf/GROUP`` that does not only change values of another one.

    Args:
        group: such as ``agent``.
        config_dir: a further directory like ``conf``.
    """
    paths = sorted(Path(conf_dir(), group).glob("*.yaml"))
    if config_dir is not None:
        paths += sorted(Path(config_dir, group).glob("*.yaml"))
    for path in paths:
        text = path.read_text(encoding="utf-8")
        settings = yaml.safe_load(text) or {}
        if "_target_" in settings:
            target = settings.pop("_target_")
            settings.pop("_partial_", None)
            comments = [line for line in text.splitlines() if line[:1] == "#" and not line.startswith("# @package")]
            yield CatalogueEntry(path.stem, target, settings, comments[0].removeprefix("# ") if comments else target)


def constants(target: str) -> NamedValues:
    """Return the constants of a class of `baselines` and its bases there."""
    module, _, name = target.rpartition(".")
    path = ROOT.joinpath(*module.split(".")).with_suffix(".py")
    homes: dict[str, str] = {}
    classes: dict[str, ast.ClassDef] = {}
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                homes[alias.name] = f"{node.module}.{alias.name}"
        elif isinstance(node, ast.ClassDef):
            homes[node.name] = f"{module}.{node.name}"
            classes[node.name] = node
    found: NamedValues = {}
    for base in reversed(classes[name].bases):
        home = homes.get(ast.unparse(base), "")
        if home.startswith("baselines."):
            found |= constants(home)
    for line in classes[name].body:
        if isinstance(line, (ast.Assign, ast.AnnAssign)) and isinstance(line.value, ast.Constant):
            targets = line.targets if isinstance(line, ast.Assign) else [line.target]
            for each in targets:
                found[ast.unparse(each)] = line.value.value
    return found
