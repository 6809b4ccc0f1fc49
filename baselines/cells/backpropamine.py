"""Backpropamine: a recurrent layer whose weights change within an episode, as the network itself modulates.

Miconi et al. 2019, "Backpropamine: training self-modifying neural networks with differentiable neuromodulated
plasticity" (ICLR, arXiv 2002.10585). Each connection has slow weights W, fast weights Hebb, which an episode starts at
0, and a learned plasticity A:

    h_t = tanh(W_i x_t + h_{t-1} (W + A * Hebb_{t-1})),  m_t = tanh(w_m h_t + b),  eta_t = m_t f + g, one of each unit,

    simple:       Hebb_t = clip(Hebb_{t-1} + eta_t h_{t-1} h_t^T, -2, 2),
    retroactive:  Hebb_t = clip(Hebb_{t-1} + eta_t E_{t-1}, -2, 2),  E_t = (1 - eta) E_{t-1} + eta h_{t-1} h_t^T,
    none:         Hebb_t = clip(Hebb_{t-1} + eta h_{t-1} h_t^T, -2, 2), differentiable plasticity without modulation,

where eta without an index is one learned number, and row i, column j of Hebb belongs to the connection from unit i to
unit j. W and A start in [0, 0.001). The paper also feeds the last action and reward, which are settings here, and the
time.

Fast weights take 4 H^2 bytes an environment, twice that if retroactive, and while a gradient is computed as much for
each step.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from typing_extensions import override

from baselines.cells.cell import Cell, CellOutput, CellState, linear_layer, of_frames, zeros_like_weights
from baselines.cells.plastic_sequence import Plastic, PlasticSequence, PlasticSteps, columns_times
from ctgraph_rl.checks import one_of, require

LARGEST_FAST_WEIGHT = 2.0

MODULATIONS = ("simple", "retroactive", "none")


class Backpropamine(Cell):
    """A recurrent layer with plastic weights; other arguments as in `Cell`.

    Args:
        num_outputs: number of units, H.
        modulation: ``simple``, ``retroactive`` or ``none``.
    """

    step_cost = 1.5
    gains_together = False  # the fast weights of several seeds leave the cache at each step
    holds = "what its units did together within an episode, in as many numbers as it has connections"

    def __init__(
        self, num_features: int, num_outputs: int, num_actions: int, modulation: str = "simple", **reads: bool
    ) -> None:
        super().__init__(num_features, num_outputs, num_actions, **reads)
        require(*one_of(MODULATIONS, modulation=modulation))
        self.modulation = modulation
        self.state_keys = ("unstored_hidden", "unstored_hebb")
        if modulation == "retroactive":
            self.state_keys += ("unstored_trace",)
        self.input = linear_layer(self.num_inputs, num_outputs)
        self.recurrent = nn.Parameter(torch.empty(num_outputs, num_outputs, dtype=torch.float32, device="cpu"))
        self.plasticity = nn.Parameter(torch.empty(num_outputs, num_outputs, dtype=torch.float32, device="cpu"))
        if modulation != "none":
            self.modulator = linear_layer(num_outputs, 1)
            self.fan_out = linear_layer(1, num_outputs)
        if modulation != "simple":
            self.rate = nn.Parameter(torch.empty((), dtype=torch.float32, device="cpu"))
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Draw W and A, and set the learned rate to 0.01."""
        nn.init.uniform_(self.recurrent, 0, 0.001)
        nn.init.uniform_(self.plasticity, 0, 0.001)
        if self.modulation != "simple":
            nn.init.constant_(self.rate, 0.01)

    def zeros(self, num_rows: int) -> CellState:
        """Return the units, [num_rows, H], and the fast weights, [num_rows, H, H] each."""
        size = self.num_outputs
        units = zeros_like_weights(self, num_rows, size)
        matrices = [zeros_like_weights(self, num_rows, size, size) for _ in self.state_keys[1:]]
        return (units, *matrices)

    @override
    def input_layers(self) -> list[tuple[Tensor, Tensor]]:
        return [(self.input.weight, self.input.bias)]

    @override
    def step(self, inputs: Tensor, state: CellState) -> CellOutput:
        return self._step(self.input(inputs), state)

    @override
    def sequence(self, inputs: Tensor, groups: Tensor, starts: Tensor, state: CellState) -> Tensor:
        given = of_frames(self.input(inputs), groups.T)
        resets = [start.nonzero().squeeze(-1) for start in starts.unbind(1)]
        resets[0] = resets[0][:0]  # zero already
        steps = PlasticSteps(self._step, LARGEST_FAST_WEIGHT, resets)
        plastic = Plastic(self.recurrent, self.plasticity, None if self.modulation == "simple" else self.rate)
        if self.modulation != "none":
            plastic = plastic._replace(
                modulator=self.modulator.weight,
                modulator_bias=self.modulator.bias,
                fan_out=self.fan_out.weight,
                fan_out_bias=self.fan_out.bias,
            )
        return PlasticSequence.apply(steps, given, *plastic, *state)

    def _step(self, given: Tensor, state: CellState, product: Tensor | None = None) -> CellOutput:
        before, hebb, *traces = state
        fast = torch.mul(self.plasticity, hebb, out=product)
        units = (given + before @ self.recurrent + columns_times(before, fast)).tanh()
        eta = self.rate if self.modulation == "none" else self.fan_out(self.modulator(units).tanh())
        column = before.unsqueeze(2)
        if self.modulation == "retroactive":
            [trace] = traces
            hebb = torch.addcmul(hebb, trace, eta.unsqueeze(1))
            traces = [trace.lerp(column * units.unsqueeze(1), self.rate)]
        else:
            hebb = torch.addcmul(hebb, column, (eta * units).unsqueeze(1))
        hebb = hebb.clamp_(-LARGEST_FAST_WEIGHT, LARGEST_FAST_WEIGHT)
        return units, (units, hebb, *traces)
