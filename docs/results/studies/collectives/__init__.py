"""What learners gain that share, and masks that select: the page collectives.md.

`runs` and `selecting` collect raw results; `page` makes the page.
"""
