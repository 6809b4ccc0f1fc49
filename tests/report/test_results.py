"""Many runs as one table."""

from __future__ import annotations

import csv
import json
import sys

import pytest
import torch
from helpers.made_runs import all_runs, line, make_run
from helpers.scripted import DECISION_ID, ONE, TWO, curriculum

from ctgraph_rl import Block, Recorder, metrics, parsers
from ctgraph_rl.log.sums import write_metrics
from ctgraph_rl.report import formats, results
from ctgraph_rl.report.results import comparisons, rows_by_seed, selected, table
from ctgraph_rl.report.terminal import mixed_code
from ctgraph_rl.runs.experts import EXPERT
from ctgraph_rl.runs.read import Problem, find_runs, grouped, why_left_out

pytest.importorskip("scipy")


def test_runs_of_one_configuration_become_one_line_a_metric(tmp_path):
    for seed, value in enumerate((0.25, 0.5, 0.75)):
        make_run(tmp_path, seed, (value, 1.0))

    rows = table(all_runs([tmp_path]))

    row = line(rows, "backward_transfer")
    assert (row.curriculum, row.definition, row.note) == ("two", "lopez-paz2017/bwt", "")
    assert (row.estimate.value, row.estimate.n) == (-0.5, 3)
    assert row.estimate.low == pytest.approx(-0.5 - 0.95 * (2 / (1 - 0.95**2)) ** 0.5 * 0.25 / 3**0.5, abs=1e-12)
    at_the_end = ["mean_final_return", "solved_rate", "interquartile_return", "solved goal1", "solved goal2"]
    assert [row.measure for row in rows][4:] == at_the_end


def test_solved_tasks_are_counted_at_the_end(tmp_path):
    for seed, value in enumerate((0.25, 0.9, 1.0)):
        make_run(tmp_path, seed, (value, 1.0))

    rows = table(all_runs([tmp_path]))

    assert line(rows, "solved goal1").estimate.value == 2 / 3
    assert line(rows, "solved goal2").estimate.value == 1.0
    assert line(rows, "solved_rate").estimate.value == 2.5 / 3
    assert line(rows, "mean_final_return").estimate.value == pytest.approx((0.625 + 0.95 + 1.0) / 3, abs=1e-15)
    assert line(rows, "interquartile_return").note == "needs 10 seeds of each task, got 3"


def test_several_seeds_without_scipy_are_refused_at_once_and_one_seed_is_not(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "scipy", None)
    make_run(tmp_path, 0)
    counted = []

    one = table(all_runs([tmp_path]))
    make_run(tmp_path, 1)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'ctgraph_rl\[stats\]'"):
        table(all_runs([tmp_path]), count=lambda *done: counted.append(done))

    assert line(one, "average_performance").estimate.n == 1
    assert counted == []


def test_an_unfinished_run_and_a_missing_one_are_shown(tmp_path):
    for seed in range(3):
        make_run(tmp_path, seed, name="ppo", gamma=0.9)
    make_run(tmp_path, 0, gamma=0.5)
    make_run(tmp_path, 1, gamma=0.5, finished=False)

    row = line(table(all_runs([tmp_path])), "average_performance", "PPO gamma=0.5")

    assert str(row.estimate) == "0.75 n = 1/3"
    assert row.note == "seed 1: unfinished; seed 2: no run; one seed has no interval"


