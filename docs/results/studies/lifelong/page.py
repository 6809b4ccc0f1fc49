"""The page of the methods, lifelong.md, and its figures."""

from __future__ import annotations

from pathlib import Path

from ctgraph_rl.report import statistics
from studies.lifelong import comparison, pairs
from studies.lifelong.comparison import MASKS
from studies.raw import fill, machines
from studies.verdicts import undecided

SHORT = {
    "finetune": "fine-tuned PPO",
    "ewc": "EWC",
    "ewc_published": "EWC",
    "mask_lc": "Mask LC",
    "mask_ri": "Mask RI",
    "mask_blc": "Mask BLC",
}
LAST = ("ewc", "mask_lc", "mask_blc", "mas", "packnet", "si")
"""Methods that are compared with fine-tuning by the seeds that find depth 5."""


def differences() -> dict[str, str]:
    """What the page says of differences that the tests did not find."""
    found = {}
    for name in ("masks_ct8", "masks_ct12"):
        areas = pairs.compare_areas(name)
        (one, other), each = pairs.clearest(areas)
        found[f"{name}_clearest"] = f"{SHORT[one]} less {SHORT[other]}, {undecided(each)}"
    last = pairs.last_depth(LAST)
    found["last_depth"] = "; ".join(f"{SHORT[name]} {undecided(last[name])}" for name in LAST[:3])
    ends = statistics.corrected(pairs.against_finetuning(["ppo"]))
    deep = {name: each for name, each in ends.items() if name.startswith("fo_b1_depth2to5")}
    name, each = pairs.clearest(deep)
    found["growing_clearest"] = f"{name.split(', ')[1]}, {undecided(each)}"
    return found


def page() -> str:
    """The page of the methods."""
    found = {name: comparison.summary(name) for name in MASKS}
    found |= {"claims": pairs.rows(pairs.claims()), "methods_ppo": pairs.by_ppo()}
    found["machines"] = machines(*MASKS, *(f"epochs/{name}" for name in MASKS), "methods")
    return fill("lifelong", found | differences())


def draw(folder: Path) -> None:
    """Draw the figures."""
    for name in MASKS:
        comparison.draw(name, folder / f"{name}.png")
    comparison.draw_by_agent(folder / "methods.png")
