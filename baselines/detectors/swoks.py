"""SWOKS: sliced Wasserstein distances from the past, and a test whether they have grown.

Dick et al. 2024 (CoLLAs), arXiv 2405.19047, after the equations, without their code. Our choices: the use of a trial's
samples, what a label keeps, and how often a sample is new.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, cast

import torch
from torch import Tensor
from typing_extensions import override

from baselines.detectors.detector import Detector
from baselines.detectors.seen import SUSPICION, Seen, Verdict
from baselines.detectors.two_sample import MOST_VALUES, ks_greater
from baselines.parts.embedding import sliced_distances, unit_directions
from ctgraph_rl.checks import at_least_one, fraction, is_int, positive, require

WINDOWS_BEFORE = 3


class SWOKS(Detector):
    """Suspects a change where the newest steps are further from the label's earlier ones than they were.

    A step is the point u = (action, sqrt(F) reward, features [F]). After every ``window`` points their sliced
    2-Wasserstein distance from each label's reference is measured. The present label's reference is the oldest of its
    last ``num_windows`` + 1 windows, the others' is the one that they left with. After ``stable_phase`` points of a
    label, a one-sided Kolmogorov-Smirnov test compares the last ``num_tested`` distances with the earlier ones, times
    ``adjustment``. A p-value below ``alpha`` is a suspicion. The label then keeps its reference, and its distances but
    the last ``num_left_out``.

    A label on trial is accepted as soon as the same test of its distances has a p-value above ``accept``. Points of a
    trial enter no reference. An accepted label starts with an empty history.

    Args:
        window: points between two tests (L_D).
        num_windows: windows of the history after the oldest one (L_W).
        num_directions: of the sliced distance.
        num_tested: newest distances that are tested.
        num_kept: distances that are kept, including those.
        num_left_out: newest distances that a label does not keep.
        alpha: a p-value below is a suspicion.
        accept: a p-value above accepts a label on trial.
        adjustment: by which earlier distances are multiplied.
        stable_phase: points after the start of a label without a test.
        num_fresh: distances in a trial before its first test; with fewer than ``num_tested``, steps before the trial
            count.
        settings: arguments of `Detector`.
    """

    reads = "features, rewards"
    needs = ("features",)
    changing = ("label", "is_trial", "num_points", "pending", "history", "references", "earlier", "distances")

    def __init__(
        self,
        window: int,
        num_windows: int,
        num_directions: int,
        num_tested: int,
        num_kept: int,
        num_left_out: int,
        alpha: float,
        accept: float,
        adjustment: float,
        stable_phase: int,
        num_fresh: int,
        **settings: Any,
    ) -> None:
        super().__init__(**settings)
        require(
            *at_least_one(window=window, num_windows=num_windows, num_directions=num_directions),
            *at_least_one(num_tested=num_tested, num_kept=num_kept, num_left_out=num_left_out),
        )
        require(
            (num_left_out >= num_tested, f"num_left_out must be at least num_tested={num_tested}, got {num_left_out}"),
            (
                num_left_out < num_kept <= MOST_VALUES,
                f"num_kept must be above num_left_out={num_left_out} and at most {MOST_VALUES}, got {num_kept}",
            ),
            (is_int(stable_phase, 0), f"stable_phase must be an integer >= 0, got {stable_phase!r}"),
            (
                is_int(num_fresh, 0) and num_fresh * window <= self.patience,
                f"num_fresh must be an integer in 0..{self.patience // window}, the windows in "
                f"patience={self.patience} points, got {num_fresh!r}",
            ),
            *fraction(alpha=alpha, accept=accept),
            *positive(adjustment=adjustment),
        )
        self.window = window
        self.num_windows = num_windows
        self.num_directions = num_directions
        self.num_tested = num_tested
        self.num_kept = num_kept
        self.num_left_out = num_left_out
        self.alpha = alpha
        self.accept = accept
        self.adjustment = adjustment
        self.stable_phase = stable_phase
        self.num_fresh = num_fresh
        self.label = 0
        self.is_trial = False
        self.num_points = 0
        """In windows since the label was started."""

        self.pending = torch.zeros(0, dtype=torch.float32, device="cpu")

        self.history: list[Tensor] = []
        """The present label's last windows, oldest first, float32 [window, n] each; none in a trial."""

        self.references: dict[int, Tensor] = {}
        """Of labels that were left, float32 [window, n]."""

        self.earlier: dict[int, list[float]] = {}
        """Distances with which those of a left label are compared."""

        self.distances: dict[int, list[float]] = {0: []}
        """The newest distances from each label's reference, oldest first."""

    @override
    def observe(self, seen: Seen) -> Verdict:
        new = points_of(seen)
        points = torch.cat([self.pending.view(-1, new.shape[1]), new])
        full = len(points) // self.window * self.window
        self.pending = points[full:].clone()
        for window in points[:full].unflatten(0, (-1, self.window)):
            verdict = self._update(window)
            if verdict is not None:
                return verdict
        return None

    def start_label(self, label: int, trial: bool) -> None:
        """Forget the history, and the points outside windows."""
        self.label = label
        self.is_trial = trial
        self.num_points = 0
        self.history = []
        self.pending = torch.zeros(0, dtype=torch.float32, device="cpu")
        if not trial:
            self.references.pop(label, None)
            self.distances[label] = []

    def _update(self, window: Tensor) -> Verdict:
        self.num_points += len(window)
        if not self.is_trial:
            self.history = [*self.history, window.clone()][-self.num_windows - 1 :]
        self._measure(window)
        return self._accepted() if self.is_trial else self._suspicion()

    def _measure(self, window: Tensor) -> None:
        references = dict(self.references)
        if len(self.history) > WINDOWS_BEFORE:
            references[self.label] = self.history[0]
        if not references:
            return
        directions = unit_directions(self.num_directions, window.shape[1])
        found = sliced_distances(torch.stack(list(references.values())), window, directions).tolist()
        for label, distance in zip(references, found, strict=True):
            self.distances[label] = [*self.distances[label], distance][-self.num_kept :]

    def _accepted(self) -> Verdict:
        earlier = self.earlier[self.label]
        newest = self.distances[self.label][-self.num_tested :]
        enough = len(newest) == self.num_tested and self.num_points >= self.num_fresh * self.window
        return self.label if enough and self._p_value(earlier, newest) > self.accept else None

    def _suspicion(self) -> Verdict:
        distances = self.distances[self.label]
        if self.num_points <= self.stable_phase or len(distances) <= self.num_left_out:
            return None
        if self._p_value(distances[: -self.num_tested], distances[-self.num_tested :]) >= self.alpha:
            return None
        self.references[self.label] = self.history[0]
        self.earlier[self.label] = distances[: -self.num_left_out]
        return SUSPICION

    def _p_value(self, earlier: Sequence[float], newest: Sequence[float]) -> float:
        return ks_greater([self.adjustment * distance for distance in earlier], newest)


def points_of(seen: Seen) -> Tensor:
    """Return a batch's steps as points, row after row: action, sqrt(F) reward, features; float32 [N, 2 + F]."""
    features = cast(Tensor, seen.features).flatten(0, 1)
    reward = math.sqrt(features.shape[1]) * seen.reward.flatten()
    return torch.cat([seen.action.flatten().unsqueeze(1), reward.unsqueeze(1), features], dim=1).float()