def test_seeds_that_were_closed_after_a_quarter_are_in_no_statistic_and_are_named(tmp_path):
    learned = curriculum(*(Block(task, 12) for task in (ONE, TWO, ONE, TWO)))

    def record(seed: int, agent: str, quarters: int) -> None:
        with Recorder(learned, tmp_path / agent / str(seed), seed=seed, about={"learner": agent}) as recorder:
            for frames in (0, *learned.ends[:quarters]):
                recorder.evaluate(lambda images: images[:, DECISION_ID].astype(int), frames)

    for seed in range(3):
        record(seed, "early", 1)
        record(seed, "mixed", 4 if seed else 3)
        record(seed, "whole", 4)
    runs = all_runs([tmp_path])

    rows = table(runs)
    assert line(rows, "every_metric", "early").note == "seed 0, 1, 2: unfinished: 12 of 48 frames; no seed has a value"
    assert [row.measure for row in rows if row.agent == "early"] == ["every_metric"]
    for name in ("solved_rate", "mean_final_return", "instant_cumulative_return", "stage_reached"):
        mixed = line(rows, name, "mixed")
        assert mixed.estimate.n == 2
        assert mixed.note.startswith("seed 0: unfinished: 36 of 48 frames")
    pairs = comparisons(runs, "instant_cumulative_return")
    assert pairs["scripted", "mixed", "whole"].difference.n == 2
    assert pairs["scripted", "early", "whole"].difference.n == 0


def test_a_task_without_an_evaluation_after_the_last_block_leaves_the_rates_without_a_value(tmp_path):
    path = make_run(tmp_path, 0)
    kept = []
    for text in (path / "run.jsonl").read_text().splitlines():
        m = json.loads(text)
        if (m["kind"], m.get("block"), m.get("task")) != ("evaluation", 2, 1):
            kept.append(text)
    (path / "run.jsonl").write_text("\n".join(kept) + "\n")

    rows = table(all_runs([tmp_path]))

    assert line(rows, "solved_rate").estimate.value is line(rows, "mean_final_return").estimate.value is None
    assert [line(rows, f"solved goal{task}").estimate.n for task in (1, 2)] == [0, 1]


def test_an_undefined_metric_is_counted_with_its_reason(tmp_path):
    for seed in range(2):
        path = make_run(tmp_path, seed)
        single = torch.tensor([[0.0], [1.0]], dtype=torch.float64)
        write_metrics(path / "metrics.json", metrics.summary(single, [(0,)]))

    row = line(table(all_runs([tmp_path])), "forgetting")

    assert (row.estimate.value, row.estimate.n, row.estimate.n_undefined) == (None, 0, 2)
    assert row.note == "seed 0, 1: the definition needs at least two tasks; no seed has a value"


def test_agents_are_told_apart_by_class_and_by_the_settings_that_differ(tmp_path):
    make_run(tmp_path, 0, gamma=0.5, rate=1)
    make_run(tmp_path, 0, gamma=0.9, rate=1)
    make_run(tmp_path, 0, curriculum="other", rate=1)

    rows = table(all_runs([tmp_path]))

    assert {(row.curriculum, row.agent) for row in rows} == {
        ("two", "PPO gamma=0.5"),
        ("two", "PPO gamma=0.9"),
        ("other", "PPO"),
    }


def test_agents_of_one_name_are_in_the_order_of_their_settings(tmp_path):
    make_run(tmp_path, 0, rate=None, heads="auto")
    for rate, heads in (
        (10, "single"),
        (1000, "multi"),
        (9.5, "multi"),
        (1000, "auto"),
        (9.5, "single"),
        (10, "multi"),
    ):
        make_run(tmp_path, 0, rate=rate, heads=heads)

    agents = dict.fromkeys(row.agent for row in table(all_runs([tmp_path])))

    expected = [
        ("auto", None),
        ("auto", 1000),
        ("multi", 9.5),
        ("multi", 10),
        ("multi", 1000),
        ("single", 9.5),
        ("single", 10),
    ]
    assert list(agents) == [f"PPO heads={heads} rate={rate}" for heads, rate in expected]


def test_a_cell_that_did_not_begin_is_left_out_with_its_reason(tmp_path):
    fine = make_run(tmp_path, 0)
    refused = tmp_path / "refused"
    refused.mkdir()
    (refused / "failed.txt").write_text("ValueError: it needs\ntask ids\n")

    runs, problems = find_runs([tmp_path])

    assert [run.path for run in runs] == [fine]
    assert [problem.reason for problem in problems] == [
        f"{refused} did not begin, failed: ValueError: it needs task ids"
    ]
    assert find_runs([tmp_path, fine / ".." / refused.name])[1] == problems


