"""The figures of no_labels.md."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from studies.no_labels.learners import IMAGES, LEARNERS, MASKS, PLANNED, SEEDS, SPANS, finished, values
from studies.raw import Raw, groups, read

COLOURS = ("#3b528b", "#5ec962", "#21918c", "#fde725")
"""Of the tasks, in the order in which they come; they also differ in grey."""

NOT_LEARNED = 0.35
"""Opacity of frames that were not learned from."""


def draw_strips(path: Path) -> None:
    """Draw the labels of all runs with detectors on four goals that come twice, and what they can do at the end."""
    from ctgraph_rl.draw.style import new_figure, save_figure

    stay, of = 384_000, finished()[MASKS, "384000"]
    shown = [(name, line) for name, lines in of.items() if lines[0]["detector"] for line in lines]
    spans = groups(read(SPANS), "curriculum", "stay", "detector", "num_fresh", "seed")
    figure = new_figure(7.2, 0.9 + 0.17 * (len(shown) + 1))
    axes, side = figure.subplots(1, 2, width_ratios=(5, 1), sharey=True)
    _draw_tasks(axes, stay)
    for place, (_, line) in enumerate(shown, 1):
        own = spans[MASKS, "384000", line["detector"], line["num_fresh"], line["seed"]]
        of_label = {label: _task(own, label, stay) for label in {span["label"] for span in own}}
        for span in own:
            _strip(axes, place, span, COLOURS[of_label[span["label"]]])
        value = float(line["average_performance"])
        side.barh(place, value, 0.7, color="0.35")
    _name_learners(axes, side, [name for name, _ in shown])
    axes.set(xlim=(0, 8 * stay), ylim=(len(shown) + 0.5, -0.5))
    changes = range(0, 9 * stay, 2 * stay)
    axes.set_xticks(changes, [f"{frames / 1e6:.2f}" for frames in changes])
    axes.tick_params(axis="both", length=0, labelsize=7)
    axes.set_xlabel("million frames; each strip is a seed", fontsize=7)
    _share_axis(side)
    save_figure(figure, path)


def _name_learners(axes: Any, side: Any, shown: list[str]) -> None:
    """Write the name of each learner beside its strips, and a line above them."""
    firsts = {name: place for place, name in reversed(list(enumerate(shown, 1)))}
    names = {place: LEARNERS[name] for name, place in firsts.items()}
    axes.set_yticks([0, *(place + SEEDS / 2 - 0.5 for place in names)], ["true task", *names.values()], fontsize=7)
    for place in names:
        axes.axhline(place - 0.5, color="0", linewidth=0.5)
        side.axhline(place - 0.5, color="0", linewidth=0.5)


def _draw_tasks(axes: Any, stay: int) -> None:
    """Draw the true tasks and their changes."""
    for block in range(8):
        colour = COLOURS[block % 4]
        axes.barh(0, stay, 0.8, left=block * stay, color=colour, linewidth=0)
        axes.text((block + 0.5) * stay, 0, str(block % 4 + 1), **_text(colour))
        axes.axvline(block * stay, color="0", linewidth=0.6, linestyle=(0, (3, 2)))


def _share_axis(side: Any) -> None:
    """Give bars of performances an axis from 0 to 1."""
    side.set(xlim=(0, 1))
    side.set_xticks([0, 0.5, 1], ["0", "0.5", "1"])
    side.tick_params(axis="both", length=0, labelsize=7)
    side.set_xlabel("average\nperformance", fontsize=7)


def _text(background: str) -> dict[str, Any]:
    """Return the look of a number on a colour."""
    light = sum(int(background[place : place + 2], 16) for place in (1, 3, 5)) > 380
    return {"ha": "center", "va": "center", "fontsize": 6, "color": "0" if light else "1"}


def _task(own: Raw, label: str, stay: int) -> int:
    """Return the task, 0 to 3, in most of whose frames a label learned, or acted if it never learned."""
    frames = [0.0] * 4
    for span in own:
        if span["label"] == label:
            weight = 1.0 if span["learned"] == "True" else 1e-6
            for block in range(8):
                shared = min(int(span["end"]), (block + 1) * stay) - max(int(span["start"]), block * stay)
                frames[block % 4] += weight * max(shared, 0)
    return frames.index(max(frames))


def _strip(axes: Any, place: int, span: dict[str, str], colour: str) -> None:
    """Draw a span of a label, with its number if it is wide enough, and its alarm."""
    start, end = int(span["start"]), int(span["end"])
    learned = span["learned"] == "True"
    axes.barh(place, end - start, 0.8, left=start, color=colour, alpha=1 if learned else NOT_LEARNED, linewidth=0)
    if end - start >= 100_000:
        axes.text((start + end) / 2, place, span["label"], **_text(colour))
    if span["alarm"] == "True":
        axes.plot([end, end], [place - 0.45, place + 0.45], color="tab:red", linewidth=1)


def draw_images(path: Path) -> None:
    """Draw the average performance of every seed on the image sets of each configuration."""
    from ctgraph_rl.draw.style import new_figure, save_figure

    of = {name: finished().get((name, "204800"), {}) for name in IMAGES}
    names = [name for name in PLANNED[IMAGES[0], "204800"] if any(name in each for each in of.values())]
    figure = new_figure(7.2, 0.8 + 0.3 * len(names))
    panels = figure.subplots(1, len(of), sharey=True)
    for axes, (curriculum, each) in zip(panels, of.items(), strict=True):
        for place, name in enumerate(names):
            found = values(each.get(name, []), "average_performance")
            shifts = [place + 0.3 * (seed / (SEEDS - 1) - 0.5) for seed in range(len(found))]
            axes.plot(found, shifts, "o", color="0", markersize=3, alpha=0.6)
            if found:
                axes.plot(sum(found) / len(found), place, "|", color="tab:red", markersize=9, markeredgewidth=1.8)
        axes.set_title(curriculum, fontsize=8)
        axes.set(xlim=(-0.05, 1.05))
        axes.set_xticks([0, 0.5, 1], ["0", "0.5", "1"])
        axes.tick_params(labelsize=7)
        axes.set_xlabel("average performance", fontsize=7)
    panels[0].set_yticks(range(len(names)), [LEARNERS[name] for name in names], fontsize=7)
    panels[0].set(ylim=(len(names) - 0.5, -0.5))
    save_figure(figure, path)
