"""What environments of Gymnasium return, in the forms that people write."""

from decimal import Decimal

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete, MultiDiscrete, Sequence, Tuple
from gymnasium.wrappers import FlattenObservation

from ctgraph_rl import Block, Curriculum, Evaluation, GymTask, Recorder, evaluate
from ctgraph_rl.batch.gym_env import GymEnv


class Returns(gymnasium.Env):
    """Returns what it is given, with an info whose array grows, from a buffer that all its instances share."""

    observation_space = Box(-np.inf, np.inf, (3,), np.float64)
    action_space = Discrete(2)
    observation = None
    reward = 1.0
    terminated = truncated = False
    buffer = np.zeros(3)

    def seen(self):
        self.buffer[:] = self.steps
        return self.buffer if self.observation is None else self.observation

    def reset(self, *, seed=None, options=None):
        self.steps = 0
        return self.seen(), None

    def step(self, action):
        self.steps += 1
        info = {"grows": np.zeros(self.steps), "object": object()}
        return self.seen(), self.reward, self.terminated, self.truncated, info


def task_of(name, **attributes):
    """Return a task whose environment ends after four steps."""
    kind = type(name, (Returns,), attributes)
    gymnasium.registry.pop(f"returns/{name}-v0", None)
    gymnasium.register(f"returns/{name}-v0", kind, max_episode_steps=4)
    return GymTask(f"returns/{name}-v0")


def played(task, num_steps=4):
    env = GymEnv([task] * 2)
    try:
        return env.rollout(num_steps, break_when_any_done=False)["next"]
    finally:
        env.close()


NUMBERS = {
    "Plain": (1, [1, 2, 3], False),
    "Long": (np.longdouble(1), np.array([1, 2, 3], np.longdouble), np.bool_(False)),
    "Numpy": (np.float32(1), np.array([1, 2, 3]), np.bool_(False)),
    "Arrays": (np.array([1.0]), np.array([[1, 2, 3]]), np.array([False])),
    "Torch": (torch.ones(1, requires_grad=True), torch.tensor([1.0, 2.0, 3.0], requires_grad=True), torch.zeros(())),
    "Decimals": (Decimal(1), tuple(map(Decimal, (1, 2, 3))), 0),
    "Tensors": (True, [torch.tensor(1.0), torch.tensor(2.0, requires_grad=True), 3], None),
}


@pytest.mark.parametrize("kind", NUMBERS)
def test_numbers_are_taken_whatever_holds_them(kind):
    reward, observation, flag = NUMBERS[kind]
    task = task_of(kind, reward=reward, observation=observation, terminated=flag, truncated=flag)

    after = played(task)

    assert after["observation"][1].tolist() == [[1, 2, 3]] * 4
    assert after["reward"].flatten().tolist() == [1] * 8
    assert not after["terminated"].any()
    assert after["truncated"][0].flatten().tolist() == [False, False, False, True]


@pytest.mark.parametrize(
    "flag", [np.True_, np.array([True]), torch.tensor(True), 1], ids=["bool", "array", "tensor", "1"]
)
def test_an_end_is_an_end_whatever_says_it(flag):
    after = played(task_of("Ends", terminated=flag), 2)

    assert after["terminated"].all()
    assert not after["truncated"].any()


def test_rows_that_share_the_buffer_of_an_observation_show_their_own():
    task = task_of("Buffer")
    env = GymEnv([task, GymTask(task.id, max_episode_steps=2)])

    steps = env.rollout(4, break_when_any_done=False)

    assert steps["next", "observation"][..., 0].tolist() == [[1, 2, 3, 4], [1, 2, 1, 2]]
    assert steps["observation"][..., 0].tolist() == [[0, 1, 2, 3], [0, 1, 0, 1]]


class Changes(Returns):
    """Writes into its action, and refuses what is no action."""

    def __init__(self, dtype):
        self.action_space = Box(-0.1, 0.1, (2,), np.dtype(dtype).type)

    def step(self, action):
        assert action in self.action_space
        self.reward = float(action[0])
        action *= 0
        return super().step(action)


gymnasium.register("returns/Changes-v0", Changes, max_episode_steps=4)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_an_action_is_given_in_the_space_s_own_numbers_and_is_the_environment_s_to_change(dtype):
    task = GymTask("returns/Changes-v0", {"dtype": dtype})
    env = GymEnv([task])
    other = GymEnv([task])
    most = env.action_spec.space.high.clone()
    data = env.reset().set("action", most.clone())

    step = env.step(data)
    after = step["action"].clone()
    step["action"].zero_()
    other.load_state_dict(env.state_dict())

    assert step["next", "reward"].item() == pytest.approx(0.1)
    assert after.equal(most)
    assert other._actions[0][0].tolist() == most[0].tolist()


def test_an_integer_action_has_the_dtype_of_its_space():
    taken = []

    class Short(Returns):
        action_space = Discrete(2, start=3, dtype=np.int32)

        def step(self, action):
            assert action in self.action_space
            taken.append(action)
            return super().step(action)

    gymnasium.register("returns/Short-v0", Short, max_episode_steps=4)

    GymEnv([GymTask("returns/Short-v0")]).rollout(4)

    assert {type(action) for action in taken} == {np.int32}


