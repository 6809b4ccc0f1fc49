"""The page board.md, its figure and the board's files from the submissions in ``board``; and submissions from runs."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from string import Template
from typing import Any, NamedTuple

from ctgraph_rl.board.method_yaml import OURS
from ctgraph_rl.board.standings.board_formats import columns
from ctgraph_rl.board.standings.board_page import write_board
from ctgraph_rl.board.standings.board_tables import BoardTable
from ctgraph_rl.board.standings.track_ceilings import Ceilings
from studies.raw import HERE, TEMPLATES, table
from studies.sentences import Sentences
from studies.verdicts import undecided

says = Sentences()

FOLDER = HERE / "board"
SMALL = "small"

WEIGHTS = 4 * 13956
"""Bytes of the weights of PPO's network on the small track, float32."""

WEIGHTS_CT8 = 4 * 14212
"""Bytes of those on CT8, whose ids are longer."""

WEIGHTS_NO_ID = 4 * 13700
"""Bytes of those where observations have no id."""

HEAD = 1040
"""Bytes of the weights of its output layers."""

ACTOR = 780
"""Bytes of the weights of its actor's head."""

EMBEDDING = 29600
"""Bytes of the embedding of a task."""

ARXIV = "https://arxiv.org/abs/"

TUNING = "the settings of the package; strengths of methods were chosen for PPO, on seeds that were not recorded"

OF_CONF = "the settings of the package; on which seeds they were chosen was not recorded"

SEARCH = "experiment=memory_search: batches, learning rate and entropy bonus, at depth 2 with 100 steps"

ONE_SEED = "64 environments in place of 256, whose run learned less and was stopped; else as in the package"


class About(NamedTuple):
    """What a submission says of a method: its name and paper, the bytes for each further task, how it was tuned."""

    name: str
    paper: str | None
    bytes_per_task: int
    tuning: str = TUNING
    tuning_seeds: tuple[int, ...] = ()
    tuning_hours: float | None = None


