"""The tensor engine: pure functions, without TorchRL, that every face of the environment wraps.

In the order of the paper: transition, observation, reward, episode. The C kernel has the same bits. Shapes: N rows;
every tensor is [N] unless said otherwise. All random numbers are drawn by counter, in `philox`.
"""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from ctgraph_rl.core.graph import StateType
from ctgraph_rl.core.philox import (
    STREAM_GOAL,
    STREAM_NOISE,
    STREAM_REWARD,
    STREAM_STEP,
    draw,
    normal,
    randint,
    randint_wide,
)
from ctgraph_rl.core.reading import add_cue, add_noise, add_saturating, cue_level, turn
from ctgraph_rl.core.rewards import Arrival
from ctgraph_rl.core.row_params import ObservationParams, RowParams, Uses
from ctgraph_rl.core.tree import State, is_done, stays, transition

_HOME, _WAIT, _DECISION, _END, _FAIL = map(int, StateType)  # plain integers: torch.compile knows no IntEnum


class RowState(NamedTuple):
    """All that changes in a row; int64 if not said."""

    state_type: Tensor  # uint8
    node: Tensor
    tick: Tensor  # observations so far, of all episodes
    step_count: Tensor
    episode_reward: Tensor  # float32
    goal_leaf: Tensor
    episodes_left: Tensor  # episodes with this goal, the present one included; 0 before the first
    reward: Tensor  # float32: the last step's reward
    paid: Tensor  # float32: the part of it that an end or fail state paid


STATE_DTYPES = dict.fromkeys(RowState._fields, torch.int64) | {
    "state_type": torch.uint8,
    "episode_reward": torch.float32,
    "reward": torch.float32,
    "paid": torch.float32,
}


class Shown(NamedTuple):
    """The observation of a row."""

    observation: Tensor  # uint8 [N, *shape]
    outcome: Tensor  # uint8
    leaf: Tensor  # int64
    done: Tensor  # bool


StateAndShown = tuple[RowState, Shown]
"""The next states, and what they show."""

Batch = TypeVar("Batch", RowState, Shown)


def beside(rows: Tensor, value: Tensor) -> Tensor:
    """Return each row's number, [N] or [N, 1], in a form that broadcasts with a value, [N, ...]."""
    return rows.view(-1, *[1] * (value.ndim - 1))


def choose(mask: Tensor, new: Batch, old: Batch) -> Batch:
    """Return one value in the rows of a mask, bool [N], and another elsewhere."""
    pairs = zip(new, old, strict=True)
    return type(new)(*(torch.where(beside(mask, a), a, b) for a, b in pairs))


OUTCOME_RUNNING, OUTCOME_FAIL, OUTCOME_OTHER_END, OUTCOME_GOAL = range(4)
"""Values of ``("next", "outcome")``; success means `OUTCOME_GOAL`."""

NO_LEAF = -1
"""Value of ``("next", "leaf")`` for a row not at an end state."""

Words = tuple[Tensor, ...]
"""A tick's small draws: two for a wait that begins there, one each for the id and view shown there, and, where rewards
have noise, a normal number for the step that begins there.
"""


def words_of(tick: Tensor, params: RowParams, uses: Uses) -> Words:
    """Return the small draws of a tick; zeros without use."""
    words = draw(params.seed, params.row, tick, STREAM_STEP) if uses.draws else (torch.zeros_like(tick),) * 4
    if not uses.reward_noise:
        return words
    return *words, normal(draw(params.seed, params.row, tick, STREAM_REWARD)[0], params.normal_table)


# Transition


def step(
    state: RowState, action: Tensor, params: RowParams, uses: Uses, words: tuple[Words, Words] | None = None
) -> StateAndShown:
    """Take a step in every row, also under ``torch.vmap`` and ``torch.compile``.

    Args:
        action: int64, as in `transition`.
        words: draws of the present and the next tick, if at hand.

    Returns:
        The next states, with the step's reward, and what they show.
    """
    now, then = words or (words_of(tick, params, uses) for tick in (state.tick, state.tick + 1))
    state = advance(state, action, now, params, uses)
    return state, show(state, params, uses, then)


def advance(
    state: RowState, action: Tensor, words: Words, params: RowParams, uses: Uses, absorbing: bool = True
) -> RowState:
    """Return the next states with the step's reward, but not what they show. ``words`` are of the present tick."""
    stay = stays(words, params.tree) if uses.waits else None
    after = transition(State(state.state_type, state.node), action, stay, params.tree)
    entered = after.state_type != state.state_type if absorbing else None
    paid = reward = _paid(after, entered, state.goal_leaf, words=words, params=params, uses=uses)
    if uses.step_reward:
        reward = (paid.double() + params.g.step_reward).float()
    return state._replace(
        state_type=after.state_type,
        node=after.node,
        tick=state.tick + 1,
        step_count=state.step_count + 1,
        episode_reward=state.episode_reward + reward,
        reward=reward,
        paid=paid,
    )


