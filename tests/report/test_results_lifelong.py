"""docs/results/lifelong.md: made from raw results, whose numbers are those of a calculation by hand."""

from __future__ import annotations

import json

import pytest
import torch
from helpers.paths import CHECKOUT

from ctgraph_rl import metrics

FOLDER = CHECKOUT / "docs" / "results"


@pytest.fixture(scope="module")
def comparison():
    from studies.lifelong import comparison

    return comparison


def lines(*evaluations):
    """Evaluations of two tasks: block, frames, and the return on each."""
    return [dict(zip(("block", "frames", "1", "2"), map(str, each), strict=True)) for each in evaluations]


@pytest.mark.parametrize(("name", "num_tasks"), [("masks_ct8_md", 8), ("masks_ct8", 8), ("masks_ct12", 12)])
def test_every_cell_of_the_published_comparison_has_one_curriculum_and_all_evaluations(comparison, name, num_tasks):
    cells = comparison.groups(comparison.read(name), "method", "seed")

    methods = {"finetune", "ewc_published", "mask_lc", "mask_blc", "mask_ri", comparison.EXPERT}
    assert set(cells) == {(method, seed) for method in methods for seed in comparison.expected(name)["seed"]}
    assert len({line["fingerprint"] for cell in cells.values() for line in cell}) == 1
    for (method, _), cell in cells.items():
        blocks = 1 if method == comparison.EXPERT else num_tasks
        assert len(cell) == 20 * blocks + 1  # and the one before training


def test_numbers_of_a_run_are_those_by_hand(comparison):
    run = lines((0, 0, 1, 1), (1, 10, 0.5, 0), (1, 20, 1, 0.25), (2, 30, 0.5, 0.5), (2, 40, 0, 1))
    experts = lines((0, 0, 0, 0), (1, 10, 1, 0), (1, 20, 1, 0.5))

    own, alone = comparison.areas([run])[0], comparison.expert_areas([experts])[0]
    found = {**comparison.scores(run), "forward transfer": comparison.forward_transfer(own[1:], alone[1:])}

    assert comparison.full([experts]) == [1]
    assert found == pytest.approx(
        {
            "average performance": 0.5,
            "forgetting": 0.5,  # task 1 falls from 1 to 0, task 2 stays: over both tasks
            "TPOT": 0.5 + 1.25 + 1.0 + 1.0,
            "tasks learned": 2,
            "known at the end": 1,
            "forward transfer": 0.5 / 0.75,  # the first expert leaves nothing to gain
        }
    )


def test_the_mean_forward_transfer_is_continual_worlds(comparison):
    """A ratio of means over seeds, whose experts need not be as many."""
    runs = [lines((1, 10, a, 0), (1, 20, 1, 0), (2, 30, 0, b), (2, 40, 0, 1)) for a, b in ((0.5, 0), (0, 0.25), (1, 1))]
    experts = [lines((1, 10, 0.5, 0.25), (1, 20, 0.75, 1)), lines((1, 10, 0, 0.5), (1, 20, 1, 0))]
    own, alone = comparison.areas(runs), comparison.expert_areas(experts)

    found = comparison.forward_transfer(own.mean(0), alone.mean(0))

    areas = torch.stack([metrics.stage_areas(comparison.curves(run)) for run in runs])
    assert alone.mean(0).tolist() == [(0.625 + 0.5) / 2, (0.625 + 0.25) / 2]
    expected = metrics.continual_world_forward_transfer(areas, torch.from_numpy(alone)).value
    assert found == pytest.approx(expected, abs=1e-12)
    assert comparison.transfer(own, alone, []).startswith(f"{expected:.2f} ")


@pytest.fixture
def experiments():
    from studies.lifelong import experiments

    return experiments


def test_what_was_not_run_is_named_by_method_and_seed(experiments, monkeypatch):
    monkeypatch.setattr(experiments, "expected", lambda name: {"method": ["a", "b"], "seed": ["0", "1", "2"]})
    monkeypatch.setattr(experiments, "read", lambda name: [{"method": "a", "seed": "1"}, {"method": "b", "seed": "2"}])

    assert experiments.missing("x") == "Not run yet: 4 of 6 cells, a (seeds 0, 2); b (seeds 0, 1)."


def test_further_seeds_of_an_agent_are_cells_of_its_experiment(experiments, monkeypatch):
    monkeypatch.setattr(experiments, "expected", lambda name: {"agent": ["a", "b"], "seed": ["0"]})
    monkeypatch.setattr(experiments, "MORE_SEEDS", {"x": {"b": 3}})
    monkeypatch.setattr(experiments, "read", lambda name: [{"agent": "a", "seed": "0"}, {"agent": "b", "seed": "1"}])

    assert experiments.missing("x") == "Not run yet: 2 of 4 cells, b (seeds 0, 2)."


def write_run(folder, num_frames, fingerprint="f"):
    folder.mkdir(parents=True)
    (folder / "metrics.json").write_text("{}")
    kinds = [
        {"kind": "run", "schema": 1, "curriculum": "ct8", "fingerprint": fingerprint, "config": {"seed": 3}},
        {"kind": "evaluation", "block": 1, "frames": num_frames, "task": 1, "return_mean": 0.5},
    ]
    (folder / "run.jsonl").write_text("".join(json.dumps({"n": 0, **line}) + "\n" for line in kinds))


@pytest.fixture
def runs(monkeypatch, tmp_path):
    """The module that collects runs, with tables in a folder of the test."""
    from studies import raw
    from studies.lifelong import runs

    monkeypatch.setattr(raw, "HERE", tmp_path / "stored")
    monkeypatch.setattr(raw, "GROWING", tmp_path / "growing")
    return runs


