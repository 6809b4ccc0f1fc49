"""DQN: double Q-learning with replay and epsilon-greedy exploration; without memory.

Mnih et al. 2015 and van Hasselt et al. 2016 (arXiv 1509.06461) on TorchRL's `QValueActor`, `EGreedyModule`,
`DQNLoss` and replay buffer; with priorities as Schaul et al. 2016 (arXiv 1511.05952) where configured.
"""

from __future__ import annotations

from typing import Any

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import Composite, TensorSpec
from torchrl.modules import MLP, QValueActor
from torchrl.objectives import DQNLoss, ValueEstimators

from baselines.learner import true_or_false
from baselines.networks import encoder
from baselines.q_learning import QLearner
from ctgraph_rl.checks import at_least_one, fraction, is_real, positive, require


class DQN(QLearner):
    """DQN for tasks that need no memory.

    Args:
        observation_spec: the environment's ``observation_spec_unbatched``.
        action_spec: the environment's ``action_spec_unbatched``.
        hidden_size: width of the two hidden layers.
        learning_rate: of Adam.
        gamma: discount factor.
        double: let the online network choose the action whose target value counts.
        priority_alpha: how much more often surprising transitions are replayed; 0 is uniform (Schaul et al. 2016, arXiv
            1511.05952).
        priority_beta: how much of that the loss corrects, in [0, 1].
        settings: the arguments of `QLearner`. Where different states show the same image, a one-step target is the
            same after every decision, so nothing is learned about decisions: ``n_steps`` helps.
    """

    solves = "what one observation tells: fully observable tasks (CT-FO)"

    def __init__(
        self,
        observation_spec: Composite,
        action_spec: TensorSpec,
        hidden_size: int,
        learning_rate: float,
        gamma: float,
        double: bool,
        priority_alpha: float,
        priority_beta: float,
        **settings: Any,
    ) -> None:
        require(
            *at_least_one(hidden_size=hidden_size),
            *positive(learning_rate=learning_rate),
            *true_or_false(double=double),
            *fraction(priority_beta=priority_beta),
            (is_real(priority_alpha, 0), f"priority_alpha must be a number >= 0, got {priority_alpha!r}"),
        )
        self.priority_alpha, self.priority_beta = priority_alpha, priority_beta
        super().__init__(gamma=gamma, **settings)
        head = MLP(hidden_size, action_spec.space.n, num_cells=[hidden_size], activation_class=nn.ReLU)
        values = TensorDictModule(head, in_keys=["features"], out_keys=["action_value"])
        features = encoder(observation_spec, hidden_size)
        self.greedy = QValueActor(TensorDictSequential(features, values), in_keys=features.in_keys, spec=action_spec)
        self.dqn = DQNLoss(self.greedy, delay_value=True, double_dqn=double, action_space=action_spec)
        self.dqn.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
        self.act_with(self.greedy, self.dqn, action_spec, learning_rate)

    def experience(self, batch: TensorDictBase) -> TensorDictBase:
        """Every step as a transition of up to ``n_steps`` steps."""
        seen = self.policy.in_keys
        after = [("next", key) for key in (*seen, "reward", "done", "terminated")]
        return batch.select(*seen, "action", *after, "steps_to_next_obs").reshape(-1)

    def loss(self, batch: TensorDictBase) -> TensorDictBase:
        """The DQN loss of transitions, with the target network's values."""
        return TensorDict({"loss_value": self.dqn(batch)["loss"]})
