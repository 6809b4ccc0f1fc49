"""The extra end step of the authors' implementation: an episode is over one step after its reward."""

from __future__ import annotations

from dataclasses import dataclass, replace

import pytest
import torch
from helpers.oracles import (
    DECISION,
    END,
    FAIL,
    HOME,
    act,
    optimal,
    surjective,
)
from helpers.task_families import SWITCHED, VECTORS, extra
from tensordict import TensorDict
from torchrl.envs import check_env_specs

from ctgraph_rl import (
    CTGraphEnv,
    evaluate,
)
from ctgraph_rl.policies import OptimalPolicy


def test_an_episode_is_over_one_step_after_its_reward_and_shows_home_again():
    env = CTGraphEnv([extra(surjective(goal=(2, 1))), surjective(goal=(2, 1))], check_actions=False)
    env.reset()

    data = torch.stack([act(env, [action] * 2).clone() for action in (0, 0, 2, 0, 1, 0, 2)], 1)

    assert data["reward"][..., 0].tolist() == [[0, 0, 0, 0, 0, 1, 0]] * 2
    assert data["done"][..., 0].tolist() == [[False] * 6 + [True], [False] * 5 + [True] * 2]
    assert torch.equal(data["done"], data["terminated"]) and not data["truncated"].any()
    assert data["outcome"][..., 0].tolist() == [[0] * 6 + [3], [0] * 5 + [3] * 2]
    assert data["leaf"][..., 0].tolist() == [[-1] * 6 + [2], [-1] * 5 + [2] * 2]
    assert data["episode_reward"][0, :, 0].tolist() == [0] * 5 + [1] * 2
    assert data["step_count"][0, :, 0].tolist() == list(range(1, 8))
    assert not data["is_init"].any()
    assert (env.state_type.tolist(), env.observation_id.tolist()) == ([HOME, END], [0, 4])


def test_any_action_ends_an_episode_at_its_end_state_and_what_is_over_stays_over():
    env = CTGraphEnv([extra(surjective(3, 1))] * 4, check_actions=False)
    env.reset()
    for action in (0, 0, 2, 0):
        act(env, [action] * 4)

    first, again = (act(env, [0, 1, 2, 3]).clone() for _ in range(2))

    assert first["done"].all() and again["done"].all()
    assert first["outcome"].unique().tolist() == again["outcome"].unique().tolist() == [2]
    assert first["leaf"].unique().tolist() == again["leaf"].unique().tolist() == [1]
    assert env.state_type.unique().tolist() == [HOME]


def test_an_episode_with_the_same_draws_is_exactly_one_step_longer():
    task = surjective(2, 3, 0.7, goal=(1, 2, 2))
    lengths, returns = [], []
    for each in (task, extra(task)):
        ends = evaluate(OptimalPolicy, [each], 500, seed=3)
        lengths.append(ends["step_count"])
        returns.append(ends["episode_reward"])

    assert lengths[0].unique().numel() > 10
    assert torch.equal(lengths[1], lengths[0] + 1)
    assert torch.equal(*returns)


@pytest.mark.parametrize(("actions", "length"), [([0, 1], 2), ([0, 0, 0], 3), ([0, 0, 1, 2], 4)])
def test_a_failure_ends_an_episode_at_once(actions, length):
    env = CTGraphEnv([extra(surjective(), fail_reward=-0.5)])
    env.reset()

    data = [act(env, [action]).clone() for action in actions]

    assert [step["done"].item() for step in data] == [False] * (length - 1) + [True]
    assert (data[-1]["reward"].item(), data[-1]["outcome"].item(), data[-1]["leaf"].item()) == (-0.5, 1, -1)
    assert env.state_type.item() == FAIL


def test_rows_with_and_without_an_extra_step_start_anew_each_in_its_time():
    tasks = [extra(surjective()), surjective(), extra(surjective(2, 1)), surjective(2, 1)]
    env = CTGraphEnv(tasks)

    data = env.rollout(420, OptimalPolicy(env), break_when_any_done=False)

    assert [row["is_init"].sum().item() for row in data] == [420 // length for length in (7, 6, 5, 4)]
    assert [row["next", "step_count"][row["next", "done"]].unique().tolist() for row in data] == [[7], [6], [5], [4]]


def test_a_step_of_an_end_state_is_checked_as_one_of_a_running_row():
    env = CTGraphEnv([extra(surjective(2, 1)), surjective(2, 2)])
    env.reset()
    for action in (0, 0, 1, 0):
        act(env, [action] * 2)

    assert env.state_type.tolist() == [END, DECISION]
    act(env, [2, 1])
    with pytest.raises(ValueError, match=r"rows \[0\] are done: reset them first"):
        act(env, [0, 0])


def test_a_planner_can_go_back_to_the_step_between_reward_and_end():
    tasks = [extra(SWITCHED[1]), extra(surjective(2, 2)), surjective(2, 3)]
    env = CTGraphEnv(tasks)
    env.reset()
    for _ in range(6):
        act(env, optimal(env))
    saved = env.get_state()
    over = act(env, [1, 2, 1]).clone()

    data = env.reset(TensorDict({"state": saved.clone()}, [3]), set_state=True)
    again = act(env, [1, 2, 1])

    assert saved["state_type"].tolist() == [END, END, DECISION]
    assert not data["done"].any() and data["outcome"].unique().tolist() == [0]
    assert (again == over).all() and over["done"].flatten().tolist() == [True, True, False]


@pytest.mark.parametrize(("row", "kind", "node"), [(0, HOME, 3), (0, HOME, 4), (1, END, 4), (0, END, 0), (0, END, 2)])
def test_a_row_that_is_over_or_at_an_end_state_that_its_tree_does_not_have_is_no_state_to_go_back_to(row, kind, node):
    env = CTGraphEnv([extra(surjective()), surjective()])
    env.reset()
    given = env.get_state()
    given["state_type"][row], given["node"][row] = int(kind), node

    with pytest.raises(
        ValueError, match=rf"rows \[{row}\] of the given state are finished or no states of their trees"
    ):
        env.reset(TensorDict({"state": given}, [2]), set_state=True)


def test_torchrl_finds_the_specs_of_switched_rows_in_order():
    for tasks in (SWITCHED, VECTORS):
        check_env_specs(CTGraphEnv(tasks), break_when_any_done="both")


def test_the_cue_shows_what_an_end_state_pays_without_the_reward_of_the_step():
    rewards = [(1.0, -0.01), (0.1, -0.02), (0.2, -0.026), (8.0, 0.5)]
    env = CTGraphEnv([replace(surjective(reward_cue=True), goal_reward=g, step_reward=s) for g, s in rewards])
    env.reset()

    for _ in range(6):
        data = act(env, optimal(env))

    assert data["observation"][:, 0, 6, 6].tolist() == [254] * 4


@dataclass(frozen=True)
class LongVectors:
    """A user's own vectors, longer than there are ids."""

    num_images: int = 5
    num_variants: int = 1
    shape: tuple[int, ...] = (10,)
    cue_element = True

    def bank(self, read_rotation):
        return torch.eye(5, 10, dtype=torch.uint8)


def test_the_cue_of_a_users_vectors_is_in_their_last_element():
    env = CTGraphEnv(
        [replace(surjective(), images=LongVectors(), observations=surjective(reward_cue=True).observations)]
    )
    env.reset()

    for _ in range(6):
        data = act(env, optimal(env))

    assert data["observation"].tolist() == [[0, 0, 0, 0, 1, 0, 0, 0, 0, 254]]
