"""A run as a directory: configuration, training with checkpoints, single-task experts, sweeps, and reading runs back.

It imports `ctgraph_rl.learn` and what is below; the entry point `ctgraph_rl.run`, the figures and the reports use it.
"""
