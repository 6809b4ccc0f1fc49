"""Descriptions of curricula before any run, as tables; ``ctgraph-rl curricula`` prints them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain, compress, pairwise
from pathlib import Path
from statistics import fmean

from ctgraph_rl.checks import positive, require
from ctgraph_rl.core.goal import write_goal
from ctgraph_rl.core.graph import CTGraph
from ctgraph_rl.draw.curriculum_figure import draw_graphs
from ctgraph_rl.draw.similarity_figure import draw_similarity
from ctgraph_rl.log.escape import listed
from ctgraph_rl.log.sheets import LISTED, Sheet
from ctgraph_rl.log.sheets import print_sheet as print_sheet
from ctgraph_rl.log.sheets import to_latex as to_latex
from ctgraph_rl.log.sheets import to_markdown as to_markdown
from ctgraph_rl.runs.config import curriculum_of
from ctgraph_rl.runs.settings import curriculum_names
from ctgraph_rl.tasks.curriculum import LAGS, Curriculum, Stream
from ctgraph_rl.tasks.exactness import MOST_HISTORIES, count_histories
from ctgraph_rl.tasks.memory import bank_bytes
from ctgraph_rl.tasks.observability import POLICIES, state_entropy, states_per_observation
from ctgraph_rl.tasks.protocol import Evaluation, Protocol
from ctgraph_rl.tasks.similarity import shared_images, state_agreement
from ctgraph_rl.tasks.task import Task, are_graphs, ct_graphs
from ctgraph_rl.tasks.values import open_loop_ceiling, random_frames_to_goal

AGENT, FRAMES_PER_SECOND = "lstm_ppo", 41_000
"""An agent and its speed on one idle core (docs/reference/agents.md), for estimates."""

SECONDS_OF_A_MEAN = 2e-3
"""Time of an exact evaluation of a task of a stream, without memory."""

SECONDS_OF_A_STEP, SECONDS_OF_A_ROW = 5e-3, 1.3e-5
"""Time of this agent's evaluation step: in all, and per parallel episode."""

OF_A_LIFE = {
    "seen": "the present task, and at block ends of the next one and those 1, 10 and 100 blocks before",
    "all": "the present task and those 1, 10 and 100 blocks before, and at block ends of the next one",
}

OF_TASKS = {"seen": "each of the tasks seen so far", "all": "each of all tasks"}

MOST_SHOWN = 20

UNKNOWN = "-"

SIZES = ("states", "ends")
CLOSED_FORMS = ("P_R", "P_E", "P_RNP", "E[rho]", "E[kappa]", "random frames")
CLOSED_FORM_NOTES = (
    "P_R: probability that a uniformly random policy over the b + 1 actions reaches the goal in an episode.",
    "P_E: the same for any end state.",
    "P_RNP: the same for the goal, under a policy that waits when it must and decides at random.",
    "E[rho]: mean steps of an episode that gets to an end state, of a policy that waits when it must.",
    "E[kappa]: mean episodes until the goal is found when end states are tried one by one.",
    "random frames: mean frames of the uniformly random policy until it reaches the goal for the first time, failed "
    "episodes included.",
)

CEILINGS: dict[str, Callable[[Task], float]] = {
    "open loop": open_loop_ceiling,
    "memoryless det.": lambda task: task.memoryless_ceiling(deterministic=True),
    "memoryless stoch.": lambda task: task.memoryless_ceiling(),
    "optimal": lambda task: task.optimal_value(1.0),
}
CEILING_NOTES = (
    "A ceiling is the best mean return of a kind of policy. open loop: a fixed sequence of actions, which ignores all "
    "observations.",
    "memoryless: an action for each observation, deterministic or stochastic.",
)
CHANGING_GOALS = (
    "Goals change: the ceilings are those of a goal that is known and stays. A search needs memory over episodes."
)
NOISE_AS_DICE = (
    "Noise and rotation on read may serve a deterministic policy as dice, up to the ceiling of stochastic ones."
)
NEEDS_MEMORY = "Memory is needed: a deterministic agent without it, as in greedy evaluation, reaches at most"
MOST_LOST = 4

SAME_DECISIONS = "although decision states look alike, as all decisions on the way to the goal are the same."

OBSERVATION_NOTES = (
    "states: how many wait, decision and end states may show one and the same observation.",
    "H: entropy of the state given the observation, in bits, as a random, a navigating and the optimal policy meet "
    "them; a navigating policy waits when it must and decides at random.",
    "noise, rotation: what is added to each pixel, and the rotation, whenever an image is read.",
)

TABLE_2 = ((2, 1, 0.0), (2, 2, 0.9), (3, 2, 0.9), (2, 4, 0.9), (3, 10, 0.9), (2, 16, 0.5))
"""b, d and p of Table 2's rows."""

