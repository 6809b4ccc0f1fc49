"""What the experiments with memory cells say of each run."""

from __future__ import annotations

from collections.abc import Mapping

from studies.raw import Raw

SEEDS = 5

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

SETTINGS = ("num_envs", "num_steps", "learning_rate", "entropy_coeff")
"""What differs between runs on the ladder: the environments, the steps of a sequence, learning rate, entropy bonus."""


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
