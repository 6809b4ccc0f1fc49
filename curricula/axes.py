"""The axes along which tasks differ, and the ways to put tasks in order.

An axis takes a task, or several, and returns the variations of each, those of the first task first. So axes combine:
``all_goals(image_seeds(task, (1, 2)))`` is every goal with the images of seed 1, then with those of seed 2. `sequence`
makes a `Curriculum`.
"""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields, replace
from math import prod
from typing import Any

from ctgraph_rl.checks import NamedValues, as_tuple, is_int, require, require_all, takes_numbers
from ctgraph_rl.core.goal import Goal
from ctgraph_rl.core.graph import CTGraph, StateType
from ctgraph_rl.tasks.configurations import observations_of
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.images import ImageSet, PaperImages
from ctgraph_rl.tasks.protocol import MOST_TASKS, Block, Evaluation, Protocol, count_rule
from ctgraph_rl.tasks.switch import Switch
from ctgraph_rl.tasks.task import Task
from curricula.draws import below, different, generator, shuffled

MOVABLE = ("home", "fail", "wait", "decision", "end")

Tasks = tuple[Task, ...]
OneOrMore = Task | Iterable[Task]

MOST_TIMES = 100_000


def as_tasks(tasks: OneOrMore) -> Tasks:
    """A task or several as a tuple.

    Raises:
        ValueError: for anything else, and for no task.
    """
    return (tasks,) if isinstance(tasks, Task) else require_all(Task, "tasks", tasks)


def each(tasks: OneOrMore, vary: Callable[[Task], Iterable[Task]]) -> Tasks:
    """Return the variations of each task, those of the first task first."""
    return tuple(itertools.chain.from_iterable(map(vary, as_tasks(tasks))))


# goal location


def all_goals(tasks: OneOrMore) -> Tasks:
    """Every goal of each task's graph, in lexicographic order."""
    return goals_sharing(tasks, 0)


@takes_numbers
def given_goals(tasks: OneOrMore, goals: Iterable[Goal]) -> Tasks:
    """Each task with each of the goals.

    Args:
        tasks: a task or several.
        goals: decisions in 1..b, as many as the graph is deep, such as ``["1.2", "2.1"]``.
    """
    listed = as_tuple(goals)
    if not isinstance(listed, tuple) or not listed:
        raise ValueError(f"goals must be a list of goals such as [1.2, 2.1], got {goals!r}")
    return each(tasks, lambda task: [replace(task, goal=goal) for goal in listed])


@takes_numbers
def goals_sharing(tasks: OneOrMore, num_decisions: int) -> Tasks:
    """Every goal that shares its first ``num_decisions`` in 0..d with the task's own, in lexicographic order."""

    varied = as_tasks(tasks)
    count = 0
    for task in varied:
        d = task.graph.depth
        require((is_int(num_decisions, 0, d), f"num_decisions must be in 0..{d}, the depth, got {num_decisions!r}"))
        count += task.graph.branching_factor ** (d - num_decisions)
    require(count_rule(count))

    def vary(task: Task) -> Iterable[Task]:
        branches = range(1, task.graph.branching_factor + 1)
        ends = itertools.product(branches, repeat=task.graph.depth - num_decisions)
        return (replace(task, goal=task.goal[:num_decisions] + end) for end in ends)

    return each(varied, vary)


@takes_numbers
def random_goals(tasks: OneOrMore, num_goals: int, seed: int) -> Tasks:
    """Different goals drawn uniformly, the same for graphs of one shape.

    Args:
        num_goals: at most b^d.
        seed: an integer >= 0.
    """

    def vary(task: Task) -> list[Task]:
        graph = task.graph
        source = generator(seed)
        _check_draws("num_goals", num_goals, graph.num_end_states)
        return different(num_goals, lambda: replace(task, goal=_random_goal(graph, source)))

    return each(tasks, vary)


# input distribution


@takes_numbers
def image_seeds(tasks: OneOrMore, seeds: Iterable[int]) -> Tasks:
    """Each task with the image sets of other seeds."""
    listed = require_all(int, "seeds", seeds)

    def vary(task: Task) -> list[Task]:
        require((task.image_seed is not None, f"image seeds need generated images, got {task.images!r}"))
        return [replace(task, images=replace(task.images, seed=seed)) for seed in listed]  # type: ignore[type-var]

    return each(tasks, vary)


