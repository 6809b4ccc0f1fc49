"""Metrics of hidden units: how many are silent, and how many directions the others span.

They are measured on the different images of the present tasks, weighted equally, and on fresh images: a unit that is
zero on a task's few images may serve others.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils import parameters_to_vector

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


def unit_metrics(layers: LayersByName) -> dict[str, float]:
    """Return the metrics of hidden layers: of all units together, and under ``_LAYER`` of each; ranks of the last.

    - ``dormant_T``: units with a score of at most T: mean absolute activation over the mean of the layer's units (Sokar
      et al. 2023, arXiv 2302.12902).
    - ``dead``: units that are 0 in all rows.
    - ``rank_effective``: exp of the entropy of the singular values' shares (Roy and Vetterli 2007).
    - ``rank_srank``: singular values that make up 99 % of their sum (Kumar et al. 2021, arXiv 2010.14498).
    - ``rank_stable``: the sum of their squares over the largest square.

    All are shares: of units, or of the largest rank, min(n, H).

    Raises:
        ValueError: without a layer.
    """
    require((bool(layers), "metrics of units need a hidden layer, and the network has none"))
    found = []
    for values, share in layers.values():
        sizes = values.detach().double().abs().cpu().numpy()
        means = share.double().cpu().numpy() @ sizes
        scores = means / (means.mean() + 1e-9)
        found.append([*(scores <= threshold for threshold in THRESHOLDS), (sizes == 0).all(axis=0)])
    names = [*(f"dormant_{threshold:g}" for threshold in THRESHOLDS), "dead"]
    units = np.concatenate(found, axis=1)
    values, share = layers[[*layers][-1]]
    ranks = _ranks(values.detach().double() * share.double().sqrt().unsqueeze(1))
    measured = {**dict(zip(names, units.mean(axis=1).tolist(), strict=True)), **ranks}
    for layer, flags in zip(layers, found, strict=True):
        for name, flag in zip(names, flags, strict=True):
            measured[f"{name}_{layer}"] = float(flag.mean())
    return measured


def _ranks(rows: Tensor) -> dict[str, float]:
    products = rows.mT @ rows if len(rows) > rows.shape[1] else rows @ rows.mT  # faster than singular values of rows
    squares = torch.linalg.eigvalsh(products).cpu().numpy()[::-1]
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


def norms(agent: Agent, before: Tensor, measurements: Mapping[str, float]) -> dict[str, float]:
    """Return the Euclidean norms of all weights, of their change over a batch, and of its mean gradient.

    Args:
        before: the weights before the batch, by `weights_of`.
        measurements: of the batch; ``grad_norm`` is the norm before it is cut, a mean over gradient steps.
    """
    after = weights_of(agent)
    found = {"norm_weights": after.norm().item(), "norm_updates": (after - before).norm().item()}
    if "grad_norm" in measurements:
        found["norm_gradients"] = measurements["grad_norm"]
    return found


def weights_of(agent: Agent) -> Tensor:
    """Return a copy of the policy's weights, float32 [P]."""
    return parameters_to_vector(agent.policy.parameters()).detach()


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


def fresh_images(task: Task) -> Tensor | None:
    """Return `NUM_FRESH` images of the law of a task's, uint8 [n, *shape]; None for sets that are not drawn."""
    if not isinstance(task.images, PaperImages):
        return None
    return PaperImages(NUM_FRESH, FRESH_SEED, task.images.size).bank(0)


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
        self._images: tuple[int, dict[str, Tensor]] = (0, {})  # the last block's, by name
        self._shape = tuple(agent_specs(curriculum).observation["observation"].shape)

    def measure(self, block: int, frames: int, moment: str) -> None:
        """Append a line for the images of a block's tasks, and one for fresh images.

        Args:
            block: from 1.
            frames: of the run so far.
            moment: ``start``, ``during`` or ``end`` of the block, or ``batch``.
        """
        if self._images[0] != block:
            self._images = block, self._images_of(block)
        sets = self._images[1]
        both = torch.cat([*sets.values()])
        layers = self._activations(both, self.curriculum.blocks[block - 1].tasks[0])
        last = 0
        for name, images in sets.items():
            first, last = last, last + len(images)
            of_set = {}
            for layer, (values, share) in layers.items():
                rows = slice(first * len(values) // len(both), last * len(values) // len(both))
                of_set[layer] = values[rows], share[rows] / share[rows].sum()
            found: dict[str, Any] = {"num_images": len(images), **unit_metrics(of_set)}
            self.log.append("units", moment=moment, block=block, frames=frames, images=name, **found)

    def _images_of(self, block: int) -> dict[str, Tensor]:
        tasks: Any = [*dict.fromkeys(self.curriculum.blocks[block - 1].tasks)]
        fresh = fresh_images(tasks[0])
        own = torch.cat([task_images(task, self._shape) for task in tasks]).unique(dim=0)
        return {"task": own} if fresh is None else {"task": own, "fresh": fresh}

    @torch.no_grad()
    def _activations(self, images: Tensor, task: Any) -> LayersByName:
        data = ShownTask(task, self._shape, shown_id(self.curriculum, task)).data(images, True)
        device = next(self.agent.policy.parameters()).device
        data = {key: value.to(device) for key, value in data.items()}
        data |= self.agent.initial_state(len(images)).items()
        learner: Any = getattr(self.agent, "unwrapped", self.agent)
        return learner.activations(data)
