"""A card for each agent, cell, method and detector, from its yaml, its class and the raw results."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from inspect import getdoc

from results_of import agents_results, methods_results
from yaml_settings import ALONE, base_of, escaped, first_comment, names_in, settings_of, table

from baselines.cells.cell import Cell
from baselines.methods.__main__ import needs_ids
from baselines.parts.catalogue import CatalogueEntry, catalogue

DETECTABLE = "curriculum=dick2020_pair agent=ppo method=mask_ri "
"""A run in which every detector can work."""


def baseline_cards() -> Iterator[tuple[str, str]]:
    """Yield the path and the text of each card, and of the lists of them, in Markdown."""
    groups = {"agent": _agent_facts, "cell": _cell_facts, "method": _method_facts, "detector": _detector_facts}
    for group, facts in groups.items():
        entries = list(catalogue(group))
        yield f"{group}s/index.md", _index(group, entries)
        first = {entry.kind: entry.name for entry in reversed(entries)}
        for entry in entries:
            yield f"{group}s/{entry.name}.md", _card(group, entry, facts(entry), first[entry.kind] == entry.name)


def _index(group: str, entries: list[CatalogueEntry]) -> str:
    rows = [f"| [`{entry.name}`]({entry.name}.md) | {escaped(entry.comment)} |" for entry in entries]
    words = f"Choose one with `{group}=NAME`. Each card has all settings with their defaults."
    listing = "\n".join([f"| `{group}=` | |", "|---|---|", *rows])
    base = f"\n## Base class\n\n{_class(Cell)}\n" if group == "cell" else ""
    return f"# {group.title()} cards\n\n{words}\n\n{listing}\n{base}"


def _agent_facts(entry: CatalogueEntry) -> dict[str, str]:
    return {"memory": "yes" if entry.kind.memory else "no", "can solve in principle": entry.kind.solves}


def _cell_facts(entry: CatalogueEntry) -> dict[str, str]:
    return {"memory": "yes" if entry.kind.memory else "no", "can hold": entry.kind.holds}


def _method_facts(entry: CatalogueEntry) -> dict[str, str]:
    ids = {"yes": "yes", "no": "no"}.get(needs_ids(entry), f"only with `{needs_ids(entry)}`")
    return {"needs task ids": ids, "needs to know boundaries": "yes" if entry.kind.needs_boundaries else "no"}


def _detector_facts(entry: CatalogueEntry) -> dict[str, str]:
    return {"reads": entry.kind.reads}


def _card(group: str, entry: CatalogueEntry, facts: dict[str, str], is_first: bool) -> str:
    chosen = {"agent": "", "cell": "agent=lstm_ppo ", "method": "agent=ppo ", "detector": DETECTABLE}[group]
    results = {"agent": agents_results, "method": methods_results}.get(group, lambda name: "")(entry.name)
    prefix = "agent.cell." if group == "cell" else f"{group}."
    rows = ["| | |", "|---|---|", *(f"| {fact} | {value} |" for fact, value in facts.items())]
    settings = settings_of(f"{group}/{entry.name}")
    parts = [
        ALONE,
        f"# `{group}={entry.name}`",
        f"[All {group}s](index.md)",
        escaped(entry.comment),
        "\n".join(rows),
        f"```bash\nctgraph-rl {chosen}{group}={entry.name}\n```",
        *(["## Settings", table(settings, prefix)] if settings else []),
        *_variants(group, entry.name),
        *(["## Results", results] if results else []),
        *_source(entry),
        "## Class",
        _class(entry.kind, is_first, with_members=group != "detector"),
    ]
    return "\n\n".join(parts) + "\n"


def _class(kind: type, is_first: bool = True, with_members: bool = True) -> str:
    """Return the reference of a class, which is indexed where it stands first."""
    options = "   :members:" * with_members + ("" if is_first else "\n   :no-index:")
    return f"```{{eval-rst}}\n.. autoclass:: {kind.__module__}.{kind.__name__}\n{options}\n```"


def _variants(group: str, name: str) -> list[str]:
    """Return a section with the yaml files that only change values of this one."""
    others = [other for other in names_in(group) if base_of(group, other) == name]
    sections = [
        f"### `{group}={other}`\n\n{escaped(first_comment(f'{group}/{other}'))}\n\n"
        + table(settings_of(f"{group}/{other}"), f"{group}.")
        for other in others
    ]
    return ["## Variants", *sections] if sections else []


def _source(entry: CatalogueEntry) -> list[str]:
    """Return a section with the papers that the module of an entry names."""
    words = (getdoc(import_module(entry.kind.__module__)) or "").split("\n\n")[1:]
    return ["## Source", " ".join(escaped(words[0]).replace("``", "`").split())] if words else []
