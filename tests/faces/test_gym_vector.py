"""Gymnasium's vector environment, step for step beside `SyncVectorEnv`."""

from __future__ import annotations

import copy
from dataclasses import replace
from itertools import product

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics as VectorStatistics
from helpers.gym_steps import MODES, act, assert_equal, play
from helpers.oracles import confounding, fully_observable, one_hot, record, scripts, surjective
from helpers.small_agents import others_slow

from ctgraph_rl import CTGraphEnv, Gradient
from ctgraph_rl.gym import CTGraphGymEnv, CTGraphVectorEnv
from ctgraph_rl.tasks.configurations import ct_su_b1

VARIED = {
    "deterministic": surjective(),
    "waits and unique ids": fully_observable(p=0.5, goal=(2, 1)),
    "drawn ids": confounding(p=0.3),
    "noise and rotation": surjective(p=0.2, read_noise=20, read_rotation=5),
    "noise before rotation": surjective(read_noise=9, read_rotation=3, noise_before_rotation=True),
    "reward noise": replace(surjective(p=0.5), reward_std=0.1, fail_reward=-0.5, step_reward=-0.01),
    "reward cue": replace(surjective(reward_cue=True), reward_fn=Gradient()),
    "changing goals": replace(surjective(p=0.1), goal_change=(1, 3)),
    "extra end step": replace(surjective(p=0.1), extra_end_step=True, legacy_goal_change=True, goal_change=(2, 3)),
    "three branches": surjective(b=3, d=3),
    "one-hot": one_hot(p=0.5),
}

every_mode = pytest.mark.parametrize("mode", MODES, ids=[mode.value for mode in MODES])


def both(tasks, mode, **kwargs):
    """The vector environment, and as many single ones in a `SyncVectorEnv`."""
    pool = list(dict.fromkeys(tasks))
    ours = CTGraphVectorEnv(len(tasks), tasks, task_pool=pool, autoreset_mode=mode, **kwargs)
    singles = [lambda task=task: CTGraphGymEnv(task, task_pool=pool, **kwargs) for task in tasks]
    return ours, SyncVectorEnv(singles, autoreset_mode=mode)


@pytest.mark.parametrize(
    ("kind", "mode"),
    others_slow(
        product(VARIED, MODES),
        *((kind, MODES[number % 3]) for number, kind in enumerate(VARIED)),
        *product(["changing goals"], MODES),
    ),
)
def test_the_vector_environment_equals_sync_vector_env_step_for_step(kind, mode):
    ours, theirs = both([VARIED[kind]] * 4, mode)

    played = [play(envs, 11, 60) for envs in (ours, theirs)]

    assert_equal(*played)
    assert any(result[2].sum() > 1 for result in played[0] if len(result) == 5)


