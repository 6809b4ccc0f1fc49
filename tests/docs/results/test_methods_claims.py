"""docs/results/lifelong.md, "Methods, agents": each sentence that reads the tables holds of the raw results."""

from __future__ import annotations

import math

import pytest
from helpers.claims import Claims, readings, sentences
from helpers.paths import CHECKOUT
from studies.lifelong import comparison

from ctgraph_rl.report import statistics

PAGE = CHECKOUT / "docs" / "results" / "lifelong.md"
reads = Claims()


@reads("methods")
def _(t):
    """Between goals, and between image sets, fine-tuning keeps about one task of four, mostly the last, apart from
    LSTM-PPO on images."""
    cells = [cell for cell in both_axes(t) if cell != ("4images", "lstm_ppo")]
    kept = [t.known(axis, "finetune", agent) for axis, agent in cells]
    return all(0.15 <= known.double().mean() <= 0.35 and 2 * known[:, 3].sum() > known.sum() for known in kept)


@reads("methods")
def _(t):
    """Separate networks for each task (`scratch`, `mask_ri`) end with all four tasks, and PPO with each method other
    than CLEAR in at least 18 of 20 seeds."""
    apart = [t.known(axis, method, agent) for axis, agent in both_axes(t) for method in ("scratch", "mask_ri")]
    others = [method for method in comparison.METHODS if method not in ("finetune", "clear")]
    of_ppo = [int(t.known(axis, method, "ppo").all(1).sum()) for axis in ("4tasks", "4images") for method in others]
    return all(known.all() for known in apart) and min(of_ppo) == 18


def both_axes(t):
    """The sequences of goals and of images with each agent."""
    return [(axis, agent) for axis in ("4tasks", "4images") for agent in comparison.AGENTS]


@reads("methods")
def _(t):
    """CLEAR, without ids and boundaries, keeps most images and, except with A2C, about three goals of four."""
    return min(t.known("4images", "clear", agent).double().mean() for agent in comparison.AGENTS) >= 0.7 and {
        agent: 0.7 <= t.known("4tasks", "clear", agent).double().mean() <= 0.8 for agent in comparison.AGENTS
    } == {"ppo": True, "a2c": False, "dqn": True, "lstm_ppo": True}


@reads("methods")
def _(t):
    """With growing depth, methods that share nothing between tasks stop before depth 5: 69 of the 70 runs with
    `scratch` and `mask_ri`."""
    own = [t.own("depth2to5", method, agent) for method in ("scratch", "mask_ri") for agent in comparison.AGENTS]
    return (sum(map(len, own)), sum(int((~each[:, -1]).sum()) for each in own)) == (70, 69)


@reads("methods")
def _(t):
    """CLEAR solves all four depths with every agent in every seed, fine-tuned PPO in 14 of 20."""
    by_ppo = t.known("depth2to5", "finetune", "ppo").all(1)
    every = all(t.known("depth2to5", "clear", agent).all() for agent in comparison.AGENTS)
    return every and (int(by_ppo.sum()), len(by_ppo)) == (14, 20)


@reads("methods")
def _(t):
    """With MAS, PackNet and SI, PPO keeps all that it learned. It finds depth 5 in five, three and two seeds, fewer
    than fine-tuned PPO (p < 0.05, corrected for six methods)."""
    return t.keeps_and_finds(("mas", "packnet", "si")) == (True, [5, 3, 2]) and max(fewer(t)[3:]) < 0.05


@reads("methods")
def _(t):
    """With EWC, Mask LC and Mask BLC it also keeps all."""
    return t.keeps_and_finds(("ewc", "mask_lc", "mask_blc"))[0]


@reads("methods")
def _(t):
    """They find depth 5 in 13, ten and seven seeds. 20 pairs cannot say whether these are fewer than 14: EWC -0.05
    [-0.38, 0.29] (2,286 pairs would do); Mask LC -0.20 [-0.56, 0.21] (214 pairs would do); Mask BLC -0.35 [-0.66, 0.05]
    (59 pairs would do)."""
    alone = int(t.own("depth2to5", "finetune", "ppo")[:, 3].sum())
    found = t.keeps_and_finds(("ewc", "mask_lc", "mask_blc"))[1]
    return alone == 14 and found == [13, 10, 7] and min(fewer(t)[:3]) > 0.05


def fewer(t):
    """The p-values of six methods against PPO alone by depth 5 in its own block, corrected for six."""
    alone, *others = (
        t.own("depth2to5", method, "ppo")[:, 3].double().tolist()
        for method in ("finetune", "ewc", "mask_lc", "mask_blc", "mas", "packnet", "si")
    )
    return statistics.holm([statistics.compare(other, alone).p_value for other in others])


