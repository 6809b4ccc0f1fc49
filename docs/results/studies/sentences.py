"""Sentences of a page, each with what raw results must say for it: a page cannot be made of others."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


class Sentences:
    """The conclusions of a page."""

    def __init__(self) -> None:
        self.of: dict[str, Callable[..., bool]] = {}

    def __call__(self, sentence: str) -> Callable[[Callable[..., bool]], Callable[..., bool]]:
        """Decorate a function that reads raw results and returns whether they say a sentence.

        Args:
            sentence: as the page has it, on one line.
        """

        def listed(holds: Callable[..., bool]) -> Callable[..., bool]:
            self.of[sentence] = holds
            return holds

        return listed

    def check(self, text: str, *data: Any) -> str:
        """Return the text of a page that has each sentence, and of which each holds.

        Args:
            text: of the page.
            data: what the functions read beside the stored tables.

        Raises:
            ValueError: for a sentence that the page lacks, or that raw results do not say.
        """
        words = " ".join(text.split())
        for sentence, holds in self.of.items():
            if sentence not in words:
                raise ValueError(f"the page lacks the sentence {sentence!r}")
            if not holds(*data):
                raise ValueError(f"raw results do not say {sentence!r}")
        return text
