"""Regions: functions of tensors that GPUs replay as CUDA graphs, without Python and without waits of the host.

Tensordict's `CudaGraphModule` waits at every call.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from ctgraph_rl.core.device import captures

Tensors = Mapping[Any, Tensor]

OwnTensors = dict[Any, Tensor]

WARM_UP = 3
"""Calls before capture, which load kernels and make optimisers' state."""


class Region:
    """A function of tensors with separate memory for its arguments and its results.

    On a GPU the first `WARM_UP` calls run the function; then it is captured as a CUDA graph, and each call copies the
    arguments and launches the graph. Elsewhere every call runs the function on copies, and returns copies, so that
    keeping a result too long fails on a CPU as well.

    Args:
        function: must not branch on data, make the host wait, or change its results' shapes. Other tensors that it
            writes to, such as weights, must stay in place.
    """

    def __init__(self, function: Callable[[OwnTensors], Tensors]) -> None:
        self.function = function
        self.graph: torch.cuda.CUDAGraph | None = None
        self._calls = 0
        self._arguments: OwnTensors = {}
        self._results: OwnTensors = {}

    def __call__(self, arguments: Tensors) -> OwnTensors:
        """Return the results, which the next call overwrites. Keys, shapes and dtypes stay as in the first call."""
        self._write(self._arguments, arguments)
        self._calls += 1
        if not captures(next(iter(self._arguments.values())).device):
            self._run()
        elif self.graph is None and self._calls <= WARM_UP:
            stream = torch.cuda.Stream()  # another stream than the usual one, as a capture has
            usual = torch.cuda.current_stream()
            stream.wait_stream(usual)
            with torch.cuda.stream(stream):
                self._run()
            usual.wait_stream(stream)
        else:
            if self.graph is None:
                graph = torch.cuda.CUDAGraph()
                with torch.cuda.graph(graph):
                    self._results = dict(self.function(dict(self._arguments)))  # in the memory of the graph
                self.graph = graph
            self.graph.replay()
        return dict(self._results)

    def copies(self, arguments: Tensors) -> OwnTensors:
        """Return the results, all of one shape, as copies."""
        found = self(arguments)
        return dict(zip(found, torch.stack(list(found.values())).unbind(), strict=True))

    def takes(self, arguments: Tensors) -> bool:
        """Return whether arguments have the first call's shapes."""
        shapes = {key: value.shape for key, value in self._arguments.items()}
        return not shapes or shapes == {key: value.shape for key, value in arguments.items()}

    def _run(self) -> None:
        self._write(self._results, self.function(dict(self._arguments)))

    @staticmethod
    def _write(buffers: OwnTensors, values: Tensors) -> None:
        if not buffers:
            buffers.update({key: value.detach().clone() for key, value in values.items()})
            return
        for key, value in values.items():
            buffers[key].copy_(value)
