"""Learners that share: raw results, and collectives.md and its figure, which are made of them.

``python docs/results/collectives.py collect RUNS...`` adds the finished collectives under some folders to
collectives.csv, a line each, and to collective_blocks.csv, a line for each member and block. Lines of other collectives
stay as they were. ``python docs/results/collectives.py`` makes the page.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from string import Template
from typing import Any

from raw import HERE, Raw, groups, machine_of, machines, mean_of, read, shown, table, write

NAME, BLOCKS = "collectives", "collective_blocks"
SEEDS = 5

CELL = ("curriculum", "frames_of_block", "exchange", "num_members")
"""The columns that tell the cells of an experiment apart."""

KEY = (*CELL, "seed")

FRAMES, LONGER = "12800", "25600"
"""Frames of a block of l2d2c_16x16, and of the run alone that has twice as many."""

NUMBERS = ("1", "4", "16")
"""Members of the collectives of l2d2c_16x16."""

EXCHANGES = {"isolated": "alone", "mosaic": "MOSAIC", "mosaic_no_similarity": "without similarity"}
"""What members of ct28_mosaic_skips_d5 do, as the page calls it."""

PUBLISHED = {
    "isolated": {2: 0.98, 3: 0.98, 4: 0.34, 5: 0.11, 6: 0.0, 7: 0.0, 8: 0.0},
    "mosaic": {2: 1.00, 3: 0.99, 4: 0.98, 5: 0.95, 6: 0.97, 7: 0.91, 8: 0.74},
}
"""Final returns by depth in the raw data of MOSAIC, means over 28 members and five seeds."""

SOLVED = 0.9
"""The least mean return of greedy episodes in a task that is solved; the optimum is 1."""

BATCH = 1_280
"""Frames of a batch: the least time."""

DPI = 220


def collect(folders: Sequence[Path]) -> None:
    """Add the finished collectives under some folders to the raw results."""
    found = [measured(path) for folder in folders for path in sorted(folder.rglob("collective.jsonl"))]
    new = [pair for pair in found if pair is not None]
    _merge(NAME, [line for line, _ in new], [line for line, _ in new])
    _merge(BLOCKS, [line for line, _ in new], [line for _, lines in new for line in lines])


def _merge(name: str, collectives: Raw, lines: Raw) -> None:
    """Write the lines of some collectives in place of those that a file has of them."""
    present = {_key(line) for line in collectives}
    kept = [line for line in read(name) if _key(line) not in present]
    write(name, sorted([*kept, *lines], key=lambda line: tuple(map(_place, [line[key] for key in KEY]))))


def _key(line: dict[str, str]) -> tuple[str, ...]:
    return tuple(str(line[key]) for key in KEY)


def _place(value: object) -> tuple[int, str]:
    """Order numbers by their value, and texts behind them."""
    text = str(value)
    return (int(text), "") if text.isdigit() else (10**9, text)


def measured(log: Path) -> tuple[dict[str, Any], list[dict[str, Any]]] | None:
    """Return the line of a collective and those of its members' blocks; None if it is not finished."""
    from ctgraph_rl.collective.summary import read_collective
    from ctgraph_rl.log.run_log import RunLog

    if not (log.parent / "metrics.json").exists():
        return None
    collective = read_collective(log.parent)
    metrics = json.loads((log.parent / "metrics.json").read_text(encoding="utf-8"))
    about = RunLog.read(log.parent / "member_000" / "run.jsonl").of_kind("run")[0]
    [frames] = {each.frames for each in collective.learned}
    cell = {
        "curriculum": about["curriculum"],
        "frames_of_block": frames,
        "exchange": _exchange(collective.config["exchange"]),
        "num_members": len({each.member for each in collective.learned}),
        "seed": collective.config["seed"],
    }
    values = {key: metrics[key]["value"] for key in ("learning_time", "share_learned", "messages", "bytes", "helps")}
    solved = {number: _solved(log.parent / f"member_{number:03}") for number in {e.member for e in collective.learned}}
    returns = [each.final_return for each in collective.learned]
    final = {"final_return": math.fsum(0.0 if math.isnan(value) else value for value in returns) / len(returns)}
    blocks = [
        {
            **cell,
            "member": each.member,
            "block": each.block,
            "task": each.label,
            "frames_to_learn": "" if each.frames_to_learn is None else each.frames_to_learn,
            "frames_to_solve": solved[each.member].get(each.block, ""),
            "final_return": "" if math.isnan(each.final_return) else round(each.final_return, 6),
        }
        for each in collective.learned
    ]
    return {**cell, **values, **final, "numbers": about["numbers"], **machine_of(about)}, blocks


