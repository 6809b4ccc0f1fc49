"""Tasks of every kind that a batch may mix, and strategies that draw any legal tasks."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from torch import Tensor

from ctgraph_rl import (
    CTGraph,
    CTGraphEnv,
    Curriculum,
    Gradient,
    GroupedImages,
    Needle,
    Observations,
    OneHot,
    PaperImages,
    ReferenceImages,
    ReferenceLinear,
    ReferenceOneHot,
    Rows,
    Task,
)
from ctgraph_rl.core.graph import StateType
from ctgraph_rl.tasks.switch import Switch
from helpers.oracles import (
    DECISION,
    END,
    FAIL,
    HOME,
    WAIT,
    confounding,
    fully_observable,
    one_hot,
    scripts,
    surjective,
)

LEGACY = {"legacy_index": True, "noise_before_rotation": True, "reward_cue": True, "cue_wraps": True}


def unique(b, d, p=0.0, room=0, goal=None, waits=True, decisions=True, images=OneHot, **variation) -> Task:
    """Ranges of exactly as many ids as there are states, and room for more."""
    graph, first, ranges = CTGraph(b, d, p), 2, []
    for count in (graph.num_wait_states, graph.num_decision_states, graph.num_end_states):
        ranges.append((first, first + count + room - 1))
        first += count + room
    x = Observations(*ranges, unique_waits=waits, unique_decisions=decisions, **variation)
    return Task(graph, goal or (1,) * d, x, images(first))


def read(d=2, p=0.0, episodes=(-1, -1), **shown) -> Task:
    """A task of a configuration file in which ids are drawn, or what ``shown`` says."""
    content = {
        "graph_shape": {"d": d, "b": 2, "p": p},
        "reward": {"high_r": 1.0, "fail_r": 0.0, "std_r": 0.0, "reward_distribution": "needle_in_haystack"}
        | dict(zip(("min_static_reward_episodes", "max_static_reward_episodes"), episodes, strict=True)),
        "observations": {"MDP_D": False, "MDP_W": False, "W_IDs": [2, 6], "D_IDs": [7, 9], "graph_ends": [10, 13]}
        | shown,
        "image_dataset": {"seed": 1, "1D": False, "nr_of_images": 64, "noise_on_read": 0, "rotation_on_read": 1},
    }
    return Task.from_json(content, goal=(1,) * d)


def legacy_number(b: int, path: tuple[int, ...]) -> int:
    """The digits of the path after a leading 1, read in base b, less one."""
    return int("1" + "".join(str(a - 1) for a in path), b) - 1


FIELDS = {"reward_fn": ReferenceLinear(), "goal_reward": 2.0, "fail_reward": -0.5, "goal_change": (1, 3)}

READ = {"read_noise": 30, "read_rotation": 45}

SWITCHED = [
    replace(unique(3, 2, 0.3, images=PaperImages, **READ, **LEGACY), **FIELDS, extra_end_step=True),
    replace(unique(4, 2, images=PaperImages, legacy_index=True), extra_end_step=True, step_reward=-0.25),
    replace(unique(2, 3, 0.5, 5, decisions=False, images=PaperImages, **LEGACY), goal_change=(2, 2)),
    replace(
        confounding(p=0.9, read_noise=9, read_rotation=359, **LEGACY),
        extra_end_step=True,
        goal_change=(1, 1),
        legacy_goal_change=True,
    ),
    replace(confounding(3, 2, reward_cue=True, **READ), goal_change=(1, 2)),
    replace(read(), **FIELDS | {"goal_change": None}, images=ReferenceImages(64, 2, noise=10.5)),
    replace(read(), observations=Observations((2, 4), (5, 5), (6, 9), (10, 12), (13, 14), unique_ends=True, **LEGACY)),
    surjective(2, 3, goal=(2, 1, 2)),
    unique(3, 2, 0.5, images=PaperImages, read_rotation=7),
]

VECTORS = [
    replace(unique(3, 2, 0.3, images=ReferenceOneHot, **LEGACY), **FIELDS, legacy_goal_change=True),
    replace(unique(2, 1, images=ReferenceOneHot, reward_cue=True), reward_fn=ReferenceLinear()),
    replace(confounding(), images=OneHot(16), extra_end_step=True),
    replace(confounding(reward_cue=True), images=ReferenceOneHot(20), step_reward=0.5),
]


def seen(rows: Rows, actions: Tensor) -> list[Tensor]:
    """All that rows show, and their rewards, under a script with finished rows reset: [steps, N, ...] each."""
    shown, data = rows.reset(), []
    for action in actions:
        begins = rows.reset(shown.done).observation
        shown = rows.step(action)
        data.append([begins, *shown, rows.reward])
    return [torch.stack(part) for part in zip(*data, strict=True)]


RICH = [
    replace(confounding(p=0.5, read_noise=9, read_rotation=5, reward_cue=True), goal_change=(2, 3), step_reward=0.5),
    replace(surjective(3, 2, p=0.2, goal=(3, 1), image_seed=2), reward_fn=Gradient(), reward_std=0.3, fail_reward=-1),
    surjective(2, 1, goal=(2,), image_seed=3),
]
"""Tasks that differ in all that a batch may mix."""


def env_of(
    tasks: list[Task], switch: Switch | None, num_rows: int = 6, seed: int = 3, first_row: int = 0
) -> CTGraphEnv:
    """An environment whose rows change between tasks and show the number of theirs."""
    ids = {task: number for number, task in enumerate(tasks)}
    env = CTGraphEnv(tasks[:1] * num_rows, seed, first_row, tasks, task_ids=ids)
    if switch is not None:
        env.switch_tasks(tasks, switch)
    return env


FILE = {
    "general_seed": 3,
    "graph_shape": {"d": 2, "b": 3, "p": 0.2},
    "reward": {
        "high_r": 1.0,
        "fail_r": -0.1,
        "std_r": 0.2,
        "reward_distribution": "linear",
        "min_static_reward_episodes": 2,
        "max_static_reward_episodes": 4,
    },
    "observations": {"MDP_D": True, "MDP_W": False, "W_IDs": [2, 4], "D_IDs": [5, 8], "graph_ends": [9, 17]},
    "image_dataset": {"seed": 1, "1D": False, "nr_of_images": 18, "noise_on_read": 9, "rotation_on_read": 8},
}

MIXED = [
    confounding(p=0.5, read_noise=20, read_rotation=5, reward_cue=True),
    replace(surjective(3, 3, 0.3), reward_fn=Gradient(), step_reward=0.01, goal_change=(1, 3)),
    replace(fully_observable(2, 3), reward_fn=ReferenceLinear(), reward_std=0.5, fail_reward=-1.0),
    Task.from_json(FILE, goal=(1, 2)),
]

FAMILIES = {
    "surjective": [surjective()],
    "fully observable": [fully_observable(2, 3, 0.5)],
    "confounding": [confounding(p=0.5)],
    "rotation": [surjective(read_rotation=9)],
    "noise": [surjective(read_noise=10)],
    "one-hot": [one_hot(p=0.5)],
    "reference": [Task.from_json(FILE, goal=(1, 2))],
    "mixed": MIXED,
    "swapped": [
        replace(fully_observable(3, 2, 0.5), swapped_branches=((2,), (1, 3))),
        replace(surjective(2, 3, 0.2, goal=(1, 2, 2)), swapped_branches=((), (1, 2)), reward_fn=Gradient()),
        surjective(2, 2),
    ],
}


def calls(num_calls: int, num_rows: int, seed: int = 0) -> list[tuple[str, tuple[Tensor, ...]]]:
    """Steps with all kinds of resets in between; the first is a reset of all rows."""
    generator = torch.Generator().manual_seed(seed)
    made = [("reset", (torch.ones(num_rows, dtype=torch.bool),))]
    for action, kind in zip(scripts(num_calls, num_rows, 4, seed), scripts(num_calls, 1, 8, seed + 1), strict=True):
        mask = torch.rand(num_rows, generator=generator) < 0.3
        steps = {5: ("reset", (mask,)), 6: ("restart", (mask,)), 7: ("step_or_reset", (action, mask))}
        made.append(steps.get(kind.item(), ("step", (action,))))
    return made


# Any legal tasks


KINDS, NAN, INF = (WAIT, DECISION, END), math.nan, math.inf

DEEP = [(2, 40), (3, 30), (2, 60), (4, 29)]

seeds, flips = st.integers(0, 2**63 - 1), st.booleans()

rewards = st.integers(-3, 3) | st.integers(-300, 300).map(lambda k: k / 100)


def examples(count: int) -> Any:
    """So many examples, the same ones at every run."""
    return settings(max_examples=count, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))


def counts_of(b: int, d: int) -> dict[StateType, int]:
    """How many states of each kind there are, level by level."""
    decisions = sum(b**level for level in range(d))
    return {HOME: 1, WAIT: decisions + b**d, DECISION: decisions, END: b**d, FAIL: 1}


@st.composite
def graphs(draw: Any) -> CTGraph:
    if draw(st.integers(0, 4)) == 4:
        return CTGraph(*draw(st.sampled_from(DEEP)), draw(st.sampled_from([0.0, 0.2])))
    p = draw(st.sampled_from([0, 0.0, 0.5, 0.9, 0.95]) | st.integers(0, 95).map(lambda k: k / 100))
    return CTGraph(draw(st.integers(2, 4)), draw(st.integers(1, 4)), p)


@st.composite
def observations(draw: Any, graph: CTGraph, one_hot: bool) -> Observations:
    """Ids for each kind of state in any order, with gaps."""
    counts, ids, start = counts_of(graph.branching_factor, graph.depth), {}, 0
    unique = {kind: counts[WAIT] <= 100 and draw(flips) for kind in KINDS}
    for kind in draw(st.permutations(tuple(StateType))):
        first = start + draw(st.integers(0, 2))
        start = first + (counts[kind] if unique.get(kind) else 1) + draw(st.integers(0, 3))
        ids[f"{kind.name.lower()}_ids"] = (first, start - 1)
    flags = {f"unique_{kind.name.lower()}s": unique[kind] for kind in KINDS}
    if unique[END] == (unique[WAIT] or unique[DECISION]) and draw(flips):
        flags["unique_ends"] = None
    if one_hot or draw(flips):
        return Observations(**ids, **flags)
    noise, turn = draw(st.sampled_from([0, 1, 30, 255])), draw(st.sampled_from([0, 1, 7, 359 if start < 20 else 3]))
    return Observations(**ids, **flags, read_noise=noise, read_rotation=turn, reward_cue=draw(flips))


@st.composite
def tasks(draw: Any, size: int | None) -> Task:
    """A legal task with images of a size, or one-hot for None."""
    graph = draw(graphs())
    x = draw(observations(graph, size is None))
    room, seed = x.last_id + 1 + draw(st.integers(0, 2)), draw(st.integers(0, 3))
    kinds = [PaperImages(room, seed, size or 4), GroupedImages((1, room - 1), 0.2, 0.3, seed, size or 4)]
    decision = st.integers(1, graph.branching_factor)
    return Task(
        graph,
        tuple(draw(st.lists(decision, min_size=graph.depth, max_size=graph.depth))),
        x,
        OneHot(room) if size is None else draw(st.sampled_from(kinds)),
        draw(st.sampled_from([Needle(), Gradient(), ReferenceLinear()])),
        goal_reward=abs(draw(rewards)) + 0.01 if x.reward_cue else draw(rewards),
        fail_reward=draw(rewards),
        step_reward=draw(st.sampled_from([0.0, 0.0, -0.25, 0.1])),
        reward_std=draw(st.sampled_from([0.0, 0.0, 0.5])),
        reward_noise=draw(st.sampled_from(["additive", "multiplicative"])),
        goal_change=draw(st.sampled_from([None, None, (1, 1), [2, 3]])),
    )


def batches(least: int = 1) -> Any:
    """Legal tasks whose observations have one shape, or are one-hot."""
    return st.sampled_from([None, 4, 8, 12, 16]).flatmap(lambda size: st.lists(tasks(size), min_size=least, max_size=4))


def extra(task: Task, **fields) -> Task:
    return replace(task, extra_end_step=True, **fields)


def switching(tasks: list[Task], switch: Switch, num_rows: int, **arguments: Any) -> Rows:
    """Rows that change between tasks."""
    rows = Rows(tasks[:1] * num_rows, task_pool=tasks, **arguments)
    rows.switch_tasks(tasks, switch)
    return rows


def started(rows: Rows, num_episodes: int) -> Tensor:
    """The tasks' numbers in as many episodes, each ended by the start of the next: int64 [episodes, rows]."""
    return torch.stack([(rows.restart(), rows.task)[1] for _ in range(num_episodes)])


