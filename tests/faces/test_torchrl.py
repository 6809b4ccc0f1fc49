"""TorchRL's own tools around `CTGraphEnv` and around our Gymnasium ids; transforms have a file of their own."""

from __future__ import annotations

import copy
import inspect
import pickle
from functools import partial

import gymnasium
import pytest
import torch
from helpers.oracles import confounding, scripts, surjective
from tensordict import TensorDict
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.data import (
    LazyMemmapStorage,
    LazyTensorStorage,
    ListStorage,
    ReplayBuffer,
    SliceSampler,
    SliceSamplerWithoutReplacement,
    TensorDictPrioritizedReplayBuffer,
    TensorDictReplayBuffer,
)
from torchrl.envs import (
    EnvBase,
    EnvCreator,
    GymEnv,
    GymWrapper,
    ParallelEnv,
    SerialEnv,
    StepCounter,
    TransformedEnv,
    check_env_specs,
)

import ctgraph_rl.gym  # noqa: F401 - registers the ids
from ctgraph_rl import CTGraphEnv
from ctgraph_rl.tasks.configurations import CONFIGURATIONS, ct_su_b1

TASKS = [surjective(p=0.3), confounding(read_noise=9), surjective(2, 1)]
ACTIONS = scripts(20, len(TASKS))
IDS = [f"ctgraph/{name}-v{int(name == 'CT-POSR-B1')}" for name in ("CTGraph", *CONFIGURATIONS)]


def make_env(seed=3, **options):
    return CTGraphEnv(TASKS, seed=seed, **options)


def steps(env):
    """A rollout with given actions."""
    return env.rollout(len(ACTIONS), actions=list(ACTIONS), break_when_any_done=False)


def waits(tensordict):
    return tensordict.set("action", torch.zeros(tensordict.shape, dtype=torch.int64))


@pytest.mark.parametrize(
    "options", [{}, {"info": False}, {"task_ids": True}, {"noise_bank": 8}, {"kernel": "off"}], ids=str
)
@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_torchrl_finds_the_specs_of_every_configuration_in_order(name, options):
    tasks = [CONFIGURATIONS[name]()] * 2
    given = options | ({"task_ids": {tasks[0]: 1}} if "task_ids" in options else {})

    check_env_specs(CTGraphEnv(tasks, **given), break_when_any_done="both")


@pytest.mark.parametrize("name", IDS)
@pytest.mark.parametrize("categorical", [True, False])
def test_gym_env_of_torchrl_makes_every_id(name, categorical):
    env = GymEnv(name, categorical_action_encoding=categorical, device="cpu")

    check_env_specs(env, break_when_any_done="both")

    assert type(env.action_spec).__name__ == ("Categorical" if categorical else "OneHot")
    env.set_seed(0)
    first = env.reset()["observation"]
    env.set_seed(0)
    assert torch.equal(env.reset()["observation"], first)


@pytest.mark.parametrize(
    ("arguments", "shape"),
    [
        ({"goal": (2, 1), "wait_prob": 0.5}, ()),
        ({"frame_skip": 2}, ()),
        ({"from_pixels": True, "pixels_only": False}, ()),
    ],
    ids=str,
)
def test_gym_env_takes_its_own_arguments_and_ours(arguments, shape):
    env = GymEnv("ctgraph/CT-SU-B1-v0", **arguments)

    data = env.rollout(4, break_when_any_done=False)
    env.close()

    assert data.shape == (*shape, 4) and data["observation"].dtype == torch.uint8
    assert ("pixels" in data.keys()) == ("from_pixels" in arguments)  # noqa: SIM118


def test_gym_env_refuses_an_argument_that_neither_knows():
    with pytest.raises(TypeError, match=r"unexpected keyword argument 'gaol': no field .*; did you mean 'goal'"):
        GymEnv("ctgraph/CT-SU-B1-v0", gaol=(1, 2))


@pytest.mark.slow
def test_gym_env_runs_in_processes():
    """They import nothing that this process has imported, so the id names the module that registers it."""
    env = GymEnv("ctgraph_rl.gym:ctgraph/CT-SU-B1-v0", num_workers=2)
    try:
        assert env.rollout(4, break_when_any_done=False).shape == (2, 4)
    finally:
        env.close()


@pytest.mark.parametrize("mode", ["SameStep", "Disabled"])
def test_a_batch_of_gymnasium_is_wrapped_by_torchrl(mode):
    env = GymWrapper(gymnasium.make_vec("ctgraph/CT-SU-B1-v0", num_envs=3, autoreset_mode=mode))

    check_env_specs(env, break_when_any_done="both")
    assert env.rollout(9, break_when_any_done=False).shape == (3, 9)


