"""docs/results/adaptation.md: made from the raw results beside it, and what it says of them holds."""

from __future__ import annotations

from statistics import fmean

from studies import adaptation


def curves(agent: str, gate: str = "none") -> list[list[float]]:
    """The success of each seed in each episode of a row."""
    of_seeds = adaptation.runs(2)[agent, gate].values()
    return [[float(line["success"]) for line in lines] for lines in of_seeds]


def test_the_page_is_made_from_the_raw_results():
    assert adaptation.page() == adaptation.PAGE.read_text(encoding="utf-8")


def test_agents_with_an_inner_loop_do_not_search_and_the_others_do():
    for curve in (*curves("cavia"), *curves("cavia", "hard"), *curves("maml")):
        assert abs(fmean(curve[:20]) - 0.25) < 0.05
        assert fmean(curve[20:]) < 0.8
    for curve in (*curves("pearl"), *curves("rl2")):
        assert fmean(curve[4:20]) > 0.5


def test_rl2_loses_success_in_late_episodes_of_three_seeds():
    lost = [fmean(curve[16:20]) - fmean(curve[-4:]) for curve in curves("rl2")]

    assert [loss > 0.1 for loss in lost].count(True) == 3
