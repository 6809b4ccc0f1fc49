"""Length of episodes and frames to the goal of the uniformly random policy: closed forms against the environment."""

import math
from dataclasses import replace
from itertools import product

import pytest
import torch
from helpers.oracles import act, surjective, uniform
from torch import Tensor

from ctgraph_rl.core.graph import StateType
from ctgraph_rl.core.tree import State, is_done, transition, tree_params
from ctgraph_rl.env import CTGraphEnv
from ctgraph_rl.policies import RandomPolicy
from ctgraph_rl.tasks.configurations import ct_su_b1
from ctgraph_rl.tasks.task import Task
from ctgraph_rl.tasks.values import random_episode_length, random_frames_to_goal

SHAPES = [(2, 1, 0.0), (2, 2, 0.5), (3, 2, 0.25), (2, 1, 0.9), (2, 4, 0.25), (4, 3, 0.0)]


def chains(task: Task) -> tuple[Tensor, Tensor]:
    """The uniformly random policy as Markov chains between states, from the environment's transition.

    Returns:
        Probabilities [n, n] that an episode goes on, home first, and that the search for the goal does: it goes on
        from home when an episode ends elsewhere.
    """
    b, p, leaves = task.graph.branching_factor, task.graph.wait_prob, task.graph.num_decision_states
    tree = tree_params(*map(single, (b, leaves, int(p * 2**63))), single(task.extra_end_step).bool())
    goal = (StateType.END, leaves + task.goal_leaf)
    places, moves = {(0, 0): 0}, {}
    while len(moves) < len(places):
        start = list(places)[len(moves)]
        moves[start] = []
        for action, (stays, prob) in product(range(b + 1), ((False, 1 - p), (True, p))):
            state = State(single(start[0]).to(torch.uint8), single(start[1]))
            after = transition(state, single(action), single(stays).bool(), tree)
            key, ends = (after.state_type.item(), after.node.item()), is_done(after, tree).item()
            moves[start].append((key, ends, prob / (b + 1)))
            if not ends:
                places.setdefault(key, len(places))
    episode, search = torch.zeros(2, len(places), len(places), dtype=torch.float64)
    for start, (key, ends, prob) in ((place, move) for place, each in moves.items() for move in each):
        if not ends:
            episode[places[start], places[key]] += prob
        if key != goal:
            search[places[start], 0 if ends else places[key]] += prob
    return episode, search


def single(value: int) -> Tensor:
    return torch.tensor([int(value)])


def expected_steps(chain: Tensor) -> float:
    """Mean steps from the first state until the chain stops."""
    identity = torch.eye(len(chain), dtype=torch.float64)
    return torch.linalg.solve(identity - chain, torch.ones(len(chain), dtype=torch.float64))[0].item()


def test_random_frames_by_hand():
    # a wait is left with 1/3, a decision with 2/3: 1 + (1 + 2/9) + 1/3 steps, and 1/27 to the goal
    assert random_episode_length(surjective(d=1)) == 23 / 9
    assert random_frames_to_goal(surjective(d=1)) == 69.0
    assert random_frames_to_goal(surjective(d=2)) == 651.0


@pytest.mark.parametrize("extra", [False, True])
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_random_frames_are_those_of_the_environment_s_chain(shape, extra):
    task = replace(surjective(*shape), extra_end_step=extra)

    episode, search = chains(task)

    assert random_episode_length(task) == pytest.approx(expected_steps(episode), rel=1e-12)
    assert random_frames_to_goal(task) == pytest.approx(expected_steps(search), rel=1e-9)


@pytest.mark.parametrize(
    "task", [surjective(2, 1, 0.5), replace(surjective(3, 2), extra_end_step=True)], ids=["p", "x"]
)
def test_random_episodes_of_the_environment_have_that_length(task):
    env = CTGraphEnv([task] * 16_384, seed=5, check_actions=False)
    policy, lengths = uniform(7), torch.zeros(16_384, dtype=torch.float64)
    data = env.reset()
    running = torch.ones(16_384, dtype=torch.bool)
    while running.any():
        lengths += running
        data = act(env, policy(env), data)
        running &= ~data["done"].squeeze(-1)

    standard_error = lengths.std() / 128
    assert abs(lengths.mean() - random_episode_length(task)) < 4.9 * standard_error  # two-sided 1e-6


def test_more_frames_than_a_float_holds_are_infinite():
    task = surjective(2, 60, 1 - 2**-53)

    assert task.graph.reward_prob_random == 0.0
    assert random_frames_to_goal(task) == math.inf


def test_the_random_policy_needs_the_expected_frames():
    torch.manual_seed(0)
    env = CTGraphEnv([ct_su_b1((1, 1))] * 512, seed=3)
    data = env.rollout(400, RandomPolicy(env), break_when_any_done=False)

    goals = (data["next", "outcome"][data["next", "done"]] == 3).sum().item()

    expected = data.numel() / random_frames_to_goal(ct_su_b1((1, 1)))
    assert abs(goals - expected) < 5 * expected**0.5
