"""Parameters of tests, of which a few are enough for the default run."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def others_slow(values: Iterable[Any], *kept: Any) -> list[Any]:
    """All values, or tuples of values, of which those that are not kept in the default run are slow."""
    several = [value if isinstance(value, tuple) else (value,) for value in values]
    wanted = [value if isinstance(value, tuple) else (value,) for value in kept]
    return [pytest.param(*value, marks=[] if value in wanted else [pytest.mark.slow]) for value in several]