def test_a_serial_env_has_the_rows_of_its_environments():
    serial = SerialEnv(2, [lambda: make_env(seed=1), lambda: make_env(seed=2)])
    check_env_specs(serial, break_when_any_done="both")
    actions = [torch.stack([action, action]) for action in ACTIONS]
    serial = SerialEnv(2, [lambda: make_env(seed=1), lambda: make_env(seed=2)])

    data = serial.rollout(len(actions), actions=actions, break_when_any_done=False)

    assert all((data[i] == steps(make_env(seed=i + 1)).select(*data.keys(True, True))).all() for i in range(2))
    singles = SerialEnv(3, lambda: CTGraphEnv(TASKS[:1]))
    assert singles.rollout(50, break_when_all_done=True)["next", "done"].any(2).all()


@pytest.mark.slow
def test_a_parallel_env_has_the_rows_of_its_environments():
    parallel = ParallelEnv(2, EnvCreator(make_env))
    try:
        actions = [torch.stack([action, action]) for action in ACTIONS]
        data = parallel.rollout(len(actions), actions=actions, break_when_any_done=False)
        assert all((data[i] == steps(make_env()).select(*data.keys(True, True))).all() for i in range(2))
    finally:
        parallel.close()


@pytest.mark.slow
def test_a_collector_of_several_processes_gives_whole_batches():
    collector = MultiSyncCollector([make_env, make_env], frames_per_batch=60, total_frames=120)
    try:
        frames = [data.numel() for data in collector]
    finally:
        collector.shutdown()

    assert sum(frames) >= 120


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"split_trajs": True},
        {"init_random_frames": 30},
        {"max_frames_per_traj": 3},
        {"reset_at_each_iter": True},
        {"use_buffers": False, "trust_policy": True},
        {"storing_device": "cpu"},
        {"return_same_td": True},
    ],
    ids=str,
)
def test_a_collector_takes_its_options(options):
    create = partial(make_env, info="max_frames_per_traj" not in options)  # which counts steps itself
    collector = Collector(create, waits, frames_per_batch=60, total_frames=120, **options)

    batches = [data.clone() for data in collector]
    collector.shutdown()

    assert len(batches) == 2 and all(data["next", "reward"].isfinite().all() for data in batches)
    if not options:
        assert [data.shape for data in batches] == [(3, 20)] * 2
        assert torch.equal(batches[0]["is_init"][:, 1:], batches[0]["next", "done"][:, :-1])


ROLLOUT_ARGUMENTS = {
    *("max_steps", "policy", "callback", "auto_reset", "auto_cast_to_device", "break_when_any_done"),
    *("break_when_all_done", "return_contiguous", "tensordict", "set_truncated", "out", "trust_policy"),
    *("storing_device", "actions", "set_state"),
}
"""Those that `test_env_rollout.py` compares with the stock method, or the test below."""


def test_every_argument_of_rollout_is_tested():
    parameters = set(inspect.signature(EnvBase.rollout).parameters) - {"self", "kwargs"}

    assert parameters == ROLLOUT_ARGUMENTS


@pytest.mark.parametrize(
    "options",
    [
        {"trust_policy": True},
        {"auto_reset": False, "tensordict": "reset"},
        {"storing_device": "cpu"},
        {"auto_cast_to_device": True},
        {"break_when_all_done": True},
        {"return_contiguous": False},
    ],
    ids=str,
)
def test_rollout_takes_its_arguments(options):
    env = make_env()
    options = options | ({"tensordict": env.reset()} if "tensordict" in options else {})

    data = env.rollout(9, waits, **options)

    assert data["next", "step_count"][0, 0] == 1 and data["is_init"][:, 0].all()


@pytest.mark.parametrize("storage", [ListStorage, LazyTensorStorage, LazyMemmapStorage])
def test_a_replay_buffer_gives_back_the_steps(storage):
    data = steps(make_env()).reshape(-1)
    buffer = TensorDictReplayBuffer(storage=storage(len(data)), batch_size=32)

    index = buffer.extend(data)
    sample = buffer.sample()

    assert len(index) == len(data) and sample.shape == (32,)
    place = sample["index"] if "index" in sample.keys() else None  # noqa: SIM118
    if place is not None:
        assert (sample["next", "observation"] == data["next", "observation"][place.flatten()]).all()


