"""Hypothesis strategies of any legal tasks."""

from __future__ import annotations

import math
from typing import Any

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from ctgraph_rl import CTGraph, Gradient, Needle, Observations, OneHot, PaperImages, ReferenceLinear, Task
from ctgraph_rl.core.graph import StateType
from ctgraph_rl.tasks.images import GroupedImages
from helpers.oracles import DECISION, END, FAIL, HOME, WAIT

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
