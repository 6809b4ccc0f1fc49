"""What memory cells solve on confounding graphs: the page memory.md.

`conditions` says what was run; all others make the page.
"""
