"""Many runs as one table."""

from __future__ import annotations

import csv
import io
import json
import sys

import pytest
import torch
from rich.console import Console

from ctgraph_rl import RunLog, metrics, results
from ctgraph_rl.log import write_metrics
from ctgraph_rl.results import comparisons, find_runs, table

pytest.importorskip("scipy")


def make_run(folder, seed: int, returns=(1.0, 0.5), finished: bool = True, curriculum: str = "two", **agent):
    """A run of two tasks that ends with the returns."""
    path = folder / f"{agent.get('name', 'ppo')}-{curriculum}-{seed}-{len(list(folder.iterdir()))}"
    path.mkdir()
    config = {"agent": {"_target_": f"baselines.{agent.pop('name', 'ppo')}.PPO", **agent}, "seed": seed}
    log = RunLog(path / "run.jsonl")
    log.append("run", schema=1, curriculum=curriculum, fingerprint="f", config=config, trained=[[1], [2]])
    for block, values in ((0, (0.0, 0.0)), (1, (1.0, 0.0)), (2, returns)):
        for task, value in enumerate(values, 1):
            log.append(
                *("evaluation",),
                **{"moment": "after" if block else "before", "block": block, "frames": block, "task": task},
                **{"label": f"goal{task}", "held_out": False, "return_mean": value, "success_rate": value},
            )
    log.close()
    if finished:
        write_metrics(path / "metrics.json", metrics.summary(log.performance(), [(0,), (1,)]))
    return path


def line(rows, measure: str, agent: str = "PPO"):
    (found,) = [row for row in rows if (row.measure, row.agent) == (measure, agent)]
    return found


def test_runs_of_one_configuration_become_one_line_a_metric(tmp_path):
    for seed, value in enumerate((0.25, 0.5, 0.75)):
        make_run(tmp_path, seed, (value, 1.0))

    rows = table(find_runs([tmp_path]))

    row = line(rows, "backward_transfer")
    assert (row.curriculum, row.definition, row.note) == ("two", "lopez-paz2017/bwt", "")
    assert (row.estimate.value, row.estimate.n) == (-0.5, 3)
    assert row.estimate.low == pytest.approx(-0.5 - 0.95 * (2 / (1 - 0.95**2)) ** 0.5 * 0.25 / 3**0.5, abs=1e-12)
    assert [row.measure for row in rows][4:] == ["interquartile_return", "solved goal1", "solved goal2"]


def test_solved_tasks_are_counted_at_the_end(tmp_path):
    for seed, value in enumerate((0.25, 0.9, 1.0)):
        make_run(tmp_path, seed, (value, 1.0))

    rows = table(find_runs([tmp_path]))

    assert line(rows, "solved goal1").estimate.value == 2 / 3
    assert line(rows, "solved goal2").estimate.value == 1.0
    assert line(rows, "interquartile_return").note == "needs 10 seeds of each task, got 3"


def test_an_unfinished_run_and_a_missing_one_are_shown(tmp_path):
    for seed in range(3):
        make_run(tmp_path, seed, name="ppo", gamma=0.9)
    make_run(tmp_path, 0, gamma=0.5)
    make_run(tmp_path, 1, gamma=0.5, finished=False)

    row = line(table(find_runs([tmp_path])), "average_performance", "PPO gamma=0.5")

    assert str(row.estimate) == "0.75 n = 1/3"
    assert row.note == "seed 1: unfinished or failed; seed 2: no run; one seed has no interval"


def test_an_undefined_metric_is_counted_with_its_reason(tmp_path):
    for seed in range(2):
        path = make_run(tmp_path, seed)
        single = torch.tensor([[0.0], [1.0]], dtype=torch.float64)
        write_metrics(path / "metrics.json", metrics.summary(single, [(0,)]))

    row = line(table(find_runs([tmp_path])), "forgetting")

    assert (row.estimate.value, row.estimate.n, row.estimate.n_undefined) == (None, 0, 2)
    assert row.note == "seed 0, 1: the definition needs at least two tasks; no seed has a value"


