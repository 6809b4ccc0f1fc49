"""Curricula for the learning properties that the CT-graph paper lists, and how each property is scored.

Section 1 of Soltoggio et al. 2023 (arXiv 2302.10887) lists the properties in this order. Tasks, frames and scores are
choices of this package; ``docs/reference/profile.md`` explains them. All graphs have b=2, and image seeds differ where
images do. In sets of goals each place has both branches equally often. Properties 5, 6 and 10 compare lives that end
with the block `TARGETS` and differ in what comes before; `profile_fresh` has nothing before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from ctgraph_rl.checks import NamedValues, by_name
from ctgraph_rl.core.graph import CTGraph
from ctgraph_rl.tasks.configurations import ct_graph, observations_of
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.images import PaperImages
from ctgraph_rl.tasks.protocol import Evaluation, Protocol
from ctgraph_rl.tasks.task import Task
from curricula.axes import OneOrMore, all_goals, as_tasks, given_goals, growing_depth, sequence
from curricula.memory import co_hard

SOURCE = "ctgraph_rl, after section 1 of Soltoggio et al. 2023, arXiv 2302.10887"

VERSION = 2

MIRRORED = {2: ((1, 2), (2, 1)), 3: ((1, 2, 1), (2, 1, 2)), 4: ((1, 2, 1, 2), (2, 1, 2, 1))}
"""Goals by depth without two equal decisions in a row, so that a policy must know where it is."""

EIGHT = ((1, 1, 1, 1), (2, 2, 1, 2), (1, 2, 2, 1), (2, 1, 2, 2), (2, 1, 1, 1), (1, 2, 1, 2), (2, 2, 2, 1), (1, 1, 2, 2))
"""Goals of depth 4: each place has both branches four times."""

SIMILAR = ((1, 1), (2, 2))

DISSIMILAR = ((2, 1), (1, 2))

CURVE = 12
"""Evaluations of a block whose area counts; one greedy episode each suffices without chance."""


def profile_observability(num_frames: int = 819_200) -> Curriculum:
    """Property 1: four degrees of observability with random waits, two goals each, all at once.

    They are the paper's CT-FO, CT-SU, CT-CO and CT-POSR with p = 0.5, where CT-SU and CT-POSR differ only in images.

    Args:
        num_frames: frames of the eight tasks together.
    """
    graph = CTGraph(2, 2, 0.5)
    tasks: list[Task] = []
    for kind in ("full", "surjective", "confounding", "surjective"):
        shown = observations_of(graph, kind)
        for goal in MIRRORED[2]:
            tasks.append(Task(graph, goal, shown, PaperImages(shown.last_id + 1, 1 + len(tasks))))
    return _profile("observability", [tasks], num_frames, Evaluation(before=False))


def profile_memory(num_frames: int = 614_400) -> Curriculum:
    """Property 2: goals of growing depth that need memory, all at once; first rewards are guided.

    Args:
        num_frames: frames of the eight tasks together.
    """
    tasks: list[Task] = []
    for goal in (*MIRRORED[2], *MIRRORED[3], *MIRRORED[4], (1, 2, 2, 1), (2, 1, 1, 2)):
        seed = 1 + len(tasks)
        tasks.append(ct_graph(2, len(goal), 0.5, goal, fully_observable=False, image_seed=seed))
    protocol = Protocol(guide_frames=num_frames // 2)
    return _profile("memory", [tasks], num_frames, Evaluation(before=False), protocol)


def profile_sparsity(num_frames: int = 57_344) -> Curriculum:
    """Property 3: fully observable goals whose reward random actions rarely meet, the rarest first.

    Each graph has two goals in turn on the same images, so no sequence of actions reaches both.

    Args:
        num_frames: frames of each goal.
    """
    tasks: list[Task] = []
    for depth in (7, 6, 5):
        tasks += given_goals(ct_graph(2, depth, image_seed=depth), (_alternating(1, depth), _alternating(2, depth)))
    return _profile("sparsity", tasks, num_frames, Evaluation(10, before=False))


def profile_adaptation(num_frames: int = 40_960) -> Curriculum:
    """Property 4: eight goals of a fully observable graph of depth 4 in turn.

    Args:
        num_frames: frames of each goal, a multiple of 5.
    """
    evaluation = Evaluation(10, before=False, every=num_frames // 5)
    return _profile("adaptation", given_goals(ct_graph(2, 4), EIGHT), num_frames, evaluation)


def profile_fresh(num_frames: int = 98_304) -> Curriculum:
    """Control of properties 5, 6 and 10: two goals of depth 2 on two fully observable graphs, with nothing before.

    Args:
        num_frames: frames of the goals together, a multiple of 24.
    """
    return _life("fresh", (), num_frames)


def profile_unrelated(num_frames: int = 98_304) -> Curriculum:
    """Control of properties 6 and 10: the goals of `profile_fresh` after goals of depth 1 on other images.

    Args:
        num_frames: frames of the last goals together, a multiple of 24.
    """
    return _life("unrelated", _first_decisions((3, 4)), num_frames)


def profile_similarity(num_frames: int = 98_304) -> Curriculum:
    """Property 5: the goals of `profile_fresh` after goals of the same graphs that share the first decision.

    Args:
        num_frames: frames of the last goals together, a multiple of 24.
    """
    return _life("similarity", _on_graphs(SIMILAR), num_frames)


def profile_dissimilar(num_frames: int = 98_304) -> Curriculum:
    """Control of properties 5 and 6: the goals of `profile_fresh` after goals of the same graphs that share nothing.

    Args:
        num_frames: frames of the last goals together, a multiple of 24.
    """
    return _life("dissimilar", _on_graphs(DISSIMILAR), num_frames)


def profile_hierarchy(num_frames: int = 98_304) -> Curriculum:
    """Property 6: the goals of `profile_fresh` after their first decisions, goals of graphs of depth 1.

    Args:
        num_frames: frames of the last goals together, a multiple of 24.
    """
    return _life("hierarchy", _first_decisions((1, 2)), num_frames)


def profile_attention(num_frames: int = 204_800) -> Curriculum:
    """Property 7: wait states show one of 100 images at random; evaluated with 100 other images, too.

    Args:
        num_frames: frames of the two goals together.
    """
    [first] = as_tasks(co_hard(2, 0.5, unique_decisions=True, num_wait_images=100).tasks)  # type: ignore[arg-type]
    last = first.observations.last_id
    other = replace(first.observations, wait_ids=(last + 1, last + 100))
    tasks: list[Task] = []
    held_out = []
    for seed, goal in enumerate(MIRRORED[2], 1):
        task = replace(first, goal=goal, images=PaperImages(last + 101, seed))
        tasks.append(task)
        held_out.append(replace(task, observations=other))
    return _profile("attention", [tasks], num_frames, Evaluation(400, before=False, held_out=tuple(held_out)))


def profile_exploration(num_frames: int = 614_400) -> Curriculum:
    """Property 8: each row has one of four goals at random; evaluated over the first four episodes with a goal.

    Args:
        num_frames: frames of all rows together.
    """
    evaluation = Evaluation(400, greedy=False, before=False, adapt_episodes=3)
    return _profile("exploration", [all_goals(ct_graph(2, 2))], num_frames, evaluation)


def profile_model(num_frames: int = 98_304) -> Curriculum:
    """Property 9: a surjective graph with random waits; what comes next depends on the decisions so far.

    Args:
        num_frames: frames to learn from before.
    """
    task = ct_graph(2, 2, 0.5, (1, 2), fully_observable=False)
    return _profile("model", [task], num_frames, Evaluation(before=False))


def profile_innate(num_frames: int = 98_304) -> Curriculum:
    """Property 10: the goals of `profile_fresh` after other graphs that share their images.

    The graphs before have depth 1 and 2, with and without random waits, and goals with another first decision.

    Args:
        num_frames: frames of the last goals together, a multiple of 24.
    """
    return _life("innate", _relatives(), num_frames)


def profile_roles(num_frames: int = 98_304) -> Curriculum:
    """Control of property 10: as `profile_innate`, but before its last block each image stands for another state.

    Images of wait states were shown by decision and end states before, and the other way round. An agent that is slow
    only where images are new is not slow here.

    Args:
        num_frames: frames of the last goals together, a multiple of 24.
    """
    before = []
    for task in _relatives():
        shown = replace(task.observations, decision_ids=(2, 4), end_ids=(5, 8), wait_ids=(9, 15))
        before.append(replace(task, observations=shown))
    return _life("roles", before, num_frames)


def _life(name: str, before: Sequence[Task], num_frames: int) -> Curriculum:
    evaluation = Evaluation(10, before=False, every=num_frames // CURVE)
    if not before:
        return _profile(name, [TARGETS], num_frames, evaluation)
    return _profile(name, [before, TARGETS], [num_frames // 2, num_frames], evaluation)


def _on_graphs(goals: Sequence[tuple[int, ...]], image_seeds: Sequence[int] = (1, 2)) -> tuple[Task, ...]:
    return tuple(ct_graph(2, 2, 0.0, goal, image_seed=seed) for goal, seed in zip(goals, image_seeds, strict=True))


def _first_decisions(image_seeds: Sequence[int]) -> tuple[Task, ...]:
    return growing_depth(_on_graphs(MIRRORED[2], image_seeds), [1])


def _relatives() -> list[Task]:
    tasks: list[Task] = []
    for deep in _on_graphs(DISSIMILAR):
        tasks += [*growing_depth(deep, [1]), replace(deep, graph=replace(deep.graph, wait_prob=0.5))]
    return tasks


TARGETS = _on_graphs(MIRRORED[2])


def _alternating(first: int, depth: int) -> tuple[int, ...]:
    return tuple(first if place % 2 == 0 else 3 - first for place in range(depth))


def _profile(
    name: str,
    blocks: Sequence[OneOrMore],
    num_frames: int | Sequence[int],
    evaluation: Evaluation,
    protocol: Protocol | None = None,
) -> Curriculum:
    return sequence(f"profile_{name}", blocks, num_frames, VERSION, SOURCE, evaluation=evaluation, protocol=protocol)


class Property(NamedTuple):
    """A property: its name in figures, and its measure of `ctgraph_rl.profile.properties`."""

    title: str
    measure: str
    arguments: NamedValues
    controls: tuple[str, ...] = ()  # curricula of the lives that it is compared with


AFRESH = ("profile_fresh", "profile_unrelated")
"""Controls of reuse: nothing before, and as long a history that shares nothing."""

PROPERTIES = {
    "profile_observability": Property("observability", "above_ceilings", {"sizes": (2, 2, 2, 2)}),
    "profile_memory": Property("memory", "above_ceilings", {"sizes": (2, 2, 4)}),
    "profile_sparsity": Property("sparse rewards", "above_random_search", {"sizes": (2, 2, 2)}),
    "profile_adaptation": Property("adaptation", "faster_than_random_search", {}),
    "profile_similarity": Property("similarity", "gains", {}, ("profile_fresh", "profile_dissimilar")),
    "profile_hierarchy": Property("hierarchy", "gains", {}, (*AFRESH, "profile_dissimilar")),
    "profile_attention": Property("attention", "held_out", {}),
    "profile_exploration": Property("exploration", "searches", {}),
    "profile_model": Property("model", "predicts", {}),
    "profile_innate": Property(
        "innate knowledge", "gains", {}, ("profile_fresh", "profile_unrelated", "profile_roles")
    ),
}
"""In the paper's order, by curricula."""

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
    profile_fresh,
    profile_unrelated,
    profile_dissimilar,
    profile_roles,
)
