"""REINFORCE: the policy's gradient from whole returns less a learned baseline; one gradient step a batch, no memory.

Williams 1992 (Machine Learning 8, 229-256). An episode that the end of a batch cuts
counts with the baseline's value in place of what would have followed; there is no bonus for entropy.
"""

from __future__ import annotations

from torch import Tensor

from baselines.networks import Data
from baselines.policy_gradient import PolicyGradient, critic_loss


class Reinforce(PolicyGradient):
    """REINFORCE for tasks that need no memory; the arguments are those of `PolicyGradient`."""

    solves = "what one observation tells: fully observable tasks (CT-FO)"

    def loss(self, batch: Data) -> dict[str, Tensor]:
        """Policy gradient and the baseline's error, as TorchRL's `ReinforceLoss` has them."""
        _, taken, values = self.judged(batch)
        return {
            "loss_actor": -(taken * batch["advantage"]).mean(),
            "loss_value": critic_loss(values, batch, 1.0),
        }
