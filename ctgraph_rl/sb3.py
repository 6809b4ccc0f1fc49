"""CT-graphs for Stable-Baselines3 in one batch, many times as fast as its ``make_vec_env``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from typing_extensions import override

from ctgraph_rl.checks import NamedValues, Rule, require, takes_numbers
from ctgraph_rl.gym import CTGraphVectorEnv, StreamVectorEnv
from ctgraph_rl.tasks.curriculum import Stream

try:
    from stable_baselines3.common.vec_env import VecEnv
    from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn
except ImportError as error:
    raise ImportError("ctgraph_rl.sb3 needs Stable-Baselines3: pip install stable-baselines3") from error


TOLD = ("task", "outcome", "leaf", "optimum", "regret")
"""Keys of infos, the last two of a stream."""


class SB3VecEnv(VecEnv):
    """A `CTGraphVectorEnv` for Stable-Baselines3, equal step for step to its ``DummyVecEnv`` of `CTGraphGymEnv`.

    ``VecMonitor(SB3VecEnv(256, "CT-SU-B1"))`` records returns and lengths of episodes.

    Args:
        task: as in `CTGraphVectorEnv`, also all others but the autoreset mode.
        stream: as in `StreamVectorEnv`, in place of ``task``.

    Example:
        >>> envs = SB3VecEnv(256, "CT-SU-B1")
        >>> envs.reset().shape
        (256, 1, 12, 12)
    """

    @takes_numbers
    def __init__(self, num_envs: int, task: Any = None, stream: Stream | None = None, **kwargs: Any) -> None:
        both = f"a stream has its tasks, got task={task!r:.80} beside it: leave one of both out"
        require((stream is None or task is None, both))
        same_step = AutoresetMode.SAME_STEP
        if stream is None:
            self.envs = CTGraphVectorEnv(num_envs, task, autoreset_mode=same_step, **kwargs)
        else:
            self.envs = StreamVectorEnv(num_envs, stream, autoreset_mode=same_step, **kwargs)
        super().__init__(num_envs, self.envs.single_observation_space, self.envs.single_action_space)
        self.metadata = self.envs.metadata

    def reset(self) -> Any:
        """Start an episode in all rows, with the seeds of ``seed``."""
        observation, infos = self.envs.reset(seed=self._seeds)
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = _by_row(infos)
        return observation

    @override
    def step_async(self, actions: NDArray[np.int64]) -> None:
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """One step; done rows start an episode and have the last observation in ``terminal_observation``."""
        observation, rewards, terminated, truncated, batch = self.envs.step(self._actions)
        done = terminated | truncated
        infos = _by_row(batch)
        for info, cut in zip(infos, truncated.tolist(), strict=True):
            info["TimeLimit.truncated"] = cut
        ended = done.nonzero()[0].tolist()
        if ended:
            begun = _by_row(batch)
            final = _by_row(batch["final_info"])
            for i in ended:
                self.reset_infos[i] = begun[i]
                infos[i] |= final[i] | {"terminal_observation": batch["final_obs"][i]}
        return observation, rewards.astype(np.float32), done, infos

    @override
    def close(self) -> None:
        self.envs.close()

    @override
    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        frames = self.envs.render() if self.render_mode == "rgb_array" else None
        return cast("Sequence[NDArray[np.uint8] | None]", frames or [None] * self.num_envs)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of the batch, repeated for every row; spaces are of one row."""
        name = f"single_{attr_name}" if attr_name in ("observation_space", "action_space") else attr_name
        found = getattr(self.envs, name)
        return [found for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the batch; ``indices`` must be None."""
        require(_batch_rule(indices))
        setattr(self.envs, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        """Call a method of the batch once, such as ``set_tasks`` with a list of tasks; ``indices`` must be None."""
        require(_batch_rule(indices))
        result = getattr(self.envs, method_name)(*args, **kwargs)
        return list(result) if isinstance(result, tuple) else [result] * self.num_envs

    @override
    def env_is_wrapped(self, wrapper_class: type, indices: VecEnvIndices = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]


def _batch_rule(indices: VecEnvIndices) -> Rule:
    return indices is None, f"the rows are one batch: indices must be None, got {indices!r}"


def _by_row(infos: NamedValues) -> list[NamedValues]:
    rows: list[NamedValues] = [{} for _ in infos["task"]]
    for key in (key for key in TOLD if key in infos):
        for row, value, known in zip(rows, infos[key].tolist(), infos[f"_{key}"].tolist(), strict=True):
            if known:
                row[key] = value
    return rows
