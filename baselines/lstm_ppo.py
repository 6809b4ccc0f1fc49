"""LSTM-PPO: clipped policy gradients with a recurrent trunk that actor and critic share.

Schulman et al. 2017 (arXiv 1707.06347), with the loss of TorchRL's `ClipPPOLoss`. Minibatches are whole rows of a
batch, so the trunk sees sequences in order; its state resets at ``is_init``.
"""

from baselines.ppo import PPO


class LSTMPPO(PPO):
    """PPO with an LSTM before the heads; arguments as in `PPO`."""

    memory = True
    solves = "partially observable tasks too, if episodes are short enough to remember"
