"""The devices of this machine, and torch's default dtype and device."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from ctgraph_rl.checks import require


def checked_device(device: object) -> torch.device:
    """Return the torch device of a name or `torch.device`.

    Raises:
        ValueError: if this machine has no such device; lists the choices.
    """
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    choices = ["cpu", *(["cuda"] if count else []), *(f"cuda:{i}" for i in range(count))]
    try:
        found = torch.device(device) if isinstance(device, (str, torch.device)) else None
    except RuntimeError:
        found = None
    there = found is not None and (found.type == "cpu" or str(found) in choices)
    require((there, f"device must be one of {', '.join(choices)} on this machine, got {device!r}"))
    return torch.device("cpu") if found is None or found.type == "cpu" else found


def captures(device: torch.device | None) -> bool:
    """Return whether a `Region` on a device is captured: on GPUs."""
    return device is not None and device.type == "cuda"


@contextmanager
def torchs_defaults() -> Iterator[None]:
    """Give others' code that names no dtype and device float32 and the CPU, whatever the user's defaults."""
    dtype = torch.get_default_dtype()
    if dtype == torch.float32 and torch.get_default_device().type == "cpu":
        yield
        return
    torch.set_default_dtype(torch.float32)
    try:
        with torch.device("cpu"):
            yield
    finally:
        torch.set_default_dtype(dtype)
