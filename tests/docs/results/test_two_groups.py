"""The interval of a number of two groups of seeds."""

from __future__ import annotations

import numpy as np
import pytest
from studies.two_groups import two_groups


def gain(runs, experts):
    """Continual World's forward transfer of mean areas."""
    return ((runs - experts) / (1 - experts)).mean(-1)


@pytest.mark.slow
def test_a_number_of_two_groups_has_the_uncertainty_of_both():
    runs, experts = np.array([[0.9], [0.8], [1.0], [0.9], [0.9]]), np.array([[0.5], [0.6], [0.4], [0.5], [0.5]])
    certain = np.repeat(experts.mean(0, keepdims=True), 10_000, 0)

    both, one = two_groups(runs, experts, gain), two_groups(runs, certain, gain)

    assert both.value == one.value == pytest.approx(0.8)
    assert both.low < one.low < 0.8 < one.high <= both.high <= 1
    with np.errstate(divide="ignore"):
        nothing_to_gain = two_groups(runs, np.array([[1.0], [1.0], [0.99], [1.0], [1.0]]), gain)
    assert nothing_to_gain.low < -50
