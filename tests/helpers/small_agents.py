"""Every agent with a small network, alone and with a method, what it collects and what it learns from."""

from __future__ import annotations

import io
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType

from baselines.methods.method import AgentWithMethod, Method
from baselines.methods.parts.importance import Importance
from baselines.parts.catalogue import catalogue
from baselines.parts.inner_loop import InnerLoop
from baselines.parts.learner import Learner
from baselines.parts.policy_gradient import PolicyGradient
from baselines.parts.q_learning import QLearner
from ctgraph_rl import Block, CTGraph, CTGraphEnv, Curriculum, Evaluation, OneHot, Protocol, Task
from ctgraph_rl.learn.collect import collect
from ctgraph_rl.packages import conf_dir
from ctgraph_rl.runs import config, train
from ctgraph_rl.runs.config import target
from ctgraph_rl.runs.job import method_of
from ctgraph_rl.runs.train import new_agent
from helpers.paths import CHECKOUT
from helpers.scripted import OBSERVATIONS, ONE, THREE, TWO, of

YAML = {path.stem: OmegaConf.load(path) for path in sorted(Path(conf_dir(), "agent").glob("*.yaml"))}

KINDS = {agent.name: agent.kind for agent in catalogue("agent")}

INNER_LOOPS = [name for name, kind in KINDS.items() if issubclass(kind, InnerLoop)]

ADAPTING = [*INNER_LOOPS, "pearl"]
"""Agents that need tasks which are drawn, and no method."""

EVOLVING = ["penn_a"]
"""Agents with neither a gradient step for their actions nor a method."""

AGENTS = [name for name in KINDS if name not in (*ADAPTING, *EVOLVING)]
"""All others; files of conf/agent that are no agents only change some values of one."""

Q_LEARNERS = tuple(name for name, kind in KINDS.items() if issubclass(kind, QLearner))
POLICY_GRADIENTS = tuple(name for name, kind in KINDS.items() if issubclass(kind, PolicyGradient))
RECURRENT = tuple(name for name in AGENTS if KINDS[name].memory)

LESS = {name: [f"agent.batch_size={4 if name in RECURRENT else 32}"] for name in Q_LEARNERS}
FEWER = {
    name: [f"agent.{key}={min(its[key], most)}" for key, most in (("num_epochs", 2), ("num_updates", 3)) if key in its]
    for name, its in YAML.items()
}
SMALL_AGENT = {
    name: ["agent.num_envs=16", "agent.num_steps=8", "agent.hidden_size=8", *FEWER[name], *LESS.get(name, [])]
    for name in YAML
}
"""Overrides that make each agent small."""

ONE_HOT_TASK = Task(CTGraph(3, 1), (3,), OBSERVATIONS, OneHot(5))
TWO_GOALS = replace(ONE_HOT_TASK, graph=CTGraph(2, 1), goal=(1,), goal_change=(4, 4))

GREEDY, SAMPLED = ExplorationType.DETERMINISTIC, ExplorationType.RANDOM

ROWS, STEPS = 8, 4
TINY = [f"agent.num_envs={ROWS}", f"agent.num_steps={STEPS}", "agent.hidden_size=4"]
MINIBATCHES = ["agent.num_minibatches=2", "agent.num_epochs=2"]
REPLAY = ["agent.num_updates=2", "agent.batch_size=8", "agent.buffer_size=96", "agent.target_update_interval=3"]
"""Overrides that make agents tiny: 32 frames a batch."""


def others_slow(values: Iterable[Any], *kept: Any) -> list[Any]:
    """All values, or tuples of values, of which those that are not kept in the default run are slow."""
    several = [value if isinstance(value, tuple) else (value,) for value in values]
    wanted = [value if isinstance(value, tuple) else (value,) for value in kept]
    return [pytest.param(*value, marks=[] if value in wanted else [pytest.mark.slow]) for value in several]


