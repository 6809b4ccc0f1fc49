"""Learning times of a collective's members, messages, and who helped whom.

The first line of ``collective.jsonl`` names members and configuration, a line ``exchange`` counts a kind of message, a
line ``help`` is what a member took over. All else follows from it and the members' logs.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

from ctgraph_rl.checks import ReadOnlyValues, require
from ctgraph_rl.disk import write_whole
from ctgraph_rl.learn.messages import DELAYED, DELIVERED, DROPPED, SENT
from ctgraph_rl.log.escape import csv_text
from ctgraph_rl.log.files import LOG, METRICS, member_folder
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.log.sums import write_metrics
from ctgraph_rl.metrics.record import HERE, MASTERED, Metric
from ctgraph_rl.runs.read import split_by

COLLECTIVE = "collective.jsonl"

FILES = (COLLECTIVE, "members.csv", "messages.csv", "helps.csv", METRICS)

LAST = 5
"""Batches at the end of a block whose mean return is its final one, as in the raw data of MOSAIC."""

WHAT = (SENT, DELIVERED, DROPPED, DELAYED)

RUN = ("curriculum", "agent", "method", "exchange", "num_members", "seed")
"""First columns of all tables: which collective a row belongs to."""


class Learned(NamedTuple):
    """What a member learned in a block."""

    member: int  # from 0
    member_seed: int
    block: int  # from 1
    label: str
    frames: int  # of the block
    frames_to_learn: int | None  # until `MASTERED` of a batch's episodes were at the goal; None if never
    final_return: float | None  # mean of the last batches with finished episodes


@dataclass(frozen=True)
class Collective:
    """A collective as data."""

    path: Path
    about: ReadOnlyValues
    config: ReadOnlyValues
    learned: Sequence[Learned]
    messages: Sequence[ReadOnlyValues]
    helps: Sequence[ReadOnlyValues]

    @property
    def learning_time(self) -> float:
        """Mean frames that a member needs to learn a block; an unlearned block counts with all its frames."""
        return fmean(each.frames if each.frames_to_learn is None else each.frames_to_learn for each in self.learned)

    @property
    def share_learned(self) -> float:
        """Share of the members' blocks that were learned."""
        return sum(each.frames_to_learn is not None for each in self.learned) / len(self.learned)

    @property
    def final_return(self) -> float:
        """Sum over members of the mean final return of their blocks; blocks without one count 0."""
        blocks = Counter(each.member for each in self.learned)
        values = []
        for each in self.learned:
            if each.final_return is not None:
                values.append(each.final_return / blocks[each.member])
        return math.fsum(values)

    def total(self, what: str) -> int:
        """Return the sum of a column of the messages."""
        return sum(row[what] for row in self.messages)


def read_collective(path: Path | str) -> Collective:
    """Read the directory of a collective.

    Raises:
        ValueError: if it holds none, or a log is damaged.
        OSError: if a log cannot be read.
    """
    path = Path(path)
    log = RunLog.read(path / COLLECTIVE)
    [about, *_] = [*log.of_kind("collective"), {}]
    names = about.get("config"), about.get("members")
    require((all(names), f"{path / COLLECTIVE} does not say what was run: its first line is missing"))
    config = about["config"]
    members = about["members"]
    called = {part: str(config[part]["_target_"]).rpartition(".")[2] for part in ("agent", "method", "exchange")}
    run = {"curriculum": members[0]["curriculum"], **called, "num_members": len(members), "seed": config["seed"]}
    learned: list[Learned] = []
    for number, each in enumerate(members):
        learned += _learned(path, number, each)
    return Collective(path, run, config, learned, messages=log.of_kind("exchange"), helps=log.of_kind("help"))


def _learned(path: Path, number: int, about: ReadOnlyValues) -> Iterator[Learned]:
    log = RunLog.read(member_folder(path, number) / LOG)
    trained = log.about["trained"]
    start = 0
    for block, own in sorted(split_by(log.of_kind("training"), lambda line: line["block"]).items()):
        returns = []
        reached = []
        for line in own:
            if line["return_mean"] is not None:
                returns.append(line["return_mean"])
                share = line.get("success_rate")
                if (returns[-1] if share is None else share) >= MASTERED:
                    reached.append(line["frames"] - start)
        label = " ".join(about["labels"][task - 1] for task in trained[block - 1])
        end = own[-1]["frames"]
        yield Learned(
            number,
            about["seed"],
            block,
            label,
            frames=end - start,
            frames_to_learn=min(reached, default=None),
            final_return=fmean(returns[-LAST:]) if returns else None,
        )
        start = end


def describe_collective(collective: Collective) -> str:
    """Return a few lines on a collective."""
    about = collective.about
    num = len(collective.learned)
    return "\n".join(
        [
            f"{about['num_members']} members, {about['exchange']}, {about['curriculum']}: learned "
            f"{collective.share_learned:.0%} of {num} blocks, {collective.learning_time:,.0f} frames each on average",
            f"messages: {collective.total(SENT):,} sent, {collective.total(DROPPED):,} lost, "
            f"{collective.total(DELAYED):,} late, "
            f"{collective.total('bytes'):,} bytes; {len(collective.helps):,} masks taken over",
            f"results: {collective.path}",
        ]
    )


def write_summary(run_dir: Path) -> None:
    """Write the tables of a finished collective and, last, its metrics."""
    collective = read_collective(run_dir)
    for name, rows in tables([collective]).items():
        write_whole(run_dir / name, csv_text(rows))
    write_metrics(run_dir / METRICS, metrics(collective))


def tables(collectives: Sequence[Collective]) -> dict[str, list[list[Any]]]:
    """Return the tidy tables of collectives by file name, columns first."""
    messages = ["round", "frames", "message", *WHAT, "bytes"]
    helps = ["round", "receiver", "sender", "block", "frames"]
    extra: set[str] = set()
    for each in collectives:
        extra.update(*each.helps)
    helps += sorted(extra - {*helps, "kind", "seconds"})
    found: dict[str, list[list[Any]]] = {
        "members.csv": [[*RUN, *Learned._fields]],
        "messages.csv": [[*RUN, *messages]],
        "helps.csv": [[*RUN, *helps]],
    }
    for each in collectives:
        run = [each.about[name] for name in RUN]
        found["members.csv"] += [[*run, *row] for row in each.learned]
        found["messages.csv"] += [[*run, *map(row.get, messages)] for row in each.messages]
        found["helps.csv"] += [[*run, *map(row.get, helps)] for row in each.helps]
    return found


def metrics(collective: Collective) -> dict[str, Metric]:
    """Return the metrics of a collective."""
    values = {
        "learning_time": (
            collective.learning_time,
            f"mean over members and blocks of the frames until a batch has {MASTERED} of its episodes at the goal, or "
            "that mean return in tasks without goals; all frames of a block that has no such batch",
        ),
        "share_learned": (collective.share_learned, "share of members' blocks with such a batch"),
        "final_return": (collective.final_return, f"sum over members of the mean return of the last {LAST} batches"),
        "messages": (float(collective.total(SENT)), "messages that were sent"),
        "bytes": (float(collective.total("bytes")), "bytes of their content"),
        "helps": (float(len(collective.helps)), "masks that were taken over"),
    }
    return {name: Metric(value, f"collective/{name}", formula, HERE) for name, (value, formula) in values.items()}