def test_agents_are_compared_seed_by_seed(tmp_path):
    for seed in range(4):
        make_run(tmp_path, seed, (1.0, 1.0), gamma=0.5)
        make_run(tmp_path, seed, (0.25 * seed, 1.0), gamma=0.9)

    (found,) = comparisons(all_runs([tmp_path]), "average_performance").items()

    names, comparison = found
    assert names == ("two", "PPO gamma=0.5", "PPO gamma=0.9")
    assert comparison.difference.value == (0.5 + 0.375 + 0.25 + 0.125) / 4
    assert (comparison.wins, comparison.p_value) == (4, 2 / 16)


def test_runs_of_different_curricula_are_not_compared(tmp_path):
    for seed in range(2):
        make_run(tmp_path, seed)
        make_run(tmp_path, seed, curriculum="other")

    assert comparisons(all_runs([tmp_path]), "average_performance") == {}


def test_an_unknown_metric_lists_those_that_there_are(tmp_path):
    make_run(tmp_path, 0)

    with pytest.raises(ValueError, match="no run has a measure 'accuracy': there are "):
        comparisons(all_runs([tmp_path]), "accuracy")


def test_agents_are_not_compared_in_what_follows_from_the_curriculum(tmp_path):
    run = make_run(tmp_path, 0)
    found = json.loads((run / "metrics.json").read_text())
    (run / "metrics.json").write_text(json.dumps(found | {"optimal_performance": found["average_performance"]}))

    with pytest.raises(ValueError, match=r"optimal_performance follows from the curriculum, .* compare another metric"):
        comparisons(all_runs([tmp_path]), "optimal_performance")


def test_of_one_run_twice_a_finished_one_is_kept_and_one_folder_twice_is_no_problem(tmp_path):
    first = make_run(tmp_path, 0)
    assert len(all_runs([tmp_path, tmp_path])) == 1
    second = make_run(tmp_path, 0)
    said = f"{first} and {second} are one run twice; "

    runs, problems = find_runs([tmp_path])

    assert [run.path for run in runs] == [first]
    assert problems == [Problem(second, f"{said}{second} is left out")]

    (first / "metrics.json").unlink()
    runs, problems = find_runs([tmp_path])

    assert [run.path for run in runs] == [second]
    assert problems == [Problem(first, f"{said}{first} is left out (unfinished)")]


def test_a_folder_without_runs_is_a_problem(tmp_path):
    reason = f"{tmp_path} holds no run: no run.jsonl in or below it; name a run directory, or a folder that holds some"

    assert find_runs([tmp_path]) == ([], [Problem(tmp_path, reason)])


def test_the_table_is_printed_and_written(tmp_path, monkeypatch, capsys):
    (tmp_path / "runs").mkdir()
    for seed in range(2):
        make_run(tmp_path / "runs", seed, (0.5 + seed / 4, 1.0))
        make_run(tmp_path / "runs", seed, (0.0, 1.0), gamma=0.5)
    arguments = [
        str(tmp_path / "runs"),
        "--all",
        "--csv",
        str(tmp_path / "table.csv"),
        "--compare",
        "average_performance",
    ]
    monkeypatch.setattr(sys, "argv", ["results", *arguments, "--difference", "0.25"])

    results.main()

    shown = capsys.readouterr().out
    assert "    average performance   0.81 [0.02, 1.61]    n = 2\n" in shown
    assert (
        "mean [95 % CI]; about 95 or more of 100 such intervals (CI) hold the true mean; intervals of solved"
        in " ".join(shown.split())
    )
    test = "sign-flip p = 0.5, Holm 0.5: not distinguishable with 2 seeds"
    seen = "6 would find such a difference with a chance of 80 %"
    sentence = f"better in 2, equal in 0, worse in 0; {test}; {seen}; 6 seeds find a difference of 0.25"
    assert sentence in " ".join(shown.split())
    rows = list(csv.DictReader((tmp_path / "table.csv").open(newline="")))
    assert tuple(rows[0]) == results.HEADER
    assert (rows[0]["measure"], rows[0]["value"], rows[0]["n"]) == ("average_performance", "0.8125", "2")
    assert rows[1]["low"] == "" and rows[1]["note"] == "all seeds are equal: no spread to estimate"


