"""The agents, cells and methods of this package, as the yaml files in ``conf`` name them."""

from __future__ import annotations

import ast
from argparse import ArgumentParser
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from ctgraph_rl.checks import NamedValues
from ctgraph_rl.packages import class_named, conf_dir

ROOT = Path(__file__).resolve().parents[2]


class CatalogueEntry(NamedTuple):
    """A yaml file and the class that it names."""

    name: str
    target: str  # dotted name of the class
    settings: NamedValues
    comment: str  # its first line, but for that which says where its settings go

    @property
    def kind(self) -> Any:
        """The class; to import it loads torch, which takes seconds."""
        module, _, name = self.target.rpartition(".")
        return class_named(module, name)

    @property
    def facts(self) -> NamedValues:
        """The constants among the attributes of the class, read from its source without importing it; none of yours."""
        return constants(self.target) if self.target.startswith("baselines.") else {}

    def says(self, fact: str) -> str:
        """Return ``yes`` or ``no`` of a fact of a class of this package, and ``-`` of yours."""
        return "-" if fact not in self.facts else "yes" if self.facts[fact] else "no"


def config_dir_of(command: str, description: str | None) -> Path | None:
    """Return the ``--config-dir`` of a command that lists, which has no other argument."""
    parser = ArgumentParser(prog=f"ctgraph-rl {command}", description=description)
    parser.add_argument("--config-dir", type=Path, metavar="DIR", help="also lists those of this directory")
    folder: Path | None = parser.parse_args().config_dir
    if folder is not None and not folder.is_dir():
        parser.error(f"--config-dir must be a directory, got {folder}")
    return folder


def catalogue(group: str, config_dir: Path | None = None) -> Iterator[CatalogueEntry]:
    """Yield an entry for each yaml file in ``conf/GROUP``, except those that only change values of another one.

    Args:
        group: such as ``agent``.
        config_dir: a further directory like ``conf``.
    """
    folders = [Path(conf_dir()), *filter(None, [config_dir])]
    for path in chain(*(sorted(Path(folder, group).glob("*.yaml")) for folder in folders)):
        text = path.read_text(encoding="utf-8")
        settings = yaml.safe_load(text)
        if "_target_" in settings:
            target = settings.pop("_target_")
            settings.pop("_partial_", None)
            comments = [line for line in text.splitlines() if line[:1] == "#" and not line.startswith("# @package")]
            yield CatalogueEntry(path.stem, target, settings, comments[0].removeprefix("# ") if comments else target)


def constants(target: str) -> NamedValues:
    """Return what the body of a class of `baselines`, or of one of its bases there, sets to constants."""
    module, _, name = target.rpartition(".")
    tree = _parse_module(module)
    classes = {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}
    homes = dict(_imported(tree)) | dict.fromkeys(classes, module)
    found: NamedValues = {}
    for base in map(ast.unparse, reversed(classes[name].bases)):
        home = homes.get(base, "")
        if home.startswith("baselines."):
            found |= constants(f"{home}.{base}")
    return found | dict(_assigned(classes[name]))


def _parse_module(module: str) -> ast.Module:
    return ast.parse(ROOT.joinpath(*module.split(".")).with_suffix(".py").read_text(encoding="utf-8"))


def _imported(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Yield names that a module imports, each with the module that it is of."""
    for node in tree.body:
        if isinstance(node, ast.ImportFrom):
            yield from ((alias.name, node.module or "") for alias in node.names)


def _assigned(node: ast.ClassDef) -> Iterator[tuple[str, Any]]:
    """Yield name and value of the constants in the body of a class."""
    for line in node.body:
        if isinstance(line, (ast.Assign, ast.AnnAssign)) and isinstance(line.value, ast.Constant):
            targets = line.targets if isinstance(line, ast.Assign) else [line.target]
            yield from ((ast.unparse(target), line.value.value) for target in targets)
