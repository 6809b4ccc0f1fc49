"""The published curricula by name."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from ctgraph_rl.packages import check_packages

if TYPE_CHECKING:
    from ctgraph_rl.tasks.curriculum import Curriculum


def curriculum_named(name: str) -> Curriculum:
    """Return a published curriculum.

    Raises:
        ValueError: for an unknown name, with the choices; and as `check_packages`.
    """
    check_packages()
    return import_module("curricula").load(name)
