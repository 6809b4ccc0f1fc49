"""Tables of the board as Markdown, LaTeX, CSV and JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from ctgraph_rl import __version__
from ctgraph_rl.board.standings.board_tables import BoardTable, Standing, is_significant
from ctgraph_rl.board.standings.entries import LEVELS, shown_level
from ctgraph_rl.board.standings.track_ceilings import in_words
from ctgraph_rl.checks import NamedValues
from ctgraph_rl.log.escape import csv_text, markdown_table, markdown_text
from ctgraph_rl.metrics import METRICS
from ctgraph_rl.report.formats import MEANS, measure_name
from ctgraph_rl.report.latex import PREAMBLE, Labels, TableCell, latex
from ctgraph_rl.report.latex import Table as LatexTable
from ctgraph_rl.report.statistics import Estimate

SCHEMA = 1

LEGEND = (
    f"{MEANS}; rank: those that comparisons of all pairs leave open, seed by seed, with Holm's correction at 5 %; "
    "n: seeds with a score; bytes per task: kept for each further task, as the authors say; hours: of all seeds"
)


NOT_IN_LATEX = ("method", "bytes of the agent", "steps")


class BoardColumn(NamedTuple):
    """A cell of a line for a page: what is shown, and what the column is sorted by."""

    head: str
    shown: str
    value: float | str | None
    interval: str = ""


def columns(line: Standing) -> list[BoardColumn]:
    """Return the cells of a line."""
    entry = line.entry
    hours = entry.hours
    per_task = entry.method["bytes_per_task"]
    numbers = []
    for name, estimate in line.estimates.items():
        value, _, interval = estimate.shown.partition(" ")
        numbers.append(BoardColumn(measure_name(name), value, estimate.value, interval))
    size = "-" if entry.agent_bytes is None else f"{entry.agent_bytes:,}"
    time = "-" if hours is None else f"{hours:.2g}" if hours < 10 else f"{hours:,.0f}"
    return [
        BoardColumn("rank", line.rank, line.best_rank),
        BoardColumn("method", line.name, line.name.lower()),
        *numbers,
        BoardColumn("n", line.score.seeds, line.score.n),
        BoardColumn("bytes per task", f"{per_task:,}", per_task),
        BoardColumn("bytes of the agent", size, entry.agent_bytes),
        BoardColumn("steps", f"{entry.frames:,}", entry.frames),
        BoardColumn("hours", time, hours),
        BoardColumn("level", entry.verified, LEVELS.index(entry.level)),
    ]


def notes(table: BoardTable) -> list[str]:
    """Return notes on lines: no rank, a verification that does not count, and failed seeds."""
    found = []
    for line in table.standings:
        why = line.entry.why_not_ranked
        found += [f"{line.name} has no rank: {why}."] if why else []
        none = line.entry.verification.why_none
        found += [f"{line.name}: {none}."] if none else []
        for seed, reason in line.entry.failed.items():
            found.append(f"{line.name}, seed {seed} failed: {reason}")
    return found


def facts(table: BoardTable) -> list[tuple[str, str]]:
    """Return what a table's tasks allow, with budget and seeds."""
    curriculum = table.variant.curriculum
    seeds = table.track.seeds
    whole = seeds == tuple(range(seeds[0], seeds[-1] + 1))
    about = [
        ("curriculum", f"{curriculum.name}, fingerprint {curriculum.fingerprint}"),
        ("steps", f"{curriculum.num_frames:,}"),
        ("seeds", f"{seeds[0]} to {seeds[-1]}" if whole else ", ".join(map(str, seeds))),
    ]
    return [*about, *in_words(table.ceilings)]


def verdicts(table: BoardTable) -> list[tuple[str, str, str]]:
    """Return each comparison of a table: the pair, the difference of scores, and the corrected p-value."""
    shown = []
    for (one, other), found in table.pairs.items():
        unclear = "" if is_significant(found) else ", not distinguishable"
        if found.needed is not None:
            unclear += f" ({found.needed:,} seeds would find it)"
        p_value = "-" if found.holm is None else f"{found.holm:.2g}{unclear}"
        shown.append((f"{one} - {other}", found.difference.shown, p_value))
    return shown


def markdown(tables: Sequence[BoardTable]) -> str:
    """Return all tables in Markdown."""
    parts = ["# Board", f"{LEGEND}."]
    for table in tables:
        track = table.track
        parts.append(f"## {markdown_text(table.title)}")
        parts.append(f"{markdown_text(track.measures)} Breakthrough: {markdown_text(track.breakthrough)}")
        parts.append("; ".join(f"{markdown_text(name)}: {markdown_text(value)}" for name, value in facts(table)) + ".")
        rows = []
        for line in table.standings:
            cells = columns(line)
            rows.append([markdown_text(f"{cell.shown} {cell.interval}".strip()) for cell in cells])
        parts.append(markdown_table([cell.head for cell in cells], rows))
        if notes(table):
            parts.append("\n".join(f"- {markdown_text(note)}" for note in notes(table)))
    return "\n\n".join(parts) + "\n"


