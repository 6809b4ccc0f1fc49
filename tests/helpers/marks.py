"""Parameters of tests, of which a few are enough for the default run."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def others_slow(values: Iterable[Any], *kept: Any) -> list[Any]:
    """All values, of which those that are not kept in the default run are slow."""
    return [value if value in kept else pytest.param(value, marks=pytest.mark.slow) for value in values]
