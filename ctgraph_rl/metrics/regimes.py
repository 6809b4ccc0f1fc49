"""Regimes, stays on one task, and a table of many."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class Regime:
    """A stay on one task.

    Args:
        training: False for an evaluation.
        values: performance of each experience in order, float64 [experiences].

    Raises:
        ValueError: for no values, or infinite ones.
    """

    task: str
    training: bool
    values: Tensor

    def __post_init__(self) -> None:
        if self.values.ndim != 1 or len(self.values) == 0 or not self.values.isfinite().all():
            raise ValueError(f"a regime of {self.task} needs finite values [experiences], got {self.values.tolist()}")

    @property
    def terminal(self) -> float:
        """Terminal performance: mean of a training's last tenth, or of an evaluation."""
        start = int((1 - 0.1) * len(self.values)) if self.training else 0
        return self.values[start:].mean().item()


class RegimeTable(Sequence[Regime]):
    """Regimes as arrays: a run that evaluates T tasks after each of T blocks has more than T^2 of them.

    Args:
        names: of tasks.
        values: the experiences of all regimes in order, float64 [experiences].
        task: each regime's task, by its position in the names.
        training: False for an evaluation.
        length: number of each regime's experiences.

    Raises:
        ValueError: for a regime that `Regime` refuses.
    """

    def __init__(self, names: Iterable[str], values: Tensor, task: Any, training: Any, length: Any) -> None:
        self.names = tuple(names)
        self.values = values
        self.task = np.asarray(task, dtype=np.int64)
        self.training = np.asarray(training, dtype=bool)
        self.length = np.asarray(length, dtype=np.int64)
        self.starts = np.concatenate([[0], self.length.cumsum()])
        finite = values.isfinite().numpy()
        wrong = [
            *np.flatnonzero(self.length == 0),
            *(np.searchsorted(self.starts, np.flatnonzero(~finite), "right") - 1),
        ]
        if wrong:
            self[int(min(wrong))]

    @classmethod
    def of(cls, regimes: Sequence[Regime]) -> RegimeTable:
        """Return regimes as a table; a table unchanged."""
        if isinstance(regimes, RegimeTable):
            return regimes
        names = {task: i for i, task in enumerate(dict.fromkeys(each.task for each in regimes))}
        task = [names[each.task] for each in regimes]
        training = [each.training for each in regimes]
        length = [len(each.values) for each in regimes]
        nothing = torch.empty(0, dtype=torch.float64, device="cpu")
        return cls(names, torch.cat([nothing, *(each.values for each in regimes)]), task, training, length)

    def replaced(self, values: Tensor) -> RegimeTable:
        """Return the table with other values."""
        return RegimeTable(self.names, values, self.task, self.training, self.length)

    def __len__(self) -> int:
        return len(self.task)

    def __getitem__(self, place: Any) -> Any:
        if isinstance(place, slice):
            return [self[i] for i in range(*place.indices(len(self)))]
        return Regime(self.names[self.task[place]], bool(self.training[place]), self.values_of(range(len(self))[place]))

    def values_of(self, place: int) -> Tensor:
        """Return the experiences of a regime."""
        return self.values[self.starts[place] : self.starts[place + 1]]

    @cached_property
    def terminal(self) -> Any:
        """`Regime.terminal`, float64 [regimes]."""
        found = self.values[torch.from_numpy(self.starts[:-1])].double().numpy().copy()
        for place in np.flatnonzero(self.length > 1).tolist():
            found[place] = self[place].terminal
        return found

    def places(self, training: bool) -> Iterator[list[int]]:
        """Yield each task's positions of trainings or evaluations."""
        own = np.flatnonzero(self.training == training)
        order = own[np.argsort(self.task[own], kind="stable")]
        ends = np.searchsorted(self.task[order], range(len(self.names) + 1))
        return (order[first:last].tolist() for first, last in pairwise(ends))