def less(name: str) -> list[str]:
    """The last two of these, where an agent has such settings."""
    return [*REPLAY * ("target_update_interval" in YAML[name]), *MINIBATCHES * ("num_minibatches" in YAML[name])]


def batches(agent, task: Task, count: int, seed: int = 0) -> list:
    """Batches that an agent collects, as `learn_curriculum` gives them."""
    env = CTGraphEnv([task] * agent.num_envs, seed=seed)
    frames = count * agent.num_envs * agent.num_steps
    return list(collect(env, agent.policy, frames, agent.num_steps, agent.initial_state))


def learnt_from(agent, batch) -> list:
    """The batches of which the agent minimises the loss when it learns from a batch."""
    seen, loss = [], agent.loss
    agent.loss = lambda minibatch, *others: (seen.append(dict(minibatch)), loss(minibatch, *others))[1]
    agent.learn(batch)
    agent.loss = loss
    return seen


def agent_of(compose, name: str, env, *overrides: str):
    """A small agent for the specs of any environment; equal weights for every call."""
    cfg = compose(f"agent={name}", *SMALL_AGENT[name], *overrides)
    torch.manual_seed(0)
    return config.target(cfg, "agent")(env.observation_spec_unbatched, env.action_spec_unbatched)


def saved_and_loaded(state: dict) -> dict:
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


def parameters_equal(one, other) -> bool:
    return all(torch.equal(*pair) for pair in zip(one.parameters(), other.parameters(), strict=True))


BATCHED = {
    "a2c": ["agent.optimiser=rmsprop", "agent.normalize_advantage=true"],
    "reinforce": [],
    "ppo": MINIBATCHES,
    "ppo_count": [*MINIBATCHES, "agent.num_hash_bits=6"],
    "ppo_rnd": MINIBATCHES,
    "ppo_published": MINIBATCHES,
    "dqn": REPLAY,
    "prioritized dqn": [*REPLAY, "agent.priority_alpha=0.6", "agent.replay_on_task_change=keep"],
}
"""Settings of agents whose seeds can be one batch."""

TASKS = (ONE, TWO, THREE)


def made(compose, group: str, name: str, *overrides: str) -> Any:
    """What builds the choice of a group of the configuration."""
    return config.target(compose(f"{group}={name}", *overrides), group)


def small(compose, agent: str, tasks=TASKS, *overrides: str) -> Any:
    """An agent as the fixture ``small_agent`` builds it."""
    env = CTGraphEnv(tasks)
    torch.manual_seed(0)
    make_agent = made(compose, "agent", agent, *SMALL_AGENT[agent], *overrides)
    return make_agent(env.observation_spec_unbatched, env.action_spec_unbatched)


def with_method(compose, agent: str, method: Method, tasks=TASKS, *overrides: str) -> AgentWithMethod:
    """A small agent with a method. Each task has one block, and the method gets its id at the start of the block."""
    curriculum = method.prepare(of(*(Block(task, 160) for task in tasks), task_id="at_boundaries"))
    return method.attach(small(compose, agent, tasks, *overrides), curriculum)


def stay(attached: AgentWithMethod, number: int, tasks=TASKS, number_of_batches: int = 2) -> None:
    """A block of some batches."""
    attached.start_task(number)
    for batch in batches(attached, tasks[number], number_of_batches, seed=number):
        attached.learn(batch)
    attached.end_task()


def weights_for(attached, number: int) -> list[torch.Tensor]:
    """Copies of the weights that a task is acted in with."""
    return [parameter.detach().clone() for parameter in attached.policy_for(number).parameters()]


RATE = 0.1


