"""What adaptation.md concludes, and what raw results must be for it."""

from __future__ import annotations

from itertools import combinations
from statistics import fmean

from studies import adaptation_swap
from studies.adaptation import LABELS, RIVALS, SUCCESS, SURJECTIVE, WITHOUT_MEMORY, adapted, against, runs
from studies.raw import read

from ctgraph_rl.report import statistics
from helpers.conclusions.sentences import Sentences

says = Sentences()


def episodes(agent: str, gate: str = "none") -> list[list[float]]:
    """Return the success of each seed of an agent in each episode of a row, at depth 2."""
    return [[float(line["success"]) for line in lines] for lines in runs(2)[agent, gate].values()]


@says("**PEARL and RL^2 search for the goal from the first episode on.**")
def _() -> bool:
    return all(fmean(curve[4:20]) > 0.5 for name in ("pearl", "rl2") for curve in episodes(name))


@says("**CAVIA and MAML do not search, and then miss some of the goals.**")
def _() -> bool:
    curves = [*episodes("cavia"), *episodes("maml")]
    return all(abs(fmean(curve[:20]) - 0.25) < 0.05 and fmean(curve[20:]) < 0.8 for curve in curves)


@says("**Where decisions look alike only RL^2 exceeds the best policy without memory**")
def _() -> bool:
    of_agents = runs(2, SURJECTIVE)
    above = {(agent, adapted(lines) > WITHOUT_MEMORY) for (agent, _), of in of_agents.items() for lines in of.values()}
    return above == {("rl2", True), ("cavia", False), ("maml", False), ("pearl", False)}


@says("With `hard_straight_through` PEARL ends lower in each of three seeds, by")
def _() -> bool:
    return against(runs(2), ("pearl", "none"), ("pearl", "hard_straight_through")).wins == 3


@says("**Three seeds cannot say whether a gate helps**")
def _() -> bool:
    of = runs(2)
    gates = [against(of, key, (key[0], "none")) for key in of if key[1] != "none"]
    clear = [each for each in gates if each.p_value is not None and each.p_value <= 0.05]
    return {each.difference.n for each in gates} == {3} and clear == []


@says("One of three soft gates of CAVIA almost never finds the goal.")
def _() -> bool:
    return [fmean(curve) < 0.01 for curve in episodes("cavia", "soft")].count(True) == 1


@says("**PENN-A is within 0.01 of the best search where the goal is swapped** (one seed).")
def _() -> bool:
    [share] = adaptation_swap.shares("penn_a", held_out=True)
    return abs(adaptation_swap.best_search(4, swapped=True) - share) < 0.01


@says("RL^2 always goes to one goal")
def _() -> bool:
    lines = [line for line in read("adaptation_swap") if (line["agent"], line["held_out"]) == ("rl2", "False")]
    reached = {(line["label"], line["success"]) for line in lines}
    return len(lines) == 12 and [goal for goal, share in reached if share == "1.0"] == ["goal1.1"] and len(reached) == 4


@says("**Five seeds cannot order the agents** on the fully observable graph: no p-value of five pairs is below 0.06.")
def _() -> bool:
    of = runs(2)
    pairs = [against(of, (one, "none"), (other, "none")) for one, other in combinations(LABELS, 2)]
    return {each.difference.n for each in pairs} == {5} and min(each.p_value or 0 for each in pairs) > 0.06


@says("PEARL ends higher in each of five seeds:")
def _() -> bool:
    of = runs(2)
    return all(against(of, ("pearl", "none"), (name, "none")).wins == 5 for name in RIVALS)


@says("the interval of each gate's difference from `none` holds 0.")
def _() -> bool:
    of = runs(2)
    gates = [against(of, key, (key[0], "none")).difference for key in of if key[1] != "none"]
    return all(each.low is not None and each.high is not None and each.low < 0 < each.high for each in gates)


@says("| agrees, with our settings |")
def _() -> bool:
    found = statistics.mean(adaptation_swap.shares("rl2", held_out=True), bounds=SUCCESS)
    return found.high is not None and found.high < adaptation_swap.best_search(4, swapped=True)


@says("In three of five seeds the success of RL^2 falls in late episodes.")
def _() -> bool:
    lost = [fmean(curve[16:20]) - fmean(curve[-4:]) > 0.1 for curve in episodes("rl2")]
    return (lost.count(True), len(lost)) == (3, 5)
