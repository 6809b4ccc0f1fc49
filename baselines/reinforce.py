"""REINFORCE: the policy's gradient from whole returns less a learned baseline; one gradient step a batch, no memory.

Williams 1992 (Machine Learning 8, 229-256) on TorchRL's `ReinforceLoss`. An episode that the end of a batch cuts
counts with the baseline's value in place of what would have followed; there is no bonus for entropy.
"""

from __future__ import annotations

from typing import Any

from torchrl.data import Composite, TensorSpec
from torchrl.objectives import ReinforceLoss

from baselines.policy_gradient import PolicyGradient


class Reinforce(PolicyGradient):
    """REINFORCE for tasks that need no memory.

    Args:
        observation_spec: the environment's ``observation_spec_unbatched``.
        action_spec: the environment's ``action_spec_unbatched``.
        settings: the arguments of `PolicyGradient`; a batch is one gradient step.
    """

    solves = "what one observation tells: fully observable tasks (CT-FO)"
    loss_keys = ("loss_actor", "loss_value")

    def __init__(self, observation_spec: Composite, action_spec: TensorSpec, **settings: Any) -> None:
        super().__init__(observation_spec, action_spec, **settings)
        self.objective = ReinforceLoss(self.actor, self.critic, loss_critic_type="l2", functional=False)
