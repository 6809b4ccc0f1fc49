"""What short runs reached on a curriculum, as one line and one figure: docs/results/every_curriculum.csv."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from statistics import fmean

from results_of import PAGE
from studies.raw import Raw, groups, mean_of, numbers_in, read, select

from ctgraph_rl import Curriculum
from ctgraph_rl.draw.style import new_figure, save_figure
from ctgraph_rl.report.bounds_of_runs import bounds_of_curriculum
from ctgraph_rl.report.intervals import Bounds
from ctgraph_rl.report.style import agent_style, frames_axis, style

NAME = "every_curriculum"

METHODS = {"finetune": "fine-tuning", "mask_ri": "Mask RI", "ewc": "EWC", "multitask": "multitask"}
"""Methods in the order of lines and figures, in words."""

WIDTHS = dict(zip(METHODS, (3.6, 2.6, 1.8, 1.0), strict=True))
"""Widths of their lines: those below show where lines coincide."""

IDS = {"": "", "at_boundaries": ", with task ids"}
"""What is said of runs with another ``protocol.task_id`` than their curriculum has."""

STUDIES = {
    "baselines": ("penn_a_swap", "single_task", "su_b1_4tasks", "su_b1_changing_goals"),
    "lifelong": ("ct8", "ct8_md", "ct12", "fo_b1_4images", "fo_b1_4tasks", "fo_b1_depth2to5"),
    "no_labels": (
        *("su_b1_4images", "co_b1_4images", "posr_b1_4images", "dick2020_pair", "swoks_2x4"),
        *("task_free_abrupt", "task_free_gradual", "task_free_recurring"),
    ),
    "claims": ("fo_b1_dissimilar", "stochastic_grouped"),
    "memory": ("co_hard",),
    "adaptation": ("nm_uniform_goals",),
    "collectives": ("ct28", "ct28_mosaic_skips_d5", "l2d2c_16x16"),
    "plasticity": ("goal_conflict", "stream"),
    "streams": ("stream",),
}
"""Curricula by the page of the study that is about them."""


@cache
def lines_of(name: str) -> dict[tuple[str, ...], Raw]:
    """Return the lines of a curriculum's short runs by agent and method, in the order of `METHODS`."""
    found = groups(select(read(NAME), curriculum=name), "agent", "method")
    return dict(sorted(found.items(), key=lambda item: list(METHODS).index(item[0][1])))


def study_of(name: str) -> str:
    """Return a link to the study that is about a curriculum, or nothing."""
    links = [f"[{page.replace('_', ' ')}]({PAGE}/{page}.md)" for page, names in STUDIES.items() if name in names]
    return f"Results are on the page {', '.join(links)}." if links else ""


def sentence_of(curriculum: Curriculum) -> str:
    """Return what short runs of a curriculum reached, in one line, or nothing."""
    of = lines_of(curriculum.name)
    if not of:
        return ""
    (agent, _), first_lines = next(iter(of.items()))
    bounds = bounds_of_curriculum(curriculum).of_returns
    parts = [_reached(method, lines, bounds) for (_, method), lines in of.items()]
    return (
        f"`agent={agent}`, {_frames(curriculum, first_lines[0])}. Mean return over all tasks at the end: "
        f"{'; '.join(parts)}.{_known(first_lines[0])} Raw: `{NAME}.csv`."
    )


def _frames(curriculum: Curriculum, line: dict[str, str]) -> str:
    """Return the frames of a block, and those of the curriculum where a run was shorter."""
    ran, full = int(line["block_frames"]), curriculum.blocks[0].num_frames
    what = "frames a task" if len(curriculum.blocks) > 1 else "frames"
    return f"{ran:,} {what}" if ran == full else f"{ran:,} instead of {full:,} {what}"


def _reached(method: str, lines: Raw, bounds: Bounds) -> str:
    """Return the mean return at the end with its interval, and right after each task's own block."""
    first = lines[0]
    ids = IDS[first["task_id"]]
    seeds = f"{len(lines)} seed{'s' * (len(lines) > 1)}"
    number = mean_of(numbers_in(lines, "end"), bounds)
    if not first["forgetting"]:
        named = "" if method == "finetune" else f" with {METHODS[method]}"
        return f"{number}{named} ({seeds}{ids})"
    own = fmean(numbers_in(lines, "learned"))
    return f"{number} with {METHODS[method]} ({seeds}{ids}; {own:.2f} right after each task)"


def _known(line: dict[str, str]) -> str:
    """Return the optimum and what random actions have, where they are known."""
    if not line["optimum"]:
        return ""
    best = "With a known goal the optimum is" if line["agent"] == "rl2" else "The optimum is"
    return f" {best} {float(line['optimum']):.3g}; random actions have {float(line['random']):.2g}."


@style()
def draw_curves(curriculum: Curriculum, path: Path) -> None:
    """Draw the mean return over all tasks over the frames: the mean of the seeds of each method, and each seed."""
    figure = new_figure(6, 2.2)
    axes = figure.subplots()
    for (_, method), lines in lines_of(curriculum.name).items():
        color = agent_style(list(METHODS).index(method), method)["color"]
        frames = [int(at) for at in lines[0]["at"].split()]
        curves = [list(map(float, line["curve"].split())) for line in lines]
        for curve in curves:
            axes.plot(frames, curve, "-", marker="", color=color, lw=0.5, alpha=0.6)
        mean = [fmean(values) for values in zip(*curves, strict=True)]
        axes.plot(frames, mean, "-", marker="", color=color, lw=WIDTHS[method], label=METHODS[method])
    optimum = next(iter(lines_of(curriculum.name).values()))[0]["optimum"]
    if optimum:
        axes.axhline(float(optimum), color="0.6", lw=0.8, label="optimum")
    axes.set(xlabel="frames", ylabel="mean return")
    frames_axis(axes)
    axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)
    save_figure(figure, path)
