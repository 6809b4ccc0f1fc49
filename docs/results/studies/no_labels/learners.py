"""The learners of the runs with detectors of task changes."""

from __future__ import annotations

from studies.raw import Raw, groups, numbers_in, read

NAME, SPANS = "no_labels", "no_labels_spans"

FOUND = ("detector", "method", "num_fresh", "boundaries")
"""The columns that tell the learners of a curriculum apart."""

MASKS = "swoks_2x4"
IMAGES = ("fo_b1_4images", "su_b1_4images", "co_b1_4images", "posr_b1_4images")

SEEDS = 5

LEARNERS = {
    "announced": "announced",
    "oracle": "oracle",
    "amd": "AMD",
    "swoks": "SWOKS, published trials",
    "swoks, fresh": "SWOKS, fresh trials",
    "adwin": "ADWIN",
    "none": "fine-tuning",
}
"""Names of learners in the order of the page."""


def learner(line: dict[str, str]) -> str:
    """Return the name of a line's learner, a key of `LEARNERS`."""
    if line["detector"]:
        return "swoks, fresh" if line["detector"] == "swoks" and line["num_fresh"] != "0" else line["detector"]
    return "announced" if line["boundaries"] == "announced" else "none"


def by_learner(name: str, *keys: str) -> dict[tuple[str, ...], dict[str, Raw]]:
    """Return the lines of a table by some keys, then by learner, in the order of the page."""
    found: dict[tuple[str, ...], dict[str, Raw]] = {}
    for place, lines in groups(read(name), *keys).items():
        of = {name: [line for line in lines if learner(line) == name] for name in LEARNERS}
        found[place] = {name: own for name, own in of.items() if own}
    return found


def finished() -> dict[tuple[str, ...], dict[str, Raw]]:
    """Return the lines by curriculum and frames of a stay, then by learner."""
    return by_learner(NAME, "curriculum", "stay")


def share(lines: Raw, column: str) -> float:
    """Return what share of all frames of some runs a column has."""
    return sum(numbers_in(lines, column)) / sum(numbers_in(lines, "frames"))


def returns(lines: Raw, column: str) -> tuple[list[float], tuple[float, float]]:
    """Return a column with the bounds of returns, one number for each seed."""
    return numbers_in(lines, column), (float(lines[0]["lowest_return"]), float(lines[0]["highest_return"]))
