"""The CT-graph as pure tensor functions on rows: the tree, its closed forms, random numbers, rewards, images.

It knows no `Task` or TorchRL, and imports only `ctgraph_rl.checks`.
"""
