"""PEARL: a policy reads a guess of its task, which it draws from a posterior over the steps of its trial.

Rakelly et al. 2019, "Efficient off-policy meta-reinforcement learning via probabilistic context variables" (arXiv
1903.08254). The posterior of a context c of steps (o_i, a_i, r_i) is a product of Gaussians, one for each step,

    q(z | c) = N(mu, s),    1/s = sum_i 1/s_i,    mu = s sum_i mu_i/s_i,    N(0, 1) without a step.

A row draws z before each episode of a trial. The losses are means over steps, those of soft actor-critic for discrete
actions (Christodoulou 2019, arXiv 1910.07207), given z of the same trial, with the smaller of two critics Q:

    loss_value = sum_j (Q_j(o, a, z) - k r - gamma V')^2
    V' = sum_b pi(b | o', z) (min_j Q'_j(o', b, z) - alpha log pi(b | o', z))
    loss_policy = sum_b pi(b | o, z) (alpha log pi(b | o, z) - min_j Q_j(o, b, z))
    loss_context = kl_coeff KL(q(z | c) || N(0, 1))

The encoder of mu_i and s_i gets no gradient of loss_policy. Q' follows Q. Each trial counts as a task.
Replay holds the last steps of all rows; a context and the steps of the other losses come from one trial. As a context
is a set of steps, it shows the goal only if the rewarded observation differs from other end states'.
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.nn.functional import one_hot, softplus
from torchrl.data import Composite, TensorSpec
from typing_extensions import override

from baselines.parts.gates import GATES, GatedNetwork, require_gated_weights, shown_specs
from baselines.parts.inner_loop import places
from baselines.parts.learner import MOST_PASSES, Learner
from baselines.parts.networks import Data, Items, TensorsByName, draw, entropy, guided, is_greedy, num_actions_of
from baselines.parts.q_learning import require_replay
from baselines.update.update import make_optimiser
from ctgraph_rl.batch.specs import TASK_NUMBER
from ctgraph_rl.checks import (
    NamedValues,
    at_least_one,
    at_most,
    fraction,
    make_fields_plain,
    not_negative,
    one_of,
    positive,
    require,
)
from ctgraph_rl.learn.collect import UNSTORED

NetInputs = tuple[Tensor, ...]

SMALLEST_VARIANCE = 1e-7

ACTION = f"{UNSTORED}action"
PRECISION = f"{UNSTORED}precision"
WEIGHTED = f"{UNSTORED}weighted"
"""A row's last action, and the sums of 1/s_i and mu_i/s_i over its trial."""

CONTEXT = f"{UNSTORED}context"
"""The z of a row's episode."""


def gaussian(precision: Tensor, weighted: Tensor) -> tuple[Tensor, Tensor]:
    """Return mu and s, [..., num_context] each, from the sums of 1/s_i and mu_i/s_i."""
    variance = torch.where(precision > 0, 1 / precision, 1.0)
    return variance * weighted, variance


def kl_to_prior(mean: Tensor, variance: Tensor) -> Tensor:
    """Return the divergence of a Gaussian, [..., num_context], from N(0, 1), [...]."""
    return 0.5 * (variance + mean.square() - 1 - variance.log()).sum(dim=-1)


