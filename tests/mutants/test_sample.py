"""The list of killers: each mutant of the sample has one in the default run, and stands where it was drawn."""

from __future__ import annotations

from helpers.mutants import sample
from helpers.mutants.sample import CHECKOUT, default_tests

ANEW = "draw others for them: python -m tests.helpers.mutants --alive --draw 1"


def test_at_least_95_of_100_mutants_have_a_killer():
    _, mutants = sample.stored()
    alike = [mutant for mutant in mutants if not mutant.equivalent]

    assert len(mutants) >= 100
    assert sum(bool(mutant.killer) for mutant in alike) >= 0.95 * len(alike)
    assert len({(mutant.path, mutant.before) for mutant in mutants}) == len(mutants)


def test_every_killer_is_in_the_default_run():
    killers = {mutant.killer for mutant in sample.stored()[1] if mutant.killer}
    tests = {path: default_tests(CHECKOUT / path) for path in {killer.partition("::")[0] for killer in killers}}

    missing = [killer for killer in killers if killer.partition("::")[2] not in tests[killer.partition("::")[0]]]

    assert sorted(missing) == [], "find others: python -m tests.helpers.mutants"


def test_at_most_five_mutants_have_lost_their_line():
    gone = sample.lines_gone(sample.stored()[1])

    assert len(gone) <= 5, f"{ANEW}: {[(mutant.path, mutant.before) for mutant in gone]}"
