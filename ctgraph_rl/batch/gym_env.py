"""GymEnv: rows of environments of Gymnasium as one TorchRL environment."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.nn.functional import one_hot
from torchrl.data import Bounded, Categorical, Unbounded
from torchrl.envs import EnvBase

from ctgraph_rl.batch.assignment import checked_num_ids, one_hot_ids
from ctgraph_rl.batch.rows import seed_rule
from ctgraph_rl.batch.specs import done_spec, observation_spec, reward_spec
from ctgraph_rl.checks import NamedValues, ReadOnlyValues, Rule, require, require_all
from ctgraph_rl.core.device import checked_device
from ctgraph_rl.core.dynamics import beside
from ctgraph_rl.tasks.kinds.gym_task import GymTask, spaces_of

NUM_PROBED = 20
"""Steps by which it is seen whether an environment repeats."""


class GymEnv(EnvBase):
    """A batch of environments of Gymnasium, ``batch_size=[len(tasks)]``, stepped one after the other.

    ``next`` shows the last observation of an episode. An episode that has ended by itself is ``terminated``, one that
    the time limit ended ``truncated``. The observation keys are those of `TaskLike.make_env`.

    Args:
        tasks: one for each row.
        seed: decides the seed of every episode, in [0, 2**63).
        task_pool: the tasks that `set_tasks` may be given. Default: ``tasks``.
        device: where the tensors live.
        task_ids: the id of each task, see `TaskLike.make_env`.
        num_task_ids: length of ``task_id``; None: just enough.

    Raises:
        ValueError: for tasks of different spaces, and an environment that does not repeat with its seed.

    Example:
        >>> env = GymEnv([GymTask("CartPole-v1")] * 2, seed=0)
        >>> env.rollout(10, break_when_any_done=False)["observation"].shape
        torch.Size([2, 10, 4])
    """

    batch_locked = True

    def __init__(
        self,
        tasks: Iterable[GymTask],
        seed: int = 0,
        *,
        task_pool: Iterable[GymTask] | None = None,
        device: torch.device | str = "cpu",
        task_ids: Mapping[GymTask, int] | None = None,
        num_task_ids: int | None = None,
    ) -> None:
        tasks = require_all(GymTask, "tasks", tasks)
        pool = tasks if task_pool is None else require_all(GymTask, "task_pool", task_pool)
        self.pool = tuple(dict.fromkeys((*pool, *tasks)))
        require(seed_rule(seed), _same_spaces(self.pool), *map(_repeats_rule, self.pool))
        self.num_task_ids = checked_num_ids(task_ids, num_task_ids)
        count = len(tasks)
        super().__init__(device=checked_device(device), batch_size=torch.Size([count]))
        self.seed = seed
        self.tasks = tasks
        self._ids = {} if task_ids is None else dict(task_ids)
        self._next = tasks
        self._episode = np.full(count, -1, dtype=np.int64)
        self._actions: list[list[Any]] = [[] for _ in tasks]
        self._rows = SyncVectorEnv(
            [task.make for task in tasks],
            autoreset_mode=AutoresetMode.DISABLED,  # so that the last observation shows, and we give each seed
            observation_mode="different",
            copy=False,
        )
        self._made = [{task: env} for task, env in zip(tasks, self._rows.envs, strict=True)]
        self._make_specs()

    def _make_specs(self) -> None:
        rows = self.batch_size
        observed, acted = spaces_of(self.pool[0])
        seen = _spec_of_observations(observed, (*rows, *self.pool[0].observation_shape))
        self.observation_spec = observation_spec(seen, rows, self.num_task_ids).to(self.device)
        self.action_spec = _spec_of_actions(acted, rows).to(self.device)
        self.reward_spec = reward_spec(rows).to(self.device)
        self.full_done_spec = done_spec(rows).to(self.device)
        self._data = {**self.observation_spec.zero(), **self.full_done_spec.zero()}

    def set_tasks(self, tasks: Iterable[GymTask], at_episode_end: bool = False) -> None:
        """Give every row a task of the pool: before the next reset of all rows, or at the end of its episode.

        Raises:
            ValueError: for another number of tasks than rows, and one that is not of the pool.
        """
        tasks = require_all(GymTask, "tasks", tasks)
        unknown = [task for task in tasks if task not in self.pool]
        require(
            (len(tasks) == len(self.tasks), f"tasks must be one for each of {len(self.tasks)} rows, got {len(tasks)}"),
            (not unknown, f"tasks must be of task_pool, got {unknown[:1]}"),
        )
        self._next = tasks
        if not at_episode_end:
            self._place(range(len(tasks)))

    def _place(self, rows: Iterable[int]) -> None:
        """Give rows their next tasks, and put the environments of these in place; each is made once."""
        tasks = list(self.tasks)
        for row in rows:
            made = self._made[row]
            task = self._next[row]
            if task not in made:
                made[task] = task.make()
            self._rows.envs[row] = made[task]
            tasks[row] = task
        self.tasks = tuple(tasks)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDict:
        given = None if tensordict is None else tensordict.get("_reset", None)
        mask = np.ones(len(self.tasks), dtype=bool)
        if given is not None and (self._episode >= 0).all():
            mask = given.view(-1).cpu().numpy()
        rows = np.flatnonzero(mask).tolist()
        self._place(rows)
        self._episode[mask] += 1
        seeds: list[int | None] = [None] * len(mask)
        for row in rows:
            self._actions[row] = []
            seeds[row] = self._episode_seed(row)
        observations, _ = self._rows.reset(seed=seeds, options={"reset_mask": mask})
        begun = torch.from_numpy(mask).to(self.device).unsqueeze(-1)
        data = self._observed(observations)
        for key, value in self._data.items():
            first = data[key] if key in data else torch.zeros_like(value)
            data[key] = torch.where(beside(begun, value), first, value)
        data["is_init"] = begun
        return self._shown(data)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        action = tensordict["action"].cpu().numpy()
        for played, taken in zip(self._actions, action, strict=True):
            played.append(taken)
        observations, reward, terminated, truncated, _ = self._rows.step(self._as_given(action))
        rewards = self._column(reward, torch.float32)
        data = self._observed(observations)
        data["terminated"] = self._column(terminated, torch.bool)
        data["truncated"] = self._column(truncated, torch.bool)
        data["done"] = data["terminated"] | data["truncated"]
        data["is_init"] = torch.zeros_like(data["done"])
        data["step_count"] = self._data["step_count"] + 1
        data["episode_reward"] = self._data["episode_reward"] + rewards
        return self._shown(data).set("reward", rewards)

    def _column(self, values: np.ndarray, dtype: torch.dtype) -> Tensor:
        """Return a value of each row, [rows, 1]."""
        return torch.tensor(values, dtype=dtype, device=self.device).unsqueeze(-1)

    def _shown(self, data: dict[str, Tensor]) -> TensorDict:
        self._data = data
        return TensorDict(data, batch_size=self.batch_size, device=self.device).clone()

    def _observed(self, observations: Any) -> dict[str, Tensor]:
        """Return what rows show of their observations and tasks."""
        shape = self.pool[0].observation_shape
        space = spaces_of(self.pool[0])[0]
        seen = torch.from_numpy(np.array(observations)).to(self.device)
        if hasattr(space, "n"):
            numbers = seen.long() - int(space.start)
            seen = one_hot(numbers, shape[0]).to(torch.uint8)
        elif space.dtype == np.uint8:
            seen = seen.permute(0, 3, 1, 2) if seen.ndim == 4 else seen.view(-1, *shape)
        else:
            seen = seen.float()
        data = {"observation": seen.contiguous()}
        if self.num_task_ids:
            ids = torch.tensor([self._ids.get(task, -1) for task in self.tasks], device=self.device, dtype=torch.int64)
            data["task_id"] = one_hot_ids(ids, self.num_task_ids)
        return data

    def _as_given(self, action: np.ndarray) -> np.ndarray:
        """Return actions as Gymnasium counts them."""
        if action.ndim > 1:
            return action
        _, space = spaces_of(self.pool[0])
        return action + int(getattr(space, "start", 0))

    def _episode_seed(self, row: int) -> int:
        """Return the seed of a row's present episode, in [0, 2**31)."""
        sequence = np.random.SeedSequence((self.seed, row, int(self._episode[row])))
        return int(sequence.generate_state(1)[0] >> 1)

    def _set_seed(self, seed: int | None) -> None:
        """Begin the episodes of another seed with the next reset."""
        require(seed_rule(seed))
        self.seed = seed  # type: ignore[assignment]
        self._episode[:] = -1

    def state_dict(self, *args: Any, **kwargs: Any) -> NamedValues:
        """Return what `load_state_dict` needs to continue: each row's task, episode and actions, and the shown data."""
        return {
            "tasks": self._numbers(self.tasks),
            "next_tasks": self._numbers(self._next),
            "episode": torch.from_numpy(self._episode.copy()),
            "actions": [torch.from_numpy(np.array(played)) for played in self._actions],
            "data": dict(self._data),
        }

    def _numbers(self, tasks: Iterable[GymTask]) -> list[int]:
        return [self.pool.index(task) for task in tasks]

    def _numbered(self, numbers: Iterable[int]) -> tuple[GymTask, ...]:
        return tuple(self.pool[number] for number in numbers)

    def load_state_dict(self, state_dict: ReadOnlyValues, *args: Any, **kwargs: Any) -> None:
        """Go back to a state: each row's episode begins with its seed, and its actions are taken again.

        Raises:
            ValueError: if a row then does not show what it showed.
        """
        rows = range(len(self.tasks))
        self._next = self._numbered(state_dict["tasks"])
        self._place(rows)
        self._next = self._numbered(state_dict["next_tasks"])
        self._episode = state_dict["episode"].numpy().copy()
        kept = all(task.repeats for task in self.tasks)
        self._actions = [list(played.numpy()) if kept else [] for played in state_dict["actions"]]
        seeds: list[int | None] = [self._episode_seed(row) for row in rows]
        begun, _ = self._rows.reset(seed=seeds, options={"reset_mask": np.ones(len(seeds), dtype=bool)})
        found = np.array(begun)
        for row in rows:
            for action in self._actions[row]:
                [given] = self._as_given(np.asarray([action]))
                found[row], *_ = self._rows.envs[row].step(given)
        self._data = {key: value.to(self.device) for key, value in state_dict["data"].items()}
        same = self._observed(found)["observation"].equal(self._data["observation"])
        require(
            (same or not kept, f"{self.tasks[0].id} does not show what it showed before the run was stopped: {FIX}")
        )