class PosteriorPolicy(TensorDictModuleBase):
    """Draws a row's z before each episode, from the posterior of its trial's steps.

    Each step counts by the encoder's weights at its time.

    Args:
        actor: maps what is seen and z to logits.
        encoder: maps what is seen, the one-hot action and the reward to mu_i, and to s_i before its softplus.
        seen_keys: what the networks see.
    """

    def __init__(
        self, actor: GatedNetwork, encoder: GatedNetwork, seen_keys: list[str], num_actions: int, trial_episodes: int
    ) -> None:
        super().__init__()
        self.actor = actor
        self.encoder = encoder
        self.seen_keys = seen_keys
        self.num_actions = num_actions
        self.trial_episodes = trial_episodes
        self.kept_keys = [f"{UNSTORED}{key}" for key in seen_keys]
        state = ["trial", ACTION, PRECISION, WEIGHTED, CONTEXT, *self.kept_keys]
        self.in_keys = [*seen_keys, "is_init", "reward", *state]
        self.out_keys = ["action", *(("next", key) for key in state)]

    def evidence(self, seen: NetInputs, action: Tensor, reward: Tensor) -> tuple[Tensor, Tensor]:
        """Return 1/s_i and mu_i/s_i of steps, [..., num_context] each."""
        found = self.encoder(*seen, one_hot(action, self.num_actions), reward)
        mean, raw = found.chunk(2, dim=-1)
        precision = 1 / softplus(raw).clamp(min=SMALLEST_VARIANCE)
        return precision, precision * mean

    @override
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        begins = tensordict["is_init"]
        episode = tensordict["trial"] + begins
        fresh = begins & ((episode == 1) | (episode > self.trial_episodes))
        last = tuple(tensordict[key] for key in self.kept_keys)
        precision, weighted = self.evidence(last, tensordict[ACTION], tensordict["reward"])
        precision = torch.where(fresh, 0, tensordict[PRECISION] + precision)
        weighted = torch.where(fresh, 0, tensordict[WEIGHTED] + weighted)
        mean, variance = gaussian(precision, weighted)
        drawn = mean + variance.sqrt() * torch.randn_like(mean)
        context = torch.where(begins, drawn, tensordict[CONTEXT])
        seen = tuple(tensordict[key] for key in self.seen_keys)
        logits = self.actor(*seen, context)
        action = logits.argmax(dim=-1) if is_greedy() else draw(logits.softmax(dim=-1))
        action = guided(tensordict, action)
        trial = torch.where(fresh, 1, episode)
        written = (action, trial, action, precision, weighted, context, *seen)
        return tensordict.update(dict(zip(self.out_keys, written, strict=True)))


@dataclass(frozen=True, kw_only=True)
class PEARLSettings:
    """The settings of `PEARL`."""

    num_envs: int  # rows, each with one trial at a time
    num_steps: int  # steps of each row between two rounds of updates
    hidden_size: int  # width of all layers
    num_layers: int  # layers before the output of each network
    num_context: int  # width of z
    trial_episodes: int  # episodes of a trial
    learning_rate: float  # of Adam
    gamma: float  # discount factor
    entropy_coeff: float  # alpha
    reward_scale: float  # what rewards are multiplied by in loss_value: against alpha and kl_coeff
    kl_coeff: float  # weight of the divergence from N(0, 1)
    buffer_size: int  # steps that replay keeps, of all rows
    num_trials: int  # trials that a gradient step learns from
    context_size: int  # steps of a trial that are its context there
    batch_size: int  # steps of a trial that the critics and the policy learn from there
    num_updates: int  # gradient steps after each batch of data
    target_rate: float  # how far the target critics follow in each gradient step, in (0, 1]
    max_grad_norm: float  # gradients are scaled down to this norm
    gate: str  # modulates the layers of the policy, see `baselines.parts.gates`
    gate_size: int  # units of a gate

    def __post_init__(self) -> None:
        make_fields_plain(self)
        require(
            *at_least_one(hidden_size=self.hidden_size, num_layers=self.num_layers, num_context=self.num_context),
            *at_least_one(gate_size=self.gate_size, num_trials=self.num_trials, context_size=self.context_size),
            *at_least_one(batch_size=self.batch_size, trial_episodes=self.trial_episodes),
            *at_least_one(num_updates=self.num_updates),
            *at_most(MOST_PASSES, num_updates=self.num_updates),
            *positive(learning_rate=self.learning_rate, target_rate=self.target_rate),
            *positive(reward_scale=self.reward_scale),
            *fraction(gamma=self.gamma, target_rate=self.target_rate),
            *not_negative(entropy_coeff=self.entropy_coeff, kl_coeff=self.kl_coeff),
            *one_of(GATES, gate=self.gate),
        )