EVERY_KIND = FAMILIES | {
    "switched": list(SWITCHED),
    "vectors": list(VECTORS),
    "wide": [replace(surjective(70, 1, 0.2), goal_change=(1, 2)), *MIXED],
    "deep": [replace(surjective(2, 40), goal_change=(1, 1), step_reward=-0.0), confounding(3, 20, 0.5)],
    "unpaid": [replace(fully_observable(), goal_reward=-1.0, fail_reward=-0.0)],
}


def batch(tasks: list[Task], num_rows: int) -> list[Task]:
    return (tasks * num_rows)[:num_rows]


def likely(tasks: list[Task], num_steps: int, seed: int = 0) -> Tensor:
    """Actions [steps, N], half of them on the way to the tasks' own goals as long as nobody waits twice."""
    rng = np.random.default_rng(seed)
    ways = [np.array([0, *(x for decision in task.goal for x in (0, decision)), 0, 0]) for task in tasks]
    best = [np.resize(way, num_steps) for way in ways]
    largest = 1 + max(task.graph.branching_factor for task in tasks)
    other = rng.integers(0, largest, (num_steps, len(tasks)))
    return torch.from_numpy(np.where(rng.random(other.shape) < 0.9, np.stack(best, 1), other))


def listing(curriculum: Curriculum) -> list[str]:
    """The blocks as image seed and goal, counted from 0 as the labs do."""
    tasks = [task for block in curriculum.blocks for task in block.tasks]
    return [f"{task.image_seed}:{''.join(str(decision - 1) for decision in task.goal)}" for task in tasks]
