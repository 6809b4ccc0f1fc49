"""The experiments of the lifelong tables: what they sweep, and which of their cells have no raw results."""

from __future__ import annotations

from pathlib import Path

from omegaconf import OmegaConf

from studies.raw import HERE

MASKS = ("masks_ct8_md", "masks_ct8", "masks_ct12")
"""The published comparison on its three curricula."""

EXPERIMENTS = (*MASKS, "methods")

CONF = HERE.parent.parent / "conf" / "experiment"


def eight(name: str) -> str:
    """The name of the raw results with 8 epochs of PPO, as its settings name, beside those with one."""
    return f"epochs/{name}"


def expected(name: str) -> dict[str, list[str]]:
    """What an experiment sweeps."""
    params = OmegaConf.load(CONF / f"{Path(name).name}.yaml").hydra.sweeper.params
    return {key: _choices(str(value)) for key, value in params.items()}


def _choices(text: str) -> list[str]:
    """The values of a sweep, a list or a range."""
    if text.startswith("range("):
        return [str(number) for number in range(int(text[len("range(") : -1]))]
    return text.split(",")
