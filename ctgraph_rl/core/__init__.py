"""The CT-graph as pure tensor functions on rows: the tree, its closed forms, random numbers, rewards, images.

Nothing here knows a `Task` or TorchRL, and it imports only `ctgraph_rl.checks`; every other folder builds on it.
"""
