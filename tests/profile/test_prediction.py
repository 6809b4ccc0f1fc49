"""Property 9: a model with memory knows all that can be known, the best one without memory has 0, however it acts."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from torch import nn

import curricula
from ctgraph_rl import learn_curriculum
from ctgraph_rl.env import CTGraphEnv
from ctgraph_rl.learn.collect import collect
from ctgraph_rl.profile import prediction
from ctgraph_rl.profile.prediction import bits_of_model

[TASK] = curricula.load("profile_model").tasks

DECISION = 2
"""Id of the image of decision states."""


def numbers(images):
    """The ids of images, by the sums of their pixels."""
    bank = TASK.images.bank(0).flatten(1).long().sum(1)
    return (images.flatten(2).long().sum(2)[:, :, None] == bank).long().argmax(-1)


class Table:
    """Counts what came after the present image and action, and with a memory after the decisions before, too."""

    def __init__(self, remembers: bool) -> None:
        self.remembers = remembers
        self.counts: dict[tuple[int, ...], torch.Tensor] = {}

    def learn(self, batch):
        images = numbers(batch["observation"]).tolist()
        actions = batch["action"].tolist()
        after = 2 * numbers(batch["next", "observation"]) + batch["next", "reward"].squeeze(-1).long()
        done = batch["next", "done"].squeeze(-1).tolist()
        for row, pairs in enumerate(after.tolist()):
            before: list[int] = []
            for image, action, pair, ends in zip(images[row], actions[row], pairs, done[row], strict=True):
                self.counts.setdefault(self.key(before, image, action), torch.full([10], 1e-3))[pair] += 1
                before = [] if ends else before + [action] * (image == DECISION)

    def key(self, before, image, action):
        return (image, action, *(before if self.remembers else ()))

    def predict_next(self, history, choices):
        rows = []
        for images, actions in zip(numbers(history["observation"]).tolist(), history["action"].tolist(), strict=True):
            before = [action for image, action in zip(images[:-1], actions, strict=False) if image == DECISION]
            counts = self.counts.get(self.key(before, images[-1], actions[-1]), torch.ones(10))
            rows.append((counts / counts.sum()).log())
        return torch.stack(rows)


def experience(num_frames):
    env = CTGraphEnv([TASK] * 128, 7)
    torch.manual_seed(7)
    [batch] = collect(env, Modeller(None, None).policy, num_frames, num_frames // 128)
    return batch


class Fixed:
    """Gives the same values to all that can come."""

    def __init__(self, value: float) -> None:
        self.value = value

    def predict_next(self, history, choices):
        return torch.full((len(history), len(choices)), self.value)


class FromTables:
    """The probabilities that the score compares with."""

    def __init__(self, number: int) -> None:
        self.number = number

    def predict_next(self, history, choices):
        tables = prediction._tables(TASK, len(choices))
        place = prediction._place(TASK, prediction._numbers(history["observation"], choices), history["action"])
        return tables[self.number, place].log()


def share(model):
    """The score of a model."""
    known = bits_of_model(model, TASK)
    return (known.value - known.memoryless) / (known.exact - known.memoryless)


def test_the_best_memoryless_predictor_has_0_and_the_exact_model_1(monkeypatch):
    monkeypatch.setattr(prediction, "NUM_EPISODES", 32)

    assert share(FromTables(0)) == pytest.approx(0, abs=1e-6)
    assert share(FromTables(1)) == pytest.approx(1, abs=1e-6)


def test_values_that_are_no_probabilities_are_refused(monkeypatch):
    monkeypatch.setattr(prediction, "NUM_EPISODES", 2)

    with pytest.raises(ValueError, match="probabilities that sum to 1 in each row, got sums off by 9"):
        bits_of_model(Fixed(0.0), TASK)
    with pytest.raises(ValueError, match="probabilities that sum to 1"):
        bits_of_model(Fixed(math.nan), TASK)


def test_a_uniform_guess_knows_nothing(monkeypatch):
    monkeypatch.setattr(prediction, "NUM_EPISODES", 2)

    known = bits_of_model(Fixed(-math.log(10)), TASK)

    assert known.value == pytest.approx(0, abs=1e-6)
    assert known.highest == math.log2(10)


@pytest.mark.slow
def test_a_table_with_memory_scores_1_and_one_without_0():
    remembers, forgets = Table(True), Table(False)
    for model in (remembers, forgets):
        model.learn(experience(163_840))

    assert 0.95 <= share(remembers) <= 1.05
    assert share(forgets) == pytest.approx(0, abs=0.05)


class Modeller(nn.Module):
    """An agent of a user that only models: its policy is its own method, which sometimes acts at random."""

    def __init__(self, observation_spec, action_spec, num_envs=128, num_steps=32, remembers=True):
        super().__init__()
        self.num_envs = num_envs
        self.num_steps = num_steps
        self.table = Table(remembers)

    def policy(self, data):
        images = numbers(data["observation"][:, None]).squeeze(1)
        right = torch.where(images == DECISION, torch.randint(1, 3, images.shape), 0)
        tries = torch.rand(images.shape) < 0.1
        return data.set("action", torch.where(tries, torch.randint(0, 3, images.shape), right))

    def policy_for(self, task):
        return self.policy

    def initial_state(self, num_envs):
        return TensorDict(batch_size=[num_envs])

    def start_task(self, task=None):
        pass

    def end_task(self):
        pass

    def loss(self, batch):
        return {"loss": torch.zeros(())}

    def learn(self, batch):
        self.table.learn(batch)
        return {}

    def predict_next(self, history, choices):
        return self.table.predict_next(history, choices)


def test_an_agent_that_learns_a_curriculum_is_scored_by_its_own_model(monkeypatch):
    monkeypatch.setattr(prediction, "NUM_EPISODES", 16)
    curriculum = curricula.load("profile_model", num_frames=16_384)
    agent = Modeller(None, None, num_steps=128)

    learn_curriculum(curriculum, agent)

    assert share(agent) > 0.8
