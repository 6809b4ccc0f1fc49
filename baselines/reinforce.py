"""REINFORCE: policy gradients of whole returns minus a learned baseline; one gradient step a batch, no memory.

Williams 1992 (Machine Learning 8, 229-256). Batches should be several times as long as an episode: the baseline's value
stands for what a batch's end cuts off. There is no bonus for entropy.
"""

from __future__ import annotations

from typing_extensions import override

from baselines.parts.merge import mean
from baselines.parts.networks import Data, TensorsByName
from baselines.parts.policy_gradient import PolicyGradient, critic_loss


class Reinforce(PolicyGradient):
    """REINFORCE for tasks that need no memory; arguments as in `PolicyGradient`."""

    solves = "fully observable tasks (CT-FO)"

    @override
    def loss(self, batch: Data) -> TensorsByName:
        frames, _, taken, values = self.evaluate_actions(batch)
        return {
            "loss_actor": -mean(taken * frames["advantage"], frames),
            "loss_value": critic_loss(values, frames, 1.0),
        }
