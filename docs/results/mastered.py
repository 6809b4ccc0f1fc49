"""What runs of the lifelong tables have mastered, and when, as their page reads it from the raw results."""

from __future__ import annotations

import comparison
import pairs
import torch
from raw import groups, read

from ctgraph_rl.metrics import MASTERED, Curves
from ctgraph_rl.report import statistics

METHODS = ("finetune", "ewc_published", "mask_lc", "mask_ri", "mask_blc")
GOALS = {
    "masks_ct8": ["000", "001", "010", "011", "100", "101", "110", "111"],
    "masks_ct12": ["00", "000", "01", "001", "10", "010", "11", "011", "100", "101", "110", "111"],
    "masks_ct8_md": ["00", "01", "000", "001", "0000", "0001", "00000", "00001"],
}


class Table:
    """The raw results of a comparison; runs of a method are in the order of their seeds."""

    def __init__(self, name: str):
        of = groups(read(name), "method", "seed")
        found = {(method, int(seed)): comparison.curves(lines) for (method, seed), lines in sorted(of.items())}
        self.curves = {who: [run for (other, _), run in found.items() if other == who] for who, _ in found}
        self.experts = torch.stack([run.performance for run in self.curves["expert"]])
        self.alone = self.experts.mean((0, 1))
        self.goals = GOALS[name]

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
        tasks = range(len(self.alone))
        return torch.stack([torch.stack([run.own_stage(task) for task in tasks]) for run in self.curves[method]])

    def areas(self, method: str) -> torch.Tensor:
        """float64 [seeds, tasks]: mean return over a task's own block."""
        return self.stages(method).mean(-1)

    def gain(self, method: str) -> torch.Tensor:
        """float64 [seeds, tasks]: over the experts' mean."""
        return self.areas(method) - self.alone

    def early_shares(self, method: str) -> list[float]:
        """The share of each run's TPOT that it has in tasks which have not begun."""
        shares = []
        for run in self.curves[method]:
            begun = torch.tensor(run.blocks)[:, None] > torch.arange(len(self.alone))
            shares.append(((run.performance * ~begun).sum() / run.performance.sum()).item())
        return shares

    def names(self, mastered: torch.Tensor) -> list[set[str]]:
        """The goals that are mastered, for each seed."""
        return [{goal for goal, known in zip(self.goals, seed, strict=True) if known} for seed in mastered.tolist()]

    def since_success(self, *methods: str) -> torch.Tensor:
        """bool [N]: whether a task is mastered, at all evaluations that follow the first success in its block."""
        stages = torch.cat([self.stages(method).flatten(0, 1) for method in methods])
        return torch.cat([stage[int(stage.double().argmax()) + 1 :] for stage in stages >= MASTERED if stage.any()])

    def transfer_of_mask_lc(self) -> tuple[float, float]:
        """Its forward transfer on CT8 multi-depth: as in the table, and with the first task."""
        transfer = (self.gain("mask_lc") / (1 - self.alone)).mean(0)
        return transfer[2:].mean().item(), transfer[[0, 2, 3, 4, 5, 6, 7]].mean().item()

    def claims_hold_of_the_means(self) -> bool:
        """Whether masks know more at the end than others, and combinations have more while learning than new masks."""
        known = {method: self.known(method).double().mean() for method in METHODS}
        learning = {method: self.areas(method).mean() for method in METHODS[2:]}
        better = min(known[mask] for mask in METHODS[2:]) > max(known[other] for other in METHODS[:2])
        return bool(better) and all(learning[mask] > learning["mask_ri"] for mask in ("mask_lc", "mask_blc"))

    @staticmethod
    def p_value(first: torch.Tensor, second: torch.Tensor) -> float | None:
        """The p-value of the paired test of two methods, a number for each seed."""
        return statistics.compare(first.tolist(), second.tolist()).p_value

    @staticmethod
    def clear_pairs() -> int:
        """How many differences that the paper claims are distinguishable over the pairs of the three curricula."""
        corrected = statistics.holm([each.p_value for each in pairs.claims().values()])
        return sum(p is not None and p <= 0.05 for p in corrected)

    def beyond_beginnings(self) -> list[set[str]]:
        """What fine-tuning on CT12 has at the end of each block of a goal of depth 3 beyond it and its beginning.

        Raises:
            ValueError: if it has not both.
        """
        more = []
        for place, goal in enumerate(self.goals):
            for known in self.names(self.ends("finetune")[:, place]) if len(goal) == 3 else []:
                if not {goal, goal[:2]} <= known:
                    raise ValueError(f"{goal} without itself or its beginning: {known}")
                more.append(known - {goal, goal[:2]})
        return more


class ByAgent:
    """The raw results of methods by agents."""

    def __init__(self):
        self.of = groups(read("methods"), "curriculum", "method", "agent", "seed")
        self.swept = comparison.expected("methods")

    def runs(self, axis: str, method: str, agent: str) -> list[Curves]:
        """Runs of one cell."""
        cell = (f"fo_b1_{axis}", method, agent)
        return [comparison.curves(lines) for key, lines in self.of.items() if key[:3] == cell]

    def known(self, axis: str, method: str, agent: str) -> torch.Tensor:
        """bool [seeds, tasks]: what is mastered at the end."""
        return torch.stack([run.performance[-1] >= MASTERED for run in self.runs(axis, method, agent)])

    def own(self, axis: str, method: str, agent: str) -> torch.Tensor:
        """bool [seeds, tasks]: what is mastered at the end of its block."""
        return torch.stack([run.ends[1:].diagonal() >= MASTERED for run in self.runs(axis, method, agent)])
