"""The page of agents, baselines.md, and its figure, made of the raw results of `studies.baselines.runs`."""

from __future__ import annotations

import math
from pathlib import Path
from string import Template

import curricula
from baselines.parts.catalogue import catalogue
from ctgraph_rl import Task
from ctgraph_rl.report.intervals import Bounds
from ctgraph_rl.tasks.configurations import CONFIGURATIONS
from ctgraph_rl.tasks.task import ct_graphs
from ctgraph_rl.tasks.values import open_loop_ceiling, random_frames_to_goal
from studies.baselines import instances, main_job, search, swap
from studies.raw import HERE, TEMPLATES, Raw, groups, machines, mean_of, read, share_of, table

PAGE = HERE / "baselines.md"
OF_GOALS = (search.NAME, swap.NAME)
"""Tables of goals that change."""

AGENTS = ("baselines_b1", "baselines_fo_b2", "depth_ladder")
"""Tables of agents that each learned one task."""

BY_FIVES = (instances.INSTANCES, instances.MEMORY)

EPISODES = 1000
"""Of the evaluation after training, greedy and sampled."""

RND = ("rnd_depth", "rnd_co_b1")
"""Tables of PPO with random network distillation, beside those of other agents on the same tasks."""

OLDER = "ppo_published"
"""The agent of which cells of the depth ladder were of an earlier revision."""


def cell(lines: Raw, column: str, bounds: tuple[float, float] | Bounds = (0.0, 1.0)) -> str:
    """Mean over seeds with its interval; seeds that failed are counted, not averaged."""
    return mean_of([None if line.get("failed") else float(line[column]) for line in lines], bounds)


def by_goal(raw: Raw, configuration: str) -> str:
    """A line for each agent, a column for each goal, greedy and sampled; the ceilings of agents without memory."""
    kinds = {agent.name: agent.kind for agent in catalogue("agent")}
    of = groups([line for line in raw if line["configuration"] == configuration], "agent", "task")
    goals = sorted({goal for _, goal in of})
    names = [name for name in kinds if any(agent == name for agent, _ in of)]
    rows = []
    for remembers in (False, True):
        for name in (name for name in names if kinds[name].memory is remembers):
            rows.append([f"`{name}`", *(both_ways(of.get((name, goal), []), configuration, goal) for goal in goals)])
        if not remembers and rows:
            exact = (", ".join(ceilings(configuration, goal)) for goal in goals)
            rows.append(["*ceiling without memory*", *(f"*{values}*" for values in exact)])
            blind = (open_loop_ceiling(task_of(configuration, goal)) for goal in goals)
            rows.append(["*ceiling without observations*", *(f"*{value:.2f}*" for value in blind)])
    return table([configuration, *(f"goal {goal}" for goal in goals)], rows)


def both_ways(lines: Raw, configuration: str, goal: str) -> str:
    """Mean return of the greedy and of the sampled policy, with its interval and the error of the evaluation."""
    if not lines:
        return ""
    task, found = task_of(configuration, goal), []
    bounds = Bounds(*task.return_bounds).widened(task.return_noise / math.sqrt(EPISODES))
    for way in ("greedy", "sampled"):
        found.append(cell(lines, f"{way}_return", bounds) + evaluation_error(lines, f"{way}_success", task))
    return ", ".join(found)


def evaluation_error(lines: Raw, column: str, task: Task) -> str:
    """The standard error of a mean return over `EPISODES` episodes, binomial and of the rewards' noise, from 0.005 on.

    All seeds and agents are evaluated by the same draws, so that more seeds do not make it smaller.
    """
    rate = sum(float(line[column]) for line in lines) / len(lines)
    error = math.sqrt((rate * (1 - rate) * task.goal_reward**2 + task.reward_std**2) / EPISODES)
    return f" ±{error:.2f}" if error >= 0.005 else ""


def task_of(configuration: str, goal: str) -> Task:
    """The task of a configuration and a goal."""
    name = "CT-" + configuration.upper().replace("_", "-")
    return CONFIGURATIONS[name](goal=tuple(map(int, goal.split("."))))


