"""AMD: a predictive model for each label, and a chi-squared test of what it predicts.

Dick et al. 2020, Frontiers in Neurorobotics 14, 578675, after the equations, without their code. Our choices: a table
of frequencies as model, windows that do not overlap, two batches that decide, an untested start of a new model, and one
cluster of unclustered steps.
"""

from __future__ import annotations

import math
from functools import partial
from typing import cast

import torch
from torch import Tensor
from torch.nn.functional import one_hot
from typing_extensions import override

from baselines.detectors.detector import Detector
from baselines.detectors.seen import Seen, Verdict
from ctgraph_rl.checks import (
    NamedValues,
    ReadOnlyValues,
    at_least_one,
    fraction,
    is_int,
    one_of,
    positive,
    require,
    true_or_false,
)

DEGREES = ("published", "corrected")

IMPOSSIBLE = 1e-8
PENALTY = 10.0
"""Where E is tiny, PENALTY * O^2 is added in place of (O - E)^2 / E."""


class AMD(Detector):
    """Compares what is observed after each action with what the model of each label expects.

    The model of a label gives P(o | a), the probability of each observation after each action, given the last ``order``
    actions and observations of the episode: relative frequencies in the label's steps, with ``smoothing`` added to each
    count. The tables P of ``window`` steps are clustered by DBSCAN. With O the number of steps in which o followed a in
    a cluster, and E the sum over the cluster's steps with a of its mean P(o | a),

        X = sum (O - E)^2 / E,   p = P(chi^2 with k degrees of freedom > X)

    with k = n m (``published``), which accepts too often, or n (m - 1) (``corrected``), where n is the number of pairs
    of a cluster and an action in it, and m that of observations. The p-value of a batch is the smallest one of its W
    windows, times W. A label fits if that is at least ``threshold``. Where the present label does not fit, the next
    batch decides, as this one may mix two tasks: the label of the largest p-value is next, or a new one if none fits.

    Args:
        window: steps of a test.
        order: steps on which a prediction depends.
        smoothing: added to each count.
        radius: largest Euclidean distance of neighbours.
        min_neighbours: of the core of a cluster, itself included.
        threshold: least p-value of a label that fits.
        degrees: of freedom: published or corrected.
        keeps_fitting: the present label stays while it fits; False: the largest p-value decides.
        num_untested: steps of a new label before it is tested.
    """

    needs_episodes = True
    reads = "one-hot observations"
    needs = ("observation_id",)
    changing = ("label", "is_doubted", "pending", "recent", "last_action")

    def __init__(
        self,
        window: int,
        order: int,
        smoothing: float,
        radius: float,
        min_neighbours: int,
        threshold: float,
        degrees: str,
        keeps_fitting: bool,
        num_untested: int,
        max_labels: int,
    ) -> None:
        super().__init__(max_labels, patience=1, snapshot_every=None)
        require(
            *at_least_one(window=window, order=order, min_neighbours=min_neighbours),
            *positive(smoothing=smoothing, radius=radius),
            *fraction(threshold=threshold),
            *one_of(DEGREES, degrees=degrees),
            *true_or_false(keeps_fitting=keeps_fitting),
            (is_int(num_untested, 0), f"num_untested must be an integer >= 0, got {num_untested!r}"),
        )
        self.window = window
        self.order = order
        self.smoothing = smoothing
        self.radius = radius
        self.min_neighbours = min_neighbours
        self.threshold = threshold
        self.degrees = degrees
        self.keeps_fitting = keeps_fitting
        self.num_untested = num_untested
        self.label = 0
        self.is_doubted = False

    @override
    def setup(self, num_rows: int, num_steps: int, num_actions: int, num_observations: int | None) -> None:
        message = "AMD needs one-hot observations, and these are images: take one-hot tasks, or another detector"
        require((num_observations is not None, message))
        self.num_actions = num_actions
        self.num_observations = num_observations or 0
        self.num_outcomes = num_actions * self.num_observations
        longest = int(63 / math.log2(self.num_outcomes + 1)) - 1
        rule = f"order must be at most {longest} with {num_actions} actions and {num_observations} observations"
        require((self.order <= longest, f"{rule}, got {self.order}"))
        integers = partial(torch.zeros, dtype=torch.int64, device="cpu")
        self.models: dict[int, Counts] = {0: Counts()}

        self.recent = integers(num_rows, self.order - 1)
        """The last pairs of action and next observation of each row's episode, from 1; 0: none."""

        self.last_action = integers(num_rows)

        self.pending = integers(0, 3)
        """History, action and next observation of the steps after the last window."""

    def observe(self, seen: Seen) -> Verdict:
        """Test every full window; learn from the batch if the label stays."""
        new = self.triples(seen)
        steps = torch.cat([self.pending, new])
        full = len(steps) // self.window * self.window
        self.pending = steps[full:].clone()
        label = self._fit_label(steps[:full].view(-1, self.window, 3)) if full else self.label
        if label == self.label:
            self.is_doubted = False
            self._learn(new)
        elif self.is_doubted:
            return label
        else:
            self.is_doubted = True
            self.pending = self.pending[:0]
        return None

    def start_label(self, label: int, trial: bool) -> None:
        """Begin a model if the label is new, and forget the steps outside windows."""
        self.label = label
        self.is_doubted = False
        self.pending = self.pending[:0]
        self.models.setdefault(label, Counts())

    def triples(self, seen: Seen) -> Tensor:
        """Return history, action and next observation of each step, row after row, int64 [N, 3]."""
        action = seen.action
        before = torch.cat([self.last_action.unsqueeze(1), action[:, :-1]], dim=1)
        pairs = torch.where(seen.is_init, 0, before) * self.num_observations + cast(Tensor, seen.observation_id) + 1
        begins = torch.cat([torch.zeros_like(self.recent, dtype=torch.bool), seen.is_init], dim=1)
        lags = [torch.cat([self.recent, pairs], dim=1)]
        for _ in range(1, self.order):
            earlier = torch.cat([torch.zeros_like(lags[-1][:, :1]), lags[-1][:, :-1]], dim=1)
            lags.append(torch.where(begins, 0, earlier))
        history = sum(each * (self.num_outcomes + 1) ** lag for lag, each in enumerate(lags))[:, self.order - 1 :]
        self.last_action = action[:, -1].clone()
        self.recent = torch.stack([each[:, -1] for each in reversed(lags)], dim=1)[:, 1:]
        steps = [history, action, cast(Tensor, seen.next_observation_id)]
        return torch.stack(steps, dim=-1).flatten(0, 1)

    def _learn(self, steps: Tensor) -> None:
        history, action, following = steps.unbind(1)
        self.models[self.label].add(history * self.num_outcomes + action * self.num_observations + following)

    def _fit_label(self, windows: Tensor) -> int:
        """Return the label that fits windows of steps, int64 [W, window, 3], by its smallest p-value times W."""
        if self.models[self.label].total < self.num_untested:
            return self.label
        smallest = [float(self.p_values(label, windows).min()) for label in range(len(self.models))]
        return self._label_for([min(1.0, len(windows) * p_value) for p_value in smallest])

    def _label_for(self, p_values: list[float]) -> int:
        present = p_values[self.label]
        best = max(p_values)
        if present == best or (self.keeps_fitting and present >= self.threshold):
            return self.label if present >= self.threshold or self._is_full else len(p_values)
        return p_values.index(best) if best >= self.threshold or self._is_full else len(p_values)

    @property
    def _is_full(self) -> bool:
        return len(self.models) == self.max_labels

    def p_values(self, label: int, windows: Tensor) -> Tensor:
        """Return a label's p-value in each window of steps, int64 [W, window, 3]: float64 [W]."""
        history, action, following = windows.unbind(-1)
        outcomes = history.unsqueeze(-1) * self.num_outcomes + torch.arange(self.num_outcomes, device="cpu")
        counts = self.models[label].of(outcomes).double() + self.smoothing
        counts = counts.unflatten(-1, (self.num_actions, self.num_observations))
        predicted = counts / counts.sum(dim=-1, keepdim=True)  # P(o | a), float64 [..., actions, observations]
        found = clusters(predicted.flatten(2), self.radius, self.min_neighbours)
        groups = one_hot(found + 1, self.window + 1).double()
        means = torch.einsum("wtc,wtao->wcao", groups, predicted) / groups.sum(1).clamp(min=1)[..., None, None]
        taken = torch.einsum("wtc,wta->wtca", groups, one_hot(action, self.num_actions).double())
        expected = means * taken.sum(dim=1).unsqueeze(-1)
        observed = torch.einsum("wtca,wto->wcao", taken, one_hot(following, self.num_observations).double())
        pairs = (taken.sum(dim=1) > 0).sum(dim=(1, 2))
        degrees = pairs * (self.num_observations - (self.degrees == "corrected"))
        return chi_squared_tail(statistic(observed, expected), degrees)

    @override
    def state_dict(self) -> NamedValues:
        models = {label: (model.keys, model.counts) for label, model in self.models.items()}
        return {**super().state_dict(), "models": models}

    @override
    def load_state_dict(self, state: ReadOnlyValues) -> None:
        super().load_state_dict(state)
        self.models = {label: Counts(*model) for label, model in state["models"].items()}


