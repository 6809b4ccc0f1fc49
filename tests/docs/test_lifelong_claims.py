"""docs/results/lifelong.md: each sentence that reads the tables holds of the raw results, and has a test."""

from __future__ import annotations

from collections import Counter

import pytest
import torch
from helpers.claims import Claims, readings, sentences
from helpers.paths import CHECKOUT

from ctgraph_rl.metrics import MASTERED
from ctgraph_rl.report import statistics

PAGE = CHECKOUT / "docs" / "results" / "lifelong.md"
MASKS = ("mask_lc", "mask_ri", "mask_blc")
METHODS = ("finetune", "ewc_published", *MASKS)
reads = Claims()


@reads("masks_ct8_md")
def _(t):
    """So plain PPO that has learned `000` solves all four in every seed, and has 1.00 on depth 4 and 5 before it was
    ever there."""
    return t.ends("finetune")[:, 2, [0, 2, 4, 6]].all()


@reads("masks_ct8_md")
def _(t):
    """At the end of their blocks it has `0000` in 15 of 20 seeds, `0001` in 13, each time at the price of `0000` and
    `00000`, `00000` in eight and `00001` in two."""
    own = t.own("finetune")
    both = own[:, 6:].all(1).sum() == 2  # as README says
    return both and own.sum(0)[4:].tolist() == [15, 13, 8, 2] and not t.ends("finetune")[own[:, 5], 5][:, [4, 6]].any()


@reads("masks_ct8_md")
def _(t):
    """Fifteen seeds end with nothing; two end with `00`, `000`, `0000` and `00000`, two with `00`, `000`, `0000` and
    `00001`, again four tasks that agree, and one with `01`."""
    return Counter(map(frozenset, t.names(t.known("finetune")))) == {
        frozenset(): 15,
        frozenset({"00", "000", "0000", "00000"}): 2,
        frozenset({"00", "000", "0000", "00001"}): 2,
        frozenset({"01"}): 1,
    }


@reads("masks_ct8_md")
def _(t):
    """What it gets in tasks that have not begun is 5 to 25 % of PPO's TPOT, up to 20 % of EWC's, and at most 7 % of
    that of masks."""
    shares = {method: [round(100 * share) for share in t.early_shares(method)] for method in METHODS}
    least, most = min(shares["finetune"]), max(shares["finetune"])
    of_masks = max(max(shares[mask]) for mask in MASKS)
    return (least, most, max(shares["ewc_published"]), of_masks) == (5, 25, 20, 7)


@reads("masks_ct8_md")
def _(t):
    """The paper's claim, that after depth 2 to 4 a linear combination of masks solves depth 5 and learning from
    scratch does not, holds here: Mask LC solves all eight tasks in every seed and forgets none; none of the
    forty experts of depth 5 solves its task at the end."""
    deep = t.experts[:, -1, 6:]
    return t.own("mask_lc").all() and t.known("mask_lc").all() and deep.numel() == 40 and not (deep >= MASTERED).any()


@reads("masks_ct8_md")
def _(t):
    """(A greedy policy can be right by chance: the experts of `00000` have 1.00 in 9 of 400 evaluations, and 0.00 in
    the others.)"""
    return [int((t.experts[:, :, 6] == value).sum()) for value in (0, 1)] == [391, 9]


@reads("masks_ct8_md")
def _(t):
    """That nothing else gets there does not hold: Mask BLC solves `0000` in 17 seeds, `0001` in ten, `00000` in four
    and `00001` in none, and PPO alone, as above, `00000` in eight and `00001` in two, for the reason given there."""
    return t.own("mask_blc").sum(0)[4:].tolist() == [17, 10, 4, 0] and t.own("finetune").sum(0)[6:].tolist() == [8, 2]


