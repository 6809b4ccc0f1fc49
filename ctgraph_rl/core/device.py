"""The devices of this machine."""

from __future__ import annotations

import torch

from ctgraph_rl.checks import require


def checked_device(device: object) -> torch.device:
    """Return the torch device that a name, or a `torch.device`, stands for.

    Raises:
        ValueError: if there is no such device on this machine; lists the choices.
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
