"""Learners that share: collectives.md and its figure, made of the raw results of `studies.collectives.runs`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from string import Template
from typing import Any

from ctgraph_rl.report import statistics
from ctgraph_rl.report.statistics import Estimate
from studies.collectives import mosaic, selecting
from studies.collectives.l2d2c import BLOCKS, CELL, FRAMES, KEY, NAME, new_and_known, on_l2d2c
from studies.raw import HERE, TEMPLATES, Raw, groups, machines, mean_of, numbers_in, read, shown, table
from studies.two_groups import two_groups

LONGER = "25600"
"""Frames of a block of the run alone that has twice as many."""

NUMBERS = ("1", "4", "16")
"""Members of the collectives of l2d2c_16x16."""

WANTED = [("1", FRAMES), ("1", LONGER), ("4", FRAMES), ("16", FRAMES)]
"""Members and frames of a block of the rows of its table."""

BATCH = 1_280
"""Frames of a batch: the least time."""

DPI = 220


def solving_times(num_members: str, frames: str = FRAMES, num_epochs: str = "1") -> list[float]:
    """Return the mean frames until a block's task is solved, for each seed that was evaluated after each batch."""
    lines = [line for line in on_l2d2c(num_members, frames, num_epochs) if int(line["evaluated_every"]) == BATCH]
    of = groups(read(BLOCKS), *KEY)
    blocks = [of[tuple(line[key] for key in KEY)] for line in lines]
    return [sum(float(block["frames_to_solve"] or frames) for block in each) / len(each) for each in blocks]


def solved_blocks(num_members: str, frames: str = FRAMES, num_epochs: str = "1") -> tuple[int, int]:
    """Return how many blocks had their tasks solved by their end at the latest, and how many there are."""
    cell = ("l2d2c_16x16", frames, "l2d2c", num_members, num_epochs)
    blocks = groups(read(BLOCKS), *CELL).get(cell, [])
    return sum(block["frames_to_solve"] != "" for block in blocks), len(blocks)


def l2d2c_table() -> str:
    """Return the table of collectives of L2D2-C by their number of members, one epoch."""
    head = ["members", "seeds", "blocks solved", "frames to solve", "frames to a return of 0.9", "final return"]
    rows = []
    for number, frames in WANTED:
        lines = on_l2d2c(number, frames)
        name = number if frames == FRAMES else f"{number}, blocks of {int(frames):,} frames"
        rows.append([name, str(len(lines)), *_row(number, frames), *_sharing(lines, int(number))])
    return table([*head, "masks taken over", "MB"], rows)


def _row(*cell: str) -> list[str]:
    solved, count = solved_blocks(*cell)
    lines, times, bounds = on_l2d2c(*cell), solving_times(*cell), (BATCH, float(cell[1]))
    return [
        f"{solved:,} of {count:,}",
        _frames(times, bounds) + (f" (n = {len(times)})" if 0 < len(times) < len(lines) else ""),
        _frames(numbers_in(lines, "learning_time"), bounds),
        mean_of(numbers_in(lines, "final_return"), (0, 1)),
    ]


def _sharing(lines: Raw, number: int) -> list[str]:
    """Return what a member took over and sent in a run."""
    return [
        f"{sum(numbers_in(lines, key)) / len(lines) / number / unit:.1f}"
        for key, unit in (("helps", 1), ("bytes", 1e6))
    ]


def _frames(times: Sequence[float], bounds: tuple[float, float]) -> str:
    """Return the mean of numbers of frames with its interval, where two seeds or more have one."""
    found = statistics.mean(times, bounds=bounds)
    if found.value is None or found.low is None or found.high is None:
        return "not measured" if found.value is None else f"{found.value:,.0f}"
    return f"{found.value:,.0f} [{found.low:,.0f}, {found.high:,.0f}]"


def faster(num_members: str) -> Estimate:
    """Return by what factor a task is solved sooner than alone, with its interval."""
    import numpy as np

    alone, shared = (np.array(solving_times(number))[:, None] for number in ("1", num_members))
    return two_groups(alone, shared, _ratio, (BATCH, float(FRAMES)))


def _ratio(first: Any, second: Any) -> Any:
    return (first / second)[..., 0]


def by_block(num_members: str, num_epochs: str = "1") -> list[float]:
    """Return the mean final return of all members and seeds in each block, from the first."""
    of: dict[int, list[float]] = {}
    for line in read(BLOCKS):
        if tuple(line[key] for key in CELL) == ("l2d2c_16x16", FRAMES, "l2d2c", num_members, num_epochs):
            of.setdefault(int(line["block"]), []).append(float(line["final_return"] or 0))
    return [sum(values) / len(values) for _, values in sorted(of.items())]


