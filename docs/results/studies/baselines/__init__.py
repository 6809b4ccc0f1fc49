"""What agents get on the tasks that each learned alone, and the main job: the page baselines.md."""
