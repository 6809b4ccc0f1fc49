"""The sample: drawn with a seed, a share for each wing, and kept in ``sample.json`` with the killer of each mutant."""

from __future__ import annotations

import ast
import json
import random
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from itertools import groupby
from pathlib import Path

from helpers.mutants.operators import Change, changes, parses, replaced

CHECKOUT = Path(__file__).resolve().parents[3]
STORED = Path(__file__).with_name("sample.json")

PACKAGES = ("baselines", "ctgraph_rl", "curricula", "hydra_plugins")

EXCLUDED = {
    "ctgraph_rl/core/region.py": "captures on a GPU",
}
"""Modules of which nothing is drawn, and why. Texts, imports and annotations are left out by the operators."""

LEAST = 2
"""Mutants of the smallest wing; the others have shares as large as their code."""


@dataclass(frozen=True)
class Mutant:
    """A change of one line of a module, found again by its text, and what became of it."""

    path: str
    before: str
    after: str
    function: str = ""
    killer: str = ""
    """A test that fails, PATH::FUNCTION; empty while none is known."""

    equivalent: str = ""
    """Why no test can fail: the program does the same."""

    @property
    def wing(self) -> str:
        """The folder of the module."""
        return _folder(self.path)

    def change(self, checkout: Path = CHECKOUT) -> Change | None:
        """Return the change where its line is now; None if the function has no such line any more."""
        found = [
            one for one in _changes(checkout / self.path) if (one.function, one.before) == (self.function, self.before)
        ]
        return next((one for one in found if one.after == self.after), None)


def stored() -> tuple[int, list[Mutant]]:
    """Return the seed and the mutants that were drawn with it."""
    read = json.loads(STORED.read_text())
    return read["seed"], [Mutant(**given) for given in read["mutants"]]


def store(seed: int, mutants: Iterable[Mutant]) -> None:
    """Write the sample, a line for each mutant's field that says something."""
    listed = [{name: value for name, value in asdict(mutant).items() if value} for mutant in mutants]
    STORED.write_text(json.dumps({"seed": seed, "mutants": listed}, indent=1) + "\n")


def draw(seed: int, shares: Mapping[str, int], kept: Sequence[Mutant] = ()) -> list[Mutant]:
    """Draw mutants, at most one of a line, and keep those that there are.

    An operator is drawn first, so that rare ones are in the sample, then a line that it applies to.

    Args:
        seed: decides what is drawn.
        shares: mutants of each wing, those that are kept among them.
        kept: mutants that stay.
    """
    generator = random.Random(seed)
    mutants = list(kept)
    taken = {(mutant.path, mutant.before) for mutant in mutants}
    for wing, found in _by_wing().items():
        while sum(mutant.wing == wing for mutant in mutants) < shares.get(wing, 0):
            operator = generator.choice(sorted({change.operator for _, change in found}))
            path, change = generator.choice([one for one in found if one[1].operator == operator])
            source = (CHECKOUT / path).read_text()
            if (path, change.before) not in taken and parses(replaced(source, change)):
                taken.add((path, change.before))
                mutants.append(Mutant(path, change.before, change.after, change.function))
    return sorted(mutants, key=lambda mutant: (mutant.wing, mutant.path))


def shares_of_wings(number: int) -> dict[str, int]:
    """Return how many mutants of all are to be of each wing, by its lines that an operator applies to."""
    lines = {wing: len({(path, change.line) for path, change in found}) for wing, found in _by_wing().items()}
    whole = sum(lines.values())
    shares = {wing: min(size, max(LEAST, number * size // whole)) for wing, size in lines.items()}
    for wing in sorted(lines, key=lambda wing: shares[wing] - number * lines[wing] / whole):
        if sum(shares.values()) >= number:
            break
        shares[wing] += 1
    return shares


def lost(mutants: Iterable[Mutant]) -> list[Mutant]:
    """Return the mutants whose line is no longer there."""
    return [mutant for mutant in mutants if mutant.change() is None]


def lines_gone(mutants: Sequence[Mutant]) -> list[Mutant]:
    """Return the mutants whose line is nowhere in its module; faster than `lost`, which looks in its function."""
    lines = {path: _lines(CHECKOUT / path) for path in {mutant.path for mutant in mutants}}
    return [mutant for mutant in mutants if mutant.before not in lines[mutant.path]]


def default_tests(path: Path) -> set[str]:
    """Return the functions of a test file that the default run has."""
    tree = ast.parse(path.read_text())
    whole = [
        node for node in tree.body if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "pytestmark"
    ]
    marks = " ".join(ast.unparse(node.value) for node in whole)
    return {
        node.name
        for node in tree.body
        if isinstance(node, ast.FunctionDef)
        and node.name.startswith("test_")
        and not _is_left_out(f"{marks} {' '.join(map(ast.unparse, node.decorator_list))}")
    }


def _is_left_out(marks: str) -> bool:
    """Whether markers, but for those of single cases, keep a test out of the default run."""
    return any(f"pytest.mark.{name}" in re.sub(r"marks=pytest\.mark\.\w+", "", marks) for name in ("slow", "slurm"))


def _lines(path: Path) -> set[str]:
    return {line.strip() for line in path.read_text().splitlines()} if path.is_file() else set()


@cache
def _changes(path: Path) -> list[Change]:
    return changes(path.read_text()) if path.is_file() else []


def _modules() -> list[str]:
    """Paths of all modules of the packages, in order; none of those that are left out."""
    found = [path.relative_to(CHECKOUT).as_posix() for name in PACKAGES for path in (CHECKOUT / name).rglob("*.py")]
    kept = [path for path in found if not any(path.startswith(excluded) for excluded in EXCLUDED)]
    return sorted(kept, key=lambda path: (_folder(path), path))


def _folder(path: str) -> str:
    return path.rpartition("/")[0]


def _by_wing() -> dict[str, list[tuple[str, Change]]]:
    """All changes of the modules of each wing, each with its path."""
    return {
        wing: [(path, change) for path in paths for change in _changes(CHECKOUT / path)]
        for wing, paths in groupby(_modules(), key=_folder)
    }
