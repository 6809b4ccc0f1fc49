"""Many runs as one table: each agent on each curriculum, with intervals over seeds."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from statistics import fmean
from typing import Any

from ctgraph_rl import metrics, parsers
from ctgraph_rl.checks import nearest, positive, require
from ctgraph_rl.disk import write_named
from ctgraph_rl.learn.progress import Count, StepCounter, silent
from ctgraph_rl.log.escape import csv_text, refused_by
from ctgraph_rl.log.files import LOG
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.log.tables import check_table, write_evaluations
from ctgraph_rl.report import statistics
from ctgraph_rl.report.bounds_of_runs import BoundsOfRuns, bounds_by_curriculum
from ctgraph_rl.report.columns import WHERE_KNOWN, caveats, columns_of_runs, objective
from ctgraph_rl.report.formats import FORMATS, LEGENDS, NO_RUN_FINISHED, SENTENCES
from ctgraph_rl.report.intervals import scipy
from ctgraph_rl.report.names import displayed, modifications
from ctgraph_rl.report.statistics import Comparison, Estimate, mean
from ctgraph_rl.report.terminal import print_note, print_problems
from ctgraph_rl.runs.read import BySeed, Run, find_runs, grouped, present, why_left_out

SOLVED = 0.9
"""Success rate from which a task is solved."""

_HERE = metrics.record.HERE
AT_END = {
    "mean_final_return": metrics.Definition(
        f"{_HERE}/mean-return-at-end", "mean over tasks of the mean return after the last block", _HERE
    ),
    "solved_rate": metrics.Definition(
        f"{_HERE}/share-solved-at-end>={SOLVED}",
        f"share of tasks with a success rate >= {SOLVED} after the last block",
        _HERE,
    ),
    "interquartile_return": metrics.Definition(
        "agarwal2021/iqm",
        "mean of the middle half of the mean returns of all tasks and seeds after the last block",
        "Agarwal et al. 2021, Deep RL at the edge of the statistical precipice (arXiv 2108.13264)",
    ),
    "solved": metrics.Definition(
        f"{_HERE}/solved-at-end>={SOLVED}",
        f"share of seeds with a success rate on the task >= {SOLVED} after the last block",
        _HERE,
    ),
}

HEADER = (
    *("curriculum", "agent", "measure", "value", "low", "high", "n", "n_undefined", "method", "definition", "note"),
    *("std", "seed"),
)


@dataclass(frozen=True)
class Row:
    """A line of the table.

    Args:
        agent: its class or name, with the settings that distinguish it; or a directory.
        measure: a metric, a measure of how tasks ended, or ``solved`` and a task.
        seed: of one run; None for all seeds.
        columns: measures that tables show of its agent on its curriculum.
    """

    curriculum: str
    agent: str
    measure: str
    estimate: Estimate
    definition: str
    note: str
    seed: int | None = None
    columns: tuple[str, ...] = ()

    @property
    def kind(self) -> str:
        """The measure without a task."""
        return self.measure.split(" ")[0]

    @property
    def shown(self) -> str:
        """The agent, and the seed of a single run's row."""
        return self.agent if self.seed is None else f"{self.agent}, seed {self.seed}"


MeasureLine = tuple[str, Estimate, str, str]


def table(runs: Sequence[Run], statistics: str = "exact", count: Count = silent) -> list[Row]:
    """Return every metric, and how tasks ended, for each agent on each curriculum.

    Args:
        statistics: one of `ctgraph_rl.parsers.STATISTICS`.
        count: called after each agent on a curriculum.

    Raises:
        ModuleNotFoundError: for several seeds without scipy.
    """
    bounds = bounds_by_curriculum(runs)
    shown = columns_of_runs(runs)
    rows = []
    groups = grouped(runs)
    if any(len(by_seed) > 1 for by_seed in groups.values()):
        scipy("stats")
    for done, ((name, agent), by_seed) in enumerate(groups.items(), 1):
        for line in _lines(by_seed, bounds[name], statistics):
            rows.append(Row(name, agent, *line, columns=_columns(by_seed, shown[name])))
        count("agents", done, len(groups))
    return rows


