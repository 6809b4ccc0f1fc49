"""CT-graphs as Gymnasium environments: a single one, and a batch with all three autoreset modes.

``gymnasium.make("ctgraph_rl.gym:ctgraph/CT-SU-B1-v0")`` imports this module, which registers the ids.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import logger, spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from torch import Tensor
from typing_extensions import override

from ctgraph_rl.batch.assignment import require_num_ids
from ctgraph_rl.batch.rows import Rows, seed_rule
from ctgraph_rl.checks import NamedValues, Rule, as_int, as_tuple, is_int, require, takes_numbers
from ctgraph_rl.core.dynamics import NO_LEAF, OUTCOME_RUNNING, Shown, choose
from ctgraph_rl.draw.pixels import render
from ctgraph_rl.draw.text import as_text
from ctgraph_rl.log.named_curricula import curriculum_named
from ctgraph_rl.tasks.configurations import CONFIGURATIONS, Json, make_task
from ctgraph_rl.tasks.curriculum import Stream
from ctgraph_rl.tasks.protocol import MOST_ROWS
from ctgraph_rl.tasks.task import Task

Frame = NDArray[np.uint8] | str
NumpyArray = NDArray[Any]
RowMask = NDArray[np.bool_]

_RENDERING: NamedValues = {"render_modes": ["rgb_array", "ansi"], "render_fps": 2}


class CTGraphGymEnv(gymnasium.Env[Any, int]):
    """One CT-graph.

    Observations are uint8 [1, r, r], or [K] when one-hot; action 0 waits and 1..b decides; ``truncated`` is always
    False. ``info`` holds

    - ``task``: the number of the task in ``task_pool``,
    - ``outcome``: 0 running, 1 fail, 2 another end state, 3 the goal,
    - ``leaf``: the number of the end state arrived at, else -1.

    Args:
        task: as in `make_task`, also ``config`` and ``changes``.
        task_pool: tasks that `set_task` takes. Default: only the task.
        task_ids: the id of each task of the pool, such as ``curriculum.task_ids``. Observations are then a dict of
            ``observation`` and ``task_id``, uint8 [num_task_ids]: the id as one-hot.
        num_task_ids: length of ``task_id``; None: just enough.
        render_mode: ``rgb_array``, ``ansi`` or None.
        kernel: ``"auto"``, ``"off"`` or ``"required"``, as in `Rows`.
        life: steps of a life, which is ``truncated`` then and hides where its episodes end: the last state of one takes
            one more action, without effect, and the next starts. Only ``info`` tells outcomes. None: single episodes.

    Raises:
        ValueError: for values out of range.
    """

    metadata = _RENDERING

    @takes_numbers
    def __init__(
        self,
        task: Task | str | None = None,
        *,
        config: Json | None = None,
        task_pool: Iterable[Task] | None = None,
        task_ids: Mapping[Task, int] | None = None,
        num_task_ids: int | None = None,
        render_mode: str | None = None,
        kernel: str = "auto",
        life: int | None = None,
        **changes: Any,
    ) -> None:
        require(_life_rule(life))
        num_threads = torch.get_num_threads()
        torch.set_num_threads(1)  # `AsyncVectorEnv` forks the process, and a fork with threads waits for ever
        try:
            task = make_task(task, config, **changes)
            self.rows = Rows([task], task_pool=task_pool, kernel=kernel)
        finally:
            torch.set_num_threads(num_threads)
        self.task_pool = self.rows.pool
        self.render_mode = _known_mode(render_mode)
        images, self.action_space = _spaces(self.rows)
        self.observation_space, self._ids = add_task_ids(images, self.task_pool, task_ids, num_task_ids)
        self._number = self._next_number = self.task_pool.index(task)
        self._num_actions = self.rows.max_branching + 1
        self._is_seeded = False
        self._is_over = True
        self._life = life
        self._age = 0

    def set_task(self, task: Task) -> None:
        """Change to a task of the pool at the next reset, or the next episode of a life."""
        (self._next_number,) = self.rows.find_numbers([task])

    @torch.inference_mode()
    @takes_numbers
    def reset(self, *, seed: int | None = None, options: NamedValues | None = None) -> tuple[Any, NamedValues]:
        """Start an episode.

        Args:
            seed: start the random stream of (seed, row 0), in [0, 2**63); None: continue the present one.
        """
        require(_seed_rule(seed))
        super().reset(seed=seed)
        self._change_task()
        self._age = 0
        if seed is not None or not self._is_seeded:
            self._is_seeded = True
            first = int(self.np_random.integers(2**63 - 1)) if seed is None else seed
            self.rows.set_seed(first)
        self._is_over = False
        info = {"task": self._number, "outcome": OUTCOME_RUNNING, "leaf": NO_LEAF}
        return add_id(self.rows.restart().numpy()[0], self._ids, self._number), info

    @torch.inference_mode()
    def step(self, action: int) -> tuple[Any, float, bool, bool, NamedValues]:
        """One step with an action in 0..b.

        Raises:
            ValueError: for another action, and after the end of an episode.
        """
        number = as_int(action)
        is_action = 0 <= number < self._num_actions
        if self._is_over or not is_action:
            require(
                (is_action, f"action must be an integer in 0..{self._num_actions - 1}, got {action!r}"),
                (not self._is_over, "no episode is running: reset first"),
            )
        if self._life is None:
            observation, ends = self.rows.act(_as_tensor(number))
            self._is_over = bool(ends.item())
            outcome, leaf = self.rows.result(ends) if self._is_over else (OUTCOME_RUNNING, NO_LEAF)
        else:
            ended = self.rows.is_done
            if ended.item():
                self._change_task()
            observation, outcome, leaf, _ = self.rows.step_or_reset(_as_tensor(number), ended)
            self._age += 1
            self._is_over = self._age == self._life
        info = {"task": self._number, "outcome": int(outcome), "leaf": int(leaf)}
        shown = add_id(observation.numpy()[0], self._ids, self._number)
        is_cut = self._is_over and self._life is not None
        return shown, self.rows.reward.item(), self._is_over and not is_cut, is_cut, info

    def _change_task(self) -> None:
        if self._next_number != self._number:
            self._number = self._next_number
            self.rows.set_tasks([self.task_pool[self._number]])

    def render(self) -> Frame | None:
        """The state as a picture, uint8 [192, 384, 3], or text."""
        frames = _frames(self)
        return frames[0] if frames else None


class CTGraphVectorEnv(VectorEnv[Any, NDArray[np.int64], NumpyArray]):
    """A batch of CT-graphs, equal step for step to `gymnasium.vector.SyncVectorEnv` of as many `CTGraphGymEnv`.

    Row i has the random stream of seed ``seed + i``, or ``seed[i]``. Returned arrays are not changed later.

    Args:
        task: as in `make_task`, also ``config`` and ``changes``; or a list of a task per row.
        task_pool: tasks that `set_tasks` takes. Default: the rows' tasks.
        task_ids: as in `CTGraphGymEnv`, also ``num_task_ids``; ids are uint8 [num_envs, num_task_ids].
        render_mode: ``rgb_array``, ``ansi`` or None.
        autoreset_mode: when a row starts its next episode: ``NextStep``, in the next step, which ignores its action;
            ``SameStep``, at once, the last in ``final_obs`` and ``final_info``; ``Disabled``, by `reset` of a mask.
        kernel: ``"auto"``, ``"off"`` or ``"required"``, as in `Rows`.
        life: as in `CTGraphGymEnv`; a row that is truncated starts its next life as it would an episode.

    Raises:
        ValueError: for values out of range.
    """

    metadata = _RENDERING

    @takes_numbers
    def __init__(
        self,
        num_envs: int = 1,
        task: Task | str | Iterable[Task | str] | None = None,
        *,
        config: Json | None = None,
        task_pool: Iterable[Task] | None = None,
        task_ids: Mapping[Task, int] | None = None,
        num_task_ids: int | None = None,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        kernel: str = "auto",
        life: int | None = None,
        **changes: Any,
    ) -> None:
        within = f"num_envs must be an integer in 1..{MOST_ROWS}, got {num_envs!r:.80}"
        limit = changes.get("max_episode_steps")
        whole = f'this batch truncates no episode, got max_episode_steps={limit!r:.80}; vectorization_mode="sync" does'
        require((is_int(num_envs, 1, MOST_ROWS), within), ("max_episode_steps" not in changes, whole), _life_rule(life))
        rows = as_tuple(task)
        given = rows if isinstance(rows, tuple) else (task,)
        require((len(given) in (1, num_envs), f"task must be one, or one per row of {num_envs}, got {len(given)}"))
        made = [make_task(one, config, **changes) for one in given]
        tasks = made if len(made) == num_envs else made * num_envs
        self.num_envs = num_envs
        self.rows = Rows(tasks, task_pool=task_pool, kernel=kernel)
        self.task_pool = self.rows.pool
        self.render_mode = _known_mode(render_mode)
        modes = [mode.value for mode in AutoresetMode]
        is_mode = autoreset_mode in (*modes, *AutoresetMode)
        require((is_mode, f"autoreset_mode must be one of {modes}, got {autoreset_mode!r}"))
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {**_RENDERING, "autoreset_mode": self.autoreset_mode}
        images, self.single_action_space = _spaces(self.rows)
        self.single_observation_space, self._ids = add_task_ids(images, self.task_pool, task_ids, num_task_ids)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._numbers = self._next_numbers = np.array(self.rows.find_numbers(tasks))
        self._seeds = np.zeros(num_envs, np.int64)
        self._is_seeded = False
        self._is_over = np.ones(num_envs, np.bool_)
        self._life = life
        self._age = np.zeros(num_envs, np.int64)

    def set_tasks(self, tasks: Iterable[Task]) -> None:
        """Give every row a task of the pool, from its next reset."""
        numbers = np.array(self.rows.find_numbers(tasks))
        require((len(numbers) == self.num_envs, f"set_tasks needs {self.num_envs} tasks, got {len(numbers)}"))
        self._next_numbers = numbers

    @torch.inference_mode()
    @takes_numbers
    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: NamedValues | None = None
    ) -> tuple[Any, NamedValues]:
        """Start an episode in all rows, or in those of a mask.

        Args:
            seed: start the random streams of (seed + i, row 0), or of a list's seeds; None: continue the present ones.
            options: ``{"reset_mask": bool [N]}``: the rows to reset.

        Raises:
            ValueError: for wrong seeds and masks, and a mask in the first reset.
        """
        mask = np.ones(self.num_envs, np.bool_)
        if options is not None and "reset_mask" in options:
            mask = options["reset_mask"]
            fits = isinstance(mask, np.ndarray) and mask.dtype == np.bool_ and mask.shape == (self.num_envs,)
            rule = f"reset_mask must be a bool array of shape [{self.num_envs}] with a row to reset, got {mask!r}"
            require((fits and bool(mask.any()), rule), (self._is_seeded, "the first reset must be of all rows"))
            mask = mask.copy()
        self._start_streams(mask, seed)
        self._change_tasks(mask)
        self._is_over = self._is_over & ~mask
        self._age[mask] = 0
        shown = self.rows.reset(torch.from_numpy(mask))
        return add_id(shown.observation.numpy(), self._ids, self._numbers), self._infos(shown, mask)

    @torch.inference_mode()
    def step(self, actions: NDArray[np.int64]) -> tuple[Any, NumpyArray, NumpyArray, NumpyArray, NamedValues]:
        """One step of all rows with actions, integers [N] in 0..b.

        Raises:
            ValueError: for other actions, before the first reset, and for rows that are done without autoreset.
        """
        action = self._check(actions)
        over = self._is_over if self._life is None else self._is_over | self.rows.is_done.numpy()
        if over.any() or self.rows.uses_kernel:
            self._change_tasks(over)
            shown = self.rows.step_or_reset(action, torch.from_numpy(over))
        else:
            images, ends = self.rows.act(action)
            shown = Shown(images, *self.rows.result(ends), ends)
        rewards = self.rows.reward.numpy().astype(np.float64)
        done = shown.done.numpy()
        if self._life is not None:
            self._age = np.where(self._is_over, 0, self._age + 1)
            done = self._age == self._life
        if self.autoreset_mode == AutoresetMode.SAME_STEP and done.any():
            shown, infos = self._restart(done, shown)
        else:
            self._is_over = done
            infos = self._infos(shown)
        observation = add_id(shown.observation.numpy(), self._ids, self._numbers)
        never = np.zeros_like(done)
        if self._life is None:
            return observation, rewards, done.copy(), never, infos
        return observation, rewards, never, done.copy(), infos

    def _restart(self, done: RowMask, final: Shown) -> tuple[Shown, NamedValues]:
        last = np.full(self.num_envs, None, dtype=object)
        for i, observation in zip(done.nonzero()[0], final.observation.numpy()[done], strict=True):
            last[i] = add_id(observation, self._ids, self._numbers[i])
        infos: NamedValues = {"final_obs": last, "_final_obs": done.copy()}
        infos |= {"final_info": self._infos(final, done), "_final_info": done.copy()}
        self._change_tasks(done)
        self._age[done] = 0
        shown = self.rows.reset(torch.from_numpy(done))
        return shown, infos | self._infos(shown)

    def _infos(self, shown: Shown, mask: RowMask | None = None) -> NamedValues:
        values = {"task": self._numbers, "outcome": shown.outcome.numpy(), "leaf": shown.leaf.numpy()}
        infos: NamedValues = {}
        for key, value in values.items():
            infos[key] = value.astype(np.int64) if mask is None else np.where(mask, value, 0).astype(np.int64)
            infos[f"_{key}"] = np.ones(self.num_envs, np.bool_) if mask is None else mask.copy()
        return infos

    def _check(self, actions: NDArray[np.int64]) -> Tensor:
        action = np.asarray(actions)
        last = self.rows.max_branching
        fits = action.shape == (self.num_envs,) and action.dtype.kind in "iu"
        if not fits or action.min() < 0 or action.max() > last:
            got = action[(action < 0) | (action > last)][:5].tolist() if fits else f"{action.dtype} {action.shape}"
            raise ValueError(f"actions must be integers of shape ({self.num_envs},) in 0..{last}, got {got}")
        autoresets = self.autoreset_mode == AutoresetMode.NEXT_STEP and self._is_seeded
        if not autoresets and self._is_over.any():
            rows = self._is_over.nonzero()[0][:5].tolist()
            raise ValueError(f"no episode is running in the rows {rows}: reset them first")
        return torch.from_numpy(action.astype(np.int64))

    def _start_streams(self, mask: RowMask, seed: int | Sequence[int | None] | None) -> None:
        seeds: Any = (None,) * self.num_envs if seed is None else as_tuple(seed)
        if isinstance(seed, int) and is_int(seed, 0):
            super().reset(seed=seed)
            seeds = tuple(range(seed, seed + self.num_envs))
        fits = isinstance(seeds, tuple) and len(seeds) == self.num_envs
        require((fits, f"seed must be an integer or one or None per row, {self.num_envs} in all, got {seed!r}"))
        require(*map(_seed_rule, seeds))
        given = np.array([one is not None for one in seeds])
        start = mask & given if self._is_seeded else mask
        if start.any():
            drawn = self.np_random.integers(2**63 - 1, size=self.num_envs) if not given[start].all() else self._seeds
            chosen = np.array([draw if one is None else one for one, draw in zip(seeds, drawn, strict=True)])
            self._seeds = np.where(start, chosen, self._seeds)
            self._is_seeded = True
            row = torch.zeros(self.num_envs, dtype=torch.int64, device="cpu")
            self._only(start, lambda: self.rows.set_streams(torch.from_numpy(self._seeds), row))

    def _change_tasks(self, mask: RowMask) -> None:
        if self._next_numbers is self._numbers:
            return
        change = mask & (self._next_numbers != self._numbers)
        if change.any():
            numbers = np.where(change, self._next_numbers, self._numbers)
            self._only(change, lambda: self.rows.set_tasks([self.task_pool[number] for number in numbers]))
            self._numbers = numbers
        if (self._numbers == self._next_numbers).all():
            self._next_numbers = self._numbers

    def _only(self, mask: RowMask, change: Callable[[], None]) -> None:
        before = self.rows.state
        change()
        self.rows.state = choose(torch.from_numpy(mask), self.rows.state, before)

    def render(self) -> tuple[Frame, ...] | None:
        """Every row's state as a picture, uint8 [192, 384, 3], or text."""
        return _frames(self)


