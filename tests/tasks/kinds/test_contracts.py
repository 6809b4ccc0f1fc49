"""The contracts that ship with the package, inherited as a user does, and that each can fail."""

from __future__ import annotations

import math
import re
import sys
from dataclasses import dataclass, replace
from types import ModuleType

import pytest
import torch
from helpers.paths import CHECKOUT
from tensordict.nn import TensorDictModule

import curricula
from baselines.a2c import A2C
from baselines.methods.si import SI
from ctgraph_rl import CTGraphEnv, Protocol, Task
from ctgraph_rl.runs.config import target
from ctgraph_rl.tasks.kinds.gym_task import GymTask
from ctgraph_rl.tasks.kinds.task_like import ENVIRONMENTS
from ctgraph_rl.testing import AgentContract, EnvironmentContract, MethodContract, TaskContract
from curricula.paper import ct_su_b1

GOALS = ((1, 2), (2, 1))


class TestLakes(TaskContract, EnvironmentContract):
    def make_tasks(self):
        return [GymTask("FrozenLake-v1", {"is_slippery": slips}, max_episode_steps=9) for slips in (True, False)]


class TestPoles(TaskContract, EnvironmentContract):
    def make_tasks(self):
        short, long, _ = curricula.load("cartpole_3lengths").tasks
        return [replace(pole, max_episode_steps=9) for pole in (short, long)]


@pytest.mark.slow
class TestPendulums(TaskContract, EnvironmentContract):
    def make_tasks(self):
        return [GymTask("Pendulum-v1", {"g": gravity}, max_episode_steps=9) for gravity in (5.0, 10.0)]


@pytest.mark.slow
class TestFaceOfGymnasium(TaskContract, EnvironmentContract):
    def make_tasks(self):
        settings = [{"goal": list(goal)} for goal in GOALS]
        return [GymTask("ctgraph_rl.gym:ctgraph/CT-SU-B1-v0", goal, max_episode_steps=9) for goal in settings]


class TestGraphs(TaskContract, EnvironmentContract):
    def make_tasks(self):
        return [ct_su_b1(goal=goal) for goal in GOALS]


class TestGraphsOfManyOptions(TaskContract, EnvironmentContract):
    def make_tasks(self):
        trained = ct_su_b1(goal=GOALS[0])
        graph = replace(trained.graph, wait_prob=0.5)
        searched = replace(trained, graph=graph, fail_reward=-0.5, goal_change=(2, 3))
        return [trained, searched]


@dataclass(frozen=True)
class Half:
    """A reward that the C kernel does not know."""

    def __call__(self, arrival):
        return torch.where(arrival.leaf == arrival.goal_leaf, 1.0, 0.5)


class TestGraphsOfTheTensorEngine(EnvironmentContract):
    def make_tasks(self):
        return [replace(ct_su_b1(goal=goal), reward_fn=Half()) for goal in GOALS]


def test_the_environment_of_the_page_passes_the_contracts_that_the_page_names(monkeypatch):
    text = (CHECKOUT / "docs" / "reference" / "own_env_base.md").read_text()
    module = ModuleType("my_task")
    monkeypatch.setitem(sys.modules, "my_task", module)
    [environment] = re.findall(r"`my_task.py`:\n\n```python\n(.*?)```", text, re.DOTALL)
    [tests] = re.findall(r"```py\n(.*?)```", text, re.DOTALL)
    exec(environment, module.__dict__)
    exec(tests, module.__dict__)
    contract = module.TestCorridor()
    names = [name for name in dir(contract) if name.startswith("test_")]

    for name in names:
        getattr(contract, name)()
    assert len(names) == 9


SMALL_A2C = ("agent.num_envs=4", "agent.num_steps=4", "agent.hidden_size=4")


class TestA2C(AgentContract):
    @pytest.fixture(autouse=True)
    def _settings(self, compose):
        self.make_agent = target(compose("agent=a2c", *SMALL_A2C), "agent")


@pytest.mark.slow
class TestEWC(TestA2C, MethodContract):
    @pytest.fixture(autouse=True)
    def _method(self, compose):
        self.make = target(compose("method=ewc", "method.num_samples=16"), "method")

    def make_method(self):
        return self.make()

    def protocol(self):
        return Protocol("at_boundaries")


class Untyped(CTGraphEnv):
    """Shows numbers of another type than its specs say."""

    def _step(self, tensordict):
        data = super()._step(tensordict)
        return data.set("observation", data["observation"].float())


class Stays(CTGraphEnv):
    """Never changes its tasks."""

    def set_tasks(self, tasks, at_episode_end=False):
        super().set_tasks(self.tasks, at_episode_end)

    def switch_tasks(self, tasks, switch, at_episode_end=False):
        """Do nothing."""


class Miscounts(CTGraphEnv):
    """Counts twice as fast."""

    def _step(self, tensordict):
        data = super()._step(tensordict)
        return data.set("step_count", 2 * data["step_count"])


class Unseeded(CTGraphEnv):
    """Pays what no seed decides."""

    steps = 0

    def _step(self, tensordict):
        Unseeded.steps += 1
        data = super()._step(tensordict)
        return data.set("reward", data["reward"] + Unseeded.steps)


