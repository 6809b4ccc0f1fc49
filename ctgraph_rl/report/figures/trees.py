"""An agent's trees of tasks: goals, where one trained seed went, and its actions."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from ctgraph_rl.draw.task_figure import draw_task
from ctgraph_rl.log.files import AGENT, CURRICULUM
from ctgraph_rl.play.visits import Visits, visits
from ctgraph_rl.report.figures.gallery import CaptionedFigure, left_out
from ctgraph_rl.report.sections import Result, Section
from ctgraph_rl.report.style import panels, short
from ctgraph_rl.runs.load import Trained, load
from ctgraph_rl.runs.read import Run
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.task import are_graphs, ct_graphs

MOST_TREES = 8
COLUMNS = 2
EPISODES = 100


class Trees(NamedTuple):
    """A run's curriculum and trained agent, as far as they can be read."""

    curriculum: Curriculum | None
    trained: Trained | None
    reason: str  # why the curriculum or the agent is missing; empty if it is not


def task_trees(section: Section, result: Result, found: Trees) -> CaptionedFigure | None:
    """Return the tasks' trees; None without a readable curriculum."""
    if found.curriculum is None:
        return None
    one = result.finished[0]
    what = "Stars are goals."
    if found.trained is not None:
        what = (
            f"What the trained agent of seed {one.seed}, the first of n = {result.n}, does in {EPISODES} greedy "
            "episodes of each task; one seed has no interval. Numbers and lines are as the legend says, where there is "
            "room for them. Stars are goals."
        )
    title = f"{result.agent}: the tasks' trees"
    tasks = left_out(len(found.curriculum.tasks), MOST_TREES, "tasks")
    return CaptionedFigure("trees", title, f"{title}. {what}{tasks}", draw_trees(found, one.seed))


def draw_trees(trees: Trees, seed: int) -> Any:
    """Draw each task's tree and goal, with the agent's visits and actions, if any."""
    assert trees.curriculum is not None
    tasks = list(zip(ct_graphs(trees.curriculum.tasks[:MOST_TREES], "a tree"), trees.curriculum.labels, strict=False))
    deepest = max(task.graph.depth for task, _ in tasks)
    per_row = trees.curriculum.evaluation.episodes_per_row
    episodes = per_row * math.ceil(EPISODES / per_row)
    grid = panels(len(tasks), COLUMNS, min(0.4 * (2 * deepest + 4), 5.0), room=0)
    for axes, (task, label) in zip(grid.ravel(), tasks, strict=False):
        seen = Visits({}, {})
        if trees.trained is not None:
            agent = trees.trained.agent
            policy = trees.trained.policy_for(task)
            seen = visits(
                task, policy, agent.initial_state, episodes, seed, episodes_per_row=per_row, curriculum=trees.curriculum
            )
        draw_task(axes, task, seen.counts, seen.actions, ids=False, legend=task is tasks[-1][0])
        axes.set_title(f"{short(label)}\n{axes.get_title()}")
    return grid[0, 0].figure


def find_trees(run: Run) -> Trees:
    """Return the agent and curriculum of a run's directory, if any."""
    try:
        curriculum = Curriculum.from_json(run.path / CURRICULUM)
    except (OSError, ValueError) as error:
        return Trees(None, None, str(error))
    if not are_graphs(curriculum.examples):
        kind = type(curriculum.examples[0]).__name__
        return Trees(None, None, f"they are of CT-graphs, and its tasks are of {kind}")
    if not (run.path / AGENT).exists():
        return Trees(curriculum, None, f"{run.path} has no {AGENT}, the weights of its agent")
    try:
        trained = load(run.path)
    except Exception as error:  # files of others fail in any way; the report says why
        return Trees(curriculum, None, " ".join(str(error).split()).rstrip(". ") or type(error).__name__)
    return Trees(trained.curriculum, trained, "")
