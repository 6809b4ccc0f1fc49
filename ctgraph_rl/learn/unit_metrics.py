"""Metrics of hidden units: how many are silent, and how many directions the others span.

They are measured on the different images of the present tasks, weighted equally, and on fresh images: a unit that is
zero on a task's few images may serve others.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

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

EACH_BATCH = "batch"
"""Of ``log_units``: measure after each batch, too; True: at starts, ends and evaluations of blocks."""

LayersByName = Mapping[str, tuple[Tensor, Tensor]]
"""By layer, from the inputs to the heads: float [n, H], and each row's share of all, [n]."""


def unit_metrics(layers: LayersByName) -> dict[str, float]:
    """Return the metrics of layers, of all units together, and under ``_LAYER`` of each.

    - ``dormant_T``: units with a score of at most T: mean absolute activation over the mean of the layer's units (Sokar
      et al. 2023, arXiv 2302.12902).
    - ``dead``: units that are 0 in all rows.
    - ``rank_effective``: exp of the entropy of the singular values' shares (Roy and Vetterli 2007).
    - ``rank_srank``: singular values that make up 99 % of their sum (Kumar et al. 2021, arXiv 2010.14498).
    - ``rank_stable``: the sum of their squares over the largest square.

    All are shares: of units, or of the largest rank, min(n, H). Without ``_LAYER`` ranks are those of the last layer.

    Raises:
        ValueError: without a layer.
    """
    require((bool(layers), "metrics of units need a hidden layer, and the network has none"))
    flags: dict[str, list[Tensor]] = {}
    measured = {}
    ranks: dict[str, float] = {}
    for layer, (values, share) in layers.items():
        sizes = values.detach().double().abs()
        weights = share.detach().double()
        means = weights @ sizes
        scores = means / (means.mean() + 1e-9)
        silent = {f"dormant_{threshold:g}": scores <= threshold for threshold in THRESHOLDS}
        silent["dead"] = (sizes == 0).all(dim=0)
        for name, units in silent.items():
            flags.setdefault(name, []).append(units)
            measured[f"{name}_{layer}"] = units.double().mean().item()
        ranks = _ranks(values.detach().double() * weights.sqrt().unsqueeze(1))
        for name, value in ranks.items():
            measured[f"{name}_{layer}"] = value
    of_all = {name: torch.cat(units).double().mean().item() for name, units in flags.items()}
    return {**of_all, **ranks, **measured}


def _ranks(rows: Tensor) -> dict[str, float]:
    sigma = torch.linalg.svdvals(rows)
    total = sigma.sum()
    if total == 0:
        return dict.fromkeys(("rank_effective", "rank_srank", "rank_stable"), 0.0)
    shares = sigma / total
    entropy = torch.special.entr(shares).sum().item()
    within = (shares.cumsum(0) < 0.99 - 1e-12).sum().item()  # as sums of shares round
    stable = (sigma.square().sum() / sigma[0].square()).item()
    most = len(sigma)
    return {
        "rank_effective": math.exp(entropy) / most,
        "rank_srank": (within + 1) / most,
        "rank_stable": stable / most,
    }


def norms(agent: Agent, before: list[Tensor], measurements: Mapping[str, float]) -> dict[str, float]:
    """Return the Euclidean norms of all weights, of their change over a batch, and of its mean gradient.

    Args:
        before: copies of the weights before the batch, by `weights_of`.
        measurements: of the batch; ``grad_norm`` is the norm before it is cut, a mean over gradient steps.
    """
    after = weights_of(agent)
    changes = torch._foreach_sub(after, before)
    found = {"norm_weights": _norm(after), "norm_updates": _norm(changes)}
    if "grad_norm" in measurements:
        found["norm_gradients"] = measurements["grad_norm"]
    return found


def weights_of(agent: Agent) -> list[Tensor]:
    """Return copies of the policy's weights."""
    return [parameter.detach().clone() for parameter in agent.policy.parameters()]


def _norm(tensors: Sequence[Tensor]) -> float:
    return torch.stack(torch._foreach_norm(list(tensors))).norm().item()


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
        self._shape = tuple(agent_specs(curriculum).observation["observation"].shape)

    def measure(self, block: int, frames: int, moment: str) -> None:
        """Append a line for the images of a block's tasks, and one for fresh images.

        Args:
            block: from 1.
            frames: of the run so far.
            moment: ``start``, ``during`` or ``end`` of the block, or ``batch``.
        """
        tasks = [task for task in dict.fromkeys(self.curriculum.blocks[block - 1].tasks) if isinstance(task, Task)]
        own = torch.cat([task_images(task, self._shape) for task in tasks]).unique(dim=0)
        for name, images in (("task", own), ("fresh", fresh_images(tasks[0]))):
            if images is not None:
                found = unit_metrics(self._activations(images, tasks[0]))
                values: dict[str, Any] = {"num_images": len(images), **found}
                self.log.append("units", moment=moment, block=block, frames=frames, images=name, **values)

    @torch.no_grad()
    def _activations(self, images: Tensor, task: Task) -> LayersByName:
        data = ShownTask(task, self._shape, shown_id(self.curriculum, task)).data(images, True)
        device = next(self.agent.policy.parameters()).device
        data = {key: value.to(device) for key, value in data.items()}
        data |= self.agent.initial_state(len(images)).items()
        learner: Any = getattr(self.agent, "unwrapped", self.agent)
        return learner.activations(data)
