"""docs/results/adaptation.md: made from the raw results beside it, and what it says of them holds."""

from __future__ import annotations

from itertools import product
from statistics import fmean

import pytest
from studies import adaptation, adaptation_swap
from studies.raw import read

import curricula


def curves(agent: str, gate: str = "none") -> list[list[float]]:
    """The success of each seed in each episode of a row."""
    of_seeds = adaptation.runs(2)[agent, gate].values()
    return [[float(line["success"]) for line in lines] for lines in of_seeds]


def test_the_page_is_made_from_the_raw_results():
    assert adaptation.page() == adaptation.PAGE.read_text(encoding="utf-8")


def test_agents_with_an_inner_loop_do_not_search_and_the_others_do():
    for curve in (*curves("cavia"), *curves("maml")):
        assert abs(fmean(curve[:20]) - 0.25) < 0.05
        assert fmean(curve[20:]) < 0.8
    for curve in (*curves("pearl"), *curves("rl2")):
        assert fmean(curve[4:20]) > 0.5


def test_only_rl2_exceeds_the_best_policy_without_memory_on_a_surjective_graph():
    of_agents = adaptation.runs(2, adaptation.SURJECTIVE)
    most = adaptation.WITHOUT_MEMORY
    exceeds = {
        agent: [adaptation.adapted(lines) > most for lines in of.values()] for (agent, _), of in of_agents.items()
    }

    assert exceeds == {agent: [agent == "rl2"] * 5 for agent in ("rl2", "cavia", "maml", "pearl")}


def test_the_best_policy_without_memory_has_the_mean_of_the_ceilings_of_the_goals():
    (block,) = curricula.load("nm_uniform_goals", kind="surjective").blocks

    assert fmean(task.memoryless_ceiling() for task in block.tasks) == pytest.approx(adaptation.WITHOUT_MEMORY)


def test_rl2_loses_success_in_late_episodes_of_three_seeds():
    lost = [fmean(curve[16:20]) - fmean(curve[-4:]) for curve in curves("rl2")]

    assert [loss > 0.1 for loss in lost].count(True) == 3


def test_one_soft_gate_almost_never_finds_the_goal():
    assert [fmean(curve) < 0.01 for curve in curves("cavia", "soft")].count(True) == 1


def test_pearl_ends_lower_with_a_gate_that_learns_in_each_of_three_seeds():
    found = adaptation.runs(2)
    without = found["pearl", "none"]
    gated = found["pearl", "hard_straight_through"]

    assert len(gated) == 3
    assert all(adaptation.adapted(lines) < adaptation.adapted(without[seed]) for seed, lines in gated.items())


def test_the_best_search_for_a_swapped_goal_is_what_playing_it_gives():
    """Goals 0 to 3 in turn; after a miss of a known goal, the others in turn."""
    misses = []
    for first, second in product(range(4), repeat=2):
        others = [goal for goal in range(4) if goal != first]
        misses.append(first + (0 if first == second else 1 + others.index(second)))

    assert adaptation_swap.best_search(4, swapped=True) == pytest.approx(1 - fmean(misses) / 100)
    assert adaptation_swap.best_search(4, swapped=False) == pytest.approx(0.985)


@pytest.mark.parametrize("swapped", [False, True])
def test_penn_a_is_within_a_point_of_the_best_search(swapped):
    (share,) = adaptation_swap.shares("penn_a", held_out=swapped)

    assert abs(adaptation_swap.best_search(4, swapped) - share) < 0.01


def test_rl2_always_goes_to_one_goal():
    lines = [line for line in read("adaptation_swap") if (line["agent"], line["held_out"]) == ("rl2", "False")]

    assert [line["success"] for line in lines if line["label"] == "goal1.1"] == ["1.0"] * 3
    assert [line["success"] for line in lines if line["label"] != "goal1.1"] == ["0.0"] * 9
