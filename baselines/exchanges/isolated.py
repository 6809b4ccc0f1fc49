"""No exchange: the members of a collective learn alone. What any other exchange is compared with."""

from __future__ import annotations

from baselines.exchanges.exchange import Exchange


class Isolated(Exchange):
    """`Exchange` as it is."""