class Unsaved(CTGraphEnv):
    """Loads another number of steps in the present episodes."""

    def load_state_dict(self, state_dict, *args, **kwargs):
        count = state_dict["rows.step_count"] + 1
        return super().load_state_dict({**state_dict, "rows.step_count": count}, *args, **kwargs)


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        (Untyped, "test_data_are_as_the_specs_say"),
        (Miscounts, "test_counts_and_sums_are_of_an_episode"),
        (Unseeded, "test_equal_seeds_and_actions_give_equal_data"),
        (Stays, "test_a_row_changes_its_task_where_its_episode_ends"),
        (Stays, "test_a_switch_changes_the_task_of_each_episode"),
        (Unsaved, "test_a_saved_environment_resumes_with_the_same_bits"),
    ],
)
def test_a_contract_fails_for_an_environment_that_breaks_it(kind, name, monkeypatch):
    monkeypatch.setitem(ENVIRONMENTS, Task, kind)

    with pytest.raises(AssertionError):
        getattr(TestGraphsOfManyOptions(), name)()


@dataclass(frozen=True)
class Named:
    """A task of nothing but what the contract of tasks reads."""

    label: str
    best: float = 0.5
    serial: int = 0

    observation_shape = (1,)
    num_actions = 2
    return_bounds = (0.0, 1.0)

    @property
    def label_parts(self):
        return {"name": self.label}

    def optimal_value(self, gamma):
        return self.best

    @classmethod
    def make_env(cls, tasks, seed=0, **others):
        raise NotImplementedError


@dataclass(frozen=True)
class Grows(Named):
    """Is another task each time that it is built from its values."""

    def __post_init__(self):
        object.__setattr__(self, "serial", self.serial + 1)


JSON = "test_a_curriculum_of_them_has_labels_and_survives_json"


@pytest.mark.parametrize(
    ("tasks", "name"),
    [
        ([Named("same"), Named("same")], "test_tasks_are_equal_and_hashed_by_value"),
        ([Named(""), Named("other")], JSON),
        (
            [Named("one"), Named("other", best=2.0)],
            "test_what_is_known_of_returns_is_in_order_or_says_why_it_is_not_known",
        ),
    ],
)
def test_a_contract_fails_for_tasks_that_break_it(tasks, name):
    contract = TaskContract()
    contract.make_tasks = lambda: tasks

    with pytest.raises(AssertionError):
        getattr(contract, name)()


def test_the_contract_of_tasks_fails_for_those_that_json_does_not_hold():
    contract = TaskContract()
    contract.make_tasks = lambda: [Grows("one"), Grows("other")]

    with pytest.raises(ValueError, match="fingerprint is"):
        getattr(contract, JSON)()


class Forgets(A2C):
    """Loads no state of its optimiser."""

    def load_state_dict(self, state_dict, *args, **kwargs):
        found = super().load_state_dict(state_dict, *args, **kwargs)
        self.replace_optimiser(self.trainable)
        return found


class Overshoots(A2C):
    """Acts outside of the range."""

    def __init__(self, *args, **settings):
        super().__init__(*args, **settings)
        self.policy = TensorDictModule(lambda seen: torch.full((len(seen),), 9), ["observation"], ["action"])


class Idles(A2C):
    """Learns nothing."""

    def learn(self, batch):
        return {"loss_policy": 0.0}


class Explodes(A2C):
    """Measures what is no number."""

    def learn(self, batch):
        return {**super().learn(batch), "entropy": math.nan}


class Wanders(A2C):
    """Draws its weights from a generator that no seed sets."""

    made = 0

    def __init__(self, *args, **settings):
        super().__init__(*args, **settings)
        Wanders.made += 1
        self.critic.module.bias.data.fill_(Wanders.made)


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        (Overshoots, "test_a_policy_writes_an_action_for_each_row"),
        (Idles, "test_it_learns_two_blocks_and_measures_finite_numbers"),
        (Explodes, "test_it_learns_two_blocks_and_measures_finite_numbers"),
        (Wanders, "test_equal_seeds_give_equal_runs"),
        (Forgets, "test_a_run_resumes_from_a_saved_state_with_the_same_bits"),
    ],
)
def test_a_contract_fails_for_an_agent_that_breaks_it(kind, name, compose):
    broken = f"agent._target_={__name__}.{kind.__name__}"
    contract = AgentContract()
    contract.make_agent = target(compose("agent=a2c", *SMALL_A2C, broken), "agent")

    with pytest.raises((AssertionError, FloatingPointError)):
        getattr(contract, name)()


class Loses(SI):
    """Does not save the paths of its weights."""

    def register_buffer(self, name, tensor, persistent=True):
        super().register_buffer(name, tensor, persistent=name != "path")


def test_the_contract_of_methods_fails_for_one_that_saves_less_than_it_needs(compose):
    contract = MethodContract()
    contract.make_agent = target(compose("agent=a2c", *SMALL_A2C), "agent")
    contract.make_method = target(compose("method=si", f"method._target_={__name__}.Loses"), "method")
    contract.protocol = lambda: Protocol("at_boundaries")

    with pytest.raises(AssertionError):
        contract.test_a_run_resumes_from_a_saved_state_with_the_same_bits()
