"""Runs of different code: which of them are of one configuration, and what is to be said of the code of all."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Sequence

from ctgraph_rl.log.escape import terminal_text
from ctgraph_rl.log.provenance import NUMBERS
from ctgraph_rl.runs.read import Problem, Run, code_of
from ctgraph_rl.runs.settings import as_before

MOST_SEEDS = 10
"""Seeds of a configuration that a sentence names."""


def mixed_code(runs: Iterable[Run]) -> list[str]:
    """Return a sentence on every configuration that was run with different code, whose runs are shown apart."""
    of: dict[str, dict[tuple[str, str, str], list[Run]]] = {}
    for run in runs:
        config = {**as_before(run.about["config"]), "seed": 0}
        how = json.dumps([config, None if "curriculum" in config else run.group], sort_keys=True)
        of.setdefault(how, {}).setdefault(_state(run), []).append(run)
    return [_sentence(list(some.values())) for some in of.values() if len(some) > 1]


def _state(run: Run) -> tuple[str, str, str]:
    (_, fingerprint), _, code = run.configuration
    return run.agent or str(run.path.resolve()), fingerprint, code


def _sentence(states: Sequence[Sequence[Run]]) -> str:
    every = [run for some in states for run in some]
    fingerprints = len({run.group[1] for run in every}) > 1
    parts = []
    for some in states:
        said = [f"fingerprint {some[0].group[1]}"] * fingerprints + [code_of(some[0], every)]
        seeds = sorted(run.seed for run in some)
        more = f" and {len(seeds) - MOST_SEEDS} more" if len(seeds) > MOST_SEEDS else ""
        shown = ", ".join(map(str, seeds[:MOST_SEEDS])) + more
        parts.append(f"seed{'s' * (len(seeds) > 1)} {shown} ({', '.join(filter(None, said))})")
    who = f"{every[0].agent or every[0].path} on {every[0].group[0]} was run with different code, shown apart"
    return f"{who}: {'; '.join(parts)}; overwrite=stale runs what is stale again"


def print_problems(problems: Iterable[Problem], runs: Sequence[Run]) -> bool:
    """Print on standard error what is left out, and what is to be said of code.

    Returns:
        Whether something is left out, or runs of one configuration are of different code.
    """
    left_out, mixed = [f"left out: {problem.reason}" for problem in problems], mixed_code(runs)
    for line in (*left_out, *(f"code: {sentence}" for sentence in (*mixed, *code_notes(runs)))):
        print(terminal_text(line), file=sys.stderr)
    return bool(left_out or mixed)


def code_notes(runs: Sequence[Run]) -> list[str]:
    """Return sentences on runs of an older numbers version, and on those that do not say of which source they are."""
    older = [run for run in runs if run.code["numbers version"] < NUMBERS]
    unknown = [run for run in runs if None in run.code.values()]
    versions = ", ".join(sorted({str(run.code["numbers version"]) for run in older}))
    said = f"of numbers version {versions}, this package is of {NUMBERS}: it may give other numbers"
    found = [(older, said), (unknown, "of unknown code: they do not say of which source they are")]
    return [f"{len(some)} of {len(runs)} runs are {what}" for some, what in found if some]
