"""Raw results of collectives: a line for each one, and a line for each member and block."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from studies.collectives import selecting
from studies.raw import Raw, grow, lost, machine_of, merged

NAME, BLOCKS = "collectives", "collective_blocks"

CELL = ("curriculum", "frames_of_block", "exchange", "num_members", "num_epochs")
"""The columns that tell the cells of an experiment apart."""

KEY = (*CELL, "seed")

SOLVED = 0.9
"""The least mean return of greedy episodes in a task that is solved; the optimum is 1."""

SETTLED = 5
"""Batches after the first one with such a return, from which on `_below` counts."""


def collect(name: str, folders: Sequence[Path], add: bool = False) -> None:
    """Add the finished collectives under some folders, and the runs on ct28, to tables that grow.

    collectives.csv has a line for each collective, collective_blocks.csv one for each member and block, selecting.csv
    one for each task of a run on ct28. They grow until they have all runs of the stored tables.

    Args:
        name: of the first table.
        folders: with run directories.
        add: whether runs that are not under the folders stay as the stored tables have them.
    """
    found = [measured(path) for folder in folders for path in sorted(folder.rglob("collective.jsonl"))]
    new = [pair for pair in found if pair is not None]
    collectives = merged(name, [line for line, _ in new], KEY, add)
    blocks = merged(BLOCKS, [line for _, lines in new for line in lines], KEY, add)
    alone = merged(selecting.NAME, selecting.measured(folders), selecting.KEY, add)
    tables = {name: _ordered(collectives), BLOCKS: _ordered(blocks), selecting.NAME: selecting.ordered(alone)}
    grow(tables, lost(name, collectives, KEY) + lost(selecting.NAME, alone, selecting.KEY))


def _ordered(lines: Raw) -> Raw:
    """Return lines in the order of their columns `KEY`."""
    return sorted(lines, key=lambda line: [_place(line[key]) for key in KEY])


def _place(value: object) -> tuple[int, str]:
    """Order numbers by their value, and texts behind them."""
    text = str(value)
    return (int(text), "") if text.isdigit() else (10**9, text)


def measured(log: Path) -> tuple[dict[str, Any], list[dict[str, Any]]] | None:
    """Return the line of a collective and those of its members' blocks; None if it is not finished."""
    from ctgraph_rl.collective.summary import read_collective
    from ctgraph_rl.log.run_log import RunLog

    if not (log.parent / "metrics.json").exists():
        return None
    collective = read_collective(log.parent)
    metrics = json.loads((log.parent / "metrics.json").read_text(encoding="utf-8"))
    about = RunLog.read(log.parent / "member_000" / "run.jsonl").of_kind("run")[0]
    [frames] = {each.frames for each in collective.learned}
    cell = {
        "curriculum": about["curriculum"].removesuffix(" (modified)"),  # in frames and evaluations, which are columns
        "frames_of_block": frames,
        "exchange": _exchange(collective.config["exchange"]),
        "num_members": len({each.member for each in collective.learned}),
        "num_epochs": collective.config["agent"]["num_epochs"],
        "seed": collective.config["seed"],
    }
    values = {key: metrics[key]["value"] for key in ("learning_time", "share_learned", "messages", "bytes", "helps")}
    members = dict.fromkeys(each.member for each in collective.learned)
    folders = {number: log.parent / f"member_{number:03}" for number in members}
    returns = [each.final_return for each in collective.learned]
    final = {"final_return": math.fsum(0.0 if math.isnan(value) else value for value in returns) / len(returns)}
    blocks = []
    for number, folder in folders.items():
        own = [each for each in collective.learned if each.member == number]
        blocks += [{**cell, **block} for block in _blocks(folder, own)]
    every = collective.config["evaluation"]["every"] or frames
    values |= {**final, **_promised(log.parent, collective.helps)}
    return {**cell, "evaluated_every": every, **values, "numbers": about["numbers"], **machine_of(about)}, blocks


def _blocks(member: Path, learned: Sequence[Any]) -> Iterator[dict[str, Any]]:
    """Yield the cells of each block that a member learned."""
    solved = _solved(member)
    below = _below(member)
    for each in learned:
        yield {
            "member": each.member,
            "block": each.block,
            "task": each.label,
            "frames_to_learn": "" if each.frames_to_learn is None else each.frames_to_learn,
            "frames_to_solve": solved.get(each.block, ""),
            "final_return": "" if math.isnan(each.final_return) else round(each.final_return, 6),
            "share_below": below.get(each.block, ""),
        }


def _solved(member: Path) -> dict[int, int]:
    """Return the frames of each block until an evaluation within it found its task solved; nothing where none did."""
    from ctgraph_rl.log.run_log import RunLog

    log = RunLog.read(member / "run.jsonl")
    ends: dict[int, int] = {}
    found: dict[int, int] = {}
    for line in log.of_kind("training"):
        ends[line["block"]] = line["frames"]
    trained = log.of_kind("run")[0]["trained"]
    for line in log.of_kind("evaluation"):
        for block, end in ends.items():
            start = ends.get(block - 1, 0)
            if start < line["frames"] <= end and [line["task"]] == trained[block - 1] and line["return_mean"] >= SOLVED:
                found.setdefault(block, line["frames"] - start)
    return found


def _below(member: Path) -> dict[int, float]:
    """Return each block's share of batches with a mean return below `SOLVED`, from `SETTLED` after the first above.

    Blocks without such a batch have none.
    """
    from ctgraph_rl.log.run_log import RunLog

    returns: dict[int, list[float]] = {}
    for line in RunLog.read(member / "run.jsonl").of_kind("training"):
        returns.setdefault(line["block"], []).append(line["return_mean"])
    found = {}
    for block, values in returns.items():
        first = next((i for i, value in enumerate(values) if value >= SOLVED), len(values))
        later = values[first + SETTLED :]
        if later:
            found[block] = round(sum(not value >= SOLVED for value in later) / len(later), 6)
    return found


def _promised(folder: Path, helps: Sequence[Mapping[str, Any]]) -> dict[str, float | str]:
    """Return the mean return that was reported with masks that were taken over, and that of the batch after it."""
    from ctgraph_rl.log.run_log import RunLog

    reported, obtained = [], []
    for member in sorted({line["receiver"] for line in helps}):
        batches = RunLog.read(folder / f"member_{member:03}" / "run.jsonl").of_kind("training")
        for line in (line for line in helps if line["receiver"] == member):
            following = next((batch for batch in batches if batch["frames"] > line["frames"]), None)
            if following is not None and following["block"] == line["block"]:
                reported.append(line["return_of_sender"])
                obtained.append(following["return_mean"])
    means = {"reported_return": reported, "obtained_return": obtained}
    return {name: round(sum(each) / len(each), 6) if each else "" for name, each in means.items()}


def _exchange(config: Mapping[str, Any]) -> str:
    """Return the name of an exchange's file, which the configuration of a run lacks."""
    name = str(config["_target_"]).rpartition(".")[2].lower()
    return name if config.get("use_similarity", True) else f"{name}_no_similarity"
