"""A life of a hundred tasks: streams.md."""

from __future__ import annotations

from pathlib import Path
from statistics import fmean

from ctgraph_rl.draw.style import new_figure, save_figure
from studies.raw import Raw, fill, groups, machines, mean_of, read, table
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
NUM_WINDOWS = 10
SHARES = (0.0, 1.0)

LESS = 0.1
"""Of a share of tasks, the smallest difference that counts."""


def runs() -> dict[tuple[str, ...], Raw]:
    """Return the lines of all seeds by agent and method, with rates chosen by a tenth of the life."""
    return groups([line for line in read(NAME) if line["k"] == "10"], "agent", "method")


def trials() -> dict[tuple[str, ...], Raw]:
    """Return the tuning runs over whole lives by method and learning rate."""
    return groups(read(TRIALS), "method", "learning_rate")


def chosen(method: str, part: str) -> str:
    """Return the learning rate with the largest mean return in ``first_tenth`` or ``whole_life``."""
    means = {}
    for (name, rate), lines in trials().items():
        if name == method:
            means[rate] = fmean(float(line[part]) for line in lines)
    return max(means, key=lambda rate: means[rate])


def tuned_on_all(method: str) -> Raw:
    """Return PPO's lines of all seeds with the rate that the whole life chooses."""
    wanted = ("ppo", method, chosen(method, "whole_life"))
    return [line for line in read(NAME) if (line["agent"], line["method"], line["learning_rate"]) == wanted]


def solved(line: dict[str, str]) -> list[float]:
    """Return the share of tasks solved at the end of their blocks in each window."""
    return [float(line[f"solved_{window}"]) for window in range(1, NUM_WINDOWS + 1)]


def mean_of_known(lines: Raw, column: str) -> str:
    """Return the mean of a metric over the seeds in which it is defined."""
    return f"{fmean(float(line[column]) for line in lines if line[column]):.2f}"


def table_of_runs() -> str:
    """Return a row for each agent and method: means over seeds with their intervals."""
    rows = []
    named = {}
    for (agent, method), lines in runs().items():
        if method != "frozen":
            named[f"{AGENTS[agent]}, {METHODS[method]}"] = lines
    named["PPO, fine-tuned, k = 100"] = tuned_on_all("finetune")
    for name, lines in named.items():
        per_frame = [float(line["frame_regret"]) / frames(line) for line in lines]
        seconds = [float(line["cpu_seconds"]) / int(line["num_tasks"]) for line in lines if line["cpu_seconds"]]
        rows.append(
            [
                name,
                str(len(lines)),
                mean_of([fmean(solved(line)) for line in lines], SHARES),
                f"{fmean(solved(line)[0] for line in lines):.2f}",
                f"{fmean(solved(line)[-1] for line in lines):.2f}",
                mean_of_known(lines, "retention_1"),
                mean_of_known(lines, "retention_10"),
                f"{fmean(per_frame):.3f}",
                f"{fmean(seconds):.1f}" if seconds else "-",
            ]
        )
    head = ["learner", "seeds", "solved", "first window", "last window", "kept after 1", "after 10", "regret per frame"]
    return table([*head, "CPU seconds a task"], rows)


def table_of_trials() -> str:
    """Return a row for each learning rate: the objective of tuning runs on both parts of a life."""
    rows: dict[str, list[str]] = {}
    for (_, rate), lines in trials().items():
        for part in ("first_tenth", "whole_life"):
            rows.setdefault(rate, [rate]).append(f"{fmean(float(line[part]) for line in lines):.3f}")
    head = [f"{METHODS[method]}, k = {k}" for method in ("finetune", "ewc") for k in (10, 100)]
    return table(["rate", *head], list(rows.values()))


def frames(line: dict[str, str]) -> int:
    """Return the frames of a life."""
    return int(line["num_tasks"]) * int(line["num_frames"])


def claims() -> str:
    """Return a row for each sentence with its verdict."""
    found = runs()
    rows = []
    for agent, name in AGENTS.items():
        losses = [solved(line)[0] - solved(line)[-1] for line in found.get((agent, "finetune"), [])]
        rows.append(_claim(f"{name}, fine-tuned, solves fewer of the last tasks than of the first", losses))
        for method in ("ewc", "mask_ri", "scratch"):
            gains = _gains(found.get((agent, method), []), found.get((agent, "finetune"), []))
            rows.append(_claim(f"{name} solves more tasks with {METHODS[method]} than fine-tuned", gains))
        on = _gains(found.get((agent, "finetune"), []), found.get((agent, "frozen"), []))
        rows.append(_claim(f"{name}, fine-tuned, solves more tasks than frozen", on))
    whole = tuned_on_all("finetune")
    longer = _gains(whole, found["ppo", "finetune"])
    rows.append(_claim("PPO, fine-tuned, solves more tasks if tuned on the whole life than on a tenth", longer))
    more = _gains(whole, tuned_on_all("ewc"))
    rows.append(_claim("PPO, tuned on the whole life, solves more tasks fine-tuned than with EWC", more))
    return table(["sentence", "difference", "verdict"], [row for row in rows if row])


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


def _claim(sentence: str, values: list[float]) -> list[str]:
    effect = Effect(values, LESS, room=1.0)
    return [sentence, mean_of(values, effect.bounds), effect.verdict] if len(values) > 1 else []


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
    rates = {AGENTS[line["agent"]]: line["learning_rate"] for line in lines if line["k"] == "10"}
    texts = {
        "table": table_of_runs(),
        "trials": table_of_trials(),
        "whole_finetune": chosen("finetune", "whole_life"),
        "ppo_whole": tasks_solved(tuned_on_all("finetune")),
        "ewc_whole": tasks_solved(tuned_on_all("ewc")),
        "claims": claims(),
        "rates": ", ".join(f"{name} {rate}" for name, rate in rates.items()),
        "frames": f"{int(lines[0]['num_frames']):,}",
        "machines": machines(NAME),
    }
    return fill(NAME, counts() | texts)
