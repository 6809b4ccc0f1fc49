"""People and policies that play a task: in the terminal, in a film, or counted for a figure.

It imports runs and everything below them; reports and the command line use it.
"""
