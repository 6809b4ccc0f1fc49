"""Plain modules that map observations to logits, as policies of evaluate and of Recorder."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.scripted import DECISION_ID, ONE, TWO, curriculum
from helpers.small_agents import others_slow
from torch import nn

import curricula
from ctgraph_rl import Block, Protocol, Recorder, evaluate
from curricula import su_b1_4tasks

TASKS = curriculum(Block(ONE, 12), Block(TWO, 24))


class Fixed(nn.Module):
    """Logits that prefer to wait, but one decision at decision states, by a number of nats; in float64."""

    def __init__(self, decision: int, nats: float = 5.0) -> None:
        super().__init__()
        self.linear = nn.Linear(5, 3, dtype=torch.float64)
        with torch.no_grad():
            self.linear.weight.zero_()
            self.linear.weight[decision, DECISION_ID] = 2 * nats
            self.linear.bias.copy_(torch.tensor([nats, 0, 0]))

    def forward(self, observation):
        return self.linear(observation)


class Told(nn.Module):
    """Takes the decision that the task id says."""

    def forward(self, observation, task_id):
        return self.logits(observation, task_id)

    def logits(self, observation, task_id):
        deciding = observation[:, DECISION_ID : DECISION_ID + 1]
        return torch.cat([1 - deciding, deciding * task_id], dim=1)


class MayBeTold(Told):
    """The same, without the need of a task id."""

    def forward(self, observation, task_id=None):
        return self.logits(observation, torch.zeros(1, 2) if task_id is None else task_id)


def test_a_plain_module_plays_by_its_largest_logit_in_evaluate_and_recorder():
    module = Fixed(2)

    result = evaluate(module, [ONE, TWO], 5)

    assert result["episode_reward"].mean((1, 2)).tolist() == [0.0, 1.0]
    assert Recorder(TASKS).evaluate(module, 0) == {"goal1": 0.0, "goal2": 1.0}


def test_a_plain_module_samples_where_evaluation_is_not_greedy():
    random = nn.Sequential(nn.Flatten(), nn.Linear(5, 3))
    for weights in random.parameters():
        nn.init.zeros_(weights)

    result = evaluate(random, [ONE], 2000, greedy=False, seed=1)

    assert result["outcome"].unique().tolist() == [1, 2, 3]
    share = (result["outcome"] == 3).double().mean().item()
    assert abs(share - ONE.graph.reward_prob_random) < 0.017  # four standard deviations of 2000 episodes


def test_a_plain_module_of_two_arguments_is_given_task_ids():
    shown = replace(TASKS, protocol=Protocol("one_hot"))

    assert Recorder(shown).evaluate(Told(), 0) == {"goal1": 1.0, "goal2": 1.0}
    assert Recorder(shown).evaluate(policy_for=lambda task: Fixed(task + 1)) == {"goal1": 1.0, "goal2": 1.0}


def test_a_task_id_that_a_module_can_do_without_is_given_where_it_is_shown():
    shown = replace(TASKS, protocol=Protocol("one_hot"))

    assert Recorder(shown).evaluate(MayBeTold(), 0) == {"goal1": 1.0, "goal2": 1.0}
    assert Recorder(TASKS).evaluate(MayBeTold(), 0) == {"goal1": 0.0, "goal2": 0.0}


def test_a_module_in_training_mode_acts_without_dropout_and_keeps_its_running_means_and_its_mode():
    module = nn.Sequential(nn.BatchNorm1d(5, dtype=torch.float64), nn.Dropout(1.0), Fixed(2)).train()
    module[1].eval()
    as_trained = nn.Sequential(nn.Dropout(1.0), Fixed(2)).train()

    evaluate(module, [TWO], 5)

    assert module[0].num_batches_tracked == 0
    assert [each.training for each in module.children()] == [True, False, True]
    assert evaluate(as_trained, [TWO], 5)["episode_reward"].mean() == 1


def test_logits_that_are_nan_are_refused():
    module = Fixed(2)
    module.linear.bias.data.fill_(torch.nan)

    with pytest.raises(ValueError, match="Fixed gives logits that are nan"):
        evaluate(module, [TWO], 1)


def test_a_traced_module_has_no_signature_and_plays():
    traced = torch.jit.trace(Fixed(2), torch.zeros(1, 5, dtype=torch.float64))

    assert evaluate(traced, [TWO], 5)["episode_reward"].mean() == 1


@pytest.mark.parametrize(
    ("module", "message"),
    [
        (nn.Linear(144, 3), r"to logits, float \[400, 3\]; Linear fails with RuntimeError"),
        (nn.Sequential(nn.Flatten(), nn.Linear(144, 2)), r"Sequential gives float32 \[400, 2\]"),
        (nn.Sequential(nn.Flatten(), nn.Linear(144, 3), nn.Flatten(0)), r"Sequential gives float32 \[1200\]"),
        (nn.Sequential(nn.Flatten(), nn.LSTM(144, 3)), "Sequential gives tuple"),
        (Told(), "Told fails with TypeError"),
    ],
)
def test_a_module_that_gives_no_logits_is_refused_with_what_to_write(module, message):
    with pytest.raises(ValueError, match=message) as refused:
        Recorder(su_b1_4tasks(num_frames=256)).evaluate(module, 0)

    assert "write one that does, or a function of a TensorDict that sets 'action'" in str(refused.value)


@pytest.mark.parametrize(
    "name",
    others_slow(
        ("ct8", "su_b1_4tasks", "cartpole_3lengths", "co_hard", "ct28_one_branch", "su_b1_changing_goals"),
        *("ct8", "su_b1_4tasks"),
    ),
)
def test_a_function_with_a_second_argument_task_id_plays_every_kind_of_curriculum(name):
    curriculum = curricula.load(name)
    lengths = []

    def policy(images, task_id=None):
        lengths.append(None if task_id is None else task_id.shape[1])
        return np.zeros(len(images), dtype=np.int64)

    with Recorder(replace(curriculum, evaluation=replace(curriculum.evaluation, tasks="all", every=0))) as recorder:
        recorder.evaluate(policy, curriculum.num_frames)

    shown = curriculum.protocol.task_id == "one_hot"
    assert set(lengths) == {curriculum.protocol.length(len(curriculum.tasks)) if shown else None}