MISPRINTS = (
    "The paper prints P_E as 7.40e-2 (row 1) and 1.99e-15 (row 6), both cut, and as 4.78e-5 (row 2), a misprint."
)


def memory(curriculum: Curriculum) -> tuple[int, int]:
    """Bytes of a curriculum's image bank, and of each row's two observations."""
    tasks = _graphs(curriculum)
    one = max(math.prod(task.images.shape) for task in tasks)
    return bank_bytes(tasks), 2 * one


def describe(curriculum: Curriculum, frames_per_second: float | None = None) -> list[Sheet]:
    """The curriculum at large, its blocks and, for CT-graphs, its tasks' difficulty, ceilings and observability.

    Args:
        frames_per_second: for the estimated time; None: that of `AGENT`.

    Raises:
        ValueError: for a rate that is not above 0.
    """
    require(*(positive(frames_per_second=frames_per_second) if frames_per_second is not None else ()))
    overview = _overview(curriculum, frames_per_second)
    if not are_graphs(curriculum.examples):
        return [overview, _blocks(curriculum)]
    return [overview, _blocks(curriculum), _difficulty(curriculum), _ceilings(curriculum), _observations(curriculum)]


def _overview(curriculum: Curriculum, frames_per_second: float | None) -> Sheet:
    rows = {
        "version": str(curriculum.version),
        "fingerprint": curriculum.fingerprint,
        "source": curriculum.source,
        "blocks": f"{len(curriculum.blocks):,}",
        "tasks": f"{len(curriculum.tasks):,}",
        "frames": f"{curriculum.num_frames:,}",
        "protocol": protocol_in_words(curriculum.protocol, len(curriculum.tasks)),
        "evaluation": evaluation_in_words(curriculum.evaluation, isinstance(curriculum, Stream)),
    }
    if isinstance(curriculum, Stream):
        pairs = list(pairwise(curriculum.tasks[:MOST_SHOWN]))
        rows["neighbours"] = "there is one task"
        if pairs:
            images = fmean(shared_images(pair)[0, 1].item() for pair in pairs)
            actions = fmean(state_agreement(pair)[0, 1].item() for pair in pairs)
            alike = f"{images:.0%} of images and {actions:.0%} of states with the same best actions"
            rows["neighbours"] = f"share {alike}, the mean of the first {len(pairs)} pairs"
    if are_graphs(curriculum.examples):
        bank, per_row = memory(curriculum)
        evaluations = _duration(_evaluation_seconds(curriculum))
        histories = max(count_histories(task, reads_actions=False) for task in _graphs(curriculum))
        if curriculum.evaluation.exact and histories > MOST_HISTORIES:
            rows["evaluation"] += " Agents with memory are refused: they have too many histories."
        rows["memory"] = f"{bank:,} bytes of images, and {per_row:,} for each row"
        rows["time"] = f"{_time(curriculum, frames_per_second)}; {evaluations} for evaluations, estimated"
    return Sheet(curriculum.name, {"what": "l", "value": "l"}, tuple(rows.items()))


def _graphs(curriculum: Curriculum) -> Sequence[Task]:
    return ct_graphs(curriculum.examples, "this sheet")


def _time(curriculum: Curriculum, frames_per_second: float | None) -> str:
    if frames_per_second is not None:
        return f"{_duration(curriculum.num_frames / frames_per_second)} at {frames_per_second:,.0f} frames/s"
    seconds = _duration(curriculum.num_frames / FRAMES_PER_SECOND)
    return f"{seconds} at {FRAMES_PER_SECOND:,} frames/s, the rate of agent={AGENT} on one core (--frames-per-second)"


