"""The learners of the runs with detectors of task changes, and what is finished of each."""

from __future__ import annotations

from functools import cache

from studies.raw import Raw, groups, read

NAME, SPANS = "no_labels", "no_labels_spans"

FOUND = ("detector", "method", "num_fresh", "boundaries")
"""The columns that tell the learners of a curriculum apart."""

MASKS, PAIR = "swoks_2x4", "dick2020_pair"
IMAGES = ("fo_b1_4images", "su_b1_4images", "co_b1_4images", "posr_b1_4images")

PLANNED = {
    (MASKS, "384000"): ("announced", "oracle", "swoks", "swoks, fresh", "adwin", "none"),
    (PAIR, "51200"): ("announced", "oracle", "amd", "swoks", "adwin", "none"),
    (PAIR, "204800"): ("announced", "oracle", "amd", "swoks, fresh", "adwin", "none"),
    **{(name, "204800"): ("announced", "oracle", "swoks, fresh", "adwin", "none") for name in IMAGES},
}
"""Curricula, frames of a stay, and learners of the experiments."""

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


@cache
def finished() -> dict[tuple[str, str], dict[str, Raw]]:
    """Return the lines of each curriculum and learner with all seeds, in the order of the page."""
    found = groups(read(NAME), "curriculum", "stay")
    of = {
        place: {name: [line for line in found.get(place, []) if learner(line) == name] for name in names}
        for place, names in PLANNED.items()
    }
    whole = {
        place: {name: lines for name, lines in each.items() if len({line["seed"] for line in lines}) >= SEEDS}
        for place, each in of.items()
    }
    return {place: each for place, each in whole.items() if each}


def values(lines: Raw, name: str) -> list[float]:
    """Return a metric of each seed."""
    return [float(line[name]) for line in lines]
