"""The functional core: pure tensor functions, without TorchRL, that every face of the environment wraps.

A state is two integers per row, ``state_type`` and ``node``: the heap index of the position in the tree
(the root is 0, branch a of node n is b * n + a). A wait state carries the node that it leads to.

Randomness is Philox4x32-10 in counter mode (Salmon et al. 2011). The 128-bit counter holds (ticks of the
row, row, stream and block), the 64-bit key holds the seed. Different (seed, row, stream, tick) are different
inputs of a bijection per key, so no two rows share a block by construction, and a row's draws depend on nothing
but its seed, its number and how many observations it has had.

Shapes: N rows; every tensor is [N] unless said otherwise. Unsigned 32-bit words are held in int64.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ctgraph_rl.graph import WAIT_ACTION, StateType

_WORD = 0xFFFFFFFF
_MULTIPLIERS = (0xD2511F53, 0xCD9E8D57)
_KEY_STEPS = (0x9E3779B9, 0xBB67AE85)
_ROUNDS = 10

STREAM_STEP, STREAM_NOISE, STREAM_IMAGES = 0, 1, 2
"""What a draw is for: the small draws of a step, pixel noise, the blueprints of an image set."""
_STREAM_SHIFT = 28  # 16 streams of 2**28 blocks each


def philox(counter: tuple[Tensor, Tensor, Tensor, Tensor], key: tuple[Tensor, Tensor]) -> tuple[Tensor, ...]:
    """Philox4x32-10: four random words for a counter of four words and a key of two.

    Args:
        counter: four int64 tensors of broadcastable shapes with values in [0, 2**32).
        key: two int64 tensors, likewise.

    Returns:
        Four int64 tensors with values in [0, 2**32).
    """
    c0, c1, c2, c3 = counter
    k0, k1 = key
    for _ in range(_ROUNDS):
        even, odd = c0 * _MULTIPLIERS[0], c2 * _MULTIPLIERS[1]  # the low 64 bits are exact
        c0, c1 = ((odd >> 32) ^ c1 ^ k0) & _WORD, odd & _WORD
        c2, c3 = ((even >> 32) ^ c3 ^ k1) & _WORD, even & _WORD
        k0, k1 = (k0 + _KEY_STEPS[0]) & _WORD, (k1 + _KEY_STEPS[1]) & _WORD
    return c0, c1, c2, c3


def draw(seed: Tensor, row: Tensor, tick: Tensor, stream: int, block: Tensor | int = 0) -> tuple[Tensor, ...]:
    """Four random words per element for (seed, row, tick, stream, block).

    Args:
        seed: int64 >= 0, any shape that broadcasts with the others.
        row: int64 in [0, 2**32).
        tick: int64 >= 0.
        stream: one of the ``STREAM_*`` constants.
        block: number of the block in [0, 2**28), for uses that need more than four words.
    """
    last = torch.as_tensor(block, device=tick.device) + (stream << _STREAM_SHIFT)
    return philox((tick & _WORD, tick >> 32, row, last), (seed & _WORD, seed >> 32))


def randint(word: Tensor, high: Tensor | int) -> Tensor:
    """A word as an integer in [0, high); each value's probability is off by less than 2**-32."""
    return (word * high) >> 32


class State(NamedTuple):
    """Where each row is."""

    state_type: Tensor
    node: Tensor


class TreeParams(NamedTuple):
    """What the transition needs to know of each row's task; int64."""

    branching_factor: Tensor
    first_leaf: Tensor  # heap index of the first end state, the number of decision states
    stay_below: Tensor  # wait_prob * 2**63


class ObservationParams(NamedTuple):
    """What the observation process X needs to know of each row's task; int64 but for ``unique``."""

    first_id: Tensor  # [N, 5], by state type
    num_ids: Tensor  # [N, 5]
    unique: Tensor  # [N, 5] bool: the id follows from the node instead of a draw
    node_offset: Tensor  # [N, 5]: the node that shows the first id
    bank_start: Tensor  # first bank row of the task's image set
    num_angles: Tensor  # rotations kept per image, read_rotation + 1
    read_noise: Tensor


