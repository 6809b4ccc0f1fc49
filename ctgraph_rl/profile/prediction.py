"""How much an agent's model knows of what comes next, on episodes of two policies that it did not choose.

One policy acts at random; the other navigates: it waits where it must and decides at random. The agent's behaviour does
not matter.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from ctgraph_rl.agent import Model
from ctgraph_rl.checks import require
from ctgraph_rl.core.graph import WAIT_ACTION, StateType
from ctgraph_rl.env import CTGraphEnv
from ctgraph_rl.learn.collect import collect
from ctgraph_rl.metrics import Undefined
from ctgraph_rl.policies import NavigationPolicy, RandomPolicy
from ctgraph_rl.runs.load import load
from ctgraph_rl.tasks.task import Task

NUM_EPISODES = 256

MOST_STEPS = 64

SEED = 230210887

TOLERANCE = 1e-3


MOST_LETTERS = 300


class KnownBits(NamedTuple):
    """Bits a step, log2 K less those that a predictor needs, for K pairs of observation and reward."""

    value: float  # of the agent; a model that is worse than a uniform guess counts as one
    memoryless: float  # of the best predictor that sees only the observation and the action
    exact: float  # of the exact model
    highest: float  # log2 K


class _Episodes(NamedTuple):
    data: TensorDictBase
    seen: Tensor  # number of the image before the step, int64
    pair: Tensor  # number of the pair of image and reward after it, int64
    runs: Tensor  # whether the step is of the first episode of its row, bool


def known_bits(folder: Path, agent_class: Any, task: Task) -> KnownBits:
    """Return what the trained agent of a run knows.

    Raises:
        Undefined: if it has no ``predict_next``, cannot be loaded, or gives no probabilities.
    """
    no_model = "has no model: its agent has no predict_next"
    if agent_class is not None and not hasattr(agent_class, "predict_next"):
        raise Undefined(no_model)
    try:
        loaded = load(folder, agent_class).agent
        agent: Any = getattr(loaded, "unwrapped", loaded)  # without a method around it
        if not hasattr(agent, "predict_next"):
            raise Undefined(no_model)
        return bits_of_model(agent, task)
    except FileNotFoundError:
        raise Undefined("has no model: a Recorder stores no agent") from None
    except ValueError as error:
        raise Undefined(" ".join(str(error).split())[:MOST_LETTERS]) from error


@torch.no_grad()
def bits_of_model(model: Model, task: Task) -> KnownBits:
    """Return how much a model knows of a task's next observation and reward, and how much can be known.

    All values are means over the same steps of the probability given to what came, so a model with the exact
    probabilities has exactly the exact model's value.

    Args:
        model: an agent with ``predict_next``, as `ctgraph_rl.agent.Model`.
        task: a surjective graph with one image for each kind of state.

    Raises:
        ValueError: for another task, and for values that are no probabilities.
    """
    choices = _choices(task)
    tables = _tables(task, len(choices))
    needed = torch.zeros(3, dtype=torch.float64, device="cpu")
    num_steps = 0
    for policy in (RandomPolicy, NavigationPolicy):
        episodes = _episodes(task, policy, choices)
        for step in range(MOST_STEPS):
            rows = episodes.runs[:, step].nonzero().flatten()
            if not len(rows):
                break
            history = episodes.data[rows][:, : step + 1].clone()
            came = episodes.pair[rows, step]
            log_probs = _checked(model.predict_next(history, choices.clone()), len(rows), len(choices))
            own = log_probs.gather(1, came[:, None]).sum().item() / math.log(2)
            place = _place(task, episodes.seen[rows, : step + 1], history["action"])
            known = tables[:, place, came].log2().sum(1)
            needed += -torch.stack([torch.tensor(own, dtype=torch.float64, device="cpu"), *known])
            num_steps += len(rows)
    highest = math.log2(len(choices))
    own, memoryless, exact = (highest - needed / num_steps).tolist()
    return KnownBits(max(own, 0.0), memoryless, exact, highest)


def _choices(task: Task) -> TensorDictBase:
    """Return all pairs of an image and a reward, 0 or the goal's, [images * 2]."""
    x = task.observations
    single = all(first == last for first, last in map(x.ids, StateType))
    plain = (task.goal_reward, task.fail_reward, task.step_reward, task.reward_std) == (1, 0, 0, 0)
    require((single and plain, "a model is scored on a surjective graph whose goal pays 1"))
    images = task.images.bank(0)[: x.last_id + 1]
    rewards = torch.tensor([0.0, 1.0], dtype=torch.float32, device="cpu").repeat(len(images))
    observations = images.repeat_interleave(2, 0)
    return TensorDict({"observation": observations, "reward": rewards}, [len(rewards)])


