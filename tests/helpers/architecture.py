"""What modules import and call, read once from their source text, and the rules of the house over that.

A rule takes modules and returns its findings, one text for each place that breaks it, sorted and without line numbers.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

from helpers.paths import CHECKOUT

PACKAGES = ("ctgraph_rl", "curricula", "baselines", "benchmarks", "hydra_plugins")
RESULTS = CHECKOUT / "docs" / "results"
FUNCTION = (ast.FunctionDef, ast.AsyncFunctionDef)
BY_NAME = ("import_module", "find_spec", "__import__")
"""Functions that import, or look for, a module by its name."""


@dataclass(frozen=True)
class Import:
    """A name that a statement imports."""

    module: str
    """Where the name is: the module itself, or the one that it is a name of."""

    name: str | None = None
    """The name in that module; None for a whole module."""

    in_function: bool = False
    typing: bool = False
    """Whether it is for type checkers only."""

    reasoned: bool = False
    """Whether its line has a comment."""

    @property
    def full(self) -> str:
        return self.module if self.name is None else f"{self.module}.{self.name}"

    @property
    def is_ours(self) -> bool:
        return self.module.partition(".")[0] in (*PACKAGES, "studies")


@dataclass(frozen=True)
class Module:
    """What the rules need to know of a module."""

    name: str
    is_folder: bool
    docstring: str
    imports: tuple[Import, ...] = ()
    calls: tuple[tuple[str, int], ...] = ()
    """Functions and with how many positional arguments they are called."""

    by_name: tuple[str | None, ...] = ()
    """The beginnings of the names of modules that it imports by name; None where the source does not say."""

    private: tuple[str, ...] = ()
    """Private names of other modules of ours that it uses."""

    starred: tuple[str, ...] = ()
    """Functions that star into a call a dict of literal keys that they made for it."""

    classes: tuple[str, ...] = ()
    """Public classes and aliases of types."""


@dataclass
class _Reader(ast.NodeVisitor):
    """Collects facts of one module in one walk over its tree."""

    lines: Sequence[str]
    is_module: Callable[[str], bool]
    with_expressions: bool
    """Whether to look for calls and private names, too."""

    imports: list[Import] = field(default_factory=list)
    calls: list[tuple[str, int]] = field(default_factory=list)
    by_name: list[str | None] = field(default_factory=list)
    private: list[str] = field(default_factory=list)
    modules: dict[str, str] = field(default_factory=dict)
    depth: int = 0
    typing: bool = False

    def visit(self, node: ast.AST) -> None:
        if self.with_expressions or not isinstance(node, ast.expr):
            super().visit(node)

    def visit_If(self, node: ast.If) -> None:
        before, self.typing = self.typing, self.typing or "TYPE_CHECKING" in ast.unparse(node.test)
        for child in node.body:
            self.visit(child)
        self.typing = before
        for child in (node.test, *node.orelse):
            self.visit(child)

    def visit_FunctionDef(self, node: ast.FunctionDef | ast.AsyncFunctionDef) -> None:
        self.depth += 1
        self.generic_visit(node)
        self.depth -= 1

    visit_AsyncFunctionDef = visit_FunctionDef

    def visit_Import(self, node: ast.Import) -> None:
        for alias in node.names:
            self._add(node, alias.name, None, alias.asname or alias.name)

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        assert node.level == 0 and node.module, f"relative import: {ast.unparse(node)}"
        for alias in node.names:
            full = f"{node.module}.{alias.name}"
            if self.is_module(full):
                self._add(node, full, None, alias.asname or alias.name)
            else:
                self._add(node, node.module, alias.name)

    def _add(self, node: ast.stmt, module: str, name: str | None, bound: str = "") -> None:
        reasoned = any("#" in line for line in self.lines[node.lineno - 1 : node.end_lineno])
        found = Import(module, name, self.depth > 0, self.typing, reasoned)
        self.imports.append(found)
        if found.is_ours and name is None:
            self.modules[bound] = module
        elif found.is_ours and name is not None and is_private(name):
            self.private.append(f"{module}.{name}")

    def visit_Attribute(self, node: ast.Attribute) -> None:
        module = self.modules.get(_dotted(node.value)) if is_private(node.attr) else None
        if module is not None:
            self.private.append(f"{module}.{node.attr}")
        self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        called = _dotted(node.func)
        self.calls.append((called, len(node.args)))
        if called.rpartition(".")[2] in BY_NAME:
            self.by_name.append(_beginning(node.args[0]) if node.args else None)
        self.generic_visit(node)


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.endswith("__")


def _dotted(node: ast.expr) -> str:
    """The source text of a name and its attributes, for which ``ast.unparse`` is slow; of others without brackets."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute):
        return f"{_dotted(node.value)}.{node.attr}"
    return ast.unparse(node)


