"""Heat maps of how similar the tasks of a curriculum are."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ctgraph_rl.draw.style import new_figure, save_figure
from ctgraph_rl.log.escape import figure_text
from ctgraph_rl.tasks.curriculum import Curriculum, Stream
from ctgraph_rl.tasks.similarity import MEASURES
from ctgraph_rl.tasks.task import ct_graphs

MOST_NUMBERS, MOST_LABELS = 8, 40

MOST_STREAMED_TASKS = 32


def draw_similarity(curriculum: Curriculum, path: Path | str) -> None:
    """Draw a heat map of each measure over a curriculum's tasks.

    Args:
        path: the picture; its ending decides the format.

    Raises:
        ModuleNotFoundError: without matplotlib; names the extra to install.
        ValueError: for tasks too large for a measure, or other than CT-graphs.
    """
    if isinstance(curriculum, Stream):
        curriculum = curriculum.first(min(len(curriculum.blocks), MOST_STREAMED_TASKS))
    labels = curriculum.labels
    tasks = ct_graphs(curriculum.tasks, "a figure of how alike tasks are")
    figure = new_figure(12, 7.6)
    figure.suptitle(f"{figure_text(curriculum.name)}: similarity of {len(tasks)} tasks")
    *panels, last = figure.subplots(2, 3).flat
    for axes, (title, measure) in zip(panels, MEASURES.items(), strict=True):
        matrix = measure(tasks).numpy()
        axes.set_facecolor("white")
        axes.patch.set(hatch="////", edgecolor="grey")
        image = axes.imshow(matrix, cmap="Greys", vmin=0, vmax=1)
        axes.set_title(title, fontsize=9)
        for (i, j), value in np.ndenumerate(matrix):
            if len(matrix) <= MOST_NUMBERS and not np.isnan(value):
                ink = "white" if value > 0.6 else "black"
                number = axes.text(j, i, f"{value:.2f}", ha="center", va="center", fontsize=7, color=ink)
                number.set_in_layout(False)  # it is within the panel
        if len(tasks) > MOST_LABELS:
            axes.set(xlabel="task, from 0", ylabel="task, from 0")
            continue
        size = max(4, 8 - len(tasks) // 8)
        columns = labels if axes in panels[2:] else ()
        rows = labels if axes in panels[::3] else ()
        axes.set_xticks(range(len(columns)), columns, rotation=90, fontsize=size)
        axes.set_yticks(range(len(rows)), rows, fontsize=size)
    last.axis("off")
    figure.colorbar(image, ax=last, location="left", shrink=0.8, label="share; hatched: nothing to compare")
    save_figure(figure, path)
