"""Random draws through ``random.Random(seed).random()``, whose numbers Python keeps between versions."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable
from typing import TypeVar

from ctgraph_rl.checks import is_int, require

Item = TypeVar("Item")


def generator(seed: int) -> random.Random:
    """Return the generator of a seed >= 0."""
    require((is_int(seed, 0), f"seed must be an integer >= 0, got {seed!r}"))
    return random.Random(seed)


def below(source: random.Random, count: int) -> int:
    """Draw an integer in [0, count); for small counts uniform to within 2**-36."""
    return int(source.random() * count)


def shuffled(items: Iterable[Item], seed: int) -> list[Item]:
    """Return the items in a uniformly random order."""
    order = list(items)
    source = generator(seed)
    for i in range(len(order) - 1, 0, -1):
        j = below(source, i + 1)
        order[i], order[j] = order[j], order[i]
    return order


def different(count: int, draw: Callable[[], Item]) -> list[Item]:
    """Draw until there are ``count`` different items."""
    found: dict[Item, None] = {}
    while len(found) < count:
        found[draw()] = None
    return list(found)
