"""Metrics of hidden units: how many are silent, and how many directions the others span.

They are measured on the different images of the present tasks, weighted equally, and on fresh images: a unit that is
zero on a task's few images may serve others.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ctgraph_rl.agent import Agent
from ctgraph_rl.checks import Rule, require
from ctgraph_rl.core.graph import StateType
from ctgraph_rl.learn.collect import agent_specs
from ctgraph_rl.learn.exact import ShownTask, shown_id
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.images import PaperImages
from ctgraph_rl.tasks.task import Task, are_graphs

THRESHOLDS = (0, 0.025, 0.1)
"""Largest scores of dormant units."""

NUM_FRESH = 256

FRESH_SEED = 2**62 - 1

ROUNDING = 1e-13
"""Squares of singular values up to this share of the largest are 0; activations have 24 bits."""

EACH_BATCH = "batch"
"""Of ``log_units``: measure after each batch, too; True: at starts, ends and evaluations of blocks."""

LayersByName = Mapping[str, tuple[Tensor, Tensor]]
"""By layer, from the inputs to the heads: float [n, H], and each row's share of all, [n]."""


def unit_metrics(layers: LayersByName, *, complete: bool = False) -> dict[str, float]:
    """Return the metrics of hidden layers: of all units together, and under ``_LAYER`` of each; ranks of the last.

    - ``dormant_T``: units with a score of at most T: mean absolute activation over the mean of the layer's units (Sokar
      et al. 2023, arXiv 2302.12902).
    - ``dead``: units that are 0 in all rows.
    - ``rank_effective``: exp of the entropy of the singular values' shares (Roy and Vetterli 2007).
    - ``rank_srank``: singular values that make up 99 % of their sum (Kumar et al. 2021, arXiv 2010.14498).
    - ``rank_stable``: the sum of their squares over the largest square.

    All are shares: of units, or of the largest rank, min(n, H).

    Args:
        complete: whether the rows are all that there are, so that few of them bound the rank in truth.

    Raises:
        ValueError: without a layer; for fewer rows than the last layer has units, unless they are all.
    """
    require((bool(layers), "metrics of units need a hidden layer, and the network has none"))
    last, of_last = layers[[*layers][-1]]
    least = f"a rank needs at least as many observations as units, {last.shape[1]}, got {len(last)}: show more"
    require((complete or len(last) >= last.shape[1], least))
    measured = _ranks(last.detach().cpu().numpy() * np.sqrt(of_last.cpu().numpy(), dtype=np.float64)[:, None])
    counts = {"": np.zeros(len(THRESHOLDS) + 1)}  # of dormant units and of all, by layer
    for layer, (values, share) in layers.items():
        means = share.cpu().numpy() @ values.detach().abs().cpu().numpy()
        scores = means / (means.sum() / len(means) + 1e-9)
        dormant = [np.count_nonzero(scores <= threshold) for threshold in THRESHOLDS]
        counts[f"_{layer}"] = np.array([*dormant, len(means)])
        counts[""] += counts[f"_{layer}"]
    for suffix, count in counts.items():
        shares = (count / count[-1]).tolist()
        for threshold, dormant in zip(THRESHOLDS, shares[:-1], strict=True):
            measured[f"dormant_{threshold:g}{suffix}"] = dormant
        measured[f"dead{suffix}"] = shares[0]
    return measured


def _ranks(rows: np.ndarray) -> dict[str, float]:
    products = rows.T @ rows if len(rows) > rows.shape[1] else rows @ rows.T  # faster than singular values of rows
    squares = np.linalg.eigvalsh(products)[::-1]
    if squares[0] <= 0:
        return dict.fromkeys(("rank_effective", "rank_srank", "rank_stable"), 0.0)
    squares = np.where(squares > ROUNDING * squares[0], squares, 0.0)
    shares = np.sqrt(squares)
    shares /= shares.sum()
    some = shares[shares > 0]
    within = int((shares.cumsum() < 0.99 - 1e-12).sum())  # as sums of shares round
    most = len(shares)
    return {
        "rank_effective": math.exp(-float(some @ np.log(some))) / most,
        "rank_srank": (within + 1) / most,
        "rank_stable": float(squares.sum() / squares[0]) / most,
    }


def norms(weights: Sequence[Tensor], before: Tensor, measurements: Mapping[str, float]) -> dict[str, float]:
    """Return the Euclidean norms of all weights, of their change over a batch, and of its mean gradient.

    Args:
        weights: the policy's.
        before: those before the batch, by `flat_copy`.
        measurements: of the batch; ``grad_norm`` is the norm before it is cut, a mean over gradient steps.
    """
    after = flat_copy(weights)
    found = {"norm_weights": after.norm().item(), "norm_updates": (after - before).norm().item()}
    if "grad_norm" in measurements:
        found["norm_gradients"] = measurements["grad_norm"]
    return found


