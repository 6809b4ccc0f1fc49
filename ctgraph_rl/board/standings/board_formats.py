"""What tables of the board show, as cells and CSV."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from ctgraph_rl.board.standings.board_tables import BoardTable, Standing, is_significant
from ctgraph_rl.board.standings.track_ceilings import write_ceiling
from ctgraph_rl.board.tracks import write_seeds
from ctgraph_rl.board.verification import STATES
from ctgraph_rl.log.escape import csv_text
from ctgraph_rl.report.formats import MEANS, measure_name

LEGEND = (
    f"{MEANS}; rank: those that comparisons of all pairs leave open, seed by seed, with Holm's correction at 5 %; "
    "n: seeds with a score; bytes per task: kept for each further task, as the authors say; hours: of all seeds"
)


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
        BoardColumn("level", entry.verified, STATES.index(entry.level)),
    ]


def notes(table: BoardTable) -> list[str]:
    """Return notes on lines: no rank, a verification that does not count, and failed seeds."""
    found = []
    for line in table.standings:
        why = line.entry.why_not_ranked
        found += [f"{line.name} has no rank: {why}."] if why else []
        none = line.entry.verification.why_none
        found += [f"{line.name}: {none}."] if none else []
        for seed, reason in line.entry.method["failed"].items():
            found.append(f"{line.name}, seed {seed} failed: {reason}")
    return found


def facts(table: BoardTable) -> list[tuple[str, str]]:
    """Return what a table's tasks allow, with budget and seeds."""
    curriculum = table.variant.curriculum
    about = [
        ("curriculum", f"{curriculum.name}, fingerprint {curriculum.fingerprint}"),
        ("steps", f"{curriculum.num_frames:,}"),
        ("seeds", write_seeds(table.track.seeds)),
    ]
    for name, value in table.ceilings.items():
        if value is not None:
            about.append((name, write_ceiling(value)))
    return about


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


def entries_csv(tables: Sequence[BoardTable]) -> str:
    """Return a line for each entry; the interval is of 95 %, hours are those of all runs."""
    rows = []
    for table in tables:
        variant = table.variant
        for line in table.standings:
            entry = line.entry
            score = line.score
            row = {
                "submission": entry.id,
                "method": entry.name,
                "track": table.track.id,
                "rung": variant.rung,
                "given": variant.given,
                "fingerprint": variant.curriculum.fingerprint,
                "steps": entry.frames,
                "best_rank": line.best_rank,
                "worst_rank": line.worst_rank,
                "score": table.track.score,
                "value": score.value,
                "low": score.low,
                "high": score.high,
                "seeds": score.n,
                "seeds_without": score.n_undefined,
                "bytes_per_task": entry.method["bytes_per_task"],
                "agent_bytes": entry.agent_bytes,
                "hours": entry.hours,
                "level": entry.verified,
            }
            rows.append(row)
    return csv_text([rows[0], *map(dict.values, rows)])


def scores_csv(tables: Sequence[BoardTable]) -> str:
    """Return a line for each metric of each seed of each entry; undefined values are empty."""
    rows: list[tuple[Any, ...]] = [("submission", "seed", "metric", "value")]
    for table in tables:
        for line in table.standings:
            entry = line.entry
            for metric, values in entry.values.items():
                for seed, value in zip(table.track.seeds, values, strict=True):
                    rows.append((entry.id, seed, metric, value))
    return csv_text(rows)
