"""The command of the results: what it makes is what the studies have."""

from __future__ import annotations

from importlib import import_module

import make


def test_each_page_has_a_module_that_makes_it():
    assert {name for name, module in make.PAGES.items() if not hasattr(import_module(module), "make")} == set()


def test_without_a_name_all_pages_are_made_and_with_one_that_page_is(monkeypatch):
    made = []
    monkeypatch.setattr(make, "_make", lambda *modules: made.append(modules))

    make.main([])
    make.main(["lifelong"])

    assert made == [tuple(make.PAGES.values()), ("studies.lifelong.page",)]
