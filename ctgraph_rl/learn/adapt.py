"""Policies of any form, of NumPy arrays or with ``predict``, as functions of TensorDicts."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn

from ctgraph_rl.checks import require
from ctgraph_rl.learn.collect import Policy
from ctgraph_rl.learn.logits_policy import as_policy, positional_parameters


def adapt(policy: Any, greedy: bool, num_actions: int | None, shows_ids: bool = False) -> Policy:
    """Return any policy, as `ctgraph_rl.Recorder` takes, as a function of TensorDicts.

    Raises:
        ValueError: for what is no policy.
    """
    if isinstance(policy, TensorDictModuleBase | type):
        return policy
    act = partial(_act_on_arrays, discrete=num_actions is not None)
    if hasattr(policy, "predict"):
        predict = policy.predict
        space = getattr(policy, "observation_space", None)
        blind = shows_ids and space is not None and "task_id" not in getattr(space, "spaces", {})
        fix = "give it a Dict space of observation and task_id, or hide it: replace(curriculum, protocol=Protocol())"
        require((not blind, f"the protocol shows a task_id that {type(policy).__name__} has no place for: {fix}"))
        return act(lambda observation, state, start: predict(observation, state, start, deterministic=greedy))
    if isinstance(policy, nn.Module):
        return as_policy(policy, num_actions)
    require((callable(policy), f"policy must be a function, or an object with predict, got {type(policy).__name__}"))
    places = positional_parameters(policy)
    if [p.name for p in places[1:2]] == ["task_id"]:
        return act(lambda shown, state, start: (policy(*_parts(shown)), None))
    taken = [p for p in places if p.default is p.empty]
    fits = len(taken) in (1, 3)
    require(
        (fits, f"policy must take (observation) or (observation, state, episode_start), not {len(taken)} arguments")
    )
    return act(policy if len(taken) == 3 else lambda observation, state, start: (policy(observation), None))


def _parts(shown: Any) -> tuple[Any, Any]:
    return (shown["observation"], shown["task_id"]) if isinstance(shown, dict) else (shown, None)


def _act_on_arrays(act: Callable[[Any, Any, Any], tuple[Any, Any]], discrete: bool) -> Policy:
    state = None

    def policy(data: TensorDictBase) -> TensorDictBase:
        nonlocal state
        observation: Any = data["observation"].numpy()
        if "task_id" in data.keys():  # noqa: SIM118, a TensorDict iterates over rows
            observation = {"observation": observation, "task_id": data["task_id"].numpy()}
        actions, state = act(observation, state, data["is_init"].squeeze(-1).numpy())
        actions = np.asarray(actions)
        if not discrete:
            return data.set("action", torch.from_numpy(actions.astype(np.float32)))
        whole = np.issubdtype(actions.dtype, np.integer) and actions.shape == data.batch_size
        got = f"{actions.dtype} {list(actions.shape)}"
        require((whole, f"a policy must return {data.batch_size[0]} integer actions, one for each row, got {got}"))
        return data.set("action", torch.from_numpy(actions.astype(np.int64)))

    return policy
