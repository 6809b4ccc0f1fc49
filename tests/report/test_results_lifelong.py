"""docs/results/lifelong.md: made from raw results, whose numbers are those of a calculation by hand."""

from __future__ import annotations

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
    seeds = range(20 if name == "masks_ct8_md" else 10)
    assert set(cells) == {(method, str(seed)) for method in methods for seed in seeds}
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
