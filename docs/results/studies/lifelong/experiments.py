"""The experiments of the lifelong tables: what they sweep, and which of their cells have no raw results."""

from __future__ import annotations

from itertools import product
from pathlib import Path

from omegaconf import OmegaConf

from studies.raw import HERE, Raw, groups, read

MASKS = ("masks_ct8_md", "masks_ct8", "masks_ct12")
"""The published comparison on its three curricula."""

EXPERIMENTS = (*MASKS, "methods")
MORE_SEEDS = {"methods": {"ppo": 20}}
"""Agents that were run with more seeds than their experiment sweeps, and how many."""

CONF = HERE.parent.parent / "conf" / "experiment"

MOST_NAMED = 12
"""Cells without results are named up to so many, apart from seeds; else counted."""


def eight(name: str) -> str:
    """The name of the raw results with 8 epochs of PPO, as its settings name, beside those with one."""
    return f"epochs/{name}"


def expected(name: str) -> dict[str, list[str]]:
    """What an experiment sweeps."""
    params = OmegaConf.load(CONF / f"{Path(name).name}.yaml").hydra.sweeper.params
    return {key: _choices(str(value)) for key, value in params.items()}


def cells_of(name: str) -> dict[tuple[str, ...], None]:
    """The cells of an experiment and those with `MORE_SEEDS`: their values of what it sweeps, in order."""
    swept = expected(name)
    more = [{"agent": [agent], "seed": _choices(f"range({n})")} for agent, n in MORE_SEEDS.get(name, {}).items()]
    return dict.fromkeys(cell for axes in ({}, *more) for cell in product(*(swept | axes).values()))


def curricula_of(name: str) -> list[str]:
    """The curricula of an experiment: those that it sweeps, or the one that it chooses."""
    defaults = OmegaConf.select(OmegaConf.load(CONF / f"{Path(name).name}.yaml"), "defaults", default=[])
    chosen = [str(each[key]) for each in defaults for key in each if key == "override /curriculum"]
    return expected(name).get("curriculum", chosen)


def _choices(text: str) -> list[str]:
    """The values of a sweep, a list or a range."""
    if text.startswith("range("):
        return [str(number) for number in range(int(text[len("range(") : -1]))]
    return text.split(",")


def lacking(name: str, lines: Raw) -> list[tuple[str, ...]]:
    """Which cells of an experiment some lines lack."""
    there = set(groups(lines, *expected(name)))
    return [cell for cell in cells_of(name) if cell not in there]


def missing(name: str) -> str:
    """Which cells of an experiment have no raw results."""
    swept, wanted = expected(name), cells_of(name)
    without = lacking(name, read(name))
    if not without:
        return "All cells were run."
    place = list(swept).index("seed")
    by_seed: dict[tuple[str, ...], list[str]] = {}
    for cell in without:
        by_seed.setdefault(cell[:place] + cell[place + 1 :], []).append(cell[place])
    count = f"Not run yet: {len(without)} of {len(wanted)} cells"
    cells = "; ".join(f"{' '.join(cell)} (seeds {', '.join(seeds)})" for cell, seeds in by_seed.items())
    return f"{count}." if len(by_seed) > MOST_NAMED else f"{count}, {cells}."
