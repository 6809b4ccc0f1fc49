"""Parameters of rows from tasks, and the bank of images that rows share."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ctgraph_rl.checks import require, require_memory
from ctgraph_rl.core import reading
from ctgraph_rl.core.graph import MAX_STATES, StateType
from ctgraph_rl.core.rewards import RewardFn
from ctgraph_rl.core.rotation import compute_taps
from ctgraph_rl.core.row_params import LegacyIndex, ObservationParams, RewardParams, Uses
from ctgraph_rl.core.tree import Swap, TreeParams, tree_params
from ctgraph_rl.tasks.images import white_level
from ctgraph_rl.tasks.memory import BankKey, bank_bytes, bank_key, make_bank, rotates_after_noise
from ctgraph_rl.tasks.task import Task

TaskValue = str | Callable[[Task], Any]


@dataclass(frozen=True)
class _Different:
    """Different tasks, and tensors with an entry for each.

    A value is a task's attribute, by name, or what a function returns for it.
    """

    tasks: tuple[Task, ...]
    device: torch.device

    def each(self, value: TaskValue, dtype: torch.dtype = torch.int64) -> Tensor:
        return torch.tensor(list(self._values(value)), dtype=dtype, device=self.device)

    def each_kind(self, number: Callable[[Task, StateType], int]) -> Tensor:
        """Return a number for each kind of state of each task, flattened."""
        numbers = [number(task, kind) for task in self.tasks for kind in StateType]
        return torch.tensor(numbers, dtype=torch.int64, device=self.device)

    def some(self, value: TaskValue) -> bool:
        return any(self._values(value))

    def _values(self, value: TaskValue) -> Iterator[Any]:
        return map(attrgetter(value) if isinstance(value, str) else value, self.tasks)

    @property
    def max_depth(self) -> int:
        return max(task.graph.depth for task in self.tasks)


class Tables(NamedTuple):
    """The parameters of U different tasks, and which entry is each row's."""

    tree: TreeParams
    x: ObservationParams
    g: RewardParams
    goal_leaf: Tensor  # int64 [U]
    uses: Uses
    number: Tensor  # int64 [U], ascending: the tasks' numbers in a pool
    entry: Tensor  # int64 [N]

    def assigned(self, task: Tensor) -> Tables:
        """Return the tables with other tasks for the rows, numbers in the pool, int64 [N]."""
        return self._replace(entry=torch.searchsorted(self.number, task))

    @property
    def row_goals(self) -> Tensor:
        """The goal of each row's task, int64 [N]."""
        return self.goal_leaf.index_select(0, self.entry)

    def by_row(self) -> tuple[TreeParams, ObservationParams, RewardParams]:
        """Return the parameters of each row."""
        return _select_rows(self.tree, self.entry), _select_rows(self.x, self.entry), _select_rows(self.g, self.entry)


def make_tables(tasks: tuple[Task, ...], number: Tensor, bank: Bank) -> Tables:
    """Return the tables of tasks with these numbers in their pool; no row has one yet."""
    different = _Different(tasks, number.device)
    reward_fns = tuple(dict.fromkeys(task.reward_fn for task in tasks))
    extra_end_step = different.each("extra_end_step", torch.bool)
    swapped_node = different.each(lambda task: -1 if task.swapped_node is None else task.swapped_node)
    branches = different.each(lambda task: task.swapped_branches[1] if task.swapped_branches else (0, 0))
    swap = Swap(swapped_node, *branches.unbind(1))
    return Tables(
        tree=tree_params(
            branching_factor=different.each("graph.branching_factor"),
            first_leaf=different.each("graph.num_decision_states"),
            stay_below=different.each(lambda task: int(task.graph.wait_prob * 2**63)),
            extra_end_step=extra_end_step if different.some("extra_end_step") else None,
            swap=swap if different.some("swapped_branches") else None,
        ),
        x=_observation_params(different, bank),
        g=_reward_params(different, reward_fns),
        goal_leaf=different.each("goal_leaf"),
        uses=_uses(different, bank, reward_fns),
        number=number,
        entry=number[:0],
    )


