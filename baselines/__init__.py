"""Baseline agents, one in each file, and what they share: networks, the gradient step, hooks and optimisers.

They import `ctgraph_rl` and neither `curricula` nor Hydra; runs build them by the ``_target_`` of ``conf/agent``.
"""
