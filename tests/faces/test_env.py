"""The batched environment: specs, data, resets, tasks that change, TorchRL's own tools."""

import dataclasses

import pytest
import torch
from helpers.oracles import (
    ALPHA,
    DECISION,
    FORKS,
    HOME,
    STATE,
    WAIT,
    act,
    binomial_p_value,
    confounding,
    fully_observable,
    one_hot,
    optimal,
    play,
    record,
    scripts,
    surjective,
)
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs import StepCounter, TransformedEnv, check_env_specs

from ctgraph_rl import CTGraphEnv, OneHot, PaperImages
from ctgraph_rl.core.dynamics import NO_LEAF, OUTCOME_GOAL, OUTCOME_RUNNING

MIXED = [
    surjective(2, 1, goal=(2,)),
    surjective(2, 3, p=0.5, goal=(1, 2, 1)),
    fully_observable(3, 2, goal=(3, 1)),
    confounding(4, 1, p=0.9, goal=(4,), read_noise=9),
    surjective(3, 2, goal=(2, 2), image_seed=2, read_rotation=20),
]
"""Tasks that differ in every field a batch may mix."""

FAMILIES = {
    "surjective": [surjective()] * 3,
    "fully observable": [fully_observable()] * 3,
    "fully observable b=3": [fully_observable(3, 2)] * 3,
    "confounding": [confounding()] * 3,
    "one-hot": [one_hot()] * 3,
    "noise and rotation": [surjective(read_noise=20, read_rotation=30)] * 3,
    "p > 0": [surjective(p=0.9)] * 3,
    "mixed": MIXED,
    "mixed one-hot": [one_hot(), one_hot(3, 3, images=OneHot(9))],
    "84 pixels": [dataclasses.replace(surjective(), images=PaperImages(5, size=84))],
}

KEYS = ("observation", "step_count", "episode_reward", "outcome", "leaf", "done", "terminated", "truncated", "is_init")


@pytest.mark.parametrize("tasks", FAMILIES.values(), ids=FAMILIES)
def test_torchrl_finds_the_specs_of_every_family_in_order(tasks):
    env = CTGraphEnv(tasks)

    check_env_specs(env, break_when_any_done="both")


def test_images_have_the_promised_keys_shapes_and_types():
    env = CTGraphEnv([surjective()] * 3)

    data = env.rollout(1)[:, 0]

    expected = {
        "observation": ((3, 1, 12, 12), torch.uint8),
        "is_init": ((3, 1), torch.bool),
        "step_count": ((3, 1), torch.int64),
        "episode_reward": ((3, 1), torch.float32),
        "outcome": ((3, 1), torch.uint8),
        "leaf": ((3, 1), torch.int64),
        "done": ((3, 1), torch.bool),
        "terminated": ((3, 1), torch.bool),
        "truncated": ((3, 1), torch.bool),
    }
    reward = {"reward": ((3, 1), torch.float32)}
    assert env.batch_size == torch.Size([3])
    assert (data["action"].shape, data["action"].dtype) == ((3,), torch.int64)
    assert {k: (tuple(v.shape), v.dtype) for k, v in data["next"].items()} == expected | reward
    assert {k: (tuple(v.shape), v.dtype) for k, v in env.reset().items()} == expected


def test_one_hot_observations_are_vectors():
    env = CTGraphEnv([one_hot(), one_hot()])

    observation = env.reset()["observation"]

    assert observation.dtype == torch.uint8
    assert observation.tolist() == [[1, 0, 0, 0, 0], [1, 0, 0, 0, 0]]


def test_one_hot_rows_are_padded_with_zeros_to_the_length_of_the_pool():
    short, long = one_hot(images=OneHot(5)), one_hot(images=OneHot(7))
    env = CTGraphEnv([short, short], task_pool=[short, long])

    env.reset()
    act(env, [0, 0])
    observation = act(env, [0, 1])["observation"]

    assert observation.tolist() == [[0, 0, 0, 1, 0, 0, 0], [0, 1, 0, 0, 0, 0, 0]]
    assert env.observation_spec["observation"].shape == (2, 7)


def test_the_action_spec_holds_the_wait_action_and_the_largest_branching_factor_of_the_pool():
    env = CTGraphEnv([surjective(2)], task_pool=[surjective(2), surjective(5)])

    assert env.action_spec.n == 6
    assert env.action_spec.shape == (1,)
    assert env.action_spec.dtype == torch.int64


def test_the_hidden_markov_state_is_not_in_the_data():
    env = CTGraphEnv([fully_observable()] * 2)

    keys = {key[-1] if isinstance(key, tuple) else key for key in env.rollout(3).keys(True, True)}

    assert keys == {
        *("observation", "action", "reward", "done", "terminated", "truncated"),
        *("is_init", "step_count", "episode_reward", "outcome", "leaf"),
    }


