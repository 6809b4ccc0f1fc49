"""The page of detectors of task changes, no_labels.md."""

from __future__ import annotations

from math import exp
from pathlib import Path
from statistics import mean

from ctgraph_rl.report.statistics import Comparison
from studies.lifelong.pairs import of_pairs, rows
from studies.no_labels import figures, task_free
from studies.no_labels.learners import FOUND, IMAGES, LEARNERS, MASKS, NAME, SPANS, finished, returns
from studies.raw import Raw, fill, groups, machines, mean_of, numbers_in, read, table
from studies.verdicts import undecided

SOON = 65_536
"""Frames after a change within which an alarm is counted as one of that change on the page: eight batches."""

HIGH = 0.9
"""The return of the batch before an alarm from which on little was left to learn."""

HEAD = (
    "",
    "average performance",
    "online return",
    "adjusted Rand index",
    "changes found soon; share found by chance",
    "other alarms; at a return of 0.9",
    "labels per task",
    "not learned from; undone",
)

COMPARED = (
    ("oracle", "none"),
    ("swoks, fresh", "none"),
    ("adwin", "none"),
    ("announced", "oracle"),
    ("oracle", "swoks, fresh"),
    ("oracle", "adwin"),
)


def delays(lines: Raw) -> list[float]:
    """Return the frames from each change to the first alarm before the next one; NaN where there is none."""
    return [float(each.replace("-", "nan")) for line in lines for each in line["delays"].split()]


def soon(lines: Raw) -> int:
    """Return the number of changes with an alarm within `SOON` frames."""
    return sum(each <= SOON for each in delays(lines))


def alarms(lines: Raw) -> Raw:
    """Return the spans of some runs that end with an alarm which is not the first one soon after a change."""
    of = groups(read(SPANS), "curriculum", "stay", *FOUND, "seed")
    found = []
    for line in lines:
        seen = set()
        for span in of.get(tuple(line[key] for key in ("curriculum", "stay", *FOUND, "seed")), []):
            if span["alarm"] == "True":
                has_seen = 0 if span["detector"] == "oracle" else 1  # its batch must have a frame of the new task
                change, after = divmod(int(span["end"]) - has_seen, int(span["stay"]))
                if change == 0 or change in seen or after + has_seen > SOON:
                    found.append(span)
                seen.add(change)
    return found


def by_chance(lines: Raw) -> str:
    """Return the share of changes that the other alarms would find soon if they came at random."""
    rate = len(alarms(lines)) / sum(numbers_in(lines, "frames"))
    return f"{100 * (1 - exp(-rate * SOON)):.0f} %"


def row(name: str, lines: Raw) -> list[str]:
    """Return the cells of a learner."""
    cells = [LEARNERS[name]]
    cells += [mean_of(*returns(lines, column)) for column in ("average_performance", "online_return")]
    if not lines[0]["detector"]:
        return [*cells, *[""] * 5]
    others = alarms(lines)
    rate = 100_000 * len(others) / sum(numbers_in(lines, "frames"))
    high = sum(value >= HIGH for value in numbers_in(others, "return_before"))
    labels = numbers_in(lines, "labels_per_task")
    low, most = min(labels), max(labels)
    shares = []
    for column in ("frames_not_learned", "frames_rolled_back"):
        of_seeds = [float(line[column]) / float(line["frames"]) for line in lines]
        shares.append(f"{100 * mean(of_seeds):.0f} %")
    return [
        *cells,
        mean_of(numbers_in(lines, "label_agreement"), (-0.5, 1)),
        f"{soon(lines)} of {len(delays(lines))}; {by_chance(lines)}",
        f"{rate:.2f}; {high} of {len(others)}" if others else "0",
        f"{mean(labels):.2f}" + (f" ({low:.2f} to {most:.2f})" if low < most else ""),
        "; ".join(shares),
    ]


def on_images(name: str) -> Raw:
    """Return the lines of a learner on the image sets of all configurations."""
    return [line for place in IMAGES for line in finished()[place, "204800"][name]]


def comparisons() -> dict[tuple[str, str], Comparison]:
    """Return the comparisons on the image sets, whose pairs are those of all configurations together."""
    measured: dict[tuple[str, ...], float] = {}
    for name in {name for pair in COMPARED for name in pair}:
        for line in on_images(name):
            measured[name, line["curriculum"], line["seed"]] = float(line["average_performance"])
    return {(one, other): of_pairs(measured, one, other) for one, other in COMPARED}


def page() -> str:
    """Return the page."""
    found = comparisons()
    texts = {
        "masks": table(HEAD, [row(name, lines) for name, lines in finished()[MASKS, "384000"].items()]),
        "compared": rows({f"{LEARNERS[one]} - {LEARNERS[other]}": each for (one, other), each in found.items()}),
        "task_free": task_free.results(),
        "announced_less": undecided(found["announced", "oracle"]),
        "machines": machines(NAME, task_free.NAME),
    }
    return fill(NAME, texts)


def draw(folder: Path) -> None:
    """Draw the figures."""
    figures.draw_strips(folder / "no_labels.png")
    figures.draw_images(folder / "no_labels_ewc.png")
