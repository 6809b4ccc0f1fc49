"""The page of the methods, lifelong.md, and its figures."""

from __future__ import annotations

from string import Template

from ctgraph_rl.report import statistics
from studies.lifelong import comparison, pairs
from studies.lifelong.experiments import EXPERIMENTS, MASKS, eight
from studies.raw import HERE, TEMPLATES, machines, read
from studies.verdicts import undecided

PAGE = HERE / "lifelong.md"

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
        found[f"{name}_clearest"] = f"{SHORT[one]} less {SHORT[other]}, {undecided(each, len(areas))}"
    last = pairs.last_depth(LAST)
    found["last_depth"] = "; ".join(f"{SHORT[name]} {undecided(last[name], len(last))}" for name in LAST[:3])
    ends = statistics.corrected(pairs.against_finetuning(["ppo"]))
    deep = {name: each for name, each in ends.items() if name.startswith("fo_b1_depth2to5")}
    name, each = pairs.clearest(deep)
    found["growing_clearest"] = f"{name.split(', ')[1]}, {undecided(each, len(ends))}"
    return found


def page() -> str:
    """The page of the methods: its template with its tables."""
    template = Template((TEMPLATES / "lifelong.md").read_text(encoding="utf-8"))
    found = comparison.tables() | pairs.tables() | differences()
    read_here = (*EXPERIMENTS, *map(eight, MASKS))
    return template.substitute(found, machines=machines(*read_here))


def make() -> None:
    """Write the page and its figures."""
    PAGE.write_text(page(), encoding="utf-8")
    for name in MASKS:
        if read(name):
            comparison.draw(name, HERE / f"{name}.png")
    comparison.draw_by_agent(HERE / "methods.png")
