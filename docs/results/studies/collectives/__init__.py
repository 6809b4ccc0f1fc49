"""What learners gain that share, and masks that select: the page collectives.md."""
