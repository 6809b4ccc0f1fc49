"""The contracts that ship hold for every agent and every method of ours."""

from __future__ import annotations

import pytest
from helpers.small_agents import ADAPTING, AGENTS, EVOLVING, TINY, less, made, others_slow

from baselines.parts.catalogue import catalogue
from ctgraph_rl import Protocol
from ctgraph_rl.testing import AgentContract, MethodContract

WHOLE_TRIALS = ["agent.adapt_episodes=1", "agent.num_steps=8", "agent.num_layers=1"]
"""The two episodes of a trial have at most 8 steps."""

SMALL_AGENT = {
    "maml": WHOLE_TRIALS,
    "cavia": [*WHOLE_TRIALS, "agent.outer=ppo", "agent.num_epochs=1"],
    "pearl": [
        "agent.trial_episodes=2",
        "agent.num_updates=2",
        "agent.buffer_size=96",
        "agent.num_trials=2",
        "agent.batch_size=4",
        "agent.context_size=4",
    ],
    "penn_a": ["agent.num_batches=1", "agent.num_trials=1", "agent.num_updates=1"],
}

SAMPLES = ["method.num_samples=8"]
SMALL_METHOD = {
    "clear": ["method.buffer_size=48"],
    "ewc": SAMPLES,
    "ewc_published": SAMPLES,
    "finetune": ["method.trunk=kept"],  # else the agent is unchanged
    "mas": SAMPLES,
    "mask_amsc": SAMPLES,
    "mask_sc": SAMPLES,
}

METHODS = [method.name for method in catalogue("method")]


class TestEveryAgent(AgentContract):
    @pytest.fixture(
        autouse=True,
        params=others_slow([*AGENTS, *EVOLVING, *ADAPTING], "dqn", "penn_a", "qrdqn_lstm", "cavia", "pearl"),
    )
    def _agent(self, request, compose):
        name = request.param
        small = SMALL_AGENT.get(name) or less(name)
        self.make_agent = made(compose, "agent", name, *TINY, *small)


class TestEveryMethod(MethodContract):
    @pytest.fixture(autouse=True, params=others_slow(METHODS, "packnet", "multitask"))
    def _method(self, request, compose):
        self.name = request.param
        self.make_agent = made(compose, "agent", "a2c", *TINY)
        self.make_method = made(compose, "method", self.name, *SMALL_METHOD.get(self.name, []))

    def protocol(self):
        return Protocol("one_hot" if self.name == "multitask" else "at_boundaries")