def shown_by(monkeypatch, capsys, *arguments: str) -> str:
    """Return what the command prints."""
    monkeypatch.setattr(sys, "argv", ["results", *arguments])
    results.main()
    return capsys.readouterr().out


def test_a_table_has_the_statistics_that_are_asked_for(tmp_path, monkeypatch, capsys):
    for seed, value in enumerate((0.0, 0.25, 0.5, 1.0)):
        make_run(tmp_path, seed, (value, 1.0))

    shown = {
        kind: " ".join(shown_by(monkeypatch, capsys, str(tmp_path), "--statistics", kind).split())
        for kind in parsers.STATISTICS
    }

    assert "--statistics exact: few seeds of bounded values need wider intervals" in shown["exact"]
    assert "solved rate 0.62 [0.24, 0.90] n = 4" in shown["exact"]
    assert "solved rate 0.62 [0.23, 1.02] n = 4" in shown["t"]
    assert "$\\pm$ 0.25" in shown_by(monkeypatch, capsys, str(tmp_path), "--statistics", "std", "--format", "latex")
    assert shown["std"].startswith("mean ± standard deviation over seeds; intervals of solved seeds")
    assert "average performance 0.72 ± 0.21 n = 4" in shown["std"]
    assert "average performance 0.69 [" in shown["iqm"]
    assert "interquartile return 0.88 [" in shown["iqm"]  # 0, 0.25, 0.5 and five times 1


def test_each_seed_is_a_row_where_that_is_asked_for(tmp_path, monkeypatch, capsys):
    for seed, value in enumerate((0.0, 0.5)):
        make_run(tmp_path, seed, (value, 1.0))
    make_run(tmp_path, 2, finished=False)

    shown = shown_by(monkeypatch, capsys, str(tmp_path), "--per-seed", "--csv", str(tmp_path / "table.csv"))

    assert "  PPO, seed 1\n    average performance  0.75   n = 1" in shown
    assert "seed 2: unfinished" in shown
    rows = list(csv.DictReader((tmp_path / "table.csv").open(newline="")))
    returns = [(row["seed"], row["value"], row["low"]) for row in rows if row["measure"] == "mean_final_return"]
    assert returns == [("0", "0.5", ""), ("1", "0.75", "")]


def test_every_evaluation_is_a_row_of_a_tidy_table(tmp_path, monkeypatch, capsys):
    parquet = pytest.importorskip("pyarrow.parquet")
    (tmp_path / "runs").mkdir()
    path = make_run(tmp_path / "runs", 0, (0.25, 1.0))
    make_run(tmp_path / "runs", 1, finished=False)
    for name in ("all.csv", "all.parquet"):
        shown_by(monkeypatch, capsys, str(tmp_path / "runs"), "--tidy", str(tmp_path / name))

    rows = list(csv.DictReader((tmp_path / "all.csv").open(newline="")))

    assert len(rows) == 12
    names = ("agent", "run", "curriculum", "seed", "block", "task", "label", "return_mean")
    assert [rows[4][name] for name in names] == ["PPO", str(path), "two", "0", "2", "1", "goal1", "0.25"]
    typed = parquet.read_table(tmp_path / "all.parquet").to_pylist()
    assert [row["return_mean"] for row in typed] == [float(row["return_mean"]) for row in rows]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["runs", "--tidy", "all.xlsx"], "a table of evaluations ends in .csv or .parquet, got all.xlsx"),
        (["empty"], "empty holds no run: no run.jsonl in or below it"),
        (["nowhere"], "nowhere holds no run: there is no such directory; name a run directory, or a folder that holds"),
        (["table.csv"], "table.csv holds no run: it is a file; name a run directory"),
        (["runs/0/metrics.json"], "it is a file; name a run directory, such as runs/0"),
        (["runs", "--compare", "average_performance"], "--compare needs two agents with the same seeds on one"),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_a_users_error_is_one_message(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "runs").mkdir()
    (tmp_path / "table.csv").touch()
    make_run(tmp_path, 0).rename(tmp_path / "runs" / "0")
    monkeypatch.setattr(sys, "argv", ["results", *arguments])

    with pytest.raises(SystemExit, match="2"):
        results.main()

    shown = capsys.readouterr()
    assert message in shown.err and shown.out == ""
    assert shown.err.count("\n") == 1


