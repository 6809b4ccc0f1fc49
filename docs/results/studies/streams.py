"""A life of a hundred tasks: streams.md."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from statistics import fmean

from ctgraph_rl.draw.style import new_figure, save_figure
from studies.raw import Raw, fill, groups, machines, mean_of, read, select, shown, table
from studies.verdicts import Effect

NAME = "streams"
TRIALS = "streams_trials"

AGENTS = {"ppo": "PPO", "lstm_ppo": "LSTM-PPO", "dqn": "DQN"}
METHODS = {
    "finetune": "fine-tuned",
    "frozen": "frozen",
    "ewc": "EWC",
    "mask_ri": "Mask RI",
    "scratch": "new weights",
}
K = {"first_tenth": "", "whole_life": ", k = 100"}
NUM_WINDOWS = 10
SHARES = (0.0, 1.0)

EWC_OF_ALL = "EWC: more than fine-tuned, k = 100"

LESS = 0.1
"""Of a share of tasks, the smallest difference that counts."""


def runs() -> dict[tuple[str, ...], Raw]:
    """Return the lines of all seeds by agent and method, with rates chosen by a tenth of the life."""
    return groups([line for line in read(NAME) if line["k"] == "10"], "agent", "method")


def chosen(agent: str, method: str, part: str) -> str:
    """Return the learning rate with the largest mean return in ``first_tenth`` or ``whole_life``."""
    by_rate = groups(select(read(TRIALS), agent=agent, method=method), "learning_rate")
    [rate] = max(by_rate, key=lambda rate: _mean(by_rate[rate], part))
    return rate


def _mean(lines: Raw, column: str) -> float:
    return fmean(float(line[column]) for line in lines if line[column])


def tuned_on_all(method: str) -> Raw:
    """Return PPO's lines of all seeds with the rate that the whole life chooses."""
    wanted = ("ppo", method, chosen("ppo", method, "whole_life"))
    return [line for line in read(NAME) if (line["agent"], line["method"], line["learning_rate"]) == wanted]


def solved(line: dict[str, str]) -> list[float]:
    """Return the share of tasks solved at the end of their blocks in each window."""
    return [float(line[f"solved_{window}"]) for window in range(1, NUM_WINDOWS + 1)]


def table_of_runs() -> str:
    """Return a row for each agent and method: means over seeds with their intervals."""
    rows = []
    named = {}
    for (agent, method), lines in runs().items():
        if method != "frozen":
            named[f"{AGENTS[agent]}, {METHODS[method]}"] = lines
    named["PPO, fine-tuned, k = 100"] = tuned_on_all("finetune")
    for name, lines in named.items():
        per_frame = _mean(lines, "frame_regret") / frames(lines[0])
        seconds = _mean(lines, "cpu_seconds") / int(lines[0]["num_tasks"])
        rows.append(
            [
                name,
                mean_of([fmean(solved(line)) for line in lines], SHARES),
                f"{fmean(solved(line)[-1] for line in lines):.2f}",
                f"{_mean(lines, 'retention_1'):.2f}",
                f"{_mean(lines, 'retention_10'):.2f}",
                f"{per_frame:.3f}",
                f"{seconds:.1f}",
            ]
        )
    head = ["learner", "solved", "last window", "kept after 1", "after 10", "regret per frame"]
    return table([*head, "CPU seconds a task"], rows)


def table_of_trials() -> str:
    """Return a row for each learner that was tuned, on both parts of a life: the objective by learning rate."""
    rows = []
    for part in K:
        for (agent, method), lines in groups(read(TRIALS), "agent", "method").items():
            if lines[0][part]:
                means = [f"{_mean(of_rate, part):.3f}" for of_rate in groups(lines, "learning_rate").values()]
                rows.append([f"{AGENTS[agent]}, {METHODS[method]}{K[part]}", *means])
    return table(["learner", "0.001", "0.003", "0.01"], rows)


def frames(line: dict[str, str]) -> int:
    """Return the frames of a life."""
    return int(line["num_tasks"]) * int(line["num_frames"])


