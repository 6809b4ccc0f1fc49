"""PPO with a bonus for observations that a network has not yet learned to predict, for exploration.

Random network distillation, Burda et al. 2019 (arXiv 1810.12894): a predictor g learns the outputs of a fixed random
network f. A step that leads to observation o' gets the bonus |g(o') - f(o')|^2, divided by the standard deviation of
its discounted returns. The bonus has a separate critic and discount factor, and its return does not end with an
episode. PPO learns from the advantages A + bonus_coeff A_bonus. Both networks read observations that are standardised
pixel by pixel and limited to [-5, 5]. Five things differ from the paper:

- Predictor and random network have the same shape.
- The critic of the bonus shares no layer with the policy, so that lifelong-learning methods act on the policy only.
- Predictor and critic of the bonus have a separate optimiser and learning rate.
- Each announced task starts with a new predictor, critic of the bonus and statistics.
- Statistics of observations start with the first batch, not with a random policy.

Beside PPO's, the agent holds 12 bytes for each weight of the predictor and of the bonus's critic, 4 for each weight of
the random network and each environment, and 16 for each pixel.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec
from typing_extensions import override

from baselines.cells.cell import linear_layer
from baselines.parts.learner import reset_layer
from baselines.parts.networks import Data, Items, TensorsByName, critic, encoder, highest
from baselines.parts.policy_gradient import Seeds, generalized_advantages
from baselines.ppo import PPO, PPOSettings
from baselines.update.update import make_optimiser, minimise
from ctgraph_rl.checks import NamedValues, at_least_one, fraction, not_negative, positive, require, require_memory

LARGEST_INPUT = 5.0


class Moments(nn.Module):
    """Mean and variance of all rows so far, in float64."""

    count: Tensor
    mean: Tensor
    variance: Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("count", torch.zeros((), dtype=torch.float64, device="cpu"))
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64, device="cpu"))
        self.register_buffer("variance", torch.zeros(size, dtype=torch.float64, device="cpu"))

    def reset(self) -> None:
        """Forget all rows."""
        for buffer in self.buffers():
            buffer.zero_()

    def update(self, rows: Tensor) -> None:
        """Add rows, [n, size], by the formula of Chan et al. 1979 for two sets."""
        rows = rows.to(self.mean.dtype)
        share = len(rows) / (self.count + len(rows))
        change = rows.mean(dim=0) - self.mean
        within = self.variance.lerp(rows.var(dim=0, correction=0), share)
        self.variance.copy_(within + change.square() * share * (1 - share))
        self.mean.add_(change * share)
        self.count.add_(len(rows))


class Novelty(nn.Module):
    """The fixed random network, its predictor, and the statistics that scale observations and bonuses.

    Args:
        hidden_size: width of the hidden layer of both networks.
        high: largest value of an observation.
        num_envs: environments, each with a discounted return of bonuses.
        gamma: discount factor of these returns.
    """

    returns: Tensor

    def __init__(
        self, num_inputs: int, hidden_size: int, num_features: int, high: float, num_envs: int, gamma: float
    ) -> None:
        super().__init__()
        self.num_inputs = num_inputs
        self.scale = 1 / high
        self.gamma = gamma
        self.target, self.predictor = (
            nn.Sequential(
                linear_layer(num_inputs, hidden_size),
                nn.ReLU(),
                linear_layer(hidden_size, num_features),
            )
            for _ in range(2)
        )
        self.target.requires_grad_(False)
        self.of_observations = Moments(num_inputs)
        self.of_returns = Moments(1)
        self.register_buffer("returns", torch.zeros(num_envs, dtype=torch.float32, device="cpu"))

    def reset(self) -> None:
        """Draw a new predictor, and reset the statistics."""
        self.predictor.apply(reset_layer)
        self.of_observations.reset()
        self.of_returns.reset()
        self.returns.zero_()

    def forward(self, observations: Tensor) -> Tensor:
        """Return the predictor's error at uint8 observations, float32 [n]: the mean square over features."""
        moments = self.of_observations
        inputs = (self._flat(observations) - moments.mean.float()) * (moments.variance + 1e-6).rsqrt().float()
        inputs = inputs.clamp(-LARGEST_INPUT, LARGEST_INPUT)
        return (self.predictor(inputs) - self.target(inputs)).square().mean(dim=-1)

    @torch.no_grad()
    def bonus(self, observations: Tensor) -> Tensor:
        """Return the bonus for observations, [num_envs, num_steps, ...]: float32 [num_envs, num_steps].

        The statistics include this batch.
        """
        self.of_observations.update(self._flat(observations))
        errors = self(observations).view(observations.shape[:2])
        discounted = []
        for error in errors.unbind(dim=1):
            self.returns.mul_(self.gamma).add_(error)
            discounted.append(self.returns.clone())
        self.of_returns.update(torch.cat(discounted).unsqueeze(-1))
        return errors / (self.of_returns.variance.sqrt().float() + 1e-8)

    def _flat(self, observations: Tensor) -> Tensor:
        return observations.reshape(-1, self.num_inputs).float() * self.scale


