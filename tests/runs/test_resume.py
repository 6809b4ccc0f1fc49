"""Runs that go on from any checkpoint end as if they had never been stopped, bit by bit."""

from __future__ import annotations

import random
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from helpers.kill_runs import equal
from helpers.scripted import MIDDLE, ONE, THREE, TWO, of
from helpers.small_agents import AGENTS as NAMES
from helpers.small_agents import MINIBATCHES, REPLAY, TINY, TWO_GOALS, less, others_slow

from ctgraph_rl import Block, Curriculum, Evaluation, RunLog, learn_curriculum
from ctgraph_rl.learn.lifelong import OfferCheckpoint
from ctgraph_rl.runs.checkpoints import decoded, encoded
from ctgraph_rl.runs.config import target
from ctgraph_rl.runs.train import new_agent
from ctgraph_rl.tasks.kinds.gym_task import GymTask
from ctgraph_rl.tasks.switch import AtRandom, ByEpisode, Drift

AGENTS: dict[str, tuple[str, list[str]]] = {name: (name, less(name)) for name in NAMES} | {
    "a2c": ("a2c", ["agent.optimiser=rmsprop"]),
    "ppo_count": ("ppo_count", [*MINIBATCHES, "agent.num_hash_bits=6"]),
    "penn_a": (
        "penn_a",
        [
            *("agent.num_trials=2", "agent.segment_size=2", "agent.num_batches=2", "agent.num_updates=2"),
            "agent.insert_prob=0.5",
        ],
    ),
    "prioritized dqn": ("dqn", [*REPLAY, "agent.priority_alpha=0.6", "agent.replay_on_task_change=keep"]),
    "qrdqn_lstm": ("qrdqn_lstm", [*REPLAY, "agent.num_quantiles=4"]),
    "rl2": ("rl2", [*MINIBATCHES, "agent.trial_episodes=4"]),
}
"""All agents; some with settings that leave more to be saved."""


def uneven(**how: Any) -> Curriculum:
    """Blocks of no whole number of batches, which are of 32 frames; with hidden boundaries, batches go over them."""
    return of(Block(ONE, 80), Block(THREE, 120), Block(ONE, 56), **how)


def switching(switch: Any) -> Curriculum:
    return of(Block((ONE, TWO, THREE), 96, switch), Block(TWO, 40), boundaries="hidden")


CURRICULA = {
    "announced": uneven(),
    "hidden": uneven(boundaries="hidden"),
    "ids with observations": uneven(task_id="one_hot", num_task_ids=3),
    "ids at boundaries": uneven(task_id="at_boundaries"),
    "hidden with ids": uneven(task_id="one_hot", boundaries="hidden"),
    "rows apart": of(Block((ONE, THREE), 80), Block(TWO, 80)),
    "by episode": switching(ByEpisode(2)),
    "by episode, together": switching(ByEpisode(2, together=True)),
    "at random": switching(AtRandom(0.5)),
    "at random, together": switching(AtRandom(0.5, together=True)),
    "drift": switching(Drift(8)),
    "drift, together": switching(Drift(8, together=True)),
    "evaluated at the end only": uneven(evaluation=Evaluation(4, before=False)),
    "changing goals": of(
        Block(TWO_GOALS, 160), Block(replace(TWO_GOALS, goal=(2,)), 64), evaluation=replace(MIDDLE, episodes_per_row=4)
    ),
}

CURRICULA["hidden episodes"] = uneven(episodes="hidden")

LAKES = [GymTask("FrozenLake-v1", {"is_slippery": slips}, max_episode_steps=20) for slips in (True, False)]
CURRICULA |= {
    "gymnasium, hidden episodes": of(Block(LAKES[0], 80), Block(LAKES[1], 56), episodes="hidden"),
    "gymnasium": of(Block(LAKES[0], 80), Block(LAKES[1], 56)),
    "gymnasium, hidden with ids": of(
        Block((LAKES[0],), 80), Block((LAKES[1], LAKES[0]), 56), task_id="one_hot", boundaries="hidden"
    ),
}


class Ended(NamedTuple):
    """What a run leaves."""

    agent: Mapping[str, Any]
    log: list[dict[str, Any]]
    random: torch.Tensor


class Learner(NamedTuple):
    """Learns a curriculum with a new agent, into a new log."""

    curriculum: Curriculum
    make_agent: Any
    folder: Path

    def learn(
        self, log: RunLog, saved: Mapping[str, Any] | None = None, checkpoint: OfferCheckpoint | None = None
    ) -> Ended:
        agent = new_agent(self.curriculum, self.make_agent, 0)
        torch.manual_seed(0 if saved is None else 1234)
        learn_curriculum(self.curriculum, agent, 7, log, saved=saved, checkpoint=checkpoint)
        log.close()
        lines = [{key: value for key, value in line.items() if key != "seconds"} for line in log.measurements]
        return Ended(agent.state_dict(), lines, torch.get_rng_state())

    def whole(self) -> tuple[Ended, list[Path]]:
        """A run that is never stopped, and its states after every update."""
        states: list[Path] = []

        def keep(state: Any, at_block_end: bool) -> None:
            states.append(self.folder / f"{len(states)}.pt")
            states[-1].write_bytes(encoded(state()))

        return self.learn(RunLog(self.folder / "whole.jsonl"), checkpoint=keep), states

    def resumed(self, state: Path) -> Ended:
        """The run that goes on from a state, and from the log as it was later."""
        saved, path = decoded(state), self.folder / f"{state.stem}.jsonl"
        path.write_bytes((self.folder / "whole.jsonl").read_bytes())
        return self.learn(RunLog.resume(path, saved["log"]), saved)


