"""Rows: a batch of CT-graphs as plain tensors, which every face of the environment wraps."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from ctgraph_rl import dynamics, philox
from ctgraph_rl.checks import is_int, require, require_all
from ctgraph_rl.dynamics import (
    LegacyIndex,
    ObservationParams,
    RewardParams,
    RowParams,
    RowState,
    Shown,
    TreeParams,
    Uses,
    Words,
)
from ctgraph_rl.graph import MAX_STATES, StateType
from ctgraph_rl.images import ImageSet, white_level
from ctgraph_rl.rewards import RewardFn
from ctgraph_rl.rotation import taps_of
from ctgraph_rl.task import Task


class Rows(nn.Module):
    """A batch of CT-graphs without TorchRL or Gymnasium: one task, one random stream and one state per row.

    ``state`` is replaced at every step and never written into, so whoever holds it keeps it. Its fields are buffers:
    they are in ``state_dict()`` and follow ``to()``.

    Args:
        tasks: one task per row.
        seed: decides all that is random, in [0, 2**63).
        first_row: number of the first row, for a batch that is split.
        task_pool: the tasks that `set_tasks` may be given; the images are fixed by it. Default: ``tasks``.
        device: where the tensors live.

    Raises:
        ValueError: for no tasks, values out of range, and observations of different shapes.
    """

    seed: Tensor
    row: Tensor
    bank: Tensor
    normal_table: Tensor
    state_type: Tensor
    node: Tensor
    tick: Tensor
    step_count: Tensor
    episode_reward: Tensor
    goal_leaf: Tensor
    episodes_left: Tensor
    reward: Tensor

    def __init__(
        self,
        tasks: Iterable[Task],
        seed: int = 0,
        first_row: int = 0,
        task_pool: Iterable[Task] | None = None,
        device: torch.device | str | None = "cpu",
    ) -> None:
        tasks = require_all(Task, "tasks", tasks)
        pool = tuple(dict.fromkeys(tasks if task_pool is None else require_all(Task, "task_pool", task_pool)))
        self.num_rows = len(tasks)
        require(
            seed_rule(seed),
            (is_int(first_row, 0, 2**32 - self.num_rows), f"rows must be numbered in [0, 2**32), got {first_row=}"),
        )
        super().__init__()
        self._pool = frozenset(pool)
        self.max_branching = max(task.graph.branching_factor for task in pool)
        self.image_shape, self._bank_start, bank = _shared_bank(pool, self.num_rows)
        self.white = max(int(white_level(task.images)) for task in pool)
        self.register_buffer("seed", torch.tensor([seed], device=device))
        self.register_buffer("row", torch.arange(first_row, first_row + self.num_rows, device=device))
        self.register_buffer("bank", bank.to(device), persistent=False)
        self.register_buffer("normal_table", philox.normal_table().to(device), persistent=False)
        zeros = torch.zeros(self.num_rows, dtype=torch.int64, device=device)
        for field in RowState._fields:
            self.register_buffer(field, zeros.to(_STATE_DTYPES.get(field, torch.int64), copy=True))
        self._stock: _Stock | None = None
        self._now: Words | None = None
        self._stock_ticks = min(MAX_STOCK // self.num_rows, MAX_STOCK_TICKS)
        self.set_tasks(tasks)

    @property
    def device(self) -> torch.device:
        """Where the tensors live."""
        return self.row.device

    @property
    def state(self) -> RowState:
        """The state of all rows."""
        buffers = self._buffers
        return RowState(*(buffers[field] for field in RowState._fields))  # type: ignore[arg-type]

    @state.setter
    def state(self, state: RowState) -> None:
        self._stock = self._now = None
        self._buffers.update(zip(RowState._fields, state, strict=True))

    def set_tasks(self, tasks: Iterable[Task]) -> None:
        """Give every row a task, in place. All episodes end: `reset` before the next step.

        Args:
            tasks: one task of the pool per row.

        Raises:
            ValueError: if the number of tasks is not the number of rows, or a task is not in the pool.
        """
        tasks = require_all(Task, "tasks", tasks)
        different = tuple(dict.fromkeys(tasks))
        unknown = [task for task in different if task not in self._pool]
        n = self.num_rows
        require(
            (len(tasks) == n, f"set_tasks needs one task per row, {n} in all, got {len(tasks)}"),
            (not unknown, f"set_tasks got tasks that are not in task_pool: {unknown[:3]}; name them at construction"),
        )
        self.tasks = tasks
        number = {task: i for i, task in enumerate(different)}
        index = torch.tensor([number[task] for task in self.tasks], device=self.device)

        def rows(values: Sequence[Any], dtype: torch.dtype = torch.int64) -> Tensor:
            return torch.tensor(values, dtype=dtype, device=self.device).index_select(0, index)

        self.params, self.uses = self._make_params(different, rows)
        self._task_goals = rows([task.goal_leaf for task in different])
        self._stock = self._now = None
        self._begin()

    def set_goals(self, goals: Iterable[Sequence[int]] | Tensor) -> None:
        """Give every row a goal at any time, in the middle of an episode too; the tree and all else stay.

        ``goal_leaf`` changes and ``tasks`` does not: `set_tasks` and `set_seed` go back to the tasks' own goals.

        Args:
            goals: for every row its decisions in 1..b, or the numbers of end states, int64 [N].

        Raises:
            ValueError: if a goal is not one of its row's tree.
        """
        if not isinstance(goals, Tensor):
            goals = list(goals)
            n = self.num_rows
            require((len(goals) == n, f"set_goals needs one goal per row, {n} in all, got {len(goals)}"))
            changed = [replace(task, goal=goal) for task, goal in zip(self.tasks, map(tuple, goals), strict=True)]
            goals = torch.tensor([task.goal_leaf for task in changed], device=self.device)
        fits = goals.shape == (self.num_rows,) and goals.dtype == torch.int64
        require((fits, f"goals must be int64 of shape [{self.num_rows}], got {goals.dtype} {list(goals.shape)}"))
        outside = (goals < 0) | (goals >= self.params.g.num_leaves)
        require((not outside.any(), f"goals must be end states of the rows' trees, got {goals[outside][:5].tolist()}"))
        self.goal_leaf = goals.to(self.device, copy=True)

    def set_seed(self, seed: int) -> None:
        """Start all rows anew with another seed and their tasks' goals; the next `reset` gives their first episodes."""
        require(seed_rule(seed))
        self.set_streams(torch.tensor([seed], device=self.device), self.row)

    def set_streams(self, seed: Tensor, row: Tensor) -> None:
        """Start all rows anew with random streams of their own.

        Args:
            seed: int64 [N], or [1] for all.
            row: int64 [N], the numbers that tell rows of one seed apart.
        """
        self.seed, self.row = seed, row
        self.tick = torch.zeros_like(self.row)
        self._stock = self._now = None
        self.params = self._row_params(self.params.tree, self.params.x, self.params.g)
        self._begin()

    def reset(self, mask: Tensor | None = None) -> Shown:
        """Start an episode in the rows of a mask, bool [N], or in all; what all rows show."""
        mask = torch.ones_like(self.row, dtype=torch.bool) if mask is None else mask
        words = self._draw(self.tick + mask)
        return self._keep(*dynamics.reset(self.state, mask, self.params, self.uses, words))

    def step(self, action: Tensor) -> Shown:
        """One step of all rows with actions, int64 [N]; what they show. The reward is in ``state``."""
        return self._keep(*dynamics.step(self.state, action, self.params, self.uses, self._draw_next()))

    def restart(self, mask: Tensor) -> Tensor:
        """`reset` of all finished rows, the mask: what all rows observe."""
        words = self._draw(self.tick + mask)
        state, observation = dynamics.restart(self.state, mask, self.params, self.uses, words)
        self._buffers.update(zip(RowState._fields, state, strict=True))
        return observation

    def step_or_reset(self, action: Tensor, mask: Tensor) -> Shown:
        """Start an episode in the rows of a mask, whatever their action, and step the others; what all rows show."""
        return self._keep(*dynamics.step_or_reset(self.state, action, mask, self.params, self.uses, self._draw_next()))

    def _keep(self, state: RowState, shown: Shown) -> Shown:
        self._buffers.update(zip(RowState._fields, state, strict=True))
        return shown

    def _draw_next(self) -> tuple[Words, Words]:
        """The draws of the present and of the next tick."""
        now = self._draw(self.tick) if self._now is None else self._now
        return now, self._draw(self.tick + 1)

    def _draw(self, tick: Tensor) -> Words:
        """The draws of ticks, at most one ahead of the present, kept as those of the present to be."""
        if self._stock_ticks < 2 or not self.uses.draws:
            self._now = dynamics.words_of(tick, self.params, self.uses)
            return self._now
        if self._stock is None or self._stock.left == 0:
            self._stock = _Stock(self.params, self.uses, self.tick, self._stock_ticks)
        self._now = self._stock.at(tick)
        return self._now

    def show(self) -> Shown:
        """What all rows show now."""
        return dynamics.show(self.state, self.params, self.uses)

    @property
    def observation_id(self) -> Tensor:
        """The ids that the rows show now, int64 [N]."""
        return dynamics.observation_id(self.state, self.params, self.uses)

    @property
    def is_done(self) -> Tensor:
        """bool [N]: rows whose episode is over."""
        return dynamics.is_done(self.state, self.params.tree)

    @property
    def branching_factor(self) -> Tensor:
        """b of each row, int64 [N]."""
        return self.params.tree.branching_factor

    @property
    def first_leaf(self) -> Tensor:
        """Heap index of each row's first end state, int64 [N]."""
        return self.params.tree.first_leaf

    @property
    def num_end_states(self) -> Tensor:
        """b^d of each row, int64 [N]."""
        return self.params.g.num_leaves

    @property
    def max_depth(self) -> int:
        """The largest depth of the rows."""
        return self.uses.max_depth

    def check_actions(self, action: Tensor | None) -> None:
        """Refuse actions of a wrong shape, dtype or range, and steps of finished rows.

        Raises:
            ValueError: saying which.
        """
        spec = f"action must be int64 of shape [{self.num_rows}] with values in 0..{self.max_branching}"
        require((action is not None, f"{spec}, got none: a policy must write it before a step"))
        assert action is not None
        require(
            (action.dtype == torch.int64, f"{spec}, got dtype {action.dtype}"),
            (action.shape == (self.num_rows,), f"{spec}, got shape {list(action.shape)}"),
        )
        outside, finished = (action < 0) | (action > self.max_branching), self.is_done
        if (outside | finished).any():
            require(
                (not outside.any(), f"{spec}, got {action[outside][:5].tolist()}"),
                (not finished.any(), f"rows {finished.nonzero().flatten()[:5].tolist()} are done: reset them first"),
            )

    def _begin(self) -> None:
        """End all episodes; the next one of every row is the first with its task's goal."""
        self.goal_leaf = self._task_goals.clone()
        self.state_type = torch.full_like(self.state_type, int(StateType.FAIL))
        self.episodes_left = torch.zeros_like(self.episodes_left)

    def _load_from_state_dict(self, *args: Any, **kwargs: Any) -> None:
        """Load into copies: a loaded buffer is written into, and someone may hold the present one."""
        self.state = RowState(*(value.clone() for value in self.state))  # drops the stock of draws, too
        super()._load_from_state_dict(*args, **kwargs)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Rows:
        """Move what is no buffer along with the buffers."""
        super()._apply(fn, recurse)
        old = self.params

        def moved(part: Any) -> Any:
            return None if part is None else fn(part) if isinstance(part, Tensor) else tuple(map(moved, part))

        legacy = old.x.legacy and LegacyIndex(*moved(old.x.legacy))
        x = ObservationParams(*moved(old.x))._replace(legacy=legacy)
        self._task_goals = fn(self._task_goals)
        self.params = self._row_params(TreeParams(*moved(old.tree)), x, RewardParams(*moved(old.g)))
        return self

    def _row_params(self, tree: TreeParams, x: ObservationParams, g: RewardParams) -> RowParams:
        return RowParams(self.seed, self.row, tree, x, g, self.bank, self.normal_table)

    def _make_params(self, tasks: tuple[Task, ...], rows: Callable[..., Tensor]) -> tuple[RowParams, Uses]:
        """The rows' parameters from their different tasks, and what they have use for."""
        reward_fns = tuple(dict.fromkeys(task.reward_fn for task in tasks))
        params = self._row_params(
            _tree_params(tasks, rows),
            self._observation_params(tasks, rows),
            _reward_params(tasks, rows, reward_fns),
        )
        observations = [task.observations for task in tasks]
        uses = Uses(
            waits=any(task.graph.wait_prob > 0 for task in tasks),
            unique_ids=any(x.is_unique(kind) and not x.legacy_index for x in observations for kind in StateType),
            drawn_ids=any(x.draws_ids for x in observations),
            views=any(_num_views(task) * _num_angles(task) > 1 for task in tasks),
            pixel_noise=any(x.read_noise for x in observations),
            reward_noise=any(task.reward_std for task in tasks),
            fail_reward=any(task.fail_reward for task in tasks),
            step_reward=any(task.step_reward for task in tasks),
            reward_cue=any(x.reward_cue for x in observations),
            goal_change=any(task.goal_change for task in tasks),
            max_depth=max(task.graph.depth for task in tasks),
            reward_fns=reward_fns,
        )
        return params, uses

    def _observation_params(self, tasks: tuple[Task, ...], rows: Callable[..., Tensor]) -> ObservationParams:
        observations = [task.observations for task in tasks]
        by_node = [[x.is_unique(kind) and not x.legacy_index for kind in StateType] for x in observations]
        views, starts = [_num_views(task) for task in tasks], [self._bank_start[_bank_key(task)] for task in tasks]

        def first_view(i: int, kind: StateType) -> int:
            skipped = tasks[i].graph.num_decision_states if by_node[i][kind] and kind == StateType.END else 0
            return starts[i] + (observations[i].ids(kind)[0] - skipped) * views[i]

        def num_ids(x: Any, kind: StateType) -> int:
            return 1 if x.is_unique(kind) else x.ids(kind)[1] - x.ids(kind)[0] + 1

        angles = max(map(_num_angles, tasks))
        taps = [taps_of(self.image_shape[-1], angle) for angle in range(angles)] if angles > 1 else []
        return ObservationParams(
            first_view=rows([[first_view(i, kind) for kind in StateType] for i in range(len(tasks))]),
            views_per_node=rows([[n * unique for unique in kinds] for n, kinds in zip(views, by_node, strict=True)]),
            num_ids=rows([[num_ids(x, kind) for kind in StateType] for x in observations]),
            bank_start=rows(starts),
            num_views=rows(views),
            num_angles=rows([_num_angles(task) for task in tasks]),
            read_noise=rows([x.read_noise for x in observations]),
            reward_cue=rows([x.reward_cue for x in observations], torch.bool),
            cue_wraps=rows([x.cue_wraps for x in observations], torch.bool),
            cue_element=rows([task.images.num_images for task in tasks]),
            white=rows([white_level(task.images) for task in tasks], torch.float64),
            legacy=_legacy_index(tasks, rows) if any(x.legacy_index for x in observations) else None,
            taps=tuple(torch.stack(part).to(self.device) for part in zip(*taps, strict=True)) if taps else None,  # type: ignore[arg-type]
        )