def ceilings(configuration: str, goal: str) -> list[str]:
    """The best mean return without memory, of a policy that always does the same and of any."""
    task = task_of(configuration, goal)
    return [f"{task.memoryless_ceiling(deterministic):.2f}" for deterministic in (True, False)]


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
        each = [of.get((agent, depth), []) for depth in depths]
        rows.append([f"`{agent}`", *map(solved, each)])
    return table(["", *(f"depth {depth}" for depth in depths)], rows)


def solved(lines: Raw) -> str:
    """How many seeds have a greedy success of at least 0.9."""
    return share_of([float(line["greedy_success"]) >= 0.9 for line in lines]) if lines else ""


def learned_and_met() -> dict[str, str]:
    """What the page says of A2C on CT-FO-B2: seeds that learned each goal, by sampled episodes, and rewards met."""
    solved = [line for line in read("baselines_fo_b2") if line["agent"] == "a2c"]
    met = groups(read("rewards_met"), "task")
    found = {}
    for task, lines in groups(solved, "task").items():
        goal, counts = task[0].replace(".", ""), [int(line["rewards_met"]) for line in met[task]]
        found[f"learned_{goal}"] = f"{sum(float(line['sampled_success']) >= 0.9 for line in lines)} of {len(lines)}"
        found[f"met_{goal}"] = f"{min(counts)} to {max(counts)}"
    return found


def searching() -> str:
    """Return how many seeds learned to search at depth 2."""
    found = search.searching([line for line in read(search.NAME) if line["depth"] == "2"])
    return f"{sum(found)} of {len(found)}"


def reruns() -> dict[str, str]:
    """What the page says of the cells that were run again, except those of an earlier revision."""
    again = read("reruns")
    others = [line for line in again if (line["agent"], line["table"]) != (OLDER, "depth_ladder")]
    return {
        "reruns": str(len(others)),
        "reruns_equal": str(sum(line["equal"] == line["numbers"] for line in others)),
    }


def page() -> str:
    """The page: the template with its tables."""
    tables = {
        "su_b1": by_goal(read("baselines_b1"), "su_b1"),
        "fo_b2": by_goal(read("baselines_fo_b2"), "fo_b2"),
        "depth_ladder": ladder(read("depth_ladder") + read("rnd_depth")),
    }
    template = Template((TEMPLATES / "baselines.md").read_text(encoding="utf-8"))
    made = template.substitute(
        tables,
        searching=searching(),
        machines=machines("main_job", *AGENTS, *RND, *BY_FIVES, *OF_GOALS),
        **learned_and_met(),
        **swap.texts(),
        **reruns(),
    )
    return made


def draw(path: Path) -> None:
    """Every seed of every agent on every goal of the four small configurations, beside the ceilings without memory."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    raw = read("baselines_b1")
    configurations = list(dict.fromkeys(line["configuration"] for line in raw))
    agents = list(dict.fromkeys(line["agent"] for line in raw))
    figure, panels = pyplot.subplots(1, len(configurations), figsize=(2.6 * len(configurations), 2.8), sharey=True)
    for axes, configuration in zip(panels, configurations, strict=True):
        for place, agent in enumerate(agents):
            of = [line for line in raw if (line["configuration"], line["agent"]) == (configuration, agent)]
            for line in of:
                goal = sorted({other["task"] for other in of}).index(line["task"])
                where = place - 0.3 + 0.2 * goal
                axes.plot(where, float(line["greedy_return"]), "o", color="black", markersize=2.5, alpha=0.5)
                axes.plot(where, float(line["sampled_return"]), "x", color="tab:orange", markersize=3.5, alpha=0.7)
        axes.set_xticks(range(len(agents)), agents, rotation=60, ha="right", fontsize=7)
        axes.set_title("CT-" + configuration.upper().replace("_", "-"), fontsize=9)
    panels[0].set_ylabel("mean return")
    figure.tight_layout()
    figure.savefig(path, dpi=150)


def make() -> None:
    """Write the page and its figures."""
    PAGE.write_text(page(), encoding="utf-8")
    draw(HERE / "baselines_b1.png")
    main_job.draw(HERE / "main_job.png")
