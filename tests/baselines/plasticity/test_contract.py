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
AGENTS = {
    "c_chain": ["ppo", "lstm_ppo", "dqn", "drqn"],
    "continual_backprop": ["a2c", "lstm_ppo", "dqn"],
    "fire": ["drqn"],
    "fresh_optimiser": ["dqn"],
    "l2_init": ["lstm_ppo"],
    "layer_norm": ["lstm_ppo", "dqn"],
    "parseval": ["drqn"],
    "redo": ["ppo", "drqn"],
    "shrink_and_perturb": ["dqn"],
    "shrink_and_perturb_soft": ["a2c"],
    "upgd": ["ppo"],
}
"""One of each sort that a plasticity treats in another way: with memory, with replay, with a target network."""

PAIRS = [f"{name} {agent}" for name, agents in AGENTS.items() for agent in agents]


def test_no_plasticity_is_left_out():
    assert {*AGENTS} == {*names_in("plasticity")} - {"none"}


class TestEveryPlasticity(PlasticityContract):
    @pytest.fixture(autouse=True, params=others_slow(PAIRS, "continual_backprop a2c"))
    def _plasticity(self, request, compose):
        name, agent = request.param.split()
        self.make_agent = made(compose, "agent", agent, *TINY, *less(agent))
        self.make_method = made(compose, "method", "finetune")
        self.make_plasticity = made(compose, "plasticity", name, *SMALL.get(name, []))
