"""What the pages about speed show."""

from __future__ import annotations

import csv
import json
import re

import pytest
import torch
from helpers.paths import CHECKOUT

from benchmarks import environment_ladder as ladder
from benchmarks import environments as benchmark
from ctgraph_rl import Rows, Steps, rollout
from ctgraph_rl.core.dynamics import words_of

PAGE = CHECKOUT / "docs" / "how-to" / "go_fast.md"


@pytest.mark.slow
def test_the_example_of_the_fast_path_learns_the_task(capsys):
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    (code,) = [block for block in blocks if "optimizer" in block]

    exec(compile(code, str(PAGE), "exec"), {})

    assert float(capsys.readouterr().out.split()[0]) >= 0.9


@pytest.mark.slow
def test_the_benchmark_prints_a_row_for_every_way(capsys):
    benchmark.main(["--rows", "2", "--tasks", "SU", "--rounds", "1", "--seconds", "0.001", "--skip-kernel"])

    lines = capsys.readouterr().out.splitlines()
    ways = [line.split("|")[3].strip() for line in lines if line.startswith("| 2 ")]
    assert ways == [
        "memset",
        "memcpy",
        "trivial environment: TorchRL rollout",
        "trivial environment: TorchRL Collector",
        "core, observations of the step and of the reset",
        "fast rollout",
        "TorchRL rollout",
        "TorchRL Collector",
        "TorchRL rollout, info=False",
        "TorchRL Collector, info=False",
        "Gymnasium VectorEnv",
    ]


def test_the_ladder_of_a_device_prints_what_it_has_measured_when_it_is_stopped(capsys, monkeypatch):
    monkeypatch.delitem(ladder.WAYS, "rollout, fused and captured")  # compiling takes long
    measure, measured = ladder.measure, []

    def stopped(rung: ladder.Rung, *how: object) -> None:
        measured.append(rung)
        if len(measured) == 3:
            raise KeyboardInterrupt
        measure(rung, *how)

    monkeypatch.setattr(ladder, "measure", stopped)
    benchmark.main(["--device", "cpu", "--rows", "2", "--tasks", "SU", "--rounds", "1", "--seconds", "0.001"])

    lines = [line.split("|") for line in capsys.readouterr().out.splitlines() if line.startswith("| 2 ")]
    assert [line[3].strip() for line in lines] == [ladder.COPY, *ladder.WAYS][:2]
    assert all(float(line[4]) > 0 for line in lines)


@pytest.mark.parametrize("name", benchmark.configurations())
def test_the_step_that_the_ladder_compiles_is_that_of_a_rollout(name):
    task, actions = benchmark.configurations()[name], torch.randint(0, 3, (20, 8))
    rows, twin = (Rows([task] * 8, kernel="off") for _ in range(2))
    expected, found = (rollout(rows, actions, Steps.empty(rows, 20)), Steps.empty(twin, 20))
    twin.reset()

    params, observation = ladder.in_words(twin, found)
    state, words = tuple(twin.state), words_of(twin.state.tick, params, twin.uses)
    for t, action in enumerate(actions):
        outputs = (observation[t + 1], found.reward[t], found.done[t], found.outcome[t])
        state, words = ladder.write_step(outputs, state, action, words, params=params, uses=twin.uses)

    assert observation.dtype == (torch.uint8 if "noise" in name else torch.int64)
    assert torch.equal(found.observation[1:], expected.observation[1:])
    assert all(torch.equal(getattr(found, key), getattr(expected, key)) for key in ("reward", "done", "outcome"))


def numbers(text: str, header: str) -> dict[str, list[list[float]]]:
    """The numbers of a table by the name of the row: of each cell the speed and the share of memcpy."""
    lines = text.split(header)[1].split("\n\n")[0].splitlines()[2:]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return {row[0]: [speed_and_share(cell) for cell in row[1:]] for row in rows}


def speed_and_share(cell: str) -> list[float]:
    return [float(number) for number in re.findall(r"[\d.]+", cell)[:2]]


def test_the_speeds_of_the_page_are_those_of_the_table_in_the_reference():
    page = (CHECKOUT / "docs" / "explanation" / "speed.md").read_text(encoding="utf-8")
    with open(CHECKOUT / "docs" / "reference" / "speed_table.csv", newline="", encoding="utf-8") as file:
        whole = {name: list(map(speed_and_share, cells)) for name, *cells in list(csv.reader(file))[1:]}
    shown = numbers(page, "| 16,384 rows, million")

    del shown['`rollout`, `kernel="off"`']  # the table of the reference is the kernel's
    names = {"`rollout`": "fast rollout", "`rollout`, noise bank of 4,096": "fast rollout, noise bank"}
    for way, cells in shown.items():
        name = names.get(way, way.replace("`", ""))
        of_tasks = [whole.get(f"{task}: {name}", [[]])[-1] for task in ("SU", "CO", "SU, noise 10", "CO, noise 10")]
        assert cells == of_tasks, way
    core, through_torchrl = shown["core"][0][0], shown["TorchRL `rollout`"][0][0]
    assert f"{core:.0f} million steps a second with 16,384 rows, and {through_torchrl} million through" in page


@pytest.fixture
def gpu():
    from studies import gpu

    return gpu


def test_the_page_says_of_gpus_what_was_measured(gpu):
    page = gpu.PAGE.read_text(encoding="utf-8")

    assert gpu.with_section(page, json.loads(gpu.FILE.read_text())) == page


