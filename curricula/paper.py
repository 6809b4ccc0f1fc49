"""Curricula over the configurations of the CT-graph paper.

Soltoggio et al. 2023 (arXiv 2302.10887), sections 3.4 and 3.5: tasks differ in the location of the goal, the
distribution of inputs, the shape of the graph, all three, and in which features vary. A function here is one way, for
the five baseline configurations: ``su_b1_4tasks`` is `goal_location` of CT-SU-B1, the paper's example of four tasks.
The depths 2, 3, 4, 5 are those of section 4.2. Other orders, frames and sizes of variations are choices of this
package.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from ctgraph_rl.checks import did_you_mean, is_int, require
from ctgraph_rl.core.graph import CTGraph
from ctgraph_rl.core.rewards import Gradient
from ctgraph_rl.tasks.configurations import CONFIGURATIONS, ct_fo_b1, ct_fo_b2, ct_su_b1
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.images import GroupedImages
from ctgraph_rl.tasks.observations import Observations
from ctgraph_rl.tasks.protocol import Block, Evaluation
from ctgraph_rl.tasks.switch import ByEpisode
from ctgraph_rl.tasks.task import Task
from curricula import axes
from curricula.axes import Tasks

PAPER = "Soltoggio et al. 2023, arXiv 2302.10887"

KINDS = {"fo_b1": "full", "fo_b2": "full", "su_b1": "surjective", "co_b1": "confounding", "posr_b1": "surjective"}

DEPTHS = (2, 3, 4, 5)
DEEPEST_GOAL = (1, 2, 1, 2, 2)
NUM_VARIATIONS = 4
FRAMES = 204_800

READ_NOISE = 10
"""Largest addition to a pixel on each read; the paper gives no amplitude."""

READ_ROTATION = 5
"""Largest rotation on each read, in degrees; Table 3 of the paper has 0 or 5."""

VERSION_2 = [
    "posr_b1_4tasks",
    "posr_b1_depth2to5",
    "posr_b1_uncorrelated",
    "su_b1_4images",
    "su_b1_new_decisions",
    "su_b1_new_waits",
    "co_b1_4images",
    "co_b1_new_decisions",
    "co_b1_new_waits",
    "posr_b1_4images",
    "posr_b1_new_decisions",
    "posr_b1_new_waits",
]
"""CT-POSR-B1 had noise in its rewards, and a single goal needed no memory."""

MOST_DEPTH = 4
"""Changing goals are all tasks of one batch, evaluated for whole trials."""

DISSIMILAR = {(2, 2): (1, 2), (3, 2): (3, 1), (2, 3): (2, 1, 2), (3, 3): (2, 3, 1)}


def configured(configuration: str, image_seed: int = 1) -> Task:
    """The task of a configuration such as ``su_b1``, its goal at the first branches.

    Raises:
        ValueError: lists the configurations.
    """
    unknown = f"unknown configuration {configuration!r}: {did_you_mean(str(configuration), KINDS)}"
    require((configuration in KINDS, unknown))
    name = configuration.replace("_", "-").upper()
    return CONFIGURATIONS[f"CT-{name}"](image_seed=image_seed)


def one_goal(configuration: str, image_seed: int = 1) -> Task:
    """The configuration's task for curricula with a single goal.

    Where all decision states look alike the goal is 1.2, which a deterministic policy without memory never reaches;
    else it is 1.1 or 1.1.1.
    """
    task = configured(configuration, image_seed)
    return task if KINDS[configuration] == "full" else replace(task, goal=(1, 2))


def goal_location(configuration: str, num_frames: int = FRAMES, image_seed: int = 1) -> Curriculum:
    """All goals of one graph in lexicographic order: does a new goal overwrite the old one?

    Args:
        num_frames: frames per task.
        image_seed: seed of the shared image set.
    """
    tasks = axes.all_goals(configured(configuration, image_seed))
    return _curriculum(f"{configuration}_{len(tasks)}tasks", tasks, num_frames)


def instances(
    configuration: str,
    num_frames: int = FRAMES,
    image_seed: int = 1,
    read_noise: int = READ_NOISE,
    read_rotation: int = READ_ROTATION,
) -> Curriculum:
    """All goals of one graph whose images vary on every read: is a class of images recognised by its instances?

    Section 2.4.1 of the paper: each read adds noise and a slight rotation. No two observations of a state are equal, so
    a table of observations does not solve the tasks.

    Args:
        num_frames: frames per task.
        image_seed: seed of the shared image set.
        read_noise: largest addition to each pixel, in 0..255.
        read_rotation: largest rotation in whole degrees, in 0..359.
    """
    task = configured(configuration, image_seed)
    varied = replace(task.observations, read_noise=read_noise, read_rotation=read_rotation)
    tasks = axes.all_goals(replace(task, observations=varied))
    return _curriculum(f"{configuration}_instances", tasks, num_frames)


def depth_growth(configuration: str, num_frames: int = FRAMES, image_seed: int = 1) -> Curriculum:
    """Depth 2 to 5 with nested goals: is a path reused whose end is the way to the next goal?

    The deepest goal is 1.2.1.2.2, and each shallower goal begins it. All graphs use the deepest one's images, so
    no image changes its role.

    Args:
        num_frames: frames per task.
        image_seed: seed of the shared image set.
    """
    task = configured(configuration, image_seed)
    deepest = axes.reshaped(task, replace(task.graph, depth=DEPTHS[-1]), KINDS[configuration], DEEPEST_GOAL)
    tasks = axes.growing_depth(deepest, DEPTHS)
    return _curriculum(f"{configuration}_depth2to5", tasks, num_frames)


def input_variation(configuration: str, num_frames: int = FRAMES, image_seed: int = 1) -> Curriculum:
    """One graph and one goal, shown through four image sets: is the same decision found behind other inputs?

    Args:
        num_frames: frames per task.
        image_seed: seed of the first image set; the others have the next three.
    """
    tasks = axes.image_seeds(one_goal(configuration), _seeds(image_seed))
    return _curriculum(f"{configuration}_{NUM_VARIATIONS}images", tasks, num_frames)


def uncorrelated(configuration: str, num_frames: int = FRAMES, image_seed: int = 1) -> Curriculum:
    """Four tasks with only the shape of the graph in common: each has its own goal and image set.

    Args:
        num_frames: frames per task.
        image_seed: seed of the first image set; the others have the next three. It also draws the goals.
    """
    shown = axes.image_seeds(configured(configuration), _seeds(image_seed))
    goals = axes.random_goals(shown[0], NUM_VARIATIONS, image_seed)
    tasks = [replace(task, goal=other.goal) for task, other in zip(shown, goals, strict=True)]
    return _curriculum(f"{configuration}_uncorrelated", tasks, num_frames)


def dissimilar(configuration: str, num_frames: int = FRAMES, image_seed: int = 1) -> Curriculum:
    """Four tasks that differ in the shape of the graph, in the images and in the goal: is nothing forgotten?

    Section 3.4.1 of the paper: such tasks test for catastrophic forgetting, not transfer. The shapes (b, d) are (2, 2),
    (3, 2), (2, 3) and (3, 3).

    Args:
        configuration: gives the wait probability and what is observed.
        num_frames: frames per task.
        image_seed: seed of the first image set; the others have the next three.
    """
    shown = axes.image_seeds(configured(configuration), _seeds(image_seed))
    tasks = []
    for task, ((b, d), goal) in zip(shown, DISSIMILAR.items(), strict=True):
        graph = CTGraph(b, d, task.graph.wait_prob)
        tasks.append(axes.reshaped(task, graph, KINDS[configuration], goal))
    return _curriculum(f"{configuration}_dissimilar", tasks, num_frames)


def new_decisions(configuration: str, num_frames: int = FRAMES, image_seed: int = 1) -> Curriculum:
    """One goal; decision states get new images with each task, all others keep theirs: variant features.

    Only the new decision images have to be learned.

    Args:
        num_frames: frames per task.
        image_seed: seed of the shared image set.
    """
    return _with_new_images(configuration, "decision", num_frames, image_seed)


def new_waits(configuration: str, num_frames: int = FRAMES, image_seed: int = 1) -> Curriculum:
    """One goal; wait states get new images with each task, all others keep theirs: variant features.

    Only the new wait images have to be learned.

    Args:
        num_frames: frames per task.
        image_seed: seed of the shared image set.
    """
    return _with_new_images(configuration, "wait", num_frames, image_seed)


def _with_new_images(configuration: str, kind: str, num_frames: int, image_seed: int) -> Curriculum:
    tasks = axes.new_images(one_goal(configuration, image_seed), NUM_VARIATIONS, (kind,))
    return _curriculum(f"{configuration}_new_{kind}s", tasks, num_frames)


def similar_goals(name: str, depth: int, num_shared: int, num_frames: int = FRAMES, image_seed: int = 1) -> Curriculum:
    """Surjective graphs whose goals share their first decisions: are the waiting and these decisions reused?

    Section 3.4.1 of the paper, "surjective graph with similar reward locations".

    Args:
        depth: d of the graph, with b=2 and p=0.
        num_shared: shared first decisions, below d; there are 2^(d - num_shared) goals.
        num_frames: frames per task.
        image_seed: seed of the shared image set.
    """
    task = axes.reshaped(ct_su_b1(image_seed=image_seed), CTGraph(2, depth), "surjective", DEEPEST_GOAL[:depth])
    return _curriculum(name, axes.goals_sharing(task, num_shared), num_frames)


def changing_goals(num_frames: int = FRAMES, depth: int = 2, image_seed: int = 1) -> Curriculum:
    """A surjective graph whose goal changes after as many episodes as it has end states: search, then repeat.

    Changes are unannounced. Section 4.2 of the paper reports such graphs of depth 2 and 3 (Ben-Iwhiwhu et al. 2020),
    where RL^2 "failed to solve all tasks". A trial is n = 2^depth episodes with one goal. The best policy tries the end
    states in turn, so it succeeds in episode i of a trial with probability min(1, i/n). Later goals are drawn
    uniformly.

    Args:
        num_frames: frames of all rows together.
        depth: d of the graph, with b=2 and p=0; the paper's are 2 and 3.
        image_seed: seed of the shared image set.
    """
    require((is_int(depth, 1, MOST_DEPTH), f"depth must be an integer in 1..{MOST_DEPTH}, got {depth!r}"))
    n = 2**depth
    task = axes.reshaped(ct_su_b1(image_seed=image_seed), CTGraph(2, depth), "surjective", (1,) * depth)
    trials = Evaluation(50 * n, greedy=False, episodes_per_row=n)
    tasks = axes.all_goals(replace(task, goal_change=(n, n)))
    return axes.sequence("su_b1_changing_goals", [tasks], num_frames, 1, PAPER, evaluation=trials)


def random_graphs(
    num_frames: int = 51_200, image_seed: int = 1, num_tasks: int = 100, seed: int = 2023, held_out: int = 0
) -> Curriculum:
    """A large set of random surjective graphs that share their images: which features are invariant?

    Section 3.5 of the paper: n graphs differ in branching factor (2 or 3), depth (2, 3 or 4), wait probability (0 or
    0.5) and goal, and share the meaning of images.

    Args:
        num_frames: frames per task.
        image_seed: seed of the shared image set.
        num_tasks: how many graphs, n.
        seed: draws the graphs, an integer >= 0.
        held_out: graphs, fewer than n, each with a block after one block of all others, which take turns by episode; 0:
            each graph has its block.
    """
    tasks = axes.random_tasks(num_tasks, seed, kinds=("surjective",), image_seeds=(image_seed,))
    curriculum = _curriculum("random_graphs", tasks, num_frames)
    in_range = is_int(held_out) and 0 <= held_out < num_tasks
    require((in_range, f"held_out must be an integer from 0 to {num_tasks - 1}, got {held_out!r}"))
    if held_out == 0:
        return curriculum
    training = Block(tasks[:-held_out], num_frames * (num_tasks - held_out), ByEpisode())
    return replace(curriculum, blocks=(training, *curriculum.blocks[-held_out:]))


def fo_b2_gradient(num_frames: int = FRAMES, image_seed: int = 1) -> Curriculum:
    """The eight goals of CT-FO-B2 with gradient rewards: every end state pays by its distance from the goal.

    Args:
        num_frames: frames per task.
        image_seed: seed of the shared image set.
    """
    task = replace(ct_fo_b2(image_seed=image_seed), reward_fn=Gradient())
    return _curriculum("fo_b2_gradient", axes.all_goals(task), num_frames)


def fo_b1_noisy(num_frames: int = FRAMES, image_seed: int = 1, reward_std: float = 0.5) -> Curriculum:
    """The four goals of CT-FO-B1 with noisy rewards: end states pay a draw from N(c, reward_std).

    Args:
        num_frames: frames per task.
        image_seed: seed of the shared image set.
        reward_std: standard deviation of what end states pay.
    """
    task = replace(ct_fo_b1(image_seed=image_seed), reward_std=reward_std)
    return _curriculum("fo_b1_noisy", axes.all_goals(task), num_frames)


def fo_b1_stochastic_rewards(num_frames: int = FRAMES, image_seed: int = 1, reward_std: float = 0.1) -> Curriculum:
    """The four goals of CT-FO-B1 with stochastic rewards: normal around the gradient reward, standard deviation 0.1.

    The reward c* of section 2.5 of the paper; Table 3 has 0.1 as a common standard deviation.

    Args:
        num_frames: frames per task.
        image_seed: seed of the shared image set.
        reward_std: standard deviation of what end states pay.
    """
    task = replace(ct_fo_b1(image_seed=image_seed), reward_fn=Gradient(), reward_std=reward_std)
    return _curriculum("fo_b1_stochastic_rewards", axes.all_goals(task), num_frames)


def stochastic_grouped(
    num_frames: int = FRAMES, image_seed: int = 1, group_size: int = 10, within: float = 0.1, between: float = 0.3
) -> Curriculum:
    """The four goals of a fully stochastic graph, b=2, d=2, p=0: all five kinds of states draw images from groups.

    Images of a group are similar to each other and less so to others.

    Args:
        num_frames: frames per task.
        image_seed: seed of the shared image set.
        group_size: images of each kind of state.
        within: expected distance of images of one group.
        between: expected distance of images of different groups.
    """
    images = GroupedImages((group_size,) * 5, within, between, image_seed)
    ranges = [(first, first + group_size - 1) for first in range(0, 5 * group_size, group_size)]
    home, fail, decision, wait, end = ranges
    observations = Observations(wait_ids=wait, decision_ids=decision, end_ids=end, home_ids=home, fail_ids=fail)
    task = Task(CTGraph(2, 2), (1, 1), observations, images)
    return _curriculum("stochastic_grouped", axes.all_goals(task), num_frames)


def co_hard_4tasks(num_frames: int = 1_024_000, image_seed: int = 1, num_wait_images: int = 500) -> Curriculum:
    """The four goals of a confounding graph with p=0.9 and 500 wait images, b=2 and d=2 as CT-CO-B1.

    By section 4.2 of the paper the most complex benchmark of Ladosz et al. 2021 had p=0.9 and 500 observations; it was
    not published.

    Args:
        num_frames: frames per task; an episode without fail takes 33 on average.
        image_seed: seed of the shared image set.
        num_wait_images: images that wait states draw from.
    """
    graph = CTGraph(2, 2, 0.9)
    task = axes.reshaped(ct_su_b1(image_seed=image_seed), graph, "confounding", (1, 1), num_wait_images)
    return _curriculum("co_hard_4tasks", axes.all_goals(task), num_frames)


def _seeds(first: int) -> range:
    return range(first, first + NUM_VARIATIONS)


def _curriculum(name: str, tasks: Tasks | list[Task], num_frames: int) -> Curriculum:
    return axes.sequence(name, tasks, num_frames, 2 if name in VERSION_2 else 1, PAPER)


WAYS = {
    "depth2to5": depth_growth,
    f"{NUM_VARIATIONS}images": input_variation,
    "instances": instances,
    "uncorrelated": uncorrelated,
    "dissimilar": dissimilar,
    "new_decisions": new_decisions,
    "new_waits": new_waits,
}

NAMED = {
    **{f"{name}_{'8' if name == 'fo_b2' else '4'}tasks": partial(goal_location, name) for name in KINDS},
    **{f"{name}_{way}": partial(function, name) for way, function in WAYS.items() for name in KINDS},
    "fo_b2_gradient": fo_b2_gradient,
    "fo_b1_noisy": fo_b1_noisy,
    "fo_b1_stochastic_rewards": fo_b1_stochastic_rewards,
    "su_b1_similar_goals": partial(similar_goals, "su_b1_similar_goals", 2, 1),
    "su_b1_d4_similar_goals": partial(similar_goals, "su_b1_d4_similar_goals", 4, 2),
    "su_b1_changing_goals": changing_goals,
    "random_graphs": random_graphs,
    "stochastic_grouped": stochastic_grouped,
    "co_hard_4tasks": co_hard_4tasks,
}
