"""docs/results/lifelong.md: each sentence that reads the tables holds of the raw results, and has a test."""

from __future__ import annotations

import pytest
import torch
from helpers.claims import Claims, readings, sentences
from helpers.paths import CHECKOUT

from ctgraph_rl.metrics import MASTERED
from ctgraph_rl.report import statistics

PAGE = CHECKOUT / "docs" / "results" / "lifelong.md"
MASKS = ("mask_lc", "mask_ri", "mask_blc")
METHODS = ("finetune", "ewc_published", *MASKS)
FULL = ("mask_ri", "mask_blc", "ewc_published")
reads = Claims()


@reads("masks_ct8_md")
def _(t):
    """Mask LC solves all eight tasks in every seed and forgets none."""
    return t.own("mask_lc").all() and t.known("mask_lc").all() and len(t.curves["mask_lc"]) == 20


@reads("masks_ct8_md")
def _(t):
    """None of the forty experts of depth 5 solves its task at the end."""
    deep = t.experts[:, -1, 6:]
    return deep.numel() == 40 and not (deep >= MASTERED).any()


@reads("masks_ct8_md")
def _(t):
    """On depth 5 each of the other methods does worse than Mask LC (p < 0.001, corrected for four)."""
    deep = {method: t.own(method)[:, 6:].double().mean(1) for method in METHODS}
    others = [deep[method] for method in METHODS if method != "mask_lc"]
    worse = all(other.mean() < deep["mask_lc"].mean() for other in others)
    return worse and max(statistics.holm([t.p_value(deep["mask_lc"], other) for other in others])) < 0.001


@reads("masks_ct8_md")
def _(t):
    """Mask BLC solves `1.1.1.1` in 17 seeds, `1.1.1.2` in ten, `1.1.1.1.1` in four and `1.1.1.1.2` in none."""
    return t.own("mask_blc").sum(0)[4:].tolist() == [17, 10, 4, 0]


@reads("masks_ct8_md")
def _(t):
    """Fine-tuned PPO solves `1.1.1.1.1` in eight and `1.1.1.1.2` in two of 20 seeds, because the goals are
    nested."""
    own = t.own("finetune")
    both = own[:, 6:].all(1).sum() == 2  # as README says
    nested = t.ends("finetune")[:, 2, [0, 2, 4, 6]].all()
    return both and nested and len(own) == 20 and own.sum(0)[6:].tolist() == [8, 2]


@reads("masks_ct8_md")
def _(t):
    """Fifteen seeds end with no task solved."""
    return (~t.known("finetune").any(1)).sum() == 15


def keep_all(t, *methods):
    """Whether methods know at the end what they learned."""
    return all(torch.equal(t.known(method), t.own(method)) for method in methods)


@reads("masks_ct8")
def _(t):
    """Mask RI, Mask BLC and EWC learn all eight tasks in every seed and keep them, and the experts learn them, too."""
    every = all(t.own(method).all() for method in FULL)
    return every and keep_all(t, *FULL) and (t.experts[:, -1] >= MASTERED).all()


@reads("masks_ct8")
def _(t):
    """Fine-tuned PPO knows only the last goal at the end of every seed."""
    return t.known("finetune").sum(0).tolist() == [0, 0, 0, 0, 0, 0, 0, 10]


@reads("masks_ct8")
def _(t):
    """Of 80 tasks, eight in each of ten seeds, Mask LC misses six, in four seeds, and keeps the others."""
    missed = [goals for goals in t.names(~t.own("mask_lc")) if goals]
    return len(missed) == 4 and sum(map(len, missed)) == 6 and keep_all(t, "mask_lc")


@reads("masks_ct8")
def _(t):
    """Mask BLC learns fastest: its mean return over all blocks, 0.96, is higher than that of each other method (p <
    0.03, corrected for all ten pairs)."""
    return fastest(t) == ("mask_blc", "0.96") and max(p_values(t, with_blc=True).values()) < 0.03


@reads("masks_ct8")
def _(t):
    """Ten seeds cannot order the other four: Mask RI has 0.87, Mask LC 0.83, fine-tuned PPO 0.82 and EWC 0.78. The
    clearest difference is that of EWC less Mask RI, -0.09 [-0.38, 0.25] (16 pairs would do)."""
    shown = [f"{t.mean_areas()[method]:.2f}" for method in ("mask_ri", "mask_lc", "finetune", "ewc_published")]
    return (
        min(p_values(t, with_blc=False).values()) > 0.05
        and shown == ["0.87", "0.83", "0.82", "0.78"]
        and left_open(t, "ewc_published", "mask_ri") == "-0.09 [-0.38, 0.25]"
    )