class _Stock:
    """The small draws of all rows for many ticks, drawn in one call: many small calls would cost more."""

    def __init__(self, params: RowParams, uses: Uses, tick: Tensor, num_ticks: int) -> None:
        num_rows = len(tick)
        self.left = num_ticks - 1
        self._tick = tick
        self._place = torch.arange(num_rows, device=tick.device)
        ticks = tick + torch.arange(num_ticks, device=tick.device).unsqueeze(-1)
        self._words = [word.flatten() for word in dynamics.words_of(ticks, params, uses)]

    def at(self, tick: Tensor) -> Words:
        """The draws of ticks that are at most one ahead of those of the last call."""
        self.left -= 1
        index = (tick - self._tick) * len(tick) + self._place
        return tuple(word.take(index) for word in self._words)


MAX_STOCK = 2**14
MAX_STOCK_TICKS = 256

_STATE_DTYPES = {"state_type": torch.uint8, "episode_reward": torch.float32, "reward": torch.float32}


def seed_rule(seed: object) -> tuple[bool, str]:
    """The rule for seeds of environments."""
    return is_int(seed, 0, 2**63 - 1), f"seed must be an integer in [0, 2**63), got {seed!r}"


def _tree_params(tasks: tuple[Task, ...], rows: Callable[..., Tensor]) -> TreeParams:
    graphs, extra = [task.graph for task in tasks], [task.extra_end_step for task in tasks]
    return TreeParams(
        branching_factor=rows([graph.branching_factor for graph in graphs]),
        first_leaf=rows([graph.num_decision_states for graph in graphs]),
        stay_below=rows([int(graph.wait_prob * 2**63) for graph in graphs]),
        extra_end_step=rows(extra, torch.bool) if any(extra) else None,
    )


