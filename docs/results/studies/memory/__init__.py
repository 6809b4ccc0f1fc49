"""What memory cells solve on confounding graphs: the page memory.md."""
