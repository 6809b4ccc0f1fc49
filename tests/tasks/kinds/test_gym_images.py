"""The picture that a network sees of each form of images."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from gymnasium.wrappers import AddRenderObservation, FrameStackObservation

from ctgraph_rl import GymTask
from ctgraph_rl.batch.gym_env import GymEnv


class Pixels(gymnasium.Env):
    """Shows the numbers 0, 1, ... in the order of its axes, as many more as its episode has steps."""

    metadata = {"render_modes": ("rgb_array", "human")}  # noqa: RUF012, as Gymnasium's own
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, shape=(5, 6, 3), render_mode=None):
        self.render_mode = render_mode
        self.observation_space = Box(0, 255, shape, np.uint8)

    def reset(self, *, seed=None, options=None):
        self.steps = 0
        return self.picture(), {}

    def step(self, action):
        self.steps += 1
        return self.picture(), 0.0, False, False, {}

    def picture(self):
        return numbers(self.observation_space.shape) + np.uint8(self.steps)

    def render(self):
        return numbers((5, 6, 3)) + np.uint8(self.steps)


gymnasium.register("images/Pixels-v0", Pixels, max_episode_steps=9)

STACK = (FrameStackObservation, {"stack_size": 2})


def numbers(shape):
    return np.arange(np.prod(shape), dtype=np.uint8).reshape(shape)


def task_of(shape, channels=None, wrappers=()):
    return GymTask("images/Pixels-v0", {"shape": tuple(shape)}, wrappers, channels=channels)


def first_picture(task):
    env = GymEnv([task])
    shown = env.reset()["observation"]
    assert env.observation_spec["observation"].is_in(shown)
    env.close()
    return shown[0]


@pytest.mark.parametrize(
    ("shape", "channels", "axes"),
    [
        ((5, 6, 3), None, (2, 0, 1)),
        ((5, 6, 1), None, (2, 0, 1)),
        ((5, 6, 4), None, (2, 0, 1)),
        ((3, 5, 6), None, (0, 1, 2)),
        ((1, 5, 6), None, (0, 1, 2)),
        ((4, 5, 6), None, (0, 1, 2)),  # four grey frames, as Atari has
        ((2, 5, 6), "first", (0, 1, 2)),
        ((8, 5, 6), "first", (0, 1, 2)),
        ((5, 6, 8), "last", (2, 0, 1)),
        ((3, 6, 3), "first", (0, 1, 2)),
        ((3, 6, 3), "last", (2, 0, 1)),
        ((3, 5, 6), "last", (2, 0, 1)),  # what is said counts
    ],
)
def test_an_image_with_channels_is_shown_channels_first(shape, channels, axes):
    shown = first_picture(task_of(shape, channels))

    assert shown.dtype == torch.uint8
    assert np.array_equal(shown, numbers(shape).transpose(axes))


def test_an_image_without_channels_is_one_channel():
    assert np.array_equal(first_picture(task_of((5, 6))), numbers((1, 5, 6)))


def test_a_stack_of_grey_frames_is_shown_frame_by_frame_the_oldest_first():
    env = GymEnv([task_of((5, 6), "first", [STACK])])

    after = env.rollout(1)["next", "observation"][0, 0]

    assert np.array_equal(after, np.stack([numbers((5, 6)), numbers((5, 6)) + 1]))


@pytest.mark.parametrize(("shape", "axes"), [((5, 6, 3), (2, 0, 1)), ((3, 5, 6), (0, 1, 2)), ((5, 6, 1), (2, 0, 1))])
@pytest.mark.parametrize("says", [False, True])
def test_a_stack_of_frames_with_channels_has_the_channels_of_all_frames(shape, axes, says):
    channels = ("first" if axes[0] == 0 else "last") if says else None
    env = GymEnv([task_of(shape, channels, [STACK])])

    after = env.rollout(1)["next", "observation"][0, 0]

    first = numbers(shape).transpose(axes)
    assert np.array_equal(after, np.concatenate([first, first + 1]))


@pytest.mark.parametrize(
    "shape", [(3, 6, 3), (5, 6, 7), (2, 5, 6), (8, 5, 6), (5, 6, 3, 4), (4, 5, 6, 7), (2, 3, 6, 3)]
)
def test_channels_that_are_not_clear_are_refused_with_the_fix(shape):
    message = "which axis of an image is the channels is not clear: give GymTask.channels='first'. or"

    with pytest.raises(ValueError, match=message):
        _ = task_of(shape).observation_shape


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: task_of((5, 6, 3), "middle"), "channels must be 'first', 'last' or None, got 'middle'"),
        (lambda: task_of((5, 6), "first").observation_shape, "channels='first' is for images of 3 or 4 dimensions"),
        (lambda: task_of((2, 2, 2, 5, 3)).observation_shape, "cannot be stacked as images or vectors: add the wrapper"),
    ],
)
def test_channels_of_other_observations_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_rendered_picture_is_an_observation():
    task = GymTask("images/Pixels-v0", {"shape": (2,), "render_mode": "rgb_array"}, [AddRenderObservation])
    env = GymEnv([task])

    after = env.rollout(2)["next", "observation"][0, 1]

    assert np.array_equal(after, numbers((5, 6, 3)).transpose(2, 0, 1) + 2)
    assert task.label_parts == {"task": "images/Pixels-v0 render_mode=rgb_array"}
    with pytest.raises(ValueError, match=r"render_mode must be 'rgb_array', .* 'human' opens windows"):
        GymTask("images/Pixels-v0", {"render_mode": "human"})