def _legacy_index(tasks: tuple[Task, ...], rows: Callable[..., Tensor]) -> LegacyIndex:
    """A level of the tree begins with node (b^k - 1) / (b - 1), which has the legacy number b^k - 1."""

    def level(task: Task, k: int) -> tuple[int, int]:
        if k > task.graph.depth:
            return MAX_STATES, 0
        number = task.graph.branching_factor**k - 1
        first = number // (task.graph.branching_factor - 1)
        return first, number - first

    def num_ids(task: Task, kind: StateType) -> int:
        first, last = task.observations.ids(kind)
        return last - first + 1 if task.observations.legacy_index and task.observations.is_unique(kind) else 1

    levels = range(max(task.graph.depth for task in tasks) + 1)
    tables = [[level(task, k) for k in levels] for task in tasks]
    return LegacyIndex(
        level_first=rows([[first for first, _ in table] for table in tables]),
        level_shift=rows([[shift for _, shift in table] for table in tables]),
        num_ids=rows([[num_ids(task, kind) for kind in StateType] for task in tasks]),
    )


def _reward_params(
    tasks: tuple[Task, ...], rows: Callable[..., Tensor], reward_fns: tuple[RewardFn, ...]
) -> RewardParams:
    changes = [task.goal_change or (0, 0) for task in tasks]
    return RewardParams(
        depth=rows([task.graph.depth for task in tasks]),
        num_leaves=rows([task.graph.num_end_states for task in tasks]),
        reward_fn=rows([reward_fns.index(task.reward_fn) for task in tasks]),
        goal_reward=rows([task.goal_reward for task in tasks], torch.float32),
        fail_reward=rows([task.fail_reward for task in tasks], torch.float32),
        step_reward=rows([task.step_reward for task in tasks], torch.float32),
        reward_std=rows([task.reward_std for task in tasks], torch.float32),
        multiplicative=rows([task.reward_noise == "multiplicative" for task in tasks], torch.bool),
        change_first=rows([first for first, _ in changes]),
        change_last=rows([last for _, last in changes]),
        legacy_change=rows([task.legacy_goal_change for task in tasks], torch.bool),
    )


