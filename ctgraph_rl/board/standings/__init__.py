"""The board: submissions as tables, one for what is comparable, and the files that show them.

It imports what submissions and tracks are, and reports; the command ``ctgraph-rl board`` alone imports it.
"""
