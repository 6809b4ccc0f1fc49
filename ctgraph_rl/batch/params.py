"""From tasks to tensors: the parameters of rows, and the bank of images that they share."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ctgraph_rl.checks import require, require_memory
from ctgraph_rl.core import reading
from ctgraph_rl.core.graph import MAX_STATES, StateType
from ctgraph_rl.core.rewards import RewardFn
from ctgraph_rl.core.rotation import taps_of
from ctgraph_rl.core.row_params import LegacyIndex, ObservationParams, RewardParams, Uses
from ctgraph_rl.core.tree import Swap, TreeParams, tree_params
from ctgraph_rl.tasks.images import white_level
from ctgraph_rl.tasks.memory import BankKey, bank_bytes, bank_key, make_bank, rotates_after_noise
from ctgraph_rl.tasks.task import Task

MakeTensor = Callable[..., Tensor]
"""Makes a tensor on the right device from a list with one entry per different task, and a dtype (int64)."""


class Tables(NamedTuple):
    """The parameters of different tasks, an entry for each of U, and which entry is each row's."""

    tree: TreeParams
    x: ObservationParams
    g: RewardParams
    goal_leaf: Tensor  # int64 [U]
    uses: Uses
    number: Tensor  # int64 [U], ascending: the tasks' numbers in a pool
    entry: Tensor  # int64 [N]

    def assigned(self, task: Tensor) -> Tables:
        """Return the tables with other tasks for the rows, by their numbers in the pool, int64 [N]."""
        return self._replace(entry=torch.searchsorted(self.number, task))

    @property
    def row_goals(self) -> Tensor:
        """The goal of each row's task, int64 [N]."""
        return self.goal_leaf.index_select(0, self.entry)

    def of_rows(self) -> tuple[TreeParams, ObservationParams, RewardParams]:
        """Return the parameters of each row."""
        return _of_rows(self.tree, self.entry), _of_rows(self.x, self.entry), _of_rows(self.g, self.entry)


def make_tables(tasks: tuple[Task, ...], number: Tensor, bank: Bank) -> Tables:
    """Return the tables of different tasks with these numbers in their pool; no row has one yet."""

    def each(values: Sequence[Any], dtype: torch.dtype = torch.int64) -> Tensor:
        return torch.tensor(values, dtype=dtype, device=number.device)

    reward_fns = tuple(dict.fromkeys(task.reward_fn for task in tasks))
    observations = [task.observations for task in tasks]
    uses = Uses(
        waits=any(task.graph.wait_prob > 0 for task in tasks),
        unique_ids=any(x.is_unique(kind) and not x.legacy_index for x in observations for kind in StateType),
        drawn_ids=any(x.draws_ids for x in observations),
        views=any(_num_views(task) * _num_angles(task) > 1 for task in tasks),
        pixel_noise=any(x.read_noise for x in observations),
        noise_bank=bank.num_noises if any(x.read_noise for x in observations) else 0,
        reward_noise=any(task.reward_std for task in tasks),
        multiplicative=any(task.reward_std and task.reward_noise == "multiplicative" for task in tasks),
        fail_reward=any(task.fail_reward for task in tasks),
        step_reward=any(task.step_reward for task in tasks),
        reward_cue=any(x.reward_cue for x in observations),
        goal_change=any(task.goal_change for task in tasks),
        max_depth=max(task.graph.depth for task in tasks),
        reward_fns=reward_fns,
    )
    return Tables(
        tree=_tree_params(tasks, each),
        x=_observation_params(tasks, each, bank),
        g=_reward_params(tasks, each, reward_fns),
        goal_leaf=each([task.goal_leaf for task in tasks]),
        uses=uses,
        number=number,
        entry=number[:0],
    )


def _tree_params(tasks: tuple[Task, ...], each: MakeTensor) -> TreeParams:
    graphs = [task.graph for task in tasks]
    extra = [task.extra_end_step for task in tasks]
    return tree_params(
        branching_factor=each([graph.branching_factor for graph in graphs]),
        first_leaf=each([graph.num_decision_states for graph in graphs]),
        stay_below=each([int(graph.wait_prob * 2**63) for graph in graphs]),
        extra_end_step=each(extra, torch.bool) if any(extra) else None,
        swap=_swap(tasks, each) if any(task.swapped_branches for task in tasks) else None,
    )


def _swap(tasks: tuple[Task, ...], each: MakeTensor) -> Swap:
    pairs = [task.swapped_branches or ((), (0, 0)) for task in tasks]
    nodes = [-1 if task.swapped_node is None else task.swapped_node for task in tasks]
    return Swap(each(nodes), each([first for _, (first, _) in pairs]), each([second for _, (_, second) in pairs]))


