"""The source that a run's numbers depend on beside this package: a digest of each module of the user.

A module is the user's if it is a .py file neither of this package, nor of the standard library, nor installed. It
counts with all modules of the user that it imports, also within functions. Digests are of the code: comments,
docstrings and layout do not count. Of a script, ``__main__``, only the
definitions count that a class needs. An installed package counts by its version, if a class of it is named. Data and
compiled extensions do not count.
"""

from __future__ import annotations

import ast
import hashlib
import sys
import sysconfig
from collections.abc import Iterable, Iterator
from importlib import metadata
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

OURS = ("ctgraph_rl", "baselines", "curricula", "hydra_plugins")

RECORDED = ("torch", "torchrl", "tensordict", "hydra")
"""Installed packages whose versions every run stores anyway."""

INSTALLED = frozenset({"site-packages", "dist-packages"})

STANDARD = tuple(sysconfig.get_path(name) for name in ("stdlib", "platstdlib"))

SCRIPT = "__main__"

SCRIPTS = (SCRIPT, "__mp_main__")


class Module(NamedTuple):
    """A user's module."""

    digest: str | None  # None if its file cannot be read
    imports: frozenset[str]  # modules that it imports, and names that may be modules


_READ: dict[str, tuple[ModuleSpec, Module]] = {}
"""Modules as first read after their import: later edits do not change the running code."""


def find_sources(names: Iterable[str]) -> dict[str, str | None]:
    """Return the digest of each user module that classes or functions need, by module name.

    An installed package has its version instead; None stands for what cannot be read, such as a notebook's class.

    Args:
        names: dotted names, such as ``my_agent.MyAgent``; those of this package and Python need nothing.
    """
    found: dict[str, str | None] = {}
    waiting: list[str] = []
    for name in names:
        package = name.partition(".")[0]
        if package in SCRIPTS:
            module = _of_script(name.split(".")[1])
            found[SCRIPT] = module and module.digest
            waiting += module.imports if module else ()
        elif package not in (*OURS, *RECORDED):
            waiting.append(name)
            found |= _installed(package)
    while waiting:
        for name, spec in _specs(waiting.pop()):
            origin = spec.origin or ""
            is_users = origin.endswith(".py") and not _is_installed(spec) and not origin.startswith(STANDARD)
            if name not in found and is_users:
                module = _module(name, spec)
                found[name] = module.digest
                waiting += module.imports
    return dict(sorted(found.items()))


def _specs(name: str) -> Iterator[tuple[str, ModuleSpec]]:
    package, *rest = name.split(".")
    if package in OURS:
        return
    spec = _top(package)
    while spec is not None:
        yield package, spec
        if not rest or spec.submodule_search_locations is None or _is_installed(spec):
            return
        name = rest.pop(0)
        package = f"{package}.{name}"
        # by its last name, as a dotted one needs its parent imported
        spec = PathFinder.find_spec(name, list(spec.submodule_search_locations))


def _top(package: str) -> ModuleSpec | None:
    try:
        return find_spec(package)
    except (ValueError, ImportError):  # a module that was made by hand
        return None


def _is_installed(spec: ModuleSpec) -> bool:
    places = [spec.origin or "", *(spec.submodule_search_locations or ())]
    return any(INSTALLED & {*Path(place).parts} for place in places)


def _installed(package: str) -> dict[str, str | None]:
    spec = _top(package)
    if spec is None:
        return {package: None}
    if not _is_installed(spec):
        return {}
    try:
        return {package: f"version {metadata.version(package)}"}
    except metadata.PackageNotFoundError:
        names = metadata.packages_distributions().get(package, ())
        return {package: f"version {metadata.version(names[0])}" if names else None}


def _module(name: str, spec: ModuleSpec) -> Module:
    imported = getattr(sys.modules.get(name), "__spec__", None)
    if imported is not None and name in _READ and _READ[name][0] is imported:
        return _READ[name][1]
    try:
        source = Path(str(spec.origin)).read_bytes()
    except OSError:  # it was removed, or is in an archive
        return Module(None, frozenset())
    module = read_module(name, source, spec.submodule_search_locations is not None)
    if imported is not None:
        _READ[name] = imported, module
    return module


def read_module(name: str, source: bytes, is_package: bool = False) -> Module:
    """Return digest and imports of a module.

    Args:
        name: its dotted name, which relative imports start from.
        source: its file; other than Python of this version it counts by bytes.
        is_package: whether it is the ``__init__`` of a package.
    """
    package = name if is_package else name.rpartition(".")[0]
    try:
        tree = ast.parse(source)
        imports = frozenset(_imports(tree, package))
        return Module(_hash(code_text(tree)), imports)
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return Module(_hash(source.hex()), frozenset())


def _of_script(name: str) -> Module | None:
    path = getattr(sys.modules.get(SCRIPT), "__file__", None)
    if path is None or not Path(path).is_file():
        return None
    tree = ast.parse(Path(path).read_bytes())
    package = getattr(sys.modules[SCRIPT], "__package__", None) or ""
    tree.body = _needed(tree.body, name)
    if not tree.body:
        return None
    imports = frozenset(_imports(tree, package))
    return Module(_hash(code_text(tree)), imports)


def _needed(statements: Iterable[ast.stmt], name: str) -> list[ast.stmt]:
    mentions = {each: {node.id for node in ast.walk(each) if isinstance(node, ast.Name)} for each in statements}
    defines = {each: set(_defined(each)) for each in mentions}
    wanted = {name}
    kept = set[ast.stmt]()
    while new := {each for each in mentions if each not in kept and defines[each] & wanted}:
        kept |= new
        for each in new:
            wanted |= mentions[each]
    return [each for each in mentions if each in kept]


DEFINITIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)


def _defined(statement: ast.stmt) -> Iterator[str]:
    if isinstance(statement, DEFINITIONS):
        yield statement.name
        return
    for node in ast.walk(statement):
        if isinstance(node, (ast.Attribute, ast.Subscript)) and isinstance(node.ctx, ast.Store):
            root: ast.expr = node
            while isinstance(root, (ast.Attribute, ast.Subscript)):
                root = root.value
            if isinstance(root, ast.Name):
                yield root.id
        if isinstance(node, ast.alias):
            yield (node.asname or node.name).partition(".")[0]
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id
        elif isinstance(node, DEFINITIONS):
            yield node.name


def _imports(tree: ast.AST, package: str) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            for alias in node.names if parents or not node.level else ():
                yield ".".join(filter(None, [*parents, node.module, alias.name]))
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith(("import_module", "__import__")):
            for each in (*node.args[:1], *(each.value for each in node.keywords if each.arg == "name")):
                if isinstance(each, ast.Constant) and isinstance(each.value, str):
                    yield f"{package}{each.value}" if each.value.startswith(".") else each.value


def code_text(tree: ast.AST) -> str:
    """Return the code of a syntax tree, which it changes: without comments, layout and statements that do nothing."""
    for node in ast.walk(tree):
        for name in ("body", "orelse", "finalbody"):
            statements = getattr(node, name, None)
            if isinstance(statements, list):
                setattr(node, name, [each for each in statements if not _has_no_effect(each)])
    return ast.unparse(tree)


def _has_no_effect(node: ast.AST) -> bool:
    return isinstance(node, ast.Pass) or (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant))


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode("ascii", "backslashreplace")).hexdigest()[:16]
