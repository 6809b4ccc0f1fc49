"""A run as a directory: configuration, training with checkpoints, experts, sweeps, and reading runs back.

The entry point `ctgraph_rl.run`, figures and reports use it.
"""
