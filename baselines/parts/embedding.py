"""Embeddings of tasks: a sample of transitions as one vector.

Linear Wasserstein embedding (Kolouri et al. 2021, arXiv 2006.09430), on transitions in place of labelled data
(Liu et al. 2022, arXiv 2208.11726); sliced Wasserstein embedding, with sorted projections in place of the plan. N are
samples, n coordinates of each, M reference points, L directions.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import normalize, one_hot

from baselines.parts.transport import optimal_plan

REFERENCE_SEED = 98
"""Of reference points and directions: embeddings are comparable if they share these."""


def transitions(observation: Tensor, action: Tensor, reward: Tensor, num_actions: int) -> Tensor:
    """Return transitions as points: standardised observation, one-hot action, reward.

    One mean and one standard deviation over all pixels of the sample standardise the observations.

    Args:
        observation: [N, ...], of any number type.
        action: int64 [N], in [0, num_actions).
        reward: [N].
        num_actions: of the environment.

    Returns:
        float32 [N, n], n = pixels + num_actions + 1.
    """
    pixels = observation.flatten(1).float()
    deviation = pixels.std(correction=0)
    pixels = (pixels - pixels.mean()) / torch.where(deviation > 0, deviation, 1.0)
    return torch.cat([pixels, one_hot(action, num_actions).float(), reward.float().unsqueeze(1)], dim=1)


def with_last(recent: Mapping[str, Tensor], batch: TensorDictBase, most: int) -> dict[str, Tensor]:
    """Return the last transitions of ``recent`` and of a batch behind them, row after row, [n, ...] each."""
    given = {"observation": batch["observation"], "action": batch["action"], "reward": batch["next", "reward"]}
    found = {}
    for key, values in given.items():
        new = values.flatten(0, 1).cpu()
        found[key] = torch.cat([recent.get(key, new[:0]), new])[-most:].clone()
    return found


def sampled_points(recent: Mapping[str, Tensor], number: int, num_actions: int, generator: torch.Generator) -> Tensor:
    """Draw some of what `with_last` returned, without replacement, as points; see `transitions`."""
    drawn = torch.randperm(len(recent["action"]), generator=generator, device="cpu")[:number]
    reward = recent["reward"][drawn].squeeze(-1)
    return transitions(recent["observation"][drawn], recent["action"][drawn], reward, num_actions)


def reference_points(number: int, width: int, seed: int = REFERENCE_SEED) -> Tensor:
    """Return points drawn uniformly from [0, 1)^n, float32 [M, n]; the same for equal arguments."""
    generator = torch.Generator(device="cpu").manual_seed(seed)
    return torch.rand(number, width, generator=generator, dtype=torch.float32, device="cpu")


def unit_directions(number: int, width: int, seed: int = REFERENCE_SEED) -> Tensor:
    """Return directions drawn uniformly from the unit sphere, float32 [L, n]; the same for equal arguments."""
    generator = torch.Generator(device="cpu").manual_seed(seed)
    return normalize(torch.randn(number, width, generator=generator, dtype=torch.float32, device="cpu"), dim=1)


def linear_wasserstein(points: Tensor, reference: Tensor) -> Tensor:
    """Return the linear Wasserstein embedding of points.

    f_i = (M sum_j gamma_ji x_j - R_i) / sqrt(M), with the optimal plan gamma for squared Euclidean distances between
    N points x and M reference points R of equal masses. Where the plan splits no R_i, its norm is the 2-Wasserstein
    distance. Equal points are merged first: the embedding stays the same, and the plan takes a fraction of the time.

    Args:
        points: float32 [N, n].
        reference: float32 [M, n].

    Returns:
        float32 [M * n].
    """
    distinct, counts = points.cpu().double().unique(dim=0, return_counts=True)
    targets = reference.cpu().double()
    number = len(reference)
    cost = (targets.square().sum(1, keepdim=True) - 2 * targets @ distinct.T + distinct.square().sum(1)).numpy()
    plan = optimal_plan(cost, np.full(number, len(points)), (number * counts).numpy())
    means = torch.from_numpy(plan).double() @ distinct / len(points)
    return ((means - targets) / math.sqrt(number)).flatten().to(points)


def sliced_wasserstein(points: Tensor, directions: Tensor, num_quantiles: int) -> Tensor:
    """Return the sliced Wasserstein embedding of points, of norm 1.

    Along each direction these are the quantiles of the projections at equally spaced levels from 0 to 1, with linear
    interpolation, divided by sqrt(L * num_quantiles), and then all by their norm.

    Args:
        points: float32 [N, n].
        directions: float32 [L, n], of norm 1.
        num_quantiles: at least 2.

    Returns:
        float32 [L * num_quantiles]; zeros where all points are 0.
    """
    levels = torch.linspace(0, 1, num_quantiles, dtype=points.dtype, device=points.device)
    quantiles = (points @ directions.T).quantile(levels, dim=0)
    return normalize(quantiles.T.flatten() / math.sqrt(quantiles.numel()), dim=0)


def sliced_distances(samples: Tensor, other: Tensor, directions: Tensor) -> Tensor:
    """Compute sliced 2-Wasserstein distances of several samples from one, all of N points.

    Its square is the mean over the directions of the squared 2-Wasserstein distance of the projections, which is the
    mean squared difference of the sorted projections. A sample that is moved by c has the distance sqrt(mean((D c)^2)).

    Args:
        samples: float [..., N, n].
        other: float [N, n].
        directions: D, float [L, n], of norm 1.

    Returns:
        float [...].
    """
    moved = _sorted_projections(samples, directions) - _sorted_projections(other, directions)
    return moved.square().mean(dim=(-2, -1)).sqrt()


def _sorted_projections(samples: Tensor, directions: Tensor) -> Tensor:
    """Return the projections of points [..., N, n] on directions [L, n] in rising order, [..., L, N].

    NumPy sorts them, which takes a twentieth of PyTorch's time.
    """
    return torch.from_numpy(np.sort((directions @ samples.mT).cpu().numpy())).to(samples.device)
