"""Frames of one history as one: their losses add up, so that each is computed once.

Used on CPUs for batches with few histories, as without noise on reading.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor

from baselines.cells.cell import Cell
from baselines.parts.networks import HISTORY, Data, Items, TensorsByName
from ctgraph_rl.learn.histories import can_branch, distinct, renumber

FEWEST_FRAMES = 512
"""Frames of a minibatch up to which all are computed, as operations then cost more than frames."""

LARGEST_SHARE = 0.6
"""Share of different histories in a batch from which each frame is computed; of a cell, by its ``step_cost``."""

KIND = "kind"
"""Key of frames' numbers, int64, the same for those that `merge` makes one."""


def number_frames(trunk: Any, items: Items, num_minibatches: int) -> Items:
    """Return the numbers of frames by which `merge` and ``trunk.of_histories`` find equal ones.

    Args:
        trunk: has ``number_histories`` and ``of_histories``.
        items: its inputs, ``action``, ``action_log_prob`` and ``advantage`` of a batch, [rows, steps, ...] each.
        num_minibatches: parts of the batch.

    Returns:
        Keys for the items; empty where each frame is to be computed.
    """
    action = items["action"]
    if action.numel() <= FEWEST_FRAMES * num_minibatches or not can_branch(action):
        return {}
    numbers = trunk.number_histories(items)
    history = numbers[HISTORY]
    cells = [part for part in trunk.modules() if isinstance(part, Cell)]
    share = LARGEST_SHARE / max([1.0, *(cell.step_cost for cell in cells)])
    if int(history.max()) >= share * history.numel():
        return {}
    gains = items["advantage"].view_as(action) > 0
    taken = (history * (int(action.max()) + 1) + action) * 2 + gains
    _, kinds = distinct([taken.flatten(), items["action_log_prob"].flatten()])
    return {**numbers, KIND: kinds.view_as(action)}


def merged_outputs(policy: Any, trunk: Any, batch: Data) -> tuple[Data, TensorsByName]:
    """Return frames of a batch, all or one of each kind of `merge`, and the network's outputs at them."""
    if KIND not in batch:
        return batch, policy.outputs(batch)
    chosen, frames = merge(batch)
    features, histories = trunk.of_histories(batch)
    of_chosen = histories.index_select(0, chosen)
    outputs = policy.heads(features)  # float64 from here on, so that the gradients of a history cancel in it
    return frames, {key: value.double().index_select(0, of_chosen) for key, value in outputs.items()}


def merge(batch: Data) -> tuple[Tensor, Items]:
    """Merge frames of the same history, action, old log-probability and sign of advantage.

    They have one probability ratio and one value V. So their loss is n times that of their mean advantage. A critic's
    squares are n (V - m)^2 + S, with their mean target m and the squares S around it. Means are float64: V is near m
    when trained, and advantages cancel.

    Returns:
        A frame of each kind, int64 [num_kinds]; and its action, old log-probability, mean ``advantage`` and
        ``value_target``, ``count`` n, and ``spread``, the sum of S of all kinds by the number of frames.
    """
    chosen, kinds = renumber(batch[KIND].flatten())
    count = kinds.bincount().double()
    items: Items = {key: batch[key].flatten().index_select(0, chosen) for key in ("action", "action_log_prob")}
    target = batch["value_target"].flatten().double()
    mean_target = kinds.bincount(target) / count
    items["value_target"] = mean_target.unsqueeze(-1)
    items["advantage"] = (kinds.bincount(batch["advantage"].flatten().double()) / count).unsqueeze(-1)
    items["spread"] = (target - mean_target.index_select(0, kinds)).square().mean()
    items["count"] = count
    return chosen, items


def mean(values: Tensor, frames: Data) -> Tensor:
    """Return the mean of values over frames, weighted by their ``count``."""
    count = frames.get("count")
    return values.mean() if count is None else (values.flatten() * count).sum() / count.sum()
