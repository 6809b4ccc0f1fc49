"""The contracts that ship hold for our methods, and for our agents but those that adapt to drawn tasks."""

from __future__ import annotations

import pytest
from helpers.small_agents import AGENTS, EVOLVING, TINY, less, made, others_slow

from baselines.parts.catalogue import catalogue
from ctgraph_rl import Protocol
from ctgraph_rl.testing import AgentContract, MethodContract

GENERATIONS = ["agent.num_batches=1", "agent.num_trials=1", "agent.num_updates=1"]

SAMPLES = ["method.num_samples=8"]
SMALL_METHOD = {
    "clear": ["method.buffer_size=48"],
    "ewc": SAMPLES,
    "ewc_published": SAMPLES,
    "mas": SAMPLES,
    "mask_amsc": SAMPLES,
    "mask_sc": SAMPLES,
}

METHODS = [method.name for method in catalogue("method") if method.name not in ("finetune", "multitask")]
"""Those that stand between an agent and a curriculum of one task a block."""


class TestEveryAgent(AgentContract):
    @pytest.fixture(autouse=True, params=others_slow([*AGENTS, *EVOLVING], "dqn", "penn_a", "qrdqn_lstm"))
    def _agent(self, request, compose):
        name = request.param
        self.make_agent = made(compose, "agent", name, *TINY, *(GENERATIONS if name in EVOLVING else less(name)))


class TestEveryMethod(MethodContract):
    @pytest.fixture(autouse=True, params=others_slow(METHODS, "packnet"))
    def _method(self, request, compose):
        self.make_agent = made(compose, "agent", "a2c", *TINY)
        self.make_method = made(compose, "method", request.param, *SMALL_METHOD.get(request.param, []))

    def protocol(self):
        return Protocol("at_boundaries")
