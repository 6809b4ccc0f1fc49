"""Submissions as entries of the board: what a table needs of them, and how far they were verified."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ctgraph_rl.board.submission import METHOD, RUNS, VERIFICATION, Submission, read_submission
from ctgraph_rl.board.tracks import Track, Variant
from ctgraph_rl.checks import require
from ctgraph_rl.disk import read_regular
from ctgraph_rl.runs.read import Problem

LEVELS = ("failed", "submitted", "rescored", "rerun", "held_out")
"""How far a submission was verified, in rising order; ``failed``: a verification found a difference."""

OF_FILES = {"none": "failed", **{level: level for level in LEVELS[2:]}}
"""Levels by the names that ``verification.json`` gives them."""

MEASURES = ("average_performance", "forgetting")
"""Metrics that each table shows beside the score."""

MOST_BYTES = 2**24
"""Largest ``verification.json`` that is read."""

DIGITS = 12
"""Of a digest, for readers."""


@dataclass(frozen=True)
class Entry:
    """A submission on the board.

    Args:
        digest: of the submission.
        method: what its ``method.yaml`` says.
        track: that it is for.
        variant: what it learned.
        level: one of `LEVELS`.
        seeds: of the track.
        values: of the track's score and `MEASURES`, one for each seed; None for a seed without a value.
        failed: why seeds failed.
        agent_bytes: of the largest agent; None where no run left one.
        folder: of the submission.
    """

    digest: str
    method: Mapping[str, Any]
    track: Track
    variant: Variant
    level: str
    seeds: tuple[int, ...]
    values: Mapping[str, tuple[float | None, ...]]
    failed: Mapping[int, str]
    agent_bytes: int | None
    folder: Path

    @property
    def name(self) -> str:
        """The name of the method."""
        return str(self.method["name"])

    @property
    def id(self) -> str:
        """The first digits of the digest."""
        return self.digest[:DIGITS]

    @property
    def scores(self) -> tuple[float | None, ...]:
        """The values of the metric that orders its table."""
        return self.values[self.track.score]

    @property
    def hours(self) -> float | None:
        """Hours of computing of its runs, as the submission says."""
        return self.method["compute"]["hours"]

    @property
    def frames(self) -> int:
        """Frames that a seed learned from."""
        return self.variant.curriculum.num_frames

    @property
    def why_not_ranked(self) -> str | None:
        """Why it has no rank; None for one that is ranked."""
        without = [str(seed) for seed, value in zip(self.seeds, self.scores, strict=True) if value is None]
        if self.level == "failed":
            return "its verification found differences"
        return f"no score of seed {', '.join(without)}" if without else None


def read_entries(paths: Iterable[Path | str], config_dir: Path | None = None) -> tuple[list[Entry], list[Problem]]:
    """Return the submissions in or below folders, and what is left out.

    Args:
        paths: folders of submissions, or folders that hold them.
        config_dir: where tracks of the user are, as ``track/NAME.yaml``.
    """
    found: dict[str, Entry] = {}
    problems = []
    for path in map(Path, paths):
        folders = sorted(file.parent for file in path.rglob(METHOD) if (file.parent / RUNS).is_file())
        if not folders:
            problems.append(Problem(path, f"{path} holds no submission: ctgraph-rl submit RUNS --to DIR makes one"))
        for folder in folders:
            try:
                entry = entry_of(read_submission(folder, config_dir=config_dir))
            except (OSError, ValueError) as error:
                problems.append(Problem(folder, f"{folder}: {error}"))
                continue
            twin = found.setdefault(entry.digest, entry)
            if twin.folder.resolve() != folder.resolve():
                said = f"{twin.folder} and {folder} are one submission twice; the second is left out"
                problems.append(Problem(folder, said))
    return list(found.values()), problems


def entry_of(submission: Submission) -> Entry:
    """Return a submission as an entry.

    Raises:
        ValueError: if it is for no track, or not of the track that it names.
    """
    track, name = submission.track, submission.method["name"]
    require((track is not None, f"{name} is for no track: name one in {METHOD}, or submit with --track"))
    assert track is not None
    variant = track.variant_of(submission.curriculum)
    found = submission.curriculum.fingerprint
    require((variant is not None, f"the curriculum (fingerprint {found}) is none of track {track.id}"))
    assert variant is not None
    by_seed = {run.seed: run for run in submission.runs}
    values = {
        metric: tuple(
            _value(submission, by_seed[seed].run if seed in by_seed else None, metric) for seed in track.seeds
        )
        for metric in dict.fromkeys((track.score, *MEASURES))
    }
    return Entry(
        digest=submission.digest,
        method=submission.method,
        track=track,
        variant=variant,
        level=level_of(submission),
        seeds=track.seeds,
        values=values,
        failed={run.seed: run.reason for run in submission.runs if not run.finished},
        agent_bytes=max((run.agent_bytes for run in submission.runs if run.agent_bytes is not None), default=None),
        folder=submission.path,
    )


def _value(submission: Submission, run: str | None, metric: str) -> float | None:
    """Return a metric of a run; None for one without."""
    cell = {} if run is None else submission.metrics.get(run, {}).get(metric, {})
    return float(cell["value"]) if cell.get("value") else None


def level_of(submission: Submission) -> str:
    """Return how far a submission was verified; a verification of other files counts for nothing.

    Raises:
        ValueError: for a ``verification.json`` that cannot be read.
    """
    path = submission.path / VERIFICATION
    if not path.is_file():
        return "submitted"
    try:
        found = json.loads(read_regular(path, MOST_BYTES))
    except (ValueError, RecursionError):
        found = None
    level = found.get("level") if isinstance(found, dict) else None
    require((level in OF_FILES, f"{path} has no level; verify the submission again"))
    return OF_FILES[str(level)] if found.get("digest") == submission.digest else "submitted"


def shown_level(level: str) -> str:
    """Return a level in words."""
    return level.replace("_", " ")


def names_of(entries: Sequence[Entry]) -> list[str]:
    """Return a name for each entry: that of its method, with digits of the digest where two have the same."""
    names = [entry.name for entry in entries]
    return [
        name if names.count(name) == 1 else f"{name} ({entry.id})" for name, entry in zip(names, entries, strict=True)
    ]
