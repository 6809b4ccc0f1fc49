"""The page board.md, its figure and the board's files from the submissions in ``board``; and submissions from runs."""

from __future__ import annotations

import shutil
from datetime import date
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

from ctgraph_rl.board.method_yaml import OURS
from ctgraph_rl.board.standings.board_formats import columns
from ctgraph_rl.board.standings.board_page import write_board
from ctgraph_rl.board.standings.board_tables import BoardTable
from ctgraph_rl.board.standings.entries import shown_level
from studies.raw import HERE, TEMPLATES, table

FOLDER = HERE / "board"
PUBLISHED = date(2026, 11, 23)
TRACK = "small"

WEIGHTS = 4 * 13956
"""Bytes of the weights of PPO's network, float32."""

HEAD = 1040
"""Bytes of the weights of its output layers."""

ACTOR = 780
"""Bytes of the weights of its actor's head."""

EMBEDDING = 29600
"""Bytes of the embedding of a task."""

ARXIV = "https://arxiv.org/abs/"


class About(NamedTuple):
    """What a submission says of a method: its name, its paper, and the bytes that it keeps for each further task."""

    name: str
    paper: str | None
    bytes_per_task: int


METHODS = {
    "ppo": About("PPO", ARXIV + "1707.06347", 0),
    "a2c": About("A2C", ARXIV + "1602.01783", 0),
    "reinforce": About("REINFORCE", "https://doi.org/10.1007/BF00992696", 0),
    "ppo_count": About("PPO with a count-based bonus", ARXIV + "1611.04717", 0),
    "lstm_ppo": About("LSTM-PPO", ARXIV + "1707.06347", 0),
    "ppo-scratch": About("PPO, a network for each task", None, WEIGHTS),
    "ppo-l2": About("PPO + L2", ARXIV + "1612.00796", HEAD),
    "ppo-ewc": About("PPO + EWC", ARXIV + "1612.00796", HEAD),
    "ppo-si": About("PPO + SI", ARXIV + "1703.04200", HEAD),
    "ppo-mas": About("PPO + MAS", ARXIV + "1711.09601", HEAD),
    "ppo-clear": About("PPO + CLEAR", ARXIV + "1811.11682", 0),
    "ppo-packnet": About("PPO + PackNet", ARXIV + "1711.05769", HEAD),
    "ppo-mask_ri": About("PPO + Mask RI", ARXIV + "2212.11110", WEIGHTS),
    "ppo-mask_lc": About("PPO + Mask LC", ARXIV + "2212.11110", WEIGHTS + 32),
    "ppo-mask_blc": About("PPO + Mask BLC", ARXIV + "2212.11110", WEIGHTS + 32),
    "ppo-mask_sc": About("PPO + MaskSC", "https://github.com/DMIU-ShELL/MaskSC", WEIGHTS + 32 + EMBEDDING),
    "ppo-mask_amsc": About("PPO + AMSC", "https://github.com/DMIU-ShELL/AMSC", WEIGHTS + 32 + EMBEDDING),
    "ppo-cka_rl": About("PPO + CKA-RL", ARXIV + "2510.19314", ACTOR),
}
"""The beginning of the names of runs, and what is submitted of them."""

ELSEWHERE = ("average performance", "bytes of the agent", "steps", "n", "level")
"""Columns that only the board itself has: the page names seeds and levels once."""

TUNING = "the settings of the package; strengths of methods were chosen for PPO, on seeds that were not recorded"


def submit_all(runs: Path, commit: str, given: str) -> None:
    """Submit every method of `METHODS` of which there are all runs in a folder; a submission is replaced."""
    from ctgraph_rl.board.submit import submit
    from ctgraph_rl.board.tracks import track

    of_track = track(TRACK)
    names = [path.parent.name for path in sorted(runs.glob("*/metrics.json"))]
    for start, about in METHODS.items():
        folders = [runs / name for name in names if name.startswith(f"{start}-seed")]
        if len(folders) >= len(of_track.seeds):
            folder = FOLDER / f"{start}{given}"
            shutil.rmtree(folder, ignore_errors=True)
            print(submit(folders, folder, _method(about, commit), of_track).digest, folder.name)


def _method(about: About, commit: str) -> dict[str, Any]:
    """Return what ``method.yaml`` says."""
    import yaml

    from ctgraph_rl.board.method_yaml import TEMPLATE

    method = yaml.safe_load(TEMPLATE)
    method |= {"name": about.name, "track": TRACK, "authors": ["The ctgraph_rl developers"], "paper": about.paper}
    method |= {"code": {"repository": OURS, "commit": commit, "licence": "Apache-2.0"}}
    method["bytes_per_task"], method["tuning"]["how"] = about.bytes_per_task, TUNING
    return method


def page(tables: list[BoardTable]) -> str:
    """Return the page: its template with its tables."""
    shown = [part for each in tables for part in (f"## {each.title}", _table(each))]
    lines = [line for each in tables for line in each.standings]
    levels = [shown_level(line.entry.level) for line in lines]
    counts = ", ".join(f"{levels.count(level)} {level}" for level in dict.fromkeys(levels))
    template = Template((TEMPLATES / "board.md").read_text(encoding="utf-8"))
    return template.substitute(tables="\n\n".join(shown), levels=counts, count=len(lines))


def _table(of: BoardTable) -> str:
    lines = [[cell for cell in columns(line) if cell.head not in ELSEWHERE] for line in of.standings]
    rows = [[f"{cell.shown} {cell.interval}".strip() for cell in cells] for cells in lines]
    return table([cell.head for cell in lines[0]], rows)


def draw(of: BoardTable, path: Path) -> None:
    """Draw every seed, the mean and its interval of each submission of a table, beside the bytes for a further task."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    lines = list(reversed(of.standings))
    figure, axes = pyplot.subplots(figsize=(7.2, 0.32 * len(lines) + 0.9))
    for place, line in enumerate(lines):
        score = line.score
        axes.plot(line.entry.scores, [place] * len(line.entry.scores), "|", color="0.6", markersize=9)
        axes.plot([score.low, score.high], [place, place], color="tab:blue", linewidth=2)
        axes.plot(score.value, place, "o", color="tab:blue", markersize=5)
        size = line.entry.method["bytes_per_task"]
        axes.annotate(f"{size:,} bytes", (1.03, place), va="center", fontsize=8, annotation_clip=False)
    axes.set_yticks(range(len(lines)), [f"{line.name}  ({line.rank})" for line in lines], fontsize=8)
    axes.set_xlim(0, 1.01)
    axes.set_xlabel("normalised performance: mean and 95 % interval, and every seed", fontsize=8)
    axes.set_title(f"{of.title} (rank); at the right: kept for a further task", fontsize=9)
    axes.grid(axis="x", alpha=0.3)
    figure.tight_layout()
    figure.savefig(path, dpi=150)


def make() -> None:
    """Write the page, its figure and the files of the board."""
    made = write_board([FOLDER], FOLDER, published=PUBLISHED)
    (FOLDER / "board.md").unlink()  # the page has the same tables
    (HERE / "board.md").write_text(page(made.tables), encoding="utf-8")
    draw(made.tables[0], HERE / "board.png")
