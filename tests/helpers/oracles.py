"""Reference policies, the paper's tree in plain Python, and helpers that several tests share."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import product

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ctgraph_rl.core.graph import CTGraph, StateType
from ctgraph_rl.env import CTGraphEnv
from ctgraph_rl.tasks.images import ImageSet, OneHot, PaperImages
from ctgraph_rl.tasks.observations import Observations
from ctgraph_rl.tasks.task import Task

HOME, WAIT, DECISION, END, FAIL = StateType

ALPHA = 1e-6
"""False-alarm rate of every statistical test; the seeds are fixed, so a test that passes always passes."""

Policy = Callable[[CTGraphEnv], Tensor]
TreeState = tuple[StateType, tuple[int, ...]]
"""A state of the tree by the decisions that lead to it."""


def surjective(
    b: int = 2, d: int = 2, p: float = 0.0, goal: Sequence[int] | None = None, image_seed: int = 1, **variation: int
) -> Task:
    """One image for each kind of state."""
    x = Observations(wait_ids=(2, 2), decision_ids=(3, 3), end_ids=(4, 4), **variation)
    return Task(CTGraph(b, d, p), tuple(goal or (1,) * d), x, PaperImages(5, image_seed))


def fully_observable(b: int = 2, d: int = 2, p: float = 0.0, goal: Sequence[int] | None = None) -> Task:
    """An image for each state, in the order home, fail, waits, decisions, ends."""
    decisions = sum(b**level for level in range(d))
    ends = b**d
    x = Observations(
        wait_ids=(2, 1 + decisions + ends),
        decision_ids=(2 + decisions + ends, 1 + 2 * decisions + ends),
        end_ids=(2 + 2 * decisions + ends, 1 + 2 * decisions + 2 * ends),
        unique_waits=True,
        unique_decisions=True,
    )
    return Task(CTGraph(b, d, p), tuple(goal or (1,) * d), x, PaperImages(2 + 2 * decisions + 2 * ends))


def confounding(
    b: int = 2, d: int = 2, p: float = 0.0, goal: Sequence[int] | None = None, image_seed: int = 1, **variation: int
) -> Task:
    """Eight images for wait states, two for decision states, four for end states, drawn at every observation."""
    x = Observations(wait_ids=(2, 9), decision_ids=(10, 11), end_ids=(12, 15), **variation)
    return Task(CTGraph(b, d, p), tuple(goal or (1,) * d), x, PaperImages(16, image_seed))


def one_hot(
    b: int = 2, d: int = 2, p: float = 0.0, goal: Sequence[int] | None = None, images: ImageSet | None = None
) -> Task:
    """The paper's 1D observations of a surjective graph."""
    x = Observations(wait_ids=(2, 2), decision_ids=(3, 3), end_ids=(4, 4))
    return Task(CTGraph(b, d, p), tuple(goal or (1,) * d), x, images or OneHot(5))


FORKS = [surjective(2, 2, goal=goal) for goal in product((1, 2), repeat=2)]
"""The four goals of one graph."""

STATE = ("state_type", "node", "observation_id", "tick", "step_count", "episode_reward")
"""Buffers of an environment that hold the state of its rows."""


def optimal(env: CTGraphEnv) -> Tensor:
    """Waits where it must and takes the goal's decisions; sees the true state."""
    states = zip(env.tasks, env.state_type.tolist(), env.node.tolist(), strict=True)
    return torch.tensor([_best_action(*state) for state in states])


def _best_action(task: Task, kind: int, node: int) -> int:
    if kind != DECISION:
        return 0
    level = 0
    while node > 0:
        node, level = (node - 1) // task.graph.branching_factor, level + 1
    return task.goal[level]


def navigation(seed: int) -> Policy:
    """Waits where it must and decides uniformly at random; sees the kind of state."""
    generator = torch.Generator().manual_seed(seed)

    def policy(env: CTGraphEnv) -> Tensor:
        decision = 1 + _uniform(_branching_factors(env), generator)
        return torch.where(env.state_type == DECISION, decision, 0)

    return policy


def uniform(seed: int) -> Policy:
    """Every action of a row's own task with the same probability."""
    generator = torch.Generator().manual_seed(seed)
    return lambda env: _uniform(_branching_factors(env) + 1, generator)


def _branching_factors(env: CTGraphEnv) -> Tensor:
    return torch.tensor([task.graph.branching_factor for task in env.tasks])


def _uniform(high: Tensor, generator: torch.Generator) -> Tensor:
    return (torch.rand(high.shape, generator=generator, dtype=torch.float64) * high).long()


