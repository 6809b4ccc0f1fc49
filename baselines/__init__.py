"""Baseline agents, one in each file; `parts` has what they share, `update` the gradient step and its executors.

They import `ctgraph_rl` and neither `curricula` nor Hydra; runs build them by the ``_target_`` of ``conf/agent``.
"""