class StreamVectorEnv(CTGraphVectorEnv):
    """A stream for any trainer: all rows have the task of the present block, from their next episode on.

    ``info`` also has ``task``, the number of the block in which the task came first, from 0; ``optimum``, its exact
    best mean return; and, where an episode ends, as ``_regret`` says, ``regret``: the optimum less its return. Its last
    task stays once the stream is over, with a warning; a reset of all rows with a seed starts the stream again.

    Args:
        num_envs: rows; a frame is one row for one step.
        stream: a `Stream`; None: ``curriculum=stream`` with ``settings``.
        seed: draws the tasks of a stream without a seed.
        task_ids: as in `CTGraphVectorEnv`, also all others but the tasks.
        settings: such as ``num_tasks=1000``; none beside ``stream``.

    Raises:
        ValueError: for values out of range, and blocks that are not whole steps of the rows.

    Example:
        >>> envs = gymnasium.make_vec("ctgraph/Stream-v0", num_envs=4, num_tasks=10, num_frames=1024)
        >>> envs.reset(seed=0)[1]["optimum"]
        array([1., 1., 1., 1.])
    """

    @takes_numbers
    def __init__(
        self,
        num_envs: int = 1,
        stream: Stream | None = None,
        *,
        seed: int = 0,
        task_ids: Mapping[Task, int] | None = None,
        num_task_ids: int | None = None,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        kernel: str = "auto",
        life: int | None = None,
        **settings: Any,
    ) -> None:
        shown = ", ".join(f"{name}={value!r:.40}" for name, value in settings.items())
        rule = f"a stream that is given has its settings, got {shown} beside it: leave them out, or give no stream"
        require((stream is None or not settings, rule))
        made = curriculum_named("stream", **settings) if stream is None else stream
        require((isinstance(made, Stream), f"stream must be a Stream, got {made!r:.80}"), seed_rule(seed))
        assert isinstance(made, Stream)
        self.stream = made.for_seed(seed)
        require(self.stream.blocks[0].frame_rule(num_envs, "a block"))
        self._optima = np.array([task.optimal_value(1.0) for task in self.stream.examples])
        self._frames = 0
        super().__init__(
            num_envs,
            self.stream.tasks[0],
            task_pool=self.stream.tasks,
            task_ids=task_ids,
            num_task_ids=num_task_ids,
            render_mode=render_mode,
            autoreset_mode=autoreset_mode,
            kernel=kernel,
            life=life,
        )

    @override
    def step(self, actions: NDArray[np.int64]) -> tuple[Any, NumpyArray, NumpyArray, NumpyArray, NamedValues]:
        self._frames += self.num_envs
        at_once = self.autoreset_mode == AutoresetMode.SAME_STEP  # the next episode starts in the step that ends one
        if at_once:
            self._start_block()
        taken = super().step(actions)
        if not at_once:
            self._start_block()
        return taken

    @override
    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: NamedValues | None = None
    ) -> tuple[Any, NamedValues]:
        if seed is not None and "reset_mask" not in (options or {}):
            self._frames = 0
            self.set_tasks([self.stream.tasks[0]] * self.num_envs)
        return super().reset(seed=seed, options=options)

    def _start_block(self) -> None:
        if self._frames == self.stream.num_frames:
            logger.warn(
                f"the stream of {self._frames:,} frames is over, its last task stays: reset(seed=) starts it again"
            )
        elif self.stream.is_end(self._frames):
            self.set_tasks([self.stream.tasks[self.stream.block_at(self._frames)]] * self.num_envs)

    @override
    def _infos(self, shown: Shown, mask: RowMask | None = None) -> NamedValues:
        infos = super()._infos(shown, mask)
        optimum = self._optima[[self.stream.blocks.choice(number) for number in self._numbers]]
        ends = shown.done.numpy() & infos["_task"]
        infos["optimum"] = np.where(infos["_task"], optimum, 0.0)
        infos["_optimum"] = infos["_task"].copy()
        infos["regret"] = np.where(ends, optimum - self.rows.episode_reward.numpy(), 0.0)
        infos["_regret"] = ends
        return infos