@reads("masks_ct8_md")
def _(t):
    """Mask LC does it in every seed and keeps it; on depth 5 each of the other methods does worse (p < 0.001,
    corrected for four)."""
    deep = {method: t.own(method)[:, 6:].double().mean(1) for method in METHODS}
    others = [deep[method] for method in METHODS if method != "mask_lc"]
    worse = all(other.mean() < deep["mask_lc"].mean() for other in others)
    return worse and max(statistics.holm([t.p_value(deep["mask_lc"], other) for other in others])) < 0.001


@reads("masks_ct8_md")
def _(t):
    """Mask RI, which shares nothing, solves `0000` in eight seeds, `0001` in one, and none of depth 5."""
    return t.own("mask_ri").sum(0)[4:].tolist() == [8, 1, 0, 0]


@reads("masks_ct8_md")
def _(t):
    """EWC learns the four tasks of depth 2 and 3, `0000` in five seeds, and nothing deeper."""
    return t.own("ewc_published").sum(0).tolist() == [20, 20, 20, 20, 5, 0, 0, 0]


@reads("masks_ct8_md")
def _(t):
    """It keeps them all but for `00` in one seed and `000` in another."""
    lost = t.own("ewc_published") & ~t.known("ewc_published")
    return sorted(sorted(goals) for goals in t.names(lost) if goals) == [["00"], ["000"]]


@reads("masks_ct8_md")
def _(t):
    """Task 1 shows why forward transfer leaves tasks out: one evaluation of 400 failed among its experts, and Mask LC
    failed one of 20 in one seed, which would count -19 there and take its forward transfer from 0.98 to 0.84."""
    return (
        (t.experts[:, :, 0] < MASTERED).sum() == 1
        and sorted((t.stages("mask_lc")[:, 0] < MASTERED).sum(1).tolist()) == [0] * 19 + [1]
        and (t.gain("mask_lc")[:, 0] / (1 - t.alone[0])).min() == pytest.approx(-19)
        and [f"{value:.2f}" for value in t.transfer_of_mask_lc()] == ["0.98", "0.84"]
    )


@reads("masks_ct8")
def _(t):
    """Mask RI, Mask BLC and EWC learn all eight tasks in every seed, and so do the experts."""
    every = all(t.own(method).all() for method in ("mask_ri", "mask_blc", "ewc_published"))
    return every and (t.experts[:, -1] >= MASTERED).all()


@reads("masks_ct8")
def _(t):
    """PPO alone misses `100`, the first goal with another first decision, in three seeds."""
    return t.names(~t.own("finetune")) == [{"100"} if seed in (4, 8, 9) else set() for seed in range(10)]


@reads("masks_ct8")
def _(t):
    """Mask LC misses six tasks in four seeds, `011` and `111` twice each."""
    missed = [goals for goals in t.names(~t.own("mask_lc")) if goals]
    goals = Counter(goal for of_seed in missed for goal in of_seed)
    return len(missed) == 4 and goals == {"011": 2, "111": 2, "100": 1, "101": 1}


@reads("masks_ct8")
def _(t):
    """Each of them was reached in no evaluation of its block. At the end PPO alone knows the last goal alone in every
    seed; EWC and masks know all that they learned."""
    reached = any((t.stages(method)[~t.own(method)] >= MASTERED).any() for method in ("finetune", "mask_lc"))
    last_alone = t.known("finetune").sum(0).tolist() == [0, 0, 0, 0, 0, 0, 0, 10]
    return last_alone and not reached and all(torch.equal(t.known(method), t.own(method)) for method in METHODS[1:])


@reads("masks_ct8")
def _(t):
    """A learned policy fails a greedy evaluation now and then, about one in 83 from the first success on in its block;
    46 of all 78 failures are EWC's, one in 26."""
    each = [t.since_success(*methods) for methods in (METHODS, ["ewc_published"])]
    return [(int((~seen).sum()), round(len(seen) / int((~seen).sum()))) for seen in each] == [(78, 83), (46, 26)]


@reads("masks_ct8")
def _(t):
    """So the paper's first claim, that masks do better than EWC and PPO alone, does not hold here: EWC knows as much
    as Mask RI and Mask BLC, and more than Mask LC."""
    known = {method: t.known(method).sum() for method in METHODS}
    return known["ewc_published"] == known["mask_ri"] == known["mask_blc"] > known["mask_lc"] > known["finetune"]