def claims() -> dict[tuple[str, str], Effect]:
    """Return the effect in the direction of each sentence on an agent, with a value for each seed."""
    found = runs()
    values = {}
    for (agent, method), lines in found.items():
        if method == "finetune":
            losses = [solved(line)[0] - solved(line)[-1] for line in lines]
            values["fine-tuned: fewer of the last ten than of the first", agent] = losses
        else:
            values[f"{METHODS[method]}: more than fine-tuned", agent] = _gains(lines, found[agent, "finetune"])
    whole = tuned_on_all("finetune")
    values["fine-tuned: more with k = 100 than with k = 10", "ppo"] = _gains(whole, found["ppo", "finetune"])
    values[EWC_OF_ALL, "ppo"] = _gains(tuned_on_all("ewc"), whole)
    return {sentence: Effect(own, LESS, room=1.0) for sentence, own in values.items()}


def table_of_claims(effects: Mapping[tuple[str, str], Effect]) -> str:
    """Return a row for each sentence: the difference by agent."""
    rows = []
    for sentence in dict.fromkeys(sentence for sentence, _ in effects):
        known = [effects.get((sentence, agent)) for agent in AGENTS]
        rows.append([sentence, *("" if effect is None else shown(effect.estimate) for effect in known)])
    return table(["tasks solved", *AGENTS.values()], rows)


def counts() -> dict[str, str]:
    """Return the tasks that were solved, means over seeds, by ``AGENT_METHOD``; of the first and last ten behind it."""
    found = {}
    for (agent, method), lines in runs().items():
        name = f"{agent}_{method}"
        found[name] = tasks_solved(lines)
        found[f"{name}_first"] = f"{10 * fmean(solved(line)[0] for line in lines):.0f}"
        found[f"{name}_last"] = f"{10 * fmean(solved(line)[-1] for line in lines):.0f}"
    return found


def _gains(lines: Raw, others: Raw) -> list[float]:
    before = {line["seed"]: fmean(solved(line)) for line in others}
    return [fmean(solved(line)) - before[line["seed"]] for line in lines if line["seed"] in before]


def tasks_solved(lines: Raw) -> str:
    """Return how many of a hundred tasks were solved, the mean over seeds."""
    return f"{100 * fmean(fmean(solved(line)) for line in lines):.0f}"


def draw(folder: Path) -> None:
    """Draw the share of tasks solved by window, a panel for each agent, means over seeds."""
    found = runs()
    figure = new_figure(7.2, 2.6)
    panels = figure.subplots(1, len(AGENTS), sharey=True)
    for axes, (agent, name) in zip(panels, AGENTS.items(), strict=True):
        for position, (method, words) in enumerate(METHODS.items()):
            lines = [solved(line) for line in found.get((agent, method), [])]
            if lines:
                means = [fmean(values) for values in zip(*lines, strict=True)]
                axes.plot(range(1, NUM_WINDOWS + 1), means, color=f"C{position}", linewidth=1, label=words)
        if agent == "ppo":
            means = [fmean(values) for values in zip(*map(solved, tuned_on_all("finetune")), strict=True)]
            axes.plot(range(1, NUM_WINDOWS + 1), means, "--C0", linewidth=1, label="fine-tuned, k = 100")
        axes.set_title(name, fontsize=9)
        axes.set(xlabel="window of 10 tasks", xticks=(1, 4, 7, 10), ylim=(-0.05, 1.05))
    panels[0].set_ylabel("share of tasks solved")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=4, fontsize=7)
    save_figure(figure, folder / "streams.png", 220)


def page() -> str:
    """Return the page."""
    lines = read(NAME)
    effects = claims()
    texts = {
        "table": table_of_runs(),
        "trials": table_of_trials(),
        "whole_finetune": chosen("ppo", "finetune", "whole_life"),
        "ppo_whole": tasks_solved(tuned_on_all("finetune")),
        "ewc_whole": tasks_solved(tuned_on_all("ewc")),
        "claims": table_of_claims(effects),
        "lead_10": shown(effects["EWC: more than fine-tuned", "ppo"].estimate),
        "lead_100": shown(effects[EWC_OF_ALL, "ppo"].estimate),
        "frames": f"{int(lines[0]['num_frames']):,}",
        "machines": machines(NAME),
    }
    return fill(NAME, counts() | texts)
