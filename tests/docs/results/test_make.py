"""The command of the results: what it makes is what the studies have."""

from __future__ import annotations

from importlib import import_module
from types import SimpleNamespace

import make


def test_each_page_has_a_module_that_makes_it():
    assert {name for name, module in make.PAGES.items() if not hasattr(import_module(module), "page")} == set()


def test_without_a_name_all_pages_are_made_and_with_one_that_page_is(monkeypatch, tmp_path):
    made = []
    study = SimpleNamespace(page=lambda: "text", draw=made.append)
    monkeypatch.setattr(make, "import_module", lambda name: study)
    monkeypatch.setattr(make, "HERE", tmp_path)

    make.main(["lifelong"])
    assert [path.name for path in tmp_path.iterdir()] == ["lifelong.md"]
    assert (tmp_path / "lifelong.md").read_text() == "text"
    make.main([])
    assert {path.stem for path in tmp_path.iterdir()} == set(make.PAGES)
    assert made == [tmp_path] * (1 + len(make.PAGES))
