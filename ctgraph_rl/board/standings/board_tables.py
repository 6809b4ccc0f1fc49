"""Tables of the board: entries that learned the same under the same conditions, with ranks as far as seeds decide them.

Other tracks, versions, rungs or protocols are other tables. Within one, every two entries are compared seed by seed,
and p-values are corrected for all pairs by Holm's procedure. An entry's rank is a range: at best behind all that are
significantly better, at worst before all that are significantly worse.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

from ctgraph_rl.board.standings.entries import BoardEntry, names_of
from ctgraph_rl.board.standings.track_ceilings import ceilings_of
from ctgraph_rl.board.tracks import Track, Variant
from ctgraph_rl.report import statistics
from ctgraph_rl.report.bounds_of_runs import bounds_of_curriculum
from ctgraph_rl.report.statistics import LEVEL, Comparison, Estimate
from ctgraph_rl.runs.read import split_by


@dataclass(frozen=True)
class Standing:
    """A line of a table.

    Args:
        name: of the method, unique in the table.
        estimates: of the score and the other measures, over seeds.
        best_rank: that the comparisons leave open; None without rank.
        worst_rank: likewise.
    """

    entry: BoardEntry
    name: str
    estimates: Mapping[str, Estimate]
    best_rank: int | None = None
    worst_rank: int | None = None

    @property
    def score(self) -> Estimate:
        """The estimate of the metric that orders the table."""
        return self.estimates[self.entry.track.score]

    @property
    def rank(self) -> str:
        """The rank as text, such as ``2 to 4``."""
        if self.best_rank is None:
            return "-"
        return str(self.best_rank) if self.best_rank == self.worst_rank else f"{self.best_rank} to {self.worst_rank}"


@dataclass(frozen=True)
class BoardTable:
    """Comparable entries, the best score first.

    Args:
        pairs: comparisons of the scores of every two ranked entries, by name.
    """

    track: Track
    variant: Variant
    standings: Sequence[Standing]
    pairs: Mapping[tuple[str, str], Comparison]

    @property
    def title(self) -> str:
        """Track, rung and what is given."""
        return ", ".join(filter(None, (self.track.id, self.variant.rung, f"given: {self.variant.given}")))

    @cached_property
    def ceilings(self) -> dict[str, float | None]:
        """What its tasks allow."""
        return ceilings_of(self.variant.curriculum)


def tables(entries: Iterable[BoardEntry]) -> list[BoardTable]:
    """Return a table for all comparable entries, in the order of tracks, rungs and what is given."""
    groups = split_by(entries, lambda entry: (entry.track.id, entry.variant.curriculum.fingerprint))
    made = map(_table, groups.values())

    def place(table: BoardTable) -> tuple[bool, str, int]:
        fingerprints = list(table.track.by_fingerprint)
        return table.track.name != "small", table.track.id, fingerprints.index(table.variant.curriculum.fingerprint)

    return sorted(made, key=place)


def _table(entries: Sequence[BoardEntry]) -> BoardTable:
    track = entries[0].track
    variant = entries[0].variant
    bounds = bounds_of_curriculum(variant.curriculum)
    lines = []
    for entry, name in zip(entries, names_of(entries), strict=True):
        estimates = {metric: bounds.estimate(metric, values) for metric, values in entry.values.items()}
        lines.append(Standing(entry, name, estimates))
    lines.sort(key=lambda line: (line.score.value is None, -(line.score.value or 0.0), line.name))
    ranked = [line for line in lines if line.entry.why_not_ranked is None]
    found = {}
    for one, other in combinations(ranked, 2):
        scores = one.entry.scores, other.entry.scores
        found[one.name, other.name] = statistics.compare(*scores, bounds=bounds.of_metric(track.score))
    pairs = statistics.corrected(found)
    significant = [names for names, comparison in pairs.items() if is_significant(comparison)]
    better = Counter(one for one, _ in significant)
    worse = Counter(other for _, other in significant)
    for place, line in enumerate(lines):
        if line in ranked:
            last = len(ranked) - better[line.name]
            lines[place] = replace(line, best_rank=1 + worse[line.name], worst_rank=last)
    return BoardTable(track, variant, lines, pairs)


def is_significant(found: Comparison) -> bool:
    """Return whether a difference is significant after the correction."""
    return found.holm is not None and found.holm <= 1 - LEVEL