def _learning_times(num_members: str) -> list[float]:
    return numbers_in(on_l2d2c(num_members), "learning_time")


def draw(path: Path) -> None:
    """Draw the frames to learn a block over the number of members, and the final returns block by block."""
    from ctgraph_rl.draw.style import new_figure, save_figure

    figure = new_figure(7.2, 2.9)
    times, returns = figure.subplots(1, 2)
    kinds = {"greedy policy solves it": solving_times, "a batch has a return of 0.9": _learning_times}
    for (label, of), style in zip(kinds.items(), ("o-", "s--"), strict=True):
        found = {int(number): values for number in NUMBERS if (values := of(number))}
        for number, values in found.items():
            times.plot([number] * len(values), values, style[0], ms=3, mec="0.35", mfc="none", mew=0.6)
        means = [sum(values) / len(values) for values in found.values()]
        times.plot(list(found), means, style[1:], color="0", lw=1, label=label)
    times.set(xscale="log", ylim=(0, 1.04 * float(FRAMES)), xlabel="members N", ylabel="frames until")
    times.set_xticks([int(number) for number in NUMBERS], NUMBERS)
    times.minorticks_off()
    times.legend(fontsize=7, frameon=False, loc="upper right")
    for name, style in zip(NUMBERS, (":", "--", "-"), strict=True):
        if values := by_block(name):
            returns.plot(range(1, len(values) + 1), values, style, color="0", lw=1, label=f"N = {name}")
    returns.set(xlabel="block", ylabel="final return", ylim=(-0.03, 1.03))
    returns.legend(fontsize=7, frameon=False, loc="lower right")
    save_figure(figure, path, DPI)


def page() -> str:
    """Return the page: the template with its tables and numbers."""
    template = Template((TEMPLATES / "collectives.md").read_text(encoding="utf-8"))
    alone = solving_times("1")
    mean = sum(alone) / len(alone)
    same = "These few seeds do not show that sharing is sooner: the intervals include 1"
    ratios = {number: faster(number) for number in NUMBERS[1:]}
    sooner = all(ratio.low is not None and ratio.low > 1 for ratio in ratios.values())
    texts = {f"faster_{number}": shown(ratio) for number, ratio in ratios.items()}
    texts |= {"verdict": "Sharing is sooner" if sooner else same}
    texts |= {"alone": f"{mean:,.0f}", "most": f"{mean / BATCH:.1f}"} | _of_numbers("1", "") | _of_numbers("8", "_8")
    texts |= known_and_new("4") | known_and_new("16")
    longer = numbers_in(on_l2d2c("1", LONGER), "learning_time")
    texts["learning_longer"] = f"{sum(longer) / len(longer):,.0f}"
    first, *_, last = by_block("16", "8")[1:]
    texts |= {"second": f"{first:.2f}", "last": f"{last:.2f}"}
    texts |= mosaic.texts() | selecting.texts()
    made = template.substitute(l2d2c=l2d2c_table(), machines=machines(NAME, selecting.NAME), **texts)
    return made


def known_and_new(num_members: str) -> dict[str, str]:
    """Return what the page says of blocks whose task a member had in an earlier block, and of the others."""
    texts = {}
    for name, those in zip(("new", "known"), new_and_known(num_members), strict=True):
        learned = sum(each["frames_to_learn"] != "" for each in those)
        texts[f"{name}_return_{num_members}"] = f"{sum(numbers_in(those, 'final_return')) / len(those):.2f}"
        texts[f"{name}_learned_{num_members}"] = f"{learned} of {len(those)} blocks"
    return texts


def _of_numbers(num_epochs: str, suffix: str) -> dict[str, str]:
    """Return what the text says of collectives of each number of members that were run."""
    texts: dict[str, str] = {}
    for number in NUMBERS:
        lines = on_l2d2c(number, num_epochs=num_epochs)
        solved, count = solved_blocks(number, num_epochs=num_epochs)
        values = {"n": str(len(lines)), "blocks": f"{count:,}", "solved": f"{solved:,} of {count:,}"}
        for name, column, form in (
            ("return", "final_return", ".2f"),
            ("learned", "share_learned", ".0%"),
            ("learning", "learning_time", ",.0f"),
            ("reported", "reported_return", ".2f"),
            ("obtained", "obtained_return", ".2f"),
        ):
            if lines and lines[0][column]:
                column_of = numbers_in(lines, column)
                values[name] = format(sum(column_of) / len(column_of), form).replace("%", " %")
        texts |= {f"{name}_{number}{suffix}": value for name, value in values.items()}
    return texts


def make() -> None:
    """Write the page and its figure."""
    (HERE / "collectives.md").write_text(page(), encoding="utf-8")
    draw(HERE / "collectives.png")
