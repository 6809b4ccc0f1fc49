"""Measurements: the log of a run, its tables, its metrics and what is recorded about where they come from.

It imports `ctgraph_rl.tasks` and `ctgraph_rl.metrics`; the loop in `ctgraph_rl.learn` writes logs, and runs and
reports read them.
"""
