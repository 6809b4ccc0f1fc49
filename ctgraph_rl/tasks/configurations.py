"""The baseline configurations of the CT-graph paper, tasks of any size in their manner, and tasks by keywords.

Soltoggio et al. 2023 (arXiv 2302.10887).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from difflib import get_close_matches
from inspect import signature
from os import PathLike
from typing import Any

from ctgraph_rl.checks import NamedValues, did_you_mean, is_int, require, takes_numbers
from ctgraph_rl.core.goal import Goal
from ctgraph_rl.core.graph import CTGraph
from ctgraph_rl.tasks.images import OneHot, PaperImages
from ctgraph_rl.tasks.observations import Observations
from ctgraph_rl.tasks.paper_json import shown_ids
from ctgraph_rl.tasks.task import Task

OBSERVABILITY = ("full", "decisions", "surjective", "confounding")
"""How much of its state a task shows, as in `observations_of`."""


@takes_numbers
def ct_graph(
    branching_factor: int = 2,
    depth: int = 2,
    wait_prob: float = 0.0,
    goal: Goal | None = None,
    fully_observable: bool = True,
    one_hot: bool = False,
    image_seed: int = 1,
) -> Task:
    """A task of any size, observed fully or through one image for each kind of state.

    Args:
        branching_factor: b >= 2.
        depth: d >= 1.
        wait_prob: p in [0, 1).
        goal: d decisions in 1..b, such as ``"1.2"``; None: all 1.
        fully_observable: an image for each state; False: surjective, images 0 to 4 for home, fail, decision, wait and
            end.
        one_hot: vectors instead of images.
    """
    graph = CTGraph(branching_factor, depth, wait_prob)
    observations = observations_of(graph, "full" if fully_observable else "surjective")
    num_images = observations.last_id + 1
    images = OneHot(num_images) if one_hot else PaperImages(num_images, image_seed)
    return Task(graph, (1,) * depth if goal is None else goal, observations, images)  # type: ignore[arg-type]


@takes_numbers
def observations_of(graph: CTGraph, kind: str, num_wait_images: int = 100) -> Observations:
    """Return observations with ids from 2: waits, decisions, ends if states have their own, else decisions first.

    Args:
        kind: ``full``, an id for each state; ``decisions``, as full but one id for all wait states; ``surjective``, one
            id for each kind of state; ``confounding``, as surjective but wait states draw one of several ids.
        num_wait_images: for ``confounding``.

    Raises:
        ValueError: for an unknown kind, or no wait images.
    """
    require(
        (kind in OBSERVABILITY, f"kinds must be some of {', '.join(OBSERVABILITY)}, got {kind!r}"),
        (is_int(num_wait_images, 1), f"num_wait_images must be an integer >= 1, got {num_wait_images!r}"),
    )
    if kind == "confounding":
        return shown_ids(graph, False, False, wait_ids=(3, 2 + num_wait_images), decision_ids=(2, 2))
    return shown_ids(graph, kind == "full", kind in ("full", "decisions"))


def ct_fo_b1(goal: Goal = "1.1", image_seed: int = 1) -> Task:
    """CT-FO-B1: fully observable, b=2, d=2, p=0; one of 16 images for each state.

    Args:
        goal: two decisions in 1..2, such as ``"1.2"``.
    """
    return ct_graph(2, 2, 0.0, goal, image_seed=image_seed)


def ct_fo_b2(goal: Goal = "1.1.1", image_seed: int = 1) -> Task:
    """CT-FO-B2: fully observable, b=2, d=3, p=0.5; one of 32 images for each state.

    Args:
        goal: three decisions in 1..2, such as ``"1.2.1"``.
    """
    return ct_graph(2, 3, 0.5, goal, image_seed=image_seed)


def ct_su_b1(goal: Goal = "1.1", image_seed: int = 1) -> Task:
    """CT-SU-B1: surjective, b=2, d=2, p=0; one image for all decision states, one for all wait states.

    The paper's D_IDs=[2,2] and W_IDs=[3,3].

    Args:
        goal: two decisions in 1..2, such as ``"1.2"``.

    Example:
        >>> ct_su_b1(goal="2.1").memoryless_ceiling()
        0.25
    """
    return ct_graph(2, 2, 0.0, goal, fully_observable=False, image_seed=image_seed)


def ct_co_b1(goal: Goal = "1.1", image_seed: int = 1) -> Task:
    """CT-CO-B1: confounding, b=2, d=2, p=0; wait states draw one of a hundred images at every observation.

    The paper's D_IDs=[2,2] and W_IDs=[3,102].

    Args:
        goal: two decisions in 1..2, such as ``"1.2"``.
    """
    graph = CTGraph(2, 2, 0.0)
    shown = observations_of(graph, "confounding")
    return Task(graph, goal, shown, PaperImages(104, image_seed))  # type: ignore[arg-type]


def ct_posr_b1(goal: Goal = "1.1", image_seed: int = 1) -> Task:
    """CT-POSR-B1: partially observable sparse reward, b=2, d=2, p=0.5; the images of CT-SU-B1.

    The paper's D_IDs=[2,2] and W_IDs=[3,3]. Rewards have no noise.

    Args:
        goal: two decisions in 1..2, such as ``"1.2"``.
    """
    return ct_graph(2, 2, 0.5, goal, fully_observable=False, image_seed=image_seed)


CONFIGURATIONS: dict[str, Callable[..., Task]] = {
    "CT-FO-B1": ct_fo_b1,
    "CT-FO-B2": ct_fo_b2,
    "CT-SU-B1": ct_su_b1,
    "CT-CO-B1": ct_co_b1,
    "CT-POSR-B1": ct_posr_b1,
}

Json = str | PathLike[str] | Mapping[str, Any]


class UnknownFieldError(ValueError, TypeError):
    """A keyword argument that names no field; a ``TypeError`` so that TorchRL's ``GymEnv`` tries again without it."""