def transition(state: State, action: Tensor, stays: Tensor, tree: TreeParams) -> State:
    """One step of the tree, sections 2.1 and 2.2 of the paper.

    Args:
        state: current state; an end or fail state is absorbing.
        action: int64, 0 waits and 1..b decides; above a row's b it fails as a wrong action does.
        stays: bool, the row's draw with probability p.
        tree: the rows' trees.

    Returns:
        The next state. ``node`` of a fail state is where it failed.
    """
    kind, node = state
    at_home, at_wait, at_decision = kind == StateType.HOME, kind == StateType.WAIT, kind == StateType.DECISION
    waits = action == WAIT_ACTION
    decides = at_decision & ~waits & (action <= tree.branching_factor)
    arrival = torch.where(node >= tree.first_leaf, int(StateType.END), int(StateType.DECISION))
    after_wait = torch.where(waits, torch.where(stays, kind, arrival), int(StateType.FAIL))
    after_decision = torch.where(decides, int(StateType.WAIT), int(StateType.FAIL))
    next_kind = torch.where(at_home, int(StateType.WAIT), kind)
    next_kind = torch.where(at_wait, after_wait, next_kind)
    next_kind = torch.where(at_decision, after_decision, next_kind)
    next_node = torch.where(decides, node * tree.branching_factor + action, node)
    return State(next_kind, next_node)


def stays(words: tuple[Tensor, ...], tree: TreeParams) -> Tensor:
    """The wait draw: True with probability p, exact to 2**-63. Uses words 0 and 1."""
    return ((words[0] << 31) | (words[1] >> 1)) < tree.stay_below


def observation_id(state: State, word: Tensor, params: ObservationParams) -> Tensor:
    """X: the id that a state shows, by its node where ids are unique, else drawn from its subset."""
    kind = state.state_type.unsqueeze(-1)

    def of_kind(table: Tensor) -> Tensor:
        return table.gather(-1, kind).squeeze(-1)

    by_node = state.node - of_kind(params.node_offset)
    drawn = randint(word, of_kind(params.num_ids))
    return of_kind(params.first_id) + torch.where(of_kind(params.unique), by_node, drawn)


def read_images(bank: Tensor, ids: Tensor, word: Tensor, params: ObservationParams) -> Tensor:
    """The images of observation ids, each rotated by a whole number of degrees in 0..read_rotation.

    Args:
        bank: uint8 [B, *shape], per image set and id all rotations in a row.
        ids: observation ids.
        word: random words that choose the angles.
        params: the rows' observation processes.

    Returns:
        uint8 [N, *shape].
    """
    index = params.bank_start + ids * params.num_angles + randint(word, params.num_angles)
    return bank.index_select(0, index)


def add_noise(images: Tensor, seed: Tensor, row: Tensor, tick: Tensor, read_noise: Tensor) -> Tensor:
    """Add to each pixel an independent integer drawn uniformly from 0..read_noise, saturating at 255.

    Args:
        images: uint8 [N, 1, r, r].
        seed: int64 scalar.
        row: numbers of the rows.
        tick: how many observations each row has had.
        read_noise: largest addition per row, 0..255.

    Returns:
        uint8 [N, 1, r, r].
    """
    pixels = images[0].numel()
    blocks = torch.arange((pixels + 3) // 4, device=images.device)
    words = draw(seed, row.unsqueeze(-1), tick.unsqueeze(-1), STREAM_NOISE, blocks)
    noise = randint(torch.stack(words, -1).flatten(1)[:, :pixels], read_noise.unsqueeze(-1) + 1)
    return (images + noise.view(images.shape)).clamp_max(255).to(torch.uint8)
