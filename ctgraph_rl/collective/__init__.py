"""Collectives as runs: members in their own directories, and what the group measured of messages and learning time.

Imports the wings up to ``report``; nothing but commands imports it.
"""
