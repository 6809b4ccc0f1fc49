"""Policies and learners that a profile is tried with, and what they score."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch

import curricula
from ctgraph_rl import Curriculum, RunLog
from ctgraph_rl.core.graph import StateType
from ctgraph_rl.learn.evaluate import Evaluator
from ctgraph_rl.policies import NavigationPolicy, OptimalPolicy, RandomPolicy
from ctgraph_rl.profile.floors import best_by_step
from ctgraph_rl.profile.properties import Evidence, Measured, measure
from ctgraph_rl.profile.scoring import Score, score_of
from curricula.profile import PROPERTIES

LATE = 10**9
"""Number of an evaluation that never comes."""


class Constant(RandomPolicy):
    """Always the first branch."""

    def action(self, tensordict):
        return torch.ones_like(self.env.node)


class OneBranch(NavigationPolicy):
    """Waits where it must, and decides for the first branch."""

    def decision(self, tensordict):
        return torch.ones_like(self.env.node)


class SequenceByImage(RandomPolicy):
    """The best sequence of actions for the graph that the first image tells; ignores all that comes after."""

    def action(self, tensordict):
        step = tensordict["step_count"].squeeze(-1)
        decides = (step >= 2) & (step % 2 == 0)
        actions = []
        for task, number in zip(self.env.tasks, (step // 2 - 1).tolist(), strict=True):
            actions.append(task.goal[number] if 0 <= number < len(task.goal) else 0)
        return torch.where(decides, torch.tensor(actions), 0)


class ByStep(NavigationPolicy):
    """The best decision for the image and the number of the step."""

    def decision(self, tensordict):
        steps = tensordict["step_count"].flatten().tolist()
        decisions = []
        for task, step in zip(self.env.tasks, steps, strict=True):
            if task.observations.unique_decisions:
                decisions.append(0)
            else:
                _, best = best_by_step(task.graph.branching_factor, task.graph.wait_prob, task.goal_decisions)
                decisions.append(best[min(step, len(best) - 1)])
        right = self._of_goal(tensordict)
        return torch.where(torch.tensor(decisions) == 0, right, torch.tensor(decisions))

    def _of_goal(self, tensordict):
        return OptimalPolicy.decision(OptimalPolicy(self.env), tensordict)


class Memoryless(OptimalPolicy):
    """Waits where it must; where decision states share an image, it draws a branch as often as the goal takes it."""

    def decision(self, tensordict):
        right = super().decision(tensordict)
        shares = torch.tensor([task.goal.count(1) / len(task.goal) for task in self.env.tasks])
        drawn = 2 - (torch.rand(len(shares)) < shares).long()
        sees = torch.tensor([task.observations.unique_decisions for task in self.env.tasks])
        return torch.where(sees, right, drawn)


class RandomAtNewImages(OptimalPolicy):
    """Acts at random at wait images that were not trained."""

    def action(self, tensordict):
        trained = torch.tensor([task.observations.wait_ids[0] < 100 for task in self.env.tasks])
        strange = ~trained & (self.env.state_type == StateType.WAIT)
        return torch.where(strange, self._random_below(self.env.branching_factor + 1), super().action(tensordict))


class EachEndOnce(OptimalPolicy):
    """Goes to another end state in each episode, and does not care whether it was the goal."""

    def __init__(self, env):
        super().__init__(env)
        self.target = torch.zeros_like(env.node)

    def action(self, tensordict):
        begins = tensordict["is_init"].squeeze(-1)
        self.target = torch.where(begins, (self.target + 1) % self.env.num_end_states, self.target)
        return super().action(tensordict)

    def decision(self, tensordict):
        return self._towards(self.target)


class OnePath(OptimalPolicy):
    """Goes to the first end state in each episode."""

    def decision(self, tensordict):
        return self._towards(torch.zeros_like(self.env.goal_leaf))


def score_of_policy(name: str, policy: type[RandomPolicy], num_episodes: int = 20, num_seeds: int = 10) -> Score:
    """Return the score of a policy that never learns, over seeds."""
    curriculum = curricula.load(name)
    how = replace(curriculum.evaluation, num_episodes=num_episodes, every=0)
    curriculum = replace(curriculum, evaluation=how)
    results = []
    for seed in range(num_seeds):
        log = RunLog()
        evaluator = Evaluator(curriculum, seed, log)
        for frames in curriculum.ends:
            evaluator.evaluate(policy, frames, "after")
        results.append(measured(name, log, curriculum))
    return score_of(results, PROPERTIES[name].controls)


def measured(name: str, log: RunLog, curriculum: Curriculum, controls: tuple[Evidence, ...] = ()) -> Measured:
    """Return what a log says of a property."""
    return measure(Evidence(log, curriculum, Path("nowhere")), controls, PROPERTIES[name])


Learner = Callable[[Curriculum, int, int], int]
"""Says for a curriculum, a block and a task, from 0, from which evaluation of the block on, from 1, it is solved."""


def life(name: str, learner: Learner) -> Evidence:
    """Return a life of a learner whose return on a task is 0 until it is solved, and 1 from then on."""
    curriculum = curricula.load(name)
    log = RunLog()
    log.append("run", trained=[[1 + task for task in block] for block in curriculum.trained])
    start = 0
    for block, end in enumerate(curriculum.ends):
        moments = [frames for frames in curriculum.moments if start < frames <= end]
        for number, frames in enumerate(moments, 1):
            moment = "after" if frames == end else "during"
            for task in range(len(curriculum.tasks)):
                solved = task in curriculum.trained[block] and number >= learner(curriculum, block, task)
                values = {"block": block + 1, "frames": frames, "task": task + 1, "return_mean": float(solved)}
                log.append("evaluation", **values, moment=moment)
        start = end
    return Evidence(log, curriculum, Path(name))


def score_of_learner(name: str, learner: Learner, num_seeds: int = 2) -> Score:
    """Return the score of a learner over seeds, with a life on each control."""
    prop = PROPERTIES[name]
    results = []
    for _ in range(num_seeds):
        run = life(name, learner)
        controls = [life(control, learner) for control in prop.controls]
        results.append(measure(run, controls, prop))
    return score_of(results, prop.controls)
