"""The tree's dynamics, section 2 of the paper: which state an action leads to.

A state is two integers per row, ``state_type`` and ``node``: the heap index of the position in the tree (the root is 0,
branch a of node n is b * n + a). A wait state carries the node that it leads to. Every tensor is [N], for N rows,
unless said otherwise.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from ctgraph_rl.core.graph import WAIT_ACTION, StateType

_HOME, _WAIT, _DECISION, _END, _FAIL = map(int, StateType)  # plain integers: torch.compile knows no IntEnum

MAX_TABLED = 62
"""Larger branching factors share one small table."""


class HasState(Protocol):
    """Anything with a state per row."""

    @property
    def state_type(self) -> Tensor:
        """uint8."""
        ...

    @property
    def node(self) -> Tensor:
        """int64."""
        ...


class State(NamedTuple):
    """Each row's position in its tree."""

    state_type: Tensor  # uint8
    node: Tensor  # int64


class Swap(NamedTuple):
    """Two decisions of one decision state per row that lead to each other's branch; int64."""

    node: Tensor  # the decision state; -1 for none
    first: Tensor  # a decision
    second: Tensor  # another one


class TreeParams(NamedTuple):
    """What the transition needs of each row's task, by `tree_params`; int64 if not said."""

    branching_factor: Tensor
    first_leaf: Tensor  # heap index of the first end state, the number of decision states
    stay_below: Tensor  # wait_prob * 2**63
    extra_end_step: Tensor | None  # bool: an end state takes one more action; None for no row
    first_move: Tensor  # place of the row's action 0 at home in the tables
    next_kind: Tensor  # uint8 table: the state type that a move leads to
    decides: Tensor  # bool table: the move is a decision
    width: int  # of the tables: actions -1 to the largest b + 1; what is beyond counts as one of these
    by_action: bool  # else the tables are of b = 1, for which 1 is any decision, and 2 any action above b
    swap: Swap | None = None  # None for no row


def tree_params(
    branching_factor: Tensor,
    first_leaf: Tensor,
    stay_below: Tensor,
    extra_end_step: Tensor | None = None,
    swap: Swap | None = None,
) -> TreeParams:
    """Return trees' parameters, with a table of moves for each different one."""
    extra = torch.zeros_like(branching_factor) if extra_end_step is None else extra_end_step.long()
    different, which = torch.unique(2 * branching_factor.clamp_max(MAX_TABLED + 1) + extra, return_inverse=True)
    largest = int(branching_factor.max())
    by_action = largest <= MAX_TABLED
    last_action = largest + 1 if by_action else 2
    tables = [_moves(number // 2 if by_action else 1, bool(number % 2), last_action) for number in different.tolist()]
    next_kind = torch.tensor(tables, dtype=torch.uint8, device=which.device)
    decides = torch.zeros_like(next_kind, dtype=torch.bool)
    decides[..., _DECISION, :] = next_kind[..., _DECISION, :] == _WAIT
    first_move = which * next_kind[0].numel() + 1
    return TreeParams(
        branching_factor=branching_factor,
        first_leaf=first_leaf,
        stay_below=stay_below,
        extra_end_step=extra_end_step,
        first_move=first_move,
        next_kind=next_kind.flatten(),
        decides=decides.flatten(),
        width=last_action + 2,
        by_action=by_action,
        swap=swap,
    )


def _moves(branching_factor: int, extra_end_step: bool, last_action: int) -> list[list[list[list[int]]]]:
    """Return where actions lead: [stays, before an end state, state type, action]."""

    def next_kind(stays: bool, before_end: bool, kind: int, action: int) -> int:
        waits = action == WAIT_ACTION
        decides = WAIT_ACTION < action <= branching_factor
        if kind == _HOME:
            return _WAIT
        if kind == _WAIT and waits:
            return _WAIT if stays else _END if before_end else _DECISION
        if kind == _DECISION and decides:
            return _WAIT
        if kind == _END:
            return _HOME if extra_end_step else _END
        return _FAIL

    return [
        [
            [[next_kind(stays, before_end, kind, action) for action in range(-1, last_action + 1)] for kind in range(5)]
            for before_end in (False, True)
        ]
        for stays in (False, True)
    ]


def transition(state: State, action: Tensor, stays: Tensor | None, tree: TreeParams) -> State:
    """One step of the tree, by tables for the kind of state and arithmetic for the node.

    Args:
        state: end and fail states are absorbing.
        action: int64, 0 waits and 1..b decides; any other fails.
        stays: bool, the row's draw with probability p; None if no row ever stays.

    Returns:
        The next state. A fail state's ``node`` is where it failed. With an extra end step an episode ends in a home
        state with an end state's node.
    """
    kind, node = state
    block = len(StateType) * tree.width
    column = action.clamp(-1, tree.width - 2)
    if not tree.by_action:
        column = torch.where(action > tree.branching_factor, 2, action.clamp(-1, 1))
    move = torch.add(tree.first_move + column, kind, alpha=tree.width)
    move = torch.add(move, node >= tree.first_leaf, alpha=block)
    if stays is not None:
        move = torch.add(move, stays, alpha=2 * block)
    next_kind = _look_up(tree.next_kind, move)
    decides = _look_up(tree.decides, move)
    if tree.extra_end_step is not None:
        next_kind = next_kind.masked_fill((kind == _HOME) & (node > 0), _HOME)
    branch = branch_of(node, action, tree.swap)
    return State(next_kind, torch.where(decides, node * tree.branching_factor + branch, node))


def branch_of(node: Tensor, decision: Tensor, swap: Swap | None) -> Tensor:
    """Return the branch, in 1..b, of a decision, or the decision of a branch."""
    if swap is None:
        return decision
    swapped = (node == swap.node) & ((decision == swap.first) | (decision == swap.second))
    return torch.where(swapped, swap.first + swap.second - decision, decision)


def _look_up(table: Tensor, index: Tensor) -> Tensor:
    return table.index_select(0, index) if index.ndim == 1 else table[index]


def is_done(state: HasState, tree: TreeParams) -> Tensor:
    """bool: the row needs a reset."""
    done = state.state_type >= _END
    if tree.extra_end_step is None:
        return done
    waits_for_one_more = (state.state_type == _END) & tree.extra_end_step
    return (done & ~waits_for_one_more) | ((state.state_type == _HOME) & (state.node > 0))


def stays(words: tuple[Tensor, ...], tree: TreeParams) -> Tensor:
    """The wait draw, words 0 and 1: True with probability p, exact to 2**-63."""
    return ((words[0] << 31) | (words[1] >> 1)) < tree.stay_below
