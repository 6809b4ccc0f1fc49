"""What methods keep and gain on sequences of tasks: the page lifelong.md.

`comparison` and `pairs` make its tables.
"""