def test_each_row_reads_integers_from_its_own_space():
    low = task_of("Low", observation_space=Discrete(4, start=1), observation=np.int64(1))
    high = task_of("High", observation_space=Discrete(4, start=7), observation=np.array([10]))

    shown = GymEnv([low, high]).rollout(1)["observation"][:, 0]

    assert shown.tolist() == [[1, 0, 0, 0], [0, 0, 0, 1]]


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        ({"observation": np.zeros(4)}, r"has the shape \(4,\), and its space \(3,\) \(step 0"),
        ({"observation": "three"}, "the observation must be numbers, got 'three'"),
        ({"reward": None}, r"the reward must be one number, got None \(step 1"),
        ({"reward": np.zeros(2)}, "the reward must be one number, got array"),
        ({"terminated": "no"}, "terminated must be true or false, got 'no'"),
        ({"observation_space": Discrete(2), "observation": 2}, "2 is not in its space Discrete"),
        ({"observation_space": Box(0, 255, (3,), np.uint8), "observation": [0, 0.5, 1]}, r"value \[0.5\], .* is uint8"),
        ({"observation_space": Tuple([Discrete(2)])}, "add the wrapper gymnasium.wrappers:FlattenObservation"),
        ({"observation_space": Sequence(Discrete(2))}, "add a wrapper of your own, a gymnasium.ObservationWrapper"),
        ({"observation_space": Box(0, 255, (9, 9, 3))}, r"DtypeObservation with {'dtype': 'uint8'}"),
        ({"action_space": MultiDiscrete([2, 2])}, "add a wrapper of your own that is a gymnasium.ActionWrapper"),
        ({"reset": lambda self: (np.zeros(3), {})}, r"write reset\(self, \*, seed=None, options=None\)"),
        ({"reset": lambda self, **_: np.zeros(3)}, "reset must return observation and info"),
        ({"step": lambda self, action: 1 / 0}, r"ZeroDivisionError: division by zero \(step 1 of an episode of random"),
    ],
)
def test_what_no_network_can_read_is_refused_before_any_work_with_the_fix(attributes, message):
    with pytest.raises(ValueError, match=f"^returns/Wrong-v0.*{message}"):
        GymEnv([task_of("Wrong", **attributes)])


@pytest.mark.parametrize(
    ("space", "observation"),
    [(Tuple([Discrete(2), Discrete(3)]), (1, 2)), (MultiDiscrete([2, 3]), np.array([1, 2]))],
    ids=["tuple", "several integers"],
)
def test_the_wrapper_that_a_refusal_names_is_enough(space, observation):
    task = task_of("Flat", observation_space=space, observation=observation)

    shown = played(GymTask(task.id, wrappers=[FlattenObservation]), 1)["observation"][0, 0]

    assert shown.tolist() == [0, 1, 0, 0, 1]


class Breaks(Returns):
    """Shows or pays what is not finite in its 23rd step, after the steps by which it is probed."""

    def __init__(self, what="reward", value=np.nan):
        self.what = what
        self.value = value

    def step(self, action):
        observation, reward, *rest = super().step(action)
        broken = self.steps == 23
        reward = self.value if broken and self.what == "reward" else reward
        return np.array([0, self.value, 0]) if broken and self.what == "observation" else observation, reward, *rest


gymnasium.register("returns/Breaks-v0", Breaks, max_episode_steps=30)


@pytest.mark.parametrize(
    ("what", "value", "said"),
    [
        ("reward", np.nan, "the reward is nan"),
        ("reward", -(10**40), "the reward is -1000"),
        ("observation", np.inf, r"the observation is inf at \[1\]"),
        ("observation", 1e39, r"the observation is 1e\+39 at \[1\]"),
    ],
)
def test_what_is_not_finite_is_named_with_environment_task_and_frame(what, value, said):
    task = GymTask("returns/Breaks-v0", {"what": what, "value": value}, label="mine")
    env = GymEnv([task] * 2, seed=3)

    place = rf"returns/Breaks-v0 \(mine\): {said}.* \(frame 45, step 23 of an episode with seed \d+\)"
    with pytest.raises(FloatingPointError, match=place):
        env.rollout(30)


def test_an_infinite_number_of_16_bits_is_not_finite():
    half = Box(-np.inf, np.inf, (3,), np.float16)
    task = task_of("Half", observation_space=half, observation=np.array([0, np.inf, 0], np.float16))

    with pytest.raises(FloatingPointError, match=r"the observation is inf at \[1\]"):
        GymEnv([task])


def test_a_resumed_environment_counts_its_frames_on():
    task = GymTask("returns/Breaks-v0", label="mine")
    env = GymEnv([task])
    other = GymEnv([task])
    data = env.rollout(20)[:, -1]["next"].exclude("reward")

    other.load_state_dict(env.state_dict())

    with pytest.raises(FloatingPointError, match=r"\(frame 23, step 23 of"):
        other.rollout(5, auto_reset=False, tensordict=data)


def test_evaluations_and_recorders_name_it_too():
    task = GymTask("returns/Breaks-v0", label="mine")
    curriculum = Curriculum("breaks", 1, "-", (Block(task, 64),), Evaluation(num_episodes=1))

    def policy(observation):
        return np.zeros(len(observation), dtype=np.int64)

    place = r"\(mine\): the reward is nan.*frame 23"
    with pytest.raises(FloatingPointError, match=place), Recorder(curriculum) as recorder:
        recorder.evaluate(policy, 0)
    with pytest.raises(FloatingPointError, match=place):
        evaluate(lambda data: data.set("action", torch.zeros(1, dtype=torch.int64)), [task], 1)


@pytest.mark.parametrize(
    ("action", "message"),
    [([2], r"actions must be in 0..1, got \[2\]"), ([0.5], "actions must be integers, got float32"), ([0, 1], "shape")],
)
def test_what_is_no_action_is_refused(action, message):
    env = GymEnv([task_of("Acts")])
    data = env.reset()

    with pytest.raises(ValueError, match=message):
        env._step(data.set("action", torch.tensor([action])))