def test_agents_are_told_apart_by_class_and_by_the_settings_that_differ(tmp_path):
    make_run(tmp_path, 0, gamma=0.5, rate=1)
    make_run(tmp_path, 0, gamma=0.9, rate=1)
    make_run(tmp_path, 0, curriculum="other", rate=1)

    rows = table(find_runs([tmp_path]))

    assert {(row.curriculum, row.agent) for row in rows} == {
        ("two", "PPO gamma=0.5"),
        ("two", "PPO gamma=0.9"),
        ("other", "PPO"),
    }


def test_agents_are_compared_seed_by_seed(tmp_path):
    for seed in range(4):
        make_run(tmp_path, seed, (1.0, 1.0), gamma=0.9)
        make_run(tmp_path, seed, (0.25 * seed, 1.0), gamma=0.5)

    (found,) = comparisons(find_runs([tmp_path]), "average_performance").items()

    names, comparison = found
    assert names == ("two", "PPO gamma=0.9", "PPO gamma=0.5")
    assert comparison.difference.value == (0.5 + 0.375 + 0.25 + 0.125) / 4
    assert (comparison.wins, comparison.p_value) == (4, 2 / 16)


def test_runs_of_different_curricula_are_not_compared(tmp_path):
    for seed in range(2):
        make_run(tmp_path, seed)
        make_run(tmp_path, seed, curriculum="other")

    assert comparisons(find_runs([tmp_path]), "average_performance") == {}


def test_an_unknown_metric_lists_those_that_there_are(tmp_path):
    make_run(tmp_path, 0)

    with pytest.raises(ValueError, match="no run has a metric 'accuracy'; there are: average_performance, "):
        comparisons(find_runs([tmp_path]), "accuracy")


def test_one_run_twice_is_refused_and_one_folder_twice_is_not(tmp_path):
    make_run(tmp_path, 0)
    assert len(find_runs([tmp_path, tmp_path])) == 1
    make_run(tmp_path, 0)

    with pytest.raises(ValueError, match="are one run twice; leave one out"):
        find_runs([tmp_path])


def test_a_folder_without_runs_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"holds no run: no run\.jsonl in or below it"):
        find_runs([tmp_path])


def test_a_log_without_its_first_line_is_refused(tmp_path):
    (tmp_path / "run.jsonl").write_text(json.dumps({"kind": "training"}) + "\n")

    with pytest.raises(ValueError, match="does not say what was run"):
        find_runs([tmp_path])


def test_the_table_is_printed_and_written(tmp_path, monkeypatch, capsys):
    (tmp_path / "runs").mkdir()
    for seed in range(2):
        make_run(tmp_path / "runs", seed, (0.5 + seed / 4, 1.0))
        make_run(tmp_path / "runs", seed, (0.0, 1.0), gamma=0.5)
    monkeypatch.setenv("COLUMNS", "200")
    arguments = [str(tmp_path / "runs"), "--csv", str(tmp_path / "table.csv"), "--compare", "average_performance"]
    monkeypatch.setattr(sys, "argv", ["results", *arguments, "--difference", "0.25"])

    results.main()

    shown = capsys.readouterr().out
    assert "average performance" in shown and "0.81 [0.02, 1.61] n = 2" in shown
    assert "mean [Student's 95 % interval], share of solved seeds [exact one]" in shown
    sentence = "better in 2, equal in 0, worse in 0; sign-flip p = 0.5; 4 seeds find a difference of 0.25"
    assert sentence in " ".join(shown.split())
    rows = list(csv.DictReader((tmp_path / "table.csv").open(newline="")))
    assert tuple(rows[0]) == results.HEADER
    assert (rows[0]["measure"], rows[0]["value"], rows[0]["n"]) == ("average_performance", "0.8125", "2")
    assert rows[1]["low"] == "" and rows[1]["note"] == "all seeds are equal: no spread to estimate"


def test_brackets_of_intervals_are_no_markup(tmp_path):
    for seed in range(2):
        make_run(tmp_path, seed, (seed / 2, 1.0))
    console = Console(file=io.StringIO(), width=200)

    console.print(results.rich_table(table(find_runs([tmp_path]))))

    assert "[-2.43, 3.93]" in console.file.getvalue()


def test_a_users_error_is_one_message(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["results", str(tmp_path)])

    with pytest.raises(SystemExit):
        results.main()

    assert "holds no run" in capsys.readouterr().err
