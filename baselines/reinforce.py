"""REINFORCE: policy gradients of whole returns minus a learned baseline; one gradient step a batch, no memory.

Williams 1992 (Machine Learning 8, 229-256). Batches should be several times as long as an episode: one that the end of
a batch cuts off is bootstrapped with the baseline's value. There is no bonus for entropy.
"""

from __future__ import annotations

from baselines.parts.merge import mean
from baselines.parts.networks import Data, TensorsByName
from baselines.parts.policy_gradient import PolicyGradient, critic_loss


class Reinforce(PolicyGradient):
    """REINFORCE for tasks that need no memory; the arguments are those of `PolicyGradient`."""

    solves = "fully observable tasks (CT-FO)"

    def loss(self, batch: Data) -> TensorsByName:
        """Compute the losses of policy and baseline, as TorchRL's `ReinforceLoss` does."""
        frames, _, taken, values = self.evaluate_actions(batch)
        return {
            "loss_actor": -mean(taken * frames["advantage"], frames),
            "loss_value": critic_loss(values, frames, 1.0),
        }
