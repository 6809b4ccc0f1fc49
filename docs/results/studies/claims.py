"""Sentences of the paper that can be tested: claims.md, made of raw results of other studies and of exact values."""

from __future__ import annotations

from string import Template

from ctgraph_rl.report import statistics
from ctgraph_rl.report.statistics import Comparison
from ctgraph_rl.tasks.configurations import CONFIGURATIONS
from ctgraph_rl.tasks.values import open_loop_ceiling
from studies import claim_runs
from studies.claim_runs import above, below
from studies.memory.conditions import GIVEN, Condition, finished
from studies.memory.runs import AGENTS, returns, solved
from studies.raw import HERE, TEMPLATES, Raw, machines, shown

PAGE = HERE / "claims.md"

RECURRENT = [
    "lstm_ppo",
    "lstm_ppo-gru",
    "lstm_ppo-min_gru",
    "lstm_ppo-amrl_max",
    "lstm_ppo-amrl_avg",
    "lstm_ppo-backpropamine",
]
BASE = "lstm_ppo"
RIVALS = {"attention": "lstm_ppo-attention", "mohqa": "mohqa", "backpropamine": "lstm_ppo-backpropamine"}
"""Agents with attention, associative learning and neuromodulation."""

SHARED = [condition for condition in GIVEN if condition.unique_decisions == "False"]
"""Confounding graphs of the paper: all decision states show one image."""

FEW = "100"
MANY = "500"
AGREES = "agrees"
NOT_FOUND = "not found"
TRANSFER = "forward_transfer"


def compared_sets() -> dict[tuple[Condition, str], tuple[Raw, Raw]]:
    """The lines of each recurrent agent with few and with many wait images, by graph with few and agent."""
    of = finished()
    few = [condition for condition in GIVEN if condition.num_wait_images == FEW and condition.wait_prob != "0"]
    pairs: dict[tuple[Condition, str], tuple[Raw, Raw]] = {}
    for condition in few:
        many = of[condition._replace(num_wait_images=MANY)]
        pairs |= {(condition, agent): (of[condition][agent], many[agent]) for agent in RECURRENT}
    return pairs


def of_large_sets() -> Comparison:
    """Greedy returns with many wait images against those with few, paired by graph, agent and seed."""
    pairs = compared_sets().values()
    many = [value for _, lines in pairs for value in returns(lines)]
    few = [value for lines, _ in pairs for value in returns(lines)]
    return statistics.compare(many, few, bounds=(0, 1))


def large_sets() -> dict[str, str]:
    """What the page says of large sets of observations."""
    pairs = compared_sets()
    changes = {key: sum(solved(many)) - sum(solved(few)) for key, (few, many) in pairs.items()}
    lost, won = (sum(abs(each) for each in changes.values() if sign * each > 0) for sign in (-1, 1))
    found = of_large_sets().difference
    return {
        "sets_few": str(sum(sum(solved(few)) for few, _ in pairs.values())),
        "sets_many": str(sum(sum(solved(many)) for _, many in pairs.values())),
        "sets_runs": str(sum(len(few) for few, _ in pairs.values())),
        "sets_difference": shown(found),
        "sets_lost": str(lost),
        "sets_won": str(won),
        "sets_worst": str(-min(changes.values())),
        "sets_verdict": AGREES if below(found) else NOT_FOUND,
    }


def of_rival(name: str) -> tuple[Raw, Comparison]:
    """The lines of an agent on all graphs with shared decisions, and its returns against those of the LSTM."""
    of = finished()
    lines, base = ([line for each in SHARED for line in of[each][agent]] for agent in (name, BASE))
    return lines, statistics.compare(returns(lines), returns(base), bounds=(0, 1))


def advantages() -> dict[str, str]:
    """What the page says of attention, associative learning and neuromodulation on confounding graphs."""
    base, _ = of_rival(BASE)
    said = {"lstm": f"{sum(solved(base))} of {len(base)}"}
    better = []
    for key, name in RIVALS.items():
        lines, found = of_rival(name)
        better.append(above(found.difference))
        said |= {key: f"{sum(solved(lines))} of {len(lines)}", f"{key}_difference": shown(found.difference)}
    return said | {"advantage_verdict": AGREES if all(better) else NOT_FOUND}


