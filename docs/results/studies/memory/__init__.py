"""What memory cells solve on confounding graphs: the page memory.md.

`runs` says what is counted of a run; all others make the page.
"""
