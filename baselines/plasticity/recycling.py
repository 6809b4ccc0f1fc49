"""The base class of methods that recycle hidden units."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from baselines.plasticity.plasticity import Plasticity
from ctgraph_rl.checks import require, true_or_false


class Recycling(Plasticity):
    """Units with ReLU start again: new incoming weights, biases of 0, outgoing weights of 0.

    Incoming weights are drawn as at construction; a layer norm's scale is 1 and its offset 0. Heads of actor and critic
    and the gates of a cell all read a unit. The units of a convolution are its channels. A target network follows at
    its next copy.

    Args:
        reset_moments: also set the optimiser's moments of these weights to 0; its count of steps stays.
    """

    recycles = reads_units = True
    stackable = False

    def __init__(self, reset_moments: bool) -> None:
        super().__init__()
        require(*true_or_false(reset_moments=reset_moments))
        self.reset_moments = reset_moments

    def recycle(self, chosen: Sequence[Tensor], means: Sequence[Tensor] | None = None) -> int:
        """Recycle units; return how many.

        Args:
            chosen: of each layer, bool [units].
            means: of their activations, which the biases of what reads them take over; None: nothing is taken over.
        """
        count = int(torch.cat(list(chosen)).sum())
        if not count:
            return 0
        with self.rewriting():
            if means is not None:
                for layer, units, mean in zip(self.layers, chosen, means, strict=True):
                    for reader in layer.readers:
                        moved = reader.weight[:, reader.columns[units]] * mean[units].unsqueeze(-1)
                        reader.bias.add_(moved.sum(dim=(1, 2)))
            drawn = self.draw_weights()
            for layer, units in zip(self.layers, chosen, strict=True):
                self._set(layer.linear.weight, units, drawn[layer.linear.weight][units])
                self._set(layer.linear.bias, units, 0.0)
                if layer.norm is not None:
                    self._set(layer.norm.weight, units, 1.0)
                    self._set(layer.norm.bias, units, 0.0)
            for layer, units in zip(self.layers, chosen, strict=True):
                for reader in layer.readers:
                    self._set(reader.weight, (slice(None), reader.columns[units].flatten()), 0.0)
        return count

    def _set(self, parameter: Tensor, index: Any, value: Tensor | float) -> None:
        parameter[index] = value
        if self.reset_moments:
            self.clear_moments(parameter, index)