def rows_by_seed(runs: Sequence[Run]) -> list[Row]:
    """Return every metric, and how tasks ended, of each run."""
    bounds = bounds_by_curriculum(runs)
    shown = columns_of_runs(runs)
    rows = []
    for (name, agent), by_seed in grouped(runs).items():
        for seed, run in by_seed.items():
            for measure, estimate, definition, note in _lines({seed: run}, bounds[name], "std"):
                if measure != "interquartile_return":
                    note = "" if estimate.n else note
                    one = replace(estimate, low=None, high=None, method="one run", reason=None)
                    shows = _columns(by_seed, shown[name])
                    rows.append(Row(name, agent, measure, one, definition, note=note, seed=seed, columns=shows))
    return rows


def _columns(by_seed: BySeed, shown: tuple[str, ...]) -> tuple[str, ...]:
    """Return what tables show of an agent: the objective of tuning runs, else a curriculum's and the solved rate."""
    tuned = objective(present(by_seed)[0])
    return (*shown, "solved_rate") if tuned is None else (tuned,)


def comparisons(runs: Sequence[Run], metric: str) -> dict[tuple[str, str, str], Comparison]:
    """Return the comparisons of every two agents on the same curriculum and seeds, by (curriculum, first, second), with
    corrected p.

    Raises:
        ValueError: if no run has the metric.
    """
    choices: dict[str, None] = {}
    for run in runs:
        choices |= dict.fromkeys(run.metrics)
    exact = metric in metrics.METRICS and metrics.METRICS[metric].is_exact
    same = f"{metric} follows from the curriculum, so that agents do not differ in it; compare another metric"
    require((metric in choices, _no_measure([metric], choices)), (not exact, same))
    found = {}
    bounds = bounds_by_curriculum(runs)
    for (first, one), (second, other) in combinations(grouped(runs).items(), 2):
        if first[0] == second[0] and list(one) == list(other):
            limits = bounds[first[0]].of_metric(metric)
            compared = statistics.compare(_values(one, metric), _values(other, metric), bounds=limits)
            found[first[0], first[1], second[1]] = compared
    return statistics.corrected(found)


def selected(rows: Sequence[Row], names: Sequence[str] | None = None, also: Sequence[str] = ()) -> list[Row]:
    """Return the rows of some measures; agents without a finished run stay.

    Args:
        names: of measures, ``solved`` for all tasks' shares; None: the rows' columns, and those of `WHERE_KNOWN` with
            a value.

    Raises:
        ValueError: for a name that no row has.
    """
    choices = dict.fromkeys(row.kind for row in rows if row.measure != NO_RUN_FINISHED)
    unknown = [name for name in names or () if name not in choices]
    require((not choices or not unknown, _no_measure(unknown, choices)))
    known = set()
    for row in rows:
        if row.measure in WHERE_KNOWN and row.estimate.n:
            known.add((row.curriculum, row.columns, row.measure))
    found = []
    for row in rows:
        wanted = (*row.columns, *also) if names is None else names
        is_known = names is None and (row.curriculum, row.columns, row.measure) in known
        if row.kind in (*wanted, NO_RUN_FINISHED) or is_known:
            found.append(row)
    return found


def _no_measure(unknown: Sequence[str], choices: Iterable[str]) -> str:
    known = list(choices)
    near = [nearest(name, known) for name in unknown]
    meant = ", ".join(dict.fromkeys(filter(None, near)))
    such = f"there are {len(known)}, such as {', '.join(known[:2])}; --all shows them"
    hint = f"did you mean {meant}?" if meant else such
    own = "of your own, import its module in your agent's module or training script, and run again"
    return (
        f"no run has a measure {', '.join(map(repr, unknown))}: {hint}; to have one {own} (docs/how-to/own_metric.md)"
    )


