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
from ctgraph_rl.rewards import Arrival, RewardFn

_HOME, _WAIT, _DECISION, _END, _FAIL = map(int, StateType)  # plain integers: torch.compile knows no IntEnum

_WORD = 0xFFFFFFFF
_MULTIPLIERS = (0xD2511F53, 0xCD9E8D57)
_KEY_STEPS = (0x9E3779B9, 0xBB67AE85)
_ROUNDS = 10

STREAM_STEP, STREAM_NOISE, STREAM_IMAGES, STREAM_REWARD, STREAM_GOAL = range(5)
"""What a draw is for: a step's small draws, pixel noise, image sets, the noise of rewards, changes of the goal."""
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


def randint_wide(words: tuple[Tensor, Tensor], high: Tensor) -> Tensor:
    """Two words as an integer in [0, high) for any high up to 2**62; off by less than 2**-64 per value."""
    upper, lower = words
    high_upper, high_lower = high >> 32, high & _WORD
    middle = upper * high_lower  # up to 64 bits: only its halves are used
    carry = (((lower * high_lower) >> 32) & _WORD) + (middle & _WORD) + lower * high_upper
    return upper * high_upper + ((middle >> 32) & _WORD) + (carry >> 32)


_NORMAL_CELLS = 256
_NORMAL_UNIT = 2.0**-20


def normal_table() -> Tensor:
    """Upper-tail quantiles of the normal distribution at (1 + i / 256) 2**e, e = -1..30, for `normal`; float64."""
    cell = torch.arange(32 * _NORMAL_CELLS + 1, dtype=torch.float64)
    octave = (cell / _NORMAL_CELLS).floor()
    tail = (1 + cell / _NORMAL_CELLS - octave) * 2 ** (octave - 1 - 32)
    return (-torch.special.ndtri(tail) / _NORMAL_UNIT).round() * _NORMAL_UNIT


def normal(word: Tensor, table: Tensor) -> Tensor:
    """A word as a standard normal number, a multiple of 2**-20 up to 6.3 in size; float64.

    The inverse distribution function by linear interpolation in 256 cells per octave of the tail probability. Every
    operation is exact in float64, so devices and compiled code agree bit by bit.
    """
    tail = ((word >> 1).to(torch.float64) + 0.5).view(torch.int64)  # the bits of a double: octave, cell, place in it
    cell = (tail >> 44) - (1022 << 8)
    place = (tail & ((1 << 44) - 1)).to(torch.float64) * 2.0**-44
    low, high = table[cell], table[cell + 1]
    size = ((low + (high - low) * place) / _NORMAL_UNIT).round() * _NORMAL_UNIT
    return torch.where((word & 1).bool(), size, -size)


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
    num_views: Tensor  # bank rows of one id: its instances, each in all rotations
    read_noise: Tensor
    reward_cue: Tensor  # bool: end states show the reward


class RewardParams(NamedTuple):
    """What rewards and goals need to know of each row's task."""

    depth: Tensor  # int64
    num_leaves: Tensor  # int64
    reward_fn: Tensor  # int64: which of `Uses.reward_fns`
    goal_reward: Tensor  # float32
    fail_reward: Tensor  # float32
    step_reward: Tensor  # float32
    reward_std: Tensor  # float32
    multiplicative: Tensor  # bool: the noise is a share of the reward
    change_first: Tensor  # int64: a goal lasts at least so many episodes; 0 for ever
    change_last: Tensor  # int64: and at most so many


class RowParams(NamedTuple):
    """Everything that stays the same between two changes of tasks."""

    seed: Tensor  # int64 scalar
    row: Tensor  # numbers of the rows
    tree: TreeParams
    x: ObservationParams
    g: RewardParams
    bank: Tensor  # uint8 [B, *shape]
    normal_table: Tensor


class Uses(NamedTuple):
    """What the rows of a batch have use for, as plain Python values; the rest is not computed."""

    draws: bool = True
    pixel_noise: bool = True
    reward_noise: bool = True
    reward_cue: bool = True
    goal_change: bool = True
    max_depth: int = 63
    reward_fns: tuple[RewardFn, ...] = ()


