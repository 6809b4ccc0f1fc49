"""EWC: elastic weight consolidation with the diagonal of the Fisher information.

Kirkpatrick et al. 2017 (PNAS, arXiv 1612.00796), eq. (3); online as Schwarz et al. 2018 (arXiv 1805.06370).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor
from typing_extensions import override

from baselines.methods.parts.importance import SampledImportance, learnt_steps, num_learnt
from baselines.methods.parts.weights import flat
from baselines.parts.learner import Learner
from baselines.parts.networks import Data
from baselines.update.compiled import compiled
from baselines.update.update import total_loss
from ctgraph_rl.checks import fraction, one_of, require, true_or_false


class EWC(SampledImportance):
    """Adds lambda/2 * sum_i F_i (w_i - a_i)^2 for earlier tasks; F is the diagonal of the Fisher information.

    Separate: a term for each earlier task k, with F_k and weights a_k. Their sum is exactly one term: F = sum_k F_k, a
    = sum_k F_k a_k / F. Online: F is the running mean alpha F + (1 - alpha) F_k, which begins at 0, and a are the
    weights at the end of the last task; Schwarz et al. have the sum gamma F + F_k.

    Args:
        coeff: lambda.
        online: one running term; False: a term for each task.
        alpha: share of the earlier tasks in the running mean, in [0, 1].
        fisher: ``policy``: F_i = E[sum_action pi(action|s) (d log pi(action|s) / d w_i)^2] over the samples, in closed
            form over actions; a Q-learner's policy is the softmax of its values. ``loss``: the squares of the gradients
            of the agent's losses on minibatches, summed up and divided by the size of a minibatch, as in the code of
            Ben-Iwhiwhu et al. 2023: it grows with the number of samples.
        settings: ``num_samples`` and ``heads`` of `SampledImportance`.
    """

    stackable = True

    def __init__(self, coeff: float, online: bool, alpha: float, fisher: str, **settings: Any) -> None:
        require(*true_or_false(online=online), *fraction(alpha=alpha), *one_of(("policy", "loss"), fisher=fisher))
        super().__init__(coeff=coeff, **settings)
        self.online = online
        self.alpha = alpha
        self.fisher = fisher
        self.coeff = coeff / 2
        if fisher == "policy":
            self.agent_members += ("outputs",)

    @override
    def task_importance(self) -> Tensor:
        if self.fisher == "policy":
            return self.mean(self._of_policy)
        squares = torch.zeros_like(self.importance)
        compiles = getattr(self.agent, "compiled_step", None) is not None
        for minibatch in self.samples.minibatches:
            usual = compiles and len(minibatch["action"]) == self.agent.minibatch_size
            add = compiled(add_squared_gradients) if usual else add_squared_gradients
            add(self.agent, minibatch, self.weights.parameters, squares, max(num_learnt(minibatch), 1))
        return squares

    @override
    def consolidate(self, new: Tensor, weights: Tensor) -> None:
        if not self.online:
            total = self.importance + new
            moved = torch.where(total > 0, (self.importance * self.anchor + new * weights) / total, weights)
            self.importance.copy_(total)
            self.anchor.copy_(moved)
            return
        self.importance.copy_(self.alpha * self.importance + (1 - self.alpha) * new)
        self.anchor.copy_(weights)

    def _of_policy(self, item: Data) -> Iterator[Tensor]:
        for step in learnt_steps(self.agent.outputs(item)["log_probs"], item):
            for log_prob in step:
                yield log_prob.exp().detach() * self.gradient(log_prob).square()


def add_squared_gradients(
    agent: Learner, minibatch: Data, weights: Sequence[Tensor], squares: Tensor, num_items: int
) -> None:
    """Add to ``squares``, [P], the squared gradients of an agent's losses on a minibatch, over its number of items."""
    gradients = torch.autograd.grad(total_loss(agent.loss(minibatch)), weights, materialize_grads=True)
    squares += flat(gradients).square() / num_items