def act(env: CTGraphEnv, action: Tensor | Sequence[int], data: TensorDictBase | None = None) -> TensorDictBase:
    """One step with given actions; what it led to."""
    data = TensorDict(batch_size=env.batch_size) if data is None else data
    return env.step(data.set("action", torch.as_tensor(action)))["next"]


def record(env: CTGraphEnv, actions: Tensor, data: TensorDictBase | None = None) -> TensorDictBase:
    """Data of given actions [steps, N], with finished rows reset; starts with a reset unless data is given."""
    data, steps = env.reset() if data is None else data, []
    for action in actions:
        step, data = env.step_and_maybe_reset(data.set("action", action))
        steps.append(step.clone())
    return torch.stack(steps, dim=1)


def play(env: CTGraphEnv, policy: Policy) -> TensorDictBase:
    """The last data of one episode per row. Rows that end early need an environment with check_actions=False."""
    env.reset()
    last = act(env, policy(env))
    for _ in range(1000):
        if last["done"].all():
            return last
        last = torch.where(last["done"].squeeze(-1), last, act(env, policy(env)))
    raise AssertionError("an episode has not ended after 1000 steps")


def scripts(num_steps: int, num_rows: int, num_actions: int = 3, seed: int = 0) -> Tensor:
    """Random actions [steps, N] in 0..num_actions - 1, half of them waits so that episodes get somewhere."""
    generator = torch.Generator().manual_seed(seed)
    action = torch.randint(num_actions, (num_steps, num_rows), generator=generator)
    return action * torch.randint(2, (num_steps, num_rows), generator=generator)


def tree_step(b: int, d: int, state: TreeState, action: int, stays: bool) -> TreeState:
    """The paper's tree, section 2, by the decisions taken."""
    kind, path = state
    if kind == HOME:
        return WAIT, path
    if kind == WAIT and action == 0:
        return state if stays else (END if len(path) == d else DECISION, path)
    if kind == DECISION and 1 <= action <= b:
        return WAIT, (*path, action)
    return (FAIL, path) if kind in (WAIT, DECISION) else state


def tree_states(b: int, d: int) -> list[TreeState]:
    """Home, and every wait, decision and end state."""
    paths = [path for level in range(d + 1) for path in product(range(1, b + 1), repeat=level)]
    waits = [(WAIT, path) for path in paths]
    return [(HOME, ()), *waits, *((END if len(path) == d else DECISION, path) for path in paths)]


def node_numbers(b: int, d: int) -> dict[tuple[int, ...], int]:
    """Positions of the tree numbered breadth first, the root being 0."""
    paths = [path for level in range(d + 1) for path in product(range(1, b + 1), repeat=level)]
    return {path: number for number, path in enumerate(paths)}


class PlainCTGraph:
    """One row in plain Python, for p = 0 and the needle reward, by the decisions taken."""

    def __init__(self, task: Task) -> None:
        self.task = task
        self.numbers = node_numbers(task.graph.branching_factor, task.graph.depth)
        self.reset()

    def reset(self) -> None:
        self.state: TreeState = (HOME, ())
        self.step_count, self.episode_reward = 0, 0.0

    def step(self, action: int) -> dict[str, bool | int | float]:
        """What the data should hold next, but for the observation."""
        b, d = self.task.graph.branching_factor, self.task.graph.depth
        kind, path = self.state = tree_step(b, d, self.state, action, stays=False)
        at_goal = kind == END and path == self.task.goal
        self.step_count += 1
        self.episode_reward += float(at_goal)
        return {
            "reward": float(at_goal),
            "episode_reward": self.episode_reward,
            "step_count": self.step_count,
            "outcome": 3 if at_goal else {END: 2, FAIL: 1}.get(kind, 0),
            "leaf": self.numbers[path] - len(self.numbers) + b**d if kind == END else -1,
            "done": kind in (END, FAIL),
            "terminated": kind in (END, FAIL),
            "truncated": False,
            "is_init": False,
        }


def binomial_p_value(successes: int, trials: int, prob: float) -> float:
    """Two-sided exact binomial test: twice the smaller tail, at most 1."""
    if successes > trials * prob:
        successes, prob = trials - successes, 1 - prob
    log_odds, log_ways = math.log(prob) - math.log1p(-prob), 0.0
    start = trials * math.log1p(-prob)
    logs = [start]
    for k in range(1, successes + 1):
        log_ways += math.log(trials - k + 1) - math.log(k)
        logs.append(start + log_ways + k * log_odds)
    return min(1.0, 2 * math.fsum(map(math.exp, logs)))


def is_uniform(counts: Sequence[int], alpha: float = ALPHA) -> bool:
    """Whether all counts fit equal probabilities: one exact binomial test each, Bonferroni over all."""
    trials = sum(counts)
    return all(binomial_p_value(count, trials, 1 / len(counts)) >= alpha / len(counts) for count in counts)
