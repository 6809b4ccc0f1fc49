"""Examples in docstrings run and print what they show."""

from __future__ import annotations

import doctest
from collections.abc import Iterator
from importlib import import_module

import pytest
from helpers.architecture import PACKAGES, find_sources

OPTIONS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def examples() -> Iterator[doctest.DocTest]:
    """Every docstring of the packages with an example, each once."""
    for name, source in find_sources(*PACKAGES).items():
        if ">>> " in source:
            found = doctest.DocTestFinder(exclude_empty=True).find(import_module(name))
            yield from (each for each in found if each.examples)


EXAMPLES = {example.name: example for example in examples()}


def test_the_most_important_names_have_examples():
    names = {name.rpartition(".")[2] for name in EXAMPLES}

    assert {"CTGraph", "Task", "CTGraphEnv", "Curriculum", "Block", "learn_curriculum", "evaluate"} <= names
    assert {"make_agent", "scores", "Recorder", "SB3VecEnv", "rollout", "load", "OptimalPolicy"} <= names
    assert len(EXAMPLES) >= 20


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_runs_and_prints_what_it_shows(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    printed: list[str] = []

    failed, _ = doctest.DocTestRunner(optionflags=OPTIONS).run(EXAMPLES[name], out=printed.append)

    assert failed == 0, "".join(printed)
    assert list(tmp_path.iterdir()) == []
