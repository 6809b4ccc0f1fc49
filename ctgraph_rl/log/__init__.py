"""Measurements: a run's log, tables, metrics and provenance.

The loop in `ctgraph_rl.learn` writes logs; runs and reports read them.
"""
