"""MOHQA: a modulated Hebbian network (MOHN) beside a Q-network, for rewards that come long after decisions.

Ladosz et al. 2021, "Deep reinforcement learning with modulated Hebbian plus Q-network architecture" (IEEE TNNLS, arXiv
1909.09902). Features phi of an observation give action values q = sigmoid(W_q relu(phi)), learned by gradients, and u =
sigmoid(W_h y) with y = tanh(phi + noise - average), which is not. It acts greedily on q + u, or at random. After y,
average <- d average + (1 - d) phi.

After each action the eligibility decays, E <- exp(-1 / tau) E. Its row of that action changes by +c where y is largest,
by -c where it is smallest, and by -h elsewhere. E = 0 at the start of an episode. With reward r, W_h <- clip(W_h +
(sign(r) - b) E, -1, 1). Targets are r + gamma max(q' + u') with a copy of all weights and the transition's stored
average. The published loss is |q - target|^2: the prediction lacks u, and q, at most 1, cannot reach a target above 1.
``predict_sum`` corrects it to |q + u - target|^2 with a constant u.

One environment and batches of one step give the paper's updates exactly. With more, W_h changes after the batch, step
by step, by the sum over environments; each has an E and an average, and a new one starts with the mean average. State
takes 4 num_features (num_actions + 1) bytes an environment, W_h and its copy 8 num_features num_actions.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torch.nn.functional import one_hot
from torchrl.data import Composite, TensorSpec
from torchrl.modules import EGreedyModule
from typing_extensions import override

from baselines.cells.cell import linear_layer
from baselines.parts.networks import (
    Data,
    EncoderModule,
    Items,
    TensorsByName,
    encoder,
    guided,
    is_greedy,
    num_actions_of,
    require_weights,
)
from baselines.parts.q_learning import QLearner, QLearnerSettings, require_replay
from ctgraph_rl.checks import at_least_one, at_most, fraction, not_negative, positive, require, true_or_false

STATE = ("eligibility", "average", "trial")
"""The state of an environment; by ``trial`` the average lasts over episodes."""

RMSPROP_ALPHA = 0.95
RMSPROP_EPS = 0.01


@dataclass(frozen=True, kw_only=True)
class MOHQASettings(QLearnerSettings):
    """The settings of `MOHQA`."""

    num_features: int  # width of phi
    predict_sum: bool  # predict q + u, as the targets do; False: only q, as published
    eligibility_steps: float  # tau, over which eligibility falls to 1/e
    hebbian_share: float  # share of the features, rounded up, whose eligibility rises, and of those whose falls
    hebbian_change: float  # by how much
    hebbian_decay: float  # by how much that of the other features falls
    reward_baseline: float  # b, what is taken from the sign of a reward
    average_decay: float  # d, of the running average of phi
    noise_std: float  # standard deviation of the noise while acting
    noise_share: float  # probability of a feature to get noise

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            *at_least_one(num_features=self.num_features),
            *positive(eligibility_steps=self.eligibility_steps),
            *true_or_false(predict_sum=self.predict_sum),
            *not_negative(hebbian_share=self.hebbian_share, hebbian_change=self.hebbian_change),
            *not_negative(hebbian_decay=self.hebbian_decay),
            *not_negative(reward_baseline=self.reward_baseline, noise_std=self.noise_std),
            *fraction(average_decay=self.average_decay, noise_share=self.noise_share),
            *at_most(0.5, hebbian_share=self.hebbian_share),
        )


class Projected(nn.Module):
    """An encoder and a linear layer."""

    def __init__(self, encoder: nn.Module, num_inputs: int, num_features: int) -> None:
        super().__init__()
        self.encoder = encoder
        self.linear = linear_layer(num_inputs, num_features)

    @override
    def forward(self, *inputs: Tensor) -> Tensor:
        return self.linear(self.encoder(*inputs))


class HebbianHead(nn.Module):
    """The weights W_h, and how eligibility and weights change."""

    weights: Tensor

    def __init__(self, settings: MOHQASettings, num_actions: int) -> None:
        super().__init__()
        self.settings = settings
        self.decay = math.exp(-1 / settings.eligibility_steps)
        weights = torch.zeros(num_actions, settings.num_features, dtype=torch.float32, device="cpu")
        self.register_buffer("weights", weights)

    def forward(self, y: Tensor) -> Tensor:
        """Return u, [..., num_actions], from y, [..., num_features]."""
        return nn.functional.linear(y, self.weights).sigmoid()

    def eligibility(self, before: Tensor, y: Tensor, action: Tensor) -> Tensor:
        """Return the eligibility after an action, [n, num_actions, num_features]; y is [n, num_features]."""
        number = (self.settings.hebbian_share * y.count_nonzero(dim=-1).to(y.dtype)).ceil().unsqueeze(-1)
        place = y.argsort(dim=-1).argsort(dim=-1)
        largest = place >= y.shape[-1] - number
        smallest = place < number
        others = ~(largest | smallest)
        rise = self.settings.hebbian_change * (largest.to(y.dtype) - smallest.to(y.dtype))
        row = rise - self.settings.hebbian_decay * others.to(y.dtype)
        taken = one_hot(action, len(self.weights)).unsqueeze(-1)
        return self.decay * before + taken * row.unsqueeze(-2)

    def modulate(self, eligibility: Tensor, reward: Tensor) -> None:
        """Change the weights step by step.

        Args:
            eligibility: after each step, [num_envs, num_steps, num_actions, num_features].
            reward: of each step, [num_envs, num_steps, 1].
        """
        modulation = (reward.sign() - self.settings.reward_baseline).unsqueeze(-1)
        for change in (modulation * eligibility).sum(dim=0):
            self.weights.add_(change).clamp_(-1, 1)


class ModulatedGreedy(TensorDictModuleBase):
    """The policy: greedy on q + u, with exploration; writes eligibility and average.

    Args:
        head: computes q, an ``nn.Module`` in a TensorDictModule.
    """

    def __init__(
        self,
        trunk: EncoderModule,
        head: TensorDictModule,
        hebbian: HebbianHead,
        exploration: EGreedyModule,
        settings: MOHQASettings,
    ) -> None:
        super().__init__()
        self.greedy = TensorDictSequential(trunk, head)
        self.hebbian = hebbian
        self.exploration = exploration
        self.settings = settings
        self.in_keys = [*trunk.in_keys, "is_init", *STATE]
        self.out_keys = ["action", *(("next", key) for key in STATE)]

    @override
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        features = self.features(tensordict)
        average = tensordict["average"]
        noisy = features
        if not is_greedy():
            noise = self.settings.noise_std * torch.randn_like(features)
            noisy = features + noise * (torch.rand_like(features) < self.settings.noise_share)
        y = (noisy - average).tanh()
        tensordict.set("action", (self.head(features) + self.hebbian(y)).argmax(dim=-1))
        tensordict = self.exploration(tensordict)
        tensordict.set("action", guided(tensordict, tensordict["action"]))
        before = tensordict["eligibility"] * ~tensordict["is_init"].unsqueeze(-1)
        after = self.hebbian.eligibility(before, y, tensordict["action"])
        tensordict.set(("next", "eligibility"), after)
        tensordict.set(("next", "average"), average.lerp(features, 1 - self.settings.average_decay))
        return tensordict.set(("next", "trial"), tensordict["trial"])

    def features(self, data: Data) -> Tensor:
        """Return phi at any number of steps, [..., num_features]."""
        return self.greedy[0].over_time(data)

    def head(self, features: Tensor) -> Tensor:
        """Return q, [..., num_actions]."""
        return self.greedy[1].module(features)


class MOHQA(QLearner):
    """A Q-network with a modulated Hebbian network beside it."""

    Settings = MOHQASettings
    needs_episodes = True
    solves = "fully observable tasks (CT-FO); its traces reach over waits that look alike"

    policy: ModulatedGreedy
    average: Tensor
    target_weights: Tensor

    def __init__(self, observation_spec: Composite, action_spec: TensorSpec, **settings: Any) -> None:
        super().__init__(observation_spec, action_spec, **settings)
        given = self.settings
        num_actions = num_actions_of(action_spec)
        inner = encoder(observation_spec, given.hidden_size, kind=given.encoder)
        projected = Projected(inner.module, given.hidden_size, given.num_features)
        trunk = EncoderModule(projected, in_keys=inner.in_keys, out_keys=["features"])
        layers = nn.Sequential(nn.ReLU(), linear_layer(given.num_features, num_actions), nn.Sigmoid())
        head = TensorDictModule(layers, in_keys=["features"], out_keys=["action_value"])
        self.hebbian = HebbianHead(given, num_actions)
        self.register_buffer("target_weights", self.hebbian.weights.clone())
        self.register_buffer("average", torch.zeros(given.num_features, dtype=torch.float32, device="cpu"))
        network = TensorDictSequential(trunk, head)
        self.set_networks(network, action_spec)
        self.policy = ModulatedGreedy(trunk, head, self.hebbian, self.exploration, given)
        rate = given.learning_rate
        self.optimiser = torch.optim.RMSprop(network.parameters(), rate, alpha=RMSPROP_ALPHA, eps=RMSPROP_EPS)

    @override
    def require_room(self, observation_spec: Composite, num_actions: int) -> None:
        given = self.settings
        require_weights(observation_spec, given.hidden_size, 1, given.num_features)
        require_replay(observation_spec, given.buffer_size, given.batch_size, 2 * given.num_features)

    def initial_state(self, num_envs: int) -> TensorDict:
        """Return no eligibility, and the environments' mean average."""
        weights = self.hebbian.weights
        average = self.average.expand(num_envs, -1)
        state = {"eligibility": weights.new_zeros(num_envs, *weights.shape), "average": average.clone()}
        return TensorDict({**state, "trial": weights.new_zeros(num_envs, 1)}, batch_size=[num_envs])

    @override
    def reset_parameters(self) -> None:
        super().reset_parameters()
        self.hebbian.weights.zero_()
        self.average.zero_()

    @override
    def other_weights(self) -> TensorsByName:
        return {**super().other_weights(), "hebbian.weights": self.target_weights}

    @override
    def weights_changed(self) -> None:
        super().weights_changed()
        self.target_weights.copy_(self.hebbian.weights)

    def values(self, data: Data) -> Tensor:
        """Return q + u, where u is a constant, [..., num_actions]."""
        features = self.policy.features(data)
        return self.policy.head(features) + self.hebbian((features - data["average"]).tanh()).detach()

    def minibatches(self, batch: TensorDictBase) -> Iterator[Items]:
        """Change W_h by a batch's rewards; store it, and yield replayed minibatches."""
        self.hebbian.modulate(batch["next", "eligibility"], batch["next", "reward"])
        self.average.copy_(batch["next", "average"][:, -1].mean(dim=0))
        yield from super().minibatches(batch)

    @override
    def with_targets(self, batch: TensorDictBase) -> TensorDictBase:
        """One step needs none of `MultiStep`'s slow operations."""
        if self.multi_step.n_steps > 1:
            return super().with_targets(batch)
        steps = torch.ones(batch.shape, dtype=torch.int64, device=batch.device)
        return batch.clone(False).set("steps_to_next_obs", steps)

    @override
    def experience(self, batch: TensorDictBase) -> TensorDictBase:
        seen = (*self.policy.greedy.in_keys, "average")
        after = [("next", key) for key in (*seen, "reward", "terminated")]
        return batch.select(*seen, "action", *after, "steps_to_next_obs").reshape(-1)

    def loss(self, batch: Data, others: Data | None = None) -> TensorsByName:
        """Return the mean squared error of the taken action's value, with targets of q' + u'."""
        values = self.values(batch) if self.settings.predict_sum else self.policy.head(self.policy.features(batch))
        predicted = values.gather(-1, batch["action"].unsqueeze(-1))
        after = {key: batch["next", key] for key in (*self.policy.greedy.in_keys, "average")}
        with torch.no_grad():
            best = self.with_others(others, type(self).values, after).amax(dim=-1, keepdim=True)
            gamma = best.new_tensor(self.settings.gamma) ** batch["steps_to_next_obs"].view_as(best)
            target = batch["next", "reward"] + gamma * ~batch["next", "terminated"] * best
        return {"loss_value": (predicted - target).square().mean()}
