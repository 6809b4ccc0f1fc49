"""Finished runs as one data frame."""

from __future__ import annotations

import json
import re
import sys

import pytest
from helpers.made_runs import all_runs, make_run
from helpers.paths import CHECKOUT

from ctgraph_rl import RunLog, results
from ctgraph_rl.report.results import print_table, table
from ctgraph_rl.report.terminal import print_summary


def test_each_evaluation_of_the_log_and_each_metric_is_one_row(tmp_path):
    path = make_run(tmp_path, 3, (0.25, 0.5))

    frame = results(tmp_path)

    evaluations = frame[frame.metric == "return_mean"]
    found = zip(
        evaluations.task, evaluations.block, evaluations.frames, evaluations.moment, evaluations.value, strict=True
    )
    logged = RunLog.read(path / "run.jsonl").of_kind("evaluation")
    assert list(found) == [(m["label"], m["block"], m["frames"], m["moment"], m["return_mean"]) for m in logged]
    [run] = all_runs([tmp_path])
    of_run = frame[frame.task.isna()]
    assert dict(zip(of_run.metric, of_run.value, strict=True)) == {
        name: each["value"] for name, each in run.metrics.items()
    }
    assert len(frame) == 2 * len(logged) + len(run.metrics)


def test_rows_name_the_run_as_tables_do(tmp_path):
    make_run(tmp_path, 0, gamma=0.9)
    make_run(tmp_path, 1, gamma=0.5)

    frame = results([tmp_path])

    named = frame[["agent", "method", "learner", "curriculum", "fingerprint", "numbers_version", "seed"]]
    assert sorted(named.drop_duplicates().itertuples(index=False, name=None)) == [
        ("PPO", "Finetune", "PPO gamma=0.5", "two", "f", 1, 1),
        ("PPO", "Finetune", "PPO gamma=0.9", "two", "f", 1, 0),
    ]
    assert frame.settings.unique().tolist() == [
        '{"agent._target_": "baselines.ppo.PPO", "agent.gamma": 0.5}',
        '{"agent._target_": "baselines.ppo.PPO", "agent.gamma": 0.9}',
    ]


def test_columns_and_their_types_are_those_of_the_docstring(tmp_path):
    make_run(tmp_path, 0)

    frame = results(tmp_path)

    said = {}
    for names, dtype in re.findall(r"((?:``\w+``,? ?)+): (\w+)", " ".join(results.__doc__.split())):
        said |= dict.fromkeys(re.findall(r"\w+", names), dtype)
    assert {name: str(dtype) for name, dtype in frame.dtypes.items()} == said


def test_an_undefined_metric_is_a_row_without_a_value(tmp_path):
    path = make_run(tmp_path, 0)
    text = (path / "metrics.json").read_text()
    (path / "metrics.json").write_text(re.sub(r'"value": -?[\d.]+', '"value": null', text, count=1))

    frame = results(tmp_path)

    assert frame[frame.task.isna()].value.isna().sum() == 1


def test_what_is_left_out_is_said_and_without_a_finished_run_there_is_no_frame(tmp_path):
    unfinished = make_run(tmp_path, 1, finished=False)
    with pytest.raises(ValueError, match=f"no run is finished: {unfinished}: unfinished"):
        results(tmp_path)
    make_run(tmp_path, 0)

    with pytest.warns(UserWarning, match=f"left out: {unfinished}: unfinished"):
        frame = results(tmp_path)

    assert frame.seed.unique().tolist() == [0]


@pytest.mark.parametrize("paths", [[], 3, None, [3]])
def test_what_are_no_paths_is_refused_with_an_example(paths):
    rule = f"paths must be a folder of runs or a list of them, such as 'runs/ct8', got {paths!r}"
    with pytest.raises(ValueError, match=re.escape(rule)):
        results(paths)


def test_a_run_whose_log_is_broken_and_says_no_blocks_has_no_returns(tmp_path):
    path = make_run(tmp_path, 0, finished=False)
    about, *_ = RunLog.read(path / "run.jsonl").measurements
    del about["trained"]
    (path / "run.jsonl").write_text(json.dumps(about) + "\nno measurement\n{}\n")

    [run] = all_runs([tmp_path])

    assert (run.values, run.returns, run.success, run.tasks) == ((), {}, {}, [])
    assert [row.measure for row in table([run])] == ["every_metric"]


def test_tables_and_summaries_need_no_pandas_and_a_frame_says_what_to_install(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "pandas", None)
    path = make_run(tmp_path, 0)

    print_table([tmp_path])
    print_summary(path)
    with pytest.raises(ModuleNotFoundError, match=r"^results needs pandas: pip install 'ctgraph_rl\[report\]'$"):
        results(tmp_path)

    assert "average performance" in capsys.readouterr().out


def test_the_guide_groups_pivots_and_draws(tmp_path, monkeypatch):
    for seed in (0, 1):
        make_run(tmp_path, seed, curriculum="ct8")
        make_run(tmp_path, seed, curriculum="ct8", name="dqn")
    monkeypatch.chdir(tmp_path)
    page = (CHECKOUT / "docs/how-to/results.md").read_text(encoding="utf-8")
    names = {}

    for block in re.findall(r"```py\n(.*?)```", page, re.DOTALL):
        exec(block.replace("runs/ct8", "."), names)

    assert names["table"].index.names == ["agent", "method"]
    assert [len(axes.lines) for axes in names["figure"].axes] == [2]
