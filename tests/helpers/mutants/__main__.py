"""The command: each mutant in a copy of the checkout, its tests, and a table of what was killed and what survived."""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from helpers.mutants import sample, trial
from helpers.mutants.sample import CHECKOUT, Mutant

NUMBER = 100
NEAREST = 3
"""Test files that are tried first; the others that name the module follow, and then the default run."""

KILLED, SURVIVED, EQUIVALENT, LOST = "killed", "survived", "equivalent", "lost"


def main() -> None:
    """Print what becomes of each mutant, and exit with 1 if more than 5 % survive."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.helpers.mutants", description=sys.modules[__package__].__doc__
    )
    parser.add_argument(
        "--draw", type=int, metavar="SEED", help="first draw anew, in place of mutants whose line is gone"
    )
    parser.add_argument("--only", default="", metavar="TEXT", help="only mutants of paths with this text")
    parser.add_argument("--alive", action="store_true", help="only mutants that no test is known to kill")
    parser.add_argument("--near", action="store_true", help="leave out the default run for what is still alive")
    given = parser.parse_args()
    seed, mutants = sample.stored()
    if given.draw is not None:
        seed, mutants = given.draw, drawn(given.draw, mutants)
        sample.store(seed, mutants)
    trial.import_third_party()
    with tempfile.TemporaryDirectory() as folder:
        copy = trial.copy_checkout(Path(folder))
        broken = trial.first_failure(copy, sorted({mutant.killer for mutant in mutants if mutant.killer}))
        if broken != "":
            sys.exit(f"{broken or 'the killers'} cannot run or fails without any mutant: mend that first")
        for number, mutant in enumerate(mutants):
            if given.only in mutant.path and not (given.alive and mutant.killer):
                mutants[number] = replace(mutant, killer=killer_of(copy, mutant, given.near))
                say(number, mutants[number])
                sample.store(seed, mutants)
    print(table(mutants))
    sys.exit(share(mutants) < 0.95)


def drawn(seed: int, mutants: Sequence[Mutant]) -> list[Mutant]:
    """Draw others of the same wings for mutants whose line is gone, or a whole sample where there is none."""
    shares = Counter(mutant.wing for mutant in mutants) or sample.shares_of_wings(NUMBER)
    gone = sample.lost(mutants)
    return sample.draw(seed, shares, [mutant for mutant in mutants if mutant not in gone])


def killer_of(copy: Path, mutant: Mutant, near: bool) -> str:
    """Return a test that fails with a mutant in the copy, the one that is known if it does; "" if none does."""
    if fate(mutant) in (LOST, EQUIVALENT):
        return mutant.killer
    with trial.mutated(copy, mutant):
        for tests, workers in trials(mutant, near):
            failed = trial.first_failure(copy, tests, workers)
            if failed is None:
                return mutant.killer or f"{tests[0]}::{min(sample.default_tests(CHECKOUT / tests[0]))}"
            if failed:
                return failed.partition("[")[0]
    return ""


def trials(mutant: Mutant, near: bool) -> Iterator[tuple[list[str], str]]:
    """Yield tests to run, the likely ones first, and the workers that run them."""
    if mutant.killer:
        yield [mutant.killer], "0"
    files = files_that_name(mutant.path, sorted((CHECKOUT / "tests").rglob("test_*.py")))
    named = [path.relative_to(CHECKOUT).as_posix() for path in files]
    yield from ((chunk, "0") for chunk in (named[:NEAREST], named[NEAREST:]) if chunk)
    if not near:
        yield ["tests"], "auto"


def files_that_name(module: str, files: Iterable[Path]) -> list[Path]:
    """Return test files that name a module: those named as it or as its folder first, small ones before large ones."""
    name, folder = Path(module).stem, Path(module).parent.name
    found = [path for path in files if name in path.read_text()]
    return sorted(found, key=lambda path: (name not in path.stem, folder not in path.parts, path.stat().st_size))


def fate(mutant: Mutant) -> str:
    """Return what became of a mutant, as it is stored."""
    if mutant.change() is None:
        return LOST
    return EQUIVALENT if mutant.equivalent else KILLED if mutant.killer else SURVIVED


def share(mutants: Sequence[Mutant]) -> float:
    """Return the share of killed ones among those that a test could kill."""
    fates = [fate(mutant) for mutant in mutants]
    return fates.count(KILLED) / max(len(fates) - fates.count(EQUIVALENT), 1)


def say(number: int, mutant: Mutant) -> None:
    """Print a mutant and its end."""
    print(f"{number} {fate(mutant)}: {mutant.path} {mutant.function}\n    {mutant.before}\n    {mutant.after}")
    print(f"    {mutant.killer or mutant.equivalent}", flush=True)


def table(mutants: Sequence[Mutant]) -> str:
    """Return a table of the wings."""
    lines = ["wing                      drawn killed equivalent survived"]
    for wing in sorted({mutant.wing for mutant in mutants}):
        fates = [fate(mutant) for mutant in mutants if mutant.wing == wing]
        alive = fates.count(SURVIVED) + fates.count(LOST)
        lines.append(f"{wing:25} {len(fates):5} {fates.count(KILLED):6} {fates.count(EQUIVALENT):10} {alive:8}")
    return "\n".join([*lines, f"killed of those that are not equivalent: {share(mutants):.1%}"])


if __name__ == "__main__":
    main()