@torch.no_grad()
def flat_copy(weights: Sequence[Tensor]) -> Tensor:
    """Return a copy of weights, one after the other, float32 [P]."""
    return torch.cat([weight.flatten() for weight in weights])


def task_images(task: Task, shape: tuple[int, ...]) -> Tensor:
    """Return the images of a task's states, padded to ``shape``, uint8 [n, *shape]."""
    views = task.images.num_variants * (task.observations.read_rotation + 1)
    ids: dict[int, None] = {}
    for kind in StateType:
        first, last = task.observations.ids(kind)
        ids |= dict.fromkeys(range(first, last + 1))
    places = torch.tensor([*ids], dtype=torch.int64, device="cpu").unsqueeze(1)
    rows = (places * views + torch.arange(views, device="cpu")).flatten()
    return ShownTask(task, shape, None).bank.index_select(0, rows)


def fresh_images(task: Task, num_units: int) -> Tensor | None:
    """Return images of the law of a task's, uint8 [n, *shape]; None for sets that are not drawn.

    There are `NUM_FRESH`, or as many as units, whose rank they would bound.
    """
    if not isinstance(task.images, PaperImages):
        return None
    return PaperImages(max(NUM_FRESH, num_units), FRESH_SEED, task.images.size).bank(0)


def unit_rules(curriculum: Curriculum, agent: Agent, when: bool | str) -> Iterator[Rule]:
    """Yield what ``log_units`` requires: True, `EACH_BATCH`, or False, which measures nothing."""
    if when is False:
        return
    named = when is True or when == EACH_BATCH
    yield named, f"log_units must be True, False or {EACH_BATCH!r}, got {when!r}"
    off = "set log_units=false"
    kind = type(curriculum.examples[0]).__name__
    yield are_graphs(curriculum.examples), f"log_units needs CT-graphs, whose images are known, got {kind}: {off}"
    learner = getattr(agent, "unwrapped", agent)
    name = type(learner).__name__
    known = hasattr(learner, "activations") and getattr(learner, "tells_units", True)
    yield known, f"log_units needs an agent that tells its hidden units, which {name} does not: {off}"


class UnitMeter:
    """Measures an agent's units in a run, and appends them to its log as lines ``units``.

    Args:
        when: True or `EACH_BATCH`.

    Raises:
        ValueError: for tasks without known images, and agents without known hidden units.
    """

    def __init__(self, curriculum: Curriculum, agent: Agent, log: RunLog, when: bool | str) -> None:
        require(*unit_rules(curriculum, agent, when))
        self.curriculum = curriculum
        self.agent = agent
        self.log = log
        self.each_batch = when == EACH_BATCH
        self._block = 0  # whose images are shown
        self._num_units = 0  # of the last layer, once it is known
        self._shape = tuple(agent_specs(curriculum).observation["observation"].shape)

    def measure(self, block: int, frames: int, moment: str) -> None:
        """Append a line for the images of a block's tasks, and one for fresh images.

        Args:
            block: from 1.
            frames: of the run so far.
            moment: ``start``, ``during`` or ``end`` of the block, or ``batch``.
        """
        if self._block != block:
            self._block = block
            self._show(block)
        layers = self._activations()
        last = 0
        for name, count in self._counts.items():
            first, last = last, last + count
            of_set = {}
            for layer, values in layers.items():
                positions = len(values) // sum(self._counts.values())
                rows = values[first * positions : last * positions]
                of_set[layer] = rows, rows.new_full([len(rows)], 1 / len(rows))
            found = unit_metrics(of_set, complete=name == "task")
            self.log.append("units", moment=moment, block=block, frames=frames, images=name, num_images=count, **found)

    def _show(self, block: int) -> None:
        tasks: Any = [*dict.fromkeys(self.curriculum.blocks[block - 1].tasks)]
        device = next(self.agent.policy.parameters()).device
        shown = ShownTask(tasks[0], self._shape, shown_id(self.curriculum, tasks[0]))
        sets = {"task": torch.cat([task_images(task, self._shape) for task in tasks]).unique(dim=0)}
        if not self._num_units:
            self._data = {key: value.to(device) for key, value in shown.data(sets["task"], True).items()}
            [*_, last] = self._activations().values()
            self._num_units = last.shape[1]
        fresh = fresh_images(tasks[0], self._num_units)
        if fresh is not None:
            sets["fresh"] = fresh
        self._counts = {name: len(images) for name, images in sets.items()}
        every = shown.data(torch.cat([*sets.values()]), True)
        self._data = {key: value.to(device) for key, value in every.items()}

    def _activations(self) -> dict[str, Tensor]:
        """Return the activations at all images shown, by layer."""
        state = self.agent.initial_state(len(self._data["observation"]))
        learner: Any = getattr(self.agent, "unwrapped", self.agent)
        found = learner.activations({**self._data, **dict(state.items())})
        return {layer: values for layer, (values, _) in found.items()}
