"""Agents that do not derive from `Learner`: which of its members each method uses."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from helpers.kill_runs import equal
from helpers.scripted import ONE, TWO, of
from helpers.small_agents import TINY, made
from torch import nn

from baselines.methods.finetune import Finetune
from baselines.methods.method import Method
from baselines.methods.multitask import Multitask
from baselines.parts.catalogue import catalogue
from baselines.parts.learner import Learner
from ctgraph_rl import Block, agent, learn_curriculum
from ctgraph_rl.runs.train import new_agent

CURRICULUM = of(Block(ONE, 32), Block(TWO, 32), Block(ONE, 16), task_id="one_hot")
PROTOCOL = {key for key in vars(agent.Agent) if not key.startswith("_")} | set(agent.Agent.__annotations__)


class Limited(nn.Module):
    """A learner of which only some members can be reached, besides those of the protocol."""

    def __init__(self, learner: Learner, members: tuple[str, ...]) -> None:
        super().__init__()
        self.learner, self.members = learner, {*members, *PROTOCOL}

    def __getattr__(self, name: str) -> Any:
        if name in ("learner", "members") or name not in self.members:
            return super().__getattr__(name)
        return getattr(self.learner, name)

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "method":
            self.learner.method = value
        else:
            super().__setattr__(name, value)


def learned(compose, make_method: Any, *limits: tuple[str, ...]) -> Any:
    """An A2C agent with a method after some blocks; its learner shows these members alone, if they are given."""
    make_alone, curriculum = made(compose, "agent", "a2c", *TINY), make_method().prepare(CURRICULUM)

    def make_agent(*specs: Any) -> Any:
        learner = make_alone(*specs)
        return make_method().attach(Limited(learner, *limits) if limits else learner, curriculum)

    attached = new_agent(curriculum, make_agent, 0)
    learn_curriculum(curriculum, attached, 7)
    return attached


def chosen(compose, name: str) -> Any:
    """What builds a method with its default settings, and a small buffer."""
    return made(compose, "method", name, *["method.buffer_size=48"] * (name == "clear"))


NAMES = [method.name for method in catalogue("method") if not issubclass(method.kind, (Finetune, Multitask))] + [
    "ewc_published"
]


@pytest.mark.parametrize("name", NAMES)
def test_a_method_uses_no_members_of_an_agent_but_those_that_it_names(compose, name):
    make_method = chosen(compose, name)
    members = make_method().agent_members

    limited = learned(compose, make_method, members)

    if name in ("clear", "ewc"):
        whole = learned(compose, make_method)
        assert equal(dict(limited.agent.learner.state_dict()), dict(whole.agent.state_dict()))
        for task in range(2):
            assert equal(limited.policy_for(task).state_dict(), whole.policy_for(task).state_dict())


@pytest.mark.parametrize("name", NAMES)
def test_an_agent_that_lacks_one_of_them_is_refused_and_the_member_is_named(compose, name):
    make_method = chosen(compose, name)
    members: tuple[str, ...] = make_method().agent_members

    for missing in members:
        with pytest.raises(ValueError, match=f"needs an agent with `{missing}`, got Limited: derive it from "):
            learned(compose, make_method, tuple(member for member in members if member != missing))


def test_an_agent_that_is_no_module_is_refused():
    class Bare:
        method = weights = None

    with pytest.raises(ValueError, match=r"Method needs an agent with `torch\.nn\.Module` as its base, got Bare"):
        Method().attach(Bare(), CURRICULUM)

    assert isinstance(Finetune().attach(Bare(), CURRICULUM), Bare)


def test_a_weight_that_the_policy_lacks_is_refused(compose):
    def with_another(*specs: Any) -> Any:
        learner = made(compose, "agent", "a2c", *TINY)(*specs)
        learner.another = nn.Parameter(torch.zeros(2))
        learner.replace_optimiser([*learner.trainable, learner.another])
        return Method().attach(learner, CURRICULUM)

    with pytest.raises(ValueError, match="the weights of an agent must all be parameters of its policy"):
        new_agent(CURRICULUM, with_another, 0)


def test_a_hook_that_does_not_take_the_weights_is_refused(compose):
    class Former(Method):
        def after_step(self) -> None:
            """As methods were written before."""

    with pytest.raises(ValueError, match=r"Former\.after_step must take `weights`, those of the agent, as its last "):
        learned(compose, Former, Former.agent_members)
