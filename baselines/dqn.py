"""DQN: double Q-learning with replay and epsilon-greedy exploration; without memory.

Mnih et al. 2015 and van Hasselt et al. 2016 (arXiv 1509.06461) on TorchRL's `QValueActor`, `EGreedyModule`,
`DQNLoss` and replay buffer.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import Composite, LazyTensorStorage, TensorDictReplayBuffer, TensorSpec
from torchrl.data.postprocs import MultiStep
from torchrl.modules import MLP, EGreedyModule, QValueActor
from torchrl.objectives import DQNLoss, HardUpdate, ValueEstimators

from baselines.learner import Learner, mean_measurements
from baselines.networks import encoder
from ctgraph_rl.checks import at_least_one, fraction, positive, require

REPLAY_KEYS = (
    "observation",
    "action",
    ("next", "observation"),
    ("next", "reward"),
    ("next", "done"),
    ("next", "terminated"),
    "steps_to_next_obs",
)


class DQN(Learner):
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
        buffer_size: transitions that the replay buffer keeps.
        batch_size: transitions a gradient step learns from.
        num_updates: gradient steps after each batch of data.
        target_update_interval: gradient steps between two copies to the target network.
        eps_init: exploration at the start of a task.
        eps_end: exploration after ``annealing_num_steps``.
        annealing_num_steps: frames of a task over which exploration falls linearly.
        max_grad_norm: gradients are scaled down to this norm.
        replay_on_task_change: ``clear`` or ``keep`` the replay buffer where a task change is announced.
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
        n_steps: int,
        buffer_size: int,
        batch_size: int,
        num_updates: int,
        target_update_interval: int,
        eps_init: float,
        eps_end: float,
        annealing_num_steps: int,
        max_grad_norm: float,
        replay_on_task_change: str,
    ) -> None:
        super().__init__(num_envs, num_steps, max_grad_norm)
        choices = ("clear", "keep")
        counts = {"hidden_size": hidden_size, "n_steps": n_steps, "buffer_size": buffer_size, "batch_size": batch_size}
        require(
            *at_least_one(**counts, num_updates=num_updates, target_update_interval=target_update_interval),
            *at_least_one(annealing_num_steps=annealing_num_steps),
            *positive(learning_rate=learning_rate, gamma=gamma),
            *fraction(gamma=gamma, eps_init=eps_init, eps_end=eps_end),
            (
                replay_on_task_change in choices,
                f"replay_on_task_change must be one of {', '.join(choices)}, got {replay_on_task_change!r}",
            ),
        )
        require((eps_end <= eps_init, f"eps_end must be <= eps_init={eps_init!r}, got {eps_end!r}"))
        self.num_updates, self.replay_on_task_change = num_updates, replay_on_task_change
        head = MLP(
            in_features=hidden_size, out_features=action_spec.space.n, num_cells=[hidden_size], activation_class=nn.ReLU
        )
        values = TensorDictModule(head, in_keys=["features"], out_keys=["action_value"])
        network = TensorDictSequential(encoder(observation_spec, hidden_size), values)
        self.greedy = QValueActor(network, in_keys=["observation"], spec=action_spec)
        batches = max(1, annealing_num_steps // (num_envs * num_steps))
        self.exploration = EGreedyModule(action_spec, float(eps_init), float(eps_end), batches)
        self.policy = TensorDictSequential(self.greedy, self.exploration, selected_out_keys=["action"])
        self.dqn = DQNLoss(self.greedy, delay_value=True, double_dqn=True, action_space=action_spec)
        self.dqn.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
        self.target_update = HardUpdate(self.dqn, value_network_update_interval=target_update_interval - 1)
        self.multi_step = MultiStep(gamma, n_steps)
        self.multi_step.done_keys = ()  # so that the end of an episode is known where the target reaches it
        self.replay = TensorDictReplayBuffer(storage=LazyTensorStorage(buffer_size), batch_size=batch_size)
        self.optimiser = torch.optim.Adam(self.greedy.parameters(), lr=learning_rate, fused=True)

    def start_task(self) -> None:
        """Explore anew; forget the old task's transitions if so configured."""
        self.exploration.eps.copy_(self.exploration.eps_init)
        if self.replay_on_task_change == "clear":
            self.replay.empty()

    def loss(self, batch: TensorDictBase) -> TensorDictBase:
        """The double-DQN loss of transitions, with the target network's values."""
        return TensorDict({"loss_value": self.dqn(batch)["loss"]})

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Store a batch, take gradient steps on replayed transitions, explore less; returns mean measurements."""
        self.replay.extend(self.multi_step(batch).select(*REPLAY_KEYS).reshape(-1))
        steps = [self._update() for _ in range(self.num_updates)]
        self.exploration.step()
        return {**mean_measurements(steps), "exploration": self.exploration.eps.item()}

    def _update(self) -> dict[str, Tensor]:
        device = next(self.parameters()).device  # the buffer stays on the CPU
        measured = self.gradient_step(self.replay.sample().to(device))
        self.target_update.step()
        return measured

    def get_extra_state(self) -> dict[str, Any]:
        """The optimiser's state, the replay buffer and the gradient steps since the last copy to the target network."""
        own = {"replay": self.replay.state_dict(), "target_age": self.target_update.counter}
        return {**super().get_extra_state(), **own}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore what `get_extra_state` gave."""
        super().set_extra_state(state)
        self.replay.load_state_dict(state["replay"])
        self.target_update.counter = state["target_age"]