def write_csv(path: Path | str, rows: Sequence[Row]) -> None:
    """Write the table as CSV, with empty cells for what is undefined."""
    lines: list[Sequence[Any]] = [HEADER]
    for row in rows:
        e = row.estimate
        numbers = (e.value, e.low, e.high, e.n, e.n_undefined, e.method)
        lines.append((row.curriculum, row.agent, row.measure, *numbers, row.definition, row.note, e.std, row.seed))
    write_named(path, csv_text(lines, "\r\n"))


def write_tidy(path: Path, runs: Sequence[Run]) -> None:
    """Write every evaluation as a row of one table, in CSV or Parquet by the file's ending.

    Raises:
        ValueError: for another ending.
        ModuleNotFoundError: for Parquet without pyarrow.
    """
    logs = []
    for (_, agent), by_seed in grouped(runs).items():
        readable = [run for run in present(by_seed) if run.history is not None]
        logs += [(agent, str(run.path), RunLog.read(run.path / LOG)) for run in readable]
    write_evaluations(path, logs)


def _lines(by_seed: BySeed, bounds: BoundsOfRuns, kind: str) -> Iterator[MeasureLine]:
    runs = by_seed.values()
    definitions: dict[str, str] = {}
    tasks: dict[str, None] = {}
    for run in present(by_seed):
        for name, metric in run.metrics.items():
            definitions.setdefault(name, metric["definition"])
        tasks |= dict.fromkeys(run.success)
    if not definitions:
        estimate = mean([None] * len(by_seed))
        yield NO_RUN_FINISHED, estimate, "", _note(by_seed, None, estimate)
    tuned = objective(present(by_seed)[0])
    for name, definition in definitions.items():
        estimate = _metric(by_seed, name, bounds, kind)
        if name == tuned:
            estimate = replace(estimate, digits=4)  # trials differ by little
        yield name, estimate, definition, _note(by_seed, name, estimate)
    ended: dict[str, Estimate] = {}
    if any(run.tasks for run in present(by_seed)):
        returns = [None if run is None else _mean([run.returns[task] for task in run.tasks]) for run in runs]
        solved = [None if run is None else _mean([_solved(run, task) for task in run.tasks]) for run in runs]
        ended["mean_final_return"] = _over_seeds(returns, bounds.of_returns, kind)
        ended["solved_rate"] = _over_seeds(solved, (0.0, 1.0), kind)
    if tasks:
        of_tasks = [[None if run is None else run.returns.get(task) for run in runs] for task in tasks]
        if kind == "iqm":
            ended["interquartile_return"] = statistics.iqm(of_tasks)
        else:
            ended["interquartile_return"] = statistics.interquartile_mean(of_tasks, bounds=bounds.of_returns)
    for task in tasks:
        ended[f"solved {task}"] = statistics.solved_rate([_solved(run, task) for run in runs])
    for measure, estimate in ended.items():
        yield measure, estimate, AT_END[measure.split(" ")[0]].id, _note(by_seed, None, estimate)


def _metric(by_seed: BySeed, name: str, bounds: BoundsOfRuns, kind: str) -> Estimate:
    values = _values(by_seed, name)
    defined = metrics.METRICS.get(name)
    if defined is not None and defined.is_time:
        for place, run in enumerate(by_seed.values()):
            if run is not None and run.metrics.get(name, {}).get("n_undefined"):
                values[place] = math.inf
        return statistics.median_time(values)
    if defined is not None and defined.is_exact:
        return statistics.constant(values)
    return _over_seeds(values, bounds.of_metric(name), kind)


def _over_seeds(values: Sequence[float | None], bounds: statistics.LowHigh, kind: str) -> Estimate:
    if kind == "t":
        return mean(values)
    if kind == "std":
        return statistics.mean_and_std(values)
    if kind == "iqm":
        return statistics.iqm([values])
    return mean(values, bounds=bounds)


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return fmean(known) if known and len(known) == len(values) else None


def _solved(run: Run | None, task: str) -> bool | None:
    rate = None if run is None else run.success.get(task)
    return None if rate is None else rate >= SOLVED


def _values(by_seed: BySeed, metric: str) -> list[float | None]:
    return [None if run is None else run.metrics.get(metric, {}).get("value") for run in by_seed.values()]


