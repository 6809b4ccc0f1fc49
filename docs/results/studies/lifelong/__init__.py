"""What methods keep and gain on sequences of tasks: the page lifelong.md.

`experiments` says what was to run, and `runs` collects it; all others make the page.
"""
