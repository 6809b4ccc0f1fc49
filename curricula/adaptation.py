"""Published sequences that test how fast a learner adapts to goals that change unannounced."""

from __future__ import annotations

from dataclasses import replace

from ctgraph_rl.checks import at_least_one, by_name, is_int, require, takes_numbers
from ctgraph_rl.core.graph import CTGraph
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.images import OneHot, PaperImages
from ctgraph_rl.tasks.observations import Observations
from ctgraph_rl.tasks.protocol import Evaluation, Protocol
from ctgraph_rl.tasks.task import Task
from curricula.axes import OneOrMore, all_goals, cycle, given_goals, random_goals, reshaped, sequence
from curricula.draws import below, generator
from curricula.published import full_mdp, goal_of, lab_task

SWOKS = "Dick et al. 2024, CoLLAs, arXiv 2405.19047; github.com/JupiLogy/swoks"
PENN_A = "Ben-Iwhiwhu et al. 2020, GECCO; github.com/dlpbc/penn-a"
DICK_2020 = "Dick et al. 2020, Frontiers in Neurorobotics 14, 578675; github.com/JupiLogy/adaptive-model-detection"
NM = "Ben-Iwhiwhu et al. 2022, Neural Networks; github.com/dlpbc/nm-metarl"

UNANNOUNCED = Protocol(boundaries="hidden")

MOST_LIVES = 10_000


def swoks_2x4(num_frames: int = 384_000) -> Curriculum:
    """Statistical context detection: the four goals of a depth-2 graph in reverse order, twice, unannounced.

    A stay is 750 iterations of 4 workers x 128 steps; a configuration file of the repository has 16 workers instead.
    There each iteration cut the episodes; here none does. The evaluation is our default.

    Args:
        num_frames: frames per stay.
    """
    goals = [goal_of(path) for path in ("11", "10", "01", "00")]
    tasks = given_goals(full_mdp("00", 1, fail_reward=-0.1), goals)
    return sequence("swoks_2x4", cycle(tasks, 2), num_frames, version=1, source=SWOKS, protocol=UNANNOUNCED)


def penn_a_swap(
    num_frames: int | None = None, depth: int = 2, num_rows: int = 256, seed: int = 0, num_lives: int | None = None
) -> Curriculum:
    """The goal swap of evolved neuromodulated networks: a goal, then unannounced another one, drawn uniformly.

    There a trial had 100 episodes with a swap at random in episodes 35 to 65, and fitness was the mean of 4 trials.
    Here each row plays a trial and swaps after the frames of 50 longest episodes. The times of evaluation are our
    default.

    With ``num_lives`` rows play trials of 100 longest episodes in turn, with a swap after 35 to 65 of them, all rows at
    once. Goals are equally often first. An evaluation's row plays 100 episodes of a goal that stays; held-out ones draw
    another after 50.

    Args:
        num_frames: frames of each half, all rows together; None: 50 episodes of 2 d + 3 steps for each row.
        depth: 2 or 3.
        num_rows: trials side by side, for the default of ``num_frames``.
        seed: draws the goals, and the moments of swaps.
        num_lives: trials of a row in turn, without ``num_frames``; None: one.
    """
    require(
        (depth in (2, 3), f"depth must be 2 or 3, as published, got {depth!r}"),
        *at_least_one(num_rows=num_rows),
        (
            num_lives is None or is_int(num_lives, 1, MOST_LIVES),
            f"num_lives must be in 1..{MOST_LIVES}, got {num_lives!r}",
        ),
        (num_lives is None or num_frames is None, "num_frames is of one life: leave it out with num_lives"),
    )
    task = lab_task("0" * depth, Observations((2, 2), (3, 3), (4, 4)), fail_reward=-0.4)
    episode = _longest_episode(depth) * num_rows
    evaluation = None
    if num_lives is None:
        tasks: list[OneOrMore] = [*random_goals(task, 2, seed)]
        frames = [50 * episode if num_frames is None else num_frames] * 2
    else:
        goals = all_goals(task)
        source = generator(seed)
        tasks = []
        frames = []
        for _ in range(num_lives):
            first = below(source, len(goals))
            second = (first + 1 + below(source, len(goals) - 1)) % len(goals)
            tasks += [goals[first:] + goals[:first], goals[second:] + goals[:second]]
            moment = 35 + below(source, 31)
            frames += [moment * episode, (100 - moment) * episode]
        swapped = all_goals(replace(task, goal_change=(50, 50)))
        every = 10 if num_lives % 10 == 0 else num_lives
        evaluation = Evaluation(
            400, episodes_per_row=100, at_block_ends=False, every=every * 100 * episode, held_out=swapped
        )
    return sequence("penn_a_swap", tasks, frames, source=PENN_A, protocol=UNANNOUNCED, evaluation=evaluation)


