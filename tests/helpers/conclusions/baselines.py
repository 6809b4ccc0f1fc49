"""What baselines.md says in short, and what raw results must be for it."""

from __future__ import annotations

from statistics import fmean

from studies.baselines.page import searching
from studies.raw import groups, numbers_in, read

from helpers.conclusions.sentences import Sentences

says = Sentences()

SOLVED = 0.9
NEAR = 0.05
"""A mean over five seeds that is so near to an exact limit is at it."""

WITHOUT_MEMORY = ("ppo", "a2c", "ppo_count")


def changes(way: str) -> dict[tuple[str, ...], float]:
    """Return by how much instances change the mean return of a cell, by configuration, goal and agent."""
    means = []
    for name in ("baselines_b1", "baselines_b1_instances"):
        cells = groups(read(name), "configuration", "task", "agent")
        means.append({key: fmean(numbers_in(lines, f"{way}_return")) for key, lines in cells.items()})
    constant, instances = means
    return {key: mean - constant[key] for key, mean in instances.items()}


@says(
    "With memory an agent learns every goal of the paper's small configurations within 204,800 frames: LSTM-PPO does "
    "in all seeds but one."
)
def _() -> bool:
    lines = [line for line in read("baselines_b1") if line["agent"] == "lstm_ppo"]
    missed = [line for line in lines if float(line["greedy_success"]) < SOLVED]
    return (len(lines), len(missed)) == (80, 1) and {line["frames"] for line in lines} == {"204800"}


@says("Without memory, greedy agents reach the exact limit of deterministic policies without memory, and no more.")
def _() -> bool:
    from ctgraph_rl.tasks.configurations import CONFIGURATIONS

    cells = groups(read("baselines_b1"), "configuration", "task", "agent")
    away = []
    for (configuration, goal, agent), lines in cells.items():
        if agent in WITHOUT_MEMORY:
            make = CONFIGURATIONS["CT-" + configuration.upper().replace("_", "-")]
            task = make(goal=tuple(map(int, goal.split("."))))
            limit = task.memoryless_ceiling(deterministic=True)
            away.append(abs(fmean(numbers_in(lines, "greedy_return")) - limit))
    return len(away) == 48 and max(away) < NEAR


@says("On four goals in a row LSTM-PPO forgets each goal in the next block.")
def _() -> bool:
    lines = [line for line in read("main_job") if line["block"] != "0"]
    known = {(line["label"], line["block"]) for line in lines if float(line["return_mean"]) >= SOLVED}
    return known == {("goal1.1", "1"), ("goal1.2", "2"), ("goal2.1", "3"), ("goal2.2", "4")}


@says("Noise and rotation of observations cost no agent anything in greedy episodes.")
def _() -> bool:
    return min(changes("greedy").values()) >= 0


@says("and at depth 3 in none.")
def _() -> bool:
    return sum(searching("2")) >= 4 and sum(searching("3")) == 0


@says(
    "From depth 4 on exploration stops plain agents. Only `ppo_count`, with a bonus for rare observations, is reliable."
)
def _() -> bool:
    deep = [line for line in read("depth_ladder") + read("rnd_depth") if int(line["depth"]) >= 4]
    of = groups(deep, "agent", "depth")
    learned = {key: [value >= SOLVED for value in numbers_in(lines, "sampled_success")] for key, lines in of.items()}
    plain = sum(any(learned[agent, depth]) for agent in ("ppo", "ppo_published") for depth in ("4", "5"))
    reliable = {agent for agent, _ in learned if all(all(learned[agent, depth]) for depth in ("4", "5"))}
    return plain <= 1 and reliable == {"ppo_count"}
