"""The C kernel, `kernel.c`: the bits of `dynamics` at the speed of memory, on CPUs."""

from __future__ import annotations

import ctypes
from collections.abc import Iterable, Iterator, Sequence
from itertools import product
from typing import NamedTuple

import torch
from torch import Tensor

from ctgraph_rl.batch.params import Tables
from ctgraph_rl.checks import NamedValues, Rule, one_of, require
from ctgraph_rl.core.dynamics import STATE_DTYPES, RowState, Shown, StateAndShown
from ctgraph_rl.core.kernel import library, num_threads
from ctgraph_rl.core.rewards import KERNEL_REWARDS, RewardFn
from ctgraph_rl.core.row_params import RowParams

KERNELS = ("auto", "off", "required")
"""The values of ``kernel`` of `Rows`."""


def kernel_rule(kernel: object) -> Rule:
    """Return the rule for values of ``kernel``."""
    return one_of(KERNELS, kernel=kernel)[0]


def knows(reward_fns: Iterable[RewardFn], device: torch.device) -> bool:
    """Return whether the kernel has these rewards and runs on this device."""
    return device.type == "cpu" and not _unknown(reward_fns)


def require_kernel(reward_fns: Iterable[RewardFn], device: torch.device) -> None:
    """Require that the kernel can run.

    Raises:
        ValueError: for other rewards, another device or a machine that cannot compile it.
    """
    other = _unknown(reward_fns)
    names = ", ".join(reward.__name__ for reward in KERNEL_REWARDS)
    fix = 'use kernel="auto" or kernel="off"'
    require(
        (not other, f'kernel="required" knows the rewards {names}, got {other[:3]}; {fix}'),
        (device.type == "cpu", f'kernel="required" runs on a CPU, got {device}; {fix}'),
    )
    library()


def _unknown(reward_fns: Iterable[RewardFn]) -> list[RewardFn]:
    return [fn for fn in reward_fns if type(fn) not in KERNEL_REWARDS]


class Stepped(NamedTuple):
    """What the rows show after a step, and what finished ones show when they start an episode."""

    observation: Tensor  # uint8 [N, *shape]
    following: Tensor  # uint8 [N, *shape]: after the restarts
    done: Tensor  # bool [N]; before the restarts, as all below
    outcome: Tensor  # uint8 [N]
    leaf: Tensor  # int64 [N]
    step_count: Tensor  # int64 [N]
    reward: Tensor  # float32 [N]
    episode_reward: Tensor  # float32 [N]


Observed = tuple[Tensor, Tensor | None]
"""What rows observe, uint8 [N, *shape], and which are done, bool [N]; None if none is."""


