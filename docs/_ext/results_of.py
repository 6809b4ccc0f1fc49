"""What the raw results in ``docs/results`` say of a curriculum, an agent or a method, as tables in Markdown."""

from __future__ import annotations

from functools import cache
from statistics import fmean

from studies.raw import HERE, Raw, groups, numbers_in, read, select

PAGE = "../../results"
MAIN_JOB = ("su_b1_4tasks", "lstm_ppo")
"""Curriculum and agent of the file that names neither."""

SEQUENCES = ("curriculum", "agent", "method", "seed", "frames", "1")
GOALS = ("configuration", "depth", "task", "agent", "seed", "greedy_return")
"""Columns of files about sequences of tasks, and about single tasks."""


@cache
def files_with(columns: tuple[str, ...]) -> dict[str, Raw]:
    """Return the files of raw results that have all of some columns."""
    files = {path.stem: read(path.stem) for path in sorted(HERE.glob("*.csv"))}
    return {name: lines for name, lines in files.items() if lines and {*columns} <= lines[0].keys()}


def curriculum_results(name: str) -> str:
    """Return what agents and methods reached on a curriculum, or nothing."""
    found = [*_of_sequences(curriculum=name), *_of_goals(configuration=name)]
    if name == MAIN_JOB[0]:
        found.append(f"`{MAIN_JOB[1]}`, five seeds: [the page of the main job]({PAGE}/baselines.md).")
    return "\n\n".join(found)


def agents_results(name: str) -> str:
    """Return what an agent reached on single tasks, or nothing."""
    return "\n\n".join(_of_goals(agent=name))


def methods_results(name: str) -> str:
    """Return what agents reached with a method on sequences, or nothing."""
    return "\n\n".join(_of_sequences(method=name))


def _of_sequences(**given: str) -> list[str]:
    """Return the mean return over all tasks at the end, by agent and method: a table for each file and curriculum."""
    tables = []
    for file, lines in files_with(SEQUENCES).items():
        for (curriculum,), of in groups(select(lines, **given), "curriculum").items():
            rows = []
            for (agent, method), own in sorted(groups(of, "agent", "method").items()):
                ends = [run[-1] for run in groups(own, "seed").values()]
                means = [fmean(float(end[key]) for key in end if key.isdigit() and end[key]) for end in ends]
                rows.append(f"| `{agent}` | `{method}` | {fmean(means):.2f} | {len(means)} |")
            head = ["| agent | method | mean return at the end | seeds |", "|---|---|--:|--:|"]
            words = f"`{curriculum}`, all tasks; with intervals: [lifelong learning]({PAGE}/lifelong.md)."
            tables.append("\n".join([f"{words} Raw: `{file}.csv`.", "", *head, *rows]))
    return tables


def _of_goals(**given: str) -> list[str]:
    """Return the mean greedy return by goal and agent: a table for each file and configuration."""
    tables = []
    for file, lines in files_with(GOALS).items():
        for (configuration,), of in groups(select(lines, **given), "configuration").items():
            rows = []
            cells = groups([line for line in of if line["greedy_return"]], "depth", "task", "agent")
            for (depth, goal, agent), own in sorted(cells.items(), key=lambda cell: (int(cell[0][0]), cell[0])):
                mean = fmean(numbers_in(own, "greedy_return"))
                rows.append(f"| {depth} | {goal} | `{agent}` | {mean:.2f} | {len(own)} |")
            head = ["| depth | goal | agent | mean greedy return | seeds |", "|--:|---|---|--:|--:|"]
            words = f"`{configuration}`; with intervals: [baselines]({PAGE}/baselines.md). Raw: `{file}.csv`."
            tables.append("\n".join([words, "", *head, *rows]))
    return tables