def test_every_image_set_is_held_once():
    tasks = [surjective(goal=goal, image_seed=seed) for goal in ((1, 1), (2, 2)) for seed in (1, 2)]
    turned = surjective(image_seed=1, read_rotation=3)

    rows = [len(CTGraphEnv(pool).rows.bank) for pool in (tasks[:1] * 9, tasks, [*tasks, turned])]

    assert rows == [5, 10, 10 + 5 * 4]


def test_the_terminal_observation_is_the_image_of_the_end_state():
    task = fully_observable(2, 2, goal=(2, 1))
    env = CTGraphEnv([task])

    actions = torch.tensor([0, 0, 2, 0, 1, 0]).view(-1, 1)
    data = record(env, actions)

    shown = data["next", "observation"][0, :, 0]
    assert data["next", "done"].flatten().tolist() == [False] * 5 + [True]
    assert torch.equal(shown, task.images.images[[2, 9, 4, 11, 7, 14]])
    assert env.state_type.item() == HOME


def test_the_terminal_observation_of_a_failed_episode_is_the_fail_image():
    task = surjective()
    env = CTGraphEnv([task])

    data = record(env, torch.tensor([[0], [1]]))

    assert torch.equal(data["next", "observation"][0, 1, 0], task.images.images[1])


def test_is_init_marks_the_first_observation_of_each_episode():
    env = CTGraphEnv([surjective(2, 1)])

    data = record(env, torch.tensor([[0], [0], [1], [0], [0], [1], [0]]))

    assert data["is_init"].flatten().tolist() == [True, False, False, False, True, False, True]
    assert data["next", "is_init"].any().item() is False
    assert data["step_count"].flatten().tolist() == [0, 1, 2, 3, 0, 1, 0]
    assert data["next", "step_count"].flatten().tolist() == [1, 2, 3, 4, 1, 2, 1]
    assert data["next", "episode_reward"].flatten().tolist() == [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    assert data["episode_reward"].flatten().tolist() == [0.0] * 7


def test_recorded_data_do_not_change_with_later_steps():
    env = CTGraphEnv(MIXED)
    data = env.reset()
    before = data.clone()

    record(env, scripts(20, 5), data.clone())

    assert (data == before).all()


def test_the_flags_of_a_step_share_no_memory():
    env = CTGraphEnv([surjective()])
    env.reset()

    data = act(env, [0])

    assert len({data[flag].data_ptr() for flag in ("done", "terminated", "truncated", "is_init")}) == 4


def test_a_partial_reset_leaves_the_other_rows_bit_identical():
    env = CTGraphEnv([confounding(p=0.5, read_noise=50, read_rotation=40)] * 4, seed=1)
    env.reset()
    data = act(env, [0] * 4)
    state = {name: getattr(env.rows, name).clone() for name in STATE}
    mask = torch.tensor([True, False, False, True])

    after = env.reset(data.clone().set("_reset", mask.unsqueeze(-1)))

    assert all((after[key] == data[key])[~mask].all() for key in KEYS)
    assert all(torch.equal(getattr(env.rows, name)[~mask], state[name][~mask]) for name in STATE)
    assert env.state_type[mask].tolist() == [HOME, HOME] and env.state_type[~mask].tolist() == [WAIT, WAIT]
    assert after["is_init"].flatten().tolist() == [True, False, False, True]


def test_a_partial_reset_does_not_change_the_future_of_the_other_rows():
    tasks, actions = [confounding(p=0.5, read_noise=50)] * 4, scripts(30, 4)
    env, undisturbed = CTGraphEnv(tasks, seed=1), CTGraphEnv(tasks, seed=1)
    mask = torch.tensor([[True], [False], [False], [True]])
    disturbed = env.reset(act(env, [0] * 4, env.reset()).clone().set("_reset", mask))

    data = record(env, actions, disturbed.exclude("reward"))
    expected = record(undisturbed, actions, act(undisturbed, [0] * 4, undisturbed.reset()).exclude("reward"))

    assert (data["next"] == expected["next"])[1:3].all()
    assert not (data["next"] == expected["next"])[[0, 3]].all()


@pytest.mark.parametrize("steps", range(1, 7))
def test_a_reset_at_any_moment_starts_a_whole_new_episode(steps):
    env = CTGraphEnv([dataclasses.replace(surjective(2, 2, goal=(2, 1)), fail_reward=-1.0)])
    for action in ([0, 0, 2, 0, 1, 0], [0, 0, 2, 0, 1, 1], [0, 0, 2, 2], [0, 1]):
        env.reset()
        for a in action[:steps]:
            act(env, [a])
        start = env.reset()

        assert (env.state_type.item(), env.node.item(), env.observation_id.item()) == (HOME, 0, 0)
        assert (start["step_count"].item(), start["episode_reward"].item()) == (0, 0.0)
        assert (start["outcome"].item(), start["leaf"].item(), start["done"].item()) == (
            OUTCOME_RUNNING,
            NO_LEAF,
            False,
        )
        assert play(env, optimal)["step_count"].item() == 6


def test_set_tasks_changes_the_tasks_in_place():
    env = CTGraphEnv([FORKS[0], FORKS[3]], task_pool=FORKS)
    rows, bank = env.rows, env.rows.bank

    env.set_tasks([FORKS[1], FORKS[2]])
    last = play(env, optimal)

    assert env.tasks == (FORKS[1], FORKS[2])
    assert last["leaf"].flatten().tolist() == [1, 2]
    assert last["episode_reward"].flatten().tolist() == [1.0, 1.0]
    assert env.rows is rows
    assert env.rows.bank is bank


def test_set_tasks_may_change_every_field_that_a_batch_may_mix():
    env = CTGraphEnv(MIXED)

    env.set_tasks(MIXED[::-1])
    changed = record(env, scripts(50, 5))

    fresh = CTGraphEnv(MIXED[::-1])
    assert (changed == record(fresh, scripts(50, 5))).all()


def test_set_tasks_ends_all_episodes():
    env = CTGraphEnv(FORKS)
    env.reset()
    act(env, [0] * 4)

    env.set_tasks(FORKS)

    with pytest.raises(ValueError, match=r"rows \[0, 1, 2, 3\] are done: reset them first"):
        act(env, [0] * 4)
    assert env.reset()["is_init"].all() and act(env, [0] * 4)["step_count"].tolist() == [[1]] * 4


def test_a_state_dict_of_the_middle_of_an_episode_resumes_bit_exactly():
    tasks = [confounding(p=0.5, read_noise=50, read_rotation=40), *MIXED]
    env, actions = CTGraphEnv(tasks, seed=1, first_row=3), scripts(60, 6)
    env.reset()
    data = act(env, [0] * 6).exclude("reward").clone()
    state = {name: value.clone() for name, value in env.state_dict().items()}
    expected = record(env, actions, data.clone())

    resumed = CTGraphEnv(tasks, seed=99)
    resumed.load_state_dict(state)

    assert (record(resumed, actions, data.clone()) == expected).all()


def test_a_step_counter_gives_a_time_limit():
    env = TransformedEnv(CTGraphEnv([surjective()] * 3), StepCounter(max_steps=2))
    waits = TensorDictModule(lambda leaf: torch.zeros(3, dtype=torch.int64), in_keys=["leaf"], out_keys=["action"])

    check_env_specs(env)
    data = env.rollout(4, waits)

    assert data.shape == (3, 2)
    assert data["next", "truncated"].squeeze(-1).tolist() == [[False, True]] * 3
    assert data["next", "terminated"].any().item() is False


def test_a_collector_collects_whole_episodes():
    torch.manual_seed(0)
    env = CTGraphEnv([surjective(2, 1, goal=(2,))] * 8)
    collector = Collector(env, frames_per_batch=8 * 200, total_frames=8 * 200, auto_register_policy_transforms=True)

    data = next(iter(collector))
    collector.shutdown()

    done, goal = data["next", "done"], data["next", "outcome"] == OUTCOME_GOAL
    assert data.shape == (8, 200)
    assert torch.equal(data["is_init"][:, 1:], done[:, :-1])
    assert torch.equal(data["next", "episode_reward"] == 1, goal)
    assert binomial_p_value(goal.sum().item(), done.sum().item(), 1 / 27) >= ALPHA


def test_policies_given_the_unbatched_action_spec_act_on_the_whole_batch():
    env = CTGraphEnv([surjective(2)] * 4)

    assert env.action_spec_unbatched.shape == ()
    assert env.action_spec_unbatched.n == 3


def test_rows_of_a_mixed_batch_show_images_of_their_own_sets():
    tasks = [surjective(image_seed=seed) for seed in (1, 2, 3)]
    env = CTGraphEnv(tasks)

    observation = env.reset()["observation"][:, 0]

    assert torch.equal(observation, torch.stack([task.images.images[0] for task in tasks]))
    assert len(observation.flatten(1).unique(dim=0)) == 3


def test_a_decision_state_is_followed_by_the_wait_state_of_the_chosen_child():
    env = CTGraphEnv([surjective(3, 2)] * 3)
    env.reset()
    act(env, [0] * 3)
    act(env, [0] * 3)
    kinds = env.state_type.tolist()

    act(env, [1, 2, 3])

    assert kinds == [DECISION] * 3
    assert env.state_type.tolist() == [WAIT] * 3
    assert env.node.tolist() == [1, 2, 3]


def test_an_environment_takes_any_iterable_of_tasks():
    env = CTGraphEnv(task for task in FORKS)

    assert env.tasks == tuple(FORKS)
    assert env.reset(TensorDict(batch_size=[4])).shape == (4,)
