"""The environments of the kinds of tasks of this package, which stand above tasks and are added by `ctgraph_rl.env`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

ENVIRONMENTS: dict[type, Callable[..., Any]] = {}
"""What makes the environment of a kind of tasks, with the arguments of `TaskLike.make_env`."""


def environment(kind: type) -> Callable[..., Any]:
    """Return what makes the environment of a kind of tasks.

    Raises:
        ImportError: if `ctgraph_rl.env` is not imported.
    """
    if kind not in ENVIRONMENTS:
        raise ImportError(f"{kind.__name__}.make_env needs its environment: import ctgraph_rl.env first")
    return ENVIRONMENTS[kind]