class RowState(NamedTuple):
    """All that changes in a row; int64 but for ``episode_reward``."""

    state_type: Tensor
    node: Tensor
    tick: Tensor  # observations so far, of all episodes
    step_count: Tensor
    episode_reward: Tensor  # float32
    goal_leaf: Tensor
    episodes_left: Tensor  # episodes with this goal, the present one included; 0 before the first
    reward: Tensor  # float32: the last step's reward


class Shown(NamedTuple):
    """What a row shows."""

    observation: Tensor  # uint8 [N, *shape]
    observation_id: Tensor  # int64
    outcome: Tensor  # uint8
    leaf: Tensor  # int64
    done: Tensor  # bool


OUTCOME_RUNNING, OUTCOME_FAIL, OUTCOME_OTHER_END, OUTCOME_GOAL = range(4)
"""Values of ``("next", "outcome")``. Success means `OUTCOME_GOAL`, never a reward threshold."""

NO_LEAF = -1
"""Value of ``("next", "leaf")`` for a row that has not arrived at an end state."""


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
    at_home, at_wait, at_decision = kind == _HOME, kind == _WAIT, kind == _DECISION
    waits = action == WAIT_ACTION
    decides = at_decision & (action > WAIT_ACTION) & (action <= tree.branching_factor)
    arrival = torch.where(node >= tree.first_leaf, _END, _DECISION)
    after_wait = torch.where(waits, torch.where(stays, kind, arrival), _FAIL)
    after_decision = torch.where(decides, _WAIT, _FAIL)
    next_kind = torch.where(at_home, _WAIT, kind)
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
    """The images of observation ids: a random instance, rotated by random whole degrees in 0..read_rotation.

    Args:
        bank: uint8 [B, *shape], per image set and id all instances and rotations in a row.
        ids: observation ids.
        word: random words that choose the view.
        params: the rows' observation processes.

    Returns:
        uint8 [N, *shape].
    """
    index = params.bank_start + ids * params.num_views + randint(word, params.num_views)
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


