"""Frame stacking: a layer that reads the features of the last few steps.

As in Mnih et al. 2015 (arXiv 1312.5602), which stacks the images themselves.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from typing_extensions import override

from baselines.cells.cell import (
    Cell,
    CellOutput,
    CellState,
    Units,
    linear_layer,
    number_episodes,
    of_frames,
    zeros_like_weights,
)
from ctgraph_rl.checks import at_most, is_int, require

MOST_FRAMES = 1000
"""Beyond the longest episodes that fit into a batch."""


def checked_frames(num_frames: int) -> int:
    """Return a valid number of frames.

    Raises:
        ValueError: for one frame, and more than `MOST_FRAMES`.
    """
    rule = f"num_frames must be an integer >= 2, got {num_frames!r}: one frame is cell=none"
    require((is_int(num_frames, 2), rule), *at_most(MOST_FRAMES, num_frames=num_frames))
    return num_frames


class Frames(Cell):
    """A linear layer with ReLU over the inputs of the last steps, zeros before the episode.

    Args:
        num_frames: steps that it reads, including the present one.
    """

    state_keys = ("recurrent_state_frames",)
    holds = "the last few steps, exactly"

    def __init__(self, num_features: int, num_outputs: int, num_actions: int, num_frames: int, **reads: bool) -> None:
        super().__init__(num_features, num_outputs, num_actions, **reads)
        self.num_frames = checked_frames(num_frames)
        self.linear = linear_layer(num_frames * self.num_inputs, num_outputs)
        self.relu = nn.ReLU()

    def zeros(self, num_rows: int) -> CellState:
        """Return zeros for earlier inputs, [num_rows, num_frames - 1, num_inputs], oldest first."""
        return (zeros_like_weights(self, num_rows, self.num_frames - 1, self.num_inputs),)

    @override
    def input_layers(self) -> list[tuple[Tensor, Tensor]]:
        return [(self.linear.weight, self.linear.bias)]

    @override
    def hidden_layers(self) -> list[Units]:
        return [Units("cell", self.linear, self.relu)]

    @override
    def step(self, inputs: Tensor, state: CellState) -> CellOutput:
        window = torch.cat([state[0], inputs.unsqueeze(1)], dim=1)
        return self.relu(self.linear(window.flatten(1))), (window[:, 1:],)

    @override
    def sequence(self, inputs: Tensor, groups: Tensor, starts: Tensor, state: CellState) -> Tensor:
        frames = torch.cat([state[0], of_frames(inputs, groups)], dim=1)
        episode = number_episodes(starts)
        earlier = episode.new_zeros(len(starts), self.num_frames - 1)
        of_frame = torch.cat([earlier, episode], dim=1)
        windows = frames.unfold(1, self.num_frames, 1).transpose(2, 3)
        same = of_frame.unfold(1, self.num_frames, 1) == episode.unsqueeze(-1)
        seen = windows * same.unsqueeze(-1)
        return self.relu(self.linear(seen.flatten(2)))
