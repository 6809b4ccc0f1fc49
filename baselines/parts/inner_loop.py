"""The base class of agents that adapt to a task by a gradient step within a trial: MAML and CAVIA.

A trial is a number of episodes of one task in one row. A row plays ``adapt_episodes`` with the initial weights, adapts,
and plays as many with the adapted ones. The inner loss is that of REINFORCE,

    L = - 1/E sum_e 1/T_e sum_t A_t log pi(a_t | o_t),

over the E episodes of T_e steps before the adaptation. The outer loss is the same over the episodes after it, with the
ratio of probabilities in place of log pi, differentiated through the inner gradient. TRPO (Schulman et al. 2015, arXiv
1502.05477) minimises it as published, or PPO by clipped steps of Adam. A = R - b has mean 0 and standard deviation 1
over the steps before, or after, the adaptation. R is the discounted rest of the episode, b a linear function of
observation and time (Duan et al. 2016, arXiv 1604.06778), fitted to the episodes before the adaptation.

The episodes before the adaptation get no credit, so the policy may drift until it always goes to one goal. PPO counters
this with ``entropy_coeff``. TRPO bounds the divergence on the played episodes only, so returns can fall once all
episodes succeed. Both are as published.

As weights change between batches, only trials that begin and end within one batch count.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.func import grad, vmap
from torch.nn.functional import one_hot
from torchrl.data import Composite, TensorSpec
from typing_extensions import override

from baselines.parts.gates import GATES, GatedNetwork, require_gated_weights, shown_specs
from baselines.parts.learner import Learner
from baselines.parts.networks import Data, Items, TensorsByName, draw, entropy, guided, is_greedy, num_actions_of
from baselines.update.trust_region import trust_region_step
from baselines.update.update import make_optimiser
from ctgraph_rl.checks import (
    at_least_one,
    fraction,
    make_fields_plain,
    not_negative,
    one_of,
    positive,
    require,
    require_memory,
)
from ctgraph_rl.core.dynamics import beside
from ctgraph_rl.learn.collect import UNSTORED

OUTER = ("trpo", "ppo")

REWARDS = f"{UNSTORED}rewards"
EPISODES = f"{UNSTORED}episodes"
"""A row's steps since its trial began, [rows, steps]; episodes that are not needed have number 0."""

RIDGE = 1e-5
"""Added to the diagonal of the baseline's normal equations."""

SMALLEST_STD = 1e-4
"""Added to the standard deviation of A, 0 where the baseline fits all returns."""

NamedWeights = TensorsByName


class Played(NamedTuple):
    """Steps of trials, padded to one length."""

    steps: Items  # what the network reads, and ``action``, [trials, steps, ...] each
    reward: Tensor  # [trials, steps]
    number: Tensor  # of the step's episode in its trial, from 1; 0 where padded, int64 [trials, steps]

    def weight(self) -> Tensor:
        """Return 1 / (E T_e) of each step, 0 where padded, [trials, steps]."""
        lengths = one_hot(self.number).sum(dim=1)
        episodes = (lengths[:, 1:] > 0).sum(dim=1, keepdim=True)
        steps = lengths.gather(1, self.number) * episodes
        return torch.where(self.number > 0, 1 / steps, 0.0)

    def returns(self, gamma: float) -> Tensor:
        """Return R, [trials, steps]."""
        found = self.reward.clone()
        for t in reversed(range(found.shape[1] - 1)):
            lasts = self.number[:, t] == self.number[:, t + 1]
            found[:, t] += torch.where(lasts, gamma * found[:, t + 1], 0.0)
        return found

    def features(self, net: GatedNetwork) -> Tensor:
        """Return the baseline's inputs: o, o^2, t, t^2, t^3 and 1, with t in 100 steps, float64."""
        begins = self.number != self.number.roll(1, dims=1)
        begins[:, 0] = True
        place, first = places(begins)
        time = (place - first).unsqueeze(-1).double() / 100
        flat = net.flat(self.steps["observation"]).double()
        return torch.cat([flat, flat**2, time, time**2, time**3, torch.ones_like(time)], dim=-1)

    def baseline(self, net: GatedNetwork, gamma: float) -> Tensor:
        """Fit the weights of b, float64 [trials, features]."""
        inputs = self.features(net) * (self.number > 0).unsqueeze(-1)
        ridge = RIDGE * torch.eye(inputs.shape[-1], dtype=inputs.dtype, device=inputs.device)
        squares = inputs.mT @ inputs + ridge
        returns = self.returns(gamma).double().unsqueeze(-1)
        return torch.linalg.solve(squares, inputs.mT @ returns).squeeze(-1)

    def advantage(self, net: GatedNetwork, gamma: float, baseline: Tensor) -> Tensor:
        """Return A, 0 where padded, [trials, steps]."""
        counts = (self.number > 0).double()
        number = counts.sum(dim=1, keepdim=True)
        predicted = (self.features(net) @ baseline.unsqueeze(-1)).squeeze(-1)
        raw = self.returns(gamma) - predicted
        mean = (counts * raw).sum(dim=1, keepdim=True) / number
        centred = counts * (raw - mean)
        variance = (centred**2).sum(dim=1, keepdim=True) / number
        std = variance.sqrt()
        return (centred / (std + SMALLEST_STD)).to(self.reward.dtype)

    def episodes(self, net: GatedNetwork, gamma: float, before: Played) -> Items:
        """Return what a loss reads: the steps with ``advantage`` and ``weight``, [trials, steps] each.

        The baseline is fitted to the steps ``before`` the adaptation.
        """
        advantage = self.advantage(net, gamma, before.baseline(net, gamma))
        return {**self.steps, "advantage": advantage, "weight": self.weight().to(advantage.dtype)}


