"""The contracts that ship with the package, inherited as a user does, and that each can fail."""

from __future__ import annotations

import pytest

from baselines.a2c import A2C
from ctgraph_rl import CTGraphEnv, Protocol
from ctgraph_rl.runs.config import target
from ctgraph_rl.tasks.kinds.gym_task import GymTask
from ctgraph_rl.testing import AgentContract, EnvironmentContract, MethodContract, TaskContract
from curricula.paper import ct_su_b1


class TestGymTask(TaskContract, EnvironmentContract):
    def make_tasks(self):
        return [GymTask("FrozenLake-v1", {"is_slippery": slips}, max_episode_steps=9) for slips in (True, False)]


class TestGraphs(TaskContract, EnvironmentContract):
    def make_tasks(self):
        return [ct_su_b1(goal=goal) for goal in ((1, 2), (2, 1))]


class TestA2C(AgentContract):
    @pytest.fixture(autouse=True)
    def _settings(self, compose):
        small = ("agent.num_envs=4", "agent.num_steps=4", "agent.hidden_size=4")
        self.make_agent = target(compose("agent=a2c", *small), "agent")


@pytest.mark.slow
class TestEWC(TestA2C, MethodContract):
    @pytest.fixture(autouse=True)
    def _method(self, compose):
        self.make = target(compose("method=ewc", "method.num_samples=16"), "method")

    def make_method(self):
        return self.make()

    def protocol(self):
        return Protocol("at_boundaries")


class Stays(CTGraphEnv):
    """Never changes its tasks."""

    def set_tasks(self, tasks, at_episode_end=False):
        super().set_tasks(self.tasks, at_episode_end)


class Miscounts(CTGraphEnv):
    """Counts twice as fast."""

    def _step(self, tensordict):
        data = super()._step(tensordict)
        return data.set("step_count", 2 * data["step_count"])


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        (Stays, "test_a_row_changes_its_task_where_its_episode_ends"),
        (Miscounts, "test_counts_and_sums_are_of_an_episode"),
    ],
)
def test_a_contract_fails_for_an_environment_that_breaks_it(kind, name, monkeypatch):
    monkeypatch.setattr("ctgraph_rl.env.CTGraphEnv", kind)

    with pytest.raises(AssertionError):
        getattr(TestGraphs(), name)()


@pytest.mark.slow
def test_a_contract_fails_for_an_agent_that_forgets_its_optimiser(compose):
    class Forgets(A2C):
        def load_state_dict(self, state_dict, *args, **kwargs):
            found = super().load_state_dict(state_dict, *args, **kwargs)
            self.replace_optimiser(self.trainable)
            return found

    contract = TestA2C()
    cfg = compose("agent=a2c", "agent.num_envs=4", "agent.num_steps=4", "agent.hidden_size=4")
    contract.make_agent = lambda *specs: _as(Forgets, target(cfg, "agent")(*specs))

    with pytest.raises(AssertionError):
        contract.test_a_run_resumes_from_a_saved_state_with_the_same_bits()


def _as(kind, agent):
    agent.__class__ = kind
    return agent
