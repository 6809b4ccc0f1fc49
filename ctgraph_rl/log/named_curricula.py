"""The published curricula by name."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from ctgraph_rl.packages import check_packages

if TYPE_CHECKING:
    from ctgraph_rl.tasks.curriculum import Curriculum


def curriculum_named(name: str, **arguments: Any) -> Curriculum:
    """Return a published curriculum, changed by arguments.

    Raises:
        ValueError: for an unknown name or argument, with the choices; and as `check_packages`.
    """
    check_packages()
    return import_module("curricula").load(name, **arguments)
