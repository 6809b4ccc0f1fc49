"""A2C: advantage actor-critic, one gradient step a batch, without memory.

Mnih et al. 2016 (arXiv 1602.01783), in its synchronous form.
"""

from __future__ import annotations

from typing import Any

from torchrl.data import Composite, TensorSpec

from baselines.parts.networks import Data, TensorsByName
from baselines.parts.policy_gradient import PolicyGradient, critic_loss, entropy_loss
from ctgraph_rl.checks import not_negative, require


class A2C(PolicyGradient):
    """A2C for tasks that need no memory.

    Args:
        observation_spec: the environment's ``observation_spec_unbatched``.
        action_spec: the environment's ``action_spec_unbatched``.
        entropy_coeff: weight of the entropy bonus.
        critic_coeff: weight of the critic's loss, a mean squared error.
        settings: the arguments of `PolicyGradient`; a batch is one gradient step, and ``gae_lambda`` 1 gives the
            paper's returns of up to ``num_steps`` steps.
    """

    solves = "fully observable tasks (CT-FO)"

    def __init__(
        self,
        observation_spec: Composite,
        action_spec: TensorSpec,
        entropy_coeff: float,
        critic_coeff: float,
        **settings: Any,
    ) -> None:
        require(*not_negative(entropy_coeff=entropy_coeff, critic_coeff=critic_coeff))
        super().__init__(observation_spec, action_spec, **settings)
        self.entropy_coeff = entropy_coeff
        self.critic_coeff = critic_coeff

    def loss(self, batch: Data) -> TensorsByName:
        """Compute the losses of policy, critic and entropy, as TorchRL's `A2CLoss` does."""
        log_probs, taken, values = self.evaluate_actions(batch)
        return {
            "loss_objective": -(taken * batch["advantage"]).mean(),
            "loss_critic": critic_loss(values, batch, self.critic_coeff),
            **entropy_loss(log_probs, self.entropy_coeff),
        }
