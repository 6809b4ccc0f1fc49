"""docs/reference/metrics.md: its tables are those of the code, and its Python runs."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.paths import CHECKOUT
from helpers.scripted import curriculum, task

import curricula
from ctgraph_rl import Block, RunLog, metrics
from ctgraph_rl.log import tables
from ctgraph_rl.log.provenance import provenance
from ctgraph_rl.log.sums import write_metrics
from ctgraph_rl.metrics.lifetime import ROUNDING
from ctgraph_rl.runs.experts import Expert
from ctgraph_rl.runs.recorder import Recorder

TEXT = (CHECKOUT / "docs" / "reference" / "metrics.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)


def table(*rows: tuple[str, ...]) -> str:
    """A table of the page, without its header."""
    return "".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in row)} |\n" for row in rows)


def four_tasks_learned_by_nobody(run_dir: Path) -> None:
    """A run of su_b1_4tasks that only waits, with a mean return of 0.25 while training."""
    reference = curricula.su_b1_4tasks()
    with Recorder(reference, run_dir) as recorder:
        for frames in (0, *reference.ends):
            if frames:
                recorder.training(frames, episodes=4, return_mean=0.25, success_rate=0.25)
            recorder.evaluate(lambda observation: np.zeros(len(observation), dtype=np.int64), frames)


def column_rows(columns: dict[str, tuple[str, str]]) -> list[tuple[str, ...]]:
    return [(f"`{name}`", type_, meaning) for name, (type_, meaning) in columns.items()]


@pytest.mark.parametrize(
    ("program", "deviation"),
    [
        ("CORA", "its code counts only the first cycle by default"),
        ("l2metrics 3.1.0", "a value within 1e-12 of the level, relative to it, has reached it"),
        (
            "Ben-Iwhiwhu et al.",
            "`total_performance_over_time` leaves out the evaluation before training, which named curricula add",
        ),
    ],
)
def test_the_page_has_the_deviation_from_a_program_under_its_name(program, deviation):
    bullets = re.split(r"\n- ", TEXT.split("differ from existing programs")[1].split("## Over seeds")[0])

    (bullet,) = [" ".join(each.split()) for each in bullets if each.startswith(f"**{program}**")]

    assert deviation in bullet
    assert ROUNDING == 1e-12


def test_the_page_has_the_columns_of_the_tables():
    differ = {name: column for name, column in tables.TRAINING.items() if tables.EVALUATIONS[name] != column}
    (without,) = re.findall(r"has the same columns without (.*)\. Doubles", TEXT)

    assert table(*column_rows(tables.EVALUATIONS)) in TEXT
    assert f"|---|---|---|\n{table(*column_rows(differ))}" in TEXT
    assert set(re.findall(r"`(\w+)`", without)) == tables.EVALUATIONS.keys() - tables.TRAINING.keys()


def test_the_python_of_the_page_runs(tmp_path, monkeypatch, capsys):
    four_tasks_learned_by_nobody(tmp_path / "RUN")
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}

    exec(compile("".join(BLOCKS), "metrics.md", "exec"), names)

    assert capsys.readouterr().out.splitlines()[0] == "0.0 lopez-paz2017/acc"
    assert len(names["everything"]) == len(metrics.definitions())
    differ = {name for name, metric in names["parts"].items() if metric != names["everything"][name]}
    assert differ == {metric.__name__ for metric in metrics.AGAINST_EXPERTS}  # which say another reason
    assert names["parts"]["mean_training_performance"].value == 26.0
    assert (tmp_path / "RUN" / "evaluations.csv").exists()


def test_the_page_has_the_fields_of_the_metrics_of_a_run(tmp_path):
    write_metrics(tmp_path / "metrics.json", metrics.summary(torch.eye(3)[:, 1:], [(0,), (1,)]))

    entry = json.loads((tmp_path / "metrics.json").read_text(encoding="utf-8"))["average_performance"]

    assert (entry["n_seeds"], entry["interval"]) == (1, None)
    assert all(f"`{name}`" in TEXT for name in entry)


def test_the_page_has_the_fields_of_an_expert_in_the_log():
    (row,) = [line for line in TEXT.splitlines() if line.startswith("| `experts` |")]

    about = Expert(1, "00ff", Path("expert")).about

    assert f"`{{{', '.join(json.dumps(name) for name in about)}}}`" in row


def test_the_page_has_the_fields_of_the_logs_first_line():
    (row,) = [line for line in TEXT.splitlines() if line.startswith("| `run` |")]

    fields = set(re.findall(r"`(\w+)`", row)) - {"run"}

    assert fields == {*provenance(curriculum(Block(task(), 12))), "config", "seconds"}


def test_a_training_line_is_as_small_as_the_page_says(tmp_path):
    log = RunLog(tmp_path / "run.jsonl")
    means = dict.fromkeys(("return_mean", "success_rate", "length_mean"), 0.9959432048681541)
    losses = ("loss_objective", "loss_critic", "loss_entropy", "entropy", "grad_norm")
    log.append("training", block=4, frames=98304, episodes=493, **means, **dict.fromkeys(losses, -0.0057376245968))
    log.close()

    (stated,) = re.findall(r"a training line has about (\d+) bytes", TEXT)

    assert abs((tmp_path / "run.jsonl").stat().st_size - int(stated)) < 50