@reads("masks_ct8")
def _(t):
    """The second claim, that a combination of masks learns faster than new ones, holds of Mask BLC and not of Mask LC:
    by the mean return over all blocks, Mask BLC, with 0.96, is better than each of the others (p < 0.03,
    corrected for all ten pairs), and no other two are distinguishable; Mask RI has 0.87, Mask LC 0.83, PPO alone
    0.82 and EWC 0.78."""
    corrected = t.pairs_of_areas()
    with_blc, others = ([p for pair, p in corrected.items() if ("mask_blc" in pair) == has] for has in (True, False))
    shown = [f"{t.mean_areas()[method]:.2f}" for method in ("mask_blc", "mask_ri", "mask_lc", *METHODS[:2])]
    return max(with_blc) < 0.03 and min(others) > 0.05 and shown == ["0.96", "0.87", "0.83", "0.82", "0.78"]


@reads("masks_ct8")
def _(t):
    """The experts have 0.76. Mask RI, which shares nothing, gains 0.11 over them, Mask BLC 0.20."""
    gains = [t.gain(method).mean() for method in ("mask_ri", "mask_blc")]
    return [f"{value:.2f}" for value in (t.alone.mean(), *gains)] == ["0.76", "0.11", "0.20"]


@reads("masks_ct8")
def _(t):
    """Mask LC has the mean return of Mask BLC over the blocks of the first three tasks, and 0.13 to 0.28 less over
    each of the others."""
    less = (t.areas("mask_blc") - t.areas("mask_lc")).mean(0)
    return less[:3].abs().max() <= 0.02 + 1e-12 and less[3:].min() >= 0.125 and less[3:].max() < 0.28


@reads("masks_ct12")
def _(t):
    """Mask RI, Mask BLC and EWC learn all twelve tasks in every seed, and the experts do, too."""
    every = all(t.own(method).all() for method in ("mask_ri", "mask_blc", "ewc_published"))
    return every and (t.experts[:, -1] >= MASTERED).all()


@reads("masks_ct12")
def _(t):
    """PPO alone misses eight tasks in seven seeds, `100` in four of them, and Mask LC misses `110` in two seeds and
    `111` in one of these. But for `111` of PPO alone, none was reached in any evaluation of its block."""
    of_ppo, of_lc = ([goals for goals in t.names(~t.own(method)) if goals] for method in ("finetune", "mask_lc"))
    each = [goal for goals in of_ppo for goal in goals]
    reached = [set.union(*t.names((t.stages(m) >= MASTERED).any(-1) & ~t.own(m))) for m in ("finetune", "mask_lc")]
    counted = (len(of_ppo), len(each), each.count("100"), of_lc) == (7, 8, 4, [{"110", "111"}, {"110"}])
    return counted and reached == [{"111"}, set()]


@reads("masks_ct12")
def _(t):
    """A goal of depth 3 extends one of depth 2, and these two alone agree on all images that they share: each of the
    72 blocks in which PPO alone learns a goal of depth 3 ends with this goal, its beginning and nothing else."""
    learned = [(goal, known) for goal, known in t.blocks_of_depth_3() if goal in known]
    return len(learned) == 72 and all(known == {goal, goal[:2]} for goal, known in learned)


@reads("masks_ct12")
def _(t):
    """So nine seeds end with `11` and `111`; the tenth, which misses `111`, ends with nothing. EWC and masks know all
    that they learned, as on CT8."""
    ends = [{"11", "111"} if own else set() for own in t.own("finetune")[:, -1]]
    kept = all(torch.equal(t.known(method), t.own(method)) for method in METHODS[1:])
    return kept and t.names(t.known("finetune")) == ends and ends.count(set()) == 1


