"""The page on troubleshooting quotes messages that are raised, word for word."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from helpers.paths import CHECKOUT
from helpers.sweeping import command_line
from torch import nn

import curricula
from baselines.methods.mas import MAS
from ctgraph_rl import CTGraph, CTGraphEnv, Observations, PaperImages, Task
from ctgraph_rl.checks import require
from ctgraph_rl.core import kernel
from ctgraph_rl.core.device import checked_device
from ctgraph_rl.draw import style
from ctgraph_rl.learn.exact import exact_rules
from ctgraph_rl.report import intervals
from ctgraph_rl.tasks.configurations import ct_fo_b1, ct_su_b1

TEXT = (CHECKOUT / "docs" / "how-to" / "troubleshooting.md").read_text(encoding="utf-8")
QUOTED = re.findall(r"^\| `(.+?)` \|", TEXT, re.MULTILINE)
OF_RUNS = (
    "... holds a run of other code",
    "... is nan in",
    "... is in use by process",
    "... is not finished: it needs",
    "seeds ... are for tuning",
    "curriculum ... has fingerprint",
    "no agent can be built",
    "the code of others is not run",
)
"""Beginnings of messages that need a run; tests of runs, trackers, faults and submissions hold them."""

GRAPH, SMALL = CTGraph(2, 2), {"wait_ids": (2, 2), "decision_ids": (3, 3)}


RAISED: list[Callable[[], object]] = [
    lambda: CTGraph(2, 2, 1.0),
    lambda: replace(ct_su_b1(), goal=(1, 3)),
    lambda: Observations(wait_ids=(2, 3), decision_ids=(2, 2), end_ids=(4, 4)),
    lambda: Task(GRAPH, (1, 2), Observations(**SMALL, end_ids=(4, 7), unique_waits=True), PaperImages(40)),
    lambda: Task(GRAPH, (1, 2), Observations((3, 102), (2, 2), (103, 103)), PaperImages(40)),
    lambda: replace(ct_su_b1(), step_reward=-0.01).memoryless_ceiling(),
    lambda: CTGraphEnv([ct_su_b1()]).set_tasks([ct_fo_b1()]),
    lambda: checked_device("cuda"),
    lambda: kernel._key(Path(kernel.__file__), ["no-compiler"]),
    lambda: intervals.scipy("stats"),
    lambda: style.new_figure(1, 1),
    lambda: MAS(8, coeff=1.0, heads="auto").attach(nn.Linear(1, 1), curricula.load("fo_b1_4tasks")),
    lambda: require(*exact_rules(nn.Linear(1, 1), ct_su_b1(), {})),
]

TYPED = (
    "curriculum.num_frames=5000",
    "evaluation.every=100",
    "curriculum=su_b1_4task",
    "agent.lr=1",
    "-m method=finetune,ewc method.coeff=1,2",
    "hydra/launcher=joblib",
    "method=mask_ri",
)
"""Settings of runs that are refused."""


def matches(quoted: str, message: str) -> bool:
    """Whether a message is the one quoted, in which ``...`` stands for anything."""
    return re.fullmatch(".*".join(map(re.escape, quoted.split("..."))), message, re.DOTALL) is not None


def test_every_message_that_the_page_quotes_is_raised(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    for package in ("scipy", "matplotlib"):
        monkeypatch.setitem(sys.modules, package, None)
    for words in TYPED:
        assert command_line(monkeypatch, *words.split()) == 1
    messages = [line.removeprefix("error: ") for line in capsys.readouterr().err.splitlines()]
    for raised in RAISED:
        with pytest.raises((ValueError, ModuleNotFoundError)) as refusal:
            raised()
        messages.append(str(refusal.value))
    assert len(QUOTED) >= 20
    assert len(messages) == len(TYPED) + len(RAISED)
    assert [
        quoted
        for quoted in QUOTED
        if not quoted.startswith(OF_RUNS) and not any(matches(quoted, message) for message in messages)
    ] == []
    assert [start for start in OF_RUNS if not any(quoted.startswith(start) for quoted in QUOTED)] == []
