"""Steps of Gymnasium environments with random actions, and the equality of what they return."""

from __future__ import annotations

import numpy as np
from gymnasium.vector import AutoresetMode

from ctgraph_rl.gym import CONFIGURATIONS

MODES = tuple(AutoresetMode)
IDS = ["ctgraph/CTGraph-v0", *(f"ctgraph/{name}-v{int(name == 'CT-POSR-B1')}" for name in CONFIGURATIONS)]


def act(rng, num_envs, num_actions=3):
    """Random actions, half of them waits so that episodes get somewhere."""
    return rng.integers(num_actions, size=num_envs) * rng.integers(2, size=num_envs)


def assert_equal(ours, theirs, where=""):
    """Equality of nested results, with equal types of arrays."""
    assert type(ours) is type(theirs), where
    if isinstance(theirs, dict):
        assert ours.keys() == theirs.keys(), where
        for key in theirs:
            assert_equal(ours[key], theirs[key], f"{where}/{key}")
    elif isinstance(theirs, (tuple, list)):
        assert len(ours) == len(theirs), where
        for i, pair in enumerate(zip(ours, theirs, strict=True)):
            assert_equal(*pair, f"{where}/{i}")
    elif isinstance(theirs, np.ndarray) and theirs.dtype == object:
        assert_equal(list(ours), list(theirs), where)
    elif isinstance(theirs, np.ndarray):
        assert (ours.dtype, ours.shape) == (theirs.dtype, theirs.shape), where
        assert np.array_equal(ours, theirs), where
    else:
        assert ours == theirs, where


def play(envs, seed, num_steps):
    """All that an environment returns for random actions; without autoreset, done rows are reset by a mask."""
    rng, results = np.random.default_rng(7), [envs.reset(seed=seed)]
    num_actions = envs.single_action_space.n
    for _ in range(num_steps):
        results.append(envs.step(act(rng, envs.num_envs, num_actions)))
        done = results[-1][2] | results[-1][3]
        if envs.metadata["autoreset_mode"] == AutoresetMode.DISABLED and done.any():
            results.append(envs.reset(options={"reset_mask": done.copy()}))
    return results