def _beginning(argument: ast.expr) -> str | None:
    """The constant text that an argument begins with."""
    if isinstance(argument, ast.JoinedStr) and argument.values:
        argument = argument.values[0]
    return argument.value if isinstance(argument, ast.Constant) and isinstance(argument.value, str) else None


def read(sources: Mapping[str, str], with_bodies: bool = True) -> list[Module]:
    """The modules of source texts, by their names; that of a folder's ``__init__`` ends with ``.__init__``.

    What a folder imports for type checkers only is what it exports lazily: who imports it from there, imports it from
    where it is.

    Args:
        sources: texts by the names of their modules.
        with_bodies: whether to look for more than imports: for calls, starred dicts and public classes.
    """
    names = {name.removesuffix(".__init__") for name in sources}
    modules = [_module(name, text, names.__contains__, with_bodies) for name, text in sources.items()]
    homes = {
        (module.name, one.name): one.module
        for module in modules
        if module.is_folder
        for one in module.imports
        if one.typing and one.name
    }
    return [
        replace(
            module,
            imports=tuple(replace(one, module=homes.get((one.module, one.name), one.module)) for one in module.imports),
        )
        for module in modules
    ]


def _module(name: str, text: str, is_module: Callable[[str], bool], with_bodies: bool) -> Module:
    tree, lines = ast.parse(text), text.splitlines()
    reader = _Reader(lines, is_module, with_bodies)
    reader.visit(tree)
    found = Module(
        name.removesuffix(".__init__"),
        name.endswith(".__init__"),
        ast.get_docstring(tree) or "",
        imports=tuple(reader.imports),
        calls=tuple(reader.calls),
        by_name=tuple(reader.by_name),
        private=tuple(reader.private),
    )
    if not with_bodies:
        return found
    functions = [node for node in ast.walk(tree) if isinstance(node, FUNCTION)]
    return replace(
        found,
        starred=tuple(_starred_dicts(functions)),
        classes=tuple(_public_classes(tree)),
    )


def _starred_dicts(functions: Iterable[ast.FunctionDef]) -> Iterator[str]:
    """Functions that star a dict of literal keys into a call, but for those that set other items of it."""
    for function in functions:
        nodes = list(ast.walk(function))
        made = {name for node in nodes for name in _literal_dicts(node)}
        if not made:
            continue
        starred = {
            ast.unparse(each.value)
            for node in nodes
            if isinstance(node, ast.Call)
            for each in node.keywords
            if each.arg is None
        }
        changed = {
            ast.unparse(node.value)
            for node in nodes
            if isinstance(node, ast.Subscript) and isinstance(node.ctx, ast.Store)
        }
        if made & starred - changed:
            yield function.name


def _literal_dicts(node: ast.AST) -> Iterator[str]:
    """The name that a statement gives to a dict whose keys are all literals."""
    value = node.value if isinstance(node, ast.Assign | ast.AnnAssign) else None
    if isinstance(value, ast.Dict) and value.keys and all(isinstance(key, ast.Constant) for key in value.keys):
        yield ast.unparse(node.targets[0] if isinstance(node, ast.Assign) else node.target)