@every_mode
def test_lives_hide_their_episodes_and_are_truncated_as_in_sync_vector_env(mode):
    tasks = [VARIED["deterministic"], VARIED["waits and unique ids"]]
    ours, theirs = both([*tasks, *tasks], mode, life=17)

    played = [play(envs, 11, 60) for envs in (ours, theirs)]

    assert_equal(*played)
    steps = [result for result in played[0] if len(result) == 5]
    ended, cut = (np.stack([result[place] for result in steps]) for place in (2, 3))
    assert not ended.any()
    assert cut[16].all() and cut.sum() == 4 * (60 // (17 + (mode == AutoresetMode.NEXT_STEP)))
    assert sum((result[4]["outcome"] > 0).sum() for result in steps) > 20


def test_the_last_state_of_an_episode_in_a_life_takes_one_more_action():
    env = gymnasium.make("ctgraph/CT-SU-B1-v0", life=14)
    env.reset(seed=0)
    optimal = [0, 0, 1, 0, 1, 0]

    steps = [env.step(action) for action in [*optimal, 2, *optimal, 2]]

    rewards = [reward for _, reward, _, _, _ in steps]
    assert rewards == [0, 0, 0, 0, 0, 1, 0] * 2
    assert [truncated for _, _, _, truncated, _ in steps] == [False] * 13 + [True]
    assert not any(terminated for _, _, terminated, _, _ in steps)
    assert np.array_equal(steps[6][0], steps[13][0]) and not np.array_equal(steps[5][0], steps[6][0])


@every_mode
def test_rows_show_the_ids_of_their_tasks_as_sync_vector_env_does(mode):
    tasks = [surjective(goal=(2, 1)), surjective(goal=(1, 2)), surjective(goal=(1, 1))]
    ours, theirs = both(tasks, mode, task_ids=dict(zip(tasks, (2, 0, 3), strict=True)), num_task_ids=5)
    assert ours.observation_space == theirs.observation_space

    played = [play(envs, 11, 60) for envs in (ours, theirs)]
    for envs in (ours, theirs):
        change(envs, tasks[::-1])
    later = [play(envs, 11, 60) for envs in (ours, theirs)]

    assert_equal(*played)
    assert_equal(*later)
    shown = [results[0][0]["task_id"].argmax(1).tolist() for results in (played[0], later[0])]
    assert shown == [[2, 0, 3], [3, 0, 2]]
    assert ours.observation_space.contains(later[0][-1][0])


def change(envs, tasks):
    """Give the rows other tasks."""
    if isinstance(envs, CTGraphVectorEnv):
        envs.set_tasks(tasks)
    else:
        for env, task in zip(envs.envs, tasks, strict=True):
            env.unwrapped.set_task(task)


def test_gymnasium_makes_environments_that_show_ids():
    first, second = ct_su_b1((1, 1)), ct_su_b1((2, 1))
    given = {"task": first, "task_pool": (first, second), "task_ids": {first: 0, second: 1}}

    one = gymnasium.make("ctgraph/CTGraph-v0", **given)
    many = gymnasium.make_vec("ctgraph/CTGraph-v0", 2, vectorization_mode="vector_entry_point", **given)

    before = one.reset(seed=0)[0]
    one.unwrapped.set_task(second)
    after = one.reset()[0]
    assert [before["task_id"].tolist(), after["task_id"].tolist()] == [[1, 0], [0, 1]]
    assert one.step(0)[0]["task_id"].tolist() == [0, 1] and one.observation_space.contains(after)
    assert many.reset(seed=0)[0]["task_id"].tolist() == [[1, 0], [1, 0]]
    with pytest.raises(ValueError, match="task_ids must name every task of the pool, got none for"):
        gymnasium.make("ctgraph/CTGraph-v0", **given | {"task_ids": {first: 0}})


@every_mode
def test_rows_of_different_tasks_equal_sync_vector_env(mode):
    tasks = [task for name, task in VARIED.items() if name not in ("three branches", "one-hot")]

    played = [play(envs, list(range(50, 50 + len(tasks))), 120) for envs in both(tasks, mode)]

    assert_equal(*played)


@every_mode
def test_what_was_returned_is_not_overwritten_and_may_be_written_into(mode):
    envs, twin = (CTGraphVectorEnv(4, confounding(p=0.5), autoreset_mode=mode) for _ in range(2))
    expected = play(twin, 3, 100)

    results = play(envs, 3, 100)
    kept = copy.deepcopy(results)
    play(envs, 4, 100)
    spoiled = play(Spoiler(envs), 3, 100)

    assert_equal(results, kept)
    assert_equal(results, expected)
    assert_equal(spoiled, expected)


class Spoiler:
    """Writes into all arrays that an environment returns, after copying them."""

    def __init__(self, envs):
        self.envs, self.num_envs, self.metadata = envs, envs.num_envs, envs.metadata
        self.single_action_space = envs.single_action_space

    def reset(self, **kwargs):
        return self.spoiled(self.envs.reset(**kwargs))

    def step(self, actions):
        result = self.spoiled(self.envs.step(actions))
        actions[:] = 77
        return result

    def spoiled(self, results):
        kept = copy.deepcopy(results)
        for array in results:
            for each in array.values() if isinstance(array, dict) else [array]:
                if isinstance(each, np.ndarray) and each.dtype != object:
                    each[...] = 1
        return kept


def test_row_i_has_the_stream_of_its_own_seed_and_row_zero():
    task, seeds = fully_observable(p=0.5), [5, 123456789012345678, 0]
    actions = scripts(60, 3)
    envs = CTGraphVectorEnv(3, task, autoreset_mode="SameStep")

    shown = [envs.reset(seed=seeds)[0], *(envs.step(action.numpy())[0] for action in actions)]

    for row, seed in enumerate(seeds):
        data = record(CTGraphEnv([task], seed=seed), actions[:, row : row + 1])
        expected = data["observation"][0].numpy()
        assert np.array_equal(np.stack(shown)[:-1, row], expected)


def test_the_first_reset_without_a_seed_draws_one_and_later_resets_go_on():
    env, envs = CTGraphGymEnv(confounding()), CTGraphVectorEnv(8, confounding())
    env.np_random, envs.np_random = np.random.default_rng(1), np.random.default_rng(1)
    first, twin = env.reset()[0], CTGraphGymEnv(confounding())
    twin.np_random = np.random.default_rng(1)

    shown = [env.reset()[0] for _ in range(20)]
    wait_images = [env.step(0)[0].tobytes() for _ in range(20) if env.reset()]

    assert np.array_equal(first, twin.reset()[0])
    assert all(np.array_equal(first, other) for other in shown)
    assert len(set(wait_images)) > 5
    envs.reset()
    assert len({image.tobytes() for image in envs.step(np.zeros(8, int))[0]}) > 3


@every_mode
def test_a_mask_resets_and_seeds_its_rows_and_leaves_the_others(mode):
    ours, theirs = both([confounding(p=0.5, read_noise=5)] * 4, mode)
    mask = np.array([True, False, False, True])

    def script(envs):
        results = [envs.reset(seed=[1, 2, 3, 4]), envs.step(np.zeros(4, int))]
        results.append(envs.reset(seed=[9, 9, None, None], options={"reset_mask": mask.copy()}))
        results += [envs.step(np.zeros(4, int)) for _ in range(2)]
        results.append(envs.reset(seed=70, options={"reset_mask": ~mask}))
        results += [envs.step(np.zeros(4, int)) for _ in range(1)]
        return [*results, envs.reset(seed=[None, 6, None, 8]), envs.step(np.zeros(4, int)), envs.reset()]

    assert_equal(script(ours), script(theirs))


@every_mode
def test_tasks_change_at_the_next_reset_of_a_row(mode):
    pool = [surjective(p=0.3), fully_observable(p=0.6, goal=(2, 2)), replace(confounding(), goal_change=(1, 2))]
    ours, theirs = both([pool[0], pool[1], pool[2], pool[0]], mode)
    wanted = [pool[1], pool[2], pool[0], pool[0]]

    def script(envs):
        results = play(envs, 1, 50)
        if envs is ours:
            envs.set_tasks(wanted)
        else:
            for env, task in zip(envs.envs, wanted, strict=True):
                env.set_task(task)
        rng = np.random.default_rng(8)
        for _ in range(100):
            results.append(envs.step(act(rng, 4)))
            if mode == AutoresetMode.DISABLED and results[-1][2].any():
                results.append(envs.reset(options={"reset_mask": results[-1][2].copy()}))
        return results

    played = [script(envs) for envs in (ours, theirs)]

    assert_equal(*played)
    assert played[0][0][1]["task"].tolist() == [0, 1, 2, 0]
    assert played[0][-1][-1]["task"].tolist() == [1, 2, 0, 0]


@every_mode
def test_episode_statistics_of_the_vector_environment_are_those_of_its_episodes(mode):
    plans = {0: (0, 0, 1, 0, 1, 0), 1: (0, 1), 2: (0, 0, 1, 0, 2, 0)}
    envs = VectorStatistics(CTGraphVectorEnv(3, surjective(), autoreset_mode=mode))
    envs.reset(seed=0)
    step, recorded = np.zeros(3, int), {row: set() for row in plans}

    for _ in range(30):
        _, _, done, _, infos = envs.step(np.array([(*plans[row], 0)[step[row]] for row in plans]))
        resets = done if mode != AutoresetMode.NEXT_STEP else step == [len(plan) for plan in plans.values()]
        step = np.where(resets, 0, step + 1)
        for row in done.nonzero()[0]:
            recorded[row].add((infos["episode"]["r"][row], infos["episode"]["l"][row]))
        if mode == AutoresetMode.DISABLED and done.any():
            envs.reset(options={"reset_mask": done})

    assert recorded == {0: {(1.0, 6)}, 1: {(0.0, 2)}, 2: {(0.0, 6)}}


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_a_row_whose_task_stays_goes_on_with_its_goals_while_others_change(mode):
    stays = replace(ct_su_b1(), goal_change=(1, 2))
    other = replace(stays, goal=(2, 2))
    envs = CTGraphVectorEnv(3, stays, task_pool=[stays, other], autoreset_mode=mode)
    twins = [CTGraphGymEnv(stays, task_pool=[stays, other]) for _ in range(3)]
    sync = SyncVectorEnv([lambda twin=twin: twin for twin in twins], autoreset_mode=AutoresetMode(mode))
    envs.reset(seed=5), sync.reset(seed=5)
    envs.set_tasks([stays, other, stays])
    twins[1].set_task(other)
    rng = np.random.default_rng(0)

    for number in range(60):
        mask = np.array([True, number % 3 == 2, number % 2 == 0])
        if mode == "Disabled":
            envs.reset(options={"reset_mask": mask})
            sync.reset(options={"reset_mask": mask.copy()})
        else:
            actions = rng.integers(0, 3, 3)
            envs.step(actions), sync.step(actions)
        assert envs.rows.goal_leaf.tolist() == [twin.rows.goal_leaf.item() for twin in twins]
