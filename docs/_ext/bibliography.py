"""The BibTeX entries of ``docs/references.bib``, and which of them a source names."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

FILE = Path(__file__).resolve().parents[1] / "references.bib"
WORKS = re.compile(r"arXiv \d{4}\.\d{5}|github\.com/[\w-]+/[\w-]+")
"""What a source and an entry have in common: an arXiv number or a repository."""


@cache
def entries() -> tuple[str, ...]:
    """Return all entries, each as its text."""
    return tuple(part.strip() for part in FILE.read_text(encoding="utf-8").split("\n\n") if part.strip())


def entries_of(source: str) -> list[str]:
    """Return the entries of the works that the source of a curriculum names by arXiv number or repository."""
    works = [work.replace("arXiv ", "arXiv:") for work in WORKS.findall(source)]
    return [entry for entry in entries() if any(re.search(rf"{re.escape(work)}(?![\w-])", entry) for work in works)]
