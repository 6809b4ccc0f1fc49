"""docs/results/lifelong.md, "Methods, agents": each sentence that reads the tables holds of the raw results."""

from __future__ import annotations

import math

import pytest
from helpers.claims import Claims, readings, sentences
from helpers.paths import CHECKOUT

from ctgraph_rl.report import statistics

PAGE = CHECKOUT / "docs" / "results" / "lifelong.md"
reads = Claims()


@reads("methods")
def _(t):
    """Twenty seeds are of PPO, five of each other agent."""
    cells = {cell[:3] for cell in t.of}
    assert len(cells) == 3 * 12 * 4
    return all(
        len(t.runs(cell[0].removeprefix("fo_b1_"), *cell[1:])) == (20 if cell[2] == "ppo" else 5) for cell in cells
    )


@reads("methods")
def _(t):
    """Between goals, and between image sets, there is nothing to transfer and much to forget: fine-tuning keeps
    about one task of four, mostly the last, apart from LSTM-PPO on images; networks of a task's own
    (`scratch`, `mask_ri`) end with all four tasks, and so does PPO with each method other than CLEAR in at least 18
    of 20 seeds on both curricula."""
    cells = [(axis, agent) for axis in ("4tasks", "4images") for agent in t.swept["agent"]]
    kept = [t.known(axis, "finetune", agent) for axis, agent in cells if (axis, agent) != ("4images", "lstm_ppo")]
    others = [method for method in t.swept["method"] if method not in ("finetune", "clear")]
    of_ppo = [int(t.known(axis, method, "ppo").all(1).sum()) for axis in ("4tasks", "4images") for method in others]
    return (
        all(0.15 <= known.double().mean() <= 0.35 and 2 * known[:, 3].sum() > known.sum() for known in kept)
        and all(t.known(axis, method, agent).all() for axis, agent in cells for method in ("scratch", "mask_ri"))
        and min(of_ppo) == 18
    )


@reads("methods")
def _(t):
    """CLEAR, which needs neither ids nor boundaries, keeps most images and, but for A2C, about three goals of four."""
    return min(t.known("4images", "clear", agent).double().mean() for agent in t.swept["agent"]) >= 0.7 and {
        agent: 0.7 <= t.known("4tasks", "clear", agent).double().mean() <= 0.8 for agent in t.swept["agent"]
    } == {"ppo": True, "a2c": False, "dqn": True, "lstm_ppo": True}


@reads("methods")
def _(t):
    """Between goals A2C learns the third and the fourth task poorly, with methods that hold weights and without a
    method, but always with networks of a task's own."""
    learned = {method: t.own("4tasks", method, "a2c")[:, 2:].double().mean() for method in t.swept["method"]}
    poorly = max(learned[method] for method in ("finetune", "l2", "ewc", "si", "mas", "packnet"))
    return poorly <= 0.4 and learned["scratch"] == learned["mask_ri"] == 1


@reads("methods")
def _(t):
    """With growing depth there is much to transfer, and less to forget: depth 5 is found by what depth 2 to
    4 taught, so what shares nothing between
    tasks stops before it (69 of the 70 runs with `scratch` and `mask_ri`), and so does `l2`, which holds all
    weights alike."""
    return sum(
        int((~t.own("depth2to5", method, agent)[:, -1]).sum())
        for method in ("scratch", "mask_ri")
        for agent in t.swept["agent"]
    ) == 69 and not any(t.own("depth2to5", "l2", agent)[:, -1].any() for agent in t.swept["agent"])


@reads("methods")
def _(t):
    """CLEAR, which holds behaviour and no weights, solves all four depths with every agent in every seed."""
    return all(t.known("depth2to5", "clear", agent).all() for agent in t.swept["agent"])


@reads("methods")
def _(t):
    """PPO does so without any method in 14 of 20 seeds, the other agents in some."""
    return [int(t.known("depth2to5", "finetune", agent).all(1).sum()) for agent in t.swept["agent"]] == [14, 4, 1, 2]


@reads("methods")
def _(t):
    """In four of the six other seeds PPO alone ends with no task solved, in two with depth 2 and 3."""
    known = t.known("depth2to5", "finetune", "ppo")
    others = known[~known.all(1)].tolist()
    return sorted(others) == 4 * [[False] * 4] + 2 * [[True, True, False, False]]


@reads("methods")
def _(t):
    """With MAS, PackNet and SI, PPO keeps all that it learned, but finds depth 5 in five, three and two seeds, fewer
    than alone (p < 0.05, corrected for six methods)."""
    return t.keeps_and_finds(("mas", "packnet", "si")) == (True, [5, 3, 2]) and max(fewer(t)[3:]) < 0.05


@reads("methods")
def _(t):
    """With EWC, Mask LC and Mask BLC it keeps all, too, and finds depth 5 in 13, ten and seven seeds, which 20 pairs
    do not distinguish from 14."""
    alone = int(t.own("depth2to5", "finetune", "ppo")[:, 3].sum())
    found = t.keeps_and_finds(("ewc", "mask_lc", "mask_blc"))
    return alone == 14 and found == (True, [13, 10, 7]) and min(fewer(t)[:3]) > 0.05


def fewer(t):
    """The p-values of six methods against PPO alone by depth 5 in its own block, corrected for six."""
    alone, *others = (
        t.own("depth2to5", method, "ppo")[:, 3].double().tolist()
        for method in ("finetune", "ewc", "mask_lc", "mask_blc", "mas", "packnet", "si")
    )
    return statistics.holm([statistics.compare(other, alone).p_value for other in others])


@reads("methods")
def _(t):
    """By the mean return at the end no method is distinguishable from PPO alone with growing depth: CLEAR is better in
    six seeds and equal in the others, and six pairs that differ give no p-value below 0.03."""
    found = t.against_finetuning("ppo")
    corrected = dict(zip(found, statistics.holm([each.p_value for each in found.values()]), strict=True))
    deep = [p for name, p in corrected.items() if name.startswith("fo_b1_depth2to5")]
    clear = found["fo_b1_depth2to5, `clear`"]
    return len(deep) == 11 and min(deep) > 0.05 and (clear.wins, clear.ties) == (6, 14) and clear.p_value > 0.025


@reads("methods")
def _(t):
    """In each of seeds 0 to 4 PPO alone solves all four depths, as five seeds drawn from the twenty do in one of eight
    cases: read five seeds with care."""
    solved = t.known("depth2to5", "finetune", "ppo").all(1)
    return solved[:5].all() and round(math.comb(len(solved), 5) / math.comb(int(solved.sum()), 5)) == 8


@pytest.fixture(scope="module")
def by_agent():
    from studies.lifelong import mastered

    return mastered.ByAgent()


@pytest.mark.parametrize(("table", "sentence"), reads.each())
def test_what_is_read_from_the_methods_table_holds_of_its_raw_results(by_agent, table, sentence):
    assert reads.of[table][sentence](by_agent)


def test_every_sentence_of_the_reading_is_tested():
    methods = PAGE.read_text(encoding="utf-8").split("## Methods, agents and what changes between tasks")[1]

    assert sorted(sentences(" ".join(readings(methods)))) == sorted(reads.sentences())
