"""What a batch holds: one copy of images, and as much for a row of a deep tree as of a shallow one."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch
from helpers.oracles import fully_observable, surjective
from helpers.scripted import PEAK

from ctgraph_rl import CTGraph, Observations, PaperImages, Rows, Task

MEASURE = f"""
import torch
from ctgraph_rl import Rows
from ctgraph_rl.tasks.configurations import ct_co_b1
{PEAK}
task, before = ct_co_b1(), peak()
rows = Rows([task] * 250_000)
observation, done = rows.restart(), None
for _ in range(3):
    observation, done = rows.act(torch.zeros(250_000, dtype=torch.int64))
    observation = rows.restart(done)
print(peak() - before - 2 * observation.numel())
"""


def bytes_of(rows: Rows) -> int:
    """All tensors of a batch but its images."""
    held = [*rows.state, *rows.params.tree, *rows.params.x, *rows.params.g, rows.params.row, rows.params.seed]
    return sum(tensor.nbytes for tensor in held if isinstance(tensor, torch.Tensor))


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.slow
def test_a_quarter_of_a_million_rows_of_ct_co_b1_take_less_than_256_mebibytes_beyond_two_observations_each():
    found = subprocess.run([sys.executable, "-c", MEASURE], capture_output=True, text=True, check=True)

    assert 0 < int(found.stdout) < 2**28


@pytest.mark.slow
def test_all_rows_share_one_copy_of_the_images_of_every_state_of_a_large_tree():
    graph = CTGraph(3, 9)
    waits, decisions = graph.num_wait_states, graph.num_decision_states
    x = Observations(
        wait_ids=(2, 1 + waits),
        decision_ids=(2 + waits, 1 + waits + decisions),
        end_ids=(2 + waits + decisions, graph.num_states - 1),
        unique_waits=True,
        unique_decisions=True,
    )
    task = Task(graph, (1,) * 9, x, PaperImages(graph.num_states))

    rows = Rows([task] * 1000)

    assert graph.num_states == 59_050
    assert rows.bank.shape == (59_050, 1, 12, 12)
    assert bytes_of(rows) == bytes_of(Rows([fully_observable(3, 2)] * 1000))


def test_equal_image_sets_are_held_once():
    tasks = [surjective(goal=(1, 1)), surjective(goal=(2, 2)), surjective(3, 4), surjective(image_seed=2)]

    assert len(Rows(tasks).bank) == 2 * 5


def test_a_row_of_a_deep_tree_takes_no_more_than_one_of_a_shallow_tree():
    assert bytes_of(Rows([surjective(2, 30)] * 100)) == bytes_of(Rows([surjective(2, 2)] * 100))


def test_a_row_takes_less_than_half_a_kilobyte():
    assert bytes_of(Rows([surjective()] * 100)) < 100 * 512
