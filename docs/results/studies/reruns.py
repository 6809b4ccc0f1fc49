"""Cells of the raw results that were run again by later code, and how many of their numbers are equal: reruns.csv.

Each cell is a line, in place of an earlier one: how many numbers were compared, and how many are equal. A run that was
stopped is compared as far as it came, as for tables of methods.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

from studies.baselines import runs as agents
from studies.lifelong import runs as methods
from studies.raw import groups, read, write

NUMBERS = ("greedy_return", "greedy_success", "sampled_return", "sampled_success")
AGENT_CELL = ("configuration", "depth", "task", "agent", "seed")
COLUMNS = ("table", "curriculum", *AGENT_CELL[:-1], "method", "seed")


def compare(table: str, folder: Path) -> None:
    """Add to reruns.csv what runs under a folder have in common with a table.

    Raises:
        ValueError: for a folder without runs of the table.
    """
    kinds = {"main_job": of_main_job, **dict.fromkeys(agents.AGENTS, of_agents)}
    compared = kinds.get(table, of_methods)
    found = {tuple(line[key] for key in COLUMNS): line for line in compared(table, folder)}
    if not found:
        raise ValueError(f"{folder} holds no run of {table}: give the folder of its runs")
    kept = {tuple(line[key] for key in COLUMNS): line for line in read("reruns")}
    write("reruns", [line for _, line in sorted({**kept, **found}.items())])


def of_agents(table: str, folder: Path) -> Iterator[dict[str, str]]:
    """Compare agents that each learned one task, by what they get in the same episodes."""
    before = groups(read(table), *AGENT_CELL)
    for run in sorted(path.parent for path in folder.rglob("metrics.json")):
        now = {key: str(value) for key, value in agents.measured(run).items()}
        old = before[tuple(now[key] for key in AGENT_CELL)]
        equal = sum(old[0][number] == now[number] for number in NUMBERS)
        yield line_of(table, now, len(NUMBERS), equal)


def of_main_job(table: str, folder: Path) -> Iterator[dict[str, str]]:
    """Compare the evaluations of runs of the main job."""
    before = groups(read(table), "seed")
    for path in sorted(folder.rglob("evaluations.csv")):
        with open(path, newline="", encoding="utf-8") as file:
            now = list(csv.DictReader(file))
        pairs = list(zip(before[now[0]["seed"],], now, strict=True))
        equal = sum(old["return_mean"] == new["return_mean"] for old, new in pairs)
        yield line_of(
            table, {key: now[0][key] for key in ("curriculum", "seed")} | {"agent": "lstm_ppo"}, len(pairs), equal
        )


def of_methods(table: str, folder: Path) -> Iterator[dict[str, str]]:
    """Compare the evaluations of runs, as far as these came."""
    before = groups(read(table), *methods.CELL)
    for run in sorted(path.parent for path in folder.rglob("run.jsonl")):
        now = methods.evaluations(run)
        pairs = list(zip(before[tuple(now[0][key] for key in methods.CELL)], now, strict=False)) if now else []
        values = [(old.get(task), new[task]) for old, new in pairs for task in new if task.isdigit()]
        if values:
            yield line_of(table, now[0], len(values), sum(old == new for old, new in values))


def line_of(table: str, who: dict[str, str], numbers: int, equal: int) -> dict[str, str]:
    """One line of reruns.csv."""
    cell = {"table": table, **{key: who.get(key, "") for key in COLUMNS[1:]}}
    return {**cell, "numbers": str(numbers), "equal": str(equal)}