def _public_classes(tree: ast.Module) -> Iterator[str]:
    """The public classes of a module and its aliases of types, whose names are in camel case."""
    for node in tree.body:
        name = node.name if isinstance(node, ast.ClassDef) else ""
        if isinstance(node, ast.Assign) and len(node.targets) == 1:
            name = ast.unparse(node.targets[0])
        if re.fullmatch(r"[A-Z]+[a-z]\w*", name):
            yield name


def find_sources(*folders: str, root: Path = CHECKOUT) -> dict[str, str]:
    """Source texts of the checkout by the names of their modules, which begin at a root."""
    paths = sorted(path for folder in folders for path in (root / folder).rglob("*.py"))
    return {".".join(path.relative_to(root).with_suffix("").parts): path.read_text("utf-8") for path in paths}


@cache
def modules_of_packages() -> list[Module]:
    """The modules of our packages."""
    return read(find_sources(*PACKAGES))


@cache
def modules_of_results() -> list[Module]:
    """The modules of the pages of results: the command and its studies."""
    return read(find_sources(".", root=RESULTS))


@cache
def modules_of_tests() -> list[Module]:
    """The modules of the tests, of which the rules need the imports."""
    return read(find_sources("tests"), with_bodies=False)


# The rules


def arrows(modules: Iterable[Module], typing: bool) -> dict[str, set[str]]:
    """The modules of ours that each module imports, with or without those for type checkers only.

    What the root of a package exports is not its own: its imports are left out.
    """
    inner = [module for module in modules if "." in module.name]
    return {
        module.name: {one.module for one in module.imports if one.is_ours and (typing or not one.typing)}
        - {module.name}
        for module in inner
    }


def wing(module: str) -> str:
    """The folder or single module of ``ctgraph_rl`` that a module belongs to; of other packages, the package."""
    package, *parts = module.split(".")
    return parts[0] if package == "ctgraph_rl" and parts else package


def upward(modules: Iterable[Module], floors: Sequence[Sequence[str]], top: Mapping[str, str]) -> list[str]:
    """Imports that do not go down.

    Args:
        modules: of which imports are read.
        floors: wings, lower ones first; those of one floor do not import each other.
        top: modules that stand above all floors, and why.
    """
    floor = {name: number for number, names in enumerate(floors) for name in names}

    def place(module: str) -> float:
        return len(floors) if module in top else floor.get(wing(module), -1.0)

    unplaced = {f"{module.name} is on no floor" for module in modules if place(module.name) < 0}
    return sorted(
        unplaced
        | {
            f"{source} -> {target}"
            for source, targets in arrows(modules, typing=True).items()
            for target in targets
            if place(target) >= place(source)
            and (wing(source) != wing(target) or {source, target} & set(top) == {target})
        }
    )


def circles(graph: Mapping[str, set[str]]) -> list[tuple[str, ...]]:
    """Groups of modules that reach each other."""
    reached = {start: _reached(graph, start) for start in graph}
    groups = {
        tuple(sorted({start, *(other for other in reached[start] if start in reached.get(other, ()))}))
        for start in graph
        if start in reached[start]
    }
    return sorted(groups)


def _reached(graph: Mapping[str, set[str]], start: str) -> set[str]:
    found: set[str] = set()
    waiting = list(graph[start])
    while waiting:
        here = waiting.pop()
        if here not in found:
            found.add(here)
            waiting += graph.get(here, ())
    return found


def circles_at_run_time(modules: Iterable[Module]) -> list[str]:
    """Circles of imports, by statements and by name.

    The names that ``ctgraph_rl`` exports are found when they are used: what it imports by name is left out.
    """
    names = [module.name for module in modules if not module.name.endswith("__main__")]
    graph = arrows(modules, typing=False)
    for module in modules:
        if module.name != "ctgraph_rl":
            graph.setdefault(module.name, set()).update(_called_by(module, names))
    return [" <-> ".join(group) for group in circles(graph)]