def _observation_params(tasks: tuple[Task, ...], each: MakeTensor, bank: Bank) -> ObservationParams:
    observations = [task.observations for task in tasks]
    angles = list(map(_num_angles, tasks))
    bank_start = each([bank.start[bank_key(task)] for task in tasks])

    def table(of_kind: Callable[[Task, StateType], int]) -> Tensor:
        """A number for each kind of state of each task, flattened."""
        values = [of_kind(task, kind) for task in tasks for kind in StateType]
        return torch.tensor(values, device=bank_start.device, dtype=torch.int64)

    return ObservationParams(
        first_kind=each([len(StateType) * i for i in range(len(tasks))]) if len(tasks) > 1 else None,
        first_view=table(lambda task, kind: bank.start[bank_key(task)] + _first_view(task, kind)),
        views_per_node=table(lambda task, kind: _num_views(task) * _is_by_node(task, kind)),
        num_ids=table(_num_ids),
        bank_start=bank_start,
        num_views=each(list(map(_num_views, tasks))),
        num_angles=each(angles),
        read_noise=each([x.read_noise for x in observations]),
        reward_cue=each([x.reward_cue for x in observations], torch.bool),
        cue_wraps=each([x.cue_wraps for x in observations], torch.bool),
        cue_element=each([task.images.shape[-1] - 1 for task in tasks]),
        white=each([white_level(task.images) for task in tasks], torch.float64),
        noise_start=each([bank.noise_levels.index(x.read_noise) * bank.num_noises for x in observations]),
        legacy=_legacy_index(tasks, each, table) if any(x.legacy_index for x in observations) else None,
        taps=_taps(bank.shape[-1], max(angles), bank_start.device) if max(angles) > 1 else None,
    )


def _taps(size: int, angles: int, device: torch.device) -> Any:
    """Return what rotates an image of a size by each angle."""
    of_angles = [taps_of(size, angle) for angle in range(angles)]
    return tuple(torch.stack(part).to(device) for part in zip(*of_angles, strict=True))


def _is_by_node(task: Task, kind: StateType) -> bool:
    """Whether each state of a kind has an image that is numbered as its node."""
    return task.observations.is_unique(kind) and not task.observations.legacy_index


def _first_view(task: Task, kind: StateType) -> int:
    """Return the first view of a kind of state, counted from that of the task."""
    skipped = task.graph.num_decision_states if kind == StateType.END and _is_by_node(task, kind) else 0
    return (task.observations.ids(kind)[0] - skipped) * _num_views(task)


def _num_ids(task: Task, kind: StateType) -> int:
    """Return how many ids a state of a kind draws from."""
    first, last = task.observations.ids(kind)
    return 1 if task.observations.is_unique(kind) else last - first + 1


def _legacy_index(
    tasks: tuple[Task, ...], each: MakeTensor, table: Callable[[Callable[[Task, StateType], int]], Tensor]
) -> LegacyIndex:
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
    by_level = [[level(task, k) for k in levels] for task in tasks]
    return LegacyIndex(
        level_first=each([[first for first, _ in pairs] for pairs in by_level]),
        level_shift=each([[shift for _, shift in pairs] for pairs in by_level]),
        num_ids=table(num_ids),
    )


def _reward_params(tasks: tuple[Task, ...], each: MakeTensor, reward_fns: tuple[RewardFn, ...]) -> RewardParams:
    changes = [task.goal_change or (0, 0) for task in tasks]
    return RewardParams(
        depth=each([task.graph.depth for task in tasks]),
        num_leaves=each([task.graph.num_end_states for task in tasks]),
        reward_fn=each([reward_fns.index(task.reward_fn) for task in tasks]),
        goal_reward=each([task.goal_reward for task in tasks], torch.float32),
        fail_reward=each([task.fail_reward for task in tasks], torch.float32),
        step_reward=each([task.step_reward for task in tasks], torch.float32),
        reward_std=each([task.reward_std for task in tasks], torch.float32),
        multiplicative=each([task.reward_noise == "multiplicative" for task in tasks], torch.bool),
        change_first=each([first for first, _ in changes]),
        change_last=each([last for _, last in changes]),
        legacy_change=each([task.legacy_goal_change and bool(task.goal_change) for task in tasks], torch.bool),
    )


def _num_angles(task: Task) -> int:
    return task.observations.read_rotation + 1 if rotates_after_noise(task) else 1


def _num_views(task: Task) -> int:
    """Bank rows that one id of a task has."""
    return task.images.num_variants * (bank_key(task)[1] + 1)


class Bank(NamedTuple):
    """All images that a pool of tasks can show, each different set of them once."""

    images: Tensor  # uint8 [rows, *shape]
    shape: tuple[int, ...]  # of an observation
    start: dict[BankKey, int]  # the first row of each image set and rotation
    noise_levels: tuple[int, ...]  # the different values of ``read_noise``
    num_noises: int  # drawn in advance for each of them
    noises: Tensor  # uint8 [noises, *shape], those of a level in a row


def observation_shape(pool: Sequence[Task], num_rows: int) -> tuple[int, ...]:
    """Return the shape of a row's observation; one-hot vectors are as long as the longest of the pool.

    Raises:
        ValueError: for observations of different shapes, and for more than the machine can hold.
    """
    shapes = list(dict.fromkeys(task.images.shape for task in pool))
    one_hot = all(len(shape) == 1 for shape in shapes)
    require((one_hot or len(shapes) == 1, f"all tasks of a batch must show observations of one shape, got {shapes}"))
    needed = bank_bytes(pool) + 2 * num_rows * math.prod(max(shapes))  # a step holds two observations of every row
    require_memory("images and observations", needed, "images or rows")
    return max(shapes)


def shared_bank(pool: tuple[Task, ...], num_rows: int, num_noises: int) -> Bank:
    """Return the bank of a pool, with so many noises for each level drawn in advance.

    Raises:
        ValueError: see `observation_shape`.
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


def _of_rows(part: Any, index: Tensor) -> Any:
    """Return parameters of rows from those of their tasks; what is a table of all tasks stays one."""
    rows = {}
    for name, value in part._asdict().items():
        if isinstance(value, (LegacyIndex, Swap)):
            rows[name] = _of_rows(value, index)
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
"""What has not one entry for each task."""