def places(begins: Tensor) -> tuple[Tensor, Tensor]:
    """Return the place of each step, and of the last one up to it that ``begins``, int64 [trials, steps] each."""
    place = torch.arange(begins.shape[1], device=begins.device).expand_as(begins)
    first = torch.where(begins, place, 0).cummax(dim=1).values
    return place, first


def log_prob(logits: Tensor, action: Tensor) -> Tensor:
    """Return log-probabilities of actions, [...], from logits [..., num_actions]."""
    return logits.log_softmax(dim=-1).gather(-1, action.unsqueeze(-1)).squeeze(-1)


class InnerModel(nn.Module):
    """A network with weights theta that all trials share, and weights of each trial, which adapt.

    Args:
        net: reads ``keys`` of the steps, and context inputs, if any.
        inner_rate: step size of the adaptation.
        num_context: context inputs.
    """

    def __init__(self, net: GatedNetwork, keys: Sequence[str], inner_rate: float, num_context: int) -> None:
        super().__init__()
        self.net = net
        self.keys = keys
        self.inner_rate = inner_rate
        self.num_context = num_context

    @property
    def theta(self) -> NamedWeights:
        """The weights that all trials share."""
        return dict(self.net.named_parameters())

    def start(self, theta: NamedWeights) -> NamedWeights:
        """Return a trial's weights before its adaptation."""
        raise NotImplementedError

    def logits(self, theta: NamedWeights, own: NamedWeights, steps: Data) -> Tensor:
        """Return logits of steps of one trial, [..., num_actions]."""
        raise NotImplementedError

    def inner_loss(self, own: NamedWeights, theta: NamedWeights, before: Data) -> Tensor:
        """Return L of one trial, a scalar."""
        log_probs = log_prob(self.logits(theta, own, before), before["action"])
        return -(before["weight"] * before["advantage"] * log_probs).sum()

    def adapt(self, theta: NamedWeights, own: NamedWeights, before: Data) -> NamedWeights:
        """Return a trial's weights after a gradient step on L."""
        gradients = grad(self.inner_loss)(own, theta, before)
        return {name: value - self.inner_rate * gradients[name] for name, value in own.items()}

    def adapted_logits(self, theta: NamedWeights, before: Data, after: Data) -> Tensor:
        """Return logits of one trial's steps after its adaptation, [steps, num_actions]."""
        own = self.adapt(theta, self.start(theta), before)
        return self.logits(theta, own, after)


