"""DRQN: double Q-learning with an LSTM and replayed sequences.

Hausknecht and Stone 2015 (arXiv 1507.06527), with stored states and double targets: see `baselines.recurrent_q`.
"""

from __future__ import annotations

from torch import Tensor
from torchrl.data import Composite, TensorSpec

from baselines.recurrent_q import RecurrentQ


class DRQN(RecurrentQ):
    """Deep recurrent Q-learning.

    Args:
        observation_spec: the environment's ``observation_spec_unbatched``.
        action_spec: the environment's ``action_spec_unbatched``.
        num_envs: rows that it learns from.
        num_steps: steps of each row between two rounds of updates, the length of the sequences.
        hidden_size: width of features and LSTM.
        learning_rate: of Adam.
        gamma: discount factor.
        n_steps: steps of a multi-step target (uncorrected).
        buffer_size: steps that the replay buffer keeps, as sequences.
        batch_size: sequences a gradient step learns from.
        num_updates: gradient steps after each batch of data.
        target_update_interval: gradient steps between two copies to the target network.
        eps_init: exploration at the start of a task.
        eps_end: exploration after ``annealing_num_steps``.
        annealing_num_steps: frames of a task over which exploration falls linearly.
        max_grad_norm: gradients are scaled down to this norm.
        replay_on_task_change: ``clear`` or ``keep`` the replay buffer where a task change is announced.
    """

    solves = "partially observable tasks too, where an episode is short enough to remember"

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
        super().__init__(
            observation_spec,
            action_spec,
            num_envs,
            num_steps,
            hidden_size,
            1,
            learning_rate,
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
        )

    def distance(self, predicted: Tensor, target: Tensor) -> Tensor:
        """The squared error of the value."""
        return (predicted - target).square().squeeze(-1)
