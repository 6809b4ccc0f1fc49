"""The configuration files of the authors' implementation, in all three dialects."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import fields
from itertools import product
from os import PathLike
from os.path import lexists
from typing import TYPE_CHECKING

from ctgraph_rl.checks import NamedValues, ReadOnlyValues, Rule, did_you_mean, is_int, is_real, require
from ctgraph_rl.core.goal import Goal
from ctgraph_rl.core.graph import CTGraph
from ctgraph_rl.core.rewards import Needle, ReferenceLinear, RewardFn
from ctgraph_rl.disk import write_whole
from ctgraph_rl.strict import json_object
from ctgraph_rl.tasks.images import ReferenceImages, ReferenceOneHot
from ctgraph_rl.tasks.images.image_set import WHITE
from ctgraph_rl.tasks.images.reference_images import MAX_SEED
from ctgraph_rl.tasks.observations import MAX_READ_ROTATION, Observations
from ctgraph_rl.tasks.paper_json import is_paper_json, read_paper_json

if TYPE_CHECKING:
    from ctgraph_rl.tasks.task import Task

_DIALECTS = ("2019", "2021", "2023")
_GOAL_NEVER_CHANGES = ("2019",)  # the versions that read these files have no use for the numbers of episodes


_KEYS: dict[str, tuple[str, str | None, str | None, str | None]] = {  # section, and the key in each dialect
    "depth": ("graph_shape", "depth", "depth", "d"),
    "branching_factor": ("graph_shape", "branching_factor", "branching_factor", "b"),
    "wait_prob": ("graph_shape", "delay_prob", "wait_prob", "p"),
    "goal_reward": ("reward", "high_reward_value", "high_reward_value", "high_r"),
    "fail_reward": ("reward", "crash_reward_value", "crash_reward_value", "fail_r"),
    "is_stochastic": ("reward", "stochastic_sampling", "stochastic_sampling", None),
    "reward_std": ("reward", "reward_std", "reward_std", "std_r"),
    "min_episodes": (
        "reward",
        "min_static_reward_episodes",
        "min_static_reward_episodes",
        "min_static_reward_episodes",
    ),
    "max_episodes": (
        "reward",
        "max_static_reward_episodes",
        "max_static_reward_episodes",
        "max_static_reward_episodes",
    ),
    "distribution": ("reward", "reward_distribution", "reward_distribution", "reward_distribution"),
    "unique_decisions": ("observations", "MDP_decisions", "MDP_decision_s", "MDP_D"),
    "unique_waits": ("observations", "MDP_delays", "MDP_wait_s", "MDP_W"),
    "wait_ids": ("observations", "delay_states", "wait_states", "W_IDs"),
    "decision_ids": ("observations", "decision_points", "decision_states", "D_IDs"),
    "end_ids": ("observations", "graph_ends", "graph_ends", "graph_ends"),
    "image_seed": ("image_dataset", "seed", "seed", "seed"),
    "one_hot": ("image_dataset", "1D", "1D", "1D"),
    "num_images": ("image_dataset", "nr_of_images", "nr_of_images", "nr_of_images"),
    "noise": ("image_dataset", "noise_on_images_on_read", "noise_on_images_on_read", "noise_on_read"),
    "rotation": ("image_dataset", "small_rotation_on_read", "small_rotation_on_read", "rotation_on_read"),
}
"""By key of a dialect: what it means here, and its name in each dialect; None where it has none."""

MAX_BYTES = 2**20

_SECTIONS = tuple(dict.fromkeys(section for section, *_ in _KEYS.values()))

_DISTRIBUTIONS: dict[str, RewardFn] = {"needle_in_haystack": Needle(), "linear": ReferenceLinear()}

_LEGACY: NamedValues = {"reward_cue": True, "cue_wraps": True, "legacy_index": True, "noise_before_rotation": True}


def read_task(path_or_dict: str | PathLike[str] | ReadOnlyValues, goal: Goal | None) -> NamedValues:
    """Return the arguments of `Task` for a configuration file or its content."""
    source, content = json_object(path_or_dict, "configuration", MAX_BYTES)
    if is_paper_json(content):
        return read_paper_json(source, content, goal)
    draws = "the authors' implementation draws one at random or sets it with set_high_reward_path, counting from 0"
    fix = "add 1 to each entry of its path, such as the goal 1.2 for [0, 1]"
    require((goal is not None, f"goal is not in the file and must be given: {draws}; {fix}"))
    given = set(_given(content))
    dialect = max(
        reversed(_DIALECTS), key=lambda name: len(given & set(_places(name).values()))
    )  # the newest of several
    require(*((False, f"{source}: {fault}") for fault in _faults(content, dialect)))
    places = _places(dialect)
    found = {name: content[section][key] for name, (section, key) in places.items()}
    if dialect in _GOAL_NEVER_CHANGES:
        found.update(min_episodes=-1, max_episodes=-1)
    require(*_value_rules(found, places))
    return {"goal": goal, **_arguments(found)}


def _places(dialect: str) -> dict[str, tuple[str, str]]:
    places = {}
    for name, (section, *keys) in _KEYS.items():
        key = keys[_DIALECTS.index(dialect)]
        if key is not None:
            places[name] = section, key
    return places


def _given(content: ReadOnlyValues) -> list[tuple[str, str]]:
    given: list[tuple[str, str]] = []
    for section in _SECTIONS:
        if isinstance(content.get(section), Mapping):
            given += product([section], content[section])
    return given


def _faults(content: ReadOnlyValues, dialect: str) -> Iterator[str]:
    names = (*_SECTIONS, "general_seed")
    for name in content:
        if name not in names:
            yield f"unknown section {name!r}; {did_you_mean(name, names)}"
    for name in _SECTIONS:
        if not isinstance(content.get(name), Mapping):
            yield f"section {name!r} {'must be an object' if name in content else 'is missing'}"
    wanted = _places(dialect).values()
    given = _given(content)
    for section, key in given:
        is_switch = (section, key) == ("reward", "stochastic_sampling")  # files of 2023 may keep the older one of noise
        says_nothing = is_switch and content["reward"].get("std_r") == 0
        if (section, key) not in wanted and not says_nothing:
            yield _surplus(section, key, dialect)
    for section, key in wanted:
        if isinstance(content.get(section), Mapping) and (section, key) not in given:
            yield f"{section}.{key} is missing"


def _surplus(section: str, key: str, dialect: str) -> str:
    here = _places(dialect)
    for other in _DIALECTS:
        for name, place in _places(other).items():
            if place == (section, key):
                fix = f"use {here[name][1]!r}" if name in here else "leave it out"
                return f"{section}.{key} is of the {other} dialect, the other keys of the {dialect} one: {fix}"
    keys = [known for home, known in here.values() if home == section]
    return f"unknown key {section}.{key}; {did_you_mean(key, keys)}"


def _value_rules(found: NamedValues, places: dict[str, tuple[str, str]]) -> list[Rule]:
    def said(name: str) -> str:
        return f"{'.'.join(places[name])} must be"

    noise = found["noise"]
    rotation = found["rotation"]
    first = found["min_episodes"]
    end = found["max_episodes"]
    episodes = is_int(first) and is_int(end) and (max(first, end) <= 0 or 1 <= first < end)
    distribution = found["distribution"]
    choices = " or ".join(map(repr, _DISTRIBUTIONS))
    known = isinstance(distribution, str) and distribution in _DISTRIBUTIONS
    still = found["one_hot"] is not True or (is_real(noise) and noise < 1 and rotation == 1)
    rules = []
    for name in ("is_stochastic", "unique_decisions", "unique_waits", "one_hot"):
        if name in found:
            rules.append((isinstance(found[name], bool), f"{said(name)} true or false, got {found[name]!r}"))
    return [
        *rules,
        (known, f"{said('distribution')} {choices}, got {distribution!r}"),
        (
            episodes,
            f"{said('min_episodes')} below max_static_reward_episodes, which is exclusive, and both >= 1, or both <= 0 "
            f"for a goal that stays; got {first!r} and {end!r}",
        ),
        (is_real(noise, 0, WHITE), f"{said('noise')} a number in [0, {WHITE}], got {noise!r}"),
        (
            is_int(rotation, 1, MAX_READ_ROTATION + 1),
            f"{said('rotation')} an integer in 1..{MAX_READ_ROTATION + 1}, got {rotation!r}; it is exclusive: 1 is "
            "none, and 0 makes the authors' implementation crash",
        ),
        (
            still,
            f"image_dataset.1D needs {places['noise'][1]} below 1 and {places['rotation'][1]} 1, got {noise!r} and "
            f"{rotation!r}: what the authors' implementation does with others is not recorded",
        ),
    ]


def _arguments(found: NamedValues) -> NamedValues:
    changes = found["min_episodes"] > 0
    noise = 0 if found["one_hot"] else found["noise"]
    count = found["num_images"]
    seed = found["image_seed"]
    images = ReferenceOneHot(count) if found["one_hot"] else ReferenceImages(count, seed, noise)
    return {
        "graph": CTGraph(found["branching_factor"], found["depth"], found["wait_prob"]),
        "observations": Observations(
            wait_ids=found["wait_ids"],
            decision_ids=found["decision_ids"],
            end_ids=found["end_ids"],
            unique_waits=found["unique_waits"],
            unique_decisions=found["unique_decisions"],
            read_noise=math.floor(noise),
            read_rotation=found["rotation"] - 1,
            **_LEGACY,
        ),
        "images": images,
        "reward_fn": _DISTRIBUTIONS[found["distribution"]],
        "goal_reward": found["goal_reward"],
        "fail_reward": found["fail_reward"],
        "reward_std": found["reward_std"] if found.get("is_stochastic", True) else 0.0,
        "reward_noise": "multiplicative",
        "goal_change": (found["min_episodes"], found["max_episodes"] - 1) if changes else None,
        "extra_end_step": True,
        "legacy_goal_change": changes,
    }


def write_task(task: Task, path: str | PathLike[str] | None, general_seed: int) -> NamedValues:
    """Return a task as a file of the 2023 dialect, written to ``path`` if given."""
    require(
        (path is None or not lexists(path), f"{path} exists: choose another path, nothing is overwritten"),
        (is_int(general_seed, 0, MAX_SEED), f"general_seed must be in [0, 2**32), got {general_seed!r}"),
    )
    values = _values(task)
    content: NamedValues = {"general_seed": general_seed, **{section: {} for section in _SECTIONS}}
    for name, (section, key) in _places("2023").items():
        content[section][key] = values[name]
    x = task.observations
    without_effect = {
        "observations": True,  # their fields are compared
        "reward_noise": task.reward_std == 0,
        "legacy_goal_change": task.goal_change is None,
        "legacy_index": not (x.unique_waits or x.unique_decisions or x.unique_ends),
        "noise_before_rotation": not (x.read_noise and x.read_rotation),
    }
    rules = []
    read = type(task)(**read_task(content, task.goal))
    for ours, theirs in ((task, read), (x, read.observations)):
        for each in fields(ours):
            own = getattr(ours, each.name)
            other = getattr(theirs, each.name)
            same = own == other or without_effect.get(each.name, False)
            rules.append((same, f"the file cannot express {each.name}={own!r}: use {other!r}"))
    require(*rules)
    if path is not None:
        write_whole(path, json.dumps(content, indent=2) + "\n")
    return content


def _values(task: Task) -> NamedValues:
    x = task.observations
    images = task.images
    first, last = task.goal_change or (-1, -2)
    return {
        "depth": task.graph.depth,
        "branching_factor": task.graph.branching_factor,
        "wait_prob": task.graph.wait_prob,
        "goal_reward": task.goal_reward,
        "fail_reward": task.fail_reward,
        "reward_std": task.reward_std,
        "min_episodes": first,
        "max_episodes": last + 1,
        "distribution": "linear" if task.reward_fn == ReferenceLinear() else "needle_in_haystack",
        "unique_decisions": x.unique_decisions,
        "unique_waits": x.unique_waits,
        "wait_ids": list(x.wait_ids),
        "decision_ids": list(x.decision_ids),
        "end_ids": list(x.end_ids),
        "image_seed": getattr(images, "seed", 1),
        "one_hot": isinstance(images, ReferenceOneHot),
        "num_images": images.num_images,
        "noise": getattr(images, "noise", 0.0),
        "rotation": x.read_rotation + 1,
    }
