"""The page of agents, baselines.md, and its figures."""

from __future__ import annotations

import math
from pathlib import Path

import curricula
from baselines.parts.catalogue import catalogue
from ctgraph_rl import Task
from ctgraph_rl.draw.style import new_figure, save_figure
from ctgraph_rl.report.intervals import Bounds
from ctgraph_rl.tasks.configurations import CONFIGURATIONS
from ctgraph_rl.tasks.task import ct_graphs
from ctgraph_rl.tasks.values import open_loop_ceiling, random_frames_to_goal
from studies.baselines import main_job
from studies.raw import Raw, fill, groups, machines, mean_of, numbers_in, read, select, share_of, table

TABLES = (
    "main_job",
    "baselines_b1",
    "baselines_fo_b2",
    "depth_ladder",
    "rnd_depth",
    "rnd_co_b1",
    "baselines_b1_instances",
    "memory_b1",
    "rl2_search",
    "rl2_swap",
)

EPISODES = 1000
"""Of the evaluation after training, greedy and sampled."""

SOLVED = 0.9
"""The least return or success of what is learned."""

FOUND = 0.95
"""Share of the last episodes of trials that reach the goal, from which on a seed has learned to search."""


def by_goal(raw: Raw, configuration: str) -> str:
    """A line for each agent, a column for each goal, greedy and sampled; the ceilings of agents without memory."""
    of = groups(select(raw, configuration=configuration), "agent", "task")
    goals = sorted({goal for _, goal in of})
    tasks = [task_of(configuration, goal) for goal in goals]
    rows: dict[bool, list[list[str]]] = {False: [], True: []}
    for agent in catalogue("agent"):
        cells = [of.get((agent.name, goal), []) for goal in goals]
        if any(cells):
            shown = [both_ways(lines, task) if lines else "" for lines, task in zip(cells, tasks, strict=True)]
            rows[agent.kind.memory].append([f"`{agent.name}`", *shown])
    if rows[False]:
        exact = [[f"{task.memoryless_ceiling(deterministic):.2f}" for deterministic in (True, False)] for task in tasks]
        blind = [f"*{open_loop_ceiling(task):.2f}*" for task in tasks]
        rows[False].append(["*ceiling without memory*", *(f"*{', '.join(ends)}*" for ends in exact)])
        rows[False].append(["*ceiling without observations*", *blind])
    return table([configuration, *(f"goal {goal}" for goal in goals)], rows[False] + rows[True])


def both_ways(lines: Raw, task: Task) -> str:
    """Mean return of the greedy and of the sampled policy, with its interval and the error of the evaluation.

    Seeds that failed are counted, not averaged. The standard error is shown from 0.005 on: binomial, and of the
    rewards' noise. All seeds and agents are evaluated by the same draws, so that more seeds do not make it smaller.
    """
    bounds = Bounds(*task.return_bounds).widened(task.return_noise / math.sqrt(EPISODES))
    found = []
    for way in ("greedy", "sampled"):
        returns = [None if line.get("failed") else float(line[f"{way}_return"]) for line in lines]
        rate = sum(numbers_in(lines, f"{way}_success")) / len(lines)
        error = math.sqrt((rate * (1 - rate) * task.goal_reward**2 + task.reward_std**2) / EPISODES)
        found.append(mean_of(returns, bounds) + (f" ±{error:.2f}" if error >= 0.005 else ""))
    return ", ".join(found)


def task_of(configuration: str, goal: str) -> Task:
    """The task of a configuration and a goal."""
    name = "CT-" + configuration.upper().replace("_", "-")
    return CONFIGURATIONS[name](goal=tuple(map(int, goal.split("."))))


def ladder(raw: Raw) -> str:
    """A line for each agent, a column for each depth: seeds that solved it; and how often chance finds the goal."""
    of = groups(raw, "agent", "depth")
    depths = sorted({depth for _, depth in of}, key=int)
    chance = []
    for depth in depths:
        alone = curricula.load("single_task", depth=int(depth))
        [task] = ct_graphs(alone.tasks, "this study")
        chance.append(f"{alone.num_frames / random_frames_to_goal(task):.2g}")
    rows = [["*goals that random actions find*", *chance]]
    for agent in dict.fromkeys(agent for agent, _ in of):
        rows.append([f"`{agent}`", *(solved(of[agent, depth]) for depth in depths)])
    return table(["", *(f"depth {depth}" for depth in depths)], rows)


def solved(lines: Raw) -> str:
    """How many seeds have a greedy success of at least 0.9, and how many of them only by chance."""
    right = [line for line in lines if float(line["greedy_success"]) >= SOLVED]
    learned = [line for line in right if float(line["sampled_success"]) > 0]
    by_chance = len(right) - len(learned)
    return share_of([line in learned for line in lines]) + (f", {by_chance} by chance" if by_chance else "")


def searching(depth: str) -> list[bool]:
    """Return for each seed whether it finds the goal by the last episode of a trial."""
    lines = select(read("rl2_search"), depth=depth)
    last = max(lines, key=lambda line: int(line["episode"]))["episode"]
    return [success >= FOUND for success in numbers_in(select(lines, episode=last), "greedy_success")]


def page() -> str:
    """The page."""
    search = searching("2")
    again = read("reruns")
    replaced = select(again, agent="ppo_published", table="depth_ladder")  # cells of an earlier revision
    others = [line for line in again if line not in replaced]
    texts = {
        "su_b1": by_goal(read("baselines_b1"), "su_b1"),
        "fo_b2": by_goal(read("baselines_fo_b2"), "fo_b2"),
        "depth_ladder": ladder(read("depth_ladder") + read("rnd_depth")),
        "searching": f"{sum(search)} of {len(search)}",
        "reruns": str(len(others)),
        "reruns_equal": str(sum(line["equal"] == line["numbers"] for line in others)),
        "machines": machines(*TABLES),
    }
    return fill("baselines", texts)


def draw(folder: Path) -> None:
    """Draw every seed of every agent on every goal of the four small configurations; and the main job."""
    raw = read("baselines_b1")
    agents = list(dict.fromkeys(line["agent"] for line in raw))
    of = groups(raw, "configuration")
    figure = new_figure(10.4, 2.8)
    for axes, ((configuration,), lines) in zip(figure.subplots(1, len(of), sharey=True), of.items(), strict=True):
        goals = sorted({line["task"] for line in lines})
        places = [agents.index(line["agent"]) - 0.3 + 0.2 * goals.index(line["task"]) for line in lines]
        axes.plot(places, numbers_in(lines, "greedy_return"), "o", color="black", markersize=2.5, alpha=0.5)
        axes.plot(places, numbers_in(lines, "sampled_return"), "x", color="tab:orange", markersize=3.5, alpha=0.7)
        axes.set_xticks(range(len(agents)), agents, rotation=60, ha="right", fontsize=7)
        axes.set_title("CT-" + configuration.upper().replace("_", "-"), fontsize=9)
    figure.axes[0].set_ylabel("mean return")
    save_figure(figure, folder / "baselines_b1.png")
    main_job.draw(folder / "main_job.png")
