"""The board: submissions as tables, one for what is comparable, and the files that show them.

It imports what submissions and tracks are, and reports; only the command ``ctgraph-rl board`` imports it.
"""
