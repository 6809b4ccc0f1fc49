"""Raw results of the experiments with memory cells, and what `memory_cells` and `memory_ladder` say of each run."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from studies.raw import Raw, machine_of

SEEDS = 5

TAIL = 40_960
"""The last frames of a run, over whose training episodes the training return and the training length are means."""

SOLVED = 0.9
"""The least greedy return of a seed that solves a task; the optimum is 1."""

AGENTS = {
    "lstm_ppo": "LSTM",
    "lstm_ppo-gru": "GRU",
    "lstm_ppo-min_gru": "minGRU",
    "lstm_ppo-amrl_max": "AMRL-Max",
    "lstm_ppo-amrl_avg": "AMRL-Avg",
    "lstm_ppo-backpropamine": "Backpropamine",
    "lstm_ppo-attention": "attention",
    "lstm_ppo-frames": "frame stacking",
    "lstm_ppo-none": "PPO (no memory)",
    "a2c, 8 steps": "A2C (8 steps)",
    "a2c, 32 steps": "A2C (32 steps)",
    "reinforce, 8 steps": "REINFORCE (8 steps)",
    "reinforce, 128 steps": "REINFORCE (128 steps)",
    "dqn, 1 step": "DQN (1 step)",
    "dqn, 6 steps": "DQN (6 steps)",
    "qrdqn_lstm": "QRDQN+LSTM",
    "mohqa": "MOHQA",
}
"""Names of agents with their cells, in the order of the page; PPO where no other algorithm is named."""

LADDER_CELLS = [name for name in AGENTS if name.startswith("lstm_ppo") and name != "lstm_ppo-attention"]
"""Agents on the ladder."""

STEPS = {"dqn": "n_steps", "a2c": "num_steps", "reinforce": "num_steps"}
"""The setting that tells the runs of an agent apart: the steps of its targets, or of its batches."""

SETTINGS = ("num_envs", "num_steps", "learning_rate", "entropy_coeff")
"""What differs between runs on the ladder: the environments, the steps of a sequence, learning rate, entropy bonus."""


def measured(run: Path) -> dict[str, Any]:
    """Return the line of a finished run: its condition, its final returns, and how soon it was near the optimum."""
    from ctgraph_rl.log.files import LOG
    from ctgraph_rl.log.run_log import RunLog

    log = RunLog.read(run / LOG)
    about, metrics = log.of_kind("run")[0], json.loads((run / "metrics.json").read_text(encoding="utf-8"))
    evaluations, training = log.of_kind("evaluation"), log.of_kind("training")
    frames, best = training[-1]["frames"], metrics["optimal_performance"]["value"]
    last = [line for line in training if line["frames"] > frames - TAIL and line["episodes"]]
    reached = (line["frames"] for line in evaluations if line["return_mean"] >= SOLVED * best)
    gap = metrics["memory_gap_closed"]
    return {
        "agent": agent_of(run, about["config"]),
        "seed": about["config"]["seed"],
        **condition(about["config"]),
        "frames": frames,
        "greedy_return": evaluations[-1]["return_mean"],
        **{f"training_{name}": round(_mean_over(last, f"{name}_mean"), 6) for name in ("return", "length")},
        **({"frames_to_90": next(reached, "")} if len(evaluations) > 1 else {}),
        "memory_gap_closed": gap["value"] if gap["value"] is not None else gap["undefined"],
        "optimum": best,
        "ceiling_without_memory": metrics["memoryless_ceiling"]["value"],
        **machine_of(about),
    }


def _mean_over(lines: list[dict[str, Any]], key: str) -> float:
    """Return a mean over the episodes of some lines of a log."""
    return sum(line[key] * line["episodes"] for line in lines) / sum(line["episodes"] for line in lines)


def agent_of(run: Path, config: dict[str, Any]) -> str:
    """Return the key of `AGENTS` for a run."""
    name = run.name.split("-seed")[0]
    if name not in STEPS:
        return name
    steps = config["agent"][STEPS[name]]
    return f"{name}, 1 step" if steps == 1 else f"{name}, {steps} steps"


def condition(config: dict[str, Any]) -> dict[str, Any]:
    """Return the columns that tell conditions apart: those of the ladder if a run is of it, else those of a graph."""
    curriculum = config["curriculum"]
    if curriculum["expected_length"]:
        graph = {key: curriculum[key] for key in ("depth", "expected_length")}
        return graph | {key: config["agent"][key] for key in SETTINGS}
    graph = {key: curriculum[key] for key in ("wait_prob", "unique_decisions", "num_wait_images")}
    return graph | {"guide_frames": config["protocol"]["guide_frames"] or 0, "read_noise": curriculum["read_noise"]}


def returns(lines: Raw) -> list[float]:
    """Return the greedy return of each seed."""
    return [float(line["greedy_return"]) for line in lines]


def solved(lines: Raw) -> list[bool]:
    """Return for each seed whether it solves the task after training."""
    return [value >= SOLVED for value in returns(lines)]


def solved_once(lines: Raw) -> list[bool]:
    """Return for each seed whether it solves the task at any evaluation."""
    return [bool(line["frames_to_90"]) for line in lines]


def mean(lines: Raw, key: str) -> float:
    """Return the mean of a column over seeds."""
    return sum(float(line[key]) for line in lines) / len(lines)


def count(lines: Raw | None) -> str:
    """Return how many seeds solve the task after training, as ``4 of 5``."""
    return f"{sum(solved(lines))} of {len(lines)}" if lines else "not run"


def ranking(of: Mapping[str, Raw]) -> str:
    """Return the agents by how many seeds solve the task after training, as ``4 of 5: LSTM, GRU; 0 of 5: A2C``."""
    by_count: dict[int, list[str]] = {}
    for name, lines in of.items():
        by_count.setdefault(sum(solved(lines)), []).append(AGENTS[name])
    last = min(by_count, default=0)
    if len(by_count) == 1:
        return f"{last} of {SEEDS} with all {len(of)} agents"
    parts = [f"{number} of {SEEDS}: {', '.join(by_count[number])}" for number in sorted(by_count, reverse=True)]
    if len(by_count[last]) > 4:
        parts[-1] = f"{last} of {SEEDS}: the other {len(by_count[last])}"
    return "; ".join(parts)
