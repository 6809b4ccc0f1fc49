"""What agents get on the tasks that each learned alone, and the main job: the page baselines.md.

`page` makes it, and `main_job` README's first figure.
"""
