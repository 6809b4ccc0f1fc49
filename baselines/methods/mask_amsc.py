"""AMSC: modulating masks that combine the most similar tasks, by a sparsemax.

After facts about the public repository DMIU-ShELL/AMSC at commit 075e23e of 2026-07-02, without its code. There is no
paper with a public text.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from typing_extensions import override

from baselines.methods.parts.selection import STREAM, SelectedMasks, own_generator
from ctgraph_rl.checks import NamedValues, at_least_one, one_of, positive, require, true_or_false
from ctgraph_rl.learn.evaluate import evaluate

DISTANCES = ("cosine", "l2")
EPISODES = ("training", "evaluation", "none")

SMALLEST_DEVIATION = 1e-3


class MaskAMSC(SelectedMasks):
    """`SelectedMasks` with the support of a sparsemax: w = sparsemax(t / temperature), selected are those with w > 0.

    t are the similarities to all earlier tasks, standardised over them, without those of tasks whose competence is 0. A
    task's competence is its mean training return in its last batches, or as in AMSC the mean return of an evaluation
    after the task: an oracle's, as a learner has no episodes that do not count. Of one or two earlier tasks exactly one
    is selected.

    Args:
        distance: ``cosine`` of the embeddings is the similarity, or minus their Euclidean distance, ``l2``.
        z_score: standardise similarities over the earlier tasks.
        temperature: of the sparsemax.
        competence: of ``training`` or ``evaluation`` episodes; ``none`` leaves out no task.
        competence_batches: batches of a mean training return.
        shuffled: select as many tasks at random instead, by its own random stream.
        settings: arguments of `SelectedMasks`.
    """

    needs_episodes = True

    def __init__(
        self,
        distance: str,
        z_score: bool,
        temperature: float,
        competence: str,
        competence_batches: int,
        shuffled: bool,
        **settings: Any,
    ) -> None:
        super().__init__(**settings)
        require(
            *one_of(DISTANCES, distance=distance),
            *one_of(EPISODES, competence=competence),
            *true_or_false(z_score=z_score, shuffled=shuffled),
            *positive(temperature=temperature),
            *at_least_one(competence_batches=competence_batches),
        )
        self.distance = distance
        self.z_score = z_score
        self.temperature = temperature
        self.episodes = competence
        self.shuffled = shuffled
        self.reads_tasks = "evaluations of the task that ends" if competence == "evaluation" else ""
        self.competence: dict[int, float] = {}
        """Of the tasks that have ended, by slot."""

        self.returns: deque[tuple[float, int]] = deque(maxlen=competence_batches)
        """Summed returns and numbers of the episodes that ended in the last batches."""

    @override
    def setup(self) -> None:
        super().setup()
        self.shuffle = own_generator(STREAM + 1)

    @override
    def start_task(self, task: int | None) -> None:
        super().start_task(task)
        self.returns.clear()

    @override
    def on_batch(self, batch: TensorDictBase) -> None:
        super().on_batch(batch)
        after = batch["next"]
        ended = after["episode_reward"][after["done"]]
        self.returns.append((float(ended.sum()), ended.numel()))

    @override
    def end_task(self) -> None:
        super().end_task()
        found = self._evaluated() if self.episodes == "evaluation" else self._trained()
        self.competence[self.slot] = min(max(found, 0.0), 1.0)

    def _trained(self) -> float:
        total = sum(returns for returns, _ in self.returns)
        number = sum(count for _, count in self.returns)
        return total / max(number, 1)

    def _evaluated(self) -> float:
        how = self.curriculum.evaluation
        agent = self.agent
        played = evaluate(
            agent.policy,
            [self.task_in(self.slot)],
            how.num_episodes,
            greedy=how.greedy,
            episodes_per_row=how.episodes_per_row,
            seed=self.slot,
            initial_state=agent.initial_state,
            device=self.weights.device,
            curriculum=self.curriculum,
        )
        return played["episode_reward"].mean().item()

    @override
    def choose(self) -> list[int]:
        known = self.embeddings
        earlier = [slot for slot in range(self.num_combined) if slot in known]
        if self.slot not in known or not earlier:
            return []
        t = similarities(known[self.slot], torch.stack([known[slot] for slot in earlier]), self.distance)
        if self.z_score:
            t = standardised(t)
        has_learned = [self.episodes == "none" or self.competence[slot] > 0 for slot in earlier]
        able = t.new_tensor(has_learned, dtype=torch.bool)
        candidates = torch.tensor(earlier, dtype=torch.int64, device="cpu")[able]
        support = candidates[sparsemax(t[able] / self.temperature) > 0]
        if self.shuffled:
            order = torch.randperm(len(candidates), generator=self.shuffle, device="cpu")
            support = candidates[order[: len(support)]]
        return support.tolist()

    @override
    def get_extra_state(self) -> NamedValues:
        own = {"competence": dict(self.competence), "returns": list(self.returns), "shuffle": self.shuffle.get_state()}
        return {**super().get_extra_state(), **own}

    @override
    def set_extra_state(self, state: NamedValues) -> None:
        super().set_extra_state(state)
        self.competence = dict(state["competence"])
        self.returns.clear()
        self.returns.extend((total, number) for total, number in state["returns"])
        self.shuffle.set_state(state["shuffle"].cpu())


def similarities(embedding: Tensor, others: Tensor, distance: str) -> Tensor:
    """Return the similarities of an embedding of norm 1, [Z], to others, [n, Z]: [n]."""
    return others @ embedding if distance == "cosine" else -(others - embedding).norm(dim=1)


def standardised(values: Tensor) -> Tensor:
    """Return values minus their mean, by their standard deviation or `SMALLEST_DEVIATION`, [n]."""
    return (values - values.mean()) / values.std(correction=0).clamp(min=SMALLEST_DEVIATION)


def sparsemax(values: Tensor) -> Tensor:
    """Return the probabilities nearest to values, [n], most of which are 0.

    Martins and Astudillo 2016 (arXiv 1602.02068): w = max(z - tau, 0), tau = (sum of the K largest - 1) / K, with the
    largest K that has 1 + K z_(K) > sum of the K largest.
    """
    ordered = values.sort(descending=True).values
    counts = torch.arange(1, len(values) + 1, device="cpu")
    sums = ordered.cumsum(0)
    held = (1 + counts * ordered > sums).nonzero().flatten()
    if not len(held):  # no values
        return values
    last = held[-1]
    return (values - (sums[last] - 1) / counts[last]).clamp(min=0.0)
