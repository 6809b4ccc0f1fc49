"""Named task sequences that a paper can cite; importable without Hydra, torchrl or a configuration file."""

from __future__ import annotations

from collections.abc import Callable
from difflib import get_close_matches

from ctgraph_rl.curriculum import Curriculum
from curricula.paper import su_b1_4tasks

__all__ = ["load", "names", "su_b1_4tasks"]

_CURRICULA: dict[str, Callable[[], Curriculum]] = {function.__name__: function for function in (su_b1_4tasks,)}


def names() -> list[str]:
    """Names of all curricula."""
    return sorted(_CURRICULA)


def load(name: str) -> Curriculum:
    """A curriculum by name, as published.

    Raises:
        ValueError: for an unknown name; lists the choices.
    """
    if name not in _CURRICULA:
        near = get_close_matches(name, names(), n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"unknown curriculum {name!r}{hint} Choices: {', '.join(names())}")
    return _CURRICULA[name]()
