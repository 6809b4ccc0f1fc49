"""Tasks that change where episodes start: when that takes effect, and that nothing else depends on it."""

from __future__ import annotations

import copy
import pickle
from dataclasses import replace

import pytest
import torch
from helpers.oracles import (
    ALPHA,
    PlainCTGraph,
    act,
    binomial_p_value,
    one_hot,
    record,
    scripts,
    surjective,
)
from helpers.small_agents import others_slow
from helpers.task_families import RICH, env_of, started, switching
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import step_mdp

from ctgraph_rl import CTGraphEnv, Rows
from ctgraph_rl.tasks.switch import AtRandom, ByEpisode, Drift, Switch

FORKS = [one_hot(2, 2, goal=goal) for goal in ((1, 1), (1, 2), (2, 1), (2, 2))]
"""Tasks without draws or images, for counting."""

TREES = [surjective(2, 1, goal=(2,)), surjective(3, 2, goal=(3, 1), image_seed=2), surjective(2, 3, image_seed=3)]
"""Tasks that `PlainCTGraph` knows, with images of their own."""


PER_ROW = [ByEpisode(2), AtRandom(0.4), Drift(3)]
TOGETHER = [ByEpisode(2, True), AtRandom(0.4, True), Drift(3, True)]


def same(first: TensorDict, second: TensorDict) -> bool:
    """Whether data are equal, bit by bit and key by key."""
    return set(first.keys(True, True)) == set(second.keys(True, True)) and bool((first == second).all())


# Where a change takes effect


@pytest.mark.parametrize("switch", PER_ROW[:1] + TOGETHER[:1])
def test_every_episode_follows_the_tree_goal_and_images_of_its_own_task(switch):
    env = env_of(TREES, switch, 5)
    plain, shown_ids = [PlainCTGraph(TREES[0]) for _ in range(5)], set()
    data = env.reset()

    for actions in scripts(150, 5, num_actions=4):
        before = env.tasks
        step, data = env.step_and_maybe_reset(data.set("action", actions))
        expected = [row.step(action) for row, action in zip(plain, actions.tolist(), strict=True)]
        assert {key: [now[key] for now in expected] for key in expected[0]} == {
            key: step["next", key].flatten().tolist() for key in expected[0]
        }
        assert data["is_init"].flatten().tolist() == [now["done"] for now in expected]
        for row, now in enumerate(expected):
            assert env.tasks[row] == before[row] or now["done"]
            assert step["next", "task_id"][row].argmax() == TREES.index(before[row])
            assert data["task_id"][row].argmax() == TREES.index(env.tasks[row])
            if now["done"]:
                plain[row] = PlainCTGraph(env.tasks[row])
                assert torch.equal(data["observation"][row, 0], env.tasks[row].images.images[0])
                shown_ids.add(data["task_id"][row].argmax().item())

    assert shown_ids == {0, 1, 2}


def test_rewards_and_waiting_are_those_of_the_episodes_task():
    poor, rich = replace(one_hot(2, 1), fail_reward=-1), replace(one_hot(2, 1, p=0.9), goal_reward=4, step_reward=0.25)
    env = env_of([poor, rich], ByEpisode(), 400)
    env.reset()

    failed = [act(env, [1] * 400)["reward"].unique().tolist() for _ in range(2)]
    env.reset()
    act(env, [0] * 400)
    stayed = act(env, [0] * 400)

    assert failed == [[0.0], [-1.0]]
    assert stayed["reward"].unique().tolist() == [0.25]
    assert binomial_p_value(int((env.state_type == 1).sum()), 400, 0.9) >= ALPHA


def test_goals_that_change_start_anew_with_their_task_and_last_as_long():
    first, second = (
        replace(one_hot(2, 8, goal=goal), goal_change=(n, n)) for goal, n in (((1,) * 8, 3), ((2,) * 8, 4))
    )
    rows = switching([first, second], ByEpisode(5), 2, seed=1)

    goals = torch.stack([(rows.reset(), rows.goal_leaf)[1] for _ in range(15)])

    for start, own, lasts in ((0, 0, 3), (5, 255, 4), (10, 0, 3)):
        assert goals[start : start + lasts].unique().tolist() == [own]
        assert (goals[start + lasts : start + 5] != own).all()


def test_a_goal_that_changes_goes_on_where_another_row_has_a_new_task():
    changing, other = replace(one_hot(2, 8), goal_change=(3, 3)), one_hot(2, 8, goal=(2,) * 8)
    rows = Rows([changing] * 2, task_pool=[changing, other])
    rows.reset(), rows.reset()
    rows.set_tasks([other, changing], at_episode_end=True)

    goals = [(rows.reset(), rows.goal_leaf.tolist())[1] for _ in range(2)]

    assert goals[0] == [255, 0]
    assert goals[1][0] == 255 and goals[1][1] != 0


def drive(kind: str, env: CTGraphEnv, actions: Tensor) -> TensorDict:
    """Data of actions by one of the ways in which TorchRL starts episodes."""
    if kind == "fused":
        return record(env, actions)
    if kind == "wrapped":
        return record(TransformedEnv(env), actions)
    if kind == "rollout":
        script = iter(actions)
        return env.rollout(
            len(actions), lambda tensordict: tensordict.set("action", next(script)), break_when_any_done=False
        )
    data, steps = env.reset(), []
    for action in actions:
        steps.append(env.step(data.set("action", action)).clone())
        data = step_mdp(steps[-1])
        if data["done"].any():
            data = env.reset(data.set("_reset", data["done"].clone()))
    return torch.stack(steps, dim=1)