def test_slices_of_a_buffer_are_of_one_episode():
    data = steps(make_env())
    for sampler in (SliceSampler, SliceSamplerWithoutReplacement):
        how = sampler(slice_len=2, end_key=("next", "done"))
        buffer = ReplayBuffer(storage=LazyTensorStorage(60), sampler=how, batch_size=8)
        buffer.extend(data.reshape(-1))
        pairs = buffer.sample().reshape(-1, 2)
        assert not pairs["next", "done"][:, 0].any()
        assert torch.equal(pairs["step_count"][:, 1], pairs["next", "step_count"][:, 0])


def test_a_prioritised_buffer_takes_errors_of_samples():
    pytest.importorskip("torchrl._torchrl", exc_type=ImportError)
    try:
        buffer = TensorDictPrioritizedReplayBuffer(alpha=0.7, beta=0.9, storage=LazyTensorStorage(60), batch_size=16)
    except RuntimeError as error:
        pytest.skip(f"TorchRL's extension is not for this torch: {error}")
    buffer.extend(steps(make_env()).reshape(-1))

    buffer.update_tensordict_priority(buffer.sample().set("td_error", torch.ones(16)))

    assert buffer.sample()["next", "reward"].shape == (16, 1)


def test_a_seed_gives_the_same_steps_again_in_a_wrapped_environment_too():
    for env in (make_env(), TransformedEnv(make_env(), StepCounter(step_count_key="steps"))):
        env.set_seed(11)
        first = steps(env)
        env.set_seed(11)

        assert (steps(env) == first).all()
        env.set_seed(12)
        assert not (steps(env) == first).all()


@pytest.mark.parametrize(
    "copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env)), lambda env: env.to("cpu")]
)
@pytest.mark.parametrize("kernel", ["off", "required"])
def test_a_copy_in_the_middle_of_an_episode_continues_as_the_environment_does(copied, kernel):
    env = make_env(kernel=kernel)
    data = env.step_mdp(env.step(waits(env.reset())))
    twin = copied(env)
    if twin is env:
        twin = copy.deepcopy(env)

    after = [each.step(waits(data.clone()))["next"] for each in (env, twin)]

    assert (after[0] == after[1]).all()


def test_a_transform_is_appended_and_state_dicts_are_loaded():
    env, other = (make_env(seed).append_transform(StepCounter(step_count_key="steps")) for seed in (1, 2))
    data = env.step_mdp(env.step(waits(env.reset())))

    other.load_state_dict(env.state_dict())  # of the transforms alone
    other.base_env.load_state_dict(env.base_env.state_dict())

    after = [each.step(waits(data.clone()))["next"] for each in (env, other)]
    assert (after[0] == after[1]).all() and after[0]["steps"].flatten().tolist() == [2, 2, 2]


def test_on_the_meta_of_specs_a_fake_step_has_the_shapes_of_a_real_one():
    env = CTGraphEnv([ct_su_b1()] * 2)

    fake, real = env.fake_tensordict(), env.rand_step(env.reset())

    assert {key: (value.shape, value.dtype) for key, value in fake.items(True, True)} == {
        key: (value.shape, value.dtype) for key, value in real.items(True, True)
    }
    assert isinstance(env.rand_action(TensorDict(batch_size=[2])), TensorDict)


@pytest.mark.parametrize(
    "wrap",
    [
        lambda env: gymnasium.wrappers.TimeLimit(env, 3),
        lambda env: gymnasium.wrappers.RecordEpisodeStatistics(env),
        lambda env: gymnasium.wrappers.FlattenObservation(env),
        lambda env: gymnasium.wrappers.FrameStackObservation(env, 2),
        lambda env: gymnasium.wrappers.DtypeObservation(env, "float32"),
        lambda env: gymnasium.wrappers.RescaleObservation(gymnasium.wrappers.DtypeObservation(env, "float32"), 0, 1),
        lambda env: gymnasium.wrappers.NormalizeReward(env),
        lambda env: gymnasium.wrappers.ClipReward(env, 0, 0.5),
        lambda env: gymnasium.wrappers.TimeAwareObservation(gymnasium.wrappers.TimeLimit(env, 9)),
        lambda env: gymnasium.wrappers.DelayObservation(env, 1),
        lambda env: gymnasium.wrappers.StickyAction(env, 0.2),
        lambda env: gymnasium.wrappers.Autoreset(env),
        lambda env: gymnasium.wrappers.PassiveEnvChecker(env),
    ],
)
def test_wrappers_of_gymnasium_take_episodes_to_their_ends(wrap):
    env = wrap(gymnasium.make("ctgraph/CT-SU-B1-v0", disable_env_checker=True))
    seen, _ = env.reset(seed=0)
    for action in (0, 0):
        seen, *_ = env.step(action)

    _, reward, terminated, truncated, _ = env.step(0)

    assert reward == 0 and (terminated or truncated)
    assert seen in env.observation_space