class InnerPolicy(TensorDictModuleBase):
    """Acts in each row with the row's weights, and adapts them after enough episodes.

    Args:
        adapt_episodes: episodes before and after the adaptation.
    """

    def __init__(self, model: InnerModel, adapt_episodes: int, gamma: float) -> None:
        super().__init__()
        self.model = model
        self.adapt_episodes = adapt_episodes
        self.gamma = gamma
        self.kept_keys = {key: f"{UNSTORED}{key}" for key in ("action", *model.keys)}
        self.own_keys = {name: f"{UNSTORED}{name}" for name in model.start(model.theta)}
        state = ["trial", REWARDS, EPISODES, *self.kept_keys.values(), *self.own_keys.values()]
        self.in_keys = [*model.keys, "is_init", "reward", *state]
        self.out_keys = ["action", *(("next", key) for key in state)]

    @override
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        theta = {name: value.detach() for name, value in self.model.theta.items()}
        begins = tensordict["is_init"].squeeze(-1)
        episode = tensordict["trial"].squeeze(-1) + begins
        fresh = begins & ((episode == 1) | (episode > 2 * self.adapt_episodes))
        episode = torch.where(fresh, 1, episode)
        adapts = begins & (episode == self.adapt_episodes + 1)
        num_kept = tensordict[EPISODES].shape[1]
        rewards = torch.cat([tensordict[REWARDS], tensordict["reward"]], dim=1)
        rewards = rewards[:, rewards.shape[1] - num_kept :]
        own = self._own(theta, tensordict, rewards, fresh=fresh, adapts=adapts)
        seen = {key: tensordict[key] for key in self.model.keys}
        logits = vmap(self.model.logits, in_dims=(None, 0, 0))(theta, own, seen)
        action = logits.argmax(dim=-1) if is_greedy() else draw(logits.softmax(dim=-1))
        tensordict.set("action", guided(tensordict, action))
        tensordict.set(("next", "trial"), episode.unsqueeze(-1))
        for name, key in self.own_keys.items():
            tensordict.set(("next", key), own[name])
        earlier = torch.where((fresh | adapts).unsqueeze(-1), 0, tensordict[EPISODES])
        now = torch.where(episode <= self.adapt_episodes, episode, 0)
        numbers = torch.cat([earlier, now.unsqueeze(-1)], dim=1)
        needed = (numbers > 0).any(dim=0)
        first = int((needed.cumsum(dim=0) == 0).sum())
        tensordict.set(("next", EPISODES), numbers[:, first:])
        tensordict.set(("next", REWARDS), rewards[:, first:])
        for key, kept in self.kept_keys.items():
            steps = torch.cat([tensordict[kept], tensordict[key].unsqueeze(1)], dim=1)
            tensordict.set(("next", kept), steps[:, first:])
        return tensordict

    def _own(self, theta: NamedWeights, data: Data, rewards: Tensor, *, fresh: Tensor, adapts: Tensor) -> NamedWeights:
        own = {name: data[key] for name, key in self.own_keys.items()}
        if adapts.any():
            steps = {key: data[kept][adapts] for key, kept in self.kept_keys.items()}
            played = Played(steps, rewards[adapts], data[EPISODES][adapts])
            theirs = {name: value[adapts] for name, value in own.items()}
            adapted = vmap(self.model.adapt, in_dims=(None, 0, 0))(theta, theirs, self.before(played))
            for name, value in adapted.items():
                own[name] = own[name].index_put((adapts,), value)
        for name, first in self.model.start(theta).items():
            own[name] = torch.where(beside(fresh, own[name]), first, own[name])
        return own

    def before(self, played: Played) -> Items:
        """Return what L reads of the steps before an adaptation."""
        return played.episodes(self.model.net, self.gamma, played)


