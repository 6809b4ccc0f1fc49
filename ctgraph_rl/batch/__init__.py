"""Batches of CT-graphs: tasks become tensors of many rows, which the tensor engine or the C kernel steps.

It imports `ctgraph_rl.tasks` and `ctgraph_rl.core`; the environments `env`, `gym` and `sb3` are thin layers over it.
"""