@pytest.mark.parametrize("switch", others_slow([*PER_ROW, *TOGETHER], PER_ROW[1], TOGETHER[0]))
def test_every_way_of_starting_episodes_gives_the_same_data(switch):
    actions = scripts(36, 6, num_actions=4)

    fused, *others = (
        drive(kind, env_of(RICH, switch), actions) for kind in ("fused", "wrapped", "rollout", "reset by hand")
    )

    assert fused["task_id"].flatten(0, 1).sum(0).min() > 10
    assert all(same(fused.select(*other.keys(True, True)), other) for other in others)


@pytest.mark.parametrize("switch", others_slow([*PER_ROW, *TOGETHER], *PER_ROW, TOGETHER[1]))
def test_rows_change_their_tasks_alike_in_all_calls_that_start_episodes(switch):
    batches = [switching(RICH, switch, 6, seed=4) for _ in range(3)]
    first, second, third = batches
    generator, seen = torch.Generator().manual_seed(2), set()
    everyone = torch.ones(6, dtype=torch.bool)
    begun = [first.reset().observation, second.restart(), third.reset(everyone).observation]
    assert all(torch.equal(begun[0], other) for other in begun)

    for actions in scripts(40, 6, num_actions=4):
        mask = torch.rand(6, generator=generator) < 0.3
        reset, restarted = first.reset(mask).observation, second.restart(mask)
        mixed = third.step_or_reset(actions, mask).observation
        assert torch.equal(reset, restarted) and torch.equal(reset[mask], mixed[mask])
        assert all(torch.equal(first.task, other.task) for other in batches)
        third.state = first.state
        assert all(torch.equal(*pair) for pair in zip(first.state, second.state, strict=True))
        stepped = [rows.step(actions).observation for rows in batches]
        assert all(torch.equal(stepped[0], other) for other in stepped)
        seen.update(first.task.tolist())
    assert len(seen) > 1


@pytest.mark.parametrize("switch", PER_ROW)
def test_a_changing_row_depends_on_its_seed_and_number_alone(switch):
    actions = scripts(24, 6, num_actions=4)

    whole = record(env_of(RICH, switch), actions)

    assert whole["task_id"].flatten(0, 1).sum(0).min() > 5
    for first, last in ((0, 1), (1, 4), (4, 6)):
        part = record(env_of(RICH, switch, last - first, first_row=first), actions[:, first:last])
        assert same(whole[first:last], part)


@pytest.mark.parametrize("switch", PER_ROW[1:])
def test_rows_and_seeds_change_their_tasks_differently(switch):
    found = [started(switching(FORKS[:2], switch, 64, seed=seed), 3)[2] for seed in (1, 2)]

    assert not torch.equal(*found)
    assert all(0 < row.sum() < 64 for row in found)


@pytest.mark.parametrize("switch", others_slow([*PER_ROW, *TOGETHER], *PER_ROW, TOGETHER[1]))
def test_a_seed_starts_the_switch_anew(switch):
    env, actions = env_of(RICH, switch), scripts(40, 6, num_actions=4)
    first = record(env, actions)

    env.set_seed(3)

    assert env.tasks == (RICH[0],) * 6
    assert same(record(env, actions), first)


# Checkpoints and copies


def half_way(switch: Switch | None, pending: bool) -> CTGraphEnv:
    """In the middle of a switch, or of a change at the end of the episode."""
    env = env_of(RICH, switch)
    record(env, scripts(15, 6, num_actions=4))
    if pending and switch is not None:
        env.switch_tasks(RICH[1:], switch, at_episode_end=True)
    elif pending:
        env.set_tasks(RICH[1:] * 3, at_episode_end=True)
        action, data = scripts(1, 6)[0], env.reset(TensorDict({"_reset": torch.arange(6).view(6, 1) < 2}, [6]))
        env.step_and_maybe_reset(data.set("action", action))
    return env


HALF_WAY = [(None, True), *((switch, pending) for switch in (*PER_ROW, *TOGETHER[1:]) for pending in (False, True))]


@pytest.mark.parametrize(("switch", "pending"), others_slow(HALF_WAY, *HALF_WAY[::2]))
def test_a_checkpoint_in_the_middle_of_a_change_is_continued_bit_for_bit(switch, pending):
    env, other = half_way(switch, pending), env_of(RICH, None, seed=8)
    if switch is not None:
        other.switch_tasks(RICH[1:] if pending else RICH, switch)
    saved = copy.deepcopy(env.state_dict())
    actions, data = scripts(30, 6, num_actions=4, seed=1), env.reset(TensorDict({"_reset": env.rows.is_done}, [6]))

    other.load_state_dict(saved)
    again = other.reset(TensorDict({"_reset": other.rows.is_done}, [6]))

    assert other.tasks == env.tasks
    assert same(record(other, actions, again), record(env, actions, data))


def pickled(env: CTGraphEnv) -> CTGraphEnv:
    return pickle.loads(pickle.dumps(env))


@pytest.mark.parametrize(
    ("clone", "switch", "pending"),
    [*((copy.deepcopy, *each) for each in HALF_WAY[:3]), (pickled, *HALF_WAY[2])],
)
def test_a_copy_goes_on_as_its_original_and_neither_disturbs_the_other(clone, switch, pending):
    env, twin = half_way(switch, pending), half_way(switch, pending)
    actions, data = scripts(20, 6, num_actions=4, seed=1), env.reset(TensorDict({"_reset": env.rows.is_done}, [6]))
    again = twin.reset(TensorDict({"_reset": twin.rows.is_done}, [6]))

    cloned = clone(env)
    expected = record(twin, actions, again)

    assert same(record(cloned, actions, data.clone()), expected)
    assert same(record(env, actions, data), expected)
