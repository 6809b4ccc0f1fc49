"""Names of curricula and agents in tables and figures: modifications and given names."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from ctgraph_rl.checks import did_you_mean, repeated, require
from ctgraph_rl.report.bounds_of_runs import curriculum_of, published
from ctgraph_rl.runs.read import MODIFIED, Run, by_curriculum, grouped, present

NOT_COMPARED = ("name", "source", "fingerprint", "schema", "about")
"""Keys of a curriculum's JSON that do not change what is learned."""

MOST_CHANGES, MOST_VALUES = 6, 3


def modifications(runs: Sequence[Run]) -> dict[str, str]:
    """Return what differs from the published curriculum, for each modified one by its name in tables."""
    found: dict[str, str] = {}
    for name, some in by_curriculum(runs).items():
        said = next(filter(None, map(modification, some)), "")
        if said:
            found[name] = said
    return found


def modification(run: Run) -> str:
    """Return in words how a run's curriculum differs from the published one; empty if unknown."""
    if not run.curriculum[0].endswith(MODIFIED):
        return ""
    learned = curriculum_of(run)
    original = published(run.group[0])
    if learned is None or original is None:
        return ""
    before: dict[str, list[Any]] = {}
    now: dict[str, list[Any]] = {}
    _collect(original.to_json(), "", before)
    _collect(learned.to_json(), "", now)
    differing = [key for key in {**before, **now} if before.get(key) != now.get(key)]
    changes = [f"{key}={_shown(now.get(key))} instead of {_shown(before.get(key))}" for key in differing]
    if len(changes) > MOST_CHANGES:
        changes[MOST_CHANGES:] = [f"and {len(changes) - MOST_CHANGES} more settings"]
    return ", ".join(changes)


def _collect(value: Any, key: str, found: dict[str, list[Any]]) -> None:
    if isinstance(value, Mapping):
        for name, inner in value.items():
            if name != "run_seed" and (key or name not in NOT_COMPARED):
                _collect(inner, f"{key}.{name}".lstrip("."), found)
    elif isinstance(value, list) and any(isinstance(inner, (Mapping, list)) for inner in value):
        for inner in value:
            _collect(inner, key, found)
    else:
        found.setdefault(key, []).append(value)


def _shown(values: Iterable[Any] | None) -> str:
    known = list(dict.fromkeys(map(str, values or ())))
    more = f" and {len(known) - MOST_VALUES} others" if len(known) > MOST_VALUES else ""
    return "/".join(known[:MOST_VALUES]) + more or "nothing"


def displayed(runs: Sequence[Run], agents: Sequence[str] = ()) -> list[Run]:
    """Return runs with other names of agents and in another order; agents that are not named follow.

    Args:
        agents: in order, each as its name in tables, or as ``NAME=SHOWN``.

    Raises:
        ValueError: for an unknown agent, with the likeliest one, and for a name of two agents.
    """
    known = _agents(runs)
    chosen: dict[str, str] = {}
    for each in agents:
        fits = [name for name in known if each.startswith(f"{name}=")]
        name = each if each in known else max(fits, key=len, default="")  # settings in names have the sign, too
        shown = name if each in known else each[len(name) + 1 :].strip()
        word = each.partition("=")[0]
        unknown = f"--agent: there is no agent {word!r}: {did_you_mean(word, known)}"
        require((bool(name), unknown), (not name or bool(shown), f"--agent {each!r} must have a name after the sign"))
        chosen[name] = shown
    twice = sorted(repeated(chosen.get(agent, agent) for agent in known))
    require((len(chosen) == len(agents), "--agent names an agent twice; give each once"))
    require((not twice, f"--agent gives the name {', '.join(twice)} to two agents; choose different ones"))
    places = {agent: (place, name) for place, (agent, name) in enumerate(chosen.items())}
    found = []
    for (_, agent), by_seed in grouped(runs).items():
        found += [replace(run, shown=places.get(agent)) for run in present(by_seed)]
    return found


def _agents(runs: Sequence[Run]) -> list[str]:
    return list(dict.fromkeys(agent for _, agent in grouped(runs)))


def colours_of(runs: Sequence[Run], given: Sequence[str]) -> dict[str, str]:
    """Return the colours given as ``NAME=COLOUR``, by agents' names in tables and figures.

    Raises:
        ValueError: for an unknown agent, and for what has no colour.
    """
    known = _agents(runs)
    found = {}
    for each in given:
        name, _, colour = each.rpartition("=")  # settings in names have the sign of equality, too
        unknown = f"--colour: there is no agent {name!r}: {did_you_mean(name, known)}"
        require((bool(name), f"--colour must be NAME=COLOUR, got {each!r}"), (not name or name in known, unknown))
        found[name] = colour
    return found
