"""What runs of the lifelong tables have mastered, and when, as their page reads it from the raw results."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from studies.lifelong import comparison, pairs
from studies.raw import groups, read

from ctgraph_rl.metrics import MASTERED, Curves
from ctgraph_rl.report import statistics

GOALS = {
    "masks_ct8": ["1.1.1", "1.1.2", "1.2.1", "1.2.2", "2.1.1", "2.1.2", "2.2.1", "2.2.2"],
    "masks_ct12": ["1.1", "1.1.1", "1.2", "1.1.2", "2.1", "1.2.1", "2.2", "1.2.2", "2.1.1", "2.1.2", "2.2.1", "2.2.2"],
    "masks_ct8_md": ["1.1", "1.2", "1.1.1", "1.1.2", "1.1.1.1", "1.1.1.2", "1.1.1.1.1", "1.1.1.1.2"],
}


class Table:
    """The raw results of a comparison; runs of a method are in the order of their seeds."""

    def __init__(self, name: str):
        self.name = name
        of = groups(read(name), "method", "seed")
        found = {(method, int(seed)): comparison.curves(lines) for (method, seed), lines in sorted(of.items())}
        self.curves = {who: [run for (other, _), run in found.items() if other == who] for who, _ in found}
        self.experts = torch.stack([run.performance for run in self.curves["expert"]])
        self.goals = GOALS[name.rpartition("/")[2]]

    def ends(self, method: str) -> torch.Tensor:
        """bool [seeds, blocks, tasks]: what is mastered after each block."""
        return torch.stack([run.ends[1:] >= MASTERED for run in self.curves[method]])

    def own(self, method: str) -> torch.Tensor:
        """bool [seeds, tasks]: what is mastered at the end of its block."""
        return self.ends(method).diagonal(dim1=1, dim2=2)

    def known(self, method: str) -> torch.Tensor:
        """bool [seeds, tasks]: what is mastered at the very end."""
        return self.ends(method)[:, -1]

    def stages(self, method: str) -> torch.Tensor:
        """float64 [seeds, tasks, evaluations]: each task in its own block."""
        tasks = range(len(self.goals))
        return torch.stack([torch.stack([run.own_stage(task) for task in tasks]) for run in self.curves[method]])

    def areas(self, method: str) -> torch.Tensor:
        """float64 [seeds, tasks]: mean return over a task's own block."""
        return self.stages(method).mean(-1)

    def names(self, mastered: torch.Tensor) -> list[set[str]]:
        """The goals that are mastered, for each seed."""
        return [{goal for goal, known in zip(self.goals, seed, strict=True) if known} for seed in mastered.tolist()]

    def mean_areas(self) -> dict[str, float]:
        """The mean return of each method over all blocks."""
        return {method: self.areas(method).mean().item() for method in pairs.METHODS}

    def compare_areas(self) -> dict[tuple[str, str], statistics.Comparison]:
        """All pairs of methods by the mean return over all blocks, as the page compares them."""
        return pairs.compare_areas(self.name)

    def pairs_of_areas(self) -> dict[tuple[str, str], float | None]:
        """The corrected p-values of all pairs of methods by the mean return over all blocks."""
        return {pair: found.holm for pair, found in self.compare_areas().items()}

    @staticmethod
    def p_value(first: torch.Tensor, second: torch.Tensor) -> float | None:
        """The p-value of the paired test of two methods, a number for each seed."""
        return statistics.compare(first.tolist(), second.tolist()).p_value


class ByAgent:
    """The raw results of methods by agents."""

    def __init__(self) -> None:
        self.of = groups(read("methods"), "curriculum", "method", "agent", "seed")

    def runs(self, axis: str, method: str, agent: str) -> list[Curves]:
        """Runs of one cell, in the order of their seeds."""
        cell = (f"fo_b1_{axis}", method, agent)
        found = {int(key[3]): lines for key, lines in self.of.items() if key[:3] == cell}
        return [comparison.curves(lines) for _, lines in sorted(found.items())]

    def known(self, axis: str, method: str, agent: str) -> torch.Tensor:
        """bool [seeds, tasks]: what is mastered at the end."""
        return torch.stack([run.performance[-1] >= MASTERED for run in self.runs(axis, method, agent)])

    def own(self, axis: str, method: str, agent: str) -> torch.Tensor:
        """bool [seeds, tasks]: what is mastered at the end of its block."""
        return torch.stack([run.ends[1:].diagonal() >= MASTERED for run in self.runs(axis, method, agent)])

    def against_finetuning(self, agents: Sequence[str]) -> dict[str, statistics.Comparison]:
        """Each method against fine-tuning with some agents on each curriculum."""
        return pairs.against_finetuning(agents)

    def keeps_and_finds(self, methods: Sequence[str]) -> tuple[bool, list[int]]:
        """Whether PPO with each method keeps all depths that it learned, and in how many seeds it learns the last."""
        own, known = ([of("depth2to5", method, "ppo") for method in methods] for of in (self.own, self.known))
        return all(map(torch.equal, own, known)), [int(each[:, -1].sum()) for each in own]
