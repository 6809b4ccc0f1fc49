"""GymEnv: rows of environments of Gymnasium as one TorchRL environment."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, TensorSpec, Unbounded
from torchrl.envs import EnvBase
from typing_extensions import override

from ctgraph_rl.batch.assignment import one_hot_ids, require_num_ids
from ctgraph_rl.batch.rows import seed_rule
from ctgraph_rl.batch.specs import TASK_NUMBER, done_spec, observation_spec, reward_spec
from ctgraph_rl.checks import NamedValues, ReadOnlyValues, Rule, one_of, require, require_all, takes_numbers
from ctgraph_rl.core.device import checked_device
from ctgraph_rl.core.dynamics import beside
from ctgraph_rl.tasks.kinds.gym_spaces import ActionForm, Taken
from ctgraph_rl.tasks.kinds.gym_task import GymTask, kept_while_registered, make_forms
from ctgraph_rl.tasks.kinds.task_like import close_env
from ctgraph_rl.tasks.protocol import EPISODES

T = TypeVar("T")

NUM_PROBED = 20


class GymEnv(EnvBase):
    """Environments of Gymnasium, ``batch_size=[len(tasks)]``, stepped one after the other.

    ``next`` shows the last observation of an episode. An episode that the time limit ended is ``truncated``, any other
    ``terminated``. Observation keys are those of `TaskLike.make_env`. A row that gets another task closes its
    environment; `close` closes all.

    Args:
        seed: of all episodes, in [0, 2**63).
        task_pool: the tasks that `set_tasks` may be given. Default: ``tasks``.
        task_ids: the id of each task, as in `TaskLike.make_env`.
        num_task_ids: length of ``task_id``; None: just enough.
        episodes: ``"hidden"`` hides where they end, as `ctgraph_rl.CTGraphEnv` does.

    Raises:
        ValueError: for tasks of different spaces, and an environment that does not repeat with its seed or leaves its
            spaces.
        FloatingPointError: for an observation or a reward that is not finite; names environment, task and frame.

    Example:
        >>> env = GymEnv([GymTask("CartPole-v1")] * 2, seed=0)
        >>> env.rollout(10, break_when_any_done=False)["observation"].shape
        torch.Size([2, 10, 4])
    """

    batch_locked = True

    @takes_numbers
    def __init__(
        self,
        tasks: Iterable[GymTask],
        seed: int = 0,
        *,
        task_pool: Iterable[GymTask] | None = None,
        device: torch.device | str = "cpu",
        task_ids: Mapping[GymTask, int] | None = None,
        num_task_ids: int | None = None,
        episodes: str = "shown",
    ) -> None:
        require(*one_of(EPISODES, episodes=episodes))
        tasks = require_all(GymTask, "tasks", tasks)
        pool = tasks if task_pool is None else require_all(GymTask, "task_pool", task_pool)
        self.pool = tuple(dict.fromkeys((*pool, *tasks)))
        self._forms = {task: make_forms(task) for task in self.pool}
        forms = []
        for seen, taken in self._forms.values():
            forms.append(f"{np.dtype(seen.dtype)} {list(seen.shape)} with actions {taken.form}")
        different = ", ".join(dict.fromkeys(forms))
        one_form = f"tasks of one environment must have observations and actions of one form, got {different}"
        require(seed_rule(seed), (len(set(forms)) == 1, one_form), *map(_repeats_rule, self.pool))
        self.num_task_ids = require_num_ids(task_ids, num_task_ids)
        count = len(tasks)
        super().__init__(device=checked_device(device), batch_size=torch.Size([count]))
        self.seed = seed
        self.hides_episodes = episodes == "hidden"
        self.ends: dict[str, Tensor] = {}
        self.tasks = tasks
        self._ids = {} if task_ids is None else dict(task_ids)
        self._next = tasks
        self._episode = np.full(count, -1, dtype=np.int64)
        self._actions: list[list[Any]] = [[] for _ in tasks]
        self._num_frames = 0
        self._envs: list[Any] = []
        self.is_closed = False
        try:
            for task in tasks:
                self._envs.append(task.make())
        except BaseException:
            self.close()
            raise
        rows = self.batch_size
        observed, acted = self._forms[self.pool[0]]
        shape = (*rows, *observed.shape)
        images: TensorSpec = Unbounded(shape=shape, dtype=torch.float32, device="cpu")
        if observed.dtype == np.uint8:
            images = Bounded(0, observed.largest, shape=shape, dtype=torch.uint8, device="cpu")
        shown = not self.hides_episodes
        self.observation_spec = observation_spec(images, rows, self.num_task_ids, info=shown).to(self.device)
        self.action_spec = _make_action_spec(acted, rows).to(self.device)
        self.reward_spec = reward_spec(rows).to(self.device)
        self.full_done_spec = done_spec(rows).to(self.device)
        every = observation_spec(images, rows, self.num_task_ids).to(self.device)
        self._data = {**every.zero(), **self.full_done_spec.zero()}

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close the environments of all rows; one that fails is named and keeps no other open."""
        super().close(raise_if_closed=raise_if_closed)
        envs = self._envs
        self._envs = []
        for env in envs:
            close_env(env)

    def _check_open(self) -> None:
        require((not self.is_closed, "the environments of this GymEnv are closed: make another one"))

    def set_tasks(self, tasks: Iterable[GymTask], at_episode_end: bool = False) -> None:
        """Give every row a task of the pool: before the next reset of all rows, or at the end of its episode.

        Raises:
            ValueError: if there is not one task per row, or a task is not in the pool.
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
        tasks = list(self.tasks)
        for row in rows:
            task = self._next[row]
            if task != tasks[row]:
                former = self._envs[row]
                self._envs[row] = task.make()
                tasks[row] = task
                close_env(former)
        self.tasks = tuple(tasks)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDict:
        self._check_open()
        given = None if tensordict is None else tensordict.get("_reset", None)
        mask = np.ones(len(self.tasks), dtype=bool)
        if given is not None and (self._episode >= 0).all():
            mask = given.view(-1).cpu().numpy()
        rows = np.flatnonzero(mask).tolist()
        seen = self._zero_observations()
        for row in rows:
            seen[row] = self._begin_next(row)
        begun = torch.from_numpy(mask).to(self.device).unsqueeze(-1)
        data = self._observed(seen)
        for key, value in self._data.items():
            first = data[key] if key in data else torch.zeros_like(value)
            data[key] = torch.where(beside(begun, value), first, value)
        data["is_init"] = begun
        return self._shown(data)

    def _begin_next(self, row: int) -> NDArray[Any]:
        self._place([row])
        self._episode[row] += 1
        self._actions[row] = []
        return self._begin(row)

    def _begin(self, row: int) -> NDArray[Any]:
        observed, _ = self._forms[self.tasks[row]]
        env = self._envs[row]
        return self._read(row, lambda seed: observed.read_first(_reset(env, seed)), self._episode_seed(row))

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self._check_open()
        actions = self._forms[self.pool[0]][1].read(tensordict["action"].detach().cpu().numpy())
        seen = self._zero_observations()
        rewards = []
        terminated = []
        truncated = []
        starts = self._data["done"] & self.hides_episodes
        for row, begins in enumerate(starts.flatten().tolist()):
            observed, acted = self._forms[self.tasks[row]]
            if begins:
                taken = Taken(self._begin_next(row), 0.0, False, False)
            else:
                self._actions[row].append(actions[row])
                taken = self._read(row, observed.read_step, self._envs[row].step(acted.give(actions[row])))
            seen[row] = taken.observation
            rewards.append(taken.reward)
            terminated.append(taken.terminated)
            truncated.append(taken.truncated)
        self._num_frames += len(self._envs)
        reward = self._column(rewards, torch.float32)
        data = self._observed(seen)
        data["terminated"] = self._column(terminated, torch.bool)
        data["truncated"] = self._column(truncated, torch.bool)
        data["done"] = data["terminated"] | data["truncated"]
        data["is_init"] = torch.zeros_like(data["done"])
        data["step_count"] = (self._data["step_count"] + 1) * ~starts
        data["episode_reward"] = torch.where(starts, 0, self._data["episode_reward"]) + reward
        return self._shown(data).set("reward", reward)

    def _read(self, row: int, read: Callable[[Any], T], returned: Any) -> T:
        try:
            return read(returned)
        except (ValueError, FloatingPointError) as error:
            step = len(self._actions[row])
            place = f"frame {self._num_frames + row + 1}, step {step} of an episode with seed {self._episode_seed(row)}"
            raise type(error)(f"{_name(self.tasks[row])}: {error} ({place})") from error

    def _zero_observations(self) -> NDArray[Any]:
        observed = self._forms[self.pool[0]][0]
        return np.zeros((len(self.tasks), *observed.shape), dtype=observed.dtype)

    def _column(self, values: Sequence[float], dtype: torch.dtype) -> Tensor:
        return torch.tensor(values, dtype=dtype, device=self.device).unsqueeze(-1)

    def _shown(self, data: dict[str, Tensor]) -> TensorDict:
        self._data = data
        if self.hides_episodes:
            self.ends = {key: data[key] for key in ("done", "step_count", "episode_reward")}
            never = torch.zeros_like(data["done"])
            data = {key: value for key, value in data.items() if key not in self.ends}
            data |= dict.fromkeys(("done", "terminated", "truncated"), never)
        return TensorDict(data, batch_size=self.batch_size, device=self.device).clone()

    def _observed(self, seen: NDArray[Any]) -> dict[str, Tensor]:
        data = {"observation": torch.from_numpy(seen).to(self.device)}
        if self.num_task_ids:
            ids = torch.tensor([self._ids.get(task, -1) for task in self.tasks], device=self.device, dtype=torch.int64)
            data["task_id"] = one_hot_ids(ids, self.num_task_ids)
            data[TASK_NUMBER] = ids.unsqueeze(-1)
        return data

    def _episode_seed(self, row: int) -> int:
        sequence = np.random.SeedSequence((self.seed, row, int(self._episode[row])))
        return int(sequence.generate_state(1)[0] >> 1)

    @takes_numbers
    @override
    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        return super().set_seed(seed, static_seed)

    def _set_seed(self, seed: int | None) -> None:
        require(seed_rule(seed))
        self.seed = seed  # type: ignore[assignment]
        self._episode[:] = -1

    def state_dict(self, *args: Any, **kwargs: Any) -> NamedValues:
        """Return each row's task, episode and actions, and the shown data."""
        return {
            "tasks": self._numbers(self.tasks),
            "next_tasks": self._numbers(self._next),
            "num_frames": self._num_frames,
            "episode": torch.from_numpy(self._episode.copy()),
            "actions": [torch.from_numpy(np.array(played)) for played in self._actions],
            "data": dict(self._data),
        }

    def _numbers(self, tasks: Iterable[GymTask]) -> list[int]:
        return [self.pool.index(task) for task in tasks]

    def _numbered(self, numbers: Iterable[int]) -> tuple[GymTask, ...]:
        return tuple(self.pool[number] for number in numbers)

    def load_state_dict(self, state_dict: ReadOnlyValues, *args: Any, **kwargs: Any) -> None:
        """Restore a state: each row's episode begins with its seed and repeats its actions.

        Raises:
            ValueError: if a row then does not show what it showed.
        """
        rows = range(len(self.tasks))
        self._next = self._numbered(state_dict["tasks"])
        self._place(rows)
        self._next = self._numbered(state_dict["next_tasks"])
        self._num_frames = state_dict["num_frames"]
        self._episode = state_dict["episode"].numpy().copy()
        kept = all(task.repeats for task in self.tasks)
        self._actions = [list(played.numpy()) if kept else [] for played in state_dict["actions"]]
        seen = self._zero_observations()
        for row in rows:
            observed, acted = self._forms[self.tasks[row]]
            seen[row] = self._begin(row)
            for action in self._actions[row]:
                returned = self._envs[row].step(acted.give(action))
                seen[row] = self._read(row, observed.read_step, returned).observation
        self._data = {key: value.to(self.device) for key, value in state_dict["data"].items()}
        same = self._observed(seen)["observation"].equal(self._data["observation"])
        require(
            (same or not kept, f"{self.tasks[0].id} does not show what it showed before the run was stopped: {FIX}")
        )