def add_task_ids(
    space: spaces.Space[Any], pool: Sequence[Task], task_ids: Mapping[Task, int] | None, num_task_ids: int | None
) -> tuple[spaces.Space[Any], NDArray[np.uint8] | None]:
    """Return the space of observations with task ids, and the pool's ids as one-hot.

    Args:
        space: of observations without ids.
        task_ids: None: the space stays unchanged, without ids.
        num_task_ids: None: just enough.

    Raises:
        ValueError: for a task without an id, and ids that do not fit the length.
    """
    length = require_num_ids(task_ids, num_task_ids)
    if task_ids is None:
        return space, None
    without = [each for each in pool if each not in task_ids]
    require((not without, f"task_ids must name every task of the pool, got none for {without[:3]}"))
    ids = np.eye(length, dtype=np.uint8)[[int(task_ids[each]) for each in pool]]
    return spaces.Dict({"observation": space, "task_id": spaces.Box(0, 1, (length,), np.uint8)}), ids


def add_id(observation: NDArray[np.uint8], ids: NDArray[np.uint8] | None, task: Any) -> Any:
    """Return one observation, or a batch's, with the numbered tasks' ids, if any."""
    return observation if ids is None else {"observation": observation, "task_id": ids[task].copy()}


def _spaces(rows: Rows) -> tuple[spaces.Space[Any], spaces.Space[Any]]:
    white = 255 if len(rows.image_shape) == 3 else rows.white
    return spaces.Box(0, white, rows.image_shape, np.uint8), spaces.Discrete(rows.max_branching + 1)


