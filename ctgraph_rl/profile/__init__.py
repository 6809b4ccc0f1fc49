"""The profile of an agent: a score for each learning property of the paper, between an exact floor and an optimum.

Imports the wings up to ``report``; nothing but commands imports it.
"""