class Native:
    """Takes the steps of a batch with the kernel; methods return the next states and what rows show.

    Bind parameters before the first step.
    """

    params: RowParams
    tables: Tables

    def bind(self, params: RowParams, tables: Tables) -> None:
        """Take the parameters of the rows and of their tasks."""
        self.params = params
        self.tables = tables
        self._call: _Call | None = None
        self._state: RowState | None = None
        self._shapes: dict[str, Tensor] = {}

    def __getstate__(self) -> NamedValues:
        """Copies start without what is prepared."""
        return {"params": self.params, "tables": self.tables, "_call": None, "_state": None, "_shapes": {}}

    def take(
        self, state: RowState, action: Tensor | None, mask: Tensor | None, shown: Tensor | None = None
    ) -> StateAndShown:
        """Start an episode in the rows of a mask, and step the others.

        Args:
            action: int64 [N]; None: no row steps.
            mask: bool [N]; None: no row starts an episode.
            shown: uint8 [N, *shape], the last observations, if known and no row steps.
        """
        made = Shown(*self._new_arrays(Shown._fields))
        return self.run(state, made=made, action=action, mask=mask, shown=shown), made

    def observe(
        self, state: RowState, action: Tensor | None, mask: Tensor | None, shown: Tensor | None = None
    ) -> tuple[RowState, Observed]:
        """Return only the observations of `take`: every finished row is in the mask; without actions, None means all
        rows.
        """
        if action is None and mask is None:
            mask = torch.ones_like(state.node, dtype=torch.bool)
        state, made = self.take(state, action, mask, shown)
        return state, (made.observation, made.done)

    def step_and_restart(
        self, state: RowState, action: Tensor | None, most_action: int
    ) -> tuple[RowState, Stepped] | None:
        """Step all rows and start an episode in those that are done, as `step` and `restart` do, in one call.

        Args:
            action: int64 [N].
            most_action: the highest action; -1 checks nothing.

        Returns:
            The next state and what the rows show; None for invalid actions and where a row's episode was over before.
        """
        n = len(self.tables.entry)
        if action is None or action.dtype != torch.int64 or action.shape != (n,):
            return None
        made = Stepped(*self._new_arrays(Stepped._fields))
        after, wrong = self._run(state, most_action=most_action, restarts=True, made=made, action=action)
        return None if wrong else (after, made)

    def _new_arrays(self, names: Sequence[str]) -> Iterator[Tensor]:
        if not self._shapes:
            for name, (dtype, is_image, _) in _ARRAYS.items():
                pixels = self.params.bank.shape[1:] if is_image else ()
                one = torch.empty((), dtype=dtype, device=self.params.row.device)
                self._shapes[name] = one.expand(len(self.tables.entry), *pixels)
        return (torch.empty_like(self._shapes[name]) for name in names)

    def run(
        self,
        state: RowState,
        num_steps: int = 1,
        restarts: bool = False,
        made: Shown | None = None,
        **arrays: Tensor | None,
    ) -> RowState:
        """Call the kernel; return the states that it leads to.

        Args:
            restarts: rows that a step finishes start an episode within it.
            made: new arrays to fill, which are not checked.
            arrays: those of ``_ARRAYS``, filled or read; with ``made``, only those that are read.

        Raises:
            ValueError: for arrays of a wrong shape or dtype, and states that the rows' tasks cannot have.
        """
        after, wrong = self._run(state, num_steps, restarts, -1, made, **arrays)
        require((wrong == 0, "the rows' states are none of their tasks: they have images outside the bank"))
        return after

    def _run(
        self,
        state: RowState,
        num_steps: int = 1,
        restarts: bool = False,
        most_action: int = -1,
        made: Shown | Stepped | None = None,
        **arrays: Tensor | None,
    ) -> tuple[RowState, int]:
        if torch.compiler.is_compiling():  # which cannot look into the call; disabling it takes 50 µs
            run = torch.compiler.disable(self._run)
            return run(state, num_steps, restarts, most_action, made, **arrays)
        if self._call is None or self._pointers != _pointers(self._alive):
            self._call = self._prepare()  # the first call, or tables that were moved, as into memory of many processes
        call = self._call
        n = call.num_rows
        before = self._own_state(state, call)
        after = RowState(*map(torch.empty_like, before))
        call.before = _StatePointers(*_pointers(before))
        call.after = _StatePointers(*_pointers(after))
        call.num_steps = num_steps
        call.restarts = restarts
        call.most_action = most_action
        call.num_threads = num_threads(n * num_steps, most=-(-n // _BLOCK))
        names = _ARRAYS if made is None else _READ
        kept = []
        for name in names:
            kept.append(_set(call, name, arrays.get(name), 1 if name in _OF_ROWS else num_steps))
        if made is not None:  # for this call: nothing to check
            for name in _WRITTEN:
                array = getattr(made, name, None)
                setattr(call, name, None if array is None else array.data_ptr())
        wrong = library().ctgraph_run(ctypes.byref(call))
        del kept
        if not wrong:
            self._state = after
        return after, wrong

    def _own_state(self, state: RowState, call: _Call) -> RowState:
        last = self._state
        if last is not None and all(a is b for a, b in zip(state, last, strict=True)):
            return state
        shape = (call.num_rows,)
        own = []
        for (name, dtype), value in zip(STATE_DTYPES.items(), state, strict=True):
            got = f"{value.dtype} {list(value.shape)} on {value.device}"
            fits = value.dtype == dtype and value.shape == shape and value.is_cpu
            require((fits, f"{name} of a state must be {dtype} {list(shape)} on the CPU, got {got}"))
            own.append(value.contiguous())
        return RowState(*own)

    def _prepare(self) -> _Call:
        params = self.params
        uses = self.tables.uses
        x = self.tables.x
        n = len(self.tables.entry)
        require_kernel(uses.reward_fns, params.row.device)
        streams = len(params.seed) in (1, n) and params.row.shape == (n,)
        require((streams, f"rows need a seed and a number each, got {len(params.seed)} and {len(params.row)} for {n}"))
        tables = {
            "tasks": _pack(self.tables),
            "task": self.tables.entry,
            "seed": params.seed,
            "row": params.row,
            "bank": params.bank,
            "noises": params.noise_bank,
            "normal_table": params.normal_table,
        }
        if x.legacy is not None:
            tables |= {"level_first": x.legacy.level_first, "level_shift": x.legacy.level_shift}
        if x.taps is not None:
            tables |= {"tap_index": x.taps[0], "tap_weight": x.taps[1]}
        self._alive = [value.contiguous() for value in tables.values()]
        self._pointers = _pointers(self._alive)
        call = _Call(
            num_rows=n,
            num_tasks=len(tables["tasks"]),
            bank_rows=len(params.bank),
            num_pixels=params.bank[0].numel(),
            width=params.bank.shape[-1],
            is_vector=params.bank.ndim == 2,
            num_levels=0 if x.legacy is None else x.legacy.level_first.shape[1],
            own_seeds=len(params.seed) > 1,
        )
        for name in _USES:
            setattr(call, name, getattr(uses, name))
        for name, pointer in zip(tables, self._pointers, strict=True):
            setattr(call, name, pointer)
        return call


def _pointers(tensors: Iterable[Tensor]) -> list[int]:
    return [tensor.data_ptr() for tensor in tensors]


def _set(call: _Call, name: str, array: Tensor | None, num_steps: int) -> Tensor | None:
    if array is None:
        setattr(call, name, None)
        return None
    dtype, is_image, is_read = _ARRAYS[name]
    array = array.contiguous() if is_read else array
    length = call.num_rows * num_steps * (call.num_pixels if is_image else 1)
    if array.dtype != dtype or array.numel() != length or not array.is_contiguous() or not array.is_cpu:
        got = f"{array.dtype} {list(array.shape)} on {array.device}"
        raise ValueError(f"{name} must be {dtype} with {length} elements in a row on the CPU, got {got}")
    setattr(call, name, array.data_ptr())
    return array


def _pack(tables: Tables) -> Tensor:
    """Return the different tasks as int64 [U, fields], ordered as ``Task`` in `kernel.c`; floats by their bits."""
    tree = tables.tree
    x = tables.x
    g = tables.g
    count = len(tree.first_leaf)
    extra = torch.zeros_like(tree.first_leaf) if tree.extra_end_step is None else tree.extra_end_step
    reward_fn = torch.tensor(
        [KERNEL_REWARDS.index(type(fn)) for fn in tables.uses.reward_fns], dtype=torch.int64, device="cpu"
    )[g.reward_fn]
    legacy = torch.ones_like(x.num_ids) if x.legacy is None else x.legacy.num_ids
    none = torch.full_like(tree.first_leaf, -1)
    plain = [tree.branching_factor, tree.first_leaf, tree.stay_below, extra, *(tree.swap or (none, none, none))]
    plain += [x.num_views, x.num_angles, x.read_noise, x.reward_cue, x.cue_wraps, x.cue_element, x.noise_start]
    plain += [_bits(x.white), g.depth, g.num_leaves, reward_fn, g.multiplicative]
    plain += [g.change_first, g.change_last, g.legacy_change]
    plain += map(_bits, (g.goal_reward, g.fail_reward, g.step_reward, g.reward_std))
    by_kind = [table.view(count, -1) for table in (x.first_view, x.views_per_node, x.num_ids, legacy)]
    return torch.cat([torch.stack([column.long() for column in plain], 1), *by_kind], 1)


def _bits(value: Tensor) -> Tensor:
    return value.double().view(torch.int64)


_BLOCK = 64
_USES = ("draws", "pixel_noise", "noise_bank", "reward_noise", "fail_reward", "step_reward", "goal_change")
_SIZES = ("num_rows", "num_steps", "num_threads", "num_tasks", "bank_rows", "num_pixels", "width", "is_vector")
_TABLES = ("tasks", "task", "seed", "row", "bank", "noises", "normal_table")
_OPTIONAL_TABLES = ("level_first", "level_shift", "tap_index", "tap_weight")
_ARRAYS = {
    "action": (torch.int64, False, True),
    "mask": (torch.bool, False, True),
    "shown": (torch.uint8, True, True),
    "observation": (torch.uint8, True, False),
    "following": (torch.uint8, True, False),
    "done": (torch.bool, False, False),
    "outcome": (torch.uint8, False, False),
    "leaf": (torch.int64, False, False),
    "step_count": (torch.int64, False, False),
    "reward": (torch.float32, False, False),
    "episode_reward": (torch.float32, False, False),
}
"""Arrays of a call, [T, N, ...]: dtype, whether it holds images, whether it is read."""
_READ = [name for name, (*_, is_read) in _ARRAYS.items() if is_read]
_WRITTEN = [name for name in _ARRAYS if name not in _READ]
_OF_ROWS = ("mask", "shown")
_StatePointers = ctypes.c_void_p * len(RowState._fields)


class _Call(ctypes.Structure):
    """``Call`` of `kernel.c`."""

    _fields_ = [
        *product((*_SIZES, "num_levels", *_USES, "own_seeds", "restarts", "most_action"), [ctypes.c_int64]),
        *product((*_TABLES, *_OPTIONAL_TABLES), [ctypes.c_void_p]),
        *product(("before", "after"), [_StatePointers]),
        *product(_ARRAYS, [ctypes.c_void_p]),
    ]