@takes_numbers
def new_images(tasks: OneOrMore, num_sets: int, kinds: Sequence[str] = ("decision",)) -> Tasks:
    """Each task, and again with new images for some kinds of states: the paper's variant and invariant features.

    Generated sets grow to the longest that is needed, so that the other images look the same in all tasks.

    Args:
        num_sets: sets of images, the task's own included.
        kinds: the states whose images change, some of home, fail, wait, decision and end.
    """
    moved = require_all(str, "kinds", kinds)
    unknown = [kind for kind in moved if kind not in MOVABLE]
    require(
        (not unknown, f"kinds must be some of {', '.join(MOVABLE)}, got {', '.join(unknown)}"),
        (is_int(num_sets, 1, MOST_TASKS), f"num_sets must be an integer >= 1, got {num_sets!r}"),
    )

    def vary(task: Task) -> list[Task]:
        x = task.observations
        ranges = {f"{kind}_ids": x.ids(StateType[kind.upper()]) for kind in moved}
        first = min(low for low, _ in ranges.values())
        size = max(high for _, high in ranges.values()) + 1 - first
        shift = x.last_id + 1 - first
        shown = [x]
        for _ in range(num_sets - 1):
            ids: NamedValues = {name: (low + shift, high + shift) for name, (low, high) in ranges.items()}
            shown.append(replace(x, **ids))
            shift += size
        images = _with_room(task.images, max(observations.last_id for observations in shown) + 1)
        return [replace(task, observations=observations, images=images) for observations in shown]

    return each(tasks, vary)


# shape


@takes_numbers
def growing_depth(tasks: OneOrMore, depths: Iterable[int]) -> Tasks:
    """The graph of each task cut to other depths, all with the id ranges of the deepest: no image changes role.

    A goal is the first decisions of the task's goal, on the path of every deeper one.

    Args:
        tasks: the deepest graph with its goal, or several.
        depths: each at most the graph's own.
    """
    listed = require_all(int, "depths", depths)

    def vary(task: Task) -> list[Task]:
        deepest = task.graph.depth
        bad = [depth for depth in listed if not is_int(depth, 1, deepest)]
        require((not bad, f"depths must be in 1..{deepest}, the depth of the task, got {bad}; give a deeper task"))
        return [replace(task, graph=replace(task.graph, depth=depth), goal=task.goal[:depth]) for depth in listed]

    return each(tasks, vary)


@takes_numbers
def wait_probs(tasks: OneOrMore, probs: Iterable[float]) -> Tasks:
    """Each task with other wait probabilities, in [0, 1)."""
    listed = tuple(probs)
    return each(tasks, lambda task: [replace(task, graph=replace(task.graph, wait_prob=p)) for p in listed])


# observability


@takes_numbers
def reshaped(task: Task, graph: CTGraph, kind: str, goal: Goal, num_wait_images: int = 100) -> Task:
    """A task on another graph, of which more or less of the state is seen.

    Args:
        task: with enough images or a generated set, which is made long enough.
        kind: ``full``, ``decisions``, ``surjective`` or ``confounding``, as in
            `ctgraph_rl.tasks.configurations.observations_of`.
        num_wait_images: for ``confounding``.
    """
    observations = observations_of(graph, kind, num_wait_images)
    images = _with_room(task.images, observations.last_id + 1, exact=True)
    return replace(task, graph=graph, goal=goal, observations=observations, images=images)  # type: ignore[arg-type]


# random graphs