def _solved(member: Path) -> dict[int, int]:
    """Return the frames of each block until an evaluation within it found its task solved; nothing where none did."""
    from ctgraph_rl.log.run_log import RunLog

    log, ends, found = RunLog.read(member / "run.jsonl"), {}, {}
    for line in log.of_kind("training"):
        ends[line["block"]] = line["frames"]
    trained = log.of_kind("run")[0]["trained"]
    for line in log.of_kind("evaluation"):
        for block, end in ends.items():
            start = ends.get(block - 1, 0)
            if start < line["frames"] <= end and [line["task"]] == trained[block - 1] and line["return_mean"] >= SOLVED:
                found.setdefault(block, line["frames"] - start)
    return found


def _exchange(config: Mapping[str, Any]) -> str:
    """Return the name of an exchange's file, which the configuration of a run lacks."""
    name = str(config["_target_"]).rpartition(".")[2].lower()
    return name if config.get("use_similarity", True) else f"{name}_no_similarity"


@cache
def cells() -> dict[tuple[str, ...], Raw]:
    """Lines of collectives by the columns of `CELL`."""
    return groups(read(NAME), *CELL)


def on_l2d2c(num_members: str, frames: str = FRAMES) -> Raw:
    """Lines of the collectives of l2d2c_16x16 with as many members."""
    return cells().get(("l2d2c_16x16", frames, "l2d2c", num_members), [])


def numbers_in(lines: Raw, column: str) -> list[float]:
    """A column, one number for each seed."""
    return [float(line[column]) for line in lines]


def l2d2c_table() -> str:
    """Return the table of collectives of L2D2-C by their number of members."""
    head = ["members", "seeds", "frames to learn a block", "blocks learned", "final return", "masks taken over", "MB"]
    rows = []
    for number, frames in (("1", FRAMES), ("1", LONGER), ("4", FRAMES), ("16", FRAMES)):
        lines = on_l2d2c(number, frames)
        if lines:
            name = number if frames == FRAMES else f"{number}, blocks of {int(frames):,} frames"
            rows.append([name, str(len(lines)), *_row(lines, int(number), int(frames))])
    return table(head, rows)


def _row(lines: Raw, number: int, frames: int) -> list[str]:
    per_member = [value / number for value in numbers_in(lines, "helps")]
    sent = [value / number / 1e6 for value in numbers_in(lines, "bytes")]
    times = numbers_in(lines, "learning_time")
    return [
        f"{sum(times) / len(times):,.0f} {_interval(times, (BATCH, frames))}",
        mean_of(numbers_in(lines, "share_learned"), (0, 1)),
        mean_of(numbers_in(lines, "final_return"), (0, 1)),
        f"{sum(per_member) / len(per_member):.1f}",
        f"{sum(sent) / len(sent):.1f}",
    ]


def _interval(values: Sequence[float], bounds: tuple[float, float]) -> str:
    from ctgraph_rl.report import statistics

    found = statistics.mean(values, bounds=bounds)
    return f"[{found.low:,.0f}, {found.high:,.0f}]"


def faster(num_members: str) -> str:
    """Return by what factor a block is learned sooner than alone, in longer blocks, with its interval."""
    import numpy as np

    from ctgraph_rl.report import statistics

    groups_ = [numbers_in(lines, "learning_time") for lines in (on_l2d2c("1", LONGER), on_l2d2c(num_members))]
    if not all(groups_):
        return "-"
    alone, together = (np.array(group)[:, None] for group in groups_)
    return shown(statistics.of_two_groups(alone, together, _ratio, (BATCH, float(LONGER))))


def _ratio(first: Any, second: Any) -> Any:
    return (first / second)[..., 0]


def by_block(num_members: str, frames: str = FRAMES) -> list[float]:
    """Return the mean final return of all members and seeds in each block, from the first."""
    of: dict[int, list[float]] = {}
    for line in read(BLOCKS):
        if (line["frames_of_block"], line["num_members"]) == (frames, num_members) and line["exchange"] == "l2d2c":
            of.setdefault(int(line["block"]), []).append(float(line["final_return"] or 0))
    return [sum(values) / len(values) for _, values in sorted(of.items())]


