"""The figure main_job.png, README's first: the tree of CT-SU-B1 beside the performance matrix of the main job."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from ctgraph_rl.draw.style import new_figure, save_figure
from ctgraph_rl.draw.task_figure import draw_task
from ctgraph_rl.report.figures.heatmaps import draw_performance
from ctgraph_rl.report.statistics import Estimate, mean
from ctgraph_rl.tasks.configurations import ct_su_b1
from studies.raw import groups, numbers_in, read


def draw(path: Path) -> None:
    """Draw both parts from the raw results, and write the picture."""
    figure = new_figure(9.0, 4.2)
    tree, matrix = figure.subplots(1, 2, width_ratios=[1, 1])
    draw_task(tree, ct_su_b1())
    tree.set_title("CT-SU-B1: two decisions, one reward", fontsize=10)
    labels, rows = performance()
    draw_performance(matrix, rows, labels, [[number] for number in range(len(labels))])
    matrix.set_title("LSTM-PPO on su_b1_4tasks: mean return on each goal", fontsize=10)
    save_figure(figure, path)


def performance() -> tuple[list[str], list[list[Estimate]]]:
    """Return the labels of the tasks, and for each block the mean over seeds on each task, without intervals."""
    rows: dict[str, dict[str, Estimate]] = {}
    for (block, label), lines in groups(read("main_job"), "block", "label").items():
        found = mean(numbers_in(lines, "return_mean"), bounds=(0, 1))
        rows.setdefault(block, {})[label] = dataclasses.replace(found, low=None, high=None)
    return list(rows["0"]), [list(row.values()) for row in rows.values()]
