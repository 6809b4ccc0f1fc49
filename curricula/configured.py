"""A curriculum whose axes are plain arguments, so that a command line can set them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from ctgraph_rl.checks import are_ints, as_tuple, at_least_one, is_int, one_of, require, takes_its_kinds
from ctgraph_rl.core.rewards import REWARD_FNS
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.images import OneHot
from ctgraph_rl.tasks.paper_json import shown_ids
from ctgraph_rl.tasks.switch import AtRandom, ByEpisode, Drift, Switch
from ctgraph_rl.tasks.task import Task
from curricula import axes
from curricula.order import Tasks
from curricula.paper import KINDS, configured

GOALS = ("all", "random", "nested")
ORDERS = ("product", "interleave", "shuffle", "reverse")
SWITCHES: dict[str, Callable[[int], Any]] = {
    "by_episode": ByEpisode,
    "at_random": lambda episodes: AtRandom(1 / episodes),
    "drift": Drift,
}
IMAGE_SIZE = 12


@takes_its_kinds
def from_axes(
    configuration: str = "su_b1",
    branching_factor: int | Sequence[int] | None = None,
    depth: int | Sequence[int] | None = None,
    wait_prob: float | Sequence[float] | None = None,
    image_seeds: int | Sequence[int] = 1,
    goals: str | Sequence[Sequence[int]] = "all",
    num_goals: int = 4,
    order: str = "product",
    repeats: int = 1,
    seed: int = 0,
    num_frames: int | Sequence[int] = 204_800,
    switch: str | None = None,
    switch_episodes: int = 100,
    name: str = "axes",
    read_noise: int = 0,
    read_rotation: int = 0,
    random_graphs: int | None = None,
    unique_decisions: bool | None = None,
    unique_waits: bool | None = None,
    decision_ids: Sequence[int] | None = None,
    wait_ids: Sequence[int] | None = None,
    num_images: int | None = None,
    image_size: int = IMAGE_SIZE,
    one_hot: bool = False,
    goal_reward: float = 1.0,
    fail_reward: float = 0.0,
    step_reward: float = 0.0,
    reward_std: float = 0.0,
    reward_fn: str = "needle",
) -> Curriculum:
    """Any combination of axes; the paper's Table 3 has the names in brackets.

    Lists are combined: the goals vary fastest, then depths, then wait probabilities, then image seeds. All tasks share
    rewards and the rules of what is observed. The ``protocol`` and ``evaluation`` of a run say what the learner knows
    and how it is evaluated, for any curriculum.

    Args:
        configuration: where the rest comes from: fo_b1, fo_b2, su_b1, co_b1 or posr_b1.
        branching_factor: another b, or several for ``random_graphs``; None: as configured [b].
        depth: another d, or several: then all have the ids of the deepest graph; None: as configured [d].
        wait_prob: another p, or several; None: as configured [p].
        image_seeds: seed of the image set, or several [image set: seed].
        goals: ``all``; ``random``, ``num_goals`` a graph; ``nested``, a random path and its beginnings; or a list of
            goals such as [[1,2],[2,1]], each for the graphs of its depth.
        num_goals: how many random goals.
        order: ``product``; ``interleave``, image seeds take turns, or graphs if there is one seed; ``shuffle``, by
            ``seed``; or ``reverse``.
        repeats: how often the whole sequence comes.
        seed: draws random goals and the shuffled order.
        num_frames: frames per block, or a list with those of each.
        switch: None: a block for each task; else all tasks in one block, between which each row changes: in turns,
            ``by_episode``; ``at_random``; or by ``drift`` from each task to the next.
        switch_episodes: episodes between changes, in turns, in the mean, or of a drift.
        name: of the curriculum, in logs and tables.
        read_noise: largest addition to each pixel whenever an image is read, in 0..255 [noise on read].
        read_rotation: largest rotation whenever an image is read, whole degrees in 0..359 [rotation on read].
        random_graphs: how many tasks to draw by ``seed``, each with any of the shapes, images and goals; None: all
            combinations.
        unique_decisions: whether each decision state has its own image; None: as configured [MDP_D].
        unique_waits: whether each wait state has its own image; None: as configured [MDP_W].
        decision_ids: first and last id of decision states, such as [2,2]; None: the next free ids [D_IDs].
        wait_ids: first and last id of wait states; None: as configured where they draw, else the next free [W_IDs].
        num_images: length of the image set; None: as many as there are ids [nr_images].
        image_size: side of an image in pixels, a multiple of 4 [r of section 2].
        one_hot: vectors instead of images [1D].
        goal_reward: reward at the goal [high_r].
        fail_reward: reward at the fail state [fail_r].
        step_reward: reward of every step, in addition [section 2.5].
        reward_std: standard deviation of the noise on the reward of end states [std_r].
        reward_fn: what end states pay: ``needle``, only the goal; ``gradient``, the nearer the goal the
            more; ``reference_linear``, as the authors' implementation [g].

    Raises:
        ValueError: for values out of range; lists the choices.
    """
    require(
        *one_of(ORDERS, order=order),
        *at_least_one(num_goals=num_goals, repeats=repeats),
        (is_int(seed, 0), f"seed must be an integer >= 0, got {seed!r}"),
        *one_of(REWARD_FNS, reward_fn=reward_fn),
        (
            not one_hot or (image_seeds, image_size) == (1, IMAGE_SIZE),
            "one_hot has no image_seeds and no image_size: leave them out",
        ),
        (is_int(image_size, 4) and image_size % 4 == 0, f"image_size must be a multiple of 4, got {image_size!r}"),
    )
    observed = partial(
        _observed,
        unique_decisions=unique_decisions,
        unique_waits=unique_waits,
        decision_ids=decision_ids,
        wait_ids=wait_ids,
        num_images=num_images,
        image_size=image_size,
    )
    rewarded = partial(
        replace,
        goal_reward=goal_reward,
        fail_reward=fail_reward,
        step_reward=step_reward,
        reward_std=reward_std,
        reward_fn=REWARD_FNS[reward_fn](),
    )
    seeds = _several(image_seeds)
    if random_graphs is None:
        task, depths = _deepest(configuration, branching_factor, depth)
        task = observed(task)
        _check_goals(goals, depths)
        if goals == "nested":
            (task,) = axes.random_goals(task, 1, seed)
        by_seed = _by_seed(task, depths, wait_prob, seeds, lambda graph: _with_goals(graph, goals, num_goals, seed))
        tasks = _ordered(by_seed, order, seed)
    else:
        drawn = f"random_graphs draws goals and order: leave both out, got goals={goals!r} and order={order!r}"
        require(((goals, order) == ("all", "product"), drawn))
        shape = (branching_factor, depth, wait_prob)
        tasks = tuple(map(observed, _drawn(configuration, shape, random_graphs, seed, image_seeds=seeds)))
    tasks = tuple(map(rewarded, tasks))
    if one_hot:
        tasks = axes.image_sets(tasks, [OneHot(tasks[0].images.num_images)])
    tasks = axes.cycle(axes.read_variation(tasks, read_noise, read_rotation), repeats)
    changes = _switch(switch, switch_episodes)
    return axes.sequence(name, [tasks] if changes else tasks, num_frames, switch=changes)


def _drawn(
    configuration: str, shape: tuple[Any, Any, Any], count: int, seed: int, image_seeds: tuple[int, ...]
) -> Tasks:
    """Random tasks with some branching factors, depths and wait probabilities; None: as configured."""
    graph = configured(configuration).graph
    branching_factor, depth, wait_prob = shape
    return axes.random_tasks(
        count,
        seed,
        branching_factors=_several(branching_factor, graph.branching_factor),
        depths=_several(depth, graph.depth),
        wait_probs=_several(wait_prob, graph.wait_prob),
        kinds=(KINDS[configuration],),
        image_seeds=image_seeds,
    )


def _deepest(
    configuration: str, branching_factor: Any, depth: int | Sequence[int] | None
) -> tuple[Task, tuple[Any, ...]]:
    """The configured task on its deepest graph, and all depths."""
    task = configured(configuration)
    depths = _several(depth, task.graph.depth)
    whole = bool(depths) and are_ints(depths, 1)
    require((whole, f"depth must be an integer >= 1 or a list of them, got {depth!r}"))
    b = task.graph.branching_factor if branching_factor is None else branching_factor
    graph = replace(task.graph, branching_factor=b, depth=max(depths))
    return axes.reshaped(task, graph, KINDS[configuration], (1,) * graph.depth), depths


def _observed(task: Task, num_images: int | None, image_size: int, **changes: Any) -> Task:
    """The task with other ids of its states, and images for them; None: as configured."""
    shown = task.observations
    given = {name: value for name, value in changes.items() if value is not None}
    if given:
        draws = not shown.unique_waits and shown.wait_ids[0] < shown.wait_ids[1]
        kept = {"wait_ids": shown.wait_ids} if draws and not given.get("unique_waits") else {}
        found = {"unique_decisions": shown.unique_decisions, "unique_waits": shown.unique_waits, **kept, **given}
        shown = shown_ids(task.graph, found)
    count = shown.last_id + 1 if num_images is None else num_images
    images = replace(task.images, num_images=count, size=image_size)  # type: ignore[type-var]
    return replace(task, observations=shown, images=images)


def _by_seed(
    task: Task, depths: tuple[int, ...], wait_prob: Any, seeds: tuple[int, ...], with_goals: Callable[[Task], Tasks]
) -> list[list[Tasks]]:
    """For each image seed the tasks on each graph."""
    probs = _several(wait_prob, task.graph.wait_prob)
    found = []
    for shown in axes.image_seeds(task, seeds):
        graphs = axes.growing_depth(axes.wait_probs(shown, probs), depths)
        found.append([with_goals(graph) for graph in graphs])
    return found


def _check_goals(goals: object, depths: tuple[int, ...]) -> None:
    if isinstance(goals, str):
        require((goals in GOALS, f"goals must be one of {', '.join(GOALS)}, or a list of goals, got {goals!r}"))
        return
    listed = as_tuple(goals)
    is_list = isinstance(listed, tuple) and all(isinstance(as_tuple(goal), tuple) for goal in listed)
    require((is_list, f"goals must be one of {', '.join(GOALS)}, or a list such as [[1, 2]], got {goals!r}"))
    lengths = {len(goal) for goal in listed}  # type: ignore[attr-defined]
    rule = f"goals must have as many decisions as the depths, {sorted(set(depths))}, and some for each; got {goals!r}"
    require((lengths == set(depths), rule))


def _with_goals(task: Task, goals: str | Sequence[Sequence[int]], num_goals: int, seed: int) -> Tasks:
    if goals == "random":
        return axes.random_goals(task, num_goals, seed)
    if isinstance(goals, str):
        return axes.all_goals(task) if goals == "all" else axes.as_tasks(task)
    return axes.given_goals(task, [goal for goal in goals if len(goal) == task.graph.depth])


def _ordered(by_seed: list[list[Tasks]], order: str, seed: int) -> Tasks:
    sequences = [axes.concatenate(*graphs) for graphs in by_seed]
    if order == "interleave":
        return axes.interleave(*(sequences if len(sequences) > 1 else by_seed[0]))
    tasks = axes.concatenate(*sequences)
    if order == "shuffle":
        return axes.shuffle(tasks, seed)
    return axes.reverse(tasks) if order == "reverse" else tasks


def _switch(switch: str | None, episodes: int) -> Switch | None:
    known = switch is None or switch in SWITCHES
    require(
        (known, f"switch must be one of {', '.join(SWITCHES)}, or null, got {switch!r}"),
        (is_int(episodes, 1), f"switch_episodes must be an integer >= 1, got {episodes!r}"),
    )
    return None if switch is None else SWITCHES[switch](episodes)


def _several(value: object, usual: object = None) -> tuple[Any, ...]:
    """A value or several of them as a tuple; the usual one for None."""
    listed = as_tuple(usual if value is None else value)
    return listed if isinstance(listed, tuple) else (listed,)
