"""PPO: clipped policy gradients, without memory.

Schulman et al. 2017 (arXiv 1707.06347).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torchrl.data import Composite, TensorSpec

from baselines.parts.learner import MOST_PASSES
from baselines.parts.merge import mean
from baselines.parts.networks import Data, TensorsByName
from baselines.parts.policy_gradient import PolicyGradient, PolicyGradientSettings, critic_loss, entropy_loss
from ctgraph_rl.checks import at_least_one, at_most, not_negative, positive, require


@dataclass(frozen=True, kw_only=True)
class PPOSettings(PolicyGradientSettings):
    """The settings of `PPO`."""

    clip_epsilon: float  # how far the probability ratio may move
    entropy_coeff: float  # weight of the entropy bonus
    critic_coeff: float  # weight of the critic's loss, a mean squared error
    num_epochs: int  # passes over a batch
    num_minibatches: int  # minibatches of an epoch; they split the frames, or with memory the rows

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            *positive(clip_epsilon=self.clip_epsilon),
            *at_most(1, clip_epsilon=self.clip_epsilon),
            *not_negative(entropy_coeff=self.entropy_coeff, critic_coeff=self.critic_coeff),
            *at_least_one(num_epochs=self.num_epochs, num_minibatches=self.num_minibatches),
            *at_most(MOST_PASSES, num_epochs=self.num_epochs),
        )


class PPO(PolicyGradient):
    """PPO for tasks that need no memory."""

    Settings: ClassVar[Any] = PPOSettings
    solves = "fully observable tasks (CT-FO)"

    def __init__(self, observation_spec: Composite, action_spec: TensorSpec, **settings: Any) -> None:
        super().__init__(observation_spec, action_spec, **settings)
        self.num_epochs = self.settings.num_epochs
        self.num_minibatches = number = self.settings.num_minibatches
        items = self.num_envs if self.memory else self.num_envs * self.num_steps
        what = f"num_envs={self.num_envs}" if self.memory else f"num_envs * num_steps = {items}"
        require((items % number == 0, f"{what} must be a multiple of num_minibatches={number}"))
        epsilon = self.settings.clip_epsilon
        self.clip_range = torch.tensor([-epsilon, epsilon], dtype=torch.float32, device="cpu").log1p().tolist()

    def loss(self, batch: Data) -> TensorsByName:
        """Return the losses of the clipped surrogate, eq. (7), critic and entropy, as TorchRL's `ClipPPOLoss`."""
        frames, log_probs, taken, values = self.evaluate_actions(batch)
        change = taken - frames["action_log_prob"].unsqueeze(-1)
        gain = change.exp() * frames["advantage"]
        clipped = change.clamp(*self.clip_range).exp() * frames["advantage"]
        return {
            "loss_objective": -mean(torch.minimum(gain, clipped), frames),
            "loss_critic": critic_loss(values, frames, self.settings.critic_coeff),
            **entropy_loss(log_probs, frames, self.settings.entropy_coeff),
        }