def _uses(tasks: _Different, bank: Bank, reward_fns: tuple[RewardFn, ...]) -> Uses:
    some = tasks.some
    pixel_noise = some("observations.read_noise")
    return Uses(
        waits=some(lambda task: task.graph.wait_prob > 0),
        unique_ids=some(lambda task: any(_is_by_node(task, kind) for kind in StateType)),
        drawn_ids=some("observations.draws_ids"),
        views=some(lambda task: _num_views(task) * _num_angles(task) > 1),
        pixel_noise=pixel_noise,
        noise_bank=bank.num_noises if pixel_noise else 0,
        reward_noise=some("reward_std"),
        multiplicative=some(lambda task: task.reward_std and task.reward_noise == "multiplicative"),
        fail_reward=some("fail_reward"),
        step_reward=some("step_reward"),
        reward_cue=some("observations.reward_cue"),
        goal_change=some("goal_change"),
        max_depth=tasks.max_depth,
        reward_fns=reward_fns,
    )


def _observation_params(tasks: _Different, bank: Bank) -> ObservationParams:
    each = tasks.each
    most_angles = max(map(_num_angles, tasks.tasks))
    first_kind = len(StateType) * torch.arange(len(tasks.tasks), device=tasks.device)

    def first_view(task: Task, kind: StateType) -> int:
        skipped = task.graph.num_decision_states if kind == StateType.END and _is_by_node(task, kind) else 0
        return bank.start[bank_key(task)] + (task.observations.ids(kind)[0] - skipped) * _num_views(task)

    def first_noise(task: Task) -> int:
        return bank.noise_levels.index(task.observations.read_noise) * bank.num_noises

    taps = None
    if most_angles > 1:
        index, weight = zip(*(compute_taps(bank.shape[-1], angle) for angle in range(most_angles)), strict=True)
        taps = torch.stack(index).to(tasks.device), torch.stack(weight).to(tasks.device)
    return ObservationParams(
        first_kind=first_kind if len(tasks.tasks) > 1 else None,
        first_view=tasks.each_kind(first_view),
        views_per_node=tasks.each_kind(lambda task, kind: _num_views(task) * _is_by_node(task, kind)),
        num_ids=tasks.each_kind(lambda task, kind: 1 if task.observations.is_unique(kind) else _length(task, kind)),
        bank_start=each(lambda task: bank.start[bank_key(task)]),
        num_views=each(_num_views),
        num_angles=each(_num_angles),
        read_noise=each("observations.read_noise"),
        reward_cue=each("observations.reward_cue", torch.bool),
        cue_wraps=each("observations.cue_wraps", torch.bool),
        cue_element=each(lambda task: task.images.shape[-1] - 1),
        white=each(lambda task: white_level(task.images), torch.float64),
        noise_start=each(first_noise),
        legacy=_legacy_index(tasks) if tasks.some("observations.legacy_index") else None,
        taps=taps,
    )


def _is_by_node(task: Task, kind: StateType) -> bool:
    return task.observations.is_unique(kind) and not task.observations.legacy_index


def _length(task: Task, kind: StateType) -> int:
    first, last = task.observations.ids(kind)
    return last - first + 1


def _legacy_index(tasks: _Different) -> LegacyIndex:
    """Return how legacy numbers differ from nodes: level k begins with (b^k - 1) / (b - 1), whose number is b^k - 1."""

    def first(task: Task, level: int) -> int:
        return task.graph.first_node(level) if level <= task.graph.depth else MAX_STATES

    def shift(task: Task, level: int) -> int:
        return task.graph.branching_factor**level - 1 - first(task, level) if level <= task.graph.depth else 0

    def num_ids(task: Task, kind: StateType) -> int:
        legacy = task.observations.legacy_index and task.observations.is_unique(kind)
        return _length(task, kind) if legacy else 1

    levels = range(tasks.max_depth + 1)
    return LegacyIndex(
        level_first=tasks.each(lambda task: [first(task, level) for level in levels]),
        level_shift=tasks.each(lambda task: [shift(task, level) for level in levels]),
        num_ids=tasks.each_kind(num_ids),
    )


