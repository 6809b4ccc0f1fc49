"""Plain modules that map observations to logits, as policies of evaluate and of Recorder."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.scripted import DECISION_ID, ONE, TWO, curriculum
from torch import nn

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
        deciding = observation[:, DECISION_ID : DECISION_ID + 1]
        return torch.cat([1 - deciding, deciding * task_id], dim=1)


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
