"""Embeddings of tasks: a sample of transitions as one vector.

Linear Wasserstein embedding (Kolouri et al. 2021, arXiv 2006.09430), on transitions in place of labelled data (Liu et
al. 2022, arXiv 2208.11726); sliced Wasserstein embedding, with sorted projections in place of the plan. N samples have
n coordinates; M are reference points, L directions.
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
"""Embeddings are comparable if they share reference points and directions."""


def transitions(observation: Tensor, action: Tensor, reward: Tensor, num_actions: int) -> Tensor:
    """Return transitions as points: standardised observation, one-hot action, reward.

    Observations are standardised by one mean and deviation over all pixels of the sample.

    Args:
        observation: [N, ...], of any number type.
        action: int64 [N], in [0, num_actions).
        reward: [N].

    Returns:
        float32 [N, n], n = pixels + num_actions + 1.
    """
    pixels = observation.flatten(1).float()
    centred = pixels - pixels.mean()
    deviation = pixels.std(correction=0)
    standardised = centred / torch.where(deviation > 0, deviation, 1.0)
    actions = one_hot(action, num_actions).float()
    return torch.cat([standardised, actions, reward.float().unsqueeze(1)], dim=1)


def with_last(recent: Mapping[str, Tensor], batch: TensorDictBase, most: int) -> dict[str, Tensor]:
    """Return the last transitions of ``recent`` and then a batch, row after row, [n, ...] each."""
    given = {"observation": batch["observation"], "action": batch["action"], "reward": batch["next", "reward"]}
    found = {}
    for key, values in given.items():
        new = values.flatten(0, 1).cpu()
        found[key] = torch.cat([recent.get(key, new[:0]), new])[-most:].clone()
    return found


def sampled_points(recent: Mapping[str, Tensor], number: int, num_actions: int, generator: torch.Generator) -> Tensor:
    """Draw some results of `with_last` without replacement, as points of `transitions`."""
    order = torch.randperm(len(recent["action"]), generator=generator, device="cpu")
    drawn = order[:number]
    reward = recent["reward"][drawn].squeeze(-1)
    return transitions(recent["observation"][drawn], recent["action"][drawn], reward, num_actions)


def reference_points(number: int, width: int) -> Tensor:
    """Return uniform points from [0, 1)^n, float32 [M, n], fixed by the arguments."""
    generator = torch.Generator(device="cpu").manual_seed(REFERENCE_SEED)
    return torch.rand(number, width, generator=generator, dtype=torch.float32, device="cpu")


def unit_directions(number: int, width: int) -> Tensor:
    """Return uniform directions from the unit sphere, float32 [L, n], fixed by the arguments."""
    generator = torch.Generator(device="cpu").manual_seed(REFERENCE_SEED)
    directions = torch.randn(number, width, generator=generator, dtype=torch.float32, device="cpu")
    return normalize(directions, dim=1)


def linear_wasserstein(points: Tensor, reference: Tensor) -> Tensor:
    """Return the linear Wasserstein embedding of points, float32 [M * n].

    f_i = (M sum_j gamma_ji x_j - R_i) / sqrt(M), with the optimal plan gamma for squared Euclidean distances between N
    points x and M reference points R of equal masses. Where the plan splits no R_i, its norm is the 2-Wasserstein
    distance. Equal points are merged first, which is faster and changes nothing.

    Args:
        points: float32 [N, n].
        reference: float32 [M, n].
    """
    x, counts = points.cpu().double().unique(dim=0, return_counts=True)
    r = reference.cpu().double()
    number = len(reference)
    squares = r.square().sum(1, keepdim=True)
    cost = squares - 2 * r @ x.T + x.square().sum(1)
    mass = np.full(number, len(points))
    plan = optimal_plan(cost.numpy(), mass, (number * counts).numpy())
    means = torch.from_numpy(plan).double() @ x / len(points)
    return ((means - r) / math.sqrt(number)).flatten().to(points)


def sliced_wasserstein(points: Tensor, directions: Tensor, num_quantiles: int) -> Tensor:
    """Return the sliced Wasserstein embedding of points, of norm 1, float32 [L * num_quantiles].

    It holds quantiles of the projections on each direction, at equally spaced levels from 0 to 1 with linear
    interpolation, divided by sqrt(L * num_quantiles) and then by their norm. It is zero where all points are 0.

    Args:
        points: float32 [N, n].
        directions: float32 [L, n], of norm 1.
        num_quantiles: at least 2.
    """
    levels = torch.linspace(0, 1, num_quantiles, dtype=points.dtype, device=points.device)
    quantiles = (points @ directions.T).quantile(levels, dim=0)
    return normalize(quantiles.T.flatten() / math.sqrt(quantiles.numel()), dim=0)


def sliced_distances(samples: Tensor, other: Tensor, directions: Tensor) -> Tensor:
    """Return sliced 2-Wasserstein distances of several samples from one, float [...].

    Its square is the mean over directions of the mean squared difference of the sorted projections. A sample that is
    moved by c has the distance sqrt(mean((D c)^2)).

    Args:
        samples: float [..., N, n].
        other: float [N, n].
        directions: D, float [L, n], of norm 1.
    """
    differences = _sorted_projections(samples, directions) - _sorted_projections(other, directions)
    return differences.square().mean(dim=(-2, -1)).sqrt()


def _sorted_projections(samples: Tensor, directions: Tensor) -> Tensor:
    """Return projections of points [..., N, n] on directions [L, n] in rising order, [..., L, N].

    NumPy sorts in a twentieth of PyTorch's time.
    """
    projections = directions @ samples.mT
    in_order = np.sort(projections.cpu().numpy())
    return torch.from_numpy(in_order).to(samples.device)
