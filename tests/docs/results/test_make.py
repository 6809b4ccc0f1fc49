"""The command of the results: what it makes is what the studies have."""

from __future__ import annotations

from importlib import import_module

import make
import pytest


def test_each_page_has_a_module_that_makes_it():
    modules = {**make.PAGES, **make.APART}

    assert {name for name, module in modules.items() if not hasattr(import_module(module), "make")} == set()


def test_without_a_name_all_pages_are_made_and_with_one_that_page_is(monkeypatch):
    made = []
    monkeypatch.setattr(make, "_make", lambda *modules: made.append(modules))

    make.main([])
    make.main(["lifelong"])
    make.main(["statistics"])

    assert made == [tuple(make.PAGES.values()), ("studies.lifelong.page",), ("studies.coverage",)]


def test_a_folder_without_runs_is_one_message_and_the_table_stays(tmp_path, capsys):
    with pytest.raises(SystemExit) as end:
        make.main(["every_curriculum", str(tmp_path)])

    assert end.value.code == 2
    assert "no raw results of every_curriculum, whose file stays as it was" in capsys.readouterr().err