TASKS = {"environment, SU": "SU", "environment, CO": "CO", "environment, SU with noise": "SU, noise 10"}
COMPARED = [
    (ladder.COPY, ""),
    ("rollout, fused and captured", "SU"),
    ("rollout, fused and captured", "CO"),
]


def test_what_the_page_says_of_gpus_in_words_was_measured(gpu):
    report = json.loads(gpu.FILE.read_text())
    page = (CHECKOUT / "docs" / "explanation" / "speed.md").read_text(encoding="utf-8")
    rates = {(row["way"], row["task"], row["rows"]): row["per_second"] for row in report["environment"]}
    learned = {(row["way"], row["rows"]): row["per_second"] for row in report["learning"]}
    ways = ("rollout", "rollout, captured", "rollout, fused and captured")
    rows = {name: [f"{rates[way, task, 65_536] / 1e6:,.0f}" for way in ways] for name, task in TASKS.items()}
    ways = ("step by step", "captured", "compiled and captured")
    rows["PPO on CT-FO-B1"] = [f"{learned[f'ppo, {way}', 65_536] / 1e6:.1f}" for way in ways]
    rows["LSTM-PPO on CT-SU-B1"] = [*(f"{learned[f'lstm_ppo, {way}', 65_536] / 1e6:.1f}" for way in ways[:2]), ""]
    copied, su, co = (rates[way, task, 65_536] / 1e9 for way, task in COMPARED)
    few, few_lstm = (learned[f"{name} captured", 256] / 1e6 for name in ("ppo, compiled and", "lstm_ppo,"))
    minutes = 1024 * gpu.learning.MAIN_JOB / learned["lstm_ppo, 1,024 seeds as one job", 262_144] / 60

    assert re.findall(r"^\| ((?:environment,|PPO|LSTM-PPO) .*) \|$", page.split("## GPUs")[1], re.MULTILINE) == [
        " | ".join([name, *cells]).rstrip() for name, cells in rows.items()
    ]
    for sentence in (
        f"Compiled steps of SU and CO reach {su / copied:.2f} and {co / copied:.2f} of a copy",
        f"PPO learns from {few:.2f} million steps a second and LSTM-PPO from {few_lstm:.2f} million.",
        f"1,024 seeds of the main job would take {minutes:.1f} minutes",
    ):
        assert sentence in " ".join(page.split())
    readme = " ".join((CHECKOUT / "README.md").read_text(encoding="utf-8").split())
    ppo = learned["ppo, captured", 65_536] / 1e6
    said = f"One H100, 65,536 environments: fused steps take {su:.1f} billion a second"
    assert f"{said}, and PPO trains on {ppo:.0f} million" in readme


@pytest.fixture
def two_rungs(gpu, monkeypatch) -> list[str]:
    """Rungs of learning, the last one of seeds as one job, and one of the environment; the names of those measured."""
    measured: list[str] = []
    monkeypatch.setattr(gpu, "SECONDS", 0.001)
    monkeypatch.setattr(gpu, "TESTS", ("-c", "print('FAILED one'); print('1 failed')"))
    names = {gpu.ladder: (gpu.ladder.COPY,), gpu.learning: ("ppo, captured", "lstm_ppo, 1,024 seeds as one job")}
    for module, ways in names.items():
        monkeypatch.setattr(
            module,
            "rungs",
            lambda *what, ways=ways: [ladder.Rung(way, "SU", 2, lambda: lambda: 7, 1e6) for way in ways],
        )
    measure = ladder.measure

    def noted(rung, *how):
        measured.append(rung.name)
        measure(rung, *how)

    monkeypatch.setattr(gpu.ladder, "measure", noted)
    return measured


def test_a_report_of_a_gpu_has_its_parts_the_most_important_first_and_the_time_of_many_seeds(gpu, two_rungs):
    report = dict(gpu.parts(torch.device("cpu"), 18.0, "abc", {}))
    text = gpu.section(json.loads(json.dumps(report)))

    assert two_rungs == ["lstm_ppo, 1,024 seeds as one job", "ppo, captured", gpu.ladder.COPY]
    assert [row["way"] for row in report["learning"]] == ["ppo, captured", "lstm_ppo, 1,024 seeds as one job"]
    assert report["tests"] == {"exit_code": 0, "said": "1 failed", "failed": ["FAILED one"]}
    assert "commit abc." in text and "Tests marked `cuda`: 1 failed." in text
    assert re.search(r"1,024 seeds of the main job as one job: [\d.e+-]+ minutes of learning, computed", text)
    assert gpu.section({name: report[name] for name in ("machine", "commit")}).startswith("Measured on")


def test_a_report_of_a_gpu_goes_on_where_it_stopped_unless_the_commit_is_another(gpu, two_rungs):
    report = json.loads(json.dumps(dict(gpu.parts(torch.device("cpu"), 18.0, "abc", {}))))
    del report["learning"][0], report["environment"]
    kept = report["learning"][0]
    two_rungs.clear()

    again = dict(gpu.parts(torch.device("cpu"), 18.0, "abc", report))
    goes_on = list(two_rungs)
    dict(gpu.parts(torch.device("cpu"), 18.0, "abc", {**report, "commit": "other"}))

    assert goes_on == ["ppo, captured", gpu.ladder.COPY]
    assert again["learning"][1] == kept and again["tests"] == report["tests"]
    assert len(two_rungs) == 2 + 3


def test_no_measurement_of_a_gpu_begins_after_the_time_of_a_call(gpu, two_rungs):
    report = dict(gpu.parts(torch.device("cpu"), 0.0, "abc", {"commit": "abc"}))

    assert two_rungs == [] and report["learning"] == []
    assert report["tests"]["exit_code"] is None