@pytest.fixture
def learner(compose, tmp_path):
    """Makes a `Learner` of a curriculum and an agent's name in `AGENTS`."""

    def make(curriculum: Curriculum, name: str) -> Learner:
        agent, overrides = AGENTS[name]
        return Learner(curriculum, target(compose(f"agent={agent}", *TINY, *overrides), "agent"), tmp_path)

    return make


def has_reward(state: Path) -> bool:
    """Whether a last reward that is not 0 is saved. RL^2 reads it."""
    carried = decoded(state)["carried"]
    return "reward" in carried and bool(carried["reward"].any())


def check_some(learner: Learner, count: int | None = None) -> None:
    """The first, the last and ``count`` other states, or all, lead to the same end; and one with a last reward."""
    whole, states = learner.whole()
    others = random.Random(str(learner.curriculum)).sample(states, len(states) if count is None else count)
    rewarded = [state for state in states if has_reward(state)]
    chosen = {states[0], states[-1], *others, *rewarded[:1]}

    for state in chosen:
        resumed = learner.resumed(state)
        assert equal(resumed.agent, whole.agent), state
        assert resumed.log == whole.log, state
        assert torch.equal(resumed.random, whole.random), state


@pytest.mark.parametrize(
    ("name", "kind"), [("lstm_ppo", "announced"), ("prioritized dqn", "announced"), ("rl2", "changing goals")]
)
def test_an_agent_of_each_family_goes_on_as_if_never_stopped(learner, name, kind):
    check_some(learner(CURRICULA[kind], name), 0)


@pytest.mark.parametrize(
    "kind", ["hidden", "by episode, together", "at random", "changing goals", "gymnasium, hidden with ids"]
)
def test_a_curriculum_of_each_family_goes_on_as_if_never_stopped(learner, kind):
    check_some(learner(CURRICULA[kind], "a2c"), 0)


@pytest.mark.parametrize("kind", others_slow(["hidden", "drift"], "drift"))
def test_memory_and_replay_go_on_over_hidden_boundaries(learner, kind):
    check_some(learner(CURRICULA[kind], "qrdqn_lstm"), 1)


def test_memory_is_kept_over_the_boundary_at_which_a_run_with_hidden_episodes_was_stopped(learner):
    its = learner(CURRICULA["hidden episodes"], "lstm_ppo")
    whole, states = its.whole()

    resumed = its.resumed(states[2])

    assert equal(resumed.agent, whole.agent) and resumed.log == whole.log


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "kind"),
    [
        (name, kind)
        for place, name in enumerate(AGENTS)
        for number, kind in enumerate(CURRICULA)
        if name == "a2c" or kind == "announced" or (place + number) % 18 == 0
        if not (name == "rl2" and kind.startswith("gymnasium"))  # it needs CT-graphs
        if not (name in ("rl2", "penn_a", "mohqa") and kind.endswith("hidden episodes"))
    ],
)
def test_one_agent_in_every_kind_of_curriculum_and_every_agent_in_some_go_on_as_if_never_stopped(learner, name, kind):
    """From every state for one agent in two kinds; else from three."""
    check_some(learner(CURRICULA[kind], name), None if name == "a2c" and kind in ("announced", "hidden") else 1)


def test_a_state_may_be_used_again_for_resuming_does_not_change_it(learner):
    its = learner(CURRICULA["hidden"], "prioritized dqn")
    whole, states = its.whole()
    before = states[4].read_bytes()

    first, again = its.resumed(states[4]), its.resumed(states[4])

    assert equal(first.agent, again.agent) and equal(first.agent, whole.agent)
    assert states[4].read_bytes() == before


def test_states_are_offered_after_every_update_and_say_where_blocks_end(learner):
    told = []

    learner(CURRICULA["announced"], "a2c").learn(
        RunLog(), checkpoint=lambda state, at_block_end: told.append((state()["frames"], at_block_end))
    )

    assert told == [
        *[(32, False), (64, False), (80, True)],
        *[(112, False), (144, False), (176, False), (200, True)],
        *[(232, False), (256, True)],
    ]


def test_another_state_gives_another_end(learner):
    its = learner(CURRICULA["announced"], "a2c")
    whole, states = its.whole()
    saved = decoded(states[3])
    saved["random"] = torch.Generator().manual_seed(99).get_state()

    other = its.learn(RunLog(), saved)

    assert not equal(other.agent, whole.agent)


def test_a_state_of_another_agent_is_refused(learner):
    _, states = learner(CURRICULA["announced"], "a2c").whole()
    other = learner(CURRICULA["announced"], "dqn")

    with pytest.raises(
        ValueError, match=r"the saved state does not fit this agent and curriculum, start again \(overw"
    ):
        other.learn(RunLog(), decoded(states[0]))