def _reward_params(tasks: _Different, reward_fns: tuple[RewardFn, ...]) -> RewardParams:
    each = tasks.each
    change_first, change_last = each(lambda task: task.goal_change or (0, 0)).unbind(1)
    return RewardParams(
        depth=each("graph.depth"),
        num_leaves=each("graph.num_end_states"),
        reward_fn=each(lambda task: reward_fns.index(task.reward_fn)),
        goal_reward=each("goal_reward", torch.float32),
        fail_reward=each("fail_reward", torch.float32),
        step_reward=each("step_reward", torch.float32),
        reward_std=each("reward_std", torch.float32),
        multiplicative=each(lambda task: task.reward_noise == "multiplicative", torch.bool),
        change_first=change_first,
        change_last=change_last,
        legacy_change=each(lambda task: task.legacy_goal_change and bool(task.goal_change), torch.bool),
    )


def _num_angles(task: Task) -> int:
    return task.observations.read_rotation + 1 if rotates_after_noise(task) else 1


def _num_views(task: Task) -> int:
    return task.images.num_variants * (bank_key(task)[1] + 1)


class Bank(NamedTuple):
    """All images of a pool of tasks, each different set once."""

    images: Tensor  # uint8 [rows, *shape]
    shape: tuple[int, ...]  # of an observation
    start: dict[BankKey, int]  # the first row of each image set and rotation
    noise_levels: tuple[int, ...]  # the different values of ``read_noise``
    num_noises: int  # drawn in advance for each of them
    noises: Tensor  # uint8 [noises, *shape], those of a level in a row


def observation_shape(pool: Sequence[Task], num_rows: int) -> tuple[int, ...]:
    """Return the shape of a row's observation; one-hot vectors have the pool's greatest length.

    Raises:
        ValueError: for different shapes, and more than the machine can hold.
    """
    shapes = list(dict.fromkeys(task.images.shape for task in pool))
    one_hot = all(len(shape) == 1 for shape in shapes)
    require((one_hot or len(shapes) == 1, f"all tasks of a batch must show observations of one shape, got {shapes}"))
    needed = bank_bytes(pool) + 2 * num_rows * math.prod(max(shapes))  # a step holds two observations of every row
    require_memory("images and observations", needed, "images or rows")
    return max(shapes)


def make_shared_bank(pool: tuple[Task, ...], num_rows: int, num_noises: int) -> Bank:
    """Return the bank of a pool, with so many noises for each level drawn in advance.

    Raises:
        ValueError: as `observation_shape`.
    """
    shape = observation_shape(pool, num_rows)
    levels = tuple(dict.fromkeys(task.observations.read_noise for task in pool))
    banks = []
    starts = {}
    rows = 0
    for key in dict.fromkeys(map(bank_key, pool)):
        bank = make_bank(key)
        if len(shape) == 1:
            bank = torch.nn.functional.pad(bank, (0, shape[0] - bank.shape[1]))
        banks.append(bank)
        starts[key] = rows
        rows += len(bank)
    has_noise = num_noises > 0 and max(levels) > 0
    return Bank(
        images=banks[0] if len(banks) == 1 else torch.cat(banks),  # one may be large
        shape=shape,
        start=starts,
        noise_levels=levels,
        num_noises=num_noises,
        noises=reading.noise_bank(levels, num_noises, shape) if has_noise else banks[0].new_empty(0, *shape),
    )


def _select_rows(part: Any, index: Tensor) -> Any:
    rows = {}
    for name, value in part._asdict().items():
        if isinstance(value, (LegacyIndex, Swap)):
            rows[name] = _select_rows(value, index)
        elif isinstance(value, Tensor) and name not in _TABLES[type(part)]:
            rows[name] = value.index_select(0, index)
    return part._replace(**rows)


_TABLES: dict[type, tuple[str, ...]] = {
    TreeParams: ("next_kind", "decides"),
    Swap: (),
    ObservationParams: ("first_view", "views_per_node", "num_ids"),
    LegacyIndex: ("num_ids",),
    RewardParams: (),
}
