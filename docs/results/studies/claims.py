"""Sentences of the paper that can be tested: claims.md, made of raw results of runs and of exact values."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import fmean, median

from ctgraph_rl.metrics.curves import frames_to_mastery
from ctgraph_rl.tasks.configurations import CONFIGURATIONS
from ctgraph_rl.tasks.values import open_loop_ceiling
from studies.lifelong import comparison
from studies.memory.conditions import GIVEN, finished
from studies.raw import Raw, fill, groups, machines, numbers_in, read, select, shown, table
from studies.verdicts import (
    AGREES,
    DISAGREES,
    MOST_SEEDS,
    OF_PAIRS,
    UNKNOWN,
    VERDICTS,
    Effect,
    compare_times,
    differences,
    effect_of_signs,
    kept_by_holm,
    later,
    pairs,
    time,
)

NAME = "claim_runs"

OF_SUCCESS = 0.25
"""The smallest difference of a share of episodes or tasks that counts."""

OF_FAILURE = 0.5
"""The loss of success that counts as more than an agent is capable of."""

RECURRENT = (
    "lstm_ppo",
    "lstm_ppo-gru",
    "lstm_ppo-min_gru",
    "lstm_ppo-amrl_max",
    "lstm_ppo-amrl_avg",
    "lstm_ppo-backpropamine",
)

SENTENCES = {
    "sets": (
        "abstract",
        "A large observation set can produce a vast set of histories that impairs memory-augmented agents.",
    ),
    "gradient": (
        "2.5",
        "Such a setting provides a gradient across rewards in large graphs such as those in the last two rows",
    ),
    "noise": (
        "2.5",
        "their complexity is likely to exceed the capabilities of current RL algorithms, unless stochasticity is used "
        "for very small graphs (i.e., depth 1 or 2).",
    ),
    "negative": (
        "2.5",
        "If stochasticity results in negative reward samples, a policy might be ``intimidated'' into not approaching "
        "graph ends.",
    ),
    "memory": (
        "3.2.2",
        "Approaches such as attention, associative learning and neurmodulation are likely to provide an advantage in "
        "this case.",
    ),
    "stochastic": (
        "3.2.3",
        "In practice, this is an extremely hard problem that links to real-world scenarios only if each subset of $O$ "
        "share common features.",
    ),
    "fixed": (
        "3.3",
        "In all previous cases with a deterministic $\\rho$, an agent can learn to reach a specific goal state by "
        "ignoring all inputs, and simply applying the unique and optimal sequence.",
    ),
    "dissimilar": (
        "3.4.1",
        "their lack of similarities can be exploited to test an LRL to learn new and uncorrelated tasks without "
        "suffering from catastrophic forgetting. However, such a curriculum will not test the ability to exploit old "
        "and new knowledge in backwards and forward transfer metrics",
    ),
    "waiting": ("3.4.1", "This similarity can be exploited by LRL algorithms to accelerate learning across tasks."),
}
"""What the paper says, by place: its words, as they are there."""

FIRST = ("frames_1",)
ALL = ("frames_1", "frames_2", "frames_3", "frames_4")
LATER = ALL[1:]
LARGE = {"16": (2, "b = 2, d = 16, p = 0.5"), "10": (3, "b = 3, d = 10, p = 0.9")}
"""Branches, and the graph in words, by depth."""

SHORT = "204800"
NOISY = (*((depth, SHORT) for depth in "12345"), ("4", "819200"))
"""Depths and frames of runs with noisy rewards."""

SMALL = ("1", "2")
"""Depths of very small graphs."""

STDS = ("0", "1", "2", "5", "10", "30")

MODULATED = "backpropamine, simple"
PLASTIC = "backpropamine, none"
MEMORIES = {"lstm": "an LSTM", "attention": "attention", PLASTIC: "plastic weights", MODULATED: "modulated weights"}
OF_MEMORY = (
    ("attention", "attention", "lstm"),
    ("association (plastic weights)", PLASTIC, "lstm"),
    ("neuromodulation of plastic weights", MODULATED, PLASTIC),
)
"""What is tested of memory: its name, its cell, and the one that it is compared with."""


@dataclass(frozen=True)
class Row:
    """A sentence beside runs.

    Args:
        sentence: a key of `SENTENCES`.
        test: what was compared.
        number: what was found.
        effect: in the direction of the sentence; None where the number is exact.
        exact: the verdict on an exact number.
        holm: whether the verdict stands after Holm's correction.
    """

    sentence: str
    test: str
    number: str
    effect: Effect | None
    exact: str = UNKNOWN
    holm: bool = False

    @property
    def verdict(self) -> str:
        """See `Effect.verdict`."""
        return self.exact if self.effect is None else self.effect.verdict

    @property
    def said(self) -> str:
        """The verdict, with its reason where nothing can be said."""
        effect = self.effect
        if effect is None or self.verdict != UNKNOWN:
            return f"**{self.verdict}**" + " (Holm)" * self.holm
        if effect.room < effect.counts:
            return f"**{UNKNOWN}**: no room for an effect"
        enough = f"fewer than {MOST_SEEDS} would not do" if effect.seeds is None else f"{effect.seeds} would do"
        return f"**{UNKNOWN}**: {len(effect.values)} seeds; {enough}"

    def cells(self) -> list[str]:
        """The cells of the table."""
        number = str(list(SENTENCES).index(self.sentence) + 1)
        if self.effect is None:
            return [number, self.test, self.number, "exact", "exact", self.said]
        smallest = self.effect.smallest
        least = "none" if smallest is None else f"{smallest:.2f}"
        return [number, self.test, self.number, shown(self.effect.estimate), least, self.said]


def runs(curriculum: str, **conditions: str) -> Raw:
    """Return the lines of a curriculum under some conditions, by seed."""
    found = select(read(NAME), curriculum=curriculum, **conditions)
    return sorted(found, key=lambda line: int(line["seed"]))


def mean(lines: Raw, column: str) -> float:
    """Return the mean of a column."""
    return fmean(numbers_in(lines, column))


def frames_in_words(lines: Raw, columns: Sequence[str]) -> str:
    """Return the median of times, where those that were not reached are the latest."""
    middle = median(time(line[column]) for line in lines for column in columns)
    return "not reached" if middle == float("inf") else f"{middle:,.0f}"


def large_sets() -> list[Row]:
    """A large set of images impairs memory."""
    of = {number: runs("co_hard", num_wait_images=number, cell="lstm") for number in ("1", "10", "500", "5000")}
    sizes = "; ".join(f"{number}: {frames_in_words(lines, FIRST)}" for number, lines in of.items())
    words, effect = compare_times(of["5000"], of["1"], FIRST)
    test = "5,000 wait images against one: frames to a return of 0.9, LSTM-PPO; seeds added after a look"
    first = Row("sets", test, f"{words}; median by images {sizes}", effect)
    return [
        first,
        Row(
            "sets", "500 wait images against 100, six agents with memory, which share seeds, four graphs", *older_sets()
        ),
    ]


def older_sets() -> tuple[str, Effect]:
    """Return the comparison of 500 images with 100, a value for each agent and seed."""
    of = finished()
    signs: dict[tuple[str, str], list[int]] = {}
    reached = []
    for condition in GIVEN:
        if condition.num_wait_images == "100" and condition.wait_prob != "0":
            beside = of[condition._replace(num_wait_images="500")]
            for agent in RECURRENT:
                for few, many in pairs(of[condition][agent], beside[agent]):
                    times = (many["frames_to_90"], few["frames_to_90"])
                    signs.setdefault((agent, few["seed"]), []).append(later(*times))
                    reached.append(any(times))
    return effect_of_signs(list(signs.values()), fmean(reached))


def gradients() -> list[Row]:
    """A reward gradient helps on large graphs; without guided runs no run met an end, so no effect was possible."""
    found = []
    for depth, (branches, graph) in LARGE.items():
        gradient, needle = (runs("guided_gradient", depth=depth, reward_fn=name) for name in ("gradient", "needle"))
        if gradient:
            ends = [mean(lines, "end_rate") for lines in (gradient, needle)]
            effect = Effect(differences(gradient, needle, "end_rate"), OF_SUCCESS, 1 - ends[1])
            number = f"episodes at an end {ends[0]:.2f} and {ends[1]:.2f}"
            found.append(Row("gradient", f"gradient against one goal, PPO, {graph}", number, effect))
            chance = return_of_random_ends(gradient[0]["order"], branches)
            values = [value - chance for value in numbers_in(gradient, "return")]
            near = Effect(values, OF_SUCCESS, 1 - chance, (-chance, 1 - chance))
            test = f"return less that of random ends, {chance:.2f}, PPO with the gradient, {graph}"
            found.append(Row("gradient", test, f"return {mean(gradient, 'return'):.2f}", near))
        else:
            gradient, needle = (runs("large_gradient", depth=depth, reward_fn=name) for name in ("gradient", "needle"))
            met = max(numbers_in(gradient + needle, "end_rate"))
            effect = Effect(differences(gradient, needle, "end_rate"), OF_SUCCESS, met)
            test = f"the same without a guide, PPO, {graph}"
            found.append(Row("gradient", test, f"episodes at an end {met:.2f}", effect))
    return found


def return_of_random_ends(goal: str, branches: int) -> float:
    """Return the mean of a reward gradient over all ends, for a goal such as ``goal1.2``; exact."""
    right = [int(place) for place in goal.removeprefix("goal").split(".")]
    misses = [fmean(abs(branch - place) for branch in range(1, branches + 1)) for place in right]
    weights = [branches ** (len(right) - k) for k in range(1, len(right) + 1)]
    return 1 - sum(map(operator.mul, weights, misses)) / (branches ** len(right) - 1)


def noise() -> list[Row]:
    """Noisy rewards are beyond agents from depth 3 on."""
    rows = []
    for depth, frames in NOISY:
        plain = runs("stochastic_rewards", depth=depth, reward_std="0", frames=SHORT)
        noisy = runs("stochastic_rewards", depth=depth, reward_std="1", frames=frames)
        success = mean(plain, "success")
        effect = Effect(differences(plain, noisy, "success"), OF_FAILURE, success, absent=depth in SMALL)
        test = f"noise of standard deviation 1 against none, PPO, depth {depth}"
        if frames != SHORT:
            test += f", {int(frames):,} frames with noise"
        rows.append(Row("noise", test, f"success {mean(noisy, 'success'):.2f} and {success:.2f}", effect))
    return rows


def negative_samples() -> list[Row]:
    """Negative samples keep a policy from ends."""
    of = {std: runs("negative_rewards", reward_std=std, goal_reward="1") for std in STDS}
    control = mean(runs("negative_rewards", goal_reward="-1"), "end_rate")
    rates = ", ".join(f"{std}: {mean(lines, 'end_rate'):.2f}" for std, lines in of.items())
    number = f"episodes at an end by standard deviation {rates}; control {control:.2f}"
    lost = differences(of["0"], of[STDS[-1]], "end_rate")
    effect = Effect(lost, OF_SUCCESS, mean(of["0"], "end_rate") - control)
    return [
        Row(
            "negative",
            f"noise of standard deviation {STDS[-1]} against none, PPO, CT-FO-B1; added after 10 failed",
            number,
            effect,
        )
    ]


def advantages() -> list[Row]:
    """Attention, association and neuromodulation are an advantage."""
    rows = []
    for name, cell, other in OF_MEMORY:
        lines = tested(cell)
        seeds = {line["seed"] for line in lines}
        beside = [line for line in tested(other) if line["seed"] in seeds]
        words, effect = compare_times(beside, lines, FIRST)
        medians = f"medians {frames_in_words(lines, FIRST)} and {frames_in_words(beside, FIRST)}"
        test = f"{name} against {MEMORIES[other]}, frames to 0.9"
        rows.append(Row("memory", test, f"the other is {words}; {medians}", effect))
    return rows


def tested(cell: str) -> Raw:
    """Return the runs of a memory that are not of the search over its settings."""
    lines = runs("co_hard", num_wait_images="500", cell=cell)
    return [line for line in lines if int(line["seed"]) < 100]


def stochastic_observations() -> list[Row]:
    """Fully stochastic observations are hard unless those of one kind share features."""
    rows = []
    for size in ("10", "50", "200"):
        alike, apart = (
            runs("stochastic_grouped", group_size=size, within=within, frames=SHORT) for within in ("0.1", "0.3")
        )
        learned = [mean(lines, "tasks_learned") for lines in (alike, apart)]
        gained = [value / 4 for value in differences(alike, apart, "tasks_learned")]
        number = f"{learned[0]:.1f} and {learned[1]:.1f} of 4 tasks learned"
        test = f"sets of {size}, alike against unrelated, LSTM-PPO"
        rows.append(Row("stochastic", test, number, Effect(gained, OF_SUCCESS, 1 - learned[1] / 4)))
    return rows


def open_loop() -> list[Row]:
    """With p = 0 an agent can ignore all inputs."""
    agrees = True
    parts = []
    for waits in (False, True):
        for name, make in CONFIGURATIONS.items():
            task = make()
            if (task.graph.wait_prob > 0) is waits:
                best = open_loop_ceiling(task)
                agrees &= (best < 1) is waits
                parts.append(f"{name} {best:g}")
    verdict = AGREES if agrees else DISAGREES
    return [Row("fixed", "return of the best fixed sequence of actions", ", ".join(parts), None, verdict)]


def similarity() -> list[Row]:
    """Tasks without similarities test forgetting, and not transfer."""
    tuned, scratch = (runs("fo_b1_dissimilar", method=method, frames="409600") for method in ("finetune", "scratch"))
    nested, control = compare_times(nested_goals("scratch"), nested_goals("finetune"), LATER)
    words, transfer = compare_times(scratch, tuned, LATER)
    room = 1.0 if control.verdict == AGREES else 0.0
    forgotten = Effect(numbers_in(tuned, "forgetting"), OF_SUCCESS, 1.0)
    number = f"`scratch` is {words}; in the control, nested goals, {nested}"
    test = "frames of later tasks: `scratch` against `finetune`, PPO"
    return [
        Row("dissimilar", "forgetting of fine-tuned PPO", f"{mean(tuned, 'forgetting'):.2f}", forgotten),
        Row("dissimilar", test, number, replace(transfer, room=room, absent=True)),
    ]


def nested_goals(method: str) -> Raw:
    """Return the times of PPO on growing depth, a line for each seed, from the table of methods."""
    lines = select(read("methods"), agent="ppo", curriculum="fo_b1_depth2to5", method=method)
    found = []
    for (seed,), of in groups(lines, "seed").items():
        terms: Sequence[float | None] = frames_to_mastery(comparison.curves(of)).terms or ()
        times = ["" if term is None else f"{term:g}" for term in terms]
        found.append({"seed": seed, **dict(zip(ALL, times, strict=True))})
    return sorted(found, key=lambda line: int(line["seed"]))


def waiting() -> list[Row]:
    """Shared waiting accelerates learning."""
    scratch = runs("shared_waiting", method="scratch")
    rows = []
    for method in ("finetune", "clear", "mask_lc"):
        words, effect = compare_times(scratch, runs("shared_waiting", method=method), LATER)
        test = f"frames of later tasks: `scratch` against `{method}`, only LSTM-PPO"
        rows.append(Row("waiting", test, f"`scratch` is {words}", effect))
    return rows


def rows() -> list[Row]:
    """All rows of the table, in the order of the paper."""
    parts = (
        large_sets,
        gradients,
        noise,
        negative_samples,
        advantages,
        stochastic_observations,
        open_loop,
        similarity,
        waiting,
    )
    found = [row for part in parts for row in part()]
    with_effect = [row for row in found if row.effect is not None]
    kept = kept_by_holm([row.effect for row in with_effect if row.effect is not None])
    standing = [with_effect[place] for place in kept]
    return [replace(row, holm=row in standing) for row in found]


def summary(found: Sequence[Row]) -> str:
    """Return the sentences with the verdicts of their rows."""
    lines = []
    for number, (sentence, (place, words)) in enumerate(SENTENCES.items(), start=1):
        verdicts = [row.verdict for row in found if row.sentence == sentence]
        counts = [f"{name} {verdicts.count(name)}" for name in VERDICTS if name in verdicts]
        lines.append(f'{number}. {place}: "{words}" **{", ".join(counts)}**')
    return "\n".join(lines)


def settings() -> str:
    """Return the learning rate of each memory."""
    parts = []
    for cell in MEMORIES:
        rates = sorted({line["learning_rate"] for line in tested(cell)})
        parts.append(f"{cell} {', '.join(rates)}")
    return ", ".join(parts)


def page() -> str:
    """The page."""
    found = rows()
    verdicts = [row.verdict for row in found]
    head = ["sentence", "test", "found", "effect", "smallest effect seen", "verdict"]
    texts = {
        "summary": summary(found),
        "table": table(head, [row.cells() for row in found]),
        "num_tests": len(found),
        "num_agrees": verdicts.count(AGREES),
        "num_disagrees": verdicts.count(DISAGREES),
        "num_unknown": verdicts.count(UNKNOWN),
        "num_intervals": sum(row.effect is not None for row in found),
        "num_holm": sum(row.holm for row in found),
        "of_success": OF_SUCCESS,
        "of_failure": OF_FAILURE,
        "of_pairs": OF_PAIRS,
        "settings": settings(),
        "machines": machines("memory_cells", NAME),
    }
    return fill("claims", texts)
