"""Curricula whose axes are plain arguments, so that a command line can set them.

To show the speed of learning each block has eight evaluations, if there are at most `MOST_EVALUATED` tasks and all
blocks have the same frames, a multiple of 2,048.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from os import PathLike
from typing import Any

from ctgraph_rl.checks import ReadOnlyValues, are_ints, as_tuple, at_least_one, is_int, one_of, require, takes_its_kinds
from ctgraph_rl.core.goal import Goal, read_goal
from ctgraph_rl.core.rewards import REWARD_FNS
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.images import OneHot
from ctgraph_rl.tasks.paper_json import shown_ids
from ctgraph_rl.tasks.protocol import Evaluation, count_rule
from ctgraph_rl.tasks.reference import read_task
from ctgraph_rl.tasks.switch import AtRandom, ByEpisode, Drift
from ctgraph_rl.tasks.task import Task
from curricula import axes
from curricula.axes import Tasks
from curricula.paper import KINDS, configured

GOALS = ("all", "random", "nested")
ORDERS = ("product", "interleave", "shuffle", "reverse")
SWITCHES: dict[str, Callable[[int], Any]] = {
    "by_episode": ByEpisode,
    "at_random": lambda episodes: AtRandom(1 / episodes),
    "drift": Drift,
}
IMAGE_SIZE = 12

EVALUATIONS = 8

ROWS = 256
"""Environments that evaluations within blocks must fit."""

MOST_EVALUATED = 20
"""Most tasks with evaluations within blocks."""

TRIALS = 50


@takes_its_kinds
def from_axes(
    configuration: str = "su_b1",
    branching_factor: int | Sequence[int] | None = None,
    depth: int | Sequence[int] | None = None,
    wait_prob: float | Sequence[float] | None = None,
    image_seeds: int | Sequence[int] = 1,
    goals: str | float | Sequence[Goal] = "all",
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
    goal_change: int | Sequence[int] | None = None,
) -> Curriculum:
    """Any combination of axes; the paper's Table 3 has the names in brackets.

    Lists are combined: goals vary fastest, then depths, wait probabilities and image seeds. All tasks share rewards and
    the rules of what is observed.

    Args:
        configuration: where the rest comes from: fo_b1, fo_b2, su_b1, co_b1 or posr_b1.
        branching_factor: another b, or several for ``random_graphs``; None: as configured [b].
        depth: another d, or several, with the ids of the deepest graph; None: as configured [d].
        wait_prob: another p, or several; None: as configured [p].
        image_seeds: seed of the image set, or several [image set: seed].
        goals: ``all``; ``random``, ``num_goals`` a graph; ``nested``, a random path and its beginnings; or a list of
            goals such as [1.2,2.1], each for the graphs of its depth.
        num_goals: how many random goals.
        order: ``product``; ``interleave``, image seeds take turns, or graphs if there is one seed; ``shuffle``, by
            ``seed``; or ``reverse``.
        repeats: how often the whole sequence comes.
        seed: draws random goals and the shuffled order.
        num_frames: frames per block, or a list with those of each.
        switch: None: a block for each task; else one block, whose rows change task in turns, ``by_episode``;
            ``at_random``; or by ``drift`` from each to the next.
        switch_episodes: episodes between changes, on average for ``at_random``, or of a drift.
        name: of the curriculum, in logs and tables.
        read_noise: largest addition to a pixel on each read, in 0..255 [noise on read].
        read_rotation: largest rotation on each read, whole degrees in 0..359 [rotation on read].
        random_graphs: how many tasks to draw by ``seed`` from all shapes, images and goals; None: all combinations.
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
        reward_fn: what end states pay: ``needle``, only the goal; ``gradient``, more nearer the goal;
            ``reference_linear``, as the authors' implementation [g].
        goal_change: episodes after which each row draws another goal, a number or the fewest and the most, for agents
            that adapt; all tasks then share a block. None: goals stay.

    Raises:
        ValueError: for values out of range; lists the choices.
    """
    plain_images = (image_seeds, image_size) == (1, IMAGE_SIZE)
    require(
        *one_of(REWARD_FNS, reward_fn=reward_fn),
        (is_int(seed, 0), f"seed must be an integer >= 0, got {seed!r}"),
        (not one_hot or plain_images, "one_hot has no image_seeds and no image_size: leave them out"),
        (is_int(image_size, 4) and image_size % 4 == 0, f"image_size must be a multiple of 4, got {image_size!r}"),
    )
    task = configured(configuration)
    kind = KINDS[configuration]
    depths = several(depth, task.graph.depth)
    probs = several(wait_prob, task.graph.wait_prob)
    seeds = several(image_seeds)
    whole = bool(depths) and are_ints(depths, 1)
    require((whole, f"depth must be an integer >= 1 or a list of them, got {depth!r}"))
    if random_graphs is None:
        b: Any = task.graph.branching_factor if branching_factor is None else branching_factor
        graph = replace(task.graph, branching_factor=b, depth=max(depths))
        graphs = axes.as_tasks(axes.reshaped(task, graph, kind, (1,) * graph.depth))
    else:
        drawn = f"random_graphs draws goals and order: leave both out, got goals={goals!r} and order={order!r}"
        require(((goals, order) == ("all", "product"), drawn))
        factors = several(branching_factor, task.graph.branching_factor)
        graphs = axes.random_tasks(random_graphs, seed, factors, depths, probs, kinds=(kind,), image_seeds=seeds)
    changed = []
    for each in graphs:
        shown = each.observations
        if any(given is not None for given in (unique_decisions, unique_waits, decision_ids, wait_ids)):
            own_decisions = shown.unique_decisions if unique_decisions is None else unique_decisions
            own_waits = shown.unique_waits if unique_waits is None else unique_waits
            draws = not (shown.unique_waits or own_waits) and shown.wait_ids[0] < shown.wait_ids[1]
            waits = shown.wait_ids if wait_ids is None and draws else wait_ids
            shown = shown_ids(each.graph, own_waits, own_decisions, waits, decision_ids)
        count = shown.last_id + 1 if num_images is None else num_images
        made = replace(
            each,
            observations=replace(shown, read_noise=read_noise, read_rotation=read_rotation),
            images=replace(each.images, num_images=count, size=image_size),  # type: ignore[type-var]
            reward_fn=REWARD_FNS[reward_fn](),
            goal_reward=goal_reward,
            fail_reward=fail_reward,
            step_reward=step_reward,
            reward_std=reward_std,
        )
        changed.append(made)
    tasks: Tasks = tuple(changed)
    if random_graphs is None:
        deepest = axes.random_goals(tasks, 1, seed) if goals == "nested" else tasks
        by_seed = []
        for shown_task in axes.image_seeds(deepest, seeds):
            by_seed.append(axes.growing_depth(axes.wait_probs(shown_task, probs), depths))
        tasks = _in_order(by_seed, goals, num_goals, order, seed=seed)
    if one_hot:
        vectors = OneHot(tasks[0].images.num_images)
        tasks = tuple(replace(each, images=vectors) for each in tasks)
    return _curriculum(
        name,
        tasks,
        num_frames,
        repeats=repeats,
        switch=switch,
        switch_episodes=switch_episodes,
        goal_change=goal_change,
    )


@takes_its_kinds
def from_graph(
    config: str | PathLike[str] | ReadOnlyValues | None = None,
    wait_prob: float | Sequence[float] | None = None,
    goals: str | float | Sequence[Goal] = "all",
    num_goals: int = 4,
    order: str = "product",
    repeats: int = 1,
    seed: int = 0,
    num_frames: int | Sequence[int] = 204_800,
    switch: str | None = None,
    switch_episodes: int = 100,
    name: str = "graph",
    goal_change: int | Sequence[int] | None = None,
) -> Curriculum:
    """Goals of the graph of a JSON file, of the paper's Table 3 or the authors' implementation.

    Args:
        config: the file, such as graph.json, which says all but the goal; or its content.
        wait_prob: another p, or several; None: as in the file.
        goals: ``all``; ``random``, ``num_goals`` of them; ``nested``, one random goal; or a list of goals such as
            [1.2,2.1].
        num_goals: how many random goals.
        order: ``product``, the goals of each wait probability; ``interleave``, wait probabilities take turns;
            ``shuffle``, by ``seed``; or ``reverse``.
        repeats: how often the whole sequence comes.
        seed: draws random goals and the shuffled order.
        num_frames: frames per block, or a list with those of each.
        switch: None: a block for each task; else one block, whose rows change task in turns, ``by_episode``;
            ``at_random``; or by ``drift`` from each to the next.
        switch_episodes: episodes between changes, on average for ``at_random``, or of a drift.
        name: of the curriculum, in logs and tables.
        goal_change: episodes after which each row draws another goal, a number or the fewest and the most; all tasks
            then share a block. None: as in the file.

    Raises:
        ValueError: for no file, one that is not of this form, and values out of range; lists the choices.
    """
    is_file = isinstance(config, (str, PathLike, Mapping))
    require(
        (is_file, f"config must be a JSON file of a graph's parameters, such as graph.json, got {config!r}"),
        (is_int(seed, 0), f"seed must be an integer >= 0, got {seed!r}"),
    )
    depth = read_task(config, ())["graph"].depth  # type: ignore[arg-type]
    task = Task.from_json(config, (1,) * depth)  # type: ignore[arg-type]
    probs = several(wait_prob, task.graph.wait_prob)
    graphs = axes.wait_probs(axes.random_goals(task, 1, seed) if goals == "nested" else task, probs)
    tasks = _in_order([graphs], goals, num_goals, order, seed=seed)
    return _curriculum(
        name,
        tasks,
        num_frames,
        repeats=repeats,
        switch=switch,
        switch_episodes=switch_episodes,
        goal_change=goal_change,
    )


def several(value: object, usual: object = None) -> tuple[Any, ...]:
    """Return one or several values as a tuple; None stands for the usual ones."""
    listed = as_tuple(usual if value is None else value)
    return listed if isinstance(listed, tuple) else (listed,)


def _in_order(by_seed: Sequence[Tasks], goals: Any, num_goals: int, order: str, seed: int) -> Tasks:
    require(*one_of(ORDERS, order=order), *at_least_one(num_goals=num_goals))
    depths = {graph.graph.depth for graph in by_seed[0]}
    listed: tuple[Any, ...] = ()
    if not isinstance(goals, str) or goals not in GOALS:
        listed = several(goals)
        read = [read_goal(goal) for goal in listed]
        are_goals = all(isinstance(goal, tuple) for goal in read)
        require((are_goals, f"goals must be one of {', '.join(GOALS)}, or a list such as [1.2,2.1], got {goals!r}"))
        example = ",".join(".".join("1" * depth) for depth in sorted(depths))
        rule = f"goals must have as many decisions as the depths, {sorted(depths)}, and some for each; got {goals!r}; "
        require(({len(goal) for goal in read} == depths, f"{rule}write them as [{example}]"))  # type: ignore[arg-type]

    def with_goals_of(task: Task) -> Tasks:
        if listed:
            return axes.given_goals(task, [goal for goal in listed if len(read_goal(goal)) == task.graph.depth])  # type: ignore[arg-type]
        if goals == "random":
            return axes.random_goals(task, num_goals, seed)
        return axes.all_goals(task) if goals == "all" else axes.as_tasks(task)

    with_goals = []
    count = 0
    for graphs in by_seed:
        with_goals.append(list(map(with_goals_of, graphs)))
        count += sum(map(len, with_goals[-1]))
        require(count_rule(count))
    sequences = [axes.concatenate(*graphs) for graphs in with_goals]
    if order == "interleave":
        return axes.interleave(*(sequences if len(sequences) > 1 else with_goals[0]))
    tasks = axes.concatenate(*sequences)
    if order == "shuffle":
        return axes.shuffle(tasks, seed)
    return axes.reverse(tasks) if order == "reverse" else tasks


def _curriculum(
    name: str,
    tasks: Tasks,
    num_frames: int | Sequence[int],
    repeats: int,
    switch: str | None,
    switch_episodes: int,
    goal_change: int | Sequence[int] | None,
) -> Curriculum:
    known = switch is None or switch in SWITCHES
    require(
        *at_least_one(repeats=repeats),
        (known, f"switch must be one of {', '.join(SWITCHES)}, or null, got {switch!r}"),
        (is_int(switch_episodes, 1), f"switch_episodes must be an integer >= 1, got {switch_episodes!r}"),
    )
    changes = None if switch is None else SWITCHES[switch](switch_episodes)
    if goal_change is not None:
        lasts = several(goal_change)
        pair = lasts * 2 if len(lasts) == 1 else lasts
        in_order = len(pair) == 2 and are_ints(pair, 1) and pair[0] <= pair[1]
        rule = f"goal_change must be a number of episodes >= 1, or the fewest and the most, got {goal_change!r}"
        require((in_order, rule))
        tasks = tuple(replace(task, goal_change=pair) for task in tasks)
    every = 0
    if isinstance(num_frames, int) and len(set(tasks)) <= MOST_EVALUATED and num_frames % (EVALUATIONS * ROWS) == 0:
        every = num_frames // EVALUATIONS
    evaluation = Evaluation(every=every)
    change = tasks[0].goal_change
    if change is not None:
        episodes = change[0]
        evaluation = Evaluation(TRIALS * episodes, greedy=False, episodes_per_row=episodes, every=every)
    tasks = axes.cycle(tasks, repeats)
    together = changes is not None or change is not None
    return axes.sequence(name, [tasks] if together else tasks, num_frames, evaluation=evaluation, switch=changes)
