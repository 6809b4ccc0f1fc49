"""The contract that ships holds for every plasticity of ours."""

from __future__ import annotations

import pytest
from helpers.small_agents import TINY, less, made, names_in, others_slow

from ctgraph_rl.testing import PlasticityContract

SMALL = {
    "redo": ["plasticity.period=2", "plasticity.threshold=0.5"],
    "continual_backprop": ["plasticity.rate=0.2", "plasticity.maturity=1"],
    "c_chain": ["plasticity.window=2"],
}
AGENTS = ("ppo", "a2c", "lstm_ppo", "dqn", "drqn")
PAIRS = [f"{name} {agent}" for name in names_in("plasticity") if name != "none" for agent in AGENTS]


class TestEveryPlasticity(PlasticityContract):
    @pytest.fixture(autouse=True, params=others_slow(PAIRS, "continual_backprop a2c"))
    def _plasticity(self, request, compose):
        name, agent = request.param.split()
        self.make_agent = made(compose, "agent", agent, *TINY, *less(agent))
        self.make_method = made(compose, "method", "finetune")
        self.make_plasticity = made(compose, "plasticity", name, *SMALL.get(name, []))
