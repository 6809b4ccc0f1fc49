"""The page of detectors of task changes, no_labels.md, made of the raw results of `studies.no_labels.runs`."""

from __future__ import annotations

from math import exp
from statistics import mean
from string import Template

from ctgraph_rl.report.statistics import Comparison
from studies.lifelong.pairs import of_pairs, rows
from studies.no_labels import figures, task_free
from studies.no_labels.learners import FOUND, IMAGES, LEARNERS, MASKS, NAME, SPANS, finished, values
from studies.raw import HERE, TEMPLATES, Raw, groups, machines, mean_of, read, table
from studies.verdicts import undecided

PAGE = HERE / "no_labels.md"
SOON = 65_536
"""Frames after a change within which an alarm is counted as one of that change on the page: eight batches."""

HIGH = 0.9
"""The return of the batch before an alarm from which on little was left to learn."""


def delays(lines: Raw) -> list[float]:
    """Return the frames from each change to the first alarm before the next one; NaN where there is none."""
    return [float(each) if each != "-" else float("nan") for line in lines for each in line["delays"].split()]


def soon(lines: Raw) -> int:
    """Return the number of changes with an alarm within `SOON` frames."""
    return sum(each <= SOON for each in delays(lines))


def alarms(lines: Raw) -> Raw:
    """Return the spans of some runs that end with an alarm which is not the first one soon after a change."""
    own = {tuple(line[key] for key in ("curriculum", "stay", *FOUND, "seed")) for line in lines}
    found = []
    for run, spans in groups(read(SPANS), "curriculum", "stay", *FOUND, "seed").items():
        seen = set()
        for span in spans if run in own else ():
            has_seen = 0 if span["detector"] == "oracle" else 1  # its batch must have a frame of the new task
            change = (int(span["end"]) - has_seen) // int(span["stay"])
            after = int(span["end"]) - change * int(span["stay"])
            first = change > 0 and change not in seen
            if span["alarm"] == "True":
                seen.add(change)
                if not (first and after <= SOON):
                    found.append(span)
    return found


def other_alarms(lines: Raw) -> str:
    """Return the alarms of `alarms` per 100,000 frames, and how many of them came at a high return."""
    found = alarms(lines)
    rate = 100_000 * len(found) / sum(values(lines, "frames"))
    high = sum(float(span["return_before"]) >= HIGH for span in found)
    return f"{rate:.2f}; {high} of {len(found)}" if found else "0"


def by_chance(lines: Raw) -> float:
    """Return the share of changes that the other alarms would find soon if they came at random."""
    rate = len(alarms(lines)) / sum(values(lines, "frames"))
    return 1 - exp(-rate * SOON)


def span_of(numbers: list[float], form: str) -> str:
    """Return the mean over seeds, and the lowest and the highest of them where they differ."""
    middle, low, high = (format(each, form) for each in (mean(numbers), min(numbers), max(numbers)))
    return middle if low == high else f"{middle} ({low} to {high})"


def returns(lines: Raw, name: str) -> str:
    """Return the mean over seeds of a metric that has the bounds of returns, with its interval."""
    low, high = (float(lines[0][f"{end}_return"]) for end in ("lowest", "highest"))
    return mean_of(values(lines, name), (low, high))


def row(name: str, lines: Raw) -> list[str]:
    """Return the cells of a learner."""
    cells = [LEARNERS[name], returns(lines, "average_performance"), returns(lines, "online_return")]
    if not lines[0]["detector"]:
        return [*cells, *[""] * 5]
    shares = [
        [each / frames for each, frames in zip(values(lines, key), values(lines, "frames"), strict=True)]
        for key in ("frames_not_learned", "frames_rolled_back")
    ]
    return [
        *cells,
        mean_of(values(lines, "label_agreement"), (-0.5, 1)),
        f"{soon(lines)} of {len(delays(lines))}; {100 * by_chance(lines):.0f} %",
        other_alarms(lines),
        span_of(values(lines, "labels_per_task"), ".2f"),
        "; ".join(f"{100 * mean(each):.0f} %" for each in shares),
    ]


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


def masks() -> str:
    """Return the table of masks on four goals that come twice."""
    return table(HEAD, [row(name, lines) for name, lines in finished()[MASKS, "384000"].items()])


def on_images(name: str) -> Raw:
    """Return the lines of a learner on the image sets of all configurations that have all its seeds."""
    return [line for place in IMAGES for line in finished().get((place, "204800"), {}).get(name, [])]


def comparisons() -> dict[tuple[str, str], Comparison]:
    """Return the comparisons on the image sets, whose pairs are those of all configurations together."""
    measured: dict[tuple[str, ...], float] = {
        (name, place, line["seed"]): float(line["average_performance"])
        for (place, _), each in finished().items()
        if place in IMAGES
        for name, lines in each.items()
        for line in lines
    }
    names = {name for name, *_ in measured}
    return {(a, b): of_pairs(measured, a, b) for a, b in COMPARED if {a, b} <= names}


def compared() -> str:
    """Return the table of comparisons on the image sets."""
    found = comparisons()
    if not found:
        return "No two learners have all their seeds yet."
    return rows({f"{LEARNERS[a]} - {LEARNERS[b]}": each for (a, b), each in found.items()})


COMPARED = (
    ("oracle", "none"),
    ("swoks, fresh", "none"),
    ("adwin", "none"),
    ("announced", "oracle"),
    ("oracle", "swoks, fresh"),
    ("oracle", "adwin"),
)


def numbers() -> dict[str, str]:
    """Return the numbers within the text of the page that follow from several tables."""
    names = {"swoks_online": "swoks, fresh", "adwin_online": "adwin", "oracle_online": "oracle"}
    online = {key: f"{mean(values(on_images(name), 'online_return')):.2f}" for key, name in names.items()}
    found = {key.replace("online", "found"): str(soon(on_images(name))) for key, name in names.items()}
    chance = {
        key.replace("online", "chance"): f"{100 * by_chance(on_images(name)):.0f} %" for key, name in names.items()
    }
    return {**online, **found, **chance, "announced_less": undecided(comparisons()["announced", "oracle"])}


def page() -> str:
    """Return the page: the template with its tables and numbers."""
    template = Template((TEMPLATES / "no_labels.md").read_text(encoding="utf-8"))
    tables = {
        "masks": masks(),
        "compared": compared(),
        "task_free": task_free.results(),
    }
    return template.substitute(tables, machines=machines(NAME, task_free.NAME), **numbers())


def make() -> None:
    """Write the page and its figures."""
    PAGE.write_text(page(), encoding="utf-8")
    figures.draw_strips(HERE / "no_labels.png")
    figures.draw_images(HERE / "no_labels_ewc.png")
