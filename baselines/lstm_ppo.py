"""LSTM-PPO: clipped policy gradients with a recurrent trunk that actor and critic share.

Schulman et al. 2017 (arXiv 1707.06347) on TorchRL's `LSTMModule` and `ClipPPOLoss`. Whole rows of a batch are the
minibatches, so the trunk sees sequences in order, and its state starts anew wherever ``is_init`` is set.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec
from torchrl.modules import LSTMModule, ProbabilisticActor, ValueOperator, set_recurrent_mode
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value.functional import vec_generalized_advantage_estimate

from baselines.learner import Learner, mean_measurements
from baselines.networks import encoder
from ctgraph_rl.checks import at_least_one, fraction, is_int, is_real, positive, require

STATE_KEYS = ("recurrent_state_h", "recurrent_state_c")
ACTED_KEYS = ("action", "action_log_prob", "state_value")
LOSS_KEYS = ("loss_objective", "loss_critic", "loss_entropy", "entropy")


class LSTMPPO(Learner):
    """PPO with an LSTM.

    Args:
        observation_spec: the environment's ``observation_spec_unbatched``.
        action_spec: the environment's ``action_spec_unbatched``.
        num_envs: rows that it learns from.
        num_steps: steps of each row in a batch, the length of the sequences.
        hidden_size: width of features and LSTM.
        learning_rate: of Adam.
        gamma: discount factor.
        gae_lambda: lambda of the generalised advantage estimate.
        clip_epsilon: how far the probability ratio may move.
        entropy_coeff: weight of the entropy bonus.
        critic_coeff: weight of the critic's loss.
        num_epochs: passes over a batch.
        num_minibatches: minibatches a pass; they split the rows.
        max_grad_norm: gradients are scaled down to this norm.
    """

    def __init__(
        self,
        observation_spec: Composite,
        action_spec: TensorSpec,
        num_envs: int,
        num_steps: int,
        hidden_size: int,
        learning_rate: float,
        gamma: float,
        gae_lambda: float,
        clip_epsilon: float,
        entropy_coeff: float,
        critic_coeff: float,
        num_epochs: int,
        num_minibatches: int,
        max_grad_norm: float,
    ) -> None:
        super().__init__(num_envs, num_steps, max_grad_norm)
        splits = is_int(num_envs, 1) and is_int(num_minibatches, 1) and num_envs % num_minibatches == 0
        require(
            *at_least_one(hidden_size=hidden_size, num_epochs=num_epochs, num_minibatches=num_minibatches),
            *positive(learning_rate=learning_rate, clip_epsilon=clip_epsilon, gamma=gamma, gae_lambda=gae_lambda),
            *fraction(gamma=gamma, gae_lambda=gae_lambda),
            (is_real(entropy_coeff, 0), f"entropy_coeff must be a number >= 0, got {entropy_coeff!r}"),
            (is_real(critic_coeff, 0), f"critic_coeff must be a number >= 0, got {critic_coeff!r}"),
            (splits, f"num_envs={num_envs} must be a multiple of num_minibatches={num_minibatches}"),
        )
        self.gamma, self.gae_lambda = gamma, gae_lambda
        self.num_epochs, self.num_minibatches = num_epochs, num_minibatches
        num_actions = action_spec.space.n
        lstm = LSTMModule(hidden_size, hidden_size, in_key="features", out_key="memory")
        self.trunk = TensorDictSequential(encoder(observation_spec, hidden_size), lstm)
        self.actor = ProbabilisticActor(
            TensorDictModule(nn.Linear(hidden_size, num_actions), in_keys=["memory"], out_keys=["logits"]),
            spec=action_spec,
            in_keys=["logits"],
            distribution_class=torch.distributions.Categorical,
            return_log_prob=True,
        )
        self.critic = ValueOperator(nn.Linear(hidden_size, 1), in_keys=["memory"])
        self.policy = TensorDictSequential(
            self.trunk, self.actor, self.critic, selected_out_keys=[*ACTED_KEYS, *(("next", key) for key in STATE_KEYS)]
        )
        self.ppo = ClipPPOLoss(
            self.actor,
            self.critic,
            clip_epsilon=clip_epsilon,
            entropy_coeff=entropy_coeff,
            critic_coeff=critic_coeff,
            loss_critic_type="l2",
            functional=False,
        )
        self.optimiser = torch.optim.Adam(self.parameters(), lr=learning_rate, fused=True)

    def initial_state(self, num_envs: int) -> TensorDict:
        """Zeros, float32 [num_envs, 1, hidden_size] for both parts of the LSTM's state."""
        lstm = self.trunk[-1].lstm
        zeros = torch.zeros(num_envs, lstm.num_layers, lstm.hidden_size, device=lstm.weight_hh_l0.device)
        return TensorDict({key: zeros.clone() for key in STATE_KEYS}, batch_size=[num_envs])

    def loss(self, batch: TensorDictBase) -> TensorDictBase:
        """Policy, critic and entropy losses of rows with advantages; the trunk runs once for actor and critic."""
        with set_recurrent_mode(True):
            remembered = self.trunk(batch.select(*self.trunk.in_keys))
        return self.ppo(batch.set("memory", remembered["memory"])).select(*LOSS_KEYS)

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Some epochs over a batch; returns mean losses, entropy and gradient norm."""
        batch = self._with_advantage(batch)
        minibatches = (rows for _ in range(self.num_epochs) for rows in self._minibatches(batch))
        return mean_measurements([self.gradient_step(batch[rows]) for rows in minibatches])

    def _minibatches(self, batch: TensorDictBase) -> tuple[Tensor, ...]:
        """Row numbers of each minibatch of one pass."""
        return torch.randperm(batch.shape[0]).chunk(self.num_minibatches)

    @torch.no_grad()
    def _with_advantage(self, batch: TensorDictBase) -> TensorDictBase:
        """The batch with ``advantage`` and ``value_target`` from the values that were computed while acting.

        The value after a step is the next step's own; only the last step needs another forward pass. Where an
        episode has terminated it is not used.
        """
        last = self.critic(self.trunk(batch[:, -1]["next"].select(*self.trunk.in_keys, strict=False)))
        values = batch["state_value"]
        next_values = torch.cat([values[:, 1:], last["state_value"].unsqueeze(1)], dim=1)
        after = batch["next"]
        advantage, target = vec_generalized_advantage_estimate(
            self.gamma,
            self.gae_lambda,
            values,
            next_values,
            after["reward"],
            after["done"],
            after["terminated"],
        )
        keys = (*self.trunk.in_keys, "action", "action_log_prob")
        return batch.select(*keys).set("advantage", advantage).set("value_target", target)
