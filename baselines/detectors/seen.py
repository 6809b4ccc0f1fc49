"""What a detector is given, and what it answers."""

from __future__ import annotations

from enum import Enum
from typing import Literal, NamedTuple

from torch import Tensor


class Seen(NamedTuple):
    """A batch as a detector gets it, on the CPU: what the learner sees, and nothing of the task.

    Steps are read row after row, in time order.
    """

    action: Tensor  # int64 [rows, steps]
    reward: Tensor  # float32 [rows, steps]
    is_init: Tensor  # bool [rows, steps]: an episode begins with the step's observation
    done: Tensor  # bool [rows, steps]: the episode ends with the step
    episode_return: (
        Tensor  # float32 [rows, steps]: return of the episode so far; of the whole one where it is done; NaN if hidden
    )
    features: Tensor | None = None  # float32 [rows, steps, F] at the step's observation, by the weights that acted
    observation_id: Tensor | None = None  # int64 [rows, steps]: number of the one-hot observation
    next_observation_id: Tensor | None = None  # int64 [rows, steps]: of the observation after the action


class Suspicion(Enum):
    """The type of `SUSPICION`."""

    CHANGE = 1


SUSPICION = Suspicion.CHANGE
"""The answer that the task has changed to an unknown one."""

Verdict = int | Literal[Suspicion.CHANGE] | None
"""A label, `SUSPICION`, or None where nothing speaks against the present label."""