def _life_rule(life: object) -> Rule:
    return life is None or is_int(life, 1), f"life must be an integer >= 1 or None, got {life!r}"


def _seed_rule(seed: object) -> Rule:
    return (True, "") if seed is None else seed_rule(seed)


@lru_cache(maxsize=256)
def _as_tensor(action: int) -> Tensor:
    return torch.tensor([action], dtype=torch.int64, device="cpu")


def _known_mode(render_mode: str | None) -> str | None:
    modes = _RENDERING["render_modes"]
    require((render_mode in (None, *modes), f"render_mode must be None or one of {modes}, got {render_mode!r}"))
    return render_mode


def _frames(env: CTGraphGymEnv | CTGraphVectorEnv) -> tuple[Frame, ...] | None:
    if env.render_mode is None:
        logger.warn("render() needs a render_mode, as in gymnasium.make(id, render_mode='rgb_array')")
        return None
    rows = env.rows
    observation = env.rows.show().observation
    if env.render_mode == "rgb_array":
        return tuple(render(rows.tasks, rows.state_type, rows.node, rows.goal_leaf, observation).numpy())
    return as_text(rows.tasks, rows.state, observation, rows.white)


for _name in ("CTGraph", *CONFIGURATIONS):
    gymnasium.register(
        f"ctgraph/{_name}-v{int(_name == 'CT-POSR-B1')}",  # version 0 of CT-POSR-B1 had noise in its rewards
        entry_point="ctgraph_rl.gym:CTGraphGymEnv",
        vector_entry_point="ctgraph_rl.gym:CTGraphVectorEnv",
        kwargs={"task": _name} if _name in CONFIGURATIONS else {},
    )
gymnasium.register("ctgraph/Stream-v0", vector_entry_point="ctgraph_rl.gym:StreamVectorEnv")
