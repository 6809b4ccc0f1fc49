"""Functions of learners and tensors, compiled by ``torch.compile``."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import torch

MOST_COMPILED = 2**14
"""Gradient steps of different agents, methods and sizes that a process may compile; the compiler allows 8."""


@cache
def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of a learner and tensors, compiled once for all learners of equal structure.

    Small networks spend nearly all time between operations, where compiled code has no gaps. The compiler recompiles
    for another agent, method, setting or size of tensors only.
    """
    torch._dynamo.config.trace_autograd_ops = True  # so that gradients are in the graph; a patch costs 0.07 ms a step
    torch._dynamo.config.recompile_limit = torch._dynamo.config.accumulated_recompile_limit = MOST_COMPILED
    return torch.compile(function, fullgraph=True, dynamic=False, options=compiler_options())


def compiler_options() -> dict[str, Any]:
    """Return compiler options: no checks of sizes between operations and, without a GPU, no Python."""
    return {"size_asserts": False, "cpp_wrapper": not torch.cuda.is_available()}
