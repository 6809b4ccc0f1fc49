"""What the dynamics need of each row's task, as tensors that stay between changes of tasks.

Shapes: N rows; every tensor is [N] unless said otherwise.
"""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from ctgraph_rl.core.rewards import RewardFn
from ctgraph_rl.core.tree import TreeParams


class LegacyIndex(NamedTuple):
    """Each row's numbers of `Observations.legacy_index`; int64."""

    level_first: Tensor  # [N, D + 1]: first node of a level, in rows of less depth 2**63 - 1 beyond it
    level_shift: Tensor  # [N, D + 1]: what is added to a node of the level
    num_ids: Tensor  # [U * 5]: the number is taken modulo it; 1 where ids are not unique or not legacy


class ObservationParams(NamedTuple):
    """What X and reading need of each row's task; int64 if not said.

    A bank's row is the first view of the state's kind, plus the node's where ids are unique, plus a draw of an id, plus
    a draw of a view: an instance in one of its rotations. Tables [U * 5] have an entry per different task and state
    type.
    """

    first_kind: Tensor | None  # where the row's task begins in the tables; None for U = 1
    first_view: Tensor  # [U * 5]: bank row of the first id; where unique, of node 0
    views_per_node: Tensor  # [U * 5]: bank rows from one node to the next, 0 where ids are not unique
    num_ids: Tensor  # [U * 5]: how many ids are drawn from; 1 where they are unique
    bank_start: Tensor  # first bank row of the task's image set
    num_views: Tensor  # bank rows of one id
    num_angles: Tensor  # rotations that are not in the bank but come after the noise, at least 1
    read_noise: Tensor
    reward_cue: Tensor  # bool: end states show the reward
    cue_wraps: Tensor  # bool
    cue_element: Tensor  # which element of a vector shows it
    white: Tensor  # float64: brightness of the cue for the goal's reward
    noise_start: Tensor  # first row of the noise bank with the row's noise
    legacy: LegacyIndex | None = None
    taps: tuple[Tensor, Tensor] | None = None  # of `num_angles` rotations, see `rotation.compute_taps`


class RewardParams(NamedTuple):
    """What rewards and goals need of each row's task."""

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
    legacy_change: Tensor  # bool: the first goal lasts one episode less


class RowParams(NamedTuple):
    """All that stays between changes of tasks."""

    seed: Tensor  # int64 [1], or [N] for rows with their own seeds
    row: Tensor  # numbers of the rows
    tree: TreeParams
    x: ObservationParams
    g: RewardParams
    bank: Tensor  # uint8 [B, *shape]
    noise_bank: Tensor  # uint8 [B', *shape]; empty for separate noise in every observation
    normal_table: Tensor


class Uses(NamedTuple):
    """What a batch's rows use; the rest is not computed."""

    waits: bool = True  # p > 0
    unique_ids: bool = True
    drawn_ids: bool = True
    views: bool = True
    pixel_noise: bool = True
    noise_bank: int = 0  # how many noises an observation's is chosen from
    reward_noise: bool = True
    multiplicative: bool = True  # some of that noise is a share of the reward
    fail_reward: bool = True
    step_reward: bool = True
    reward_cue: bool = True
    goal_change: bool = True
    max_depth: int = 63
    reward_fns: tuple[RewardFn, ...] = ()

    @property
    def draws(self) -> bool:
        """Whether a tick needs random words."""
        return self.waits or self.drawn_ids or self.views