class Tiny(Learner):
    """Two inputs and three outputs, linear: logits of a policy, or action values; learns by plain gradient descent."""

    output_keys = ("log_probs",)
    minibatch_size = 0

    def __init__(self) -> None:
        super().__init__(num_envs=1, num_steps=1, max_grad_norm=1e9)
        self.linear = nn.Linear(2, 3)
        self.policy = TensorDictModule(self.linear, in_keys=["observation"], out_keys=["logits"])
        self.optimiser = torch.optim.SGD(self.parameters(), RATE)

    def outputs(self, data: Any) -> dict[str, Tensor]:
        outputs = self.linear(data["observation"])
        return {"log_probs": outputs.log_softmax(dim=-1), "action_value": outputs}

    def loss(self, batch: Any) -> dict[str, Tensor]:
        """Linear in the outputs: two parts, and something that is only measured."""
        each = (batch["factor"] * self.linear(batch["observation"])).mean(dim=0)
        return {"loss_first": each[0], "loss_others": each[1:].sum(), "entropy": each.sum() * 100}


def seen(number: int, seed: int = 0) -> dict[str, Tensor]:
    """A minibatch."""
    generator = torch.Generator().manual_seed(seed)
    observation, factor = (torch.randn(number, width, generator=generator) for width in (2, 3))
    return {"observation": observation, "factor": factor, "action": torch.zeros(number, dtype=torch.int64)}


def same(one: Any, other: Any) -> bool:
    """Whether two lists or dictionaries of tensors are equal bit by bit."""
    pairs = zip(one, other, strict=True) if isinstance(one, list) else [(one[key], other[key]) for key in one]
    return all(torch.equal(*pair) for pair in pairs)


CURRICULUM = of(*(Block(task, 64) for task in TASKS), task_id="at_boundaries")


def tiny(method: Importance, kind: type[Tiny] = Tiny) -> AgentWithMethod:
    torch.manual_seed(0)
    return AgentWithMethod(kind(), method, CURRICULUM)


TWO_TASKS = of(Block(ONE, 32), Block(TWO, 64), evaluation=Evaluation(2, greedy=False, before=False), task_id="one_hot")
HIDDEN = replace(TWO_TASKS, protocol=Protocol(boundaries="hidden"))

SETTINGS = {
    "clear": ["method.buffer_size=48"],
    "mask_sc": ["method.num_samples=4", "method.every=1", "method.threshold=-1"],
    **{name: ["method.num_samples=4"] for name in ("ewc", "ewc_published", "mas", "mask_amsc")},
    "swoks": [
        "detector.window=8",
        "detector.num_windows=4",
        "detector.num_tested=2",
        "detector.num_kept=8",
        "detector.num_left_out=2",
    ],
    "adwin": ["detector.clock=1", "detector.grace_period=1", "detector.min_window_length=1"],
}


def names_in(group: str) -> list[str]:
    return sorted(path.stem for path in (CHECKOUT / "conf" / group).glob("*.yaml"))


CHOICES = [
    *((agent, {}) for agent in AGENTS),
    *(("lstm_ppo", {"cell": cell}) for cell in names_in("cell") if cell != "lstm"),  # which both agents have
    *(("drqn", {"cell": cell}) for cell in ("attention", "frames", "min_gru")),
    *(("ppo", {"method": method}) for method in names_in("method")),
    *(("ppo", {"method": "mask_ri", "detector": detector}) for detector in names_in("detector")),
]
"""Agents, and the choices of other groups of the configuration."""


def learner_of(compose, agent: str, choices: dict[str, str], seed: int = 0) -> tuple[Any, Curriculum]:
    """A learner, and the curriculum that it can learn."""
    names = [f"{group}={name}" for group, name in choices.items()]
    more = [setting for name in choices.values() for setting in SETTINGS.get(name, [])]
    cfg = compose(f"agent={agent}", *names, *TINY, *less(agent), *more)
    make_method = method_of(cfg)
    curriculum = make_method().prepare(HIDDEN if "detector" in choices else TWO_TASKS)
    return new_agent(curriculum, train.with_method(target(cfg, "agent"), make_method, curriculum), seed), curriculum


def name_of(choice: Any) -> str | None:
    """A test's name for one of these."""
    return " ".join([choice[0], *choice[1].values()]) if isinstance(choice, tuple) else None
