"""A2C: advantage actor-critic, one gradient step a batch, without memory.

Mnih et al. 2016 (arXiv 1602.01783), in its synchronous form, on TorchRL's `A2CLoss`.
"""

from __future__ import annotations

from torchrl.data import Composite, TensorSpec
from torchrl.objectives import A2CLoss

from baselines.policy_gradient import PolicyGradient, loss_weight
from ctgraph_rl.checks import require


class A2C(PolicyGradient):
    """A2C for tasks that need no memory.

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
        gae_lambda: lambda of the generalised advantage estimate; 1 gives the paper's returns of up to num_steps steps.
        normalize_advantage: give the advantages of a batch mean 0 and standard deviation 1.
        entropy_coeff: weight of the entropy bonus.
        critic_coeff: weight of the critic's loss, a mean squared error.
        max_grad_norm: gradients are scaled down to this norm.
    """

    solves = "what one observation tells: fully observable tasks (CT-FO)"

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
        gae_lambda: float,
        normalize_advantage: bool,
        entropy_coeff: float,
        critic_coeff: float,
        max_grad_norm: float,
    ) -> None:
        require(*loss_weight(entropy_coeff=entropy_coeff, critic_coeff=critic_coeff))
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
            gae_lambda,
            normalize_advantage,
            1,
            1,
            max_grad_norm,
        )
        self.objective = A2CLoss(
            self.actor,
            self.critic,
            entropy_coeff=entropy_coeff,
            critic_coeff=critic_coeff,
            loss_critic_type="l2",
            functional=False,
        )
