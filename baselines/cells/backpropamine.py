"""Backpropamine: a recurrent layer whose weights change within an episode, as the network itself modulates.

Miconi et al. 2019, "Backpropamine: training self-modifying neural networks with differentiable neuromodulated
plasticity" (ICLR, arXiv 2002.10585). Beside slow weights W each connection has fast weights Hebb, which start at 0 with
an episode, and a learned plasticity A:

    h_t = tanh(W_i x_t + h_{t-1} (W + A * Hebb_{t-1})),  m_t = tanh(w_m h_t + b),  eta_t = m_t f + g, one of each unit,

    simple:       Hebb_t = clip(Hebb_{t-1} + eta_t h_{t-1} h_t^T, -2, 2),
    retroactive:  Hebb_t = clip(Hebb_{t-1} + eta_t E_{t-1}, -2, 2),  E_t = (1 - eta) E_{t-1} + eta h_{t-1} h_t^T,
    none:         Hebb_t = clip(Hebb_{t-1} + eta h_{t-1} h_t^T, -2, 2), differentiable plasticity without modulation,

where eta without an index is one learned number, and row i, column j of Hebb belongs to the connection from unit i to
unit j. W and A start in [0, 0.001). The paper also feeds the last action, the last reward and the time; here the first
two are settings, and no cell reads the time.

Fast weights are H^2 numbers an environment, 4 H^2 bytes, twice that if retroactive. A batch holds them once, before its
first step: with 256 environments, 32 steps and H = 64, 4 MB in place of 134 MB. Learning from a sequence keeps some ten
such matrices for each of its steps while the gradient is computed.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from baselines.cells.cell import Cell, State, reset, zeros_like_weights
from ctgraph_rl.checks import one_of, require

LARGEST_FAST_WEIGHT = 2.0

MODULATIONS = ("simple", "retroactive", "none")


class Backpropamine(Cell):
    """A recurrent layer with plastic weights.

    Args:
        num_features: see `Cell`.
        num_outputs: number of units, H.
        num_actions: see `Cell`.
        modulation: ``simple``, ``retroactive`` or ``none``.
        reads: further arguments of `Cell`.
    """

    holds = "what its units did together within an episode, in as many numbers as it has connections"

    def __init__(
        self, num_features: int, num_outputs: int, num_actions: int, modulation: str = "simple", **reads: bool
    ) -> None:
        super().__init__(num_features, num_outputs, num_actions, **reads)
        require(*one_of(MODULATIONS, modulation=modulation))
        self.modulation = modulation
        self.state_keys = ("unstored_hidden", "unstored_hebb", *["unstored_trace"] * (modulation == "retroactive"))
        self.input = nn.Linear(self.num_inputs, num_outputs)
        self.recurrent, self.plasticity = (nn.Parameter(torch.empty(num_outputs, num_outputs)) for _ in range(2))
        if modulation != "none":
            self.modulator, self.fan_out = nn.Linear(num_outputs, 1), nn.Linear(1, num_outputs)
        if modulation != "simple":
            self.rate = nn.Parameter(torch.empty(()))
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Draw W and A, and set the learned rate to 0.01; the linear layers draw their own."""
        for weights in (self.recurrent, self.plasticity):
            nn.init.uniform_(weights, 0, 0.001)
        if self.modulation != "simple":
            nn.init.constant_(self.rate, 0.01)

    def zeros(self, num_rows: int) -> State:
        """Return the units, [num_rows, H], and the fast weights, [num_rows, H, H] each."""
        size = self.num_outputs
        matrices = (zeros_like_weights(self, num_rows, size, size) for _ in self.state_keys[1:])
        return (zeros_like_weights(self, num_rows, size), *matrices)

    def step(self, inputs: Tensor, state: State) -> tuple[Tensor, State]:
        """See `Cell`."""
        return self._step(self.input(inputs), state)

    def sequence(self, inputs: Tensor, groups: Tensor, starts: Tensor, state: State) -> Tensor:
        """See `Cell`; inputs are multiplied with their weights once a group."""
        given, outputs = self.input(inputs), []
        resets = starts.any(dim=0).tolist() if starts.is_cpu else [True] * starts.shape[1]  # a GPU would have to wait
        for group, start, some in zip(groups.unbind(1), starts.unbind(1), resets, strict=True):
            output, state = self._step(given.index_select(0, group), reset(state, start) if some else state)
            outputs.append(output)
        return torch.stack(outputs, dim=1)

    def _step(self, given: Tensor, state: State) -> tuple[Tensor, State]:
        """Take a step from the inputs times their weights, [rows, H]."""
        before, hebb, *trace = state
        fast = (before.unsqueeze(1) @ (self.plasticity * hebb)).squeeze(1)
        units = (given + before @ self.recurrent + fast).tanh()
        pairs = before.unsqueeze(2) * units.unsqueeze(1)
        change = self._rate(units) * (trace[0] if trace else pairs)
        following = (hebb + change).clamp(-LARGEST_FAST_WEIGHT, LARGEST_FAST_WEIGHT)
        return units, (units, following, *(each.lerp(pairs, self.rate) for each in trace))

    def _rate(self, units: Tensor) -> Tensor:
        """Compute eta_t, [rows, 1, H], or the learned rate without modulation."""
        if self.modulation == "none":
            return self.rate
        return self.fan_out(self.modulator(units).tanh()).unsqueeze(1)
