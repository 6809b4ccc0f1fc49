"""Models of the environment against its exact entropy."""

from __future__ import annotations

import pytest
from helpers.oracles import confounding, fully_observable, surjective
from torch import Tensor

from baselines.models.gru_model import GRUModel
from baselines.models.model import Symbols, Transitions, experience, learned_share
from baselines.models.table_model import TableModel
from ctgraph_rl.policies import NavigationPolicy, RandomPolicy


class Frequencies:
    """Knows how often each pair comes, and nothing else."""

    def __init__(self, transitions: Transitions) -> None:
        self.share = transitions.pair.flatten().bincount(minlength=1000) / transitions.pair.numel()

    def bits(self, transitions: Transitions) -> Tensor:
        return -self.share[transitions.pair].log2()


def share_learned(make, task, num_steps=160, policy=RandomPolicy, name="random"):
    symbols = Symbols([task])
    model = make(symbols)
    model.learn(experience(task, symbols, policy, num_steps=num_steps))
    return learned_share(model, experience(task, symbols, policy, num_steps=num_steps, seed=1), task, name)


@pytest.mark.parametrize("make", [fully_observable, surjective, confounding])
def test_frequencies_alone_predict_nothing(make):
    task = make(2, 2, 0.5)
    symbols = Symbols([task])
    test = experience(task, symbols, num_steps=160, seed=1)

    assert learned_share(Frequencies(test), test, task) == pytest.approx(0, abs=0.03)


def test_a_table_is_the_exact_model_of_a_fully_observable_task():
    assert share_learned(TableModel, fully_observable(2, 2, 0.5)) == pytest.approx(1, abs=0.03)


def test_a_table_cannot_be_the_model_of_a_task_that_needs_memory():
    task = surjective(2, 2, 0.5, goal=(1, 2))

    assert share_learned(TableModel, task, 64, NavigationPolicy, "navigation") < 0.9


@pytest.mark.slow
def test_a_gru_is_the_exact_model_of_a_task_that_needs_memory():
    task = surjective(2, 2, 0.5, goal=(1, 2))
    assert share_learned(GRUModel, task, 128, NavigationPolicy, "navigation") == pytest.approx(1, abs=0.05)


def test_a_table_forgets_where_its_tasks_disagree():
    tasks = [fully_observable(goal=(1, 1)), fully_observable(goal=(2, 2))]
    symbols = Symbols(tasks)
    model = TableModel(symbols)
    test = experience(tasks[0], symbols, num_steps=64, seed=1)

    shares = []
    for task in tasks:
        model.learn(experience(task, symbols, num_steps=64))
        shares.append(learned_share(model, test, tasks[0]))

    assert shares[0] == pytest.approx(1, abs=0.02)
    assert shares[1] < shares[0] - 0.02


def test_symbols_tell_every_image_and_reward_apart():
    task = fully_observable(2, 3)
    symbols = Symbols([task])
    assert len(symbols.images) == task.images.num_images
    assert symbols.rewards.tolist() == [0, 1]
    test = experience(task, symbols, num_steps=64)
    assert test.image.unique().numel() == task.images.num_images - 1 - task.graph.num_end_states