ON_SMALL = {
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

METHODS = {
    SMALL: ON_SMALL,
    "adaptation": {"rl2": About("RL^2", ARXIV + "1611.02779", 0, OF_CONF)},
    "exploration": {"ppo_count": ON_SMALL["ppo_count"]._replace(tuning=OF_CONF)},
    "forgetting": {"ppo-mask_ri": ON_SMALL["ppo-mask_ri"]._replace(bytes_per_task=WEIGHTS_CT8, tuning=OF_CONF)},
    "growing_depth": {
        "ppo-mask_lc": ON_SMALL["ppo-mask_lc"]._replace(bytes_per_task=WEIGHTS_NO_ID + 32, tuning=OF_CONF)
    },
    "memory": {"lstm_ppo-gru": About("PPO with a GRU", ARXIV + "1406.1078", 0, SEARCH, tuning_seeds=(100, 101))},
    "sharing": {
        "ppo_count-mask_lc": About(
            "PPO with a count-based bonus + Mask LC",
            ARXIV + "2212.11110",
            WEIGHTS_NO_ID + 32,
            tuning=ONE_SEED,
            tuning_seeds=(100,),
            tuning_hours=0.2,
        )
    },
}
"""What is submitted to each track."""

ELSEWHERE = ("average performance", "bytes of the agent", "steps", "n", "hours", "level")
"""Columns that only the board itself has: the page names seeds and levels once."""


def submit_all(runs: Path, commit: str, given: str, track_name: str = SMALL) -> None:
    """Submit every method of a track of which there are all runs in a folder; a submission is replaced."""
    from ctgraph_rl.board.submit import submit
    from ctgraph_rl.board.tracks import track

    of_track = track(track_name)
    names = [path.parent.name for path in sorted(runs.glob("*/metrics.json"))]
    prefix = "" if track_name == SMALL else f"{track_name}-"
    for start, about in METHODS[track_name].items():
        folders = [runs / name for name in names if name.startswith(f"{start}-seed")]
        if len(folders) >= len(of_track.seeds):
            folder = FOLDER / f"{prefix}{start}{given}"
            shutil.rmtree(folder, ignore_errors=True)
            print(submit(folders, folder, _method(about, commit, track_name), of_track).digest, folder.name)


def _method(about: About, commit: str, track_name: str) -> dict[str, Any]:
    """Return what ``method.yaml`` says."""
    import yaml

    from ctgraph_rl.board.method_yaml import TEMPLATE

    method = yaml.safe_load(TEMPLATE)
    method |= {"name": about.name, "track": track_name, "authors": ["The ctgraph_rl developers"], "paper": about.paper}
    method |= {"code": {"repository": OURS, "commit": commit, "licence": "Apache-2.0"}}
    method["bytes_per_task"] = about.bytes_per_task
    method["tuning"] = {"how": about.tuning, "seeds": list(about.tuning_seeds)}
    method["compute"]["tuning_hours"] = about.tuning_hours
    return method


def page(tables: list[BoardTable]) -> str:
    """Return the page: its template with its tables."""
    several = [each for each in tables if len(each.standings) > 1]
    alone = [each for each in tables if len(each.standings) == 1]
    template = Template((TEMPLATES / "board.md").read_text(encoding="utf-8"))
    text = template.substitute(
        tables="\n\n".join(f"## {each.title}\n\n{_table(each)}" for each in several),
        alone=table(
            ["track and rung", "given", "method", "score", "bytes per task", "landmarks"], list(map(_line, alone))
        ),
        count=sum(len(each.standings) for each in tables),
        without=_without({each.track.name for each in tables}),
        clearest=_clearest(tables[0]),
    )
    return says.check(text, tables)


def _clearest(of: BoardTable) -> str:
    """Return the clearest difference of two lines of the first ranks, whose order is open."""
    names = {line.name for line in of.standings if line.best_rank == 1}
    found = {pair: each for pair, each in of.pairs.items() if names.issuperset(pair)}
    one, other = min(found, key=lambda pair: found[pair].p_value or 0)
    return f"{one} less {other}, {undecided(found[one, other], len(of.pairs))}"


def _ranks(of: BoardTable) -> dict[str, set[str]]:
    """Return the names of lines by their rank."""
    found: dict[str, set[str]] = {}
    for line in of.standings:
        found.setdefault(line.rank, set()).add(line.name)
    return found


def _mean(values: Sequence[float | None]) -> float:
    """Return the mean of seeds, of which each has a value."""
    return fmean(value for value in values if value is not None)


@says("Ten keep nearly everything. 20 seeds cannot order them:")
def _(tables: list[BoardTable]) -> bool:
    first = [line for line in tables[0].standings if line.rank == "1 to 10"]
    forgotten = [_mean(line.entry.values["forgetting"]) for line in first]
    return tables[0].num_seeds == 20 and len(first) == 10 and max(forgotten) < 0.05


@says("CLEAR are behind them, then CKA-RL and agents without a method.")
def _(tables: list[BoardTable]) -> bool:
    last = {"PPO + CKA-RL", "LSTM-PPO", "PPO with a count-based bonus", "REINFORCE", "A2C", "PPO"}
    ranks = _ranks(tables[0])
    return ranks.get("11 to 12") == {"PPO + MaskSC", "PPO + CLEAR"} and ranks.get("13 to 18") == last


@says("MaskSC, which forgets nothing but does not learn every task,")
def _(tables: list[BoardTable]) -> bool:
    [line] = [line for line in tables[0].standings if line.name == "PPO + MaskSC"]
    return set(line.entry.values["forgetting"]) == {0.0} and _mean(line.entry.scores) < 0.95


def _without(there: set[str]) -> str:
    """Return a sentence about the tracks that have no line; nothing where each has one."""
    from ctgraph_rl.board.tracks import tracks

    lacking = [f"`{each.name}`" for each in tracks() if each.name not in there]
    return f" No line yet: {', '.join(lacking)}." if lacking else ""


def _table(of: BoardTable) -> str:
    rows = []
    for line in of.standings:
        cells = [cell for cell in columns(line) if cell.head not in ELSEWHERE]
        rank, *others = cells
        shown = [f"{cell.shown} {cell.interval}".strip() for cell in others]
        rows.append([rank.shown.replace(" to ", "-"), *shown])
    return table([cell.head for cell in cells], rows)


def _line(of: BoardTable) -> list[str]:
    """Return the cells of a table's only line, beside what policies get that lack what the track is about."""
    standing = of.standings[0]
    cells = {cell.head: cell.shown for cell in columns(standing)}
    learned = ", ".join(filter(None, (of.track.id, of.variant.rung)))
    score, _, interval = str(standing.score).partition(" n = ")[0].partition(" ")
    about = [cells["method"], f"{score} {interval}", cells["bytes per task"]]
    return [learned, of.variant.given, *about, _landmarks(of.ceilings)]


def _landmarks(of: Ceilings) -> str:
    """Return the returns of policies that lack what a track is about."""
    parts = [f"random {of.random:.2g}"]
    if of.memoryless is not None and of.memoryless < 1:
        parts.append(f"no memory {of.memoryless:.2f}")
    if of.search is not None:
        parts.append(f"best search {of.search:.3f}")
    return ", ".join(parts)


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
    made = write_board([FOLDER], FOLDER)
    (FOLDER / "board.md").unlink()  # the page has the same tables
    (HERE / "board.md").write_text(page(made.tables), encoding="utf-8")
    draw(made.tables[0], HERE / "board.png")
