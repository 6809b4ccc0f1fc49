"""A card for each metric: definition, inputs, bounds, and its value for an example where the matrix is enough."""

from __future__ import annotations

from collections.abc import Iterator
from inspect import getdoc

import torch
from yaml_settings import ALONE, escaped

from ctgraph_rl import metrics

EXAMPLE = torch.tensor([[0.1, 0.2, 0.0], [1.0, 0.3, 0.0], [0.6, 1.0, 0.2], [0.4, 0.7, 1.0]], dtype=torch.float64)
"""Return on three tasks, before training and after each of three blocks."""

TRAINED = ((0,), (1,), (2,))


def metric_cards() -> Iterator[tuple[str, str]]:
    """Yield the path and the text of each card, and of the list of them, in Markdown."""
    values = metrics.of_matrix(EXAMPLE, TRAINED)
    found = metrics.definitions()
    rows = [
        f"| [`{name}`]({name}.md) | `{each.id}` | `{each.formula}` | {escaped(each.source)} |"
        for name, each in found.items()
    ]
    head = ["| metric | id | formula | source |", "|---|---|---|---|"]
    words = "Every metric of `metrics.json`. R is the performance matrix; tasks and blocks count from 1."
    listing = "\n".join([*head, *rows])
    yield "metrics/index.md", f"# Metric cards\n\n{words}\n\n{listing}\n"
    for name in found:
        yield f"metrics/{name}.md", _card(name, values.get(name))


def _card(name: str, value: metrics.Metric | None) -> str:
    entry = metrics.METRICS[name]
    text = getdoc(entry.metric) or ""
    bounds = entry.bounds.__name__
    facts = {
        "id": f"`{entry.meaning.id}`",
        "formula": f"`{entry.meaning.formula}`",
        "source": escaped(entry.meaning.source),
        "computed from": ", ".join(f"`{each}`" for each in entry.required),
        "bounds of a value": "none" if bounds == "unbounded" else escaped(bounds.replace("_", " ")),
        "terms without a value": "left out of the mean" if entry.meaning.partial else "make the metric undefined",
    }
    rows = ["| | |", "|---|---|", *(f"| {fact} | {words} |" for fact, words in facts.items())]
    parts = [
        ALONE,
        f"# `{name}`",
        "[All metrics](index.md)",
        escaped(text.split("\n\n")[0].replace("\n", " ")).replace("``", "`"),
        "\n".join(rows),
    ]
    python = f"```{{eval-rst}}\n.. autofunction:: {entry.metric.__module__}.{name}\n   :no-index:\n```"
    return "\n\n".join([*parts, *_example(value), "## In Python", python]) + "\n"


def _example(value: metrics.Metric | None) -> list[str]:
    """Return the example, of a metric that the performance matrix is enough for."""
    if value is None:
        return []
    moments = ("before training", "after block 1", "after block 2", "after block 3")
    rows = [
        f"| {moment} | {' | '.join(f'{x:g}' for x in row)} |"
        for moment, row in zip(moments, EXAMPLE.tolist(), strict=True)
    ]
    matrix = ["| R | task 1 | task 2 | task 3 |", "|---|--:|--:|--:|", *rows]
    terms = ", ".join("none" if term is None else f"{term:.4g}" for term in value.terms)
    result = f"undefined: {value.undefined}" if value.value is None else f"**{value.value:.4g}**; its terms are {terms}"
    words = "Three tasks, one after the other. Each is learned in its block and partly forgotten later."
    return ["## Example", words, "\n".join(matrix), f"Here the metric is {result}."]