def tables_tex(tables: Sequence[BoardTable]) -> str:
    """Return all tables in LaTeX."""
    labels = Labels()
    parts = [PREAMBLE]
    for table in tables:
        rows = []
        for line in table.standings:
            cells = [cell for cell in columns(line) if cell.head not in NOT_IN_LATEX]
            rows.append((line.name, [TableCell(cell.shown, cell.interval) for cell in cells]))
        label = labels.new("board", table.track.id, table.variant.rung, table.variant.given)
        caption = f"{table.title}: {LEGEND}."
        parts.append(latex(LatexTable(caption, label, "method", [cell.head for cell in cells], rows)))
    return "\n\n".join(parts) + "\n"


ENTRY_COLUMNS = {
    "submission": "first digits of the submission's digest",
    "method": "name of the method",
    "track": "track with its version",
    "rung": "rung of a ladder; empty for a track of one curriculum",
    "given": "what the learner was given to know of tasks",
    "fingerprint": "what the curriculum is, in 16 digits",
    "steps": "frames that each seed learned from",
    "best_rank": "best rank that the comparisons leave open; empty without a rank",
    "worst_rank": "worst rank that the comparisons leave open",
    "score": "name of the metric that orders the table",
    "value": "its mean over seeds",
    "low": "lower end of the 95 % interval",
    "high": "upper end of the 95 % interval",
    "seeds": "seeds with a value",
    "seeds_without": "seeds without a value",
    "bytes_per_task": "bytes kept for each further task, as the authors say",
    "agent_bytes": "bytes of the largest agent",
    "hours": "hours of computing of all its runs",
    "level": f"how far it was verified: {', '.join(map(shown_level, LEVELS))}; scores: not by bits",
}

SCORE_COLUMNS = {
    "submission": "first digits of the submission's digest",
    "seed": "seed of the run",
    "metric": "name of the metric",
    "value": "its value; empty where it is undefined or the run failed",
}


def entries_csv(tables: Sequence[BoardTable]) -> str:
    """Return a line for each entry."""
    rows: list[Sequence[Any]] = [list(ENTRY_COLUMNS)]
    for table in tables:
        variant = table.variant
        for line in table.standings:
            entry = line.entry
            score = line.score
            about = (entry.id, entry.name, table.track.id, variant.rung, variant.given)
            learned = (variant.curriculum.fingerprint, entry.frames, line.best_rank, line.worst_rank)
            reached = (table.track.score, score.value, score.low, score.high, score.n, score.n_undefined)
            kept = (entry.method["bytes_per_task"], entry.agent_bytes, entry.hours, entry.verified)
            rows.append([*about, *learned, *reached, *kept])
    return csv_text(rows)


def scores_csv(tables: Sequence[BoardTable]) -> str:
    """Return a line for each metric of each seed of each entry."""
    rows: list[Sequence[Any]] = [list(SCORE_COLUMNS)]
    for table in tables:
        for line in table.standings:
            for metric, values in line.entry.values.items():
                for seed, value in zip(line.entry.seeds, values, strict=True):
                    rows.append([line.entry.id, seed, metric, value])
    return csv_text(rows)


def as_json(tables: Sequence[BoardTable]) -> NamedValues:
    """Return all tables as plain values."""
    return {"schema": SCHEMA, "made_by": f"ctgraph_rl {__version__}", "tables": list(map(_json, tables))}


def _json(table: BoardTable) -> NamedValues:
    track = table.track
    variant = table.variant
    comparisons = []
    for (one, other), found in table.pairs.items():
        comparisons.append(
            {
                "first": one,
                "second": other,
                "difference": _numbers(found.difference),
                "p_value": found.p_value,
                "holm": found.holm,
            }
        )
    return {
        "track": {"name": track.name, "version": track.version, "measures": track.measures},
        "breakthrough": track.breakthrough,
        "rung": variant.rung,
        "given": variant.given,
        "curriculum": {"name": variant.curriculum.name, "fingerprint": variant.curriculum.fingerprint},
        "steps": variant.curriculum.num_frames,
        "seeds": list(track.seeds),
        "score": {"name": track.score, "definition": METRICS[track.score].meaning.id},
        "ceilings": table.ceilings._asdict(),
        "entries": list(map(_json_line, table.standings)),
        "comparisons": comparisons,
    }


def _json_line(line: Standing) -> NamedValues:
    entry = line.entry
    return {
        "name": line.name,
        "digest": entry.digest,
        "method": dict(entry.method),
        "level": entry.level,
        "bits": entry.verification.bits,
        "best_rank": line.best_rank,
        "worst_rank": line.worst_rank,
        "why_not_ranked": entry.why_not_ranked,
        "measures": {name: _numbers(estimate) for name, estimate in line.estimates.items()},
        "values": {name: list(values) for name, values in entry.values.items()},
        "agent_bytes": entry.agent_bytes,
        "failed": dict(zip(map(str, entry.failed), entry.failed.values(), strict=True)),
    }


def _numbers(estimate: Estimate) -> NamedValues:
    names = ("value", "low", "high", "n", "n_undefined", "method")
    return {name: getattr(estimate, name) for name in names}