@reads("masks_ct12")
def _(t):
    """The paper's first claim does not hold here either: EWC knows all that Mask RI and Mask BLC know, and Mask LC
    knows less."""
    known = {method: t.known(method).sum() for method in METHODS}
    return known["ewc_published"] == known["mask_ri"] == known["mask_blc"] > known["mask_lc"] > known["finetune"]


@reads("masks_ct12")
def _(t):
    """The second holds of Mask BLC again: by the mean return over all blocks, Mask BLC, with 0.99, is better than each
    of the others (p < 0.02, corrected for all ten pairs)."""
    means = t.mean_areas()
    best = max(means, key=means.get) == "mask_blc" and f"{means['mask_blc']:.2f}" == "0.99"
    return best and max(p for pair, p in t.pairs_of_areas().items() if "mask_blc" in pair) < 0.02


@reads("masks_ct12")
def _(t):
    """Mask RI has 0.91, Mask LC 0.89, EWC 0.88 and PPO alone 0.79; Mask RI and Mask LC are better than PPO alone (p <
    0.03), and no other two are distinguishable. The experts have 0.85."""
    shown = [f"{t.mean_areas()[m]:.2f}" for m in ("mask_ri", "mask_lc", "ewc_published", "finetune")]
    others = {pair: p for pair, p in t.pairs_of_areas().items() if "mask_blc" not in pair}
    clear = {pair: p for pair, p in others.items() if p <= 0.05}
    better = {("finetune", "mask_lc"), ("finetune", "mask_ri")}
    shown.append(f"{t.alone.mean():.2f}")
    return shown == ["0.91", "0.89", "0.88", "0.79", "0.85"] and clear.keys() == better and max(clear.values()) < 0.03


@reads("masks_ct12")
def _(t):
    """Mask LC has 0.2 to 0.4 less than Mask BLC over the blocks of `11`, `110` and `111`, and less than 0.1 less over
    each of the others."""
    less = dict(zip(t.goals, (t.areas("mask_blc") - t.areas("mask_lc")).mean(0).tolist(), strict=True))
    slow = [less.pop(goal) for goal in ("11", "110", "111")]
    return min(slow) > 0.2 and max(slow) < 0.4 and max(less.values()) < 0.1


@reads("masks_ct12")
def _(t):
    """Forward transfer has the eight tasks of depth 3 only, as experts leave at most 0.02 to gain in each of depth
    2."""
    left = dict(zip(t.goals, (1 - t.alone).tolist(), strict=True))
    return all((gain <= 0.02 + 1e-12) if len(goal) == 2 else (gain > 0.05 + 1e-12) for goal, gain in left.items())


NO_DATA = {
    "The goals are nested and their trees share images: at each image that two of `00`, `000`, `0000` and `00000` "
    "share, the same actions are best (`ctgraph_rl.tasks.similarity.observation_agreement` is 1).",  # tests/tasks
    "So tasks 5 and 7 say little about exploration; 6 and 8, the same way with another last decision, say more.",
    "(They explore by chance. `ppo_count` learns depth 5 from scratch in every seed, in as many frames: "
    "[the depth ladder](baselines.md#the-depth-ladder).)",  # tests/docs/test_results_claims.py
    "How the paper's own runs did task by task is not known here.",
    "It begins a task with equal shares of old and new masks, Mask BLC with one half for the new one, which "
    "may be why.",
    "With 8 epochs it [forgets](#what-epochs-change).",  # tests/docs/results/test_epochs.py
}
"""What explains, or is tested elsewhere."""


@pytest.fixture(scope="module")
def tables():
    from studies.lifelong import mastered

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
    measured |= {("mask_lc", pairs.MASKS[0], "10"): 1.0}
    rows = PAGE.read_text(encoding="utf-8").split("### The paper's claims")[1].split("\n## ")[0].split("\n| ")[3:]

    assert pairs.over_curricula(measured) == {("mask_lc", "0"): 1.75 / 3}
    assert len(rows) == 8
    assert {row.split(" | ")[2] for row in rows} == {"10"}
    assert min(float(row.split(" | ")[4]) for row in rows) == round(2 / 2**10, 3)
