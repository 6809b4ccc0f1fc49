"""Figures of tasks, images, curricula and trained agents, and `play` in the terminal.

It imports runs and everything below them, and Matplotlib only where a figure is drawn; reports and the command
line use it.
"""
