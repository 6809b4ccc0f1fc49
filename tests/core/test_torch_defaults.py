"""Nothing depends on torch's default dtype and device: whatever a user sets them to, results have the same bits."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.architecture import PACKAGES
from helpers.learning import learn_together
from helpers.oracles import scripts
from helpers.paths import CHECKOUT
from helpers.scripted import ONE, TWO, lines
from helpers.small_agents import CHOICES, MINIBATCHES, TINY, TWO_TASKS, learner_of, less, name_of, others_slow
from helpers.task_families import FAMILIES, RICH, SWITCHED, VECTORS
from torch import nn

import curricula
from baselines.update.seeds import SeedGroup
from ctgraph_rl import (
    CTGraphEnv,
    Evaluation,
    GroupedImages,
    Recorder,
    RunLog,
    Task,
    learn_curriculum,
    make_agent,
    scores,
)
from ctgraph_rl.batch.gym_env import GymEnv
from ctgraph_rl.gym import CTGraphGymEnv, CTGraphVectorEnv
from ctgraph_rl.learn.collective import Member, learn_collective
from ctgraph_rl.policies import SearchPolicy
from ctgraph_rl.runs.config import target
from ctgraph_rl.runs.job import run_job
from ctgraph_rl.runs.load import load
from ctgraph_rl.runs.train import new_agent, with_method
from ctgraph_rl.sb3 import SB3VecEnv
from ctgraph_rl.tasks.kinds.gym_task import GymTask
from ctgraph_rl.tasks.protocol import Protocol

FLOATS = "zeros ones empty full eye linspace logspace rand randn normal tensor as_tensor asarray"
LAYERS = "Linear Embedding LSTM GRU LSTMCell GRUCell Conv2d LayerNorm RNN"
OF_TORCHRL = ("Bounded", "Unbounded", "Binary", "Categorical", "Composite")
NEEDS = {name: {"dtype", "device"} for name in (*FLOATS.split(), *LAYERS.split(), *OF_TORCHRL)}
NEEDS |= {name: {"device"} for name in ("arange", "randint", "randperm", "Generator", "Composite")}
"""What a call must name that makes tensors; whole numbers have the same dtype by default always."""

MAKERS = re.compile(rf"\b({'|'.join(NEEDS)})\(")


def unnamed(source: str) -> list[str]:
    """The calls of a module that leave dtype or device to torch's defaults."""
    found = []
    for call in ast.walk(ast.parse(source)):
        if isinstance(call, ast.Call):
            owner = call.func.value if isinstance(call.func, ast.Attribute) else None
            name = getattr(call.func, "attr", getattr(call.func, "id", ""))
            is_torchs = getattr(owner, "id", "") in ("torch", "nn") or (owner is None and name in OF_TORCHRL)
            missing = NEEDS.get(name, set()) - {keyword.arg for keyword in call.keywords}
            found += [ast.unparse(call)] * (is_torchs and bool(missing))
    return found


def test_every_tensor_of_the_package_names_its_dtype_and_device():
    paths = [path for package in PACKAGES for path in (CHECKOUT / package).rglob("*.py")]
    sources = {path: path.read_text(encoding="utf-8") for path in paths}
    makers = [path for path, source in sources.items() if MAKERS.search(source)]

    found = {str(path): calls for path in makers if (calls := unnamed(sources[path]))}

    assert len(makers) > 60
    assert not found


def test_calls_that_leave_dtype_or_device_open_are_found():
    source = "torch.zeros(3, device='cpu'); nn.Linear(1, 2); torch.arange(3); Unbounded(3); values.new_zeros(3)"

    assert unnamed(source) == ["torch.zeros(3, device='cpu')", "nn.Linear(1, 2)", "torch.arange(3)", "Unbounded(3)"]


@contextmanager
def defaults(name: str) -> Iterator[None]:
    """What a user may have set: a default dtype, or a default device on which nothing can be computed."""
    if name == "meta":
        with torch.device("meta"):
            yield
        return
    torch.set_default_dtype(getattr(torch, name))
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


STATES = ("float64", "bfloat16", "meta")


