"""docs/results/streams.md: made from the raw results beside it."""

from __future__ import annotations

import pytest
from helpers.paths import CHECKOUT

import curricula
from ctgraph_rl.tasks.gain import reached_by_policies

PAGE = CHECKOUT / "docs" / "results" / "streams.md"


@pytest.fixture(scope="module")
def streams():
    from studies import streams

    return streams


def test_the_page_is_what_its_raw_results_make(streams):
    assert streams.page() == PAGE.read_text(encoding="utf-8")


def test_the_runs_are_of_the_named_stream_with_shorter_blocks_and_share_their_lives(streams):
    lines = streams.read(streams.NAME)
    life = curricula.load("stream", num_frames=12_288)

    assert {line["fingerprint"] for line in lines} <= {life.fingerprint, _with_ids(life).fingerprint}
    assert {line["num_tasks"] for line in lines} == {"100"}
    for learner in streams.groups(lines, "agent", "method", "k").values():
        assert [line["seed"] for line in learner] == ["0", "1", "2", "3", "4"]


def _with_ids(life):
    from dataclasses import replace

    return replace(life, protocol=replace(life.protocol, task_id="at_boundaries"))


def test_regret_and_solved_tasks_are_those_of_one_life(streams):
    for line in streams.read(streams.NAME):
        solved = streams.solved(line)
        assert float(line["window_solved"]) == pytest.approx(solved[-1], abs=1e-3)
        assert 0 <= sum(solved) <= (1 - float(line["never_adapted"])) * 10 + 1e-3
        assert 0 <= float(line["frame_regret"]) / streams.frames(line) <= 1 / 6 + 1e-3


def test_settings_are_those_that_a_part_of_the_life_chooses(streams):
    for (agent, method), of_learner in streams.runs().items():
        tuned = "finetune" if method == "frozen" else method
        assert {line["learning_rate"] for line in of_learner} == {streams.chosen(agent, tuned, "first_tenth")}
    whole = streams.chosen("ppo", "finetune", "whole_life")
    assert {line["learning_rate"] for line in streams.read(streams.NAME) if line["k"] == "100"} == {whole}
    assert streams.chosen("ppo", "ewc", "whole_life") == streams.chosen("ppo", "ewc", "first_tenth")
    trials = streams.groups(streams.read(streams.TRIALS), "agent", "method", "learning_rate")
    assert {tuple(line["seed"] for line in lines) for lines in trials.values()} == {("100", "101", "102")}
    assert len(trials) == 36


def test_what_the_page_says_in_bold_is_what_was_found(streams):
    solved = {name: float(count) for name, count in streams.counts().items()}
    effects = streams.claims()
    whole = effects[streams.EWC_OF_ALL, "ppo"].estimate.value

    for agent in ("ppo", "dqn"):
        assert solved[f"{agent}_finetune_last"] <= solved[f"{agent}_finetune_first"] - 4
    for agent in streams.AGENTS:
        assert solved[f"{agent}_scratch"] >= 90
        assert solved[f"{agent}_ewc"] < solved[f"{agent}_finetune"]
    assert streams.chosen("ppo", "finetune", "first_tenth") != streams.chosen("ppo", "finetune", "whole_life")
    assert whole < effects["EWC: more than fine-tuned", "ppo"].estimate.value < 0
    assert solved["dqn_finetune"] > 4 * solved["dqn_frozen"]
    assert abs(effects["frozen: more than fine-tuned", "ppo"].estimate.value) < streams.LESS
    assert {effect.verdict for effect in effects.values()} == {"cannot be said"}
    assert {len(effect.values) for effect in effects.values()} == {5}
    needed = [effect.seeds for effect in effects.values()]
    assert (min(needed), max(needed)) == (39, 69)


def test_regret_per_frame_of_policies_without_learning_is_in_the_text(streams):
    reached = reached_by_policies(curricula.load("stream").tasks[0], 12_288)
    lost = {name: each.in_frames / 12_288 for name, each in reached.items()}

    assert (
        f"A search in each block loses {lost['search']:.4f}, the random policy {lost['random']:.3f}" in streams.page()
    )
    assert lost["optimal"] == pytest.approx(0.0) == lost["memoryless"]