def _evaluation_seconds(curriculum: Curriculum) -> float:
    how = curriculum.evaluation
    if isinstance(curriculum, Stream):
        within = curriculum.blocks.num_frames // how.every if how.every else 0
        each = 1 + len(LAGS) * (how.tasks == "all")
        return SECONDS_OF_A_MEAN * (2 + len(LAGS) + within * each) * len(curriculum.blocks)
    moments = how.before + (curriculum.num_frames // how.every if how.every else len(curriculum.ends))
    tasks = len(curriculum.tasks) / (2 if how.tasks == "seen" else 1) + len(how.held_out)
    rows = tasks * how.num_episodes / how.episodes_per_row
    steps = how.row_episodes * max(task.graph.expected_episode_length for task in _graphs(curriculum))
    return moments * steps * (SECONDS_OF_A_STEP + SECONDS_OF_A_ROW * rows)


def protocol_in_words(protocol: Protocol, num_tasks: int) -> str:
    """Return a protocol in words."""
    ids = {
        "hidden": "The learner does not observe its task.",
        "one_hot": f"Every observation comes with a one-hot task id of length {protocol.length(num_tasks)}.",
        "at_boundaries": "The learner is given the task's id where a block begins and where it is evaluated.",
    }
    boundaries = {
        "announced": "A new block ends all episodes and is announced.",
        "hidden": "A row changes to the next block when its episode ends, without notice.",
    }
    guide = (
        f" A navigating policy acts in the learner's place in a share of the episodes, which falls from 1 to 0 over "
        f"the first {protocol.guide_frames:,} frames."
    )
    endless = " The learner observes no end of an episode." * protocol.hides_episodes
    said = f"{ids[protocol.task_id]} {boundaries[protocol.boundaries]}{endless}"
    return said + guide * bool(protocol.guide_frames)


def evaluation_in_words(evaluation: Evaluation, is_life: bool = False) -> str:
    """Return an evaluation in words; ``is_life``: that of a stream."""
    how = "greedy" if evaluation.greedy else "sampled"
    in_row = f", {evaluation.episodes_per_row} in a row" if evaluation.episodes_per_row > 1 else ""
    moments = [
        *(["before training"] if evaluation.before else []),
        *([f"every {evaluation.every:,} frames"] if evaluation.every else []),
        *(["at block ends"] if evaluation.at_block_ends else []),
    ]
    held_out = f" and {len(evaluation.held_out)} held out" if evaluation.held_out else ""
    which = (OF_A_LIFE if is_life else OF_TASKS)[evaluation.tasks]
    adapts = f", after {evaluation.adapt_episodes} to adapt" if evaluation.adapt_episodes else ""
    episodes = f"{evaluation.num_episodes} {how} episodes{in_row}{adapts}"
    if evaluation.exact:
        episodes = f"The exact means of {how} episodes"
    return f"{episodes} on {which}{held_out}: {', '.join(moments)}."


def _blocks(curriculum: Curriculum) -> Sheet:
    switches = any(block.switch is not None for block in curriculum.example_blocks)
    shown = curriculum.blocks[:MOST_SHOWN] if isinstance(curriculum, Stream) else curriculum.blocks
    numbers = dict.fromkeys(chain.from_iterable(curriculum.trained[: len(shown)]))
    labels = {curriculum.tasks[number]: curriculum.labels[number] for number in numbers}
    columns = {"block": "r", "task": "l"}
    notes = []
    if are_graphs(curriculum.examples):
        columns |= {"b": "r", "d": "r", "p": "r", "goal": "l"}
    else:
        kind = type(curriculum.tasks[0]).__name__
        notes.append(f"Tasks are of {kind}: difficulty and ceilings are known only of CT-graphs.")
    columns["frames"] = "r"
    if switches:
        columns["switch"] = "l"
    if len(shown) < len(curriculum.blocks):
        notes.append(f"The first {len(shown)} of {len(curriculum.blocks):,} blocks.")
    rows = []
    for number, block in enumerate(shown, 1):
        name = str(number)
        frames = f"{block.num_frames:,}"
        switch = "" if block.switch is None else repr(block.switch)
        for task in dict.fromkeys(block.tasks):
            cells = [name, labels[task]]
            if isinstance(task, Task):
                graph = task.graph
                cells += [str(graph.branching_factor), str(graph.depth), f"{graph.wait_prob:g}", write_goal(task.goal)]
            rows.append((*cells, frames, switch)[: len(columns)])
            name = frames = switch = ""
    return Sheet("Blocks", columns, tuple(rows), tuple(notes))


def _difficulty(curriculum: Curriculum) -> Sheet:
    rows = []
    for task, label in _labelled(curriculum):
        graph = task.graph
        sizes = (graph.num_states, graph.num_end_states)
        probs = (graph.reward_prob_random, graph.end_prob_random, graph.reward_prob_navigation)
        lengths = (graph.expected_episode_length, graph.expected_search_episodes, random_frames_to_goal(task))
        rows.append((label, *map(_number, (*sizes, *probs, *lengths))))
    sides = dict.fromkeys((*SIZES, *CLOSED_FORMS), "r")
    return Sheet("Tasks", {"task": "l", **sides}, tuple(rows), CLOSED_FORM_NOTES)


def _ceilings(curriculum: Curriculum) -> Sheet:
    rows = []
    reasons = []
    easy = []
    lost = []
    limited: dict[str, bool] = {CHANGING_GOALS: False, NOISE_AS_DICE: False}
    for task, label in _labelled(curriculum):
        limited[CHANGING_GOALS] |= task.goal_change is not None
        limited[NOISE_AS_DICE] |= bool(task.observations.read_noise or task.observations.read_rotation)
        found: list[float | None] = []
        for ceiling in CEILINGS.values():
            try:
                found.append(ceiling(task))
            except ValueError as error:
                found.append(None)
                reasons.append(f"{UNKNOWN}: {error}")
        rows.append((label, *(UNKNOWN if value is None else _number(value) for value in found)))
        memoryless = found[1]
        optimal = found[3]
        alike = not task.observations.unique_decisions and task.goal_change is None
        if alike and None not in (memoryless, optimal) and memoryless == optimal:
            easy.append(label)
        if memoryless is not None and optimal is not None and memoryless < optimal - 1e-9:
            lost.append(f"{_number(memoryless)} of {_number(optimal)} in {label}")
    no_memory = f"No memory is needed for {', '.join(easy)}: a deterministic policy without memory is optimal, "
    easily = [f"{no_memory}{SAME_DECISIONS}"] if easy else []
    needed = [f"{NEEDS_MEMORY} {listed(lost, MOST_LOST)}."] if lost else []
    notes = (*CEILING_NOTES, *dict.fromkeys(reasons), *needed, *compress(limited, limited.values()), *easily)
    return Sheet("Ceilings", {"task": "l", **dict.fromkeys(CEILINGS, "r")}, tuple(rows), notes)


def _observations(curriculum: Curriculum) -> Sheet:
    rows = []
    reasons = []
    for task, label in _labelled(curriculum):
        try:
            counts = "/".join(map(_number, states_per_observation(task).values()))
            known = [counts, *(_number(state_entropy(task, policy)) for policy in POLICIES)]
        except ValueError as error:
            known = [UNKNOWN] * (1 + len(POLICIES))
            reasons.append(f"{UNKNOWN}: {error}")
        x = task.observations
        varied = (_up_to(x.read_noise), f"{_up_to(x.read_rotation)} deg", f"{task.reward_std:g}")
        rows.append((label, *known, *varied))
    columns = ("states", *(f"H {policy}" for policy in POLICIES), "noise", "rotation", "reward std")
    notes = (*OBSERVATION_NOTES, *dict.fromkeys(reasons))
    return Sheet("Observations", {"task": "l", **dict.fromkeys(columns, "r")}, tuple(rows), notes)


def _up_to(most: int) -> str:
    return f"0..{most}" if most else "0"


def _labelled(curriculum: Curriculum) -> Iterator[tuple[Task, str]]:
    return zip(_graphs(curriculum), curriculum.example_labels, strict=True)


def probabilities() -> Sheet:
    """Return Table 2 of the paper by its formulas, with the printed numbers that differ."""
    rows = []
    for b, d, p in TABLE_2:
        graph = CTGraph(b, d, p)
        of_ends = f"1/{graph.num_end_states}"
        probs = (f"{graph.reward_prob_random:.2e}", f"{graph.end_prob_random:.2e}", of_ends)
        rows.append((f"b={b}, d={d}, p={p:g}", *probs, str(graph.num_states), str(graph.num_end_states)))
    columns = dict.fromkeys(("P_R", "P_E", "P_RNP", "states", "end states"), "r")
    return Sheet("Table 2", {"CT-graph": "l", **columns}, tuple(rows), (*CLOSED_FORM_NOTES[:3], MISPRINTS))


def _number(value: float) -> str:
    return f"{value:,.0f}" if 1e4 <= value < 1e7 else f"{value:.4g}"


def _duration(seconds: float) -> str:
    units = {"days": 86_400, "hours": 3600, "minutes": 60}
    unit, size = next(((unit, size) for unit, size in units.items() if seconds >= 2 * size), ("seconds", 1))
    return f"{seconds / size:.3g} {unit}"


def listing(curricula: Iterable[Curriculum]) -> Sheet:
    """Name, version, tasks, frames, fingerprint and source of each."""
    rows = [
        (c.name, str(c.version), f"{len(c.tasks):,}", f"{c.num_frames:,}", c.fingerprint, c.source) for c in curricula
    ]
    return Sheet("Curricula", LISTED, tuple(rows))


def own_curricula(config_dir: Path) -> list[Curriculum]:
    """Return the curricula of a configuration directory.

    Raises:
        ValueError: as `ctgraph_rl.runs.config.curriculum_of`.
    """
    return [curriculum_of(name, config_dir) for name in curriculum_names(config_dir)]


def find_curriculum(name: str, config_dir: Path | None) -> Curriculum:
    """Return the curriculum of a name or of a JSON file.

    Raises:
        ValueError: for an unknown name, and a file that holds no curriculum.
    """
    is_file = name.endswith(".json") or Path(name).is_file()
    return Curriculum.from_json(name) if is_file else curriculum_of(name, config_dir)


def write(
    curriculum: Curriculum, figure: Path | None = None, similarity: Path | None = None, json: Path | None = None
) -> None:
    """Write figures of graphs and goals and of similarity, and the curriculum as JSON, where named.

    Raises:
        ValueError: for other formats of figures, and a JSON file that exists.
    """
    if figure is not None:
        draw_graphs(curriculum, figure)
    if similarity is not None:
        draw_similarity(curriculum, similarity)
    if json is not None:
        curriculum.to_json(json)
