"""A figure of what a task's states look like, and how their images vary when they are read."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ctgraph_rl.batch.rows import Rows
from ctgraph_rl.core.graph import StateType
from ctgraph_rl.draw.style import new_figure
from ctgraph_rl.tasks.images import white_level
from ctgraph_rl.tasks.task import Task

MOST_IDS = 3
"""Ids of each kind of state that are shown with their variation."""
COLUMNS = 8
INCHES = 0.72
"""Side of an image with the gap to the next."""
ROW, GAP = 1.22, 0.06


class ImageLine(NamedTuple):
    """Images side by side, uint8 [n, *shape], with a word above each."""

    label: str
    images: Tensor
    words: list[str]


def image_figure(task: Task, seed: int = 0) -> Any:
    """Return a figure of the first images of each kind of state.

    Where images vary on read, by noise, rotation or instances, a line holds the image of one id and seven observations
    of it; else eight ids of a kind.
    """
    x = task.observations
    varies = x.read_noise or x.read_rotation or task.images.num_variants > 1
    lines = []
    if varies:
        shown: list[tuple[StateType, int]] = []
        for kind in StateType:
            shown += product([kind], _first_ids(task, kind, MOST_IDS))
        for (kind, number), images in zip(shown, _reads(task, shown, COLUMNS - 1, seed), strict=True):
            both = torch.cat([_stored(task, [number]), images])
            lines.append(ImageLine(f"{kind.name.lower()} {number}", both, ["image", *["read"] * len(images)]))
    else:
        for kind in StateType:
            ids = _first_ids(task, kind, COLUMNS)
            lines.append(ImageLine(kind.name.lower(), _stored(task, ids), list(map(str, ids))))
    figure = new_figure(INCHES * COLUMNS + 1.0, INCHES * ROW * len(lines) + 0.5)
    axes = figure.subplots()
    for row, line in enumerate(lines):
        _draw_line(axes, row, line, white_level(task.images))
    axes.set(xlim=(-1, COLUMNS), ylim=(-ROW * len(lines), 4 * GAP), aspect="equal")
    axes.axis("off")
    noise = f"noise 0..{x.read_noise}, rotation 0..{x.read_rotation} degrees on read"
    figure.suptitle(f"{task.images.num_images:,} images, {noise if varies else 'nothing varies on read'}", fontsize=9)
    return figure


def _first_ids(task: Task, kind: StateType, most: int) -> list[int]:
    first, last = task.observations.ids(kind)
    return list(range(first, last + 1)[:most])


def _stored(task: Task, ids: list[int]) -> Tensor:
    return task.images.bank(0)[[place * task.images.num_variants for place in ids]]


def _reads(task: Task, shown: list[tuple[StateType, int]], count: int, seed: int) -> Tensor:
    rows: list[Task] = []
    kinds: list[int] = []
    for kind, number in shown:
        name = kind.name.lower()
        changes: dict[str, Any] = {f"{name}_ids": (number, number)}
        if task.observations.is_unique(kind):
            changes[f"unique_{name}s"] = False
        rows += [replace(task, observations=replace(task.observations, **changes))] * count
        kinds += [kind] * count
    batch = Rows(rows, seed)
    batch.reset()
    state = batch.state
    state_type = state.state_type.new_tensor(kinds)
    node = torch.where(state_type == StateType.END, task.graph.num_decision_states, 0)
    batch.state = state._replace(state_type=state_type, node=node)
    return batch.show().observation.unflatten(0, (len(shown), count))


def _draw_line(axes: Any, row: int, line: ImageLine, white: float) -> None:
    from matplotlib.patches import Rectangle

    top = -ROW * row
    axes.text(-GAP, top - 0.5, line.label, fontsize=7, ha="right", va="center")
    for i, (image, word) in enumerate(zip(line.images.numpy(), line.words, strict=True)):
        pixels = image[0] if image.ndim == 3 else image[None]
        place = (i, i + 1 - GAP, top - 1 + GAP, top)
        axes.imshow(pixels, cmap="gray", vmin=0, vmax=white, extent=place, aspect="auto", interpolation="nearest")
        axes.add_patch(Rectangle((i, top - 1 + GAP), 1 - GAP, 1 - GAP, fill=False, linewidth=0.6))
        axes.text(i + 0.5 - GAP / 2, top + GAP / 2, word, fontsize=6, ha="center", va="bottom")
