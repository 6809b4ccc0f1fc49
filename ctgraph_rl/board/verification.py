"""How far a submission was verified, as its ``verification.json`` says."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from ctgraph_rl.board.method_yaml import Kind, kind_rules, list_of
from ctgraph_rl.board.rescore import Check
from ctgraph_rl.board.submission import VERIFICATION, Submission
from ctgraph_rl.checks import is_int, require
from ctgraph_rl.disk import read_regular
from ctgraph_rl.parsers import LEVELS
from ctgraph_rl.strict import json_value

SCHEMA = 1

MOST_BYTES = 2**24

NONE = "none"

STATES = ("failed", "submitted", *LEVELS)
"""How far a submission was verified, in rising order; ``failed``: a verification found a difference."""


class Verification(NamedTuple):
    """How far a submission was verified."""

    level: str  # one of `STATES`
    bits: bool = True  # whether reruns are held to the same bits; False: only scores were tested
    why_none: str = ""  # why a ``verification.json`` that is there counts for nothing


def level_of(checks: Sequence[Check]) -> str:
    """Return the highest level up to which all checks passed.

    Files or reruns that contradict the submission leave no level. An open question, or lower held-out scores, only keep
    it from the next level.
    """
    reached = NONE
    if any(check.passed is False and check.level != LEVELS[-1] for check in checks):
        return NONE
    for level in LEVELS:
        own = [check.passed for check in checks if check.level == level]
        if not own or not all(own):
            break
        reached = level
    return reached


def verification_of(submission: Submission) -> Verification:
    """Return how far a submission was verified; a verification of other files counts for nothing."""
    path = submission.path / VERIFICATION
    if not path.is_file():
        return Verification("submitted")
    try:
        found = json_value(read_regular(path, MOST_BYTES))
        require((isinstance(found, dict), f"it must be an object, got {found!r:.80}"))
        known = {name: found.get(name) for name in KINDS}
        require(*((holds, f"its {message}") for holds, message in kind_rules(known, KINDS)))
        stated = found["level"]
        reached = level_of([Check(**check) for check in found["checks"]])
        require((reached == stated, f"its checks give the level {reached}, not {stated}"))
    except (OSError, ValueError) as error:
        why = f"{VERIFICATION} counts for nothing, {error}; verify the submission again"
        return Verification("submitted", why_none=why)
    if found.get("digest") != submission.digest:
        return Verification("submitted", why_none=f"{VERIFICATION} is of other files; verify the submission again")
    return Verification("failed" if stated == NONE else stated, found["bits"])


def _is_check(value: Any) -> bool:
    return isinstance(value, dict) and {*value} == {*Check._fields} and type(value["passed"]) in (bool, type(None))


KINDS = {
    "schema": Kind(lambda value: is_int(value, SCHEMA, SCHEMA), str(SCHEMA)),
    "level": Kind(lambda value: value in (NONE, *LEVELS), ", ".join([NONE, *LEVELS])),
    "bits": Kind(lambda value: isinstance(value, bool), "true or false"),
    "checks": list_of(Kind(_is_check, ""), "a list of checks with what, level and passed"),
}