def draw(path: Path) -> None:
    """Draw the frames to learn a block over the number of members, and the final returns block by block."""
    from ctgraph_rl.visualize.style import new_figure, save_figure

    figure = new_figure(7.2, 2.9)
    times, returns = figure.subplots(1, 2)
    means = {}
    for number in NUMBERS:
        values = numbers_in(on_l2d2c(number, LONGER if number == "1" else FRAMES), "learning_time")
        if values:
            means[int(number)] = sum(values) / len(values)
            times.plot([int(number)] * len(values), values, "o", ms=3, mec="0.35", mfc="none", mew=0.6)
    times.plot(list(means), list(means.values()), "-", color="0", lw=1, label="mean over seeds")
    if 1 in means:
        line = [means[1] / number for number in means]
        times.plot(list(means), line, ":", color="0.5", lw=1, label="alone, divided by N")
    times.set(xscale="log", yscale="log", xlabel="members N", ylabel="frames to learn a block")
    times.set_xticks([int(number) for number in NUMBERS], NUMBERS)
    times.minorticks_off()
    times.set_yticks([1000, 2000, 5000, 10_000, 20_000], ["1,000", "2,000", "5,000", "10,000", "20,000"])
    times.legend(fontsize=7, frameon=False)
    for number, style in zip(NUMBERS, (":", "--", "-"), strict=True):
        values = by_block(number)
        returns.plot(range(1, len(values) + 1), values, style, color="0", lw=1, label=f"N = {number}")
    returns.set(xlabel="block", ylabel="final return", ylim=(-0.03, 1.03))
    returns.legend(fontsize=7, frameon=False, loc="lower right")
    save_figure(figure, path, DPI)


def by_depth(exchange: str) -> dict[int, list[float]]:
    """Return the mean final return of the members whose tasks have a depth, for each depth one number for each seed."""
    of: dict[int, dict[str, list[float]]] = {}
    for line in read(BLOCKS):
        if (line["curriculum"], line["exchange"]) == ("ct28_mosaic_skips_d5", exchange):
            depth = line["task"].count(".") + 1
            of.setdefault(depth, {}).setdefault(line["seed"], []).append(float(line["final_return"] or 0))
    return {
        depth: [sum(values) / len(values) for _, values in sorted(seeds.items())] for depth, seeds in sorted(of.items())
    }


def mosaic_table() -> str:
    """Return the table of final returns by depth, beside the published ones."""
    found = {exchange: by_depth(exchange) for exchange in EXCHANGES}
    head = ["depth"]
    for exchange, name in EXCHANGES.items():
        head += [f"{name}, published"] * (exchange in PUBLISHED) + [name]
    rows = []
    for depth in next(iter(found.values())):
        row = [str(depth)]
        for exchange in EXCHANGES:
            row += [f"{PUBLISHED[exchange][depth]:.2f}"] if exchange in PUBLISHED else []
            values = found[exchange].get(depth)
            row.append("not run" if values is None else mean_of(values, (0, 1)))
        rows.append(row)
    return table(head, rows)


def agreement(exchange: str) -> str:
    """Return at which depths the published mean is inside the interval of the mean over seeds, and where it is not."""
    from ctgraph_rl.report import statistics

    inside, outside = [], []
    for depth, values in by_depth(exchange).items():
        found, published = statistics.mean(values, bounds=(0, 1)), PUBLISHED[exchange][depth]
        if found.low is None or found.high is None:
            return "one seed has no interval"
        (inside if found.low <= published <= found.high else outside).append(str(depth))
    parts = [f"inside at depth {', '.join(inside)}"] * bool(inside) + [f"outside at {', '.join(outside)}"] * bool(
        outside
    )
    return "; ".join(parts)


def not_run() -> str:
    """Return which seeds are missing, or that none is."""
    wanted = [("1", FRAMES), ("1", LONGER), ("4", FRAMES), ("16", FRAMES)]
    missing = {cell: SEEDS - len(on_l2d2c(*cell)) for cell in wanted}
    parts = [f"{count} of {SEEDS} seeds with N = {number}" for (number, _), count in missing.items() if count]
    return f"Not run yet: {'; '.join(parts)}." if parts else "All seeds that were planned are here."


def page() -> str:
    """Return the page: the template with its tables and numbers."""
    template = Template((HERE / "collectives_template.md").read_text(encoding="utf-8"))
    texts = {f"faster_{number}": faster(number) for number in NUMBERS[1:]}
    for number, frames in (("1", FRAMES), ("1", LONGER), ("4", FRAMES), ("16", FRAMES)):
        lines = on_l2d2c(number, frames)
        share = numbers_in(lines, "share_learned")
        name = f"learned_{number}" + ("_longer" if frames == LONGER else "")
        texts[name] = f"{sum(share) / len(share):.0%}" if share else "-"
    return template.substitute(l2d2c=l2d2c_table(), machines=machines(NAME), not_run=not_run(), **texts)


def main() -> None:
    """See above."""
    parser = argparse.ArgumentParser(prog="python docs/results/collectives.py", description=__doc__)
    commands = parser.add_subparsers(dest="command")
    collecting = commands.add_parser("collect", help="raw results from runs")
    collecting.add_argument("runs", type=Path, nargs="+", help="folders with runs")
    options = parser.parse_args()
    if options.command == "collect":
        collect(options.runs)
    else:
        (HERE / "collectives.md").write_text(page(), encoding="utf-8")
        draw(HERE / "collectives.png")


if __name__ == "__main__":
    main()