@dataclass(frozen=True, kw_only=True)
class InnerLoopSettings:
    """The settings of `InnerLoop`."""

    num_envs: int  # rows, each with one trial at a time
    num_steps: int  # steps of each row in a batch: twice those of a trial, so that there is a whole one
    hidden_size: int  # width of all layers
    num_layers: int  # layers before the output
    adapt_episodes: int  # episodes before the adaptation, and after it
    inner_rate: float  # step size of the adaptation
    gamma: float  # discount factor
    gate: str  # modulates layers, see `baselines.parts.gates`: none, soft, hard or hard_straight_through
    gate_size: int  # units of a gate
    outer: str  # trpo, whose step needs no Adam, or ppo
    max_kl: float  # largest mean divergence of a step of TRPO
    learning_rate: float  # of PPO
    clip_epsilon: float  # how far the probability ratio of PPO may move
    num_epochs: int  # steps of PPO on a batch
    max_grad_norm: float  # the gradients of PPO are scaled down to this norm
    entropy_coeff: float  # weight in PPO's loss of the entropy before the adaptation

    def __post_init__(self) -> None:
        make_fields_plain(self)
        require(
            *at_least_one(num_steps=self.num_steps, hidden_size=self.hidden_size, num_layers=self.num_layers),
            *at_least_one(gate_size=self.gate_size, num_epochs=self.num_epochs, adapt_episodes=self.adapt_episodes),
            *positive(inner_rate=self.inner_rate, max_kl=self.max_kl),
            *positive(learning_rate=self.learning_rate, clip_epsilon=self.clip_epsilon),
            *fraction(gamma=self.gamma),
            *not_negative(entropy_coeff=self.entropy_coeff),
            *one_of(GATES, gate=self.gate),
            *one_of(OUTER, outer=self.outer),
        )
        ignored = f"entropy_coeff is of outer=ppo: set it to 0, got {self.entropy_coeff!r} with outer={self.outer!r}"
        require((self.outer == "ppo" or self.entropy_coeff == 0, ignored))
        trial = 2 * self.adapt_episodes
        short = f"num_steps must be at least the 2 * adapt_episodes={trial} episodes of a trial, got {self.num_steps}"
        require((self.num_steps >= trial, short))


