"""What learners gain that share, and masks that select: the page collectives.md.

`page` makes it; the other modules are of its sections.
"""
