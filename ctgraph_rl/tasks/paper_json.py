"""The JSON parameters of Table 3 of the paper.

``graph_shape`` is enough; other keys have defaults. Rewards are the paper's, their noise is additive, and an episode
ends in the end state. Files of the authors' implementation have a section ``image_dataset``, and
`ctgraph_rl.tasks.reference` reads them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from ctgraph_rl.checks import NamedValues, ReadOnlyValues, as_tuple, did_you_mean, is_int, require
from ctgraph_rl.core.goal import Goal
from ctgraph_rl.core.graph import CTGraph
from ctgraph_rl.tasks.images import OneHot, PaperImages
from ctgraph_rl.tasks.observations import Observations

SHAPE = {"d": "depth", "b": "branching_factor", "p": "wait_prob"}

SECTIONS: dict[str, dict[str, str]] = {
    "graph_shape": SHAPE,
    "reward": {"high_r": "goal_reward", "fail_r": "fail_reward", "std_r": "reward_std"},
    "observations": {
        "MDP_D": "unique_decisions",
        "MDP_W": "unique_waits",
        "W_IDs": "wait_ids",
        "D_IDs": "decision_ids",
    },
    "image_set": {
        "seed": "image_seed",
        "1D": "one_hot",
        "nr_images": "num_images",
        "noise_on_read": "read_noise",
        "rotation_on_read": "read_rotation",
    },
}
"""What each key means here, by section. A space in a name is an underscore."""

SEED = "Seed"
"""Of the environment, not of a task."""

DEFAULTS: NamedValues = {
    "wait_prob": 0.0,
    "unique_decisions": False,
    "unique_waits": False,
    "image_seed": 1,
    "one_hot": False,
    "read_noise": 0,
    "read_rotation": 0,
}


def is_paper_json(content: ReadOnlyValues) -> bool:
    """Return whether a file is one of Table 3, not of the authors' implementation."""
    shape = content.get("graph_shape")
    return "image_dataset" not in content and isinstance(shape, Mapping) and bool({"d", "b"} & shape.keys())


def read_paper_json(source: str, content: ReadOnlyValues, goal: Goal | None) -> NamedValues:
    """Return the arguments of `Task` for the parameters of Table 3.

    Missing ids are the next free ones after home, 0, and fail, 1: decision states first where they share ids. End
    states, which Table 3 leaves out, come last.

    Args:
        goal: d decisions in 1..b, such as ``"1.2"``.

    Raises:
        ValueError: for a missing goal, unknown sections and keys, and a graph without d or b.
    """
    found = dict(_found(source, content))
    require(
        (goal is not None, "goal is not in Table 3 and must be given: d decisions in 1..b, such as 1.2"),
        *((SHAPE[key] in found, f"{source}: graph_shape.{key} is missing") for key in ("d", "b")),
    )
    found = DEFAULTS | found
    graph = CTGraph(found["branching_factor"], found["depth"], found["wait_prob"])
    shown = shown_ids(
        graph, found["unique_waits"], found["unique_decisions"], found.get("wait_ids"), found.get("decision_ids")
    )
    observations = replace(shown, read_noise=found["read_noise"], read_rotation=found["read_rotation"])
    count = found.get("num_images", observations.last_id + 1)
    one_hot = found["one_hot"]
    require((isinstance(one_hot, bool), f"{source}: image_set.1D must be true or false, got {one_hot!r}"))
    images = OneHot(count) if one_hot else PaperImages(count, found["image_seed"])
    rewards = {name: found[name] for name in SECTIONS["reward"].values() if name in found}
    return {"graph": graph, "goal": goal, "observations": observations, "images": images, **rewards}


def _found(source: str, content: ReadOnlyValues) -> Iterator[tuple[str, Any]]:
    for written, section in content.items():
        name = written.replace(" ", "_")
        if name == SEED:
            continue
        known = SECTIONS.get(name)
        require((known is not None, f"{source}: unknown section {written!r}; {did_you_mean(name, [*SECTIONS, SEED])}"))
        require((isinstance(section, Mapping), f"{source}: section {written!r} must be an object, got {section!r}"))
        for key, value in section.items():
            meaning = known.get(key.replace(" ", "_"))  # type: ignore[union-attr]
            unknown = f"{source}: Table 3 has no {written}.{key}; {did_you_mean(key, known)}"  # type: ignore[arg-type]
            require((meaning is not None, unknown))
            yield str(meaning), value


def shown_ids(
    graph: CTGraph, unique_waits: bool, unique_decisions: bool, wait_ids: Any = None, decision_ids: Any = None
) -> Observations:
    """Return the ids of wait, decision and end states: given ones, else the next free."""
    ids = {"wait_ids": wait_ids, "decision_ids": decision_ids}
    sizes = {
        "wait_ids": graph.num_wait_states if unique_waits else 1,
        "decision_ids": graph.num_decision_states if unique_decisions else 1,
        "end_ids": graph.num_end_states if unique_waits or unique_decisions else 1,
    }
    order = ("wait_ids", "decision_ids") if unique_decisions else ("decision_ids", "wait_ids")
    for name in (*order, "end_ids"):
        if ids.get(name) is None:
            ranges = [as_tuple(each) for each in ids.values()]
            lasts = [each[-1] for each in ranges if isinstance(each, tuple) and each and is_int(each[-1])]
            first = max([1, *lasts]) + 1
            ids[name] = (first, first + sizes[name] - 1)
    return Observations(**ids, unique_waits=unique_waits, unique_decisions=unique_decisions)