class InnerLoop(Learner):
    """A policy that adapts within a trial; subclasses say which weights adapt."""

    Settings: ClassVar[Any] = InnerLoopSettings
    settings: Any
    Model: ClassVar[type[InnerModel]]
    memory = True
    needs_whole_trials = True
    needs_episodes = True
    output_keys = ("log_probs",)
    minibatch_size = 0  # batches differ in their number of trials

    policy: InnerPolicy

    def __init__(self, observation_spec: Composite, action_spec: TensorSpec, **settings: Any) -> None:
        self.settings = given = self.Settings(**settings)
        super().__init__(given.num_envs, given.num_steps, given.max_grad_norm)
        self.adapt_episodes = given.adapt_episodes
        self.trial_episodes = 2 * given.adapt_episodes
        hidden = given.hidden_size, given.num_layers
        require_gated_weights(observation_spec, *hidden, num_context=self.num_context, gate_size=given.gate_size)
        self.specs = shown_specs(observation_spec)
        num_actions = num_actions_of(action_spec)
        net = GatedNetwork(
            self.specs,
            self.num_context,
            num_actions,
            hidden_size=given.hidden_size,
            num_layers=given.num_layers,
            gate=given.gate,
            gate_size=given.gate_size,
        )
        model = self.Model(net, list(self.specs), given.inner_rate, self.num_context)
        count = given.num_envs * sum(value.numel() for value in model.start(model.theta).values())
        adapted = f"weights of each of num_envs={given.num_envs} rows, their gradients and what they become"
        require_memory(adapted, 16 * count, "rows or smaller layers")
        self.policy = InnerPolicy(model, given.adapt_episodes, given.gamma)
        self.optimiser = make_optimiser("adam", net.parameters(), given.learning_rate)

    @property
    def num_context(self) -> int:
        """Inputs of the network beside observations."""
        return 0

    @property
    def model(self) -> InnerModel:
        """The weights, and how they adapt."""
        return self.policy.model

    @override
    def initial_state(self, num_envs: int) -> TensorDict:
        theta = self.model.theta
        like = next(iter(theta.values())).detach()
        state = {
            "trial": like.new_zeros(num_envs, 1, dtype=torch.int64),
            "reward": like.new_zeros(num_envs, 1),
            f"{UNSTORED}action": like.new_zeros(num_envs, 0, dtype=torch.int64),
            EPISODES: like.new_zeros(num_envs, 0, dtype=torch.int64),
            REWARDS: like.new_zeros(num_envs, 0),
        }
        for key, spec in self.specs.items():
            state[f"{UNSTORED}{key}"] = torch.zeros(num_envs, 0, *spec.shape, dtype=spec.dtype, device=like.device)
        for name, value in self.model.start(theta).items():
            state[self.policy.own_keys[name]] = value.detach().expand(num_envs, *value.shape).clone()
        return TensorDict(state, batch_size=[num_envs])

    def minibatches(self, batch: TensorDictBase) -> Iterator[Items]:
        """Yield the whole trials of a batch, if any, once for each step of the outer loop."""
        trials = self.trials(batch)
        if trials is not None:
            for _ in range(1 if self.settings.outer == "trpo" else self.settings.num_epochs):
                yield trials

    @torch.no_grad()
    def trials(self, batch: TensorDictBase) -> Items | None:
        """Return what the losses read of trials within a batch; None without one.

        Keys are those of `Played.episodes`, ``("before", key)`` for steps before the adaptation, and ``log_prob`` of
        the present weights.
        """
        number = batch["next", "trial"].squeeze(-1)
        begins = batch["is_init"].squeeze(-1) & (number == 1)
        trial = begins.cumsum(dim=1)
        rows, first = begins.nonzero(as_tuple=True)
        own = trial[rows] == trial[rows, first].unsqueeze(-1)
        ends = batch["next", "done"].squeeze(-1) & (number == self.trial_episodes)
        whole = (own & ends[rows]).any(dim=1)
        if not whole.any():
            return None
        rows = rows[whole]
        own = own[whole]
        is_before = number[rows] <= self.adapt_episodes
        before = self._played(batch, rows, own & is_before)
        after = self._played(batch, rows, own & ~is_before)
        policy = self.policy
        found = after.episodes(self.model.net, policy.gamma, before)
        for key, value in policy.before(before).items():
            found["before", key] = value
        found["log_prob"] = log_prob(self._adapted_logits(found), found["action"])
        for name, played in (("before", before), ("after", after)):
            total = (played.reward * (played.number > 0)).sum()
            found["measured", name] = total / len(rows) / self.adapt_episodes
        return found

    def _played(self, batch: TensorDictBase, rows: Tensor, chosen: Tensor) -> Played:
        count = chosen.sum(dim=1, keepdim=True)
        place = torch.arange(int(count.max()), device=rows.device)
        first = chosen.int().argmax(dim=1, keepdim=True)
        at = (rows.unsqueeze(-1), (first + place).clamp(max=chosen.shape[1] - 1))
        number = torch.where(place < count, batch["next", "trial"].squeeze(-1)[at], 0)
        steps = {key: batch[key][at] for key in (*self.specs, "action")}
        return Played(steps, batch["next", "reward"].squeeze(-1)[at], number)

    def _adapted_logits(self, batch: Data, theta: NamedWeights | None = None) -> Tensor:
        """Return logits of all trials after their adaptation, [trials, steps, num_actions]."""
        after = {key: batch[key] for key in self.specs}
        logits = vmap(self.model.adapted_logits, in_dims=(None, 0, 0))
        return logits(theta or self.model.theta, steps_before(batch), after)

    def loss(self, batch: Data) -> TensorsByName:
        """Return the outer loss of `trials`, and the entropy's before the adaptation."""
        losses = {"loss_policy": self._outer_loss(batch, self._adapted_logits(batch))}
        if self.settings.entropy_coeff > 0:
            theta = self.model.theta
            logits = self.model.logits(theta, self.model.start(theta), steps_before(batch))
            entropies = entropy(logits.log_softmax(dim=-1))
            weight = -self.settings.entropy_coeff * batch["before", "weight"]
            losses["loss_entropy"] = (weight * entropies).sum(dim=1).mean()
        return losses

    def _outer_loss(self, batch: Data, logits: Tensor) -> Tensor:
        ratio = (log_prob(logits, batch["action"]) - batch["log_prob"]).exp()
        gain = ratio * batch["advantage"]
        if self.settings.outer == "ppo":
            clipped = ratio.clamp(1 - self.settings.clip_epsilon, 1 + self.settings.clip_epsilon) * batch["advantage"]
            gain = torch.minimum(gain, clipped)
        return -(batch["weight"] * gain).sum(dim=1).mean()

    @override
    def gradient_step(self, batch: Data) -> TensorsByName:
        if self.settings.outer == "ppo":
            measured = super().gradient_step(batch)
        else:
            measured = trust_region_step(
                list(self.model.net.named_parameters()),
                partial(self._adapted_logits, batch),
                partial(self._outer_loss, batch),
                weight=batch["weight"] / len(batch["weight"]),
                max_kl=self.settings.max_kl,
            )
        return {
            **measured,
            "return_before": batch["measured", "before"],
            "return_after": batch["measured", "after"],
            "trials": torch.full_like(batch["measured", "after"], len(batch["action"])),
        }


def steps_before(batch: Data) -> Items:
    """Return the part of `InnerLoop.trials` before the adaptation."""
    return {key[1]: value for key, value in batch.items() if key[0] == "before"}
