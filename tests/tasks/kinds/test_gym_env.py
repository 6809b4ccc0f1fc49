"""Rows of Gymnasium against a plain loop over its single environments."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete

from ctgraph_rl.batch.gym_env import GymEnv
from ctgraph_rl.tasks.kinds.gym_task import GymTask

CART = GymTask("CartPole-v1", max_episode_steps=12)
LAKE = GymTask("FrozenLake-v1")


class Counts(gymnasium.Env):
    """Shows how many steps its episode has, as an image of 2 x 3 pixels with one channel; ends after three steps."""

    observation_space, action_space = Box(0, 255, (2, 3, 1), np.uint8), Discrete(2, start=5)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps, self.first = 0, int(self.np_random.integers(100))
        return self._image(), {}

    def step(self, action):
        assert action in self.action_space
        self.steps += 1
        return self._image(), 1.0, self.steps == 3, False, {}

    def _image(self):
        image = np.zeros((2, 3, 1), dtype=np.uint8)
        image[0, 2], image[1, 0] = self.steps, self.first
        return image


class Forgets(Counts):
    """Ignores the seed of a reset."""

    def reset(self, *, seed=None, options=None):
        return super().reset()


class Shows(Counts):
    """Shows a dictionary."""

    observation_space = Dict({"image": Counts.observation_space})


for kind in (Counts, Forgets, Shows):
    gymnasium.register(f"test/{kind.__name__}-v0", kind, max_episode_steps=9)


def of_row(task, seed, row, actions):
    """Play a row's actions in a single environment, a new seed for each episode; yield what each step shows."""
    env, episode = task.make(), 0
    begun = env.reset(seed=seed_of(seed, row, episode))[0]
    for action in actions:
        seen, reward, terminated, truncated, _ = env.step(action)
        before, begun = begun, seen
        if terminated or truncated:
            episode += 1
            begun = env.reset(seed=seed_of(seed, row, episode))[0]
        yield before, seen, reward, terminated, truncated


def seed_of(seed, row, episode):
    return int(np.random.SeedSequence((seed, row, episode)).generate_state(1)[0] >> 1)


def played(env, num_steps, seed=0):
    torch.manual_seed(seed)
    return env.rollout(num_steps, break_when_any_done=False)


def test_a_row_shows_the_last_observation_of_an_episode_and_then_the_first_of_the_next_as_gymnasium_gives_them():
    steps = played(GymEnv([CART] * 3, seed=7), 40)

    for row in range(3):
        shown = zip(*of_row(CART, 7, row, steps["action"][row].tolist()), strict=True)
        before, after, rewards, terminated, truncated = map(np.array, shown)
        assert np.array_equal(steps["observation"][row], before)
        assert np.array_equal(steps["next", "observation"][row], after)
        assert steps["next", "reward"][row, :, 0].tolist() == rewards.tolist()
        assert steps["next", "terminated"][row, :, 0].tolist() == terminated.tolist()
        assert steps["next", "truncated"][row, :, 0].tolist() == truncated.tolist()
    assert steps["next", "truncated"].any()
    assert steps["next", "terminated"].any()


def test_counts_and_sums_begin_again_with_each_episode():
    steps = played(GymEnv([GymTask("test/Counts-v0")] * 2), 7)

    assert steps["next", "step_count"][0, :, 0].tolist() == [1, 2, 3, 1, 2, 3, 1]
    assert steps["next", "episode_reward"][1, :, 0].tolist() == [1, 2, 3, 1, 2, 3, 1]
    assert steps["is_init"][0, :, 0].tolist() == [True, False, False, True, False, False, True]
    assert steps["next", "is_init"].any().item() is False


def test_images_are_shown_channels_first_and_integers_as_one_hot():
    image = played(GymEnv([GymTask("test/Counts-v0")]), 1)["next", "observation"][0, 0]
    lake = played(GymEnv([LAKE]), 1)["observation"][0, 0]

    assert (image.dtype, list(image.shape)) == (torch.uint8, [1, 2, 3])
    assert image[0, 0, 2] == 1
    assert lake.tolist() == [1] + [0] * 15


def test_a_row_changes_its_task_where_its_episode_ends_and_shows_its_id():
    long = GymTask("CartPole-v1", max_episode_steps=500)
    env = GymEnv([CART] * 2, task_pool=[CART, long], task_ids={CART: 0, long: 1}, num_task_ids=2)
    data = env.reset()
    env.set_tasks([long] * 2, at_episode_end=True)
    ids = []
    for _ in range(14):
        data["action"] = torch.tensor([0, 0])
        step, data = env.step_and_maybe_reset(data)
        ids.append((step["next", "done"][0].item(), step["next", "task_id"][0].tolist(), data["task_id"][0].tolist()))

    end = [done for done, *_ in ids].index(True)
    assert ids[end] == (True, [1, 0], [0, 1])
    assert all(shown == ([1, 0] if i < end else [0, 1]) for i, (_, _, shown) in enumerate(ids))


def test_a_restored_environment_goes_on_with_the_same_bits():
    env, other = GymEnv([LAKE, LAKE], seed=3), GymEnv([LAKE, LAKE], seed=3)
    data = env.reset()
    torch.manual_seed(0)
    for _ in range(17):
        _, data = env.step_and_maybe_reset(env.rand_action(data))

    other.load_state_dict(env.state_dict())

    for _ in range(30):
        env.rand_action(data)
        step, following = env.step_and_maybe_reset(data.clone())
        again, data = other.step_and_maybe_reset(data.clone())
        assert all(step[key].equal(again[key]) for key in step.keys(True, True))
        assert all(following[key].equal(data[key]) for key in data.keys(True, True))


def test_a_restored_row_still_changes_its_task_where_its_episode_ends():
    long = GymTask("CartPole-v1", max_episode_steps=500)
    env, other = (GymEnv([CART] * 2, task_pool=[CART, long]) for _ in range(2))
    env.reset()
    env.set_tasks([long] * 2, at_episode_end=True)

    other.load_state_dict(env.state_dict())
    before = other.tasks
    other.reset()

    assert before == (CART, CART)
    assert other.tasks == (long, long)


@pytest.mark.parametrize(
    ("tasks", "message"),
    [
        ([GymTask("test/Forgets-v0")], "an episode of test/Forgets-v0 must repeat with its seed and actions"),
        (
            [GymTask("test/Shows-v0")],
            "test/Shows-v0 shows Dict.*cannot be stacked as images or vectors: add",
        ),
        ([CART, LAKE], "tasks of one environment must have observations and actions of one form, got float32"),
        ([GymTask("CliffWalking-v1")], "CliffWalking-v1 has no time limit, .*: give max_episode_steps"),
        ([GymTask("CartPole-v1", {"lenght": 1})], r"GymTask\('CartPole-v1'\) cannot be made: TypeError"),
        ([GymTask("Nothing-v0")], r"GymTask\('Nothing-v0'\) cannot be made"),
    ],
)
def test_what_cannot_be_rows_is_refused_before_any_work(tasks, message):
    with pytest.raises(ValueError, match=message):
        GymEnv(tasks)
