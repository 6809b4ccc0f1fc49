"""``python -m ctgraph_rl.benchmark``: how fast environments are, measured by `benchmarks.environments` of a checkout.

A wheel has no ``benchmarks``; there an import of a name from here names the missing package.
"""

from __future__ import annotations

from typing import Any

from ctgraph_rl.packages import speed_suite


def __getattr__(name: str) -> Any:
    """Return what `benchmarks.environments` has under a name."""
    if name.startswith("__"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(speed_suite("environments"), name)
