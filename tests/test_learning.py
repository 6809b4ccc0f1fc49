"""Learning tests: minutes, not seconds. Run them with ``pytest -m slow``."""

from __future__ import annotations

import math
from fractions import Fraction
from itertools import product

import pytest
import torch

import curricula
from ctgraph_rl import Block, CTGraphEnv, Curriculum, evaluate, learn_curriculum
from ctgraph_rl.dynamics import OUTCOME_GOAL
from curricula.paper import ct_su_b1

pytestmark = pytest.mark.slow

DQN_FRAMES = 102_400


def upper_tail(successes: int, trials: int, probability: Fraction) -> Fraction:
    """P[X >= successes] of a binomial X, exactly."""
    ways = (math.comb(trials, k) * probability**k * (1 - probability) ** (trials - k) for k in range(successes))
    return 1 - sum(ways)


def test_lstm_ppo_learns_every_task_of_su_b1_4tasks_in_its_own_block(build_agent):
    curriculum = curricula.load("su_b1_4tasks")
    agent = build_agent("lstm_ppo", curriculum.tasks)

    performance = learn_curriculum(curriculum, agent, seed=0).performance()

    assert curriculum.evaluation.num_episodes >= 100
    assert performance[1:].diagonal().min() >= 0.95
    assert performance[0].mean() <= 0.5


@pytest.mark.parametrize("goal", list(product((1, 2), repeat=2)))
def test_dqn_without_memory_finds_only_goals_that_repeat_one_decision(build_agent, goal):
    task = ct_su_b1(goal)
    curriculum = Curriculum("one_goal", 1, "theory", [Block(task, DQN_FRAMES)])
    agent = build_agent("dqn", [task])

    performance = learn_curriculum(curriculum, agent, seed=0).performance()

    assert performance[-1].tolist() == [1.0 if goal[0] == goal[1] else 0.0]
    if goal[0] != goal[1]:
        sampled = evaluate(agent.policy, [task], 2000, seed=1, greedy=False)
        successes = int((sampled["outcome"] == OUTCOME_GOAL).sum())
        assert upper_tail(successes, 2000, Fraction(1, 4)) > 1e-6


@pytest.mark.parametrize("goal", [(1, 2), (2, 1)])
def test_no_memoryless_policy_finds_a_goal_of_two_different_decisions_in_more_than_a_quarter_of_episodes(goal):
    plans = torch.cartesian_prod(*[torch.arange(3)] * 6)
    env = CTGraphEnv([ct_su_b1(goal)] * len(plans))
    seen, data = [], env.reset()
    for action in plans.T:
        seen.append(env.observation_id.clone())
        step, data = env.step_and_maybe_reset(data.set("action", action.contiguous()))
    reached = ((step["next", "outcome"] == OUTCOME_GOAL) & (step["next", "step_count"] == 6)).flatten()
    decision_id, wait_id = 2, 3

    def success(first: float, second: float) -> float:
        """Exact probability of the goal for a policy that only waits where it should."""
        chances = torch.zeros(5, 3, dtype=torch.float64)
        chances[:, 0] = 1.0
        chances[decision_id] = torch.tensor([1 - first - second, first, second], dtype=torch.float64)
        of_plan = torch.stack([chances[ids, action] for ids, action in zip(seen, plans.T, strict=True)]).prod(dim=0)
        return of_plan[reached].sum().item()

    grid = [(first / 20, second / 20) for first in range(21) for second in range(21 - first)]
    found = [success(first, second) for first, second in grid]

    assert found == pytest.approx([first * second for first, second in grid], abs=1e-12)
    assert max(found) == success(0.5, 0.5) == 0.25
    assert wait_id in seen[1] and decision_id in seen[2]