def step_or_reset(
    state: RowState,
    action: Tensor,
    mask: Tensor,
    params: RowParams,
    uses: Uses,
    words: tuple[Words, Words] | None = None,
) -> StateAndShown:
    """Start an episode in the rows of a mask, whatever their action, and `step` the others."""
    now, then = words or (words_of(tick, params, uses) for tick in (state.tick, state.tick + 1))
    stepped = advance(state, action, now, params, uses)
    state = begin(stepped._replace(tick=state.tick + ~mask), mask, params, uses)
    return state, show(state, params, uses, then)


# Observation


def observe(state: RowState, words: Words, params: RowParams, uses: Uses) -> Tensor:
    """Return the images that rows show, uint8 [N, *shape]: a random view of the id, with noise, late rotation and
    reward cue.

    ``words`` are the small draws of the states' ticks.
    """
    return read(look(state, words, params, uses), state, params, uses)


class SeenState(NamedTuple):
    """The views that rows see, not yet read; int64."""

    rows: Tensor  # of the bank
    angle: Tensor  # degrees by which the images are still to be rotated
    noise: Tensor  # start of the noise, or its row in the noise bank


def look(state: RowState, words: Words, params: RowParams, uses: Uses) -> SeenState:
    """Choose each row's view, and draw what is not in the bank."""
    x = params.x
    rows = bank_rows(state, words[2], params.x, uses)
    angle = noise = torch.zeros_like(rows)
    if uses.views:
        view = randint(words[3], x.num_views * x.num_angles)
        rows = rows + view // x.num_angles
        angle = view % x.num_angles
    if uses.pixel_noise:
        upper, lower, *_ = draw(params.seed, params.row, state.tick, STREAM_NOISE)
        noise = x.noise_start + randint(upper, uses.noise_bank) if uses.noise_bank else (upper << 32) | lower
    return SeenState(rows, angle, noise)


def bank_rows(state: State | RowState, word: Tensor, x: ObservationParams, uses: Uses) -> Tensor:
    """X: return the bank's first view of a state's id, by node or drawn."""
    kind = state.state_type.long() if x.first_kind is None else x.first_kind + state.state_type
    rows = x.first_view.index_select(0, kind)
    if uses.unique_ids:
        rows = rows + state.node * x.views_per_node.index_select(0, kind)
    if x.legacy is not None:
        level = (state.node.unsqueeze(-1) >= x.legacy.level_first).sum(-1, keepdim=True) - 1
        number = state.node + x.legacy.level_shift.gather(-1, level).squeeze(-1)
        rows = rows + number % x.legacy.num_ids.index_select(0, kind) * x.num_views
    if uses.drawn_ids:
        rows = rows + randint(word, x.num_ids.index_select(0, kind)) * x.num_views
    return rows


def read(seen: SeenState, state: RowState, params: RowParams, uses: Uses) -> Tensor:
    """Return the seen images, uint8 [N, *shape], with noise, late rotation and reward cue."""
    x = params.x
    images = params.bank.index_select(0, seen.rows)
    if uses.noise_bank:
        images = add_saturating(images, params.noise_bank.index_select(0, seen.noise))
    elif uses.pixel_noise:
        images = add_noise(images, seen.noise, x.read_noise)
    if x.taps is not None:
        images = turn(images, seen.angle, x.taps)
    if uses.reward_cue:
        level = cue_level(state.paid.double() / params.g.goal_reward, x.white, x.cue_wraps)
        images = add_cue(images, level, (state.state_type == _END) & x.reward_cue, x.cue_element)
    return images


def observation_id(state: RowState, params: RowParams, uses: Uses) -> Tensor:
    """Return the ids that rows show, int64 [N]."""
    rows = bank_rows(state, words_of(state.tick, params, uses)[2], params.x, uses)
    return (rows - params.x.bank_start) // params.x.num_views


def show(state: RowState, params: RowParams, uses: Uses, words: Words | None = None) -> Shown:
    """Return what rows show in given states."""
    done = is_done(state, params.tree)
    words = words_of(state.tick, params, uses) if words is None else words
    return Shown(observe(state, words, params, uses), *outcome(state, done, params), done)


# Reward


