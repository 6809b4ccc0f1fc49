"""The command of the results: what it makes and collects are what the studies have."""

from __future__ import annotations

from importlib import import_module

import make
import pytest


def test_each_page_has_a_module_that_makes_it_and_each_table_one_that_collects_it():
    modules = {**make.PAGES, **make.APART}

    assert {name for name, module in modules.items() if not hasattr(import_module(module), "make")} == set()
    assert {name for name, module in make.TABLES.items() if not hasattr(import_module(module), "collect")} == set()


def test_the_tables_of_the_command_are_those_of_the_studies():
    from studies.baselines import page, runs, search
    from studies.lifelong import experiments

    of_agents = {"main_job", *runs.AGENTS, *page.RND, *runs.BY_FIVES, search.NAME, runs.REWARDS_MET}

    assert {name for name, module in make.TABLES.items() if module == runs.__name__} == of_agents
    assert set(make.OF_AGENTS) == {"main_job", *runs.AGENTS}
    assert make.OF_METHODS == experiments.EXPERIMENTS


def test_without_a_name_all_pages_are_made_and_with_one_that_page_is(monkeypatch):
    made = []
    monkeypatch.setattr(make, "_make", lambda *modules: made.append(modules))

    make.main([])
    make.main(["lifelong"])
    make.main(["statistics"])

    assert made == [tuple(make.PAGES.values()), ("studies.lifelong.page",), ("studies.coverage",)]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["baselines_b1", "runs", "--add"],
            "--add is for masks_ct8_md, masks_ct8, masks_ct12, methods, claim_runs, ",
        ),
        (["together_fo_b1", "runs"], "needs two folders, of the runs alone and of those together, got 1"),
        (["collectives", "none"], "no finished run of collectives, collective_blocks, selecting, whose files stay as "),
        (["no_labels", "none"], "no finished run of no_labels, no_labels_spans, whose files stay as they were"),
    ],
)
def test_what_cannot_be_collected_is_one_message(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)

    with pytest.raises(SystemExit) as end:
        make.main(["collect", *arguments])

    assert end.value.code == 2
    assert message in capsys.readouterr().err
