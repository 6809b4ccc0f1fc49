"""The published curricula, which `curricula` has: by name, and whether a curriculum is one of them."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from ctgraph_rl.packages import check_packages

if TYPE_CHECKING:
    from ctgraph_rl.tasks.curriculum import Curriculum


def curriculum_named(name: str) -> Curriculum:
    """Return a published curriculum.

    Raises:
        ValueError: for an unknown name, with the choices; and see `check_packages`.
    """
    check_packages()
    return import_module("curricula").load(name)


def is_published(curriculum: Curriculum) -> bool | None:
    """Return whether a curriculum is the published one of its name; None if no published one has this name.

    Raises:
        ValueError: see `check_packages`.
    """
    check_packages()
    for name, _, _, _, fingerprint, _ in import_module("curricula").listed():
        if name == curriculum.name:
            return bool(fingerprint == curriculum.fingerprint)
    return None
