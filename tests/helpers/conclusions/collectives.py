"""What collectives.md says in short, and what raw results must be for it."""

from __future__ import annotations

from itertools import pairwise
from statistics import fmean

from studies.collectives import mosaic, selecting
from studies.collectives.l2d2c import BLOCKS, on_l2d2c
from studies.raw import Raw, groups, numbers_in, read

from helpers.conclusions.sentences import Sentences

says = Sentences()


def new_and_known(num_members: str) -> tuple[Raw, Raw]:
    """Return the blocks whose task no member had in an earlier block, and the others."""
    new: Raw = []
    known: Raw = []
    for lines in groups(on_l2d2c(num_members, name=BLOCKS), "seed", "task").values():
        first = min(int(line["block"]) for line in lines)
        for line in lines:
            (known if int(line["block"]) > first else new).append(line)
    return new, known


@says(
    "On 16 tasks members of a collective that exchange masks have higher returns than single learners. "
    "The gain comes from members who had the task before."
)
def _() -> bool:
    returns = [numbers_in(on_l2d2c(number), "final_return") for number in ("1", "4", "16")]
    apart = all(max(fewer) < min(more) for fewer, more in pairwise(returns))
    gains = []
    for number in ("4", "16"):
        new, known = (fmean(numbers_in(lines, "final_return")) for lines in new_and_known(number))
        gains.append(known - new > new - fmean(returns[0]))
    return apart and all(gains)


@says(
    "On 28 nested goals the sum of returns of isolated members is not shown to differ from the published one; "
    "those of MOSAIC, with and without similarity, differ."
)
def _() -> bool:
    agree = []
    for exchange, (value, half) in mosaic.SUMS.items():
        low, high = mosaic.welch(mosaic.sums(exchange, mosaic.ALL), value, half)
        if low <= 0 <= high:
            agree.append(exchange)
    return agree == ["isolated"]


@says(
    "On 28 tasks in a row AMSC, which selects earlier masks, learns more tasks than four other methods in each of five "
    "seeds."
)
def _() -> bool:
    of = groups(read(selecting.NAME), "method", "seed")
    learned: dict[str, list[int]] = {}
    for (method, _), lines in of.items():
        count = sum(value >= selecting.HIGH for value in numbers_in(lines, "evaluated"))
        learned.setdefault(method, []).append(count)
    others = [count for method, counts in learned.items() if method != "mask_amsc" for count in counts]
    return len(learned) == 5 and min(learned["mask_amsc"]) > max(others)
