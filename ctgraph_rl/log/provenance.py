"""Provenance: the versions and the machine that a run's numbers depend on, for the first line of its log."""

from __future__ import annotations

import platform
from dataclasses import replace
from typing import Any

import tensordict
import torch
import torchrl

from ctgraph_rl import __version__
from ctgraph_rl.log.run_log import SCHEMA
from ctgraph_rl.packages import is_published
from ctgraph_rl.portable import cpu_model, is_portable
from ctgraph_rl.tasks.curriculum import Curriculum

NUMBERS = 1
"""The numbers version of this package: raised when equal configurations and seeds give other weights or measurements.

Every run stores it. A log without it is of numbers version 1.
"""


def versions() -> dict[str, str]:
    """Return the versions of this package and of what computes its numbers."""
    return {
        "ctgraph_rl": __version__,
        "torch": torch.__version__,
        "torchrl": torchrl.__version__,
        "tensordict": tensordict.__version__,
        "python": platform.python_version(),
    }


def named(curriculum: Curriculum) -> Curriculum:
    """Return the curriculum, with ``(modified)`` behind its name if another one is published under that name."""
    modified = is_published(curriculum) is False
    return replace(curriculum, name=f"{curriculum.name} (modified)") if modified else curriculum


def provenance(curriculum: Curriculum) -> dict[str, Any]:
    """Return curriculum, versions and machine as plain values for JSON. Tasks are counted from 1."""
    return {
        "schema": SCHEMA,
        "curriculum": named(curriculum).name,
        **{name: getattr(curriculum, name) for name in ("version", "fingerprint", "source")},
        "tasks": list(curriculum.labels),
        "trained": [[number + 1 for number in block] for block in curriculum.trained],
        "versions": versions(),
        "numbers": NUMBERS,
        **machine(),
        "cpu": cpu_model(),
    }


def machine() -> dict[str, Any]:
    """Return what besides versions decides the bits of a run on a CPU: its kind and the number of threads.

    The kind is such as ``x86_64 AVX512``, or ``x86_64 portable`` for any CPU of `ctgraph_rl.portable`.
    """
    instructions = "portable" if is_portable() else torch.backends.cpu.get_cpu_capability()
    kind = f"{platform.machine()} {instructions}"
    return {"machine": kind, "num_threads": torch.get_num_threads()}
