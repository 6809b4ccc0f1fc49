"""docs/results/lifelong.md: made from raw results, whose numbers are those of a calculation by hand."""

from __future__ import annotations

import json
import sys

import pytest
import torch
from helpers.paths import CHECKOUT

from ctgraph_rl import metrics

FOLDER = CHECKOUT / "docs" / "results"


@pytest.fixture(scope="module")
def make():
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.syspath_prepend(str(FOLDER))
        yield __import__("make")
        for name in ("make", "comparison", "raw"):
            del sys.modules[name]


@pytest.fixture
def comparison(make):
    return sys.modules["comparison"]


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
    transfer = comparison.forward_transfer(own[1:], alone[1:]), comparison.gain(own, alone)
    found = {**comparison.scores(run), **dict(zip(("forward transfer", "gain over experts"), transfer, strict=True))}

    assert comparison.full([experts]) == [1]
    assert found == pytest.approx(
        {
            "average performance": 0.5,
            "forgetting": 0.5,  # task 1 falls from 1 to 0, task 2 stays: over both tasks
            "TPOT": 0.5 + 1.25 + 1.0 + 1.0,
            "tasks learned": 2,
            "known at the end": 1,
            "gain over experts": ((0.75 - 1) + (0.75 - 0.25)) / 2,
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
    assert comparison.transfer(own, alone, [])["forward transfer"].startswith(f"{expected:.2f} ")


def test_what_was_not_run_is_named_by_method_and_seed(comparison, monkeypatch):
    monkeypatch.setattr(comparison, "expected", lambda name: {"method": ["a", "b"], "seed": ["0", "1", "2"]})
    monkeypatch.setattr(comparison, "read", lambda name: [{"method": "a", "seed": "1"}, {"method": "b", "seed": "2"}])

    assert comparison.missing("x") == "Not run yet: 4 of 6 cells, a (seeds 0, 2); b (seeds 0, 1)."


def test_further_seeds_of_an_agent_are_cells_of_its_experiment(comparison, monkeypatch):
    monkeypatch.setattr(comparison, "expected", lambda name: {"agent": ["a", "b"], "seed": ["0"]})
    monkeypatch.setattr(comparison, "MORE_SEEDS", {"x": {"b": 3}})
    monkeypatch.setattr(comparison, "read", lambda name: [{"agent": "a", "seed": "0"}, {"agent": "b", "seed": "1"}])

    assert comparison.missing("x") == "Not run yet: 2 of 4 cells, b (seeds 0, 2)."


def write_run(folder, num_frames, fingerprint="f"):
    folder.mkdir(parents=True)
    (folder / "metrics.json").write_text("{}")
    kinds = [
        {"kind": "run", "schema": 1, "curriculum": "ct8", "fingerprint": fingerprint, "config": {"seed": 3}},
        {"kind": "evaluation", "block": 1, "frames": num_frames, "task": 1, "return_mean": 0.5},
    ]
    (folder / "run.jsonl").write_text("".join(json.dumps({"n": 0, **line}) + "\n" for line in kinds))


def test_two_runs_that_cannot_be_told_apart_are_refused_and_nothing_is_written(comparison, monkeypatch, tmp_path):
    written = []
    monkeypatch.setattr(comparison, "read", lambda name: [])
    monkeypatch.setattr(comparison, "write", lambda name, lines: written.append(lines))
    write_run(tmp_path / "ct8" / "ppo-ewc-seed3-aaaa", 512)
    comparison.collect("masks_ct8", tmp_path)
    write_run(tmp_path / "ct8" / "ppo-ewc-seed3-bbbb", 1024)

    with pytest.raises(ValueError, match="two runs of ct8 ppo ewc 3"):
        comparison.collect("masks_ct8", tmp_path)

    assert [[line["frames"] for line in each] for each in written] == [["512"]]


def test_two_sets_of_experts_of_a_seed_are_refused(comparison, monkeypatch, tmp_path):
    monkeypatch.setattr(comparison, "read", lambda name: [])
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
        comparison.collect("masks_ct8", tmp_path)


def test_a_run_of_another_curriculum_does_not_take_the_place_of_raw_results(comparison, monkeypatch, tmp_path):
    there = {"curriculum": "ct8", "agent": "ppo", "method": "finetune", "seed": "3", "fingerprint": "other"}
    monkeypatch.setattr(comparison, "read", lambda name: [there])
    write_run(tmp_path / "ct8" / "ppo-seed3-aaaa", 512)

    with pytest.raises(ValueError, match=r"learned another curriculum than masks_ct8\.csv has of ct8 ppo finetune 3"):
        comparison.collect("masks_ct8", tmp_path)


def test_runs_of_another_experiment_are_refused(comparison, monkeypatch, tmp_path):
    written = []
    monkeypatch.setattr(comparison, "write", lambda name, lines: written.append(lines))
    write_run(tmp_path / "ct8" / "ppo-seed3-aaaa", 512)

    with pytest.raises(ValueError, match="learned ct8, and masks_ct12 is of ct12"):
        comparison.collect("masks_ct12", tmp_path)
    with pytest.raises(ValueError, match="and methods is of fo_b1_4tasks, fo_b1_4images, fo_b1_depth2to5"):
        comparison.collect("methods", tmp_path)

    assert written == []


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
