"""PPO: clipped policy gradients, without memory.

Schulman et al. 2017 (arXiv 1707.06347).
"""

from __future__ import annotations

from typing import Any

import torch
from torchrl.data import Composite, TensorSpec

from baselines.parts.learner import MOST_PASSES
from baselines.parts.networks import Data, TensorsByName
from baselines.parts.policy_gradient import PolicyGradient, critic_loss, entropy_loss
from ctgraph_rl.checks import at_least_one, at_most, is_int, not_negative, positive, require


class PPO(PolicyGradient):
    """PPO for tasks that need no memory.

    Args:
        observation_spec: the environment's ``observation_spec_unbatched``.
        action_spec: the environment's ``action_spec_unbatched``.
        clip_epsilon: how far the probability ratio may move.
        entropy_coeff: weight of the entropy bonus.
        critic_coeff: weight of the critic's loss, a mean squared error.
        num_epochs: passes over a batch.
        num_minibatches: minibatches of an epoch; they split the frames, or with memory the rows.
        settings: the arguments of `PolicyGradient`.
    """

    solves = "fully observable tasks (CT-FO)"

    def __init__(
        self,
        observation_spec: Composite,
        action_spec: TensorSpec,
        clip_epsilon: float,
        entropy_coeff: float,
        critic_coeff: float,
        num_epochs: int,
        num_minibatches: int,
        **settings: Any,
    ) -> None:
        require(
            *positive(clip_epsilon=clip_epsilon),
            *at_most(1, clip_epsilon=clip_epsilon),
            *not_negative(entropy_coeff=entropy_coeff, critic_coeff=critic_coeff),
            *at_least_one(num_epochs=num_epochs, num_minibatches=num_minibatches),
            *at_most(MOST_PASSES, num_epochs=num_epochs),
        )
        super().__init__(observation_spec, action_spec, **settings)
        items = self.num_envs if self.memory else self.num_envs * self.num_steps
        what = f"num_envs={self.num_envs}" if self.memory else f"num_envs * num_steps = {items}"
        splits = is_int(num_minibatches, 1) and items % num_minibatches == 0
        require((splits, f"{what} must be a multiple of num_minibatches={num_minibatches}"))
        self.num_epochs = num_epochs
        self.num_minibatches = num_minibatches
        self.entropy_coeff = entropy_coeff
        self.critic_coeff = critic_coeff
        self.clip_range = (
            torch.tensor([-clip_epsilon, clip_epsilon], dtype=torch.float32, device="cpu").log1p().tolist()
        )

    def loss(self, batch: Data) -> TensorsByName:
        """Compute the clipped surrogate, eq. (7), critic's and entropy losses, as TorchRL's `ClipPPOLoss` does."""
        log_probs, taken, values = self.evaluate_actions(batch)
        change = taken - batch["action_log_prob"].unsqueeze(-1)
        gain = change.exp() * batch["advantage"]
        clipped = change.clamp(*self.clip_range).exp() * batch["advantage"]
        return {
            "loss_objective": -torch.minimum(gain, clipped).mean(),
            "loss_critic": critic_loss(values, batch, self.critic_coeff),
            **entropy_loss(log_probs, self.entropy_coeff),
        }
