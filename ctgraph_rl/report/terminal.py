"""A run on the terminal: performance matrix, curves and main metrics, and notes on different code."""

from __future__ import annotations

import json
import math
import sys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from statistics import fmean

from rich.console import Console
from rich.table import Table
from rich.text import Text

from ctgraph_rl.checks import ReadOnlyValues, require
from ctgraph_rl.log.escape import listed, terminal_text
from ctgraph_rl.log.provenance import numbers_of
from ctgraph_rl.report.columns import WHERE_KNOWN, caveats, columns, objective
from ctgraph_rl.report.formats import measure_name
from ctgraph_rl.report.names import modification
from ctgraph_rl.runs.read import FOLDER, MOST_SEEDS, Curve, History, Problem, Run, code_of, read_run
from ctgraph_rl.runs.settings import as_before

OF_DETECTION = ("detection_delay", "false_alarms", "labels_per_task", "label_agreement")
"""Metrics that are shown; the file has all."""

IN_WINDOWS = (
    *("window_return", "window_regret", "window_solved", "jump_start"),
    *("adaptation_frames", "never_adapted"),
)

LONGEST_LABEL = 24

BARS, ASCII_BARS = "▁▂▃▄▅▆▇█", "_.-:=+*#"

MOST_POINTS = 32
"""Characters of a curve; more evaluations share them."""

FEWEST_POINTS = 5

WIDEST, NARROWEST = 10**6, len(" - |")


def print_summary(run_dir: Path | str, console: Console | None = None) -> None:
    """Print a finished run's performance matrix, evaluation curves and metrics."""
    console = Console() if console is None else console
    bars = BARS if console.encoding.lower().startswith("utf") else ASCII_BARS
    run = read_run(Path(run_dir))
    history = run.history
    require((history is not None, f"{run_dir} cannot be shown: {run.reason}"))
    assert history is not None
    name = Path(run_dir).name
    tables = []
    if len(history.labels) * NARROWEST <= console.width:
        matrix = Table(title=_text(f"{name}: mean return on each task after each block"))
        for heading in ("block", "frames", *history.labels):
            matrix.add_column(_text(heading), justify="right")
        for block, (frames, values) in enumerate(zip(history.ends, history.performance, strict=False)):
            matrix.add_row(str(block), f"{frames:,}", *map(_shown, values))
        curves = Table("task", "mean return at every evaluation")
        for label, line in sparklines(history.evaluations, bars).items():
            curves.add_row(_text(label), _text(line))
        tables = [matrix, curves]
    if not tables or max(map(_width, tables)) > console.width:
        of_tasks = _tasks(name, history, {})
        room = console.width - _width(of_tasks) - len("│  ")
        if room >= FEWEST_POINTS:
            of_tasks = _tasks(name, history, sparklines(history.evaluations, bars, min(room, MOST_POINTS)))
        tables = [of_tasks]
    modified = modification(run)
    if modified:
        console.print(_text(f"{run.curriculum[0]}: {modified}"))
    always = columns(history.trained, bool(history.adaptation), "life" in run.about)
    tuned = objective(run)
    if tuned is not None:
        always = (tuned,)
    if "life" in run.about:
        tables = [_life(name, run)]
    for table in (*tables, metrics_table(run.metrics, always)):
        console.print(table)
    for metric, sentence in caveats(run).items():
        if metric in always:
            console.print(_text(f"{measure_name(metric)}: {sentence}"))


def _width(table: Table) -> int:
    return Console(width=WIDEST).measure(table).maximum


def _text(plain: str) -> Text:
    return Text(terminal_text(plain))


