"""QR-DQN with an LSTM: the distribution of returns by quantile regression, with memory.

Dabney et al. 2018 (arXiv 1710.10044) on the recurrent parts of `baselines.recurrent_q`.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import huber_loss
from torchrl.data import Composite, TensorSpec

from baselines.recurrent_q import RecurrentQ


class QRDQNLSTM(RecurrentQ):
    """Recurrent Q-learning of K quantiles for each action.

    Args:
        observation_spec: the environment's ``observation_spec_unbatched``.
        action_spec: the environment's ``action_spec_unbatched``.
        num_envs: rows that it learns from.
        num_steps: steps of each row between two rounds of updates, the length of the sequences.
        hidden_size: width of features and LSTM.
        num_quantiles: quantiles of the return's distribution, K.
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
        num_quantiles: int,
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
            num_quantiles,
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
        """The quantile Huber loss, eq. (10) of the paper with kappa = 1, summed over predicted quantiles."""
        predicted, target = torch.broadcast_tensors(predicted.unsqueeze(-1), target.unsqueeze(-2))
        fractions = (torch.arange(predicted.shape[-2], device=predicted.device) + 0.5) / predicted.shape[-2]
        weight = (fractions.unsqueeze(-1) - (target < predicted).float()).abs()
        return (weight * huber_loss(predicted, target, reduction="none")).mean(dim=-1).sum(dim=-1)
