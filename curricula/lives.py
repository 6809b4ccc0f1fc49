"""Lives of many tasks, each drawn by seed when it is needed."""

from __future__ import annotations

from collections.abc import Sequence

from ctgraph_rl.checks import by_name, require
from ctgraph_rl.core.goal import Goal
from ctgraph_rl.tasks.curriculum import Curriculum, Stream
from ctgraph_rl.tasks.life import Life
from ctgraph_rl.tasks.protocol import Evaluation
from ctgraph_rl.tasks.task import Task
from curricula.configured import from_axes, several

VERSION = 1

SOURCE = "ctgraph_rl, after Mesbahi et al. 2025, arXiv 2404.02113"

CONFLICT = "ctgraph_rl, after Abbas et al. 2023, arXiv 2303.07507"

EVALUATIONS = 8


def stream(
    num_tasks: int = 100,
    num_frames: int = 24_576,
    order: str = "dissimilar",
    share: float = 0.5,
    lag: int = 10,
    seed: int | None = None,
    configuration: str | Sequence[str] = "fo_b1",
    branching_factor: int | None = None,
    depth: int | Sequence[int] | None = None,
    wait_prob: float | Sequence[float] | None = None,
    image_seeds: int | Sequence[int] | None = None,
    goals: str | float | Sequence[Goal] = "all",
    goal_reward: float = 1.0,
    fail_reward: float = 0.0,
    step_reward: float = 0.0,
    reward_std: float = 0.0,
    reward_fn: str | Sequence[str] = "needle",
) -> Curriculum:
    """A life of many tasks, each drawn by seed when it is needed: does a learner keep learning?

    A task is drawn uniformly from all combinations of the lists, and of their goals. Each block has eight evaluations,
    if ``num_frames`` is a multiple of eight.

    Args:
        num_tasks: tasks of the life, one a block, at most 100,000.
        num_frames: frames per block.
        order: ``similar``, all on one image set; ``dissimilar``, each on another; ``returning``, as dissimilar, but a
            share comes again; ``drifting``, one decision or the image set changes at a time; ``conflicting``, on one
            image set, all decisions change at a time.
        share: of blocks with a task that returns, in (0, 1].
        lag: blocks between a task and its return.
        seed: draws the tasks; None: the run's seed, so that seeds have different lives.
        configuration: fo_b1, fo_b2, su_b1, co_b1 or posr_b1, or several.
        branching_factor: another b; None: as configured.
        depth: another d, or several, with the ids of the deepest graph; None: as configured.
        wait_prob: another p, or several; None: as configured.
        image_seeds: image sets to draw from; None: always a new one.
        goals: ``all``, or a list of goals such as [1.2,2.1].
        goal_reward: reward at the goal.
        fail_reward: reward at the fail state.
        step_reward: reward of every step, in addition.
        reward_std: standard deviation of the noise on the reward of end states.
        reward_fn: what end states pay, ``needle``, ``gradient`` or ``reference_linear``, or several.

    Raises:
        ValueError: for values out of range.
    """
    require((goals not in ("random", "nested"), f"goals must be all or a list such as [1.2,2.1], got {goals!r}"))
    choices: list[Task] = []
    for each in several(configuration):
        for pays in several(reward_fn):
            drawn_from = from_axes(
                configuration=each,
                branching_factor=branching_factor,
                depth=depth,
                wait_prob=wait_prob,
                goals=goals,
                goal_reward=goal_reward,
                fail_reward=fail_reward,
                step_reward=step_reward,
                reward_std=reward_std,
                reward_fn=pays,
            )
            choices += drawn_from.examples  # type: ignore[arg-type]
    sets = () if image_seeds is None else several(image_seeds)
    blocks = Life(tuple(choices), num_tasks, num_frames, order=order, image_seeds=sets, share=share, lag=lag, seed=seed)
    every = num_frames // EVALUATIONS if num_frames % EVALUATIONS == 0 else 0
    return Stream("stream", VERSION, SOURCE, blocks, Evaluation(every=every, tasks="seen", exact=True))


def goal_conflict(num_frames: int = 98_304, depth: int = 3, num_tasks: int = 2, seed: int | None = None) -> Curriculum:
    """Two goals on the same images that disagree at every decision: does the first slow down the second?

    Evaluation samples actions, so that a success rate is no coin, 48 times a block if ``num_frames`` is a multiple.

    Args:
        num_frames: frames per goal.
        depth: decisions to the goal.
        num_tasks: goals.
        seed: draws images and goals; None: the run's seed, so that seeds have different ones.
    """
    life = stream(num_tasks, num_frames, "conflicting", seed=seed, depth=depth).blocks
    every = num_frames // 48 if num_frames % 48 == 0 else 0
    how = Evaluation(greedy=False, every=every, tasks="seen", exact=True)
    return Stream("goal_conflict", 1, CONFLICT, life, how)  # type: ignore[arg-type]


NAMED = by_name(goal_conflict, stream)