def in_turn(names: Iterable[Any], states: Sequence[Any]) -> list[tuple[Any, Any]]:
    """Each name in one of the states; what all names share is in all of them."""
    return [(name, states[number % len(states)]) for number, name in enumerate(names)]


def forget() -> None:
    """Empty the caches of the package, so that everything is made again."""
    for name, module in list(sys.modules.items()):
        if name.partition(".")[0] in PACKAGES:
            for value in list(vars(module).values()):
                if hasattr(value, "cache_clear"):
                    value.cache_clear()


def bits(value: Any) -> Any:
    """Nested values, tensors and arrays by their bits."""
    if isinstance(value, torch.Tensor):
        value = value.detach().contiguous().numpy()
    if isinstance(value, np.ndarray):
        return str(value.dtype), value.shape, value.tobytes()
    if isinstance(value, dict):
        return {key: bits(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [bits(inner) for inner in value]
    return repr(value)


def assert_independent(state: str, job: Callable[[], Any]) -> None:
    """A job gives the same bits in a state as in torch's own."""
    forget()
    expected = bits(job())
    forget()
    with defaults(state):
        found = job()
    assert bits(found) == expected


def learned(compose, agent: str, choices: dict[str, str]) -> Any:
    """Measurements, metrics and state of an agent that has learned two tasks."""
    learner, curriculum = learner_of(compose, agent, choices)
    log = learn_curriculum(curriculum, learner, 7)
    return lines(log), dict(scores(log, curriculum)), learner.state_dict()


@pytest.mark.parametrize(
    ("choice", "state"),
    others_slow([*in_turn(CHOICES, STATES), (("dqn", {}), "meta")], (CHOICES[0], "float64"), (("dqn", {}), "meta")),
    ids=name_of,
)
def test_every_agent_cell_method_and_detector_learns_the_same(compose, choice, state):
    agent, choices = choice
    assert_independent(state, lambda: learned(compose, agent, choices))


TASKS = {
    "rich": RICH,
    "switched": SWITCHED,
    "vectors": VECTORS,
    "grouped": [replace(RICH[2], images=GroupedImages((2, 5, 4, 4), within=0.1, between=0.3))],
    **FAMILIES,
}


def stepped(tasks: list[Task], kernel: str) -> Any:
    """What rows of tasks show under a script, in the environment of TorchRL and in both of Gymnasium."""
    env = CTGraphEnv(tasks, seed=3, kernel=kernel, task_ids={task: number for number, task in enumerate(set(tasks))})
    policy = SearchPolicy(env)
    torch.manual_seed(0)
    played = env.rollout(12, policy, break_when_any_done=False).to_dict()
    rows = CTGraphVectorEnv(len(tasks), tasks, kernel=kernel)
    found = [rows.reset(seed=5)]
    alone = CTGraphGymEnv(tasks[0], kernel=kernel)
    found.append(alone.reset(seed=5))
    for action in ACTIONS:
        found.append(rows.step(action[: len(tasks)]))
        step = alone.step(action[0])
        found.append(step if not step[2] else alone.reset())
    return played, found


ACTIONS = scripts(12, 16, num_actions=2).numpy()


SETTINGS = tuple(product(STATES, ("off", "auto")))


@pytest.mark.parametrize(
    ("name", "setting"),
    others_slow(
        [*product(["rich"], SETTINGS), *in_turn([name for name in TASKS if name != "rich"], SETTINGS)],
        ("rich", ("meta", "auto")),
        ("rich", ("bfloat16", "off")),
    ),
    ids=str,
)
def test_every_environment_shows_the_same(name, setting):
    state, kernel = setting
    assert_independent(state, lambda: stepped(TASKS[name], kernel))


@pytest.mark.parametrize("state", STATES)
def test_rows_of_gymnasium_have_the_same_specs_and_data(state):
    def specs_and_data() -> Any:
        env = GymEnv([GymTask("FrozenLake-v1")] * 2, seed=3)
        dtypes = {str(key): str(spec.dtype) for key, spec in env.output_spec.items(True, True)}
        return dtypes, env.reset().to_dict()

    assert_independent(state, specs_and_data)


class Logits(nn.Module):
    """A user's module, of the user's default dtype."""

    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(5, 3, device="cpu")
        nn.init.constant_(self.linear.weight, 0.5)
        nn.init.constant_(self.linear.bias, 0.0)

    def forward(self, observation):
        return self.linear(observation)


def recorded() -> Any:
    """What a recorder measures of policies of every kind."""
    curriculum = replace(TWO_TASKS, evaluation=Evaluation(2), protocol=Protocol())
    recorder = Recorder(curriculum)
    recorder.evaluate(lambda observation: np.ones(len(observation), dtype=np.int64), 0)
    recorder.evaluate(Logits(), 32)
    recorder.evaluate(SearchPolicy, 64)
    return lines(recorder.log), recorder.metrics


def played_by_stable_baselines() -> Any:
    envs = SB3VecEnv(3, [ONE, TWO, ONE], task_ids={ONE: 0, TWO: 1})
    return [envs.reset(), *(envs.step(action[:3]) for action in ACTIONS)]


def shared(compose) -> Any:
    """What members of a collective measure that exchange masks and embeddings."""
    members = []
    cfg = compose(
        "agent=ppo",
        "method=mask_shared",
        "method.backbone_seed=1",
        "exchange=mosaic",
        *TINY,
        *MINIBATCHES,
        "exchange.num_members=2",
        "exchange.every=1",
        "exchange.num_samples=8",
        "exchange.buffer_size=16",
    )
    curriculum = replace(TWO_TASKS, protocol=Protocol("at_boundaries", num_task_ids=4))
    for seed in range(2):
        agent = new_agent(curriculum, with_method(target(cfg, "agent"), target(cfg, "method"), curriculum), seed)
        members.append(Member(curriculum, agent, seed, RunLog()))
    learn_collective(members, target(cfg, "exchange")())
    return [(lines(member.log), member.agent.state_dict()) for member in members]


def ran(compose, folder: Path) -> Any:
    """The log of a run, and the agent that is loaded from its directory."""
    small = ["curriculum=su_b1_4tasks", "curriculum.num_frames=64", "evaluation.num_episodes=4"]
    run_job(compose("agent=dqn", *small, *TINY, *less("dqn")), folder)
    return lines(RunLog.read(folder / "run.jsonl")), load(folder).agent.state_dict()


def stacked(compose) -> Any:
    """What two seeds measure that learn as one batch."""
    generators, agents = [], []
    for seed in range(2):
        agents.append(learner_of(compose, "dqn", {}, seed)[0])
        generators.append(torch.Generator("cpu").set_state(torch.get_rng_state()))
    logs = [RunLog(), RunLog()]
    learn_together(TWO_TASKS, SeedGroup(agents, generators), [0, 1], logs)
    return [lines(log) for log in logs], [agent.state_dict() for agent in agents]


def of_gymnasium() -> Any:
    """What an agent measures on tasks of Gymnasium."""
    logs = []
    for name in ("frozen_lake_4maps", "cartpole_3lengths"):
        curriculum = curricula.load(name, num_frames=64)
        curriculum = replace(curriculum, evaluation=Evaluation(2))
        agent = make_agent("dqn", curriculum, 0, num_envs=8, num_steps=4, hidden_size=8, batch_size=8)
        logs.append(lines(learn_curriculum(curriculum, agent, 3)))
    return logs


JOBS: dict[str, Callable[[Any, Path], Any]] = {
    "recorder": lambda compose, path: recorded(),
    "stable-baselines3": lambda compose, path: played_by_stable_baselines(),
    "collective": lambda compose, path: shared(compose),
    "run": ran,
    "seeds as one batch": lambda compose, path: stacked(compose),
    "tasks of Gymnasium": lambda compose, path: of_gymnasium(),
}


KEPT = ("recorder", "float64"), ("stable-baselines3", "meta")


@pytest.mark.parametrize(("name", "state"), others_slow(product(JOBS, STATES), *KEPT))
def test_every_way_to_learn_and_to_measure_gives_the_same(compose, tmp_path, name, state):
    folders = iter([tmp_path / "before", tmp_path / "after"])

    def job() -> Any:
        folder = next(folders)
        folder.mkdir()
        return JOBS[name](compose, folder)

    assert_independent(state, job)
