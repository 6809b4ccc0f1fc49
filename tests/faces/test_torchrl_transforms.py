"""Every transform of TorchRL: what it does to the data of `CTGraphEnv`, or why it does not fit.

A transform that is in no table fails the first test, so that a new version of TorchRL is looked at.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import pytest
import torch
import torchrl.envs
from helpers.oracles import confounding, scripts, surjective
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Unbounded
from torchrl.envs import Transform, TransformedEnv, check_env_specs
from torchrl.envs import transforms as t
from torchrl.modules import GRUModule

from ctgraph_rl import CTGraphEnv
from ctgraph_rl.core.dynamics import OUTCOME_GOAL

TASKS = [confounding(p=0.3, read_noise=9), surjective(2, 1), surjective(2, 1, goal=(2,)), confounding(2, 1)]
ACTIONS = scripts(24, len(TASKS), seed=2)

SEEN, PAID = ["observation"], ["reward"]
Data = TensorDictBase


class Case(NamedTuple):
    """A transform, what is true of the data, and the keys that it changes.

    All other data are those without the transform.
    """

    make: Callable[[], Transform]
    holds: Callable[[Data, Data, TransformedEnv], Any]
    changed: Sequence[str] = ()


def make_env(**options: Any) -> CTGraphEnv:
    return CTGraphEnv(TASKS, seed=5, **options)


def to_float(*out_keys: str) -> Transform:
    return t.DTypeCastTransform(torch.uint8, torch.float32, in_keys=SEEN, out_keys=list(out_keys) or None)


def seen(data: Data) -> Tensor:
    return data["next", "observation"]


def paid(data: Data) -> Tensor:
    return data["next", "reward"]


DONE = ("done", "terminated", "truncated")
EPISODES = ("observation", "is_init", "step_count", "episode_reward", "outcome", "leaf", "reward", *DONE)
"""What changes with when episodes end."""

OF_THE_ENVIRONMENT = {
    "ActionMask": Case(
        lambda: t.Compose(
            t.UnaryTransform(["is_init"], ["action_mask"], fn=lambda x: torch.tensor([[True, True, False]] * len(x))),
            t.ActionMask(),
        ),
        lambda b, d, env: not (env.rollout(30, break_when_any_done=False)["action"] == 2).any(),
    ),
    "BatchSizeTransform": Case(
        lambda: t.BatchSizeTransform(reshape_fn=lambda data: data.reshape(2, 2)),
        lambda b, d, env: (d.shape == (2, 2, 24)) and (d.reshape(4, 24).select(*b.keys(True, True)) == b).all(),
        ("action", *EPISODES),
    ),
    "BinarizeReward": Case(t.BinarizeReward, lambda b, d, _: (paid(d) == (paid(b) > 0)).all(), PAID),
    "CatFrames": Case(
        lambda: t.CatFrames(2, -3, in_keys=SEEN, out_keys=["frames"]),
        lambda b, d, _: (d["next", "frames"] == torch.cat([b["observation"], seen(b)], -3)).all(),
    ),
    "CatTensors": Case(
        lambda: t.CatTensors(["step_count", "leaf"], "both", del_keys=False, sort=False),
        lambda b, d, _: (d["next", "both"] == torch.cat([b["next", "step_count"], b["next", "leaf"]], -1)).all(),
    ),
    "ClipTransform": Case(
        lambda: t.ClipTransform(in_keys=["reward"], low=0.0, high=0.5),
        lambda b, d, _: (paid(d) == paid(b).clamp(0, 0.5)).all() and paid(b).max() == 1,
        PAID,
    ),
    "ConditionalSkip": Case(
        lambda: t.ConditionalSkip(lambda data: torch.tensor([False, False, True, True])),
        lambda b, d, _: (d[:2] == b[:2]).all() and not d["next", "step_count"][2:].any(),
        EPISODES,
    ),
    "DTypeCastTransform": Case(
        lambda: t.Compose(to_float(), t.DTypeCastTransform(torch.int64, torch.int32, in_keys_inv=["action"])),
        lambda b, d, _: seen(d).dtype == torch.float32 and (seen(d) == seen(b)).all(),
        SEEN,
    ),
    "DeviceCastTransform": Case(lambda: t.DeviceCastTransform("cpu"), lambda b, d, _: d.device == b.device),
    "DoubleToFloat": Case(
        lambda: t.Compose(
            t.DTypeCastTransform(torch.uint8, torch.float64, in_keys=SEEN),
            t.DoubleToFloat(in_keys=SEEN),
        ),
        lambda b, d, _: seen(d).dtype == torch.float32 and (seen(d) == seen(b)).all(),
        SEEN,
    ),
    "ExcludeTransform": Case(
        lambda: t.ExcludeTransform("leaf", "outcome"),
        lambda b, d, _: not {"leaf", "outcome"} & {*d.keys(), *d["next"].keys()},
        ("leaf", "outcome"),
    ),
    "ExpandAs": Case(
        lambda: t.ExpandAs("reward", "observation", "reward_map"),
        lambda b, d, _: d["next", "reward_map"].shape == seen(b).shape,
    ),
    "FiniteTensorDictCheck": Case(t.FiniteTensorDictCheck, lambda b, d, _: True),
    "FlattenObservation": Case(
        lambda: t.FlattenObservation(-3, -1, in_keys=SEEN), lambda b, d, _: (seen(d) == seen(b).flatten(-3)).all(), SEEN
    ),
    "Hash": Case(
        lambda: t.Hash(["observation"], ["sum"], hash_fn=lambda image: image.flatten(-3).long().sum(-1, keepdim=True)),
        lambda b, d, _: (d["next", "sum"] == seen(b).flatten(-3).long().sum(-1, keepdim=True)).all(),
    ),
    "InitTracker": Case(
        lambda: t.InitTracker("starts"), lambda b, d, _: (d["starts"] == b["is_init"]).all() and b["is_init"].any()
    ),
    "LineariseRewards": Case(
        lambda: t.LineariseRewards(["reward"], ["half"], weights=[0.5]),
        lambda b, d, _: (d["next", "half"] == paid(b) / 2).all(),
    ),
    "ModuleTransform": Case(
        lambda: t.ModuleTransform(module=TensorDictModule(lambda x: 255 - x, in_keys=SEEN, out_keys=["observation"])),
        lambda b, d, _: (seen(d) == 255 - seen(b)).all(),
        SEEN,
    ),
    "ObservationNorm": Case(
        lambda: t.Compose(to_float(), t.ObservationNorm(loc=0.0, scale=1 / 255, in_keys=SEEN)),
        lambda b, d, _: seen(d).max() <= 1 and torch.allclose(seen(d) * 255, seen(b).float()),
        SEEN,
    ),
    "PermuteTransform": Case(
        lambda: t.PermuteTransform((-1, -2, -3), in_keys=SEEN),
        lambda b, d, _: (seen(d) == seen(b).transpose(-1, -3)).all(),
        SEEN,
    ),
    "RNDTransform": Case(
        lambda: t.Compose(
            to_float("pixels"),
            t.FlattenObservation(-3, -1, in_keys=["pixels"]),
            t.RNDTransform(nn.Linear(144, 2), nn.Linear(144, 2), in_keys=["pixels"]),
        ),
        lambda b, d, _: d["next", "intrinsic_reward"].shape == paid(b).shape,
    ),
    "RandomTruncationTransform": Case(
        lambda: t.RandomTruncationTransform(1, 2, prob=1.0),
        lambda b, d, _: d["next", "truncated"].any() and d["next", "step_count"].max() <= 2,
        EPISODES,
    ),
    "RemoveEmptySpecs": Case(t.RemoveEmptySpecs, lambda b, d, _: True),
    "RenameTransform": Case(
        lambda: t.RenameTransform(["observation"], ["pixels"]),
        lambda b, d, _: (d["next", "pixels"] == seen(b)).all(),
        SEEN,
    ),
    "RewardClipping": Case(
        lambda: t.RewardClipping(0.0, 0.5), lambda b, d, _: (paid(d) == paid(b).clamp(0, 0.5)).all(), PAID
    ),
    "RewardScaling": Case(lambda: t.RewardScaling(1.0, 2.0), lambda b, d, _: (paid(d) == 2 * paid(b) + 1).all(), PAID),
    "RewardSum": Case(
        lambda: t.RewardSum(in_keys=["reward"], out_keys=["sum"]),
        lambda b, d, _: (d["next", "sum"] == b["next", "episode_reward"]).all() and d["next", "sum"].any(),
    ),
    "SelectTransform": Case(
        lambda: t.SelectTransform("observation", "is_init"),
        lambda b, d, _: "leaf" not in d["next"].keys() and (seen(d) == seen(b)).all(),  # noqa: SIM118
        ("step_count", "episode_reward", "outcome", "leaf"),
    ),
    "SignTransform": Case(
        lambda: t.SignTransform(in_keys=["reward"]), lambda b, d, _: (paid(d) == paid(b).sign()).all(), PAID
    ),
    "SqueezeTransform": Case(
        lambda: t.SqueezeTransform(-3, in_keys=SEEN), lambda b, d, _: (seen(d) == seen(b).squeeze(-3)).all(), SEEN
    ),
    "Stack": Case(
        lambda: t.Stack(["step_count", "leaf"], "both", del_keys=False),
        lambda b, d, _: (d["next", "both"][..., 1] == b["next", "leaf"]).all(),
    ),
    "StepCounter": Case(
        lambda: t.StepCounter(step_count_key="steps"),
        lambda b, d, _: (d["next", "steps"] == b["next", "step_count"]).all(),
    ),
    "SuccessReward": Case(
        lambda: t.Compose(t.UnaryTransform(["outcome"], ["success"], fn=lambda x: x == 3), t.SuccessReward()),
        lambda b, d, _: (paid(d) == (b["next", "outcome"] == OUTCOME_GOAL)).all(),
        PAID,
    ),
    "TargetReturn": Case(
        lambda: t.TargetReturn(1.0, in_keys=["reward"]),
        lambda b, d, _: (d["next", "target_return"] == 1 - b["next", "episode_reward"]).all(),
    ),
    "TensorDictPrimer": Case(
        lambda: t.TensorDictPrimer(hidden=Unbounded((5,)), expand_specs=True, default_value=0.5),
        lambda b, d, _: (d["hidden"] == 0.5).all(),
    ),
    "TerminateTransform": Case(
        lambda: t.TerminateTransform(lambda data: data["step_count"] >= 2),
        lambda b, d, _: d["next", "step_count"].max() == 2,
        EPISODES,
    ),
    "TimeMaxPool": Case(
        lambda: t.TimeMaxPool(["observation"], ["brightest"], T=2),
        lambda b, d, _: (d["next", "brightest"] == torch.maximum(b["observation"], seen(b))).all(),
    ),
    "Timer": Case(t.Timer, lambda b, d, _: (d["next", "time_step"] > 0).all()),
    "ToTensorImage": Case(
        lambda: t.ToTensorImage(in_keys=SEEN, out_keys=["pixels"], shape_tolerant=True),
        lambda b, d, _: torch.equal(d["next", "pixels"], seen(b) / 255),
    ),
    "TrajCounter": Case(
        t.TrajCounter, lambda b, d, _: len(d["traj_count"].unique()) == 4 + b["next", "done"][:, :-1].sum()
    ),
    "UnaryTransform": Case(
        lambda: t.UnaryTransform(["outcome"], ["success"], fn=lambda x: x == OUTCOME_GOAL),
        lambda b, d, _: (d["next", "success"] == (b["next", "outcome"] == OUTCOME_GOAL)).all(),
    ),
    "UnsqueezeTransform": Case(
        lambda: t.UnsqueezeTransform(-1, in_keys=SEEN), lambda b, d, _: (seen(d) == seen(b).unsqueeze(-1)).all(), SEEN
    ),
    "VecNorm": Case(lambda: t.VecNorm(in_keys=["reward"]), lambda b, d, _: paid(d).isfinite().all(), PAID),
    "VecNormV2": Case(
        lambda: t.Compose(to_float(), t.VecNormV2(in_keys=SEEN)),
        lambda b, d, _: seen(d).isfinite().all() and seen(d).min() < 0,
        SEEN,
    ),
}


def waits(tensordict: Data) -> Data:
    return tensordict.set("action", torch.zeros(tensordict.shape, dtype=torch.int64))


def frames_are_skipped() -> bool:
    """Rows that a step finishes stay: ``check_actions=False`` lets it repeat the action there."""
    env = TransformedEnv(make_env(check_actions=False), t.FrameSkipTransform(2))
    data = env.rollout(3, waits, break_when_any_done=False)
    return data["next", "step_count"].flatten(1)[1].tolist() == [2, 4, 2]


def chunks_of_actions_are_taken() -> bool:
    env = TransformedEnv(CTGraphEnv([surjective(2, 1)] * 2), t.MultiAction())
    data = env.step(env.reset().set("action", torch.tensor([[0, 0, 1, 0], [0, 1, 0, 0]])))["next"]
    return data["step_count"].flatten().tolist() == [4, 2] and data["outcome"].flatten().tolist() == [3, 1]


def a_single_row_starts_after_random_steps() -> bool:
    torch.manual_seed(0)
    env = TransformedEnv(CTGraphEnv([surjective()]), t.NoopResetEnv(1, random=False))
    return env.reset()["step_count"].item() == 1


def a_single_row_is_steered_by_a_second_policy() -> bool:
    waits_at_even_steps = t.ConditionalPolicySwitch(waits, lambda data: data["step_count"].squeeze(-1) % 2 == 1)
    env = TransformedEnv(CTGraphEnv([surjective(2, 1, goal=(2,))]), waits_at_even_steps)
    data = env.rollout(9, waits)
    return data["next", "step_count"].flatten().tolist() == [2, 3]


OF_OTHER_ENVIRONMENTS = {
    "FrameSkipTransform": frames_are_skipped,
    "MultiAction": chunks_of_actions_are_taken,
    "NoopResetEnv": a_single_row_starts_after_random_steps,
    "ConditionalPolicySwitch": a_single_row_is_steered_by_a_second_policy,
}
"""Those that need a row alone, unchecked actions or other actions."""


def burnt_in(batch: Data) -> bool:
    gru = GRUModule(
        input_size=1,
        hidden_size=3,
        in_keys=["step_count", "hidden"],
        out_keys=["features", ("next", "hidden")],
        default_recurrent_mode=True,
    )
    batch = batch.clone().set("hidden", torch.zeros(*batch.shape, 1, 3)).set("step_count", batch["step_count"].float())
    return t.BurnInTransform([gru], 4)(batch)["hidden"][:, 0].any().item()


def chunked(batch: Data) -> bool:
    columns = batch.clone().set("action", batch["action"].unsqueeze(-1))
    return (t.ActionChunkTransform(2)(columns)["vla_action", "chunk"][:, 0, :, 0] == ACTIONS[:2].T).all()


def reward_to_go(batch: Data) -> bool:
    found = t.Reward2GoTransform(out_keys=["to_go"]).inv(batch.clone())["to_go"]
    ends = batch["next", "done"].flatten(1)
    first = [row[start].sum() for row, start in zip(found, batch["is_init"], strict=True)]
    returns = [row[end].sum() for row, end in zip(batch["next", "episode_reward"], ends, strict=True)]
    return torch.equal(torch.stack(first), torch.stack(returns)) and sum(returns) > 0


def n_steps(batch: Data) -> bool:
    summed = t.MultiStepTransform(2, 1.0).inv(batch.clone())
    return summed.shape == (4, 22) and paid(summed).sum() >= paid(batch[:, :22]).sum() > 0


def rebuilt(batch: Data) -> bool:
    whole = batch.clone().set(("collector", "traj_ids"), torch.arange(4).view(4, 1).expand(4, 24))
    kept = whole.exclude(("next", "observation")).reshape(-1)
    after = t.NextStateReconstructor(fill_value=0)(kept)["next", "observation"]
    inside = ~batch["next", "done"].flatten()
    inside[23::24] = False
    return (after[inside] == seen(batch).flatten(0, 1)[inside]).all().item() and inside.any().item()


def rebuilt_from_differences(batch: Data) -> bool:
    env = TransformedEnv(make_env(), t.Compose(to_float(), t.NextObservationDelta(["observation"])))
    data = env.rollout(24, actions=list(ACTIONS), break_when_any_done=False)
    rows = [t.NextObservationDelta(["observation"])(step) for step in data.unbind(1)[:-1]]
    return (torch.stack([row["next", "observation"] for row in rows], 1) == seen(batch)[:, :-1]).all().item()


OF_A_REPLAY_BUFFER: dict[str, Callable[[Data], Any]] = {
    "ActionChunkTransform": chunked,
    "BurnInTransform": burnt_in,
    "MultiStepTransform": n_steps,
    "NextObservationDelta": rebuilt_from_differences,
    "NextStateReconstructor": rebuilt,
    "PolicyAgeFilter": lambda batch: (
        len(t.PolicyAgeFilter(5, 1)(batch.reshape(-1).set("policy_version", torch.arange(96) % 8))) == 96 // 8 * 4
    ),
    "RandomCropTensorDict": lambda batch: t.RandomCropTensorDict(5)(batch.clone()).shape == (4, 5),
    "Reward2GoTransform": reward_to_go,
}

NOT_FITTING = {
    "actions are discrete": "ActionDiscretizer ActionScaling ActionTokenizerTransform gSDENoise",
    "actions have no dimension to flatten": "FlattenAction",
    "actions are numbers, not one-hot": "DiscreteActionProjection",
    "for beliefs over states, as of PILCO": "MeanActionSelector",
    "for environments that reset themselves": "AutoResetTransform",
    "for environments that are a world model": "DreamerDecoder",
    "reads the lives of Atari's games": "EndOfLifeTransform",
    "made for one robot": "MacroPrimitiveTransform MicroDuckTaskSampler SatelliteAttitudeTransform "
    "URScriptPrimitiveTransform",
    "`GymEnv` adds it to a batch of Gymnasium's environments": "VecGymEnvTransform",
    "base classes": "ObservationTransform Transform",
    "others are tested in it": "Compose",
    "needs an accelerator": "PinMemoryTransform",
    "needs torchvision": "CenterCrop Crop GrayScale Resize",
    "needs torchvision, and downloads a network": "R3MTransform VC1Transform VIPRewardTransform VIPTransform",
    "needs torchcodec": "DecodeVideoTransform",
    "needs ray": "RayTransform",
    "needs transformers": "Tokenizer",
}
"""Why transforms have no test."""


def test_every_transform_of_torchrl_is_tested_or_has_a_reason():
    modules = (torchrl.envs, torchrl.envs.transforms)
    public = {name: value for module in modules for name, value in vars(module).items() if inspect.isclass(value)}
    known = [*OF_THE_ENVIRONMENT, *OF_OTHER_ENVIRONMENTS, *OF_A_REPLAY_BUFFER, *" ".join(NOT_FITTING.values()).split()]

    assert {name for name, value in public.items() if issubclass(value, Transform)} == set(known)
    assert len(known) == len(set(known))


@pytest.fixture(scope="module")
def bare() -> Data:
    """The data without a transform."""
    return make_env().rollout(len(ACTIONS), actions=list(ACTIONS), break_when_any_done=False)


@pytest.mark.parametrize("name", OF_THE_ENVIRONMENT)
def test_a_transform_does_to_the_data_what_it_says_and_nothing_else(bare, name):
    make, holds, changed = OF_THE_ENVIRONMENT[name]
    env = TransformedEnv(make_env(), make())
    actions = [action.view(env.batch_size) for action in ACTIONS]
    if name == "DTypeCastTransform":
        actions = [action.int() for action in actions]

    data = env.rollout(len(ACTIONS), actions=actions, break_when_any_done=False)

    kept = [key for key in bare.keys(True, True) if (key if isinstance(key, str) else key[-1]) not in changed]
    assert all((data[key] == bare[key]).all() for key in kept) and bare["next", "done"].sum() > 8
    assert holds(bare, data, env)
    check_env_specs(env, break_when_any_done=False)


@pytest.mark.parametrize("name", OF_OTHER_ENVIRONMENTS)
def test_a_transform_of_a_row_alone_or_of_other_actions_works(name):
    assert OF_OTHER_ENVIRONMENTS[name]()


@pytest.mark.parametrize("name", OF_A_REPLAY_BUFFER)
def test_a_transform_of_a_replay_buffer_works_on_a_rollout(name):
    batch = make_env().rollout(len(ACTIONS), actions=list(ACTIONS), break_when_any_done=False)

    assert OF_A_REPLAY_BUFFER[name](batch.contiguous())
