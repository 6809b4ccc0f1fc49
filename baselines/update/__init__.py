"""How agents learn: one update of weights, optimiser state and batch, which every executor takes.

`update.update` is the function. It runs operation by operation, compiled (`compiled.compiled`), for the tensors of many
seeds (`stack.Stack`), and as a CUDA graph (`ctgraph_rl.core.region.Region`) of any of these.
"""