FIX = "make reset(seed=...) decide all of an episode, or give GymTask(repeats=False)"


def _spec_of_observations(space: Any, shape: tuple[int, ...]) -> Any:
    if hasattr(space, "n"):
        return Bounded(0, 1, shape=shape, dtype=torch.uint8, device="cpu")
    if space.dtype == np.uint8:
        return Bounded(0, 255, shape=shape, dtype=torch.uint8, device="cpu")
    return Unbounded(shape=shape, dtype=torch.float32, device="cpu")


def _spec_of_actions(space: Any, rows: torch.Size) -> Any:
    if hasattr(space, "n"):
        return Categorical(int(space.n), shape=rows, dtype=torch.int64, device="cpu")
    shape = (*rows, *space.shape)
    ends = np.stack([space.low, space.high])
    if not np.isfinite(ends).all():
        return Unbounded(shape=shape, dtype=torch.float32, device="cpu")
    low, high = torch.tensor(ends, dtype=torch.float32, device="cpu").unsqueeze(1).expand(2, *shape)
    return Bounded(low, high, shape=shape, dtype=torch.float32, device="cpu")


def _same_spaces(pool: Sequence[GymTask]) -> Rule:
    """Return the rule that tasks can be rows of one environment."""
    forms = []
    for task in pool:
        observed, acted = spaces_of(task)
        form = f"{observed.dtype} {list(task.observation_shape)} with actions {acted}"
        if form not in forms:
            forms.append(form)
    rule = f"tasks of one environment must have observations and actions of one form, got {', '.join(forms)}"
    return len(forms) == 1, rule


@cache
def _repeats_rule(task: GymTask) -> Rule:
    """Return the rule that an episode repeats with its seed: in one environment, and in another."""
    if not task.repeats:
        return True, ""
    first = task.make()
    other = task.make()
    same = _play_probe(first) == _play_probe(first) == _play_probe(other)
    return same, f"an episode of {task.id} must repeat with its seed and actions, and it does not: {FIX}"


def _play_probe(env: Any) -> list[bytes]:
    """Return what an episode of random actions shows."""
    env.action_space.seed(0)
    shown = [np.asarray(env.reset(seed=0)[0]).tobytes()]
    for _ in range(NUM_PROBED):
        observation, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        shown.append(np.asarray(observation).tobytes() + np.float64(reward).tobytes() + bytes([terminated, truncated]))
        if terminated or truncated:
            break
    return shown
