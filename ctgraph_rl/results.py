"""Many runs as one table: each agent on each curriculum, with intervals over seeds.

``python -m ctgraph_rl.results runs/multirun [--csv FILE] [--compare average_performance [--difference 0.1]]``

Runs of one configuration but for the seed belong together. Every seed that any agent has on a curriculum is expected
of all: one without a run, with an unfinished run or with an undefined metric is counted, as in n = 9/10.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from ctgraph_rl.checks import require
from ctgraph_rl.log import RunLog
from ctgraph_rl.statistics import Comparison, Estimate, compare, interquartile_mean, mean, seeds_needed, solved_rate

SOLVED = 0.9
"""Success rate from which on a task counts as solved."""

HEADER = ("curriculum", "agent", "measure", "value", "low", "high", "n", "n_undefined", "method", "definition", "note")


@dataclass(frozen=True)
class Run:
    """What a run directory says.

    Args:
        path: the directory.
        curriculum: name and fingerprint.
        settings: the configuration without the seed, by dotted keys.
        seed: the seed.
        metrics: `Metric` fields by name; empty for an unfinished run.
        success: success rate on each task by its label, at the end; empty for an unfinished run.
        returns: mean return on each task in the same way.
    """

    path: Path
    curriculum: tuple[str, str]
    settings: Mapping[str, Any]
    seed: int
    metrics: Mapping[str, Mapping[str, Any]]
    success: Mapping[str, float]
    returns: Mapping[str, float]


@dataclass(frozen=True)
class Row:
    """A line of the table.

    Args:
        curriculum: its name.
        agent: the agent's class, and the settings in which it differs from others of the class.
        measure: a metric, or ``solved`` and a task.
        estimate: over seeds.
        definition: id of the metric's definition.
        note: why seeds have no value.
    """

    curriculum: str
    agent: str
    measure: str
    estimate: Estimate
    definition: str
    note: str


BySeed = Mapping[int, Run | None]


def find_runs(paths: Iterable[Path | str]) -> list[Run]:
    """Every run in or below the directories.

    Raises:
        ValueError: for a directory without a run, and for one run that is there twice.
    """
    runs: dict[tuple[Any, ...], Run] = {}
    for path in paths:
        logs = sorted(Path(path).rglob("run.jsonl"))
        require((bool(logs), f"{path} holds no run: no run.jsonl in or below it"))
        for run in map(read_run, (log.parent for log in logs)):
            twin = runs.setdefault((*_group(run), run.seed), run)
            same = twin.path.resolve() == run.path.resolve()
            require((same, f"{twin.path} and {run.path} are one run twice; leave one out"))
    return list(runs.values())


def read_run(path: Path) -> Run:
    """A run directory, finished or not.

    Raises:
        ValueError: if its log does not start with what was run.
    """
    log = RunLog.read(path / "run.jsonl")
    about = log.of_kind("run")
    require((bool(about), f"{path / 'run.jsonl'} does not say what was run: its first line is missing"))
    config = dict(about[0]["config"])
    seed = config.pop("seed")
    finished = (path / "metrics.json").exists()
    metrics = json.loads((path / "metrics.json").read_text(encoding="utf-8")) if finished else {}
    ends = [m for m in log.of_kind("evaluation") if m.get("moment") != "during"] if finished else []
    success, returns = ({m["label"]: m[name] for m in ends} for name in ("success_rate", "return_mean"))  # the last
    curriculum = (about[0]["curriculum"], about[0]["fingerprint"])
    return Run(path, curriculum, dict(_flat(config)), seed, metrics, success, returns)


def table(runs: Sequence[Run]) -> list[Row]:
    """Every metric, and how tasks ended, for each agent on each curriculum."""
    groups = grouped(runs).items()
    return [
        Row(name, agent, *line)
        for (name, agent), by_seed in groups
        for line in (*_metrics(by_seed), *_at_the_end(by_seed))
    ]


def comparisons(runs: Sequence[Run], metric: str) -> dict[tuple[str, str, str], Comparison]:
    """Every pair of agents on the same curriculum and seeds, by (curriculum, first, second).

    Raises:
        ValueError: if no run has the metric; lists those that there are.
    """
    choices = dict.fromkeys(name for run in runs for name in run.metrics)
    require((metric in choices, f"no run has a metric {metric!r}; there are: {', '.join(choices) or 'none'}"))
    found = {}
    for (first, one), (second, other) in combinations(grouped(runs).items(), 2):
        if first[0] == second[0] and list(one) == list(other):
            values, others = ([_value(run, metric) for run in by_seed.values()] for by_seed in (one, other))
            found[first[0], first[1], second[1]] = compare(values, others)
    return found


def grouped(runs: Sequence[Run]) -> dict[tuple[str, str], dict[int, Run | None]]:
    """Runs by seed, for each (curriculum, agent); None for a seed that only other agents have."""
    groups: dict[tuple[Any, ...], dict[int, Run]] = {}
    for run in runs:
        groups.setdefault(_group(run), {})[run.seed] = run
    one_each = [next(iter(by_seed.values())) for by_seed in groups.values()]
    found: dict[tuple[str, str], dict[int, Run | None]] = {}
    for one, by_seed in zip(one_each, groups.values(), strict=True):
        seeds = sorted({run.seed for run in runs if run.curriculum == one.curriculum})
        name = _curriculum_name(one, one_each), _agent_name(one, one_each)
        found[name] = {seed: by_seed.get(seed) for seed in seeds}
    return found


def write_csv(path: Path | str, rows: Sequence[Row]) -> None:
    """Write the table, empty cells for what is undefined."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(HEADER)
        for row in rows:
            e = row.estimate
            numbers = (e.value, e.low, e.high, e.n, e.n_undefined, e.method)
            writer.writerow([row.curriculum, row.agent, row.measure, *numbers, row.definition, row.note])


