"""LSTM-PPO: clipped policy gradients with a recurrent trunk that actor and critic share.

Schulman et al. 2017 (arXiv 1707.06347). The loss has the values of TorchRL's `ClipPPOLoss`. Minibatches are whole rows
of a batch, so the trunk sees sequences in order. Its state is reset wherever ``is_init`` is set.
"""

from baselines.ppo import PPO


class LSTMPPO(PPO):
    """PPO with an LSTM before the heads; the arguments are those of `PPO`."""

    memory = True
    solves = "partially observable tasks too, if episodes are short enough to remember"