@takes_numbers
def random_tasks(
    num_tasks: int,
    seed: int,
    branching_factors: Sequence[int] = (2, 3),
    depths: Sequence[int] = (2, 3, 4),
    wait_probs: Sequence[float] = (0.0, 0.5),
    kinds: Sequence[str] = ("full",),
    image_seeds: Sequence[int] = tuple(range(1, 101)),
) -> Tasks:
    """Different tasks on random graphs: each choice is uniform and independent, then a uniform goal.

    Args:
        seed: an integer >= 0.
        branching_factors: choices of b.
        depths: choices of d.
        wait_probs: choices of p.
        kinds: choices of what is seen, as in `reshaped`.
        image_seeds: choices of the image seed.
    """
    given: tuple[Sequence[Any], ...] = (branching_factors, depths, wait_probs, kinds, image_seeds)
    choices = [tuple(dict.fromkeys(choice)) for choice in given]
    rule = "branching_factors, depths, wait_probs, kinds and image_seeds need at least one choice each"
    require((all(choices), rule))
    goals = sum(CTGraph(b, d).num_end_states for b, d in itertools.product(*choices[:2]))
    _check_draws("num_tasks", num_tasks, goals * prod(map(len, choices[2:])))
    source = generator(seed)

    def draw() -> Task:
        b, d, p, kind, image_seed = (choice[below(source, len(choice))] for choice in choices)
        graph = CTGraph(b, d, p)
        observations = observations_of(graph, kind)
        goal = _random_goal(graph, source)
        return Task(graph, goal, observations, PaperImages(observations.last_id + 1, image_seed))

    return tuple(different(num_tasks, draw))


def _check_draws(name: str, wanted: object, available: int) -> None:
    most = min(available, MOST_TASKS)
    require((is_int(wanted, 1, most), f"{name} must be in 1..{most}, as many as differ, got {wanted!r}"))


def _random_goal(graph: CTGraph, source: random.Random) -> tuple[int, ...]:
    return tuple(1 + below(source, graph.branching_factor) for _ in range(graph.depth))


def _with_room(images: ImageSet, num_images: int, exact: bool = False) -> ImageSet:
    settable = "num_images" in {field.name for field in fields(images) if field.init}  # type: ignore[arg-type]
    fits = images.num_images == num_images if exact else images.num_images >= num_images
    return images if fits or not settable else replace(images, num_images=num_images)  # type: ignore


# order


def concatenate(*sequences: OneOrMore) -> Tasks:
    """One sequence after the other."""
    return tuple(itertools.chain.from_iterable(map(as_tasks, sequences)))


def interleave(*sequences: OneOrMore) -> Tasks:
    """The first task of each sequence, then the second of each; ended sequences are left out.

    Example:
        >>> from ctgraph_rl.tasks.configurations import ct_su_b1
        >>> a, b, c = (ct_su_b1(goal=goal) for goal in ("1.1", "1.2", "2.1"))
        >>> [task.goal for task in interleave((a, b), c)]
        [(1, 1), (2, 1), (1, 2)]
    """
    rounds = itertools.zip_longest(*map(as_tasks, sequences))
    return tuple(filter(None, itertools.chain.from_iterable(rounds)))


@takes_numbers
def cycle(tasks: OneOrMore, times: int) -> Tasks:
    """The whole sequence several times: A B A B."""
    require((is_int(times, 1, MOST_TIMES), f"times must be an integer >= 1, got {times!r}"))
    return as_tasks(tasks) * times


@takes_numbers
def shuffle(tasks: OneOrMore, seed: int) -> Tasks:
    """The tasks in a uniformly random order; the seed is >= 0."""
    return tuple(shuffled(as_tasks(tasks), seed))


def reverse(tasks: OneOrMore) -> Tasks:
    """The last task first."""
    return as_tasks(tasks)[::-1]


@takes_numbers
def sequence(
    name: str,
    tasks: Iterable[OneOrMore],
    num_frames: int | Sequence[int],
    version: int = 1,
    source: str = "",
    protocol: Protocol | None = None,
    evaluation: Evaluation | None = None,
    switch: Switch | None = None,
) -> Curriculum:
    """A curriculum with a block for each item.

    Args:
        name: as cited.
        tasks: a task, or several that share a block, for each block.
        num_frames: of every block, or a list with those of each.
        version: rises when the content changes.
        source: where the sequence comes from.
        protocol: None: no task ids, announced boundaries.
        evaluation: None: the defaults of `Evaluation`.
        switch: how rows change between the tasks of a block.
    """
    items = [tasks] if isinstance(tasks, Task) else list(tasks)
    frames = as_tuple(num_frames)
    budgets = frames if isinstance(frames, tuple) else (num_frames,) * len(items)
    require((len(budgets) == len(items), f"num_frames must be one for each of {len(items)} blocks, got {len(budgets)}"))
    blocks = tuple(Block(as_tasks(item), n, switch) for item, n in zip(items, budgets, strict=True))
    return Curriculum(name, version, source, blocks, evaluation or Evaluation(), protocol=protocol or Protocol())