def dick2020_pair(num_frames: int = 51_200, one_hot: bool = True) -> Curriculum:
    """Two depth-2 graphs that differ in one transition, without notice: a change of task that is hard to detect.

    Section 4.2 of the CT-graph paper: the graphs "had a single variation in the transition matrix". No configuration
    was published. Here observations are as in CT-SU-B1, but each end state has its own, so that the change is seen. In
    the second task the branches behind the first one are swapped: 1.2 reaches the same goal instead of 1.1.

    Args:
        num_frames: frames per task.
        one_hot: observations are one-hot vectors; False: images.
    """
    x = Observations(wait_ids=(2, 2), decision_ids=(3, 3), end_ids=(4, 7), unique_ends=True)
    task = Task(CTGraph(2, 2), (1, 1), x, OneHot(8) if one_hot else PaperImages(8))
    tasks = (task, replace(task, swapped_branches=((1,), (1, 2))))
    return sequence("dick2020_pair", tasks, num_frames, version=1, source=DICK_2020, protocol=UNANNOUNCED)


META_BATCHES = {1: (501, 20, 20, 40), 2: (501, 20, 20, 40), 3: (1001, 40, 25, 40), 4: (1501, 20, 60, 100)}
"""By depth: batches, tasks in a batch, episodes of a task before and after its adaptation, test episodes."""


@takes_numbers
def nm_uniform_goals(num_frames: int | None = None, depth: int = 2, kind: str = "full") -> Curriculum:
    """The meta-learning tasks of the neuromodulated-context paper: a uniform random goal for each task.

    The graph is fully observable, with vectors. A goal lasts as long as a task there, the episodes before and after its
    adaptation; then the row draws any goal. Goals are equally often first. The frames bound the authors' batches from
    above, by the longest episodes, rounded up to a multiple of 512. A test has as many episodes of a goal as theirs
    between adaptations, sampled.

    Args:
        num_frames: frames of all rows together; None: the bound.
        depth: 2, 3 or 4; 1, which is not published, has the numbers of 2.
        kind: what states show, as in ``axes.reshaped``; all but ``full`` are not published.
    """
    require((depth in META_BATCHES, f"depth must be in 1..4, got {depth!r}"))
    batches, tasks_a_batch, episodes, test_episodes = META_BATCHES[depth]
    task = full_mdp("0" * depth, 1, fail_reward=-0.01, one_hot=True)
    if kind != "full":
        task = reshaped(task, task.graph, kind, task.goal)
    tasks = all_goals(replace(task, goal_change=(2 * episodes, 2 * episodes)))
    bound = batches * tasks_a_batch * 2 * episodes * _longest_episode(depth)
    frames = -(-bound // 512) * 512 if num_frames is None else num_frames
    evaluation = Evaluation(test_episodes, greedy=False, episodes_per_row=test_episodes)
    return sequence("nm_uniform_goals", [tasks], frames, 1, NM, evaluation=evaluation)


@takes_numbers
def goal_search(num_frames: int = 409_600, depth: int = 2, num_image_sets: int = 4) -> Curriculum:
    """Half of the goals on some image sets; held out are the other half, and all goals on a new image set.

    A learner that knows the trained goals by heart finds these faster than the best search among all, and never the
    held-out ones. Tasks are fully observable; trained goals have an even number of second decisions. A row keeps its
    task; in an evaluation it first plays as many episodes as there are goals.

    Args:
        num_frames: frames of all rows together.
        depth: of the graph.
        num_image_sets: trained image sets, with the image seeds 1, 2 and so on.
    """
    require(*at_least_one(depth=depth, num_image_sets=num_image_sets))
    tasks = [task for seed in range(1, num_image_sets + 1) for task in all_goals(full_mdp("0" * depth, seed))]
    trained = [task for task in tasks if task.goal.count(2) % 2 == 0]
    other_goals = [task for task in tasks if task.goal.count(2) % 2 == 1]
    other_images = all_goals(full_mdp("0" * depth, num_image_sets + 1))
    evaluation = Evaluation(
        40,
        greedy=False,
        episodes_per_row=2,
        held_out=(*other_goals, *other_images),
        adapt_episodes=2**depth,
    )
    return sequence("goal_search", [trained], num_frames, 1, f"ctgraph_rl, after {NM}", evaluation=evaluation)


def _longest_episode(depth: int) -> int:
    return 2 * depth + 3


NAMED = by_name(dick2020_pair, goal_search, nm_uniform_goals, penn_a_swap, swoks_2x4)
