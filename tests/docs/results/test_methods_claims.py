"""docs/results/lifelong.md, "Methods, agents": each sentence that reads the tables holds of the raw results."""

from __future__ import annotations

import sys

import pytest
import torch
from helpers.claims import Claims, readings, sentences
from helpers.paths import CHECKOUT

from ctgraph_rl.report import statistics

PAGE = CHECKOUT / "docs" / "results" / "lifelong.md"
FINDS_DEPTH_5 = {"ewc": 13, "mask_lc": 10, "mask_blc": 7, "mas": 5, "packnet": 3, "si": 2}
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
    about one task of four, apart from LSTM-PPO on images; networks of a task's own (`scratch`, `mask_ri`)
    keep all, and so, but for at most two seeds of twenty, does PPO with any method other than CLEAR."""
    return (
        all(
            0.15 <= t.known(axis, "finetune", agent).double().mean() <= 0.35
            for axis in ("4tasks", "4images")
            for agent in t.swept["agent"]
            if (axis, agent) != ("4images", "lstm_ppo")
        )
        and all(
            t.known(axis, method, agent).all()
            for axis in ("4tasks", "4images")
            for method in ("scratch", "mask_ri")
            for agent in t.swept["agent"]
        )
        and all(
            (~t.known(axis, method, "ppo").all(1)).sum() <= 2
            for axis in ("4tasks", "4images")
            for method in t.swept["method"]
            if method not in ("finetune", "clear")
        )
    )


@reads("methods")
def _(t):
    """CLEAR, which needs neither ids nor boundaries, keeps most images and, but for A2C, about three goals of four."""
    return min(t.known("4images", "clear", agent).double().mean() for agent in t.swept["agent"]) >= 0.7 and {
        agent: 0.7 <= t.known("4tasks", "clear", agent).double().mean() <= 0.8 for agent in t.swept["agent"]
    } == {"ppo": True, "a2c": False, "dqn": True, "lstm_ppo": True}


@reads("methods")
def _(t):
    """A2C learns later tasks poorly where weights are held: the methods' strengths were chosen for PPO."""
    return all(
        t.own(axis, method, "a2c")[:, 2:].sum(0).max() <= 2
        for axis in ("4tasks", "4images")
        for method in ("l2", "ewc", "si", "mas", "packnet")
    )


@reads("methods")
def _(t):
    """Growing depth turns this round: depth 5 is found by what depth 2 to 4 taught, so what shares nothing between
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
    """Where PPO alone does not find depth 5, it ends without depth 4, too, and in four seeds of six with nothing."""
    known = t.known("depth2to5", "finetune", "ppo")
    others = known[~t.own("depth2to5", "finetune", "ppo")[:, 3]]
    return not others[:, 2:].any() and (len(others), int((~others.any(1)).sum())) == (6, 4)


@reads("methods")
def _(t):
    """The methods that hold weights keep all that PPO learned, but it finds depth 5 in fewer seeds: in 13 with EWC, ten
    with Mask LC, seven with Mask BLC, five with MAS, three with PackNet and two with SI."""
    found = {method: t.own("depth2to5", method, "ppo") for method in FINDS_DEPTH_5}
    kept = all(torch.equal(own, t.known("depth2to5", method, "ppo")) for method, own in found.items())
    return kept and {method: int(own[:, 3].sum()) for method, own in found.items()} == FINDS_DEPTH_5


@reads("methods")
def _(t):
    """By the mean return at the end no method is distinguishable from PPO alone there."""
    found = t.against_finetuning("ppo")
    corrected = statistics.holm([each.p_value for each in found.values()])
    deep = [p for name, p in zip(found, corrected, strict=True) if name.startswith("fo_b1_depth2to5")]
    return len(deep) == 11 and min(deep) > 0.05


@reads("methods")
def _(t):
    """In each of seeds 0 to 4, all that were run at first, PPO alone solves all four depths; at a share of 14 in 20
    five seeds do so in one of six cases."""
    return t.known("depth2to5", "finetune", "ppo")[:5].all() and round(1 / (14 / 20) ** 5) == 6


@pytest.fixture(scope="module")
def by_agent():
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.syspath_prepend(str(CHECKOUT / "docs" / "results"))
        yield __import__("mastered").ByAgent()
        for name in ("mastered", "pairs", "comparison", "raw"):
            sys.modules.pop(name, None)


@pytest.mark.parametrize(("table", "sentence"), reads.each())
def test_what_is_read_from_the_methods_table_holds_of_its_raw_results(by_agent, table, sentence):
    assert reads.of[table][sentence](by_agent)


def test_every_sentence_of_the_reading_is_tested():
    methods = PAGE.read_text(encoding="utf-8").split("## Methods, agents and what changes between tasks")[1]

    assert sorted(sentences(" ".join(readings(methods)))) == sorted(reads.sentences())