def open_loop() -> dict[str, str]:
    """What the page says of sequences of actions that ignore all observations; exact."""
    ceilings = {name: open_loop_ceiling(make()) for name, make in CONFIGURATIONS.items()}
    waits = {name: make().graph.wait_prob > 0 for name, make in CONFIGURATIONS.items()}
    without, withs = ([f"{name} {ceilings[name]:g}" for name in waits if waits[name] is p] for p in (False, True))
    holds = all((ceilings[name] < 1) is waits[name] for name in waits)
    verdict = AGREES if holds else NOT_FOUND
    return {"no_waits": ", ".join(without), "with_waits": ", ".join(withs), "open_loop_verdict": verdict}


def gradients() -> dict[str, str]:
    """What the page says of reward gradients on large graphs."""
    found = claim_runs.of_gradient()
    said = {"gradient_difference": shown(found), "gradient_verdict": AGREES if above(found) else NOT_FOUND}
    for name in ("gradient", "needle"):
        lines = claim_runs.runs("large_gradient", reward_fn=name)
        said[f"success_{name}"] = claim_runs.means("success", lines, "depth")
    return said


def noise() -> dict[str, str]:
    """What the page says of noisy rewards."""
    deep = claim_runs.of_noise("3")
    deeper = claim_runs.of_noise("4")
    ends = claim_runs.of_negative()
    noisy = claim_runs.runs("stochastic_rewards", reward_std="1")
    return {
        "noise_difference": shown(deep),
        "deeper_difference": shown(deeper),
        "noise_success": claim_runs.means("success", noisy, "depth"),
        "noise_verdict": AGREES if below(deep) and below(deeper) else NOT_FOUND,
        "ends_difference": shown(ends),
        "ends_rates": claim_runs.means("end_rate", claim_runs.runs("negative_rewards"), "reward_std"),
        "ends_verdict": AGREES if below(ends) else NOT_FOUND,
    }


def alike() -> dict[str, str]:
    """What the page says of images that are alike within a kind of state."""
    found = claim_runs.of_groups()
    rates = claim_runs.means("tasks_learned", claim_runs.runs("stochastic_grouped"), "within")
    return {
        "alike_difference": shown(found),
        "alike_rates": rates,
        "alike_verdict": AGREES if above(found) else NOT_FOUND,
    }


def similarity() -> dict[str, str]:
    """What the page says of tasks without similarities, and of the wait states that tasks share."""
    forgetting = claim_runs.of_dissimilar("forgetting")
    transfer = claim_runs.of_dissimilar(TRANSFER)
    waiting = claim_runs.of_waiting()
    return {
        "dissimilar_forgetting": shown(forgetting),
        "dissimilar_transfer": shown(transfer),
        "similar_transfer": shown(claim_runs.of_dissimilar(TRANSFER, "fo_b1_4tasks")),
        "dissimilar_verdict": AGREES if above(forgetting) and not above(transfer) else NOT_FOUND,
        "waiting_difference": shown(waiting),
        "waiting_verdict": AGREES if below(waiting) else NOT_FOUND,
    }


def page() -> str:
    """The page: its template with its numbers."""
    text = (TEMPLATES / "claims.md").read_text(encoding="utf-8")
    parts = (large_sets, advantages, open_loop, gradients, noise, alike, similarity)
    found: dict[str, str] = {}
    for part in parts:
        found |= part()
    verdicts = [value for name, value in found.items() if name.endswith("_verdict")]
    return Template(text).substitute(
        found,
        agents=", ".join(AGENTS[name] for name in RECURRENT),
        num_agrees=verdicts.count(AGREES),
        num_not_found=verdicts.count(NOT_FOUND),
        machines=machines("memory_cells", claim_runs.NAME),
    )


def make() -> None:
    """Write the page."""
    PAGE.write_text(page(), encoding="utf-8")
