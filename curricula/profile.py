"""Ten small curricula, one for each learning property that the CT-graph paper lists, and how each is scored.

Section 1 of Soltoggio et al. 2023 (arXiv 2302.10887) lists the properties in this order. The tasks, the numbers of
frames and the scores are choices of this package; ``docs/reference/profile.md`` says what a score means. All graphs
have two branches. Tasks with different image seeds have different images.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from ctgraph_rl.checks import NamedValues, by_name
from ctgraph_rl.core.graph import CTGraph
from ctgraph_rl.tasks.configurations import OBSERVABILITY, ct_graph, observations_of
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.images import PaperImages
from ctgraph_rl.tasks.protocol import Evaluation, Protocol
from ctgraph_rl.tasks.task import Task
from curricula.axes import all_goals, given_goals, growing_depth
from curricula.memory import co_hard
from curricula.order import OneOrMore, as_tasks, sequence

SOURCE = "ctgraph_rl, after section 1 of Soltoggio et al. 2023, arXiv 2302.10887"

CURVES = Evaluation(num_episodes=10, before=False, every=10_240)
"""Of scores that are areas under curves; without chance in a task, each episode of a greedy policy is the same."""

EIGHT = ((1, 1, 1), (2, 2, 2), (1, 2, 1), (2, 1, 2), (1, 1, 2), (2, 2, 1), (1, 2, 2), (2, 1, 1))
PAIRED = ((1, 1, 1), (1, 1, 2), (2, 2, 1), (2, 2, 2), (1, 2, 1), (1, 2, 2), (2, 1, 1), (2, 1, 2))
"""Goals of depth 3: every second one shares two decisions with the one before it, and the others share none."""


def profile_observability(num_frames: int = 409_600) -> Curriculum:
    """Property 1: the same goal under four degrees of observability, all at once, with random waits.

    Args:
        num_frames: frames of the four tasks together.
    """
    graph = CTGraph(2, 2, 0.5)
    tasks = []
    for image_seed, kind in enumerate(OBSERVABILITY, 1):
        shown = observations_of(graph, kind)
        images = PaperImages(shown.last_id + 1, image_seed)
        tasks.append(Task(graph, (1, 2), shown, images))
    return _profile("observability", [tasks], num_frames, Evaluation(before=False))


def profile_memory(num_frames: int = 614_400) -> Curriculum:
    """Property 2: four sequences of growing length, all at once, whose goals need memory; first rewards are guided.

    Args:
        num_frames: frames of the four tasks together.
    """
    lengths = ((2, 0.0), (2, 0.5), (3, 0.5), (4, 0.5))
    tasks = []
    for seed, (depth, p) in enumerate(lengths, 1):
        tasks.append(ct_graph(2, depth, p, _alternating(depth), fully_observable=False, image_seed=seed))
    protocol = Protocol(guide_frames=num_frames // 2)
    return _profile("memory", [tasks], num_frames, Evaluation(before=False), protocol)


def profile_sparsity(num_frames: int = 102_400) -> Curriculum:
    """Property 3: fully observable goals whose reward random actions rarely meet, the rarest first.

    Args:
        num_frames: frames of each of the three tasks.
    """
    tasks = [ct_graph(2, depth, 0.0, _alternating(depth), image_seed=depth) for depth in (7, 6, 5)]
    return _profile("sparsity", tasks, num_frames, Evaluation(10, before=False))


def profile_adaptation(num_frames: int = 61_440) -> Curriculum:
    """Property 4: the eight goals of a fully observable graph of depth 3, one after the other, with task ids.

    Args:
        num_frames: frames of each goal.
    """
    tasks = given_goals(ct_graph(2, 3), EIGHT)
    return _profile("adaptation", tasks, num_frames, CURVES, protocol=Protocol("one_hot"))


def profile_similarity(num_frames: int = 61_440) -> Curriculum:
    """Property 5: the same goals, ordered so that each shares two decisions with the one before it, or none.

    Args:
        num_frames: frames of each goal.
    """
    return _profile("similarity", given_goals(ct_graph(2, 3), PAIRED), num_frames, CURVES)


def profile_hierarchy(num_frames: int = 102_400) -> Curriculum:
    """Property 6: a goal of depth 4 from scratch, then nested goals of depth 2, 3 and 4 on other images.

    Args:
        num_frames: frames of each goal.
    """
    scratch = ct_graph(2, 4, 0.0, _alternating(4))
    deepest = ct_graph(2, 4, 0.0, _alternating(4), image_seed=2)
    tasks = [scratch, *growing_depth(deepest, (2, 3, 4))]
    return _profile("hierarchy", tasks, num_frames, CURVES)


def profile_attention(num_frames: int = 204_800) -> Curriculum:
    """Property 7: wait states show one of 100 images at random; evaluated with 100 other images, too.

    Args:
        num_frames: frames.
    """
    [task] = as_tasks(co_hard(2, 0.5, unique_decisions=True, num_wait_images=100).tasks)  # type: ignore[arg-type]
    last = task.observations.last_id
    task = replace(task, images=PaperImages(last + 101))
    other = replace(task.observations, wait_ids=(last + 1, last + 100))
    held_out = replace(task, observations=other)
    return _profile("attention", [task], num_frames, Evaluation(400, before=False, held_out=(held_out,)))


def profile_exploration(num_frames: int = 614_400) -> Curriculum:
    """Property 8: each row has one of four goals at random; evaluated over the first four episodes with a goal.

    Args:
        num_frames: frames of all rows together.
    """
    evaluation = Evaluation(400, greedy=False, before=False, adapt_episodes=3)
    return _profile("exploration", [all_goals(ct_graph(2, 2))], num_frames, evaluation)


def profile_model(num_frames: int = 102_400) -> Curriculum:
    """Property 9: a fully observable graph with random waits, of which a table learns a model from the agent's data.

    Args:
        num_frames: frames that the agent learns from before.
    """
    return _profile("model", [ct_graph(2, 2, 0.5, (1, 2))], num_frames, Evaluation(before=False))


def profile_innate(num_frames: int = 102_400) -> Curriculum:
    """Property 10: a graph from scratch, then four others at once, then a held-out graph with the images of these.

    The first and the last graph differ in nothing but their images. The four in between have depth 2 and 3, with and
    without random waits, and other goals.

    Args:
        num_frames: frames of each block.
    """
    scratch = ct_graph(2, 4, 0.0, _alternating(4))
    deepest = ct_graph(2, 4, 0.0, _alternating(4), image_seed=2)
    [two, three] = growing_depth(deepest, (2, 3))
    innate = []
    for task, goal, p in ((two, (2, 1), 0.0), (two, (2, 2), 0.5), (three, (2, 1, 2), 0.0), (three, (2, 2, 1), 0.5)):
        innate.append(replace(task, goal=goal, graph=replace(task.graph, wait_prob=p)))
    return _profile("innate", [scratch, innate, deepest], num_frames, CURVES)


def _alternating(depth: int) -> tuple[int, ...]:
    """The goal 1, 2, 1, 2, ..."""
    return tuple(1 + place % 2 for place in range(depth))


def _profile(
    name: str,
    blocks: Sequence[OneOrMore],
    num_frames: int,
    evaluation: Evaluation,
    protocol: Protocol | None = None,
) -> Curriculum:
    return sequence(f"profile_{name}", blocks, num_frames, 1, SOURCE, evaluation=evaluation, protocol=protocol)


class Property(NamedTuple):
    """A property: its name in figures, and the measure of `ctgraph_rl.profile.properties` with its arguments."""

    title: str
    measure: str
    arguments: NamedValues


PROPERTIES = {
    "profile_observability": Property("observability", "above_ceiling", {"ceiling": "open_loop"}),
    "profile_memory": Property("memory", "above_ceiling", {"ceiling": "memoryless"}),
    "profile_sparsity": Property("sparse rewards", "above_random_search", {}),
    "profile_adaptation": Property("adaptation", "faster", {"on": range(1, 8), "than": [0], "learned": True}),
    "profile_similarity": Property("similarity", "faster", {"on": [1, 3, 5, 7], "than": [2, 4, 6]}),
    "profile_hierarchy": Property("hierarchy", "faster", {"on": [3], "than": [0]}),
    "profile_attention": Property("attention", "held_out", {}),
    "profile_exploration": Property("exploration", "searches", {}),
    "profile_model": Property("model", "teaches", {}),
    "profile_innate": Property("innate knowledge", "faster", {"on": [5], "than": [0]}),
}
"""The properties in the order of the paper, by their curricula. A measure counts tasks from 0."""

NAMED = by_name(
    profile_observability,
    profile_memory,
    profile_sparsity,
    profile_adaptation,
    profile_similarity,
    profile_hierarchy,
    profile_attention,
    profile_exploration,
    profile_model,
    profile_innate,
)
"""The curricula of this module by name."""