def _note(by_seed: BySeed, metric: str | None, estimate: Estimate) -> str:
    reasons: dict[str, list[str]] = {}
    for seed, run in by_seed.items():
        reason: str | None
        if run is None:
            reason = "no run"
        elif run.reason is not None or metric is None:
            reason = run.reason
        elif metric not in run.metrics:
            reason = "another version, without this metric"
        else:
            undefined = run.metrics[metric]["value"] is None
            reason = run.metrics[metric]["undefined"] if undefined else caveats(run).get(metric)
        if reason is not None:
            reasons.setdefault(reason, []).append(str(seed))
    notes = [f"seed {', '.join(seeds)}: {reason}" for reason, seeds in reasons.items()]
    return "; ".join(filter(None, [*notes, estimate.reason]))


def print_table(run_dirs: Sequence[Path]) -> None:
    """Print the most important measures of runs."""
    runs, problems = find_runs(run_dirs, tuning=True)
    print(FORMATS["text"](selected(table(runs)), modifications(runs), LEGENDS["exact"]))
    for problem in problems:
        print_note("left out", problem.reason)


def main() -> None:
    """Print the table of many runs, and write it where asked."""
    parser = parsers.results()
    arguments = parser.parse_args()
    if arguments.difference is not None and arguments.compare is None:
        parser.error("--difference is of the metric that --compare names; give both")
    with refused_by(parser):
        require(*(positive(difference=arguments.difference) if arguments.difference is not None else ()))
        if arguments.tidy is not None:
            check_table(arguments.tidy)
        with StepCounter() as count:
            runs, problems = find_runs(arguments.runs, count, arguments.tuning)
            require((bool(runs), why_left_out(problems)))
            runs = displayed(runs, arguments.agent)
            pairs = {} if arguments.compare is None else comparisons(runs, arguments.compare)
            agents = ", ".join(f"{agent} on {curriculum}" for curriculum, agent in grouped(runs))
            rule = f"--compare needs two agents with the same seeds on one curriculum, got {agents}"
            has_pairs = bool(pairs) or arguments.compare is None
            require((has_pairs, f"{rule}; add the runs of another agent, or leave --compare out"))
            rows = rows_by_seed(runs) if arguments.per_seed else table(runs, arguments.statistics, count)
        names = None if arguments.metrics is None else list(map(str.strip, arguments.metrics.split(",")))
        also = ["interquartile_return"] if arguments.statistics == "iqm" else []
        shown = rows if arguments.all else selected(rows, names, also)
        kind = "seeds" if arguments.per_seed else arguments.statistics
        print(FORMATS[arguments.format](shown, modifications(runs), LEGENDS[kind]))
        if arguments.csv is not None:
            write_csv(arguments.csv, rows)
        if arguments.tidy is not None:
            write_tidy(arguments.tidy, runs)
        for pair, found in pairs.items():
            print("\n" + SENTENCES[arguments.format](_sentence(*pair, found, arguments.difference)))
    if print_problems(problems, runs):
        sys.exit(1)


def _sentence(curriculum: str, first: str, second: str, found: Comparison, difference: float | None) -> str:
    record = f"better in {found.wins}, equal in {found.ties}, worse in {found.losses}"
    parts = [f"{curriculum}: {first} - {second}: {found.difference}", record]
    if found.p_value is not None:
        is_found = found.holm is not None and found.holm <= 1 - statistics.LEVEL
        unclear = "" if is_found else f": not distinguishable with {found.difference.n} seeds"
        parts.append(f"sign-flip p = {found.p_value:.3g}, Holm {found.holm:.3g}{unclear}")
        if found.needed is not None:
            parts.append(f"{found.needed:,} would find such a difference with a chance of 80 %")
    if difference is not None and found.std is not None:
        seeds = statistics.pairs_needed(difference, found.std)
        parts.append(f"{seeds} seeds find a difference of {difference:g} with a chance of 80 %")
    return "; ".join(parts)


if __name__ == "__main__":
    main()
