"""A2C: advantage actor-critic, one gradient step a batch, without memory.

Mnih et al. 2016 (arXiv 1602.01783), in its synchronous form, on TorchRL's `A2CLoss`.
"""

from __future__ import annotations

from typing import Any

from torchrl.data import Composite, TensorSpec
from torchrl.objectives import A2CLoss

from baselines.policy_gradient import PolicyGradient, loss_weight
from ctgraph_rl.checks import require


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

    solves = "what one observation tells: fully observable tasks (CT-FO)"

    def __init__(
        self,
        observation_spec: Composite,
        action_spec: TensorSpec,
        entropy_coeff: float,
        critic_coeff: float,
        **settings: Any,
    ) -> None:
        require(*loss_weight(entropy_coeff=entropy_coeff, critic_coeff=critic_coeff))
        super().__init__(observation_spec, action_spec, **settings)
        self.objective = A2CLoss(
            self.actor,
            self.critic,
            entropy_coeff=entropy_coeff,
            critic_coeff=critic_coeff,
            loss_critic_type="l2",
            functional=False,
        )
