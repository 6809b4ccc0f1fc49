"""Methods that a detector gives labels: the oracle is the announced run, and what a suspicion does, state by state."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

import pytest
import torch
from helpers.kill_runs import equal
from helpers.scripted import ONE, TWO, of
from helpers.small_agents import MINIBATCHES, REPLAY, TINY, batches, made, saved_and_loaded, weights_for
from helpers.sweeping import command_line

from baselines.detectors.detector import Detector, SelfLabelledAgent
from baselines.detectors.seen import SUSPICION, Seen, Verdict
from baselines.parts.networks import trunk_of
from baselines.ppo import PPO
from ctgraph_rl import Block, Curriculum, Evaluation, RunLog, learn_curriculum
from ctgraph_rl.core.rewards import Needle
from ctgraph_rl.runs.load import load
from ctgraph_rl.runs.read import read_run
from ctgraph_rl.runs.train import new_agent
from ctgraph_rl.tasks.images import OneHot, PaperImages

EVALUATION = Evaluation(1, greedy=False, every=32)

BLOCKS = (Block(ONE, 80), Block(TWO, 64), Block(ONE, 48))
"""Batches of 32 frames, and at the end of announced blocks of less; the first task comes again."""

SETTINGS = {
    "clear": ["method.buffer_size=48"],
    "ewc": ["method.num_samples=8"],
    "mas": ["method.num_samples=8"],
    "mask_amsc": ["method.num_samples=8"],
    "mask_sc": ["method.num_samples=8", "method.every=1", "method.threshold=-1"],
}

OTHERS = ("cka_rl", "clear", "l2", "mas", "mask_amsc", "mask_ri", "mask_sc", "scratch", "si")

AGENTS = {"dqn": REPLAY, "lstm_ppo": MINIBATCHES, "ppo": MINIBATCHES, "rl2": [*MINIBATCHES, "agent.trial_episodes=2"]}


@dataclass
class Script(Detector):
    """Says what it was told to say of the batch with a number, from 1."""

    verdicts: dict[int, Verdict]
    needs: tuple[str, ...] = ()  # type: ignore[misc]
    max_labels: int | None = 3
    patience: int = 64
    snapshot_every: int | None = 32

    def __post_init__(self) -> None:
        self.number, self.started, self.seen = 0, list[tuple[int, bool]](), list[Seen]()

    def observe(self, seen: Seen) -> Verdict:
        self.number += 1
        self.seen.append(seen)
        return self.verdicts.get(self.number)

    def start_label(self, label: int, trial: bool) -> None:
        self.started.append((label, trial))

    def state_dict(self) -> dict[str, Any]:
        return {"number": self.number}

    def load_state_dict(self, state: Any) -> None:
        self.number = state["number"]


def maker(compose, method: str, make_detector: Any = None, agent: str = "ppo") -> Any:
    """What builds the agent with its method for a curriculum, and what that makes of the curriculum."""
    make_alone = made(compose, "agent", agent, *TINY, *AGENTS[agent])
    make_method = made(compose, "method", method, *SETTINGS.get(method, []))

    def make(curriculum: Curriculum) -> Any:
        whole = make_method() if make_detector is None else make_detector().labelling(make_method())
        prepared = whole.prepare(curriculum)
        return new_agent(prepared, lambda *specs: whole.attach(make_alone(*specs), prepared), 0)

    return make


def learned(make: Any, curriculum: Curriculum, saved: Any = None, *keep: int) -> tuple[Any, RunLog, list[Any]]:
    """The agent that learned a curriculum, its log, and the states after some batches."""
    agent, log, number, states = make(curriculum), RunLog(), count(1), list[Any]()

    def checkpoint(state: Any, at_end: bool) -> None:
        if next(number) in keep:
            states.append(saved_and_loaded(state()))

    torch.manual_seed(1 if saved is None else 1234)
    learn_curriculum(curriculum, agent, 7, log, saved=saved, checkpoint=checkpoint)
    return agent, log, states


def lines(log: RunLog, *without: str) -> list[dict[str, Any]]:
    return [{key: value for key, value in m.items() if key not in ("seconds", *without)} for m in log.measurements]


OWN = ("acted_label", "learned", "alarm", "rolled_back")
"""Measurements that an agent with labels adds."""


SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    ("method", "agent"),
    [
        ("ewc", "ppo"),
        *(pytest.param(method, "ppo", marks=SLOW) for method in ("mask_lc", *OTHERS)),
        *(pytest.param("mas", agent, marks=SLOW) for agent in ("dqn", "lstm_ppo")),
    ],
)
def test_the_oracle_at_announced_boundaries_is_the_run_that_is_given_ids_there(compose, method, agent):
    given = of(*BLOCKS, evaluation=EVALUATION, task_id="at_boundaries")

    told, log, _ = learned(maker(compose, method, agent=agent), given)
    own, own_log, _ = learned(
        maker(compose, method, made(compose, "detector", "oracle"), agent), of(*BLOCKS, evaluation=EVALUATION)
    )

    assert lines(own_log, *OWN, "oracle") == lines(log)
    assert equal(own.learner.state_dict(), told.state_dict())
    assert own_log.training("acted_label").unique().tolist() == [1, 2]


@pytest.fixture
def labelled(compose):
    """An agent with a scripted detector that has started, and batches for it."""

    def build(verdicts: dict[int, Verdict], method: str = "mask_ri", **how: Any) -> tuple[Any, list[Any]]:
        agent = maker(compose, method, lambda: Script(verdicts, **how))(of(*BLOCKS, boundaries="hidden"))
        agent.start_task(None)
        return agent, batches(agent, ONE, 12)

    return build


def own(measured: list[dict[str, float]]) -> list[tuple[float, ...]]:
    return [tuple(each[name] for name in OWN) for each in measured]


@pytest.mark.parametrize(("every", "kept"), [(32, 4), (33, 2), (64, 2), (96, 0)])
def test_a_suspicion_restores_the_older_snapshot_and_a_label_that_is_found_again_learns_on_from_it(
    labelled, every, kept
):
    agent, given = labelled({6: SUSPICION, 8: 0}, "scratch", snapshot_every=every)
    states = [deepcopy(agent.learner.state_dict())]

    measured = []
    for batch in given[:8]:
        measured.append(agent.learn(batch))
        states.append(deepcopy(agent.learner.state_dict()))

    assert own(measured[:5]) == [(1, 1, 0, 0)] * 5
    assert own(measured[5:]) == [(1, 0, 1, 32 * (5 - kept)), (1, 0, 0, 0), (1, 0, 0, 0)]
    assert not equal(states[5], states[kept])
    assert equal(states[8], states[kept])
    assert agent.detector.started == [(0, False), (0, True), (0, False)]
    assert own([agent.learn(given[8])]) == [(1, 1, 0, 0)]


def test_known_labels_are_tried_in_turn_then_a_new_one_is_opened_while_there_is_room(labelled):
    agent, given = labelled({1: 1, 2: SUSPICION, 7: SUSPICION})

    measured = own([agent.learn(batch) for batch in given])

    assert [each[0] for each in measured] == [1, 2, 1, 1, 2, 2, 3, 1, 1, 2, 2, 3]  # 64 frames each
    assert [each[1] for each in measured] == [1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]
    assert [each[2] for each in measured] == [1, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0]
    trials = [(label, True) for label in (0, 1)]
    assert agent.detector.started == [(0, False), (1, False), *trials, (2, False), *trials, (2, True)]
    agent.learn(given[0])
    assert (agent.label, agent.home, agent.num_labels) == (2, None, 3)  # no room: the earlier label resumes


def test_a_label_acts_with_its_own_weights_while_it_is_tried_and_learns_on_with_them(labelled):
    agent, given = labelled({2: 1, 4: SUSPICION, 5: 0}, "scratch", snapshot_every=None)
    for batch in given[:2]:
        agent.learn(batch)
    first = weights_for(agent, 0)
    agent.learn(given[2])
    assert not equal(weights_for(agent, 1), first)

    agent.learn(given[3])

    assert agent.label == 0
    assert equal([each.detach() for each in agent.policy.parameters()], first)
    agent.learn(given[4])
    assert (agent.home, agent.learn(given[5])["learned"]) == (None, 1)
    assert not equal([each.detach() for each in agent.policy.parameters()], first)


@pytest.mark.parametrize("method", ["mask_lc", *(pytest.param(name, marks=SLOW) for name in ("clear", "ewc"))])
@pytest.mark.parametrize("place", [4, *(pytest.param(place, marks=SLOW) for place in (2, 6))])
def test_a_run_with_labels_is_resumed_with_the_same_bits_also_while_labels_are_tried(compose, method, place):
    make = maker(compose, method, lambda: Script({3: SUSPICION}, ("features",)))
    curriculum = of(Block(ONE, 80), Block(TWO, 176), evaluation=EVALUATION, boundaries="hidden")

    whole, log, [saved] = learned(make, curriculum, None, place)
    resumed, rest, _ = learned(make, curriculum, saved)

    assert equal(resumed.state_dict(), whole.state_dict())
    assert lines(rest)[-1] | {"acted_label": 0} == lines(log)[-1] | {"acted_label": 0}
    assert log.training("acted_label").tolist()[:2] == [1, 1] and 2 in log.training("acted_label").tolist()


class Twin(Needle):
    """The same reward by another name: a task with it is another task that nobody can tell from the first."""


@pytest.mark.parametrize("method", ["mask_lc", pytest.param("ewc", marks=SLOW)])
def test_no_detector_but_the_oracle_learns_which_task_is_the_true_one(compose, method):
    assert replace(ONE, reward_fn=Twin()) != ONE
    alike = of(*BLOCKS, boundaries="hidden", evaluation=EVALUATION)
    others = of(Block(ONE, 80), Block(TWO, 64), Block(replace(ONE, reward_fn=Twin()), 48), boundaries="hidden")
    make = maker(compose, method, lambda: Script({2: 1, 4: SUSPICION}, ("features",)))
    oracle = maker(compose, method, made(compose, "detector", "oracle"))

    found, told = ([learned(each, curriculum) for curriculum in (alike, others)] for each in (make, oracle))

    assert equal(found[0][0].state_dict(), found[1][0].state_dict())
    assert found[0][1].training("acted_label").tolist() == found[1][1].training("acted_label").tolist()
    assert [log.training("acted_label").unique().tolist() for _, log, _ in told] == [[1, 2], [1, 2, 3]]


def test_a_detector_sees_what_the_learner_sees_and_features_by_the_weights_that_acted(labelled):
    agent, given = labelled({}, method="finetune", needs=("features",))
    features = trunk_of(agent.policy).over_time(given[0]).detach()

    agent.learn(given[0])

    [seen] = agent.detector.seen
    batch, after = given[0], given[0]["next"]
    assert torch.equal(seen.features, features) and seen.observation_id is None
    assert [each.shape for each in seen[:5]] == [torch.Size([8, 4])] * 5
    assert torch.equal(seen.action, batch["action"]) and torch.equal(seen.reward, after["reward"][..., 0])
    assert torch.equal(seen.episode_return, after["episode_reward"][..., 0])
    assert torch.equal(seen.is_init, batch["is_init"][..., 0]) and torch.equal(seen.done, after["done"][..., 0])


@pytest.mark.parametrize("agent", ["dqn", "lstm_ppo", "rl2"])
def test_features_and_observation_ids_are_there_for_other_agents(compose, agent):
    make = maker(compose, "finetune", lambda: Script({}, ("features", "observation_id")), agent)

    learner, _, _ = learned(make, of(Block(ONE, 64), boundaries="hidden"))

    seen = learner.detector.seen[0]
    going = ~seen.done[:, :-1]
    assert seen.features.shape == (8, 4, 4)
    assert torch.equal(seen.next_observation_id[:, :-1][going], seen.observation_id[:, 1:][going])


def test_each_task_is_evaluated_with_the_label_that_acted_in_most_of_its_frames(compose, monkeypatch):
    asked, played = list[int | None](), list[int]()
    for name, to in (("policy_for_label", asked), ("policy_for", played)):
        kept = getattr(SelfLabelledAgent, name)
        monkeypatch.setattr(
            SelfLabelledAgent, name, lambda self, label, to=to, kept=kept: to.append(label) or kept(self, label)
        )
    evaluation = Evaluation(2, every=112)
    curriculum = of(Block(ONE, 96), Block(TWO, 96), evaluation=evaluation, boundaries="hidden")

    learned(maker(compose, "mask_ri", lambda: Script({1: 1, 3: 0, 4: 2})), curriculum)

    before, first, within, last = [None, None], [1, None], [1, 0], [1, 2]  # within: the second task's first batch acts
    assert asked == [*before, *first, *within, *last]
    assert played == [0, 0, 1, 2, 1, 0, 1, 2]  # a task without a label has the next one that would be opened


def test_an_alarm_counts_once_where_a_batch_goes_over_a_boundary(compose):
    curriculum = of(*BLOCKS, evaluation=Evaluation(1, before=False), boundaries="hidden")

    _, log, _ = learned(maker(compose, "finetune", lambda: Script({3: 1, 5: SUSPICION})), curriculum)

    frames, alarms, undone = (log.training(name).tolist() for name in ("frames", "alarm", "rolled_back"))
    assert frames == [32, 64, 80, 96, 128, 144, 160, 192]
    assert alarms == [0, 0, 0, 1, 0, 0, 1, 0]
    assert undone == [0, 0, 0, 0, 0, 0, 32, 0]


def test_a_run_with_a_detector_says_so_in_its_name_metrics_and_directory(monkeypatch, tmp_path):
    parts = ("agent=ppo", "method=mask_ri", "detector=oracle", "protocol.boundaries=hidden")
    settings = (*parts, "curriculum.num_frames=64", "evaluation.num_episodes=1")

    assert command_line(monkeypatch, *settings, *TINY, *MINIBATCHES, f"hydra.run.dir={tmp_path}/run") == 0

    run, trained = read_run(tmp_path / "run"), load(tmp_path / "run")
    assert run.agent == "PPO + MaskRI + Oracle"
    assert [run.metrics[name]["value"] for name in ("detection_delay", "label_agreement")] == [0, 1]
    assert type(trained.agent.unwrapped) is PPO
    assert trained.log.training("acted_label").tolist() == [1, 1, 2, 2, 3, 3, 4, 4]
    for number, task in enumerate(trained.curriculum.tasks):
        assert equal(trained.policy_for(task).state_dict(), trained.agent.policy_for(number).state_dict())


HIDDEN = {"boundaries": "hidden"}


@pytest.mark.parametrize(
    ("method", "how", "protocol", "message"),
    [
        ("mask_ri", {}, {}, r"Script detects task changes that are not announced: set protocol\.boundaries=hidden, or"),
        ("mask_ri", {}, {**HIDDEN, "task_id": "one_hot"}, r"set protocol\.task_id=hidden, got one_hot"),
        ("packnet", {}, HIDDEN, "PackNet needs the frames of each block, which no detector gives: take another method"),
        ("multitask", {}, HIDDEN, "Multitask needs all tasks at once, which no detector gives"),
        ("mask_ri", {"needs": ("observation_id",)}, HIDDEN, r"Script needs one-hot observations, got images \[1, 12"),
    ],
)
def test_what_a_detector_cannot_label_is_refused_with_what_to_do(compose, method, how, protocol, message):
    images = "observation_id" in how.get("needs", ())
    tasks = [replace(task, images=PaperImages(5)) if images else task for task in (ONE, TWO)]

    with pytest.raises(ValueError, match=message):
        maker(compose, method, lambda: Script({}, **how))(of(*(Block(task, 64) for task in tasks), **protocol))


@pytest.mark.parametrize(
    ("images", "known"), [((OneHot(16), OneHot(20)), 20), ((PaperImages(5), PaperImages(5)), None)]
)
def test_a_detector_is_told_the_most_entries_of_one_hot_observations_and_of_images_none(compose, images, known):
    script, told = Script({}), []
    tasks = [replace(task, images=kind) for task, kind in zip((ONE, TWO), images, strict=True)]
    script.setup = lambda *given: told.append(given)

    maker(compose, "mask_ri", lambda: script)(of(*(Block(task, 64) for task in tasks), **HIDDEN))

    assert told == [(8, 4, 3, known)]