def _episodes(task: Task, policy: type[RandomPolicy], choices: TensorDictBase) -> _Episodes:
    env = CTGraphEnv([task] * NUM_EPISODES, SEED)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(SEED)
        [batch] = collect(env, policy(env), NUM_EPISODES * MOST_STEPS, MOST_STEPS)
    after = batch["next"]
    reward = after["reward"].squeeze(-1)
    seen = _numbers(batch["observation"], choices)
    pair = 2 * _numbers(after["observation"], choices) + reward.long()
    before = torch.cat([torch.zeros_like(reward[:, :1]), reward[:, :-1]], 1)
    data = batch.select("observation", "action").set("reward", before)
    ended = after["done"].squeeze(-1).long().cumsum(1)
    runs = torch.cat([torch.zeros_like(ended[:, :1]), ended[:, :-1]], 1) == 0
    return _Episodes(data, seen, pair, runs)


def _numbers(observation: Tensor, choices: TensorDictBase) -> Tensor:
    images = choices["observation"][::2].flatten(1)
    flat = observation.flatten(2)
    return (flat[:, :, None] == images).all(-1).long().argmax(-1)


def _checked(log_probs: Any, num_rows: int, num_choices: int) -> Tensor:
    shape = list(log_probs.shape) if isinstance(log_probs, Tensor) else type(log_probs).__name__
    rule = f"predict_next must return log-probabilities, float [{num_rows}, {num_choices}]"
    require((shape == [num_rows, num_choices], f"{rule}, got {shape}"))
    log_probs = log_probs.double().cpu()
    sums = log_probs.exp().sum(1)
    off = (sums - 1).abs().max().item()
    require((off <= TOLERANCE, f"{rule} of probabilities that sum to 1 in each row, got sums off by {off:.3g}"))
    return log_probs - sums.log()[:, None]


def _place(task: Task, seen: Tensor, action: Tensor) -> Tensor:
    """Return the row of `_tables` of each row's last step, int64 [rows].

    Args:
        seen: numbers of images, [rows, steps].
        action: [rows, steps].
    """
    depth = task.graph.depth
    goal = torch.tensor(task.goal_decisions, dtype=torch.int64, device="cpu")
    decided = (seen == task.observations.decision_ids[0]) & (action != WAIT_ACTION)
    before = decided[:, :-1]
    level = before.sum(1)
    order = (before.cumsum(1) - 1).clamp(0, depth - 1)
    wrong = (before & (action[:, :-1] != goal[order])).any(1)
    waits = action[:, -1] == WAIT_ACTION
    return ((seen[:, -1] * 2 + waits) * (depth + 1) + level) * 2 + wrong


def _tables(task: Task, num_pairs: int) -> Tensor:
    """Return the probabilities of what comes next, float64 [2, images * 2 * (depth + 1) * 2, pairs].

    The first are those of the best memoryless predictor, the second those of the exact model. Rows count image, whether
    the action waits, level and whether a decision was wrong, the last fastest.
    """
    x = task.observations
    depth = task.graph.depth
    p = task.graph.wait_prob
    home = x.home_ids[0]
    fail = 2 * x.fail_ids[0]
    wait = 2 * x.wait_ids[0]
    decision = 2 * x.decision_ids[0]
    end = 2 * x.end_ids[0]
    exact = torch.zeros(num_pairs // 2, 2, depth + 1, 2, num_pairs, dtype=torch.float64, device="cpu")
    exact[home, :, :, :, wait] = 1
    exact[decision // 2, 1, :, :, fail] = 1
    exact[decision // 2, 0, :, :, wait] = 1
    exact[wait // 2, 0, :, :, fail] = 1
    exact[wait // 2, 1, :, :, wait] = p
    exact[wait // 2, 1, :depth, :, decision] = 1 - p
    exact[wait // 2, 1, depth, 0, end + 1] = 1 - p
    exact[wait // 2, 1, depth, 1, end] = 1 - p
    memoryless = exact.clone()
    at_last = _share_at_last_level(task)
    at_goal = task.graph.branching_factor**-depth
    memoryless[wait // 2, 1, :, :, decision] = (1 - p) * (1 - at_last)
    memoryless[wait // 2, 1, :, :, end + 1] = (1 - p) * at_last * at_goal
    memoryless[wait // 2, 1, :, :, end] = (1 - p) * at_last * (1 - at_goal)
    return torch.stack([memoryless, exact]).flatten(1, -2)


def _share_at_last_level(task: Task) -> float:
    """Return the share of waits at a wait state that are at the last one.

    Each policy has as many episodes. One that waits with probability a leaves a wait state with probability w = a (1 -
    p) / (1 - a p), and waits there a / (1 - a p) times. It decides with probability c.
    """
    b = task.graph.branching_factor
    p = task.graph.wait_prob
    depth = task.graph.depth
    last = 0.0
    total = 0.0
    for waits, decides in ((1 / (b + 1), b / (b + 1)), (1.0, 1.0)):
        leaves = waits * (1 - p) / (1 - waits * p)
        times = [(leaves * decides) ** level * waits / (1 - waits * p) for level in range(depth + 1)]
        last += times[depth]
        total += sum(times)
    return last / total
