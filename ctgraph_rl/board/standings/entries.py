"""Submissions as entries of the board, and how far they were verified."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ctgraph_rl.board.method_yaml import track_version
from ctgraph_rl.board.rescore import scores_of
from ctgraph_rl.board.submission import SUBMISSION, Submission, read_submission
from ctgraph_rl.board.tracks import Track, Variant
from ctgraph_rl.board.verification import STATES, Verification, verification_of
from ctgraph_rl.checks import ReadOnlyValues, repeated, require
from ctgraph_rl.report.bounds_of_runs import bounds_of_curriculum
from ctgraph_rl.report.columns import board_columns
from ctgraph_rl.report.intervals import Bounds, within_bounds
from ctgraph_rl.runs.read import Problem
from ctgraph_rl.strict import files_below, one_line_of, too_deep

DIGITS = 12


@dataclass(frozen=True)
class BoardEntry:
    """A submission on the board.

    Args:
        method: from ``method.yaml``.
        values: of the track's score and `board_columns`, one for each seed of the track, or None.
        agent_bytes: of the largest agent, if a run left one.
    """

    digest: str
    method: ReadOnlyValues
    track: Track
    variant: Variant
    verification: Verification
    values: Mapping[str, tuple[float | None, ...]]
    agent_bytes: int | None
    folder: Path

    @property
    def name(self) -> str:
        """The name of the method."""
        return str(self.method["name"])

    @property
    def level(self) -> str:
        """How far it was verified, one of `STATES`."""
        return self.verification.level

    @property
    def verified(self) -> str:
        """The level in words, also whether scores were tested in place of bits."""
        reran = self.level in STATES[3:]
        return shown_level(self.level) + (", scores" if reran and not self.verification.bits else "")

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
        """Hours of computing of its runs, by the submission."""
        return self.method["compute"]["hours"]

    @property
    def frames(self) -> int:
        """Frames that a seed learned from."""
        return self.variant.curriculum.num_frames

    @property
    def why_not_ranked(self) -> str | None:
        """Why it has no rank, if it has none."""
        without = [str(seed) for seed, value in zip(self.track.seeds, self.scores, strict=True) if value is None]
        if self.level == "failed":
            return "its verification found differences"
        return f"no score of seed {', '.join(without)}" if without else None


def read_entries(paths: Iterable[Path | str], config_dir: Path | None = None) -> tuple[list[BoardEntry], list[Problem]]:
    """Return the submissions in or below folders, and what is left out.

    Args:
        config_dir: where the user's tracks are, as ``track/NAME.yaml``.
    """
    found: dict[str, BoardEntry] = {}
    problems: list[Problem] = []
    for path in map(Path, paths):
        files, deep = files_below(path, (SUBMISSION,))
        folders = [file.parent for file in files]
        problems += map(Problem, deep, map(too_deep, deep))
        if not folders:
            problems.append(Problem(path, f"{path} holds no submission: ctgraph-rl submit RUNS --to DIR makes one"))
        for folder in folders:
            try:
                entry = make_entry(read_submission(folder, config_dir=config_dir))
            except Exception as error:  # a broken submission is never an end for others
                problems.append(Problem(folder, f"{folder}: {one_line_of(error, folder)}"))
                continue
            twin = found.setdefault(entry.digest, entry)
            if twin.folder.resolve() != folder.resolve():
                said = f"{twin.folder} and {folder} are one submission twice; the second is left out"
                problems.append(Problem(folder, said))
    return list(found.values()), problems


def make_entry(submission: Submission) -> BoardEntry:
    """Return a submission as an entry.

    Raises:
        ValueError: if it is not of the track that it names, and for values out of a metric's bounds.
    """
    track = submission.track
    name = submission.method["name"]
    require((track is not None, f"{name} is for no track: name one in method.yaml, or submit with --track"))
    assert track is not None
    found = submission.curriculum.fingerprint
    variant = track.by_fingerprint.get(found)
    own = replace(track, version=track_version(submission.method))
    other = "" if own.version == track.version else f"; it was submitted to {own.id}: use a package that has it"
    require(
        (variant is not None, f"the curriculum (fingerprint {found}) is none of track {track.id}{other}"),
        (own.version <= track.version, f"the newest version of the track is {track.id}{other}"),
    )
    assert variant is not None
    evaluations = sum(frames > 0 for frames in submission.curriculum.moments)
    bounds = bounds_of_curriculum(submission.curriculum, max(1, evaluations))
    by_seed = {run.seed: scores_of(submission, run) for run in submission.finished}
    values = {}
    for metric in dict.fromkeys((track.score, *board_columns(submission.curriculum))):
        between = Bounds(*bounds.of_metric(metric))
        of_seeds = []
        for seed in track.seeds:
            value = by_seed.get(seed, {}).get(metric)
            fits = value is None or (math.isfinite(value) and within_bounds([value], between))
            require((fits, f"the logs give {metric} {value}, it must be in [{between.low:g}, {between.high:g}]"))
            of_seeds.append(value)
        values[metric] = tuple(of_seeds)
    return BoardEntry(
        digest=submission.digest,
        method=submission.method,
        track=own if other else track,
        variant=variant,
        verification=verification_of(submission),
        values=values,
        agent_bytes=max((run.agent_bytes for run in submission.runs if run.agent_bytes is not None), default=None),
        folder=submission.path,
    )


def shown_level(level: str) -> str:
    """Return a level in words."""
    return level.replace("_", " ")


def names_of(entries: Sequence[BoardEntry]) -> list[str]:
    """Return each entry's method name, with digits of the digest where two are equal."""
    several = repeated(entry.name for entry in entries)
    return [f"{entry.name} ({entry.id})" if entry.name in several else entry.name for entry in entries]
