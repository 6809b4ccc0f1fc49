"""Kinds of tasks: the protocol that all of them satisfy, and those that are no CT-graphs.

It imports only `ctgraph_rl.checks`; blocks of a curriculum hold tasks of any kind.
"""
