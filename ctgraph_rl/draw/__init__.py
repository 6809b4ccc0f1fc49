"""Pictures of tasks and curricula: figures, pixels of rows, text, and one layout of a tree for all of them.

It imports tasks, and Matplotlib only where a figure is drawn; nothing acts here.
"""
