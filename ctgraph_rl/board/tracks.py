"""Tracks of the board: named and versioned tasks, each a file in ``conf/track``.

A track fixes curriculum, protocol, budget and seeds; agent, cell and method are free. ``ctgraph-rl -m track=small
agent=ppo method=ewc`` runs what the track ``small`` asks for. Each rung of a ladder has a curriculum, and a learner may
be given less than the track gives: each of these is a `Variant`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from copy import deepcopy
from dataclasses import dataclass
from functools import cached_property
from itertools import filterfalse, product
from pathlib import Path
from typing import Any

import yaml

from ctgraph_rl.checks import ReadOnlyValues, did_you_mean, require
from ctgraph_rl.packages import conf_dir
from ctgraph_rl.runs import config
from ctgraph_rl.runs.job import with_changes
from ctgraph_rl.runs.settings import names_in
from ctgraph_rl.runs.sweep import swept
from ctgraph_rl.tasks.curriculum import Curriculum

TUNING_SEEDS = range(100, 200)
"""Seeds for choosing the hyperparameters of a submission."""

HELD_OUT_SEEDS = range(10**6, 2**31)

KEYS = ("version", "title", "measures", "breakthrough", "score", "less_given")

SCORES = (
    "adapted_return",
    "average_performance",
    "held_out_adapted_return",
    "memory_gap_closed",
    "normalised_performance",
    "search_efficiency",
    "tasks_learned",
)
"""Metrics that order a table; more is better."""

GROUP = "track"


@dataclass(frozen=True)
class Variant:
    """What a submission to a track may learn.

    Args:
        settings: changes of ``track=NAME``, as on the command line.
        rung: of a ladder, in words; empty for one curriculum.
    """

    settings: tuple[str, ...]
    rung: str
    curriculum: Curriculum

    @property
    def given(self) -> str:
        """What the learner is given to know of tasks, in words; several blocks have boundaries."""
        protocol = self.curriculum.protocol
        parts = {"one_hot": ["task ids"], "at_boundaries": ["task ids at boundaries"], "hidden": []}[protocol.task_id]
        if len(self.curriculum.blocks) > 1 and protocol.announces and protocol.task_id != "at_boundaries":
            parts.append("boundaries")
        if protocol.guide_frames:
            parts.append("first rewards")
        return ", ".join(parts) or "nothing"


@dataclass(frozen=True)
class Track:
    """A track, from its file in ``conf/track``.

    Args:
        version: rises with every change that makes results incomparable.
        score: the metric that orders a table.
        rungs: settings of each rung; one without settings for a single curriculum.
        less_given: changes of the protocol for learners that are given less.
        config_dir: of the user's file; None: ours.
    """

    name: str
    version: int
    title: str
    measures: str
    breakthrough: str
    score: str
    seeds: tuple[int, ...]
    rungs: tuple[tuple[str, ...], ...]
    less_given: tuple[ReadOnlyValues, ...] = ()
    config_dir: Path | None = None

    @property
    def id(self) -> str:
        """Name and version, such as ``small-v1``."""
        return f"{self.name}-v{self.version}"

    @cached_property
    def variants(self) -> tuple[Variant, ...]:
        """What may be submitted: each rung as the track gives it, then with less."""
        cfgs: dict[tuple[str, ...], Any] = {}  # each is composed once, as it takes 0.1 s
        found: list[Variant] = []
        for rung in self.rungs:
            chosen = tuple(filterfalse(_is_value, rung))
            if chosen not in cfgs:
                cfgs[chosen] = config.composed([f"{GROUP}={self.name}", *chosen], self.config_dir)
            cfg = deepcopy(cfgs[chosen])
            for setting in filter(_is_value, rung):
                key, _, value = setting.partition("=")
                group, _, name = key.partition(".")
                cfg[group][name] = yaml.safe_load(value)
            made = config.target(cfg, "curriculum")()
            for less in ({}, *self.less_given):
                own = deepcopy(cfg)
                own.protocol.update(less)
                settings = (*rung, *(f"protocol.{key}={value}" for key, value in less.items()))
                found.append(Variant(settings, _in_words(rung), with_changes(made, own)))
        return tuple(found)

    @cached_property
    def by_fingerprint(self) -> dict[str, Variant]:
        """The variants by their curricula's fingerprints."""
        return {each.curriculum.fingerprint: each for each in self.variants}

    @property
    def curriculum(self) -> Curriculum:
        """The curriculum of the first variant."""
        return self.variants[0].curriculum


def drawn(text: str, most: int) -> int:
    """Return an integer in [0, most) from a text: the first 8 bytes of its SHA-256 modulo ``most``."""
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") % most


def held_out_seeds(key: str, count: int) -> tuple[int, ...]:
    """Return different held-out seeds that follow from a text."""
    found: dict[int, None] = {}
    for place in range(2**20):
        found[HELD_OUT_SEEDS[drawn(f"{key} {place}", len(HELD_OUT_SEEDS))]] = None
        if len(found) == count:
            break
    return tuple(found)


def write_seeds(seeds: Iterable[int]) -> str:
    """Return seeds in words, such as ``0 to 19``."""
    ordered = sorted(seeds)
    whole = len(ordered) > 2 and ordered == list(range(ordered[0], ordered[-1] + 1))
    return f"{ordered[0]} to {ordered[-1]}" if whole else ", ".join(map(str, ordered))


def track(name: str, config_dir: Path | None = None) -> Track:
    """Return a track by name; the user's, ``track/NAME.yaml`` in ``config_dir``, come first.

    Raises:
        ValueError: for an unknown name, with the likeliest one, and for a file that lacks a part.
    """
    homes: dict[str, Path] = {}
    ours = Path(conf_dir())
    for folder in (config_dir or ours, ours):
        for each in names_in(folder, GROUP):
            homes.setdefault(each, folder)
    require((name in homes, f"unknown track {name!r}: {did_you_mean(str(name), homes)}"))
    file = homes[name] / GROUP / f"{name}.yaml"
    settings = yaml.safe_load(file.read_text(encoding="utf-8"))
    about = settings.get(GROUP) or {}
    values = swept(settings.get("hydra", {}).get("sweeper", {}).get("params", {}))
    missing = [key for key in KEYS if key not in about]
    require(
        (not missing, f"{file} must say track.{', track.'.join(missing)}"),
        ("seed" in values, f"{file} must have hydra.sweeper.params.seed, the seeds of a submission"),
        (
            not missing and about["score"] in SCORES,
            f"{file}: track.score must be one of {', '.join(SCORES)}, got {about.get('score')!r}",
        ),
    )
    seeds = tuple(int(setting.partition("=")[2]) for setting in values.pop("seed"))
    less = tuple(about.pop("less_given"))
    rungs = tuple(product(*values.values()))
    return Track(name, **about, seeds=seeds, rungs=rungs, less_given=less, config_dir=config_dir)


def tracks() -> tuple[Track, ...]:
    """Return the tracks of this package, the small one first."""
    names = sorted(names_in(conf_dir(), GROUP), key=lambda name: (name != "small", name))
    return tuple(map(track, names))


def _is_value(setting: str) -> bool:
    return "." in setting.partition("=")[0]


def _in_words(rung: Sequence[str]) -> str:
    words = []
    for setting in rung:
        key, _, value = setting.rpartition(".")[2].partition("=")
        words.append(value if key == "curriculum" else f"{key.replace('_', ' ')} {value}")
    return ", ".join(words)