def _called_by(module: Module, names: Iterable[str]) -> Iterator[str]:
    """The modules that one imports by a name that its source says, or whose beginning it says."""
    for said in filter(None, module.by_name):
        for name in names:
            if name == said or (said.endswith(".") and name.startswith(said)):
                yield name


def circles_between_wings(modules: Iterable[Module]) -> list[str]:
    """Circles, those of imports for type checkers included, that reach beyond a wing."""
    groups = circles(arrows(modules, typing=True))
    return [" <-> ".join(group) for group in groups if len({wing(name) for name in group}) > 1]


def _is_of(name: str, packages: Iterable[str]) -> bool:
    return any(f"{name}.".startswith(f"{package}.") for package in packages)


def users_of(modules: Iterable[Module], *packages: str) -> list[str]:
    """Modules that import one of these packages, for type checkers only or not."""
    return sorted({module.name for module in modules for one in module.imports if _is_of(one.full, packages)})


def forbidden(modules: Iterable[Module], never: Mapping[str, Sequence[str]]) -> list[str]:
    """Imports of packages that modules of a package must never import when they run."""
    return sorted(
        {
            f"{module.name} -> {one.full}"
            for module in modules
            for package, others in never.items()
            for one in module.imports
            if _is_of(module.name, [package]) and _is_of(one.full, others) and not one.typing
        }
    )


def imported_by_name(modules: Iterable[Module], doors: Iterable[str]) -> list[str]:
    """Modules besides some doors that import one of our packages by its name, or what the source does not say."""
    found = ((module.name, name) for module in modules if module.name not in doors for name in module.by_name)
    return sorted({f"{where}: {name or '?'}" for where, name in found if name is None or Import(name).is_ours})


def starred_dicts(modules: Iterable[Module]) -> list[str]:
    return sorted(f"{module.name}.{name}" for module in modules for name in module.starred)


def classes_defined_twice(modules: Iterable[Module]) -> dict[str, list[str]]:
    """Public names of classes and aliases that several modules define, with these modules."""
    found: dict[str, list[str]] = {}
    for module in modules:
        for name in module.classes:
            found.setdefault(name, []).append(module.name)
    return {name: homes for name, homes in sorted(found.items()) if len(homes) > 1}


def modules_of_one_name(modules: Iterable[Module]) -> dict[str, list[str]]:
    """Names that several modules have, with these modules."""
    found: dict[str, list[str]] = {}
    for module in modules:
        last = module.name.rpartition(".")[2]
        if not module.is_folder and last != "__main__":
            found.setdefault(last, []).append(module.name)
    return {name: homes for name, homes in sorted(found.items()) if len(homes) > 1}


def long_calls(modules: Iterable[Module], most: int, exceptions: Iterable[str] = ()) -> list[str]:
    """Calls with more positional arguments than allowed, but for some functions."""
    found = ((module.name, called, number) for module in modules for called, number in module.calls)
    return sorted({f"{name}: {called}" for name, called, number in found if number > most and called not in exceptions})


def private_names(modules: Iterable[Module]) -> list[str]:
    return sorted({f"{module.name}: {name}" for module in modules for name in module.private})


def imports_in_functions(modules: Iterable[Module]) -> list[tuple[str, Import]]:
    """Our own imports inside functions, with the modules that have them."""
    return [(module.name, one) for module in modules for one in module.imports if one.is_ours and one.in_function]


def unexplained_folders(modules: Iterable[Module]) -> list[str]:
    """Folders whose docstring has not two or three sentences."""
    return sorted(
        module.name
        for module in modules
        if module.is_folder and not 2 <= len(re.findall(r"[.!?](?=\s|$)", module.docstring)) <= 3
    )


def tests_that_import_tests(modules: Iterable[Module]) -> list[str]:
    pattern = re.compile(r"(^|\.)(test_\w+|conftest)($|\.)")
    return sorted(
        {f"{module.name}: {one.module}" for module in modules for one in module.imports if pattern.search(one.full)}
    )