def add_cue(images: Tensor, share: Tensor, shows: Tensor) -> Tensor:
    """Show the reward in the images of end states: the middle half becomes a square as bright as the reward.

    Args:
        images: uint8 [N, 1, r, r].
        share: float32 reward as a share of the goal's, shown as 0 (black) for 0 or less to 254 for 1 or more.
        shows: bool, the rows that show it.

    Returns:
        uint8 [N, 1, r, r].
    """
    size = images.shape[-1]
    inside = torch.zeros(size, dtype=torch.bool, device=images.device)
    inside[size // 4 : size - size // 4] = True
    level = (share.clamp(0, 1) * 254).to(torch.uint8).view(-1, 1, 1, 1)
    return torch.where(shows.view(-1, 1, 1, 1) & inside & inside.unsqueeze(-1), level, images)


def step(state: RowState, action: Tensor, params: RowParams, uses: Uses) -> tuple[RowState, Shown]:
    """One step of every row: a pure function, under ``torch.vmap`` and ``torch.compile`` too.

    Args:
        state: the rows' states.
        action: int64, see `transition`.
        params: the rows' tasks.
        uses: what the rows have use for.

    Returns:
        The next states, with the step's reward, and what they show.
    """
    state = state._replace(tick=state.tick + 1)
    words = _words(state, params, uses)
    before = State(state.state_type, state.node)
    after = transition(before, action, stays(words, params.tree), params.tree)
    reward = _reward(before, after, state, params, uses)
    state = state._replace(
        state_type=after.state_type,
        node=after.node,
        step_count=state.step_count + 1,
        episode_reward=state.episode_reward + reward,
        reward=reward,
    )
    return state, _show(state, words, params, uses)


def reset(state: RowState, mask: Tensor, params: RowParams, uses: Uses) -> tuple[RowState, Shown]:
    """Start an episode in the rows of a mask; a pure function like `step`.

    Args:
        state: the rows' states.
        mask: bool, the rows that start anew; the others stay as they are.
        params: the rows' tasks.
        uses: what the rows have use for.

    Returns:
        The states, and what all rows show (the others show what they showed before).
    """
    state = state._replace(
        state_type=state.state_type.masked_fill(mask, _HOME),
        node=state.node.masked_fill(mask, 0),
        tick=state.tick + mask,
        step_count=state.step_count.masked_fill(mask, 0),
        episode_reward=state.episode_reward.masked_fill(mask, 0),
        reward=state.reward.masked_fill(mask, 0),
    )
    if uses.goal_change:
        state = _count_episode(state, mask, params)
    return state, show(state, params, uses)


def show(state: RowState, params: RowParams, uses: Uses) -> Shown:
    """What rows show in given states; a pure function like `step`."""
    return _show(state, _words(state, params, uses), params, uses)


def _words(state: RowState, params: RowParams, uses: Uses) -> tuple[Tensor, ...]:
    """The small draws of a tick: two words for waiting, one for the id, one for the view; zeros without use."""
    if not uses.draws:
        return (torch.zeros_like(state.tick),) * 4
    return draw(params.seed, params.row, state.tick, STREAM_STEP)


def _count_episode(state: RowState, mask: Tensor, params: RowParams) -> RowState:
    """Begin an episode: where the last one with a goal is over, draw a goal and how many episodes it lasts."""
    g, left = params.g, state.episodes_left
    words = draw(params.seed, params.row, state.tick, STREAM_GOAL)
    lasts = g.change_first + randint(words[0], g.change_last - g.change_first + 1)
    over = mask & (left == 1)
    goal = torch.where(over, randint_wide((words[1], words[2]), g.num_leaves), state.goal_leaf)
    left = torch.where(mask, torch.where(left <= 1, lasts, left - 1), left)
    return state._replace(goal_leaf=goal, episodes_left=left)


def _reward(before: State, after: State, state: RowState, params: RowParams, uses: Uses) -> Tensor:
    """float32: the step's own reward, and what is paid on entering an end or a fail state.

    Products are of two float32 numbers in float64, hence exact: fused multiply-add changes nothing.
    """
    g, entered = params.g, after.state_type != before.state_type
    paid = (_share(after, state.goal_leaf, params, uses).double() * g.goal_reward).float().double()
    if uses.reward_noise:
        word = draw(params.seed, params.row, state.tick, STREAM_REWARD)[0]
        noise = (normal(word, params.normal_table) * g.reward_std).float()
        paid = paid + noise.double() * torch.where(g.multiplicative, paid, 1.0)
    at_end = entered & (after.state_type == _END)
    failed = entered & (after.state_type == _FAIL)
    return (torch.where(at_end, paid, torch.where(failed, g.fail_reward, 0.0).double()) + g.step_reward).float()


def _share(after: State, goal_leaf: Tensor, params: RowParams, uses: Uses) -> Tensor:
    """float32: the reward functions' shares, as if every row were at an end state."""
    tree, g = params.tree, params.g
    arrival = Arrival(after.node - tree.first_leaf, goal_leaf, tree.branching_factor, g.depth, uses.max_depth)
    share = uses.reward_fns[0](arrival)
    for i, reward_fn in enumerate(uses.reward_fns[1:], 1):
        share = torch.where(g.reward_fn == i, reward_fn(arrival), share)
    return share


def _show(state: RowState, words: tuple[Tensor, ...], params: RowParams, uses: Uses) -> Shown:
    """Observation, outcome, leaf and done of states."""
    x, at_end = params.x, state.state_type == _END
    ids = observation_id(State(state.state_type, state.node), words[2], x)
    images = read_images(params.bank, ids, words[3], x)
    if uses.pixel_noise:
        images = add_noise(images, params.seed, params.row, state.tick, x.read_noise)
    if uses.reward_cue:
        share = (state.reward - params.g.step_reward) / params.g.goal_reward
        images = add_cue(images, share, at_end & x.reward_cue)
    failed = state.state_type == _FAIL
    leaf = torch.where(at_end, state.node - params.tree.first_leaf, NO_LEAF)
    arrived = torch.where(leaf == state.goal_leaf, OUTCOME_GOAL, OUTCOME_OTHER_END)
    outcome = torch.where(at_end, arrived, torch.where(failed, OUTCOME_FAIL, OUTCOME_RUNNING))
    return Shown(images, ids, outcome.to(torch.uint8), leaf, at_end | failed)