FIX = "make reset(seed=...) decide all of an episode, or give GymTask(repeats=False)"


def _make_action_spec(acted: ActionForm, rows: torch.Size) -> Any:
    if acted.num_actions is not None:
        return Categorical(acted.num_actions, shape=rows, dtype=torch.int64, device="cpu")
    shape = (*rows, *acted.shape)
    if not np.isfinite(acted.ends).all():
        return Unbounded(shape=shape, dtype=torch.float32, device="cpu")
    low, high = torch.from_numpy(acted.ends).unsqueeze(1).expand(2, *shape)
    return Bounded(low, high, shape=shape, dtype=torch.float32, device="cpu")


def _name(task: GymTask) -> str:
    label = task.label_parts["task"]
    return task.id if label == task.id else f"{task.id} ({label})"


def _reset(env: Any, seed: int) -> Any:
    try:
        return env.reset(seed=seed)
    except TypeError as error:
        if "argument" not in str(error):
            raise
        fix = "write reset(self, *, seed=None, options=None)"
        raise ValueError(f"it cannot be reset with a seed: {error}; {fix}") from error


@kept_while_registered
def _repeats_rule(task: GymTask) -> Rule:
    if not task.repeats:
        return True, ""
    envs: list[Any] = []
    try:
        envs += [task.make()]
        envs += [task.make()]
        first, other = envs
        same = _play_probe(task, first) == _play_probe(task, first) == _play_probe(task, other)
    finally:
        for env in envs:
            close_env(env)
    return same, f"an episode of {task.id} must repeat with its seed and actions, and it does not: {FIX}"


def _play_probe(task: GymTask, env: Any) -> list[Any]:
    observed, _ = make_forms(task)
    env.action_space.seed(0)
    shown: list[Any] = []
    try:
        shown.append(observed.read_first(_reset(env, 0)).tobytes())
        for _ in range(NUM_PROBED):
            taken = observed.read_step(env.step(env.action_space.sample()))
            shown.append((taken.observation.tobytes(), taken.reward, taken.terminated, taken.truncated))
            if taken.terminated or taken.truncated:
                break
    except Exception as error:  # of an environment of anyone
        kind = FloatingPointError if isinstance(error, FloatingPointError) else ValueError
        cause = "" if isinstance(error, (FloatingPointError, ValueError)) else f"{type(error).__name__}: "
        place = f"step {len(shown)} of an episode of random actions with seed 0"
        raise kind(f"{_name(task)}: {cause}{error} ({place})") from error
    return shown
