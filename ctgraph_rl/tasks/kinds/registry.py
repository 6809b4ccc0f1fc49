"""Makers of environments by kind of task, filled by `ctgraph_rl.env`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

ENVIRONMENTS: dict[type, Callable[..., Any]] = {}
"""Take the arguments of `TaskLike.make_env`."""


def environment(kind: type) -> Callable[..., Any]:
    """Return the maker of environments for a kind of tasks.

    Raises:
        ImportError: if `ctgraph_rl.env` is not imported.
    """
    if kind not in ENVIRONMENTS:
        raise ImportError(f"{kind.__name__}.make_env needs its environment: import ctgraph_rl.env first")
    return ENVIRONMENTS[kind]
