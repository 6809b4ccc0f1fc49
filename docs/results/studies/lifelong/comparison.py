"""Tables and figures of runs with methods, made of the raw results of `studies.lifelong.runs`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fractions import Fraction
from itertools import product
from pathlib import Path

import numpy as np
import torch

from ctgraph_rl import metrics
from ctgraph_rl.metrics import METRICS, Curves
from ctgraph_rl.metrics.bounds import Known
from studies.lifelong.experiments import MASKS, expected
from studies.raw import Raw, groups, mean_of, read, shown, table
from studies.two_groups import two_groups

EXPERT = "expert"
"""The method of lines that have what each single-task expert of a seed gets on its own task after so many frames."""

SOLVED = 0.9
LEAST_ROOM = Fraction(1, 20)
"""What experts must leave to gain for a forward transfer: one of a task's 20 evaluations. Below it one failed
evaluation of one run would outweigh all other tasks. Areas are compared with it as exact fractions."""

RETURNS = (0.0, 1.0)
"""Bounds of the returns of all tasks of these experiments."""


def curves(lines: Raw) -> Curves:
    """The evaluations of a run after the one before training, which the published protocol does not have."""
    used = [line for line in lines if int(line["frames"]) > 0]
    tasks = [key for key in used[0] if key.isdigit() and used[0][key]]
    values = torch.tensor([[float(line[task]) for task in tasks] for line in used], dtype=torch.float64)
    blocks, frames = (tuple(int(line[key]) for line in used) for key in ("block", "frames"))
    return Curves(values, blocks, frames, tuple((task,) for task in range(len(tasks))))


def scores(lines: Raw) -> dict[str, float | None]:
    """The numbers of the table that a run has without experts; None where there is none."""
    run = curves(lines)
    found = {
        "average performance": metrics.continual_world_performance(run),
        "forgetting": metrics.continual_world_forgetting(run),
        "TPOT": metrics.total_performance_over_time(run),
        "tasks learned": metrics.tasks_learned(run, SOLVED),
    }
    values = {name: metric.value for name, metric in found.items()}
    return {**values, "known at the end": float((run.performance[-1] >= SOLVED).sum())}


def areas(runs: Iterable[Raw]) -> np.ndarray:
    """float64 [seeds, tasks]: the areas under the curves of tasks over their own blocks."""
    return np.array([metrics.stage_areas(curves(lines)).tolist() for lines in runs])


def expert_areas(experts: Iterable[Raw]) -> np.ndarray:
    """float64 [seeds, tasks]: the areas under the curves of the experts."""
    return np.array([metrics.mean_area(curves(lines).performance).tolist() for lines in experts])


def full(experts: Sequence[Raw]) -> list[int]:
    """Tasks, from 1, whose experts leave less than `LEAST_ROOM` to gain, in exact numbers."""
    rooms: dict[str, list[Fraction]] = {}
    for lines in experts:
        for line in lines:
            for task in (key for key in line if key.isdigit() and line[key] and int(line["frames"]) > 0):
                rooms.setdefault(task, []).append(1 - Fraction(line[task]))
    return [int(task) for task, room in rooms.items() if sum(room) / len(room) < LEAST_ROOM]


def forward_transfer(runs: np.ndarray, experts: np.ndarray) -> np.ndarray:
    """Continual World's forward transfer of mean areas [..., tasks]; -inf where an expert leaves nothing to gain."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.nan_to_num((runs - experts) / (1 - experts), nan=-np.inf, neginf=-np.inf).mean(-1)


def transfer(runs: np.ndarray, experts: np.ndarray, left_out: Sequence[int]) -> str:
    """Forward transfer, with the uncertainty of both sides."""
    kept = [task for task in range(runs.shape[1]) if task + 1 not in left_out]
    return shown(two_groups(runs[:, kept], experts[:, kept], forward_transfer, RETURNS))


OF_A_RUN = {
    "average performance": "continual_world_performance",
    "forgetting": "continual_world_forgetting",
    "TPOT": "total_performance_over_time",
    "tasks learned": "tasks_learned",
    "known at the end": "tasks_learned",
}
"""Columns that a run has without experts, with the metrics that say their bounds."""

COLUMNS = (
    "average performance",
    "forward transfer",
    "forgetting",
    "TPOT",
    "tasks learned",
    "known at the end",
)


