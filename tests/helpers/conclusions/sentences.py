"""Sentences of a page, each with what raw results must say for it."""

from __future__ import annotations

from collections.abc import Callable


class Sentences:
    """The conclusions of a page."""

    def __init__(self) -> None:
        self.of: dict[str, Callable[[], bool]] = {}

    def __call__(self, sentence: str) -> Callable[[Callable[[], bool]], Callable[[], bool]]:
        """Decorate a function that reads raw results and returns whether they say a sentence.

        Args:
            sentence: as the page has it, on one line.
        """

        def listed(holds: Callable[[], bool]) -> Callable[[], bool]:
            self.of[sentence] = holds
            return holds

        return listed
