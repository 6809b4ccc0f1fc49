"""Methods after a change of task, on tasks that each seed draws: the page plasticity.md.

`page` makes its table and numbers.
"""
