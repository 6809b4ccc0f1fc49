"""Former names of modules: each is the module that it became, and a page lists them."""

from __future__ import annotations

import pickle
import re
from importlib import import_module

import pytest
from helpers.paths import CHECKOUT

import baselines
from baselines.parts.learner import Learner
from ctgraph_rl.packages import class_named


@pytest.mark.parametrize("former", baselines.MOVED)
def test_a_former_name_is_the_module_that_moved(former):
    assert import_module(former) is import_module(baselines.MOVED[former])


def test_a_former_name_has_the_same_class_in_statements_pickles_and_runs():
    from baselines.learner import Learner as former

    assert former is Learner
    assert pickle.loads(b"cbaselines.learner\nLearner\n.") is Learner
    assert class_named("baselines.learner", "Learner") is Learner


def test_a_page_lists_all_former_names():
    page = (CHECKOUT / "docs" / "reference" / "moved_modules.md").read_text(encoding="utf-8")

    moved = {}
    for line in re.findall(r"^- (.*)\.$", page, re.MULTILINE):
        former, now, *names = re.findall(r"`([\w.]+)`", line)
        moved |= {former.replace("NAME", name): now.replace("NAME", name) for name in names or [""]}

    assert moved == baselines.MOVED