def left_open(t, one, other):
    """The difference of two methods with its interval, where no other pair that was not found is clearer."""
    pairs = {pair: each for pair, each in t.compare_areas().items() if each.holm > 0.05}
    assert pairs[one, other].p_value == min(each.p_value for each in pairs.values())
    areas = [t.areas(method).mean(1) for method in (one, other)]
    found = pairs[one, other].difference
    assert found.value == pytest.approx((areas[0] - areas[1]).mean().item())
    return f"{found.value:.2f} [{found.low:.2f}, {found.high:.2f}]"


def fastest(t):
    """The method with the highest mean return over all blocks, and this return."""
    means = t.mean_areas()
    best = max(means, key=means.get)
    return best, f"{means[best]:.2f}"


def p_values(t, with_blc):
    """The corrected p-values of the pairs of methods that Mask BLC is in, or that it is not in."""
    return {pair: p for pair, p in t.pairs_of_areas().items() if ("mask_blc" in pair) == with_blc}


@reads("masks_ct12")
def _(t):
    """Mask RI, Mask BLC and EWC learn all twelve tasks in every seed and keep them, and the experts learn them, too."""
    every = all(t.own(method).all() for method in FULL)
    return every and keep_all(t, *FULL) and (t.experts[:, -1] >= MASTERED).all()


@reads("masks_ct12")
def _(t):
    """Fine-tuned PPO ends with `2.2` and `2.2.2` in nine seeds and with nothing in one."""
    return sorted(map(sorted, t.names(t.known("finetune")))) == [[], *9 * [["2.2", "2.2.2"]]]


@reads("masks_ct12")
def _(t):
    """Mask LC misses `2.2.1` in two seeds and `2.2.2` in one of these, and keeps the others."""
    missed = [goals for goals in t.names(~t.own("mask_lc")) if goals]
    return missed == [{"2.2.1", "2.2.2"}, {"2.2.1"}] and keep_all(t, "mask_lc")


@reads("masks_ct12")
def _(t):
    """Mask BLC learns fastest again: its mean return over all blocks, 0.99, is higher than that of each other method
    (p < 0.02, corrected for all ten pairs)."""
    return fastest(t) == ("mask_blc", "0.99") and max(p_values(t, with_blc=True).values()) < 0.02


@reads("masks_ct12")
def _(t):
    """Mask RI (0.91) and Mask LC (0.89) are better than fine-tuned PPO (0.79; p < 0.03). Ten seeds cannot order the
    others: the clearest difference is that of fine-tuned PPO less EWC, -0.09 [-0.38, 0.25] (17 pairs would do)."""
    shown = [f"{t.mean_areas()[method]:.2f}" for method in ("mask_ri", "mask_lc", "finetune")]
    clear = {pair: p for pair, p in p_values(t, with_blc=False).items() if p <= 0.05}
    better = {("finetune", "mask_lc"), ("finetune", "mask_ri")}
    found = shown == ["0.91", "0.89", "0.79"] and clear.keys() == better and max(clear.values()) < 0.03
    return found and left_open(t, "finetune", "ewc_published") == "-0.09 [-0.38, 0.25]"


NO_DATA = {
    # of the two sentences after it
    "The paper's claim holds: after depth 2 to 4, a linear combination of masks solves depth 5, and learning from "
    "scratch does not.",
    # tests/docs/test_results_claims.py
    "A bonus for rare states also reaches depth 5: `ppo_count` learns depth 5 from scratch in every seed, in as many "
    "frames ([the depth ladder](baselines.md#the-depth-ladder)).",
}
"""What follows from other sentences, or is tested elsewhere."""


@pytest.fixture(scope="module")
def tables():
    from helpers import mastered

    return {name: mastered.Table(name) for name in reads.of}


@pytest.mark.parametrize(("table", "sentence"), reads.each())
def test_what_is_read_from_a_table_holds_of_its_raw_results(tables, table, sentence):
    assert reads.of[table][sentence](tables[table])


def test_every_sentence_of_the_readings_is_tested():
    masks = PAGE.read_text(encoding="utf-8").split("## Methods, agents and what changes between tasks")[0]

    assert sorted(sentences(" ".join(readings(masks)))) == sorted([*reads.sentences(), *NO_DATA])


def test_the_papers_claims_compare_means_over_curricula_with_a_pair_for_each_seed_that_has_all():
    from studies.lifelong import pairs

    measured = {("mask_lc", name, "0"): value for name, value in zip(pairs.MASKS, (0.25, 0.5, 1.0), strict=True)}
    measured |= {("mask_lc", pairs.MASKS[0], "2.1"): 1.0}
    rows = PAGE.read_text(encoding="utf-8").split("### The paper's claims")[1].split("\n## ")[0].split("\n| ")[2:]

    assert pairs.over_curricula(measured) == {("mask_lc", "0"): 1.75 / 3}
    assert len(rows) == 8
    assert {each.difference.n for each in pairs.claims().values()} == {10}
    assert min(float(row.split(" | ")[3].strip(" |\n")) for row in rows) == round(8 * 2 / 2**10, 3)  # Holm's, of eight
