"""REINFORCE: the policy's gradient from whole returns less a learned baseline; one gradient step a batch, no memory.

Williams 1992 (Machine Learning 8, 229-256) on TorchRL's `ReinforceLoss`. An episode that the end of a batch cuts
counts with the baseline's value in place of what would have followed; there is no bonus for entropy.
"""

from __future__ import annotations

from torchrl.data import Composite, TensorSpec
from torchrl.objectives import ReinforceLoss

from baselines.policy_gradient import PolicyGradient


class Reinforce(PolicyGradient):
    """REINFORCE for tasks that need no memory.

    Args:
        observation_spec: the environment's ``observation_spec_unbatched``.
        action_spec: the environment's ``action_spec_unbatched``.
        num_envs: rows that it learns from.
        num_steps: steps of each row in a batch, which is one gradient step.
        hidden_size: width of all layers.
        num_layers: layers before the heads.
        optimiser: ``adam`` or ``rmsprop``.
        learning_rate: of the optimiser.
        gamma: discount factor.
        normalize_advantage: give the advantages of a batch mean 0 and standard deviation 1.
        max_grad_norm: gradients are scaled down to this norm.
    """

    solves = "what one observation tells: fully observable tasks (CT-FO)"
    loss_keys = ("loss_actor", "loss_value")

    def __init__(
        self,
        observation_spec: Composite,
        action_spec: TensorSpec,
        num_envs: int,
        num_steps: int,
        hidden_size: int,
        num_layers: int,
        optimiser: str,
        learning_rate: float,
        gamma: float,
        normalize_advantage: bool,
        max_grad_norm: float,
    ) -> None:
        super().__init__(
            observation_spec,
            action_spec,
            num_envs,
            num_steps,
            hidden_size,
            num_layers,
            optimiser,
            learning_rate,
            gamma,
            1.0,
            normalize_advantage,
            1,
            1,
            max_grad_norm,
        )
        self.objective = ReinforceLoss(self.actor, self.critic, loss_critic_type="l2", functional=False)
