"""PPO: clipped policy gradients, without memory.

Schulman et al. 2017 (arXiv 1707.06347) on TorchRL's `ClipPPOLoss`.
"""

from __future__ import annotations

from torchrl.data import Composite, TensorSpec
from torchrl.objectives import ClipPPOLoss

from baselines.policy_gradient import PolicyGradient, loss_weight
from ctgraph_rl.checks import positive, require


class PPO(PolicyGradient):
    """PPO for tasks that need no memory.

    Args:
        observation_spec: the environment's ``observation_spec_unbatched``.
        action_spec: the environment's ``action_spec_unbatched``.
        num_envs: rows that it learns from.
        num_steps: steps of each row in a batch; with memory, the length of the sequences.
        hidden_size: width of all layers, the LSTM's too.
        num_layers: layers before the heads, or before the LSTM.
        optimiser: ``adam`` or ``rmsprop``.
        learning_rate: of the optimiser.
        gamma: discount factor.
        gae_lambda: lambda of the generalised advantage estimate.
        normalize_advantage: give the advantages of a batch mean 0 and standard deviation 1.
        clip_epsilon: how far the probability ratio may move.
        entropy_coeff: weight of the entropy bonus.
        critic_coeff: weight of the critic's loss, a mean squared error.
        num_epochs: passes over a batch.
        num_minibatches: minibatches a pass; they split the frames, or with memory the rows.
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
        clip_epsilon: float,
        entropy_coeff: float,
        critic_coeff: float,
        num_epochs: int,
        num_minibatches: int,
        max_grad_norm: float,
    ) -> None:
        require(
            *positive(clip_epsilon=clip_epsilon), *loss_weight(entropy_coeff=entropy_coeff, critic_coeff=critic_coeff)
        )
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
            num_epochs,
            num_minibatches,
            max_grad_norm,
        )
        self.objective = ClipPPOLoss(
            self.actor,
            self.critic,
            clip_epsilon=clip_epsilon,
            entropy_coeff=entropy_coeff,
            critic_coeff=critic_coeff,
            loss_critic_type="l2",
            functional=False,
        )
