"""docs/results/profile.md: made from the raw results beside it, and what it says of them holds and would change."""

from __future__ import annotations

import pytest
from helpers.paths import CHECKOUT
from studies import profile
from studies.raw import read

from curricula.profile import PROPERTIES

PAGE = CHECKOUT / "docs" / "results" / "profile.md"

TITLES = [prop.title for prop in PROPERTIES.values()]


def changed(agent, title, change):
    """The lines of seeds and gaps with other values for an agent's property."""
    lines = []
    for line in profile.raw():
        is_it = (line["agent"], line["property"]) == (agent, title)
        lines.append({**line, **change(line)} if is_it else line)
    return lines


def test_the_page_is_made_from_the_raw_results():
    assert profile.page() == PAGE.read_text(encoding="utf-8")


def test_every_agent_has_each_property_or_a_reason():
    for by_title in profile.scores().values():
        assert list(by_title) == TITLES
        for score in by_title.values():
            assert score.value is not None or score.reason


@pytest.mark.parametrize("title", ["attention", "memory"])
def test_the_verdict_follows_the_scores(title):
    """With values at the optimum an agent is above the floor, and at the floor it is not."""
    best = profile.scores(changed("ppo", title, lambda line: {"value": line["optimum"]}))
    none = profile.scores(changed("ppo", title, lambda line: {"value": line["floors"]}))

    assert title in profile.above_floor(best, certain=False)["ppo"]
    assert (title in profile.above_floor(best, certain=True)["ppo"]) == (title == "attention")
    assert title not in profile.above_floor(none, certain=False)["ppo"]
    assert profile.verdicts(best) != profile.verdicts(none)


def test_what_the_page_says_of_each_agent_is_in_the_raw_results():
    found = profile.scores()

    for agent, titles in profile.above_floor(found, certain=True).items():
        for title in TITLES:
            assert (title in titles) == bool(found[agent][title].low)


def test_what_is_read_aloud_is_the_score_of_lstm_ppo():
    score = profile.scores()["lstm_ppo"]["memory"]

    assert (str(score), score.n) == ("0.28 [0.00, 0.66]", 5)
    assert 'Read aloud, `0.28 [0.00, 0.66]` for memory: "Over five seeds, LSTM-PPO comes 28 % of the way' in (
        PAGE.read_text(encoding="utf-8")
    )


def test_the_first_sentence_is_what_the_intervals_say():
    certain = profile.above_floor(profile.scores(), certain=True)

    assert certain == {"ppo": ["attention"], "lstm_ppo": ["attention"], "dqn": [], "rl2": []}
    assert "PPO and LSTM-PPO are above the floor in attention." in PAGE.read_text(encoding="utf-8")


def test_an_agent_without_a_model_has_a_gap_and_no_score():
    reasons = {line["reason"] for line in profile.raw() if line["property"] == "model"}

    assert reasons == {"has no model: its agent has no predict_next"}
    assert all(by_title["model"].value is None for by_title in profile.scores().values())


@pytest.mark.parametrize(("frames", "said"), [(16_384, "at least four times"), (32_768, "less than four times")])
def test_the_page_says_whether_lives_have_four_times_what_a_fresh_ppo_needs(monkeypatch, frames, said):
    monkeypatch.setattr(profile, "fresh_frames", lambda agent: [float(frames)] * 5)

    assert said in profile.four_times()


def test_lives_have_four_times_the_frames_that_a_fresh_ppo_needs_in_the_median():
    assert "at least four times as many" in profile.four_times()


def test_no_line_names_a_place_of_the_machine():
    assert not [line for line in read(profile.NAME) if line["reason"].startswith("/")]
