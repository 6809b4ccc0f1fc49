"""The task and policy of a command line of ``ctgraph-rl draw`` or ``ctgraph-rl play``."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import NamedTuple

from ctgraph_rl import parsers
from ctgraph_rl.checks import NamedValues, is_int, require
from ctgraph_rl.draw.layout import write_short
from ctgraph_rl.learn.collect import InitialState, Policy
from ctgraph_rl.play.player import Player
from ctgraph_rl.play.visits import Visits, visits
from ctgraph_rl.policies import NavigationPolicy, OptimalPolicy, RandomPolicy
from ctgraph_rl.runs.config import curriculum_of
from ctgraph_rl.runs.load import load
from ctgraph_rl.runs.settings import curriculum_names
from ctgraph_rl.tasks.configurations import make_task
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.task import Task, ct_graphs

POLICIES: dict[str, Policy] = dict(zip(parsers.POLICIES, (RandomPolicy, NavigationPolicy, OptimalPolicy), strict=True))


class Selection(NamedTuple):
    """A task, and the policy that acts in it.

    Args:
        policy: as for `evaluate`, or None.
    """

    task: Task
    name: str
    policy: Policy | None = None
    initial_state: InitialState | None = None
    curriculum: Curriculum | None = None

    def player(self, seed: int, greedy: bool) -> Player:
        """Return the policy in its own environment."""
        return Player(self.task, self.policy, self.initial_state, seed=seed, greedy=greedy, curriculum=self.curriculum)

    def visits(self, num_episodes: int, seed: int, greedy: bool) -> Visits:
        """Count where the policy goes, with as many successive episodes in a row as the curriculum says."""
        assert self.policy is not None
        in_row = 1 if self.curriculum is None else self.curriculum.evaluation.episodes_per_row
        count = partial(visits, self.task, self.policy, self.initial_state, curriculum=self.curriculum)
        return count(max(1, num_episodes // in_row) * in_row, seed, greedy=greedy, episodes_per_row=in_row)


def select(arguments: argparse.Namespace) -> Selection:
    """Return the named task and policy.

    Raises:
        ValueError: for unknown names and values that exclude each other.
        OSError: for files that cannot be read.
    """
    given = {name: getattr(arguments, name) for name in (*parsers.CHANGES, "goal")}
    changes = {name: value for name, value in given.items() if value is not None}
    changes |= {"fully_observable": False} if arguments.surjective else {}
    if arguments.run is not None:
        require((arguments.name is None and not changes, "--run names the curriculum: choose its task with --task"))
        trained = load(arguments.run)
        selection = _select_of_curriculum(trained.curriculum, arguments.task)
        policy = trained.policy_for(selection.task)
        initial_state = trained.agent.initial_state
        return selection._replace(policy=policy, initial_state=initial_state, curriculum=trained.curriculum)
    selection = _select_task(arguments.name, arguments.task, changes, arguments.config_dir)
    return selection if arguments.policy is None else selection._replace(policy=POLICIES[arguments.policy])


def _select_task(name: str | None, number: int, changes: NamedValues, config_dir: Path | None) -> Selection:
    own = name in curriculum_names(config_dir)
    if name is None:
        return _name_task("CT-graph", make_task(**changes))
    if not own and name.endswith(".json"):
        return _name_task(name, make_task(config=name, **changes))
    if not own and "-" in name:  # as in the paper's labels and in no curriculum's name
        return _name_task(name.upper(), make_task(name.upper(), **changes))
    require((not changes, f"the tasks of a curriculum cannot be changed here: {name} takes no {', '.join(changes)}"))
    return _select_of_curriculum(curriculum_of(name, config_dir), number)


def _name_task(name: str, task: Task) -> Selection:
    return Selection(task, f"{name}, goal {write_short(task.goal)}")


def _select_of_curriculum(curriculum: Curriculum, number: int) -> Selection:
    tasks = curriculum.tasks
    labels = curriculum.labels
    rule = f"--task must be in 1..{len(tasks)}, the tasks of {curriculum.name}, got {number}"
    require((is_int(number, 1, len(tasks)), rule))
    (task,) = ct_graphs([tasks[number - 1]], "a drawing or a game")
    return Selection(task, f"{curriculum.name}, task {number}: {labels[number - 1]}")