def sparklines(evaluations: Mapping[str, Curve], bars: str = BARS, most: int = MOST_POINTS) -> dict[str, str]:
    """Return a line of text for each task: its mean return at all evaluations, on one scale.

    The scale goes from the lowest value, or 0, to the highest, or 1. Evaluations beyond ``most`` share a place with
    their mean; one without a value is a space.
    """
    known = [0.0, 1.0]
    for curve in evaluations.values():
        known += [value for _, value in curve if not math.isnan(value)]
    low = min(known)
    high = max(known)
    lines = {}
    for label, curve in evaluations.items():
        places = min(most, len(curve))
        line = ""
        for place in range(places):
            part = curve[len(curve) * place // places : len(curve) * (place + 1) // places]
            there = [value for _, value in part if not math.isnan(value)]
            line += bars[round((fmean(there) - low) / (high - low) * (len(bars) - 1))] if there else " "
        lines[label] = line
    return lines


def _tasks(name: str, history: History, curves: Mapping[str, str]) -> Table:
    where = f"ctgraph-rl export has it after each of {len(history.ends) - 1} blocks"
    table = Table(title=_text(f"{name}: mean return on each task; {where}"))
    for heading in ("task", "before", "best", "in block", "at end"):
        table.add_column(heading, justify="left" if heading == "task" else "right")
    if curves:
        table.add_column("curve")
    by_task = zip(*history.performance[: len(history.ends)], strict=True)
    half = LONGEST_LABEL // 2
    for label, values in zip(history.labels, by_task, strict=True):
        known = [(value, -block) for block, value in enumerate(values) if block and not math.isnan(value)]
        best, block = max(known, default=(math.nan, 0))
        short = label if len(label) <= LONGEST_LABEL else f"{label[: half - 2]}...{label[1 - half :]}"
        curve = [_text(curves.get(label, ""))] if curves else []
        numbers = (_shown(values[0]), _shown(best), str(-block) if best > 0 else "-", _shown(values[-1]))
        table.add_row(_text(short), *numbers, *curve)
    return table


def _life(name: str, run: Run) -> Table:
    table = Table(title=_text(f"{name}: means over windows of tasks"))
    table.add_column("window", no_wrap=True)
    for metric in IN_WINDOWS:
        table.add_column(metric.replace("_", "\n"), justify="right")
    for number, label in enumerate(run.history.labels if run.history else ()):
        terms = {metric: run.windows(metric)[number] for metric in IN_WINDOWS}
        shown = []
        for metric, term in terms.items():
            at_least = ">= " if metric == "adaptation_frames" and terms["never_adapted"] > 0 else ""
            shown.append("-" if math.isnan(term) else f"{at_least}{term:z,.{0 if term >= 100 else 2}f}")
        table.add_row(_text(label), *shown)
    return table


def _shown(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:z.2f}"


def metrics_table(metrics: Mapping[str, ReadOnlyValues], always: Sequence[str]) -> Table:
    """Return metrics with their definitions, or why one of ``always`` is undefined; others only with a value."""
    table = Table(title=f"Metrics; metrics.json has all {len(metrics)}")
    for name, justify in (("metric", "left"), ("value", "right"), ("definition", "left")):
        table.add_column(name, justify=justify)  # type: ignore[arg-type]
    for name in (*always, *WHERE_KNOWN, *OF_DETECTION):
        metric = metrics.get(name)
        if metric is None or (name not in always and metric["value"] is None):
            continue
        value = "undefined" if metric["value"] is None else f"{metric['value']:z.2f}"
        table.add_row(measure_name(name), value, _text(metric["undefined"] or metric["formula"]))
    return table


def mixed_code(runs: Iterable[Run]) -> list[str]:
    """Return a sentence on every configuration with runs of different code, which are shown apart."""
    of: dict[str, dict[tuple[str, str], list[Run]]] = {}
    for run in runs:
        config = {**as_before(run.about["config"]), "seed": 0}
        learner = [run.agent, run.settings.get(FOLDER), None if "curriculum" in config else run.group]
        group, _, code = run.configuration
        states = of.setdefault(json.dumps([config, learner], sort_keys=True), {})
        states.setdefault((group[1], code), []).append(run)
    sentences = []
    for states in of.values():
        if len(states) == 1:
            continue
        every = list(chain(*states.values()))
        fingerprints = len({run.group[1] for run in every}) > 1
        parts = []
        for some in states.values():
            said = [f"fingerprint {some[0].group[1]}"] * fingerprints + [code_of(some[0], every)]
            seeds = listed(sorted(run.seed for run in some), MOST_SEEDS)
            parts.append(f"seed{'s' * (len(some) > 1)} {seeds} ({', '.join(filter(None, said))})")
        who = f"{every[0].agent or every[0].settings[FOLDER]} on {every[0].group[0]} was run with different code"
        sentences.append(f"{who}, shown apart: {'; '.join(parts)}; overwrite=stale runs what is stale again")
    return sentences


def print_problems(problems: Sequence[Problem], runs: Sequence[Run]) -> bool:
    """Print on standard error what is left out, and notes on code.

    Returns:
        Whether something is left out, or runs of one configuration are of different code.
    """
    mixed = mixed_code(runs)
    for problem in problems:
        print_note("left out", problem.reason)
    for sentence in (*mixed, *code_notes(runs)):
        print_note("code", sentence)
    for sentence in label_notes(runs):
        print_note("labels", sentence)
    return any(problem.is_error for problem in problems) or bool(mixed)


def print_note(about: str, sentence: str) -> None:
    """Print a note on standard error."""
    print(terminal_text(f"{about}: {sentence}"), file=sys.stderr)


def group_size(run: Run) -> int:
    """Return how many seeds a run was trained with, itself included."""
    together = run.about.get("together")
    return len(together) if isinstance(together, list) and together else 1


def code_notes(runs: Sequence[Run]) -> list[str]:
    """Return sentences on runs of an older numbers version, of unknown source, and of groups where others are not.

    Groups are those of runs and of their single-task experts.
    """
    older = 0
    unknown = 0
    stored = set()
    needed = set()
    for run in runs:
        code = run.code
        unknown += None in code.values()
        if code["numbers version"] < numbers_of(run.about):
            older += 1
            stored.add(str(code["numbers version"]))
            needed.add(str(numbers_of(run.about)))
    versions = f"of numbers version {', '.join(sorted(stored))}, this package is of {', '.join(sorted(needed))}"
    found = [(older, f"{versions}: it may give other numbers")]
    found.append((unknown, "of unknown code: they do not say of which source they are"))
    for size, count in sorted(Counter(map(group_size, runs)).items()):
        if size > 1 and count < len(runs):
            found.append((count, f"of seeds trained together, {size} at a time; they differ from others by rounding"))
    experts = [run.history.experts_together for run in runs if run.history is not None]
    if {True, False} <= {*chain(*experts)}:
        rounded = "compared with experts of seeds trained together; those differ from others by rounding"
        found.append((sum(map(any, experts)), rounded))
    return [f"{count} of {len(runs)} runs are {what}" for count, what in found if count]


def label_notes(runs: Sequence[Run]) -> list[str]:
    """Return notes on evaluations of runs whose learners gave tasks labels."""
    count = sum(run.history is not None and bool(run.history.spans) for run in runs)
    how = "evaluation uses each task's most frequent label, chosen with knowledge of the true tasks"
    return [f"{count} of {len(runs)} runs have labels of a detector: {how}"] if count else []
