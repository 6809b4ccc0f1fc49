"""ADWIN on the return: a window of episodes is cut where the mean returns of its two parts differ.

Bifet and Gavalda 2007 (SDM), "Learning from time-changing data with adaptive windowing"; the detector is River's.
Suspicion and acceptance of labels are our choices.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from statistics import fmean, pvariance
from typing import Any, NamedTuple

import torch
from torch import Tensor
from typing_extensions import override

from baselines.detectors.detector import Detector
from baselines.detectors.seen import SUSPICION, Seen, Verdict
from ctgraph_rl.checks import LARGEST_INT, NamedValues, ReadOnlyValues, at_least_one, is_int, is_real, require


class Returns(NamedTuple):
    """Returns of episodes: their number, their mean and their variance."""

    number: int
    mean: float
    variance: float


class ADWIN(Detector):
    """Suspects a change where ADWIN cuts its window of episode returns, and their mean has fallen.

    A mean that rises comes from learning. A label keeps number, mean and variance of the returns that were cut off. On
    trial it is accepted once ``num_trial_episodes`` returns were seen and their mean differs from the kept one by at
    most ADWIN's bound at significance ``delta``. So a label without success is accepted in any task without success.
    Every label starts with an empty window and counts episodes that began with it.

    Args:
        delta: significance of a cut.
        clock: episodes between two tests for a cut.
        max_buckets: of each size of the window.
        min_window_length: episodes of a part.
        grace_period: episodes before the first test.
        num_trial_episodes: before a label is accepted.
        settings: arguments of `Detector`.

    Raises:
        ModuleNotFoundError: without River; names the extra to install.
    """

    needs_episodes = True
    reads = "returns"

    is_whole: Tensor | None
    """Whether each row's present episode began with the label, bool [rows]; None: before the first batch."""

    def __init__(
        self,
        delta: float,
        clock: int,
        max_buckets: int,
        min_window_length: int,
        grace_period: int,
        num_trial_episodes: int,
        **settings: Any,
    ) -> None:
        super().__init__(**settings)
        require(
            (is_real(delta, 0, 1) and 0 < delta < 1, f"delta must be in (0, 1), got {delta!r}"),
            *at_least_one(clock=clock, max_buckets=max_buckets, min_window_length=min_window_length),
            *at_least_one(num_trial_episodes=num_trial_episodes),
            (
                is_int(grace_period, 0, LARGEST_INT),
                f"grace_period must be an integer in [0, 2**63), got {grace_period!r}",
            ),
        )
        self.delta = delta
        self.num_trial_episodes = num_trial_episodes
        self._new_window = partial(
            _river_adwin(),
            delta=delta,
            clock=clock,
            max_buckets=max_buckets,
            min_window_length=min_window_length,
            grace_period=grace_period,
        )
        self.kept: dict[int, Returns] = {}
        self.start_label(0, trial=False)

    def observe(self, seen: Seen) -> Verdict:
        """Give ADWIN the returns of ended episodes, or on trial compare them with the kept ones."""
        before = torch.zeros(len(seen.done), dtype=torch.bool, device="cpu") if self.is_whole is None else self.is_whole
        is_whole = before.unsqueeze(1) | (seen.is_init.cumsum(dim=1) > 0)
        self.is_whole = is_whole[:, -1].clone()
        ended = seen.episode_return[seen.done & is_whole].tolist()
        if self.is_trial:
            self.returns.extend(ended)
            return self._accepted()
        return SUSPICION if any(self._falls(each) for each in ended) else None

    @override
    def start_label(self, label: int, trial: bool) -> None:
        self.label = label
        self.is_trial = trial
        self.window = self._new_window()
        self.returns: list[float] = []
        """In the window, or of the trial."""

        self.is_whole = None

    def _falls(self, episode_return: float) -> bool:
        self.window.update(episode_return)
        self.returns.append(episode_return)
        if not self.window.drift_detected:
            return False
        newest = int(self.window.width)
        before = returns_of(self.returns[:-newest])
        after = returns_of(self.returns[-newest:])
        self.returns = []  # River starts an empty window at the next return
        if after.mean < before.mean:
            self.kept[self.label] = before
        return after.mean < before.mean

    def _accepted(self) -> Verdict:
        kept = self.kept.get(self.label)
        seen = returns_of(self.returns)
        if kept is None or seen.number < self.num_trial_episodes:
            return None
        return self.label if abs(seen.mean - kept.mean) <= bound(kept, seen, self.delta) else None

    def state_dict(self) -> NamedValues:
        """Return what verdicts depend on: 8 bytes for each return in the window, 1 for each row."""
        kept = {label: tuple(each) for label, each in self.kept.items()}
        returns = torch.tensor(self.returns, dtype=torch.float64, device="cpu")
        now = {"label": self.label, "is_trial": self.is_trial, "is_whole": self.is_whole}
        return {**now, "returns": returns, "kept": kept}

    @override
    def load_state_dict(self, state: ReadOnlyValues) -> None:
        self.start_label(state["label"], state["is_trial"])
        self.kept = {label: Returns(*each) for label, each in state["kept"].items()}
        self.returns = state["returns"].tolist()
        self.is_whole = state["is_whole"]
        for each in () if self.is_trial else self.returns:
            self.window.update(each)


def returns_of(values: Sequence[float]) -> Returns:
    """Return number, mean and variance of returns; zeros if there are none."""
    return Returns(len(values), fmean(values), pvariance(values)) if values else Returns(0, 0.0, 0.0)


def bound(first: Returns, second: Returns, delta: float) -> float:
    """Return ADWIN's bound of the difference of two means, Bifet and Gavalda 2007, Section 3.3.

    epsilon = sqrt(2 v L / m) + 2 L / (3 m), with L = ln(2 ln(n) / delta), n episodes in all, 1 / m = 1 / n0 + 1 / n1,
    and v the variance of all returns.
    """
    total = first.number + second.number
    mean = (first.number * first.mean + second.number * second.mean) / total
    variance = sum(each.number * (each.variance + (each.mean - mean) ** 2) for each in (first, second)) / total
    inverse = 1 / first.number + 1 / second.number
    log = math.log(2 * math.log(total) / delta)
    return math.sqrt(2 * variance * log * inverse) + 2 / 3 * log * inverse


def _river_adwin() -> Any:
    try:
        from river.drift import ADWIN as RiverADWIN
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("detector=adwin needs river: pip install 'ctgraph_rl[detectors]'") from error
    return RiverADWIN
