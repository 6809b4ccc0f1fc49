"""DQN: double Q-learning with replay and epsilon-greedy exploration; without memory.

Mnih et al. 2015 and van Hasselt et al. 2016 (arXiv 1509.06461) on TorchRL's `QValueActor`, `EGreedyModule`,
`DQNLoss` and replay buffer; with priorities as Schaul et al. 2016 (arXiv 1511.05952) where configured.
"""

from __future__ import annotations

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import Composite, TensorSpec
from torchrl.modules import MLP, QValueActor
from torchrl.objectives import DQNLoss, ValueEstimators

from baselines.learner import true_or_false
from baselines.networks import encoder
from baselines.q_learning import QLearner
from ctgraph_rl.checks import at_least_one, positive, require


class DQN(QLearner):
    """DQN for tasks that need no memory.

    Args:
        observation_spec: the environment's ``observation_spec_unbatched``.
        action_spec: the environment's ``action_spec_unbatched``.
        num_envs: rows that it learns from.
        num_steps: steps of each row between two rounds of updates.
        hidden_size: width of the two hidden layers.
        learning_rate: of Adam.
        gamma: discount factor.
        n_steps: steps of a multi-step target (uncorrected). Where different states show the same image, a one-step
            target is the same after every decision, so nothing is learned about decisions.
        double: let the online network choose the action whose target value counts.
        buffer_size: transitions that the replay buffer keeps.
        batch_size: transitions a gradient step learns from.
        num_updates: gradient steps after each batch of data.
        target_update_interval: gradient steps between two copies to the target network.
        priority_alpha: how much more often surprising transitions are replayed; 0 is uniform.
        priority_beta: how much of that the loss corrects, in [0, 1].
        eps_init: exploration at the start of a task.
        eps_end: exploration after ``annealing_num_steps``.
        annealing_num_steps: frames of a task over which exploration falls linearly.
        max_grad_norm: gradients are scaled down to this norm.
        replay_on_task_change: ``clear`` or ``keep`` the replay buffer where a task change is announced.
    """

    solves = "what one observation tells: fully observable tasks (CT-FO)"

    def __init__(
        self,
        observation_spec: Composite,
        action_spec: TensorSpec,
        num_envs: int,
        num_steps: int,
        hidden_size: int,
        learning_rate: float,
        gamma: float,
        n_steps: int,
        double: bool,
        buffer_size: int,
        batch_size: int,
        num_updates: int,
        target_update_interval: int,
        priority_alpha: float,
        priority_beta: float,
        eps_init: float,
        eps_end: float,
        annealing_num_steps: int,
        max_grad_norm: float,
        replay_on_task_change: str,
    ) -> None:
        require(
            *at_least_one(hidden_size=hidden_size, buffer_size=buffer_size),
            *positive(learning_rate=learning_rate),
            *true_or_false(double=double),
        )
        super().__init__(
            num_envs,
            num_steps,
            gamma,
            n_steps,
            buffer_size,
            batch_size,
            num_updates,
            target_update_interval,
            eps_init,
            eps_end,
            annealing_num_steps,
            max_grad_norm,
            replay_on_task_change,
            priority_alpha,
            priority_beta,
        )
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
