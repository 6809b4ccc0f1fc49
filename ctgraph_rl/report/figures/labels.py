"""Labels that learners gave to tasks, against the true tasks, over the frames of a run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ctgraph_rl.learn.labels import Span
from ctgraph_rl.log.escape import figure_text, terminal_text
from ctgraph_rl.report.figures.gallery import CaptionedFigure, left_out
from ctgraph_rl.report.sections import Section
from ctgraph_rl.report.style import figure_width, frames_axis, ink, new_figure, short
from ctgraph_rl.runs.read import Run, split_by

MOST_STRIPS = 30

NARROWEST = 0.03
"""Share of the frames from which a part of a strip has a number."""

NOT_LEARNED = 0.35

SEVERAL = (0.85, 0.85, 0.85)
"""Colour of blocks with several tasks, and of labels that acted only there."""


def label_strips(section: Section) -> CaptionedFigure | None:
    """Return the labels of all runs whose learners gave them, if any."""
    runs = _runs(section)
    if not runs:
        return None
    caption = (
        "Labels that learners gave to tasks themselves, over the frames of each run. Top: the true tasks, by number. "
        "Numbers in strips: labels, in the order in which they were opened; colour: the task in most of whose frames "
        "the label acted. Pale: frames that were not learned from, while known labels were tried. Red marks below a "
        f"strip: alarms. Dashed: changes of task.{left_out(len(runs), MOST_STRIPS, 'runs')} In evaluations each task "
        "is played with the label that acted in most of its frames: an oracle only in evaluation, which no learner "
        "sees."
    )
    runs = runs[:MOST_STRIPS]
    figure = new_figure(figure_width(), 0.7 + 0.24 * (len(runs) + 1))
    axes = figure.subplots()
    blocks = list(zip(section.ends, section.ends[1:], section.trained, strict=False))
    for start, end, tasks in blocks:
        text = ",".join(str(task + 1) for task in tasks)
        _part(axes, 0, (start, end), text, colour=_colour(tasks[0] if len(tasks) == 1 else None), room=section.ends[-1])
    for row, (_, run) in enumerate(runs, 1):
        assert run.history is not None
        draw_strip(axes, row, run.history.spans, blocks, room=section.ends[-1])
    for start, _, tasks in blocks[1:]:
        if tasks != next(before for _, end, before in blocks if end == start):
            axes.axvline(start, color="black", linestyle=(0, (3, 2)), linewidth=0.6)
    names = ["true task", *(figure_text(name) for name, _ in runs)]
    axes.set(xlim=(0, max(section.ends[-1], 1)), ylim=(len(runs) + 0.6, -0.6), xlabel="frames")
    axes.set_yticks(range(len(names)), names)
    axes.tick_params(axis="y", length=0)
    frames_axis(axes)
    return CaptionedFigure("labels", "Labels and true tasks", caption, figure)


def draw_strip(axes: Any, row: int, spans: Sequence[Span], blocks: Sequence[Any], room: float) -> None:
    """Draw the labels of a run.

    Args:
        row: the strip's place.
        spans: in time order.
        blocks: first frame, frame after the last one, and trained tasks.
        room: frames of the whole strip.
    """
    of_label = {}
    for label, own in split_by(spans, lambda span: span.label).items():
        frames: dict[int, float] = {}
        for start, end, tasks in blocks:
            if len(tasks) == 1:
                shared = sum(max(0, min(end, span.end) - max(start, span.start)) for span in own)
                frames[tasks[0]] = frames.get(tasks[0], 0) + shared
        if any(frames.values()):
            of_label[label] = max(frames, key=lambda task: frames[task])  # in most of whose frames it acted
    for span in spans:
        colour = _colour(of_label.get(span.label))
        opacity = 1.0 if span.learned else NOT_LEARNED
        _part(axes, row, (span.start, span.end), str(span.label), colour=colour, room=room, opacity=opacity)
        if span.alarm:
            place = [span.end, span.end]
            axes.plot(place, [row + 0.3, row + 0.48], color="tab:red", linestyle="-", marker="", linewidth=1.2)


def _runs(section: Section) -> list[tuple[str, Run]]:
    found = []
    for result in section.results:
        for run in result.finished:
            if run.history and run.history.spans:
                found.append((f"{short(terminal_text(result.agent))}, seed {run.seed}", run))
    return found


def _part(
    axes: Any, row: int, place: tuple[float, float], text: str, colour: Any, room: float, opacity: float = 1.0
) -> None:
    start, end = place
    axes.barh(row, end - start, 0.6, left=start, color=colour, alpha=opacity, linewidth=0)
    if end - start >= NARROWEST * room:
        shown = [opacity * part + 1 - opacity for part in colour]
        axes.text((start + end) / 2, row, text, ha="center", va="center", fontsize=6, color=ink(shown))


def _colour(task: int | None) -> tuple[float, float, float]:
    from matplotlib import colormaps

    shades = 8
    if task is None:
        return SEVERAL
    red, green, blue, _ = colormaps["viridis"]((task % shades * 3 % shades + 0.5) / shades)
    return red, green, blue
