"""What bounds learning: its matrix products, timed separately, for `baselines.benchmark`."""

from __future__ import annotations

import math
import statistics
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

Shape = tuple[int, int, int]
"""Rows, inner size and columns of a matrix product."""

ROUNDS = 20
"""Products of one shape that are timed in a round."""


class Products(TorchDispatchMode):
    """Counts the matrix products that are computed while it is entered, by their shapes."""

    def __init__(self) -> None:
        super().__init__()
        self.shapes: Counter[Shape] = Counter()

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        """Call an operation, and count it if it is a product."""
        name = func.overloadpacket.__name__
        if name in ("mm", "addmm"):
            self._count(*args[-2:])
        elif name == "mkldnn_rnn_layer":  # an LSTM without gradients, of inputs [rows, steps, ...]
            inputs, of_inputs, of_state = args[:3]
            self._count(inputs.flatten(0, 1), of_inputs.t())
            self._count(inputs.new_empty(inputs[..., 0].numel(), of_state.shape[1]), of_state.t())
        return func(*args, **(kwargs or {}))

    def _count(self, left: Tensor, right: Tensor) -> None:
        self.shapes[left.shape[0], left.shape[1], right.shape[1]] += 1

    @property
    def multiply_adds(self) -> int:
        """Multiply-adds of all products."""
        return sum(math.prod(shape) * count for shape, count in self.shapes.items())

    def seconds(self) -> float:
        """Time products of random matrices of the same shapes; return the processor time of as many of each."""
        return sum(_seconds_of(shape) * count for shape, count in self.shapes.items())


def _seconds_of(shape: Shape) -> float:
    """Return the processor time of one product of a shape."""
    rows, inner, columns = shape
    left = torch.randn(rows, inner, dtype=torch.float32, device="cpu")
    right = torch.randn(inner, columns, dtype=torch.float32, device="cpu")
    torch.mm(left, right)
    start = time.process_time()
    for _ in range(ROUNDS):
        torch.mm(left, right)
    return (time.process_time() - start) / ROUNDS


def table(learners: Sequence[tuple[str, str, Callable[[], int]]], rounds: int) -> str:
    """Measure learning and its products in turn; return medians in Markdown.

    Args:
        learners: agent, task, and what learns from a batch and returns its frames, which is one that has learnt.
        rounds: how often each is measured.
    """
    columns = ["agent", "task", "steps/s", "multiply-adds a step", "only products, steps/s", "share of products"]
    lines = [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    for agent, task, learn in learners:
        times = [_measured(learn) for _ in range(rounds)]
        step, alone, count = (statistics.median(values) for values in zip(*times, strict=True))
        share = statistics.median(alone / step for step, alone, _ in times)
        lines.append(f"| {agent} | {task} | {1 / step:,.0f} | {count:,.0f} | {1 / alone:,.0f} | {100 * share:.0f} % |")
    return "\n".join(lines)


def _measured(learn: Callable[[], int]) -> tuple[float, float, float]:
    """Return seconds an environment step, those of only its products, and its multiply-adds."""
    start = time.process_time()
    frames = sum(learn() for _ in range(4))
    seconds = time.process_time() - start
    with Products() as products:
        counted = learn()
    return seconds / frames, products.seconds() / counted, products.multiply_adds / counted
