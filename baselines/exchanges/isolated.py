"""No exchange: no member of a collective learns from another. Other exchanges are compared with it."""

from baselines.exchanges.exchange import Exchange


class Isolated(Exchange):
    """`Exchange` without changes."""
