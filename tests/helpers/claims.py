"""Sentences of the pages of results, each beside what the raw results must be for it to hold."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

Holds = Callable[[Any], Any]


class Claims:
    """The sentences that were claimed of each table, by whether they hold of it.

    Call it with a table to decorate a function of it whose docstring is a sentence of the page, or some.
    """

    def __init__(self) -> None:
        self.of: dict[str, dict[str, Holds]] = {}

    def __call__(self, table: str) -> Callable[[Holds], Holds]:
        def listed(holds: Holds) -> Holds:
            self.of.setdefault(table, {})[" ".join((holds.__doc__ or "").split())] = holds
            return holds

        return listed

    def each(self) -> list[tuple[str, str]]:
        """Every table with each text that is claimed of it."""
        return [(table, text) for table, claims in self.of.items() for text in claims]

    def sentences(self) -> list[str]:
        """All sentences that are claimed."""
        return [sentence for _, text in self.each() for sentence in sentences(text)]


def sentences(text: str) -> list[str]:
    """The sentences of a text."""
    return re.split(r"(?<=\.)\s+(?=[A-Z(])|(?<=\.\))\s+", " ".join(text.split()))


def readings(page: str) -> list[str]:
    """The texts of a page from "Findings." to the next figure, without the marks of their lists."""
    found = re.findall(r"\*\*Findings\.\*\*(.*?)\n!\[", page, re.DOTALL)
    return [re.sub(r"^- ", "", text, flags=re.MULTILINE) for text in found]