def _turns_late(task: Task) -> bool:
    """Whether rotations come after noise, so that they cannot be in the bank; without noise the order is the same."""
    return task.observations.noise_before_rotation and task.observations.read_noise > 0


def _num_angles(task: Task) -> int:
    return task.observations.read_rotation + 1 if _turns_late(task) else 1


def _num_views(task: Task) -> int:
    """Bank rows that one id of a task has."""
    return task.images.num_variants * (_bank_key(task)[1] + 1)


def _bank_key(task: Task) -> tuple[ImageSet, int]:
    """The images of a task and the rotation that is in the bank."""
    return task.images, 0 if _turns_late(task) else task.observations.read_rotation


def _require_memory(pool: tuple[Task, ...], bytes_each: int, num_rows: int) -> None:
    """Refuse image sets and observations that cannot be held, before anything is allocated; POSIX systems only."""
    if not hasattr(os, "sysconf"):
        return
    sets = dict.fromkeys(map(_bank_key, pool))
    images_held = sum(images.num_images * images.num_variants * (rotation + 1) for images, rotation in sets)
    needed = bytes_each * (images_held + 2 * num_rows)  # a step holds two observations of every row
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    message = f"images and observations need {needed:,} bytes, this machine has {memory:,}; use fewer images or rows"
    require((needed < memory, message))


def _shared_bank(
    pool: tuple[Task, ...], num_rows: int
) -> tuple[tuple[int, ...], dict[tuple[ImageSet, int], int], Tensor]:
    """One bank with each different image set of the pool once.

    Returns:
        The shape of an observation, the first row of each image set and rotation, and uint8 [rows, *shape].
    """
    shapes = list(dict.fromkeys(task.images.shape for task in pool))
    one_hot = all(len(shape) == 1 for shape in shapes)
    require((one_hot or len(shapes) == 1, f"all tasks of a batch must show observations of one shape, got {shapes}"))
    shape = max(shapes)
    _require_memory(pool, math.prod(shape), num_rows)
    banks, starts, rows = [], {}, 0
    for key in dict.fromkeys(map(_bank_key, pool)):
        images, rotation = key
        bank = images.bank(rotation)
        if one_hot:
            bank = torch.nn.functional.pad(bank, (0, shape[0] - bank.shape[1]))
        banks.append(bank)
        starts[key] = rows
        rows += len(bank)
    return shape, starts, banks[0] if len(banks) == 1 else torch.cat(banks)  # one may be large