def rich_table(rows: Sequence[Row]) -> Table:
    """The table for a terminal."""
    shown = Table(title="mean [Student's 95 % interval], share of solved seeds [exact one]".replace("[", r"\["))
    for name in ("curriculum", "agent", "measure", "over seeds", "note"):
        shown.add_column(name)
    for row in rows:
        shown.add_row(row.curriculum, row.agent, row.measure.replace("_", " "), _plain(row.estimate), row.note)
    return shown


def _metrics(by_seed: BySeed) -> Iterator[tuple[str, Estimate, str, str]]:
    """A line for each metric."""
    present = [run for run in by_seed.values() if run is not None]
    for metric in dict.fromkeys(metric for run in present for metric in run.metrics):
        definition = next(run.metrics[metric]["definition"] for run in present if metric in run.metrics)
        estimate = mean([_value(run, metric) for run in by_seed.values()])
        yield metric, estimate, definition, _note(by_seed, metric, estimate)


def _at_the_end(by_seed: BySeed) -> Iterator[tuple[str, Estimate, str, str]]:
    """The interquartile mean of the last returns, and each task's share of solved seeds."""
    tasks = dict.fromkeys(task for run in by_seed.values() if run is not None for task in run.success)
    if tasks:
        returns = [[None if run is None else run.returns.get(task) for run in by_seed.values()] for task in tasks]
        estimate = interquartile_mean(returns)
        yield "interquartile_return", estimate, "agarwal2021/iqm", _note(by_seed, None, estimate)
    for task in tasks:
        rates = [None if run is None else run.success.get(task) for run in by_seed.values()]
        estimate = solved_rate([None if rate is None else rate >= SOLVED for rate in rates])
        yield f"solved {task}", estimate, f"ctgraph_rl/solved-at-end>={SOLVED}", _note(by_seed, None, estimate)


def _plain(estimate: Estimate) -> str:
    return str(estimate).replace("[", r"\[")


def _group(run: Run) -> tuple[tuple[str, str], str]:
    return run.curriculum, json.dumps(run.settings, sort_keys=True)


def _curriculum_name(run: Run, runs: Sequence[Run]) -> str:
    """The curriculum's name, with its fingerprint where another one has the same name."""
    name, fingerprint = run.curriculum
    fingerprints = {other.curriculum[1] for other in runs if other.curriculum[0] == name}
    return name if len(fingerprints) == 1 else f"{name} {fingerprint}"


def _agent_name(run: Run, runs: Sequence[Run]) -> str:
    """The agent's class, with the settings in which it differs from others of the class on the curriculum."""
    alike = [other for other in runs if other.curriculum == run.curriculum and _agent(other) == _agent(run)]
    keys = sorted({key for other in alike for key in other.settings})
    differing = [key for key in keys if len({json.dumps(other.settings.get(key)) for other in alike}) > 1]
    return " ".join([_agent(run), *(f"{key.removeprefix('agent.')}={run.settings.get(key)}" for key in differing)])


def _agent(run: Run) -> str:
    return str(run.settings.get("agent._target_", "agent")).rpartition(".")[2]


def _flat(config: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in config.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _value(run: Run | None, metric: str) -> float | None:
    return None if run is None or metric not in run.metrics else run.metrics[metric]["value"]


def _note(by_seed: BySeed, metric: str | None, estimate: Estimate) -> str:
    """Why seeds have no value, each reason once with its seeds."""
    reasons: dict[str, list[str]] = {}
    for seed, run in by_seed.items():
        reason = _missing(run, metric)
        if reason is not None:
            reasons.setdefault(reason, []).append(str(seed))
    notes = [f"seed {', '.join(seeds)}: {reason}" for reason, seeds in reasons.items()]
    return "; ".join(notes + ([estimate.reason] if estimate.reason else []))


def _missing(run: Run | None, metric: str | None) -> str | None:
    if run is None:
        return "no run"
    if not run.metrics:
        return "unfinished or failed"
    if metric is None or _value(run, metric) is not None:
        return None
    return run.metrics[metric]["undefined"] if metric in run.metrics else "another version, without this metric"


def main() -> None:
    """Print the table of many runs, and write it where asked."""
    parser = argparse.ArgumentParser(prog="python -m ctgraph_rl.results", description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+", help="run directories, or folders that hold them")
    parser.add_argument("--csv", type=Path, help="also write the table into this file")
    parser.add_argument("--compare", metavar="METRIC", help="also compare every two agents, seed by seed")
    parser.add_argument("--difference", type=float, help="how many seeds would find a true difference of this size")
    arguments = parser.parse_args()
    console = Console()
    try:
        runs = find_runs(arguments.runs)
        rows = table(runs)
        console.print(rich_table(rows))
        if arguments.csv is not None:
            write_csv(arguments.csv, rows)
        if arguments.compare is not None:
            for names, found in comparisons(runs, arguments.compare).items():
                console.print(_sentence(*names, found, arguments.difference))
    except (OSError, ValueError, ModuleNotFoundError) as error:
        parser.error(str(error))


def _sentence(curriculum: str, first: str, second: str, found: Comparison, difference: float | None) -> str:
    record = f"better in {found.wins}, equal in {found.ties}, worse in {found.losses}"
    p_value = "" if found.p_value is None else f"; sign-flip p = {found.p_value:.3g}"
    sentence = f"{curriculum}: {first} - {second}: {_plain(found.difference)}; {record}{p_value}"
    if difference is None or not found.std:
        return sentence
    seeds = seeds_needed(difference, found.std, paired=True)
    return f"{sentence}; {seeds} seeds find a difference of {difference:g} with a chance of 80 %"


if __name__ == "__main__":
    main()