def summary(name: str) -> str:
    """A line for each method: every number's mean over seeds with its interval; then what was left out."""
    of = groups(read(name), "method", "seed")
    if not of:
        return f"Nothing was run yet: `ctgraph-rl -m experiment={name}`."
    experts = [lines for (who, _), lines in of.items() if who == EXPERT]
    alone, left_out, rows = expert_areas(experts), full(experts), []
    for method in dict.fromkeys(expected(name)["method"]):
        runs = [lines for (who, _), lines in of.items() if who == method]
        found, own = [scores(lines) for lines in runs], areas(runs)
        values = {"forward transfer": transfer(own, alone, left_out)}
        values |= {column: mean_of([each[column] for each in found], bounds(column, runs[0])) for column in OF_A_RUN}
        rows.append([f"`{method}`", *(values[column] for column in COLUMNS)])
    tasks = f"task {', '.join(map(str, left_out))}" if left_out else "none"
    seeds = f"{len(experts)} seeds of each method and of the experts."
    said = f"{seeds} Left out of forward transfer: {tasks}."
    return f"{table(['method', *COLUMNS], rows)}\n\n{said}"


def bounds(column: str, lines: Raw) -> tuple[float, float]:
    """The lowest and the highest value of a column."""
    run = curves(lines)
    evaluations, tasks = run.performance.shape
    known = Known(*RETURNS, tasks=tasks, evaluations=evaluations, lowest_share=0.0, highest_share=1.0)
    return METRICS[OF_A_RUN[column]].bounds(known)


def seeds_of(lines: Raw, agent: str) -> str:
    """How many seeds the cells of an agent have, such as ``n = 2 to 3``."""
    cells = groups([line for line in lines if line["agent"] == agent], "curriculum", "method").values()
    counts = sorted({len(groups(cell, "seed")) for cell in cells})
    return f"n = {' to '.join(map(str, dict.fromkeys([counts[0], counts[-1]])))}"


def returns_at_end(lines: Raw) -> list[float]:
    """The mean return over all tasks at the end of each run."""
    return [float(curves(each).performance[-1].mean()) for each in groups(lines, "seed").values()]


def draw(name: str, path: Path) -> None:
    """The mean return over all tasks after so many frames: a line for each method, thin ones for its seeds."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    of = groups(read(name), "method")
    figure, axes = pyplot.subplots(figsize=(6.4, 3.2))
    for number, method in enumerate(expected(name)["method"]):
        runs = [curves(lines) for lines in groups(of.get((method,), []), "seed").values()]
        each = [run.performance.mean(1) for run in runs]
        for run, values in zip(runs, each, strict=True):
            axes.plot(_thousands(run), values, color=f"C{number}", linewidth=0.5, alpha=0.5)
        if each:
            label = f"{method} (n = {len(each)})"
            axes.plot(_thousands(runs[0]), torch.stack(each).mean(0), color=f"C{number}", linewidth=1.6, label=label)
            starts = [place for place, block in enumerate(runs[0].blocks) if block > runs[0].blocks[max(place - 1, 0)]]
            axes.vlines(_thousands(runs[0])[starts], 0, 1, color="0.9", linewidth=0.7, zorder=0)
    axes.set_xlabel("thousand frames")
    axes.set_ylabel("mean return over all tasks")
    axes.set_ylim(-0.02, 1.02)
    axes.legend(fontsize=7, frameon=False)
    figure.tight_layout()
    figure.savefig(path, dpi=150)
    pyplot.close(figure)


def draw_by_agent(path: Path) -> None:
    """The mean over seeds of the return at the end: a panel for each curriculum, methods by agents."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    raw, swept = read("methods"), expected("methods")
    of = groups(raw, "curriculum", "method", "agent")
    figure, panels = pyplot.subplots(1, len(swept["curriculum"]), figsize=(7.2, 3.6), sharey=True)
    for axes, curriculum in zip(panels, swept["curriculum"], strict=True):
        cells = torch.full([len(swept["method"]), len(swept["agent"])], torch.nan)
        for (row, method), (column, agent) in product(enumerate(swept["method"]), enumerate(swept["agent"])):
            if lines := of.get((curriculum, method, agent)):
                value = cells[row, column] = torch.tensor(returns_at_end(lines)).mean()
                colour = "white" if value < 0.6 else "black"
                axes.text(column, row, f"{value:.2f}", ha="center", va="center", fontsize=7, color=colour)
        axes.imshow(cells, vmin=0, vmax=1, cmap="viridis", aspect="auto")
        axes.set_title(curriculum, fontsize=9)
        labels = [f"{agent}\n{seeds_of(raw, agent)}" for agent in swept["agent"]]
        axes.set_xticks(range(len(labels)), labels, fontsize=6)
        axes.set_yticks(range(len(swept["method"])), swept["method"], fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=150)
    pyplot.close(figure)


def _thousands(run: Curves) -> torch.Tensor:
    return torch.tensor(run.frames) / 1e3


def tables(names: Sequence[str] = MASKS) -> dict[str, str]:
    """What the template of the page names."""
    return {name: summary(name) for name in names}