@pytest.mark.parametrize("name", [EXPERT, f"{EXPERT} (modified)"])
def test_single_task_experts_are_no_rows_beside_other_runs(tmp_path, name):
    make_run(tmp_path, 0)
    (tmp_path / "runs" / "experts").mkdir(parents=True)
    for _ in range(2):  # of two versions of a package: one configuration, twice
        expert = make_run(tmp_path / "runs" / "experts", 0, curriculum=name)

    assert [run.curriculum[0] for run in all_runs([tmp_path])] == ["two"]
    assert [run.curriculum[0] for run in all_runs([expert])] == [name]


def record(path, **config):
    """A finished run whose configuration is given."""
    made = make_run(path.parent, 0)
    first, *others = (made / "run.jsonl").read_text().splitlines()
    (made / "run.jsonl").write_text("\n".join([json.dumps({**json.loads(first), "config": config}), *others]) + "\n")
    path.parent.mkdir(exist_ok=True)
    made.rename(path)


def test_runs_in_one_folder_that_name_no_agent_are_one_learner_with_its_name(tmp_path, monkeypatch, capsys):
    learned = curriculum(Block(ONE, 12), Block(TWO, 12))
    for name, count in (("mine", 3), ("yours", 2)):
        for seed in range(count):
            with Recorder(learned, tmp_path / f"runs/{name}/{seed}", seed) as recorder:
                for frames in (0, *learned.ends):
                    recorder.evaluate(lambda images: images[:, DECISION_ID].astype(int), frames)

    runs, problems = find_runs([tmp_path])
    rows = [row for row in table(runs) if row.measure == "average_performance"]

    assert problems == [] and mixed_code(runs) == []
    assert {row.agent: row.estimate.n for row in rows} == {"mine": 3, "yours": 2}
    assert {row.agent: row.seed for row in rows_by_seed(runs)} == {"mine": 2, "yours": 1}
    shown_by(monkeypatch, capsys, str(tmp_path))  # exit code 0


def test_one_seed_twice_in_a_folder_of_a_learner_without_a_name_is_left_out_with_the_fix(tmp_path):
    make_run(tmp_path, 2)
    for name in ("mine", "yours"):
        record(tmp_path / name, seed=0)

    runs, problems = find_runs([tmp_path])

    assert sorted((run.agent or "", run.seed) for run in runs) == [("", 0), ("PPO", 2)]
    assert why_left_out(problems) == (
        f"{tmp_path}/mine and {tmp_path}/yours are both seed 0 of the learner of {tmp_path}, "
        f"{tmp_path}/yours is left out: "
        'learners need names, such as Recorder(..., about={"learner": "NAME"}), or separate folders'
    )


def test_folders_of_one_name_are_told_apart(tmp_path):
    for folder in ("a", "b"):
        (tmp_path / folder / "run").mkdir(parents=True)
        record(tmp_path / folder / "run" / "0", seed=0)

    agents = {row.agent for row in table(all_runs([tmp_path]))}

    assert agents == {f"run folder={(tmp_path / folder / 'run').resolve()}" for folder in ("a", "b")}


