"""The figures of no_labels.md."""

from __future__ import annotations

from pathlib import Path

from ctgraph_rl.draw.style import new_figure, save_figure
from ctgraph_rl.learn.labels import Span
from ctgraph_rl.report.figures.labels import draw_strip
from studies.figures import draw_seeds
from studies.no_labels.learners import IMAGES, LEARNERS, MASKS, SEEDS, SPANS, finished
from studies.raw import numbers_in, read

STAY = 384_000
"""Frames of each of eight blocks with four tasks, of the figure of strips."""


def draw_strips(path: Path) -> None:
    """Draw the labels of all runs with detectors on four goals that come twice, and what they can do at the end."""
    of = {name: lines for name, lines in finished()[MASKS, str(STAY)].items() if lines[0]["detector"]}
    runs = [line for lines in of.values() for line in lines]
    blocks = [(STAY * block, STAY * (block + 1), (block % 4,)) for block in range(8)]
    figure = new_figure(7.2, 0.9 + 0.17 * (len(runs) + 1))
    axes, side = figure.subplots(1, 2, width_ratios=(5, 1), sharey=True)
    tasks = [Span(start, end, task + 1, learned=True, alarm=False) for start, end, (task,) in blocks]
    draw_strip(axes, 0, tasks, blocks, room=8 * STAY)
    for row, line in enumerate(runs, 1):
        draw_strip(axes, row, spans_of(line), blocks, room=8 * STAY)
    side.barh(range(1, len(runs) + 1), numbers_in(runs, "average_performance"), 0.7, color="0.35")
    for start, _, _ in blocks[1:]:
        axes.axvline(start, color="0", linewidth=0.6, linestyle=(0, (3, 2)))
    firsts = range(1, len(runs), SEEDS)
    names = ["true task", *(LEARNERS[name] for name in of)]
    axes.set_yticks([0, *(row + (SEEDS - 1) / 2 for row in firsts)], names, fontsize=7)
    for row in firsts:
        axes.axhline(row - 0.5, color="0", linewidth=0.5)
        side.axhline(row - 0.5, color="0", linewidth=0.5)
    axes.set(xlim=(0, 8 * STAY), ylim=(len(runs) + 0.5, -0.5))
    changes = range(0, 9 * STAY, 2 * STAY)
    axes.set_xticks(changes, [f"{frames / 1e6:.2f}" for frames in changes])
    axes.set_xlabel("million frames; each strip is a seed", fontsize=7)
    side.set(xlim=(0, 1))
    side.set_xticks([0, 0.5, 1], ["0", "0.5", "1"])
    side.set_xlabel("average\nperformance", fontsize=7)
    for panel in (axes, side):
        panel.tick_params(axis="both", length=0, labelsize=7)
    save_figure(figure, path)


def spans_of(line: dict[str, str]) -> list[Span]:
    """Return the labels of a run."""
    own = {key: line[key] for key in ("curriculum", "stay", "detector", "num_fresh", "seed")}
    spans = []
    for span in read(SPANS):
        if own.items() <= span.items():
            start, end, label = (int(span[key]) for key in ("start", "end", "label"))
            spans.append(Span(start, end, label, span["learned"] == "True", span["alarm"] == "True"))
    return spans


def draw_images(path: Path) -> None:
    """Draw the average performance of every seed on the image sets of each configuration."""
    figure = new_figure(7.2, 2.3)
    for axes, name in zip(figure.subplots(1, len(IMAGES), sharey=True), IMAGES, strict=True):
        of = finished()[name, "204800"]
        draw_seeds(axes, {LEARNERS[each]: numbers_in(lines, "average_performance") for each, lines in of.items()})
        axes.set_title(name, fontsize=8)
        axes.set_xlabel("average performance", fontsize=7)
    save_figure(figure, path)
