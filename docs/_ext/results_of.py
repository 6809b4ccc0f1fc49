"""What the raw results in ``docs/results`` say of a curriculum, an agent or a method, as tables in Markdown."""

from __future__ import annotations

import csv
from collections import defaultdict
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from statistics import fmean

FOLDER = Path(__file__).resolve().parents[1] / "results"
PAGE = "../../results"
MAIN_JOB = ("main_job", "su_b1_4tasks", "lstm_ppo")
"""The file that names neither its curriculum nor its agent, and what it is of."""

Line = dict[str, str]


@cache
def raw(name: str) -> list[Line]:
    """Return the lines of a file of raw results."""
    with (FOLDER / f"{name}.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def files_with(*columns: str) -> Iterator[tuple[str, list[Line]]]:
    """Yield each file of raw results that has all of some columns."""
    for path in sorted(FOLDER.glob("*.csv")):
        lines = raw(path.stem)
        if lines and {*columns} <= lines[0].keys():
            yield path.stem, lines


def curriculum_results(name: str) -> str:
    """Return what agents and methods reached on a curriculum, or nothing."""
    found = [_of_sequence(file, [line for line in lines if line["curriculum"] == name]) for file, lines in _sequences()]
    found += [_of_goals(file, [line for line in lines if line["configuration"] == name]) for file, lines in _goals()]
    if name == MAIN_JOB[1]:
        found.append(f"`{MAIN_JOB[2]}`, five seeds: [the page of the main job]({PAGE}/baselines.md).")
    return "\n\n".join(part for part in found if part)


def agents_results(name: str) -> str:
    """Return what an agent reached on single tasks, or nothing."""
    found = []
    for file, lines in _goals():
        of = [line for line in lines if line["agent"] == name]
        found += [
            _of_goals(file, [line for line in of if line["configuration"] == c]) for c in _unique(of, "configuration")
        ]
    return "\n\n".join(part for part in found if part)


def methods_results(name: str) -> str:
    """Return what agents reached with a method on sequences, or nothing."""
    found = []
    for file, lines in _sequences():
        of = [line for line in lines if line["method"] == name]
        found += [
            _of_sequence(file, [line for line in of if line["curriculum"] == c]) for c in _unique(of, "curriculum")
        ]
    return "\n\n".join(part for part in found if part)


def _sequences() -> Iterator[tuple[str, list[Line]]]:
    return files_with("curriculum", "agent", "method", "seed", "frames", "1")


def _goals() -> Iterator[tuple[str, list[Line]]]:
    return files_with("configuration", "depth", "task", "agent", "seed", "greedy_return")


def _unique(lines: Iterable[Line], column: str) -> list[str]:
    return list(dict.fromkeys(line[column] for line in lines))


def _of_sequence(file: str, lines: list[Line]) -> str:
    """Return the mean return over all tasks at the end, by agent and method."""
    if not lines:
        return ""
    last: dict[tuple[str, str, str], Line] = {}
    for line in lines:
        last[line["agent"], line["method"], line["seed"]] = line
    values = defaultdict(list)
    for (agent, method, _), line in last.items():
        values[agent, method].append(fmean(float(line[key]) for key in line if key.isdigit() and line[key]))
    rows = [f"| `{a}` | `{m}` | {fmean(v):.2f} | {len(v)} |" for (a, m), v in sorted(values.items())]
    head = ["| agent | method | mean return at the end | seeds |", "|---|---|--:|--:|"]
    pages = f"with intervals: [lifelong learning]({PAGE}/lifelong.md). Raw: `{file}.csv`."
    link = f"`{lines[0]['curriculum']}`, all tasks; {pages}"
    return "\n".join([link, "", *head, *rows])


def _of_goals(file: str, lines: list[Line]) -> str:
    """Return the mean greedy return by goal and agent."""
    if not lines:
        return ""
    values = defaultdict(list)
    for line in lines:
        if line["greedy_return"]:
            values[int(line["depth"]), line["task"], line["agent"]].append(float(line["greedy_return"]))
    rows = [f"| {d} | {goal} | `{a}` | {fmean(v):.2f} | {len(v)} |" for (d, goal, a), v in sorted(values.items())]
    head = ["| depth | goal | agent | mean greedy return | seeds |", "|--:|---|---|--:|--:|"]
    link = f"`{lines[0]['configuration']}`; with intervals: [baselines]({PAGE}/baselines.md). Raw: `{file}.csv`."
    return "\n".join([link, "", *head, *rows])
