"""Collectives of l2d2c_16x16 by their number of members: the first section of collectives.md, and its figure."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

from ctgraph_rl.draw.style import new_figure, save_figure
from ctgraph_rl.report import statistics
from ctgraph_rl.report.statistics import Estimate
from studies.raw import Raw, groups, mean_of, numbers_in, read, select, shown, table
from studies.two_groups import two_groups

NAME, BLOCKS = "collectives", "collective_blocks"
"""Tables with a line for each collective, and for each member and block."""

NUMBERS = ("1", "4", "16")
"""Members of the collectives."""

FRAMES = "12800"
"""Of a block."""

LONGER = "25600"
"""Frames of a block of the run alone that has twice as many."""

BATCH = 1_280
"""Frames of a batch: the least time."""


def on_l2d2c(num_members: str, frames: str = FRAMES, name: str = NAME) -> Raw:
    """Return the lines of some collectives with one epoch in a table."""
    lines = select(read(name), curriculum="l2d2c_16x16", exchange="l2d2c", frames_of_block=frames)
    return select(lines, num_members=num_members, num_epochs="1")


def solving_times(num_members: str, frames: str = FRAMES) -> list[float]:
    """Return the mean frames until a block's task is solved, for each seed that was evaluated after each batch."""
    blocks = groups(on_l2d2c(num_members, frames, name=BLOCKS), "seed")
    found = []
    for line in select(on_l2d2c(num_members, frames), evaluated_every=str(BATCH)):
        found.append(fmean(float(block["frames_to_solve"] or frames) for block in blocks[line["seed"],]))
    return found


def solved_blocks(num_members: str, frames: str = FRAMES) -> str:
    """Return how many blocks had their tasks solved by their end at the latest."""
    blocks = on_l2d2c(num_members, frames, name=BLOCKS)
    return f"{sum(block['frames_to_solve'] != '' for block in blocks):,} of {len(blocks):,}"


def collectives_table() -> str:
    """Return the table of collectives by their number of members, one epoch."""
    rows = []
    for number, frames in (("1", FRAMES), ("1", LONGER), ("4", FRAMES), ("16", FRAMES)):
        lines = on_l2d2c(number, frames)
        times = solving_times(number, frames)
        bounds = (BATCH, float(frames))
        rows.append(
            [
                number if frames == FRAMES else f"{number}, blocks of {int(frames):,} frames",
                str(len(lines)),
                solved_blocks(number, frames),
                _frames(times, bounds) + (f" (n = {len(times)})" if len(times) < len(lines) else ""),
                _frames(numbers_in(lines, "learning_time"), bounds),
                mean_of(numbers_in(lines, "final_return"), (0, 1)),
                f"{fmean(numbers_in(lines, 'helps')) / int(number):.1f}",
                f"{fmean(numbers_in(lines, 'bytes')) / int(number) / 1e6:.1f}",
            ]
        )
    head = ["members", "seeds", "blocks solved", "frames to solve", "frames to a return of 0.9", "final return"]
    return table([*head, "masks taken over", "MB"], rows)


def _frames(times: Sequence[float], bounds: tuple[float, float]) -> str:
    """Return the mean of numbers of frames with its interval, where two seeds or more have one."""
    found = statistics.mean(times, bounds=bounds)
    if found.low is None:
        return f"{found.value:,.0f}"
    return f"{found.value:,.0f} [{found.low:,.0f}, {found.high:,.0f}]"


def faster(num_members: str) -> Estimate:
    """Return by what factor a task is solved sooner than alone, with its interval."""
    alone, shared = (np.array(solving_times(number))[:, None] for number in ("1", num_members))
    return two_groups(alone, shared, lambda first, second: (first / second)[..., 0], (BATCH, float(FRAMES)))


def by_block(num_members: str) -> list[float]:
    """Return the mean final return of all members and seeds in each block, from the first."""
    of = groups(on_l2d2c(num_members, name=BLOCKS), "block")
    return [fmean(numbers_in(of[number,], "final_return")) for number in sorted((each for (each,) in of), key=int)]


def draw(path: Path) -> None:
    """Draw the frames to learn a block over the number of members, and the final returns block by block."""
    figure = new_figure(7.2, 2.9)
    times, returns = figure.subplots(1, 2)
    numbers = [int(number) for number in NUMBERS]
    solving = [solving_times(number) for number in NUMBERS]
    learning = [numbers_in(on_l2d2c(number), "learning_time") for number in NUMBERS]
    _draw_times(times, "greedy policy solves it", solving, "o", "-")
    _draw_times(times, "a batch has a return of 0.9", learning, "s", "--")
    times.set(xscale="log", ylim=(0, 1.04 * float(FRAMES)), xlabel="members N", ylabel="frames until")
    times.set_xticks(numbers, NUMBERS)
    times.minorticks_off()
    times.legend(fontsize=7, frameon=False, loc="upper right")
    for name, style in zip(NUMBERS, (":", "--", "-"), strict=True):
        values = by_block(name)
        returns.plot(range(1, len(values) + 1), values, style, color="0", lw=1, label=f"N = {name}")
    returns.set(xlabel="block", ylabel="final return", ylim=(-0.03, 1.03))
    returns.legend(fontsize=7, frameon=False, loc="lower right")
    save_figure(figure, path, 220)


def _draw_times(axes: Any, label: str, of_numbers: Sequence[Sequence[float]], mark: str, line: str) -> None:
    """Draw the seeds of collectives of each number of members, and a line through their means."""
    for number, values in zip(NUMBERS, of_numbers, strict=True):
        axes.plot([int(number)] * len(values), values, mark, ms=3, mec="0.35", mfc="none", mew=0.6)
    axes.plot([int(number) for number in NUMBERS], list(map(fmean, of_numbers)), line, color="0", lw=1, label=label)


def texts() -> dict[str, str]:
    """Return what the page's template names; it has the means over seeds, which tests compare with the raw results."""
    alone = fmean(solving_times("1"))
    ratios = {number: faster(number) for number in NUMBERS[1:]}
    found = {f"faster_{number}": shown(ratio) for number, ratio in ratios.items()}
    if all(ratio.low is not None and ratio.low > 1 for ratio in ratios.values()):
        found["verdict"] = "Sharing is sooner"
    else:
        found["verdict"] = "These few seeds do not show that sharing is sooner: the intervals include 1"
    found |= {f"solved_{number}": solved_blocks(number) for number in NUMBERS}
    return found | {"alone": f"{alone:,.0f}", "most": f"{alone / BATCH:.1f}", "l2d2c": collectives_table()}
