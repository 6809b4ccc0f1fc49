"""Evaluation measures what it says, and refuses what it would measure wrongly."""

from __future__ import annotations

from dataclasses import dataclass, replace

import pytest
import torch
from helpers.oracles import act, one_hot, surjective
from helpers.scripted import Scripted, curriculum
from torchrl.envs.utils import ExplorationType, exploration_type

from ctgraph_rl import Block, CTGraphEnv, Evaluation, Gradient, evaluate, learn_curriculum, metrics
from ctgraph_rl.learn.collect import collect
from ctgraph_rl.policies import NavigationPolicy, OptimalPolicy

CHANGING = replace(one_hot(2, 2, goal=(1, 1)), goal_change=(1, 1))


def first_branch(data):
    """Waits and always decides for the first branch, by the one-hot observation."""
    return data.set("action", data["observation"][..., 3].long())


def test_a_reference_policy_is_built_on_the_evaluations_environment():
    tasks = [surjective(2, 2, goal=(2, 1)), surjective(3, 4, goal=(3, 1, 2, 1))]

    result = evaluate(OptimalPolicy, tasks, num_episodes=7)

    assert result["episode_reward"].unique().tolist() == [1.0]
    assert result["step_count"][..., 0].tolist() == [[6] * 7, [10] * 7]


def test_a_reference_policy_of_another_environment_is_refused():
    with pytest.raises(ValueError, match="OptimalPolicy acts in the environment that it was built on"):
        evaluate(OptimalPolicy(CTGraphEnv([surjective()])), [surjective()])


@pytest.mark.parametrize(
    ("tasks", "found"),
    [([surjective(), 3], r"\(<Task .*, 3\); a task is a Task, a"), ([], "none$"), ("x", "'x'; a task is a Task, a")],
)
def test_what_is_no_list_of_tasks_is_refused(tasks, found):
    with pytest.raises(ValueError, match=f"^tasks must be a list with at least one Task, got {found}"):
        evaluate(OptimalPolicy, tasks)


def test_changing_goals_are_measured_over_the_episodes_of_a_row():
    result = evaluate(first_branch, [CHANGING], num_episodes=4000, episodes_per_row=100)

    rate = (result["outcome"] == 3).double().mean().item()
    expected = 1 / 4 + 3 / 4 / 100  # the first goal of a row is the task's own
    assert result.batch_size == torch.Size([1, 4000])
    assert abs(rate - expected) < 5 * (0.1875 / 4000) ** 0.5


def test_changing_goals_are_not_measured_by_first_episodes():
    with pytest.raises(ValueError, match="goal_change need episodes_per_row > 1"):
        evaluate(first_branch, [CHANGING])
    with pytest.raises(ValueError, match="goal_change need episodes_per_row > 1"):
        learn_curriculum(curriculum(Block(CHANGING, 12)), Scripted())


def test_episodes_of_a_row_follow_each_other():
    task = surjective(2, 2, 0.5, goal=(1, 1))

    one_by_one = evaluate(OptimalPolicy, [task], num_episodes=12, episodes_per_row=12)["step_count"]

    env = CTGraphEnv([task])
    data = env.rollout(400, OptimalPolicy(env), break_when_any_done=False)["next"]
    assert one_by_one.flatten().tolist() == data["step_count"][data["done"]].flatten()[:12].tolist()


@pytest.mark.parametrize(
    ("greedy", "expected"), [(True, ExplorationType.DETERMINISTIC), (False, ExplorationType.RANDOM)]
)
def test_a_curriculum_says_whether_it_is_evaluated_greedily(greedy, expected):
    seen = set()

    def policy(data):
        seen.add((len(data), exploration_type()))
        return first_branch(data)

    learn_curriculum(curriculum(Block(one_hot(), 24), num_episodes=7, greedy=greedy), Scripted(policy))

    assert {kind for rows, kind in seen if rows == 7} == {expected}


def test_episodes_that_rows_cannot_share_are_refused():
    with pytest.raises(ValueError, match="num_episodes=10 must be a multiple of episodes_per_row=4"):
        Evaluation(10, episodes_per_row=4)


@pytest.mark.parametrize("frames", [0, -4, 10, 3])
def test_frames_that_are_no_whole_steps_are_refused(frames):
    env = CTGraphEnv([surjective()] * 4)

    with pytest.raises(ValueError, match=f"num_frames must be a multiple of the 4 rows, got {frames}"):
        next(collect(env, first_branch, frames, 3))


def test_a_row_without_noise_is_paid_the_same_beside_a_row_with_noise():
    task = replace(surjective(2, 2, goal=(2, 2)), reward_fn=Gradient(), goal_reward=0.7, step_reward=-0.01)
    alone, beside = CTGraphEnv([task]), CTGraphEnv([task, replace(task, reward_std=0.1)])
    alone.reset()
    beside.reset()

    paid = [(act(alone, [a])["reward"][0], act(beside, [a, a])["reward"][0]) for a in (0, 0, 2, 0, 1, 0)]

    assert all(torch.equal(*pair) for pair in paid)
    assert paid[-1][0].item() == pytest.approx(0.7 * 2 / 3 - 0.01)


@dataclass(frozen=True)
class Needle:
    """Another reward of the same name."""

    def __call__(self, arrival):
        return torch.zeros_like(arrival.leaf, dtype=torch.float32)


def test_the_fingerprint_tells_a_users_reward_from_ours_of_the_same_name():
    ours = curriculum(Block(surjective(), 12))
    theirs = curriculum(Block(replace(surjective(), reward_fn=Needle()), 12))
    gradient = curriculum(Block(replace(surjective(), reward_fn=Gradient()), 12))

    assert len({ours.fingerprint, theirs.fingerprint, gradient.fingerprint}) == 3


@pytest.mark.parametrize("metric", [metrics.backward_transfer, metrics.forward_transfer, metrics.forgetting])
@pytest.mark.parametrize("shape", [(2, 4), (3, 4), (5, 2)])
def test_a_metric_refuses_a_matrix_that_its_definition_does_not_cover(metric, shape):
    with pytest.raises(ValueError, match=f"{shape[0] - 1} blocks and {shape[1]} tasks"):
        metric(torch.zeros(shape, dtype=torch.float64))


def test_the_navigation_policy_in_evaluation_is_as_lucky_as_the_closed_form():
    torch.manual_seed(0)

    wins = (evaluate(NavigationPolicy, [surjective(2, 3)], num_episodes=8000)["outcome"] == 3).sum().item()

    assert abs(wins - 1000) < 5 * (8000 * 7 / 64) ** 0.5