@takes_numbers
def make_task(task: Task | str | None = None, config: Json | None = None, **changes: Any) -> Task:
    """A task from the arguments of ``gymnasium.make``.

    Args:
        task: a task, or the name of one of the paper's configurations.
        config: a file of the authors' implementation or its content, for `Task.from_json` with ``goal``.
        changes: ``image_seed``, and fields of `Task`, `CTGraph` and `Observations` to change. Without task and config
            also the arguments of `ct_graph`.

    Raises:
        UnknownFieldError: a ``ValueError``, for changes that are no fields.
        ValueError: for unknown names, and values out of range.

    Example:
        >>> make_task("CT-FO-B2", goal="1.2.1").graph.depth
        3
    """
    require((task is None or config is None, "give a task or a config, not both"))
    if config is not None:
        return _changed(Task.from_json(config, changes.pop("goal", None)), changes)
    if task is None:
        shape = {name: changes.pop(name) for name in signature(ct_graph).parameters if name in changes}
        return _changed(ct_graph(**shape), changes)
    if isinstance(task, str):
        unknown = f"unknown configuration {task!r}: {did_you_mean(task, CONFIGURATIONS)}"
        require((task in CONFIGURATIONS, unknown))
        task = CONFIGURATIONS[task]()
    require((isinstance(task, Task), f"task must be a Task or the name of a configuration, got {task!r}"))
    return _changed(task, changes)


def _changed(task: Task, changes: NamedValues) -> Task:
    if "image_seed" in changes:
        require((task.image_seed is not None, f"image_seed needs generated images, got {task.images!r}"))
        changes["images"] = replace(task.images, seed=changes.pop("image_seed"))  # type: ignore[type-var]
    for name in ("graph", "observations"):
        part = getattr(task, name)
        own = {field.name: changes.pop(field.name) for field in fields(part) if field.name in changes}
        if own:
            changes[name] = replace(part, **own)
    unknown = sorted(changes.keys() - {field.name for field in fields(Task)})
    parts = (Task, type(task.graph), type(task.observations))
    known = ["config", "task", "task_pool", "image_seed", *(field.name for part in parts for field in fields(part))]
    close = [f"; did you mean {match!r}?" for name in unknown for match in get_close_matches(name, known, 1)]
    if unknown:
        python = "; ".join(f"unexpected keyword argument {name!r}" for name in unknown)
        message = f"no field of a task, its graph or its observations: {', '.join(unknown)}{''.join(close)}"
        raise UnknownFieldError(f"{python}: {message}")
    return replace(task, **changes)