class Counts:
    """Counts of numbers; those that never occurred take no memory.

    Args:
        keys: the numbers in rising order, int64 [n]; None: none.
        counts: of each, int64 [n].
    """

    def __init__(self, keys: Tensor | None = None, counts: Tensor | None = None) -> None:
        empty = torch.zeros(0, dtype=torch.int64, device="cpu")
        self.keys = empty if keys is None else keys
        self.counts = empty if counts is None else counts

    @property
    def total(self) -> int:
        """Of all counts."""
        return int(self.counts.sum())

    def add(self, numbers: Tensor) -> None:
        """Count numbers, int64 [N]."""
        weights = torch.cat([self.counts, torch.ones_like(numbers)])
        self.keys, places = torch.cat([self.keys, numbers]).unique(return_inverse=True)
        self.counts = torch.zeros_like(self.keys).index_add(0, places, weights)

    def of(self, numbers: Tensor) -> Tensor:
        """Return the counts of numbers, int64 [...]."""
        if not len(self.keys):
            return torch.zeros_like(numbers)
        places = torch.searchsorted(self.keys, numbers).clamp(max=len(self.keys) - 1)
        return torch.where(self.keys[places] == numbers, self.counts[places], 0)


def statistic(observed: Tensor, expected: Tensor) -> Tensor:
    """Return the sum of (O - E)^2 / E over all but the first dimension; 10 O^2 where E is below 1e-8."""
    terms = torch.where(expected < IMPOSSIBLE, PENALTY * observed**2, (observed - expected) ** 2 / expected)
    return terms.flatten(1).sum(dim=1)


