"""Attention: a block of a causal transformer over the last steps of an episode.

Vaswani et al. 2017 (arXiv 1706.03762), with normalised inputs and output (Xiong et al. 2020, arXiv 2002.04745), and a
learned bias for each head and distance (Raffel et al. 2020, arXiv 1910.10683):

    x_t = W x'_t,  n_t = norm(x_t),  a_t = sum_s softmax_s(q(n_t) . k(n_s) / sqrt(n) + bias_{t-s}) v(n_s),
    y_t = x_t + W_o a_t,  output_t = norm(y_t + W_2 relu(W_1 norm(y_t))),

where s are the steps of the episode among the last ``num_frames``, and x' are the inputs.
"""

from __future__ import annotations

import math

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
from baselines.cells.frames import checked_frames
from ctgraph_rl.checks import at_least_one, require


class Attention(Cell):
    """A block of a causal transformer over the last steps of an episode.

    The state holds their inputs, each with a 1, and zeros for steps before the episode.

    Args:
        num_outputs: width of the output; a multiple of ``num_heads``.
        num_frames: steps, including the present one.
    """

    state_keys = ("recurrent_state_frames",)
    merges_rows = True
    gains_together = False
    holds = "each of the last steps, by what was seen there"

    def __init__(
        self, num_features: int, num_outputs: int, num_actions: int, num_frames: int, num_heads: int, **reads: bool
    ) -> None:
        super().__init__(num_features, num_outputs, num_actions, **reads)
        self.num_frames = checked_frames(num_frames)
        self.step_cost = 0.6 * num_frames  # each step computes the keys of all frames again
        require(*at_least_one(num_heads=num_heads))
        divided = f"hidden_size must be a multiple of num_heads={num_heads}, got {num_outputs}"
        require((num_outputs % num_heads == 0, divided))
        self.num_heads = num_heads
        self.enter = linear_layer(self.num_inputs, num_outputs)
        self.attended = linear_layer(num_outputs, 3 * num_outputs)
        self.leave = linear_layer(num_outputs, num_outputs)
        self.wider = linear_layer(num_outputs, 2 * num_outputs)
        self.relu = nn.ReLU()
        self.narrower = linear_layer(2 * num_outputs, num_outputs)
        self.first_norm = nn.LayerNorm(num_outputs, dtype=torch.float32, device="cpu")
        self.second_norm = nn.LayerNorm(num_outputs, dtype=torch.float32, device="cpu")
        self.last_norm = nn.LayerNorm(num_outputs, dtype=torch.float32, device="cpu")
        self.bias = nn.Parameter(torch.empty(num_heads, num_frames, dtype=torch.float32, device="cpu"))
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Set the biases of distances to 0."""
        nn.init.zeros_(self.bias)

    def zeros(self, num_rows: int) -> CellState:
        """Return zeros for earlier inputs, [num_rows, num_frames - 1, num_inputs + 1], oldest first."""
        return (zeros_like_weights(self, num_rows, self.num_frames - 1, self.num_inputs + 1),)

    @override
    def input_layers(self) -> list[tuple[Tensor, Tensor]]:
        return [(self.enter.weight, self.enter.bias)]

    @override
    def hidden_layers(self) -> list[Units]:
        return [Units("wider", self.wider, self.relu, self.narrower)]

    @override
    def step(self, inputs: Tensor, state: CellState) -> CellOutput:
        present = torch.cat([inputs, torch.ones_like(inputs[:, :1])], dim=1).unsqueeze(1)
        frames = torch.cat([state[0], present], dim=1)
        seen = frames[..., -1] > 0
        output = self._block(frames[..., :-1], 1, seen.unsqueeze(1))
        return output.squeeze(1), (frames[:, 1:],)

    @override
    def sequence(self, inputs: Tensor, groups: Tensor, starts: Tensor, state: CellState) -> Tensor:
        present = of_frames(inputs, groups)
        frames = torch.cat([state[0][..., :-1], present], dim=1)
        episode = number_episodes(starts)
        earlier = torch.where(state[0][..., -1] > 0, 0, -1)
        of_frame = torch.cat([earlier, episode], dim=1)
        same = of_frame.unsqueeze(1) == episode.unsqueeze(2)
        return self._block(frames, groups.shape[1], same)

    def _block(self, frames: Tensor, num_steps: int, same: Tensor) -> Tensor:
        """Return the outputs of the last steps, [rows, num_steps, num_outputs].

        Args:
            frames: inputs of all steps, [rows, frames, num_inputs].
            num_steps: steps with an output.
            same: whether a frame is of a step's episode, bool [rows, num_steps, frames].
        """
        x = self.enter(frames)
        q, k, v = self.attended(self.first_norm(x)).chunk(3, dim=-1)
        q = self._by_head(q[:, -num_steps:])
        k = self._by_head(k)
        v = self._by_head(v)
        places = torch.arange(frames.shape[1], device=frames.device)
        distance = places[-num_steps:].unsqueeze(1) - places
        near = (distance >= 0) & (distance < self.num_frames)
        bias = self.bias[:, distance.clamp(0, self.num_frames - 1)]
        scores = q @ k.transpose(-1, -2) / math.sqrt(q.shape[-1]) + bias
        hidden = ~(same & near).unsqueeze(1)
        shares = scores.masked_fill(hidden, -torch.inf).softmax(dim=-1)
        a = (shares @ v).transpose(1, 2).flatten(2)
        y = x[:, -num_steps:] + self.leave(a)
        wide = self.relu(self.wider(self.second_norm(y)))
        return self.last_norm(y + self.narrower(wide))

    def _by_head(self, values: Tensor) -> Tensor:
        return values.unflatten(-1, (self.num_heads, -1)).transpose(1, 2)
