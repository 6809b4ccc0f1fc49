"""A2C: advantage actor-critic, one gradient step a batch, without memory.

Mnih et al. 2016 (arXiv 1602.01783), in its synchronous form.
"""

from __future__ import annotations

from dataclasses import dataclass

from typing_extensions import override

from baselines.parts.merge import mean
from baselines.parts.networks import Data, TensorsByName
from baselines.parts.policy_gradient import PolicyGradient, PolicyGradientSettings, critic_loss, entropy_loss
from ctgraph_rl.checks import not_negative, require


@dataclass(frozen=True, kw_only=True)
class A2CSettings(PolicyGradientSettings):
    """The settings of `A2C`; ``gae_lambda`` 1 gives the paper's returns of up to ``num_steps`` steps."""

    entropy_coeff: float  # weight of the entropy bonus
    critic_coeff: float  # weight of the critic's loss, a mean squared error

    def __post_init__(self) -> None:
        super().__post_init__()
        require(*not_negative(entropy_coeff=self.entropy_coeff, critic_coeff=self.critic_coeff))


class A2C(PolicyGradient):
    """A2C for tasks that need no memory."""

    Settings = A2CSettings
    solves = "fully observable tasks (CT-FO)"

    @override
    def loss(self, batch: Data) -> TensorsByName:
        frames, log_probs, taken, values = self.evaluate_actions(batch)
        return {
            "loss_objective": -mean(taken * frames["advantage"], frames),
            "loss_critic": critic_loss(values, frames, self.settings.critic_coeff),
            **entropy_loss(log_probs, frames, self.settings.entropy_coeff),
        }