@pytest.mark.parametrize("key", ["agent", "learner"])
def test_a_plain_name_of_the_agent_is_the_name_of_its_runs(tmp_path, key):
    for seed in range(3):
        record(tmp_path / f"run{seed}", seed=seed, **{key: "sac"})

    row = line(table(all_runs([tmp_path])), "average_performance", "sac")

    assert str(row.estimate) == "0.75 n = 3"


PPO = {"_target_": "baselines.ppo.PPO"}


def test_an_agent_has_its_method_in_its_name_and_the_settings_in_which_that_differs(tmp_path):
    for number, (name, settings) in enumerate(
        [("ewc.EWC", {"coeff": 1.0}), ("ewc.EWC", {"coeff": 2.0}), ("mask_ri.MaskRI", {}), ("mask_lc.MaskLC", {})]
    ):
        method = {"_target_": f"baselines.methods.{name}", **settings}
        record(tmp_path / f"run{number}", seed=0, agent=PPO, method=method)
    record(tmp_path / "named", seed=0, agent="sac", method="replay")

    names = {name for _, name in grouped(all_runs([tmp_path]))}

    assert names == {"PPO + EWC coeff=1.0", "PPO + EWC coeff=2.0", "PPO + MaskRI", "PPO + MaskLC", "sac + replay"}


def test_runs_that_are_fine_tuned_and_those_that_name_no_method_are_seeds_of_one_agent(tmp_path):
    record(tmp_path / "without", seed=0, agent=PPO)
    record(tmp_path / "with", seed=1, agent=PPO, method={"_target_": "baselines.methods.finetune.Finetune"})

    ((_, by_seed),) = grouped(all_runs([tmp_path])).items()

    assert sorted(by_seed) == [0, 1]
    assert line(table(all_runs([tmp_path])), "average_performance", "PPO").estimate.n == 2


def test_an_agent_none_of_whose_runs_finished_is_one_row(tmp_path):
    make_run(tmp_path, 0, finished=False)

    rows = table(all_runs([tmp_path]))

    assert [(row.measure, str(row.estimate), row.note) for row in rows] == [
        ("every_metric", "- n = 0/1", "seed 0: unfinished; no seed has a value")
    ]
    assert selected(rows) == selected(rows, ["regret"]) == rows
    assert formats.text(rows).splitlines()[5:] == [
        *("two", "  PPO", "    every metric  -  n = 0/1  (1)", "  (1) seed 0: unfinished; no seed has a value")
    ]


def test_a_log_of_one_line_is_an_unfinished_run_beside_a_finished_one(tmp_path):
    make_run(tmp_path, 0, gamma=0.5)
    crashed = make_run(tmp_path, 0, gamma=0.9, finished=False) / "run.jsonl"
    crashed.write_text(crashed.read_text().splitlines()[0] + "\n")

    rows = selected(table(all_runs([tmp_path])), ["forgetting"])

    assert [(row.agent, row.measure, str(row.estimate)) for row in rows] == [
        ("PPO gamma=0.5", "forgetting", "0.00 n = 1"),
        ("PPO gamma=0.9", "every_metric", "- n = 0/1"),
    ]


@pytest.mark.parametrize("name", ["multirun.yaml", "optimization_results.yaml"])
def test_the_files_that_hydra_leaves_in_a_sweep_are_no_runs_without_results(tmp_path, name):
    run_dir = make_run(tmp_path, 0)
    (tmp_path / name).touch()
    (tmp_path / "notes.txt").touch()

    assert find_runs([run_dir, tmp_path / name])[1] == []
    assert "notes.txt holds no run" in find_runs([run_dir, tmp_path / "notes.txt"])[1][0].reason
    assert f"{name} holds no run" in find_runs([tmp_path / name])[1][0].reason
