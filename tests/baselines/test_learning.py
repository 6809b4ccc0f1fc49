"""Learning tests: minutes, not seconds. Run them with ``pytest -m slow``."""

from __future__ import annotations

import math
from fractions import Fraction

import pytest
import torch

from ctgraph_rl import Block, CTGraphEnv, Curriculum, Task, evaluate, learn_curriculum
from ctgraph_rl.core.dynamics import OUTCOME_GOAL
from ctgraph_rl.tasks.configurations import ct_fo_b1, ct_fo_b2
from curricula.paper import ct_su_b1

pytestmark = pytest.mark.slow

FRAMES = 102_400
UNLIKELY = 1e-6


def upper_tail(successes: int, trials: int, probability: Fraction) -> Fraction:
    """P[X >= successes] of a binomial X, exactly."""
    ways = (math.comb(trials, k) * probability**k * (1 - probability) ** (trials - k) for k in range(successes))
    return 1 - sum(ways)


def learnt(build_agent, name: str, task: Task, num_frames: int = FRAMES):
    """An agent that has learned one task with seed 0, and its greedy return."""
    agent = build_agent(name, [task])
    curriculum = Curriculum("one_goal", 1, "theory", [Block(task, num_frames)])
    return agent, learn_curriculum(curriculum, agent, seed=0).performance()[-1].item()


def sampled_successes(agent, task: Task, num_episodes: int = 2000) -> int:
    """Episodes at the goal while exploring or sampling."""
    episodes = evaluate(agent.policy, [task], num_episodes, seed=1, greedy=False, initial_state=agent.initial_state)
    return int((episodes["outcome"] == OUTCOME_GOAL).sum())


@pytest.mark.parametrize(("name", "goal"), [("a2c", (1, 1)), ("dqn", (1, 2))])
def test_agents_learn_goals_of_ct_fo_b1(build_agent, name, goal):
    _, found = learnt(build_agent, name, ct_fo_b1(goal))

    assert found == 1.0


def test_reinforce_learns_a_goal_of_ct_fo_b1(build_agent):
    _, found = learnt(build_agent, "reinforce", ct_fo_b1((1, 2)), 151_552)

    assert found == 1.0


@pytest.mark.parametrize(("name", "goal"), [("lstm_ppo", (1, 2)), ("drqn", (1, 2)), ("qrdqn_lstm", (2, 1))])
def test_agents_with_memory_learn_ct_su_b1(build_agent, name, goal):
    _, found = learnt(build_agent, name, ct_su_b1(goal), 40_960)

    assert found == 1.0


@pytest.mark.parametrize(("name", "goal"), [("dqn", (1, 2)), ("ppo", (1, 2)), ("ppo", (2, 2))])
def test_agents_without_memory_reach_their_ceiling_on_ct_su_b1_and_not_more(build_agent, name, goal):
    task = ct_su_b1(goal)

    agent, greedy = learnt(build_agent, name, task, FRAMES if name == "dqn" else 151_552)

    assert greedy == task.memoryless_ceiling(deterministic=True) == (1.0 if goal == (2, 2) else 0.0)
    if goal == (1, 2):
        successes, ceiling = sampled_successes(agent, task), Fraction(task.memoryless_ceiling())
        assert ceiling == Fraction(1, 4)
        assert upper_tail(successes, 2000, ceiling) > UNLIKELY
        assert name == "dqn" or successes >= 0.18 * 2000


def test_ppo_with_the_bonus_finds_a_goal_that_ppo_does_not_find_yet(build_agent):
    task = ct_fo_b2((1, 2, 1))

    with_bonus, without = (learnt(build_agent, name, task, FRAMES)[1] for name in ("ppo_count", "ppo"))

    assert (with_bonus, without) == (1.0, 0.0)


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