class PEARL(Learner):
    """Discrete soft actor-critic with a posterior over tasks.

    TorchRL's `DiscreteSACLoss` has one context for both losses, where the policy's must not reach the encoder, and
    hides its critics from a `Learner`.
    """

    Settings = PEARLSettings
    memory = True
    adapt_episodes = 1
    needs_episodes = True
    output_keys = ("log_probs",)
    solves = "tasks whose goal is drawn from several: it draws a guess of its task before each episode"

    policy: PosteriorPolicy

    def __init__(self, observation_spec: Composite, action_spec: TensorSpec, **settings: Any) -> None:
        self.settings = given = PEARLSettings(**settings)
        super().__init__(given.num_envs, given.num_steps, given.max_grad_norm)
        num_actions = num_actions_of(action_spec)
        hidden = given.hidden_size, given.num_layers
        context = given.num_context
        require_gated_weights(observation_spec, *hidden, num_context=context, gate_size=given.gate_size)
        items = given.num_trials * (given.batch_size + given.context_size)
        require_replay(observation_spec, given.buffer_size, items, context)
        short = f"buffer_size must be at least a step of each of num_envs={given.num_envs} rows"
        require((given.buffer_size >= given.num_envs, f"{short}, got {given.buffer_size}"))
        self.minibatch_size = given.num_trials
        self.specs = shown_specs(observation_spec)
        network = partial(
            GatedNetwork,
            self.specs,
            hidden_size=given.hidden_size,
            num_layers=given.num_layers,
            gate_size=given.gate_size,
        )
        encoder = network(num_actions + 1, 2 * context, gate="none")
        actor = network(context, num_actions, gate=given.gate)
        self.policy = PosteriorPolicy(actor, encoder, list(self.specs), num_actions, given.trial_episodes)
        self.critics = nn.ModuleList([network(context, num_actions, gate="none") for _ in range(2)])
        self.targets = deepcopy(self.critics).requires_grad_(False)
        trained = [*self.policy.parameters(), *self.critics.parameters()]
        self.optimiser = make_optimiser("adam", trained, given.learning_rate)
        self.replay: Items = {}
        """The last steps of all rows, [rows, steps] each, and whether a trial ``begins`` there."""

    @override
    def initial_state(self, num_envs: int) -> TensorDict:
        like = next(self.parameters()).detach()
        counts = like.new_zeros(num_envs, dtype=torch.int64)
        state = {"trial": counts.unsqueeze(-1), ACTION: counts, "reward": like.new_zeros(num_envs, 1)}
        state |= {key: like.new_zeros(num_envs, self.settings.num_context) for key in (PRECISION, WEIGHTED, CONTEXT)}
        for key, spec in self.specs.items():
            state[f"{UNSTORED}{key}"] = torch.zeros(num_envs, *spec.shape, dtype=spec.dtype, device=like.device)
        return TensorDict(state, batch_size=[num_envs])

    def minibatches(self, batch: TensorDictBase) -> Iterator[Items]:
        """Store a batch, and yield steps of trials, [num_trials, batch_size], each with a context of its trial."""
        starts = batch["is_init"] & (batch["next", "trial"] == 1)
        keys = [*self.specs, "action", ("next", "reward"), ("next", "terminated")]
        keys += [("next", key) for key in self.specs]
        kept = {}
        kept_steps = self.settings.buffer_size // self.num_envs
        for key, new in {"begins": starts.squeeze(-1), **{key: batch[key] for key in keys}}.items():
            steps = [self.replay[key], new] if self.replay else [new]
            kept[key] = torch.cat(steps, dim=1)[:, -kept_steps:].contiguous()
        self.replay = kept
        begins = self.replay["begins"]
        num_rows, num_steps = begins.shape
        place, first = places(begins)
        ends = begins.roll(-1, dims=1)
        ends[:, -1] = True
        last = torch.where(ends, place, num_steps).flip(1).cummin(dim=1).values.flip(1)
        for _ in range(self.settings.num_updates):
            row = torch.randint(num_rows, (self.minibatch_size, 1), device=begins.device)
            step = torch.randint(num_steps, (self.minibatch_size, 1), device=begins.device)
            trial = row, first[row, step], last[row, step]
            context = {
                ("context", key): value for key, value in self._steps(*trial, self.settings.context_size).items()
            }
            noise = torch.randn(
                self.minibatch_size, self.settings.num_context, dtype=torch.float32, device=begins.device
            )
            yield {**self._steps(*trial, self.settings.batch_size), **context, "noise": noise}

    @override
    def shown_ids(self, batch: TensorDictBase) -> Tensor | None:
        shown = super().shown_ids(batch)
        if shown is None or not self.replay:
            return shown
        return torch.cat([shown, self.replay[TASK_NUMBER].flatten(), self.replay["next", TASK_NUMBER].flatten()])

    def _steps(self, row: Tensor, first: Tensor, last: Tensor, number: int) -> Items:
        share = torch.rand(len(row), number, dtype=torch.float32, device=row.device)
        step = (first + (share * (last + 1 - first)).long()).minimum(last)
        return {key: value[row, step] for key, value in self.replay.items() if key != "begins"}

    @override
    def other_weights(self) -> TensorsByName:
        return {f"critics.{name}": value for name, value in self.targets.named_parameters()}

    @override
    def loss(self, batch: Data, others: Data | None = None) -> TensorsByName:
        mean, variance = self.posterior(batch)
        context = (mean + variance.sqrt() * batch["noise"]).unsqueeze(1).expand(-1, batch["action"].shape[1], -1)
        fixed = context.detach()
        seen = tuple(batch[key] for key in self.specs)
        after = tuple(batch["next", key] for key in self.specs)
        with torch.no_grad():
            later = self.policy.actor(*after, fixed).log_softmax(dim=-1)
            soft = self.with_others(others, type(self).smaller, after, fixed) - self.settings.entropy_coeff * later
            value = (later.exp() * soft).sum(dim=-1, keepdim=True)
            reward = self.settings.reward_scale * batch["next", "reward"]
            target = reward + self.settings.gamma * ~batch["next", "terminated"] * value
            best = self.smaller(seen, fixed)
        action = batch["action"].unsqueeze(-1)
        errors = [critic(*seen, context).gather(-1, action) - target for critic in self.critics]
        log_probs = self.policy.actor(*seen, fixed).log_softmax(dim=-1)
        return {
            "loss_value": sum(error.square().mean() for error in errors),
            "loss_policy": (log_probs.exp() * (self.settings.entropy_coeff * log_probs - best)).sum(dim=-1).mean(),
            "loss_context": self.settings.kl_coeff * kl_to_prior(mean, variance).mean(),
            "entropy": entropy(log_probs).detach().mean(),
        }

    def smaller(self, seen: NetInputs, context: Tensor) -> Tensor:
        """Return the smaller of the critics' action values, [..., num_actions]."""
        first, second = (critic(*seen, context) for critic in self.critics)
        return torch.minimum(first, second)

    def posterior(self, batch: Data) -> tuple[Tensor, Tensor]:
        """Return mu and s of a minibatch's contexts, [num_trials, num_context] each."""
        seen = tuple(batch["context", key] for key in self.specs)
        given = batch["context", "action"], batch["context", ("next", "reward")]
        precision, weighted = self.policy.evidence(seen, *given)
        return gaussian(precision.sum(dim=1), weighted.sum(dim=1))

    @override
    @torch.no_grad()
    def after_update(self, measured: TensorsByName) -> TensorsByName:
        for target, online in zip(self.targets.parameters(), self.critics.parameters(), strict=True):
            target.lerp_(online, self.settings.target_rate)
        return measured

    @override
    def weights_changed(self) -> None:
        self.targets.load_state_dict(self.critics.state_dict())

    @override
    def get_extra_state(self) -> NamedValues:
        return {**super().get_extra_state(), "replay": self.replay}

    @override
    def set_extra_state(self, state: NamedValues) -> None:
        super().set_extra_state(state)
        self.replay = state["replay"]