def _paid(
    after: State, entered: Tensor | None, goal_leaf: Tensor, words: Words, params: RowParams, uses: Uses
) -> Tensor:
    """float32: what entering an end or fail state pays.

    Sums are of float32 numbers and their products in float64, hence exact: fused multiply-add changes nothing.
    """
    g = params.g
    tree = params.tree
    arrival = Arrival(after.node - tree.first_leaf, goal_leaf, tree.branching_factor, g.depth, uses.max_depth)
    earned = uses.reward_fns[0](arrival)
    for i, reward_fn in enumerate(uses.reward_fns[1:], 1):
        earned = torch.where(g.reward_fn == i, reward_fn(arrival), earned)
    paid = earned * g.goal_reward
    if uses.reward_noise:
        noise = (words[4] * g.reward_std).float()
        share = torch.where(g.multiplicative, paid, 1.0) * noise.double() if uses.multiplicative else noise
        paid = paid.double() + share
    at_end = after.state_type == _END
    reward = torch.where(at_end if entered is None else at_end & entered, paid, 0.0)
    if uses.fail_reward:
        failed = after.state_type == _FAIL
        reward = torch.where(failed if entered is None else failed & entered, g.fail_reward, reward)
    return reward.float()


# Episode


def reset(state: RowState, mask: Tensor, params: RowParams, uses: Uses, words: Words | None = None) -> StateAndShown:
    """Start an episode in the rows of a mask.

    Args:
        mask: bool, the rows that start an episode; the others stay unchanged.
        words: draws of the ticks after the reset, if at hand.

    Returns:
        The states, and what all rows show; the others show the same as before.
    """
    state = begin(state, mask, params, uses)
    return state, show(state, params, uses, words)


def restart(
    state: RowState, mask: Tensor | None, params: RowParams, uses: Uses, words: Words | None = None
) -> tuple[RowState, Tensor]:
    """`reset` that leaves no row finished: return the states and the observations."""
    state = begin(state, mask, params, uses)
    words = words_of(state.tick, params, uses) if words is None else words
    return state, observe(state, words, params, uses)


def begin(state: RowState, mask: Tensor | None, params: RowParams, uses: Uses) -> RowState:
    """Return the states after a reset of a mask's rows, or of all."""
    if mask is None:
        zeros = RowState(*map(torch.zeros_like, state))
        state = zeros._replace(tick=state.tick + 1, goal_leaf=state.goal_leaf, episodes_left=state.episodes_left)
        mask = torch.ones_like(state.node, dtype=torch.bool)
    else:
        starts = mask.long()
        keeps = 1 - starts
        nothing = torch.zeros_like(state.reward)
        reward = torch.where(mask, nothing, state.reward)
        state = state._replace(
            state_type=state.state_type * keeps.to(torch.uint8),  # the home state is 0; faster than filling by a mask
            node=state.node * keeps,
            tick=state.tick + starts,
            step_count=state.step_count * keeps,
            episode_reward=torch.where(mask, nothing, state.episode_reward),
            reward=reward,
            paid=torch.where(mask, nothing, state.paid) if uses.step_reward else reward,
        )
    return _count_episode(state, mask, params) if uses.goal_change else state


def _count_episode(state: RowState, mask: Tensor, params: RowParams) -> RowState:
    g = params.g
    left = state.episodes_left
    words = draw(params.seed, params.row, state.tick, STREAM_GOAL)
    span = g.change_last - g.change_first + 1
    first, second = (g.change_first + randint(word, span) for word in (words[0], words[3]))
    begins = mask & (left == 0)
    left = torch.where(begins, first - g.legacy_change.long(), left - mask.long())
    over = mask & (left == 0) & (g.change_first > 0)
    goal = torch.where(over, randint_wide((words[1], words[2]), g.num_leaves), state.goal_leaf)
    return state._replace(goal_leaf=goal, episodes_left=torch.where(over, torch.where(begins, second, first), left))


def outcome(state: RowState, done: Tensor, params: RowParams) -> tuple[Tensor, Tensor]:
    """Return the rows' ``OUTCOME_*``, uint8, and the end state of arrival, int64, else `NO_LEAF`."""
    result, arrived, leaf = arrivals(state, done, params)
    return result, leaf.masked_fill(~arrived, NO_LEAF)


def arrivals(state: RowState, done: Tensor, params: RowParams) -> tuple[Tensor, Tensor, Tensor]:
    """Return the rows' ``OUTCOME_*``, uint8, whether they arrived at an end state, and which."""
    arrived = done & (state.state_type != _FAIL)
    leaf = state.node - params.tree.first_leaf
    hits = arrived & (leaf == state.goal_leaf)
    return done.to(torch.uint8) + arrived.to(torch.uint8) + hits.to(torch.uint8), arrived, leaf