def frames_in(folder, name="masks_ct8"):
    """The frames of the lines of a table in a folder; None where there is no such table."""
    from studies import raw

    path = folder / f"{name}.csv"
    return [line["frames"] for line in raw.read(name, folder)] if path.exists() else None


def test_two_runs_that_cannot_be_told_apart_are_refused_and_nothing_is_written(runs, tmp_path):
    write_run(tmp_path / "ct8" / "ppo-ewc-seed3-aaaa", 512)
    runs.collect("masks_ct8", [tmp_path])
    write_run(tmp_path / "ct8" / "ppo-ewc-seed3-bbbb", 1024)

    with pytest.raises(ValueError, match="two runs of ct8 ppo ewc 3"):
        runs.collect("masks_ct8", [tmp_path])

    assert frames_in(tmp_path / "growing") == ["512"]


def test_a_table_grows_apart_and_is_stored_once_when_all_its_cells_are_there(
    runs, experiments, monkeypatch, capsys, tmp_path
):
    monkeypatch.setattr(experiments, "expected", lambda name: {"method": ["ewc", "si"], "seed": ["3"]})
    growing, stored = tmp_path / "growing", tmp_path / "stored"
    found = []
    for method, frames in (("ewc", 512), ("si", 1024)):
        folder = tmp_path / method
        write_run(folder / "ct8" / f"ppo-{method}-seed3-aaaa", frames)
        runs.collect("masks_ct8", [folder])
        found.append((frames_in(growing), frames_in(stored)))

    assert found == [(["512"], None), (None, ["512", "1024"])]
    assert capsys.readouterr().out == (
        "To run for masks_ct8.csv, 1 in all: si 3. The stored files stay as they were until then.\n"
    )


def test_cells_that_were_not_run_again_stay_where_runs_are_added(runs, experiments, monkeypatch, tmp_path):
    monkeypatch.setattr(experiments, "expected", lambda name: {"method": ["ewc", "si"], "seed": ["3"]})
    for method, frames in (("ewc", 512), ("si", 1024), ("si", 2048)):
        folder = tmp_path / f"{method}{frames}"
        write_run(folder / "ct8" / f"ppo-{method}-seed3-aaaa", frames)
    runs.collect("masks_ct8", [tmp_path / "ewc512", tmp_path / "si1024"])

    runs.collect("masks_ct8", [tmp_path / "si2048"])
    replaced = frames_in(tmp_path / "stored")
    runs.collect("masks_ct8", [tmp_path / "si2048"], add=True)

    assert replaced == ["512", "1024"]
    assert frames_in(tmp_path / "stored") == ["512", "2048"]


def test_two_sets_of_experts_of_a_seed_are_refused(runs, tmp_path):
    for number, method in enumerate(("ewc", "si")):
        own = tmp_path / "runs" / "experts" / method
        own.mkdir(parents=True)
        evaluated = {"n": 0, "kind": "evaluation", "block": 1, "frames": 512, "task": 1, "return_mean": float(number)}
        about = {"n": 0, "kind": "run", "schema": 1}
        (own / "run.jsonl").write_text(json.dumps(about) + "\n" + json.dumps(evaluated) + "\n")
        write_run(tmp_path / "runs" / "ct8" / f"ppo-{method}-seed3-aaaa", 512)
        with open(tmp_path / "runs" / "ct8" / f"ppo-{method}-seed3-aaaa" / "run.jsonl", "a") as file:
            file.write(json.dumps({"n": 0, "kind": "experts", "experts": [{"task": 1, "run": f"x/{method}"}]}) + "\n")

    with pytest.raises(ValueError, match="two runs of ct8 ppo expert 3"):
        runs.collect("masks_ct8", [tmp_path])


def test_a_run_of_another_curriculum_does_not_take_the_place_of_raw_results(runs, tmp_path):
    from studies import raw

    there = {"curriculum": "ct8", "agent": "ppo", "method": "finetune", "seed": "3", "fingerprint": "other"}
    raw.write("masks_ct8", [there])
    write_run(tmp_path / "ct8" / "ppo-seed3-aaaa", 512)

    with pytest.raises(ValueError, match=r"learned another curriculum than masks_ct8\.csv has of ct8 ppo finetune 3"):
        runs.collect("masks_ct8", [tmp_path], add=True)


def test_runs_of_another_experiment_are_refused(runs, tmp_path):
    write_run(tmp_path / "ct8" / "ppo-seed3-aaaa", 512)

    with pytest.raises(ValueError, match="learned ct8, and masks_ct12 is of ct12"):
        runs.collect("masks_ct12", [tmp_path])
    with pytest.raises(ValueError, match="and methods is of fo_b1_4tasks, fo_b1_4images, fo_b1_depth2to5"):
        runs.collect("methods", [tmp_path])

    assert not (tmp_path / "growing").exists() and not (tmp_path / "stored").exists()


def first_block(lines, *tasks):
    """What was measured on some tasks until the end of the first block."""
    return [[line[task] for task in tasks] for line in lines if int(line["block"]) <= 1]


@pytest.mark.parametrize("name", ["masks_ct8_md", "masks_ct8", "masks_ct12"])
def test_what_learns_the_first_task_alike_has_the_same_raw_results(comparison, name):
    """Masks have nothing to combine yet, and experts are without a method: else code is mixed; on EWC see docs."""
    of = comparison.groups(comparison.read(name), "method", "seed")
    tasks = [key for key in next(iter(of.values()))[0] if key.isdigit()]

    for seed in {seed for _, seed in of}:
        its = {method: lines for (method, other), lines in of.items() if other == seed}
        masks = [first_block(lines, *tasks) for method, lines in its.items() if "mask" in method]
        assert all(each == masks[0] for each in masks)
        assert first_block(its["finetune"], "1") == first_block(its["expert"], "1")