@reads("methods")
def _(t):
    """With growing depth 20 pairs cannot say of any method whether its mean return at the end is higher than that of
    fine-tuned PPO. The clearest difference is that of `mask_ri`, -0.26 [-0.46, 0.02] (48 pairs would do)."""
    found = {name: each for name, each in t.against_finetuning(["ppo"]).items() if "depth2to5" in name}
    clearest = min(found, key=lambda name: found[name].p_value)
    values = [each[-1].mean().item() for each in (run.performance for run in t.runs("depth2to5", "mask_ri", "ppo"))]
    alone = [each[-1].mean().item() for each in (run.performance for run in t.runs("depth2to5", "finetune", "ppo"))]
    difference = f"{sum(values) / 20 - sum(alone) / 20:.2f}"
    return better(t, "ppo")["depth2to5"] == set() and (clearest, difference) == ("fo_b1_depth2to5, `mask_ri`", "-0.26")


@reads("methods")
def _(t):
    """With the other three agents each method is better than fine-tuning between goals. Between image sets all but EWC
    and CLEAR are better, with growing depth none (15 pairs, taken as independent; p <= 0.05, corrected for 33)."""
    every = {method for method in comparison.METHODS if method != "finetune"}
    found = better(t, "a2c", "dqn", "lstm_ppo", pairs=15)
    return found == {"4tasks": every, "4images": every - {"ewc", "clear"}, "depth2to5": set()}


def better(t, *agents, pairs=20):
    """The methods that are better than fine-tuning with some agents, by what changes between tasks."""
    found = t.against_finetuning(agents)
    assert len(found) == 33 and {each.difference.n for each in found.values()} == {pairs}
    corrected = statistics.holm([each.p_value for each in found.values()])
    clear = [
        name
        for (name, each), p in zip(found.items(), corrected, strict=True)
        if p <= 0.05 and each.difference.value > 0
    ]
    axes = ("4tasks", "4images", "depth2to5")
    return {axis: {name.split("`")[1] for name in clear if name.startswith(f"fo_b1_{axis}")} for axis in axes}


@pytest.fixture(scope="module")
def by_agent():
    from helpers import mastered

    return mastered.ByAgent()


@pytest.mark.parametrize(("table", "sentence"), reads.each())
def test_what_is_read_from_the_methods_table_holds_of_its_raw_results(by_agent, table, sentence):
    assert reads.of[table][sentence](by_agent)


def test_every_sentence_of_the_reading_is_tested():
    methods = PAGE.read_text(encoding="utf-8").split("## Methods, agents and what changes between tasks")[1]

    assert sorted(sentences(" ".join(readings(methods)))) == sorted(reads.sentences())


def test_five_seeds_of_twenty_can_all_solve_four_depths_by_chance(by_agent):
    solved = by_agent.known("depth2to5", "finetune", "ppo").all(1)

    assert solved[:5].all()
    assert round(math.comb(len(solved), 5) / math.comb(int(solved.sum()), 5)) == 8
    said = (
        "In seeds 0 to 4 fine-tuned PPO solves all four depths, as five seeds drawn from the twenty do in one of eight"
    )
    assert said in " ".join(PAGE.read_text(encoding="utf-8").split())


def test_a_cell_of_ppo_has_its_mean_at_the_end_and_the_p_value_of_its_difference(by_agent):
    found = by_agent.against_finetuning(["ppo"])
    p_values = dict(zip(found, statistics.holm([each.p_value for each in found.values()]), strict=True))
    table = PAGE.read_text(encoding="utf-8").split("| `fo_b1_4tasks` | `fo_b1_4images` | `fo_b1_depth2to5` |")[1]

    for method in comparison.METHODS:
        cells = table.split(f"| `{method}` | ")[1].split("\n")[0].strip("| ").split(" | ")
        for cell, axis in zip(cells, ("4tasks", "4images", "depth2to5"), strict=True):
            runs = by_agent.runs(axis, method, "ppo")
            ends = [float(run.performance[-1].mean()) for run in runs]
            p_value = p_values.get(f"fo_b1_{axis}, `{method}`")
            assert cell.split(" [")[0] == f"{sum(ends) / len(ends):.2f}"
            assert cell.endswith("]" if p_value is None else f", p {p_value:.3f}")


def test_ppo_has_twenty_seeds_of_each_method_and_every_other_agent_five(by_agent):
    cells = {cell[:3] for cell in by_agent.of}

    assert len(cells) == 3 * 12 * 4
    for curriculum, method, agent in cells:
        runs = by_agent.runs(curriculum.removeprefix("fo_b1_"), method, agent)
        assert len(runs) == (20 if agent == "ppo" else 5)
    assert "Twenty seeds are of PPO, five of each other agent." in PAGE.read_text(encoding="utf-8")
