"""Tables and figures of runs with methods."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from statistics import fmean

import numpy as np
import torch

from ctgraph_rl import metrics
from ctgraph_rl.draw.style import new_figure, save_figure
from ctgraph_rl.metrics import MASTERED, METRICS, Curves
from ctgraph_rl.metrics.bounds import Known
from studies.figures import draw_grid
from studies.raw import Raw, groups, mean_of, read, select, shown, table
from studies.two_groups import two_groups

MASKS = ("masks_ct8_md", "masks_ct8", "masks_ct12")
"""The published comparison on its three curricula."""

MASK_METHODS = ("finetune", "mask_lc", "ewc_published", "mask_ri", "mask_blc")

CURRICULA = ("fo_b1_4tasks", "fo_b1_4images", "fo_b1_depth2to5")
AGENTS = ("ppo", "a2c", "dqn", "lstm_ppo")
METHODS = (
    "finetune",
    "scratch",
    "multitask",
    "l2",
    "ewc",
    "si",
    "mas",
    "clear",
    "packnet",
    "mask_ri",
    "mask_lc",
    "mask_blc",
)
"""What `methods` compares, in the order of the page."""

EXPERT = "expert"
"""The method of lines that have what each single-task expert of a seed gets on its own task after so many frames."""

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
    "average performance": metrics.continual_world_performance,
    "forgetting": metrics.continual_world_forgetting,
    "TPOT": metrics.total_performance_over_time,
    "tasks learned": metrics.tasks_learned,
}
"""Columns that a run has without experts, and the metrics that they are."""

COLUMNS = ("average performance", "forward transfer", "forgetting", "TPOT", "tasks learned", "known at the end")


def scores(lines: Raw) -> dict[str, float | None]:
    """The numbers of the table that a run has without experts; None where there is none."""
    run = curves(lines)
    values = {name: metric(run).value for name, metric in OF_A_RUN.items()}
    return {**values, "known at the end": float((run.performance[-1] >= MASTERED).sum())}


def summary(name: str) -> str:
    """A line for each method: every number's mean over seeds with its interval; then what was left out."""
    experts = list(groups(select(read(name), method=EXPERT), "seed").values())
    alone = expert_areas(experts)
    left_out = full(experts)
    rows = []
    for method in MASK_METHODS:
        runs = list(groups(select(read(name), method=method), "seed").values())
        found = [scores(lines) for lines in runs]
        evaluations, tasks = curves(runs[0]).performance.shape
        known = Known(*RETURNS, tasks=tasks, evaluations=evaluations, lowest_share=0.0, highest_share=1.0)
        cells = {"forward transfer": transfer(areas(runs), alone, left_out)}
        for column in found[0]:
            metric = OF_A_RUN.get(column, metrics.tasks_learned)
            cells[column] = mean_of([each[column] for each in found], METRICS[metric.__name__].bounds(known))
        rows.append([f"`{method}`", *(cells[column] for column in COLUMNS)])
    names = f"task {', '.join(map(str, left_out))}" if left_out else "none"
    seeds = f"{len(experts)} seeds of each method and of the experts."
    return f"{table(['method', *COLUMNS], rows)}\n\n{seeds} Left out of forward transfer: {names}."


def returns_at_end(lines: Raw) -> list[float]:
    """The mean return over all tasks at the end of each run."""
    return [float(curves(each).performance[-1].mean()) for each in groups(lines, "seed").values()]


def draw(name: str, path: Path) -> None:
    """The mean return over all tasks after so many frames: a line for each method, thin ones for its seeds."""
    figure = new_figure(6.4, 3.2)
    axes = figure.subplots()
    for number, method in enumerate(MASK_METHODS):
        runs = [curves(lines) for lines in groups(select(read(name), method=method), "seed").values()]
        returns = torch.stack([run.performance.mean(1) for run in runs])
        thousands = torch.tensor(runs[0].frames) / 1e3
        axes.plot(thousands, returns.T, color=f"C{number}", linewidth=0.5, alpha=0.5)
        label = f"{method} (n = {len(runs)})"
        axes.plot(thousands, returns.mean(0), color=f"C{number}", linewidth=1.6, label=label)
    starts = torch.tensor(runs[0].blocks).diff().nonzero()[:, 0] + 1
    axes.vlines(thousands[starts], 0, 1, color="0.9", linewidth=0.7, zorder=0)
    axes.set(xlabel="thousand frames", ylabel="mean return over all tasks", ylim=(-0.02, 1.02))
    axes.legend(fontsize=7, frameon=False)
    save_figure(figure, path)


def draw_by_agent(path: Path) -> None:
    """The mean over seeds of the return at the end: a panel for each curriculum, methods by agents."""
    figure = new_figure(7.2, 3.6)
    panels = figure.subplots(1, len(CURRICULA), sharey=True)
    for axes, curriculum in zip(panels, CURRICULA, strict=True):
        of = groups(select(read("methods"), curriculum=curriculum), "method", "agent")
        rows = [[fmean(returns_at_end(of[method, agent])) for agent in AGENTS] for method in METHODS]
        counts = [len(groups(of[METHODS[0], agent], "seed")) for agent in AGENTS]
        agents = [f"{agent}\nn = {count}" for agent, count in zip(AGENTS, counts, strict=True)]
        draw_grid(axes, rows, "{:.2f}", METHODS, agents)
        axes.set_title(curriculum, fontsize=9)
    save_figure(figure, path)