@dataclass(frozen=True, kw_only=True)
class PPORNDSettings(PPOSettings):
    """The settings of `PPORND`."""

    bonus_coeff: float  # weight of the advantages of the bonus
    bonus_gamma: float  # discount factor of the bonus
    num_features: int  # outputs of the random network and of its predictor, whose hidden layer is hidden_size wide
    bonus_learning_rate: float  # of Adam for the predictor and the critic of the bonus
    predictor_share: float  # share of each minibatch that the predictor learns from, at least one frame

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            *not_negative(bonus_coeff=self.bonus_coeff),
            *positive(bonus_gamma=self.bonus_gamma, bonus_learning_rate=self.bonus_learning_rate),
            *positive(predictor_share=self.predictor_share),
            *fraction(bonus_gamma=self.bonus_gamma, predictor_share=self.predictor_share),
            *at_least_one(num_features=self.num_features),
        )


class PPORND(PPO):
    """PPO with random network distillation."""

    Settings = PPORNDSettings
    solves = "fully observable tasks (CT-FO) whose goal random actions almost never reach"

    def __init__(self, observation_spec: Composite, action_spec: TensorSpec, **settings: Any) -> None:
        super().__init__(observation_spec, action_spec, **settings)
        given = self.settings
        spec = observation_spec["observation"]
        width = given.hidden_size
        size = width * (spec.shape.numel() + given.num_features)
        require_memory(f"weights of num_features={given.num_features}", 20 * size, "or smaller layers")
        shape = (spec.shape.numel(), width, given.num_features)
        self.novelty = Novelty(*shape, high=highest(spec), num_envs=self.num_envs, gamma=given.bonus_gamma)
        features = encoder(observation_spec, width, given.num_layers, kind=given.encoder)
        self.bonus_critic = TensorDictSequential(features, critic("features", width))
        self._make_bonus_optimiser()

    def _make_bonus_optimiser(self) -> None:
        learned = [*self.novelty.predictor.parameters(), *self.bonus_critic.parameters()]
        self.bonus_optimiser = make_optimiser("adam", learned, self.settings.bonus_learning_rate)

    def start_task(self, task: int | None = None) -> None:
        """Draw a new predictor and critic of the bonus, and reset their optimiser and all statistics."""
        self.novelty.reset()
        self.bonus_critic.apply(reset_layer)
        self._make_bonus_optimiser()

    def bonus_values(self, data: Data) -> Tensor:
        """Return the values of the bonus at any number of steps, [..., 1]."""
        features, head = self.bonus_critic
        return head.module(features.over_time(data))

    def minibatches(self, batch: TensorDictBase) -> Iterator[Items]:
        """Yield the minibatches of all epochs; predictor and critic of the bonus learn from each before PPO."""
        for minibatch in super().minibatches(batch):
            observations = minibatch.pop("next_observation")
            target = minibatch.pop("bonus_target")
            used = max(1, round(self.settings.predictor_share * len(observations)))  # the frames are shuffled
            error = (self.bonus_values(minibatch) - target).square().mean()
            minimise(self.bonus_optimiser, error + self.novelty(observations[:used]).mean())
            yield minibatch

    @torch.no_grad()
    def with_advantage(self, batch: TensorDictBase, seeds: Seeds) -> TensorsByName:
        """Add the observations that the predictor learns from, and the targets of the bonus's critic."""
        advantage, target = self.bonus_advantages(batch)
        given = super().with_advantage(batch.copy().set("bonus_advantage", advantage), seeds)
        return given | {"bonus_target": target, "next_observation": batch["next", "observation"]}

    def advantages(self, batch: TensorDictBase, *given: Tensor) -> tuple[Tensor, Tensor]:
        """Return the sum of the reward's and the weighted bonus's advantages, and the critic's targets."""
        advantage, target = super().advantages(batch, *given)
        return advantage + self.settings.bonus_coeff * batch["bonus_advantage"], target

    def bonus_advantages(self, batch: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return the bonus's advantages and its critic's targets, [num_envs, num_steps, 1] each.

        Returns continue over the ends of episodes.
        """
        bonus = self.novelty.bonus(batch["next", "observation"]).unsqueeze(-1)
        values = self.bonus_values(batch)
        last = {key: batch["next", key][:, -1:] for key in self.trunk.in_keys}
        following = torch.cat([values[:, 1:], self.bonus_values(last)], dim=1)
        never = torch.zeros_like(batch["next", "done"])
        given = (values, following, bonus, never, never)
        return generalized_advantages(self.settings.bonus_gamma, self.settings.gae_lambda, *given)

    @override
    def get_extra_state(self) -> NamedValues:
        return {**super().get_extra_state(), "bonus_optimiser": self.bonus_optimiser.state_dict()}

    @override
    def set_extra_state(self, state: NamedValues) -> None:
        super().set_extra_state(state)
        self.bonus_optimiser.load_state_dict(state["bonus_optimiser"])
