"""What lifelong.md says in short, and what raw results must be for it."""

from __future__ import annotations

import torch
from studies.lifelong.comparison import MASKS
from studies.verdicts import ALPHA

from ctgraph_rl.report.statistics import compare
from helpers.conclusions.sentences import Sentences
from helpers.mastered import Table

says = Sentences()

MASK_METHODS = ("mask_lc", "mask_ri", "mask_blc")
EWC = "ewc_published"


def known(table: Table, method: str) -> float:
    """Return the mean share of tasks that a method knows at the end."""
    return table.known(method).double().mean().item()


@says("Masks keep every task that they learn. Fine-tuned PPO forgets.")
def _() -> bool:
    tables = [Table(name) for name in MASKS]
    keep = all(torch.equal(of.known(method), of.own(method)) for of in tables for method in MASK_METHODS)
    learned = min(of.own(method).double().mean().item() for of in tables for method in MASK_METHODS)
    return keep and learned > 0.5 and all(known(of, "finetune") < 0.3 for of in tables)


@says(
    "EWC forgets with the 8 epochs of the published settings. With one epoch, as in the public code, EWC keeps all "
    "tasks of CT8 and CT12 in every seed."
)
def _() -> bool:
    many = [Table(f"epochs/{name}") for name in MASKS]
    one = [Table(name) for name in ("masks_ct8", "masks_ct12")]
    return all(known(of, EWC) < of.own(EWC).double().mean() - 0.2 for of in many) and all(
        of.known(EWC).all() for of in one
    )


@says(
    "The paper claims that masks know more at the end than EWC. On CT8 multi-depth this holds for Mask LC and Mask "
    "BLC; 20 seeds cannot decide it for Mask RI. On CT8 and CT12 no method can know more than EWC, which keeps all "
    "tasks with one epoch."
)
def _() -> bool:
    of = Table("masks_ct8_md")
    shares = {method: of.known(method).double().mean(1).tolist() for method in (*MASK_METHODS, EWC)}
    found = {method: is_higher(shares[method], shares[EWC]) for method in MASK_METHODS}
    full = [known(Table(name), EWC) for name in ("masks_ct8", "masks_ct12")]
    return found == {"mask_lc": True, "mask_ri": None, "mask_blc": True} and full == [1.0, 1.0]


@says(
    "The paper claims that combined masks learn faster than new masks. This holds for Mask BLC on all three curricula "
    "and for Mask LC on CT8 multi-depth. On CT8 and CT12 ten seeds cannot order Mask LC and new masks."
)
def _() -> bool:
    blc = [faster(name, "mask_blc") for name in MASKS]
    lc = {name: faster(name, "mask_lc") for name in MASKS}
    return all(blc) and lc == {"masks_ct8_md": True, "masks_ct8": None, "masks_ct12": None}


def faster(name: str, method: str) -> bool | None:
    """Return whether a method has a higher mean return over all blocks than new masks; see `is_higher`."""
    of = Table(name)
    return is_higher(of.areas(method).mean(1).tolist(), of.areas("mask_ri").mean(1).tolist())


def is_higher(first: list[float], second: list[float]) -> bool | None:
    """Return whether the first values are higher, paired by seed; None where p > 0.05."""
    found = compare(first, second, bounds=(0, 1))
    if found.p_value is None or found.p_value > ALPHA:
        return None
    return (found.difference.value or 0) > 0