def chi_squared_tail(statistics: Tensor, degrees: Tensor) -> Tensor:
    """Return the probability that a chi-squared variable is larger, float64 [...]."""
    return torch.special.gammaincc(degrees.double() / 2, statistics.double() / 2)


def clusters(points: Tensor, radius: float, min_neighbours: int) -> Tensor:
    """Cluster points by DBSCAN: cores within the radius of each other, and points within the radius of a core.

    A core has at least ``min_neighbours`` points within the radius, itself included. A point near several clusters
    joins the one whose first core comes first.

    Args:
        points: float [..., N, n].
        radius: largest Euclidean distance of neighbours.
        min_neighbours: of a core.

    Returns:
        int64 [..., N]: the place of the first core of a point's cluster, or -1.
    """
    number = points.shape[-2]
    near = torch.cdist(points, points, compute_mode="donot_use_mm_for_euclid_dist") <= radius
    core = near.sum(dim=-1) >= min_neighbours
    firsts = torch.where(core, torch.arange(number, device="cpu"), number)
    joined = near & core.unsqueeze(-2)
    for _ in range(number):
        spread = torch.where(joined, firsts.unsqueeze(-2), number).amin(dim=-1)
        following = torch.where(core, torch.minimum(firsts, spread), number)
        if torch.equal(following, firsts):
            break
        firsts = following
    found = torch.where(joined, firsts.unsqueeze(-2), number).amin(dim=-1)
    return torch.where(found < number, found, -1)
