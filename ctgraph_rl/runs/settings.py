"""A run's settings as plain values: how they name a run, and how two runs compare."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from decimal import Decimal
from inspect import Parameter, signature
from pathlib import Path
from typing import Any

import yaml

from ctgraph_rl.checks import LARGEST_INT, NamedValues, ReadOnlyValues, did_you_mean, require
from ctgraph_rl.packages import conf_dir

SPECS = ("observation_spec", "action_spec", "folder")
"""Arguments that a run gives: environments' specs to agents, folders to trackers."""

HINTS = {"cell": "it has no memory; use agent=lstm_ppo, rl2, drqn or qrdqn_lstm, or leave the cell out"}

LSTM = {
    "_target_": "baselines.cells.lstm.LSTM",
    "_partial_": True,
    "reads_action": False,
    "reads_reward": False,
}
"""Stands behind the encoder of an agent with memory, unless ``cell=`` is given."""

_ENCODER: NamedValues = {"encoder": "mlp"}
_CELL: NamedValues = {"cell": LSTM, **_ENCODER}
_BACKBONE: NamedValues = {"backbone_seed": None}

ADDED: dict[str, NamedValues] = {
    "run": {
        "portable": False,
        "save_optimiser": True,
        "protocol.guide_frames": None,
        "protocol.episodes": None,
        "evaluation.adapt_episodes": None,
        "evaluation.exact": None,
        "objective_until": None,
        "freeze_after": None,
        "log_units": None,
    },
    "baselines.dqn.DQN": _ENCODER,
    "baselines.mohqa.MOHQA": _ENCODER,
    "baselines.a2c.A2C": _ENCODER,
    "baselines.reinforce.Reinforce": _ENCODER,
    "baselines.ppo.PPO": _ENCODER,
    "baselines.ppo_count.PPOCount": _ENCODER,
    "baselines.ppo_rnd.PPORND": _ENCODER,
    "baselines.drqn.DRQN": _CELL,
    "baselines.qrdqn_lstm.QRDQNLSTM": _CELL,
    "baselines.lstm_ppo.LSTMPPO": _CELL,
    "baselines.cavia.CAVIA": {"entropy_coeff": 0.0},
    "baselines.maml.MAML": {"entropy_coeff": 0.0},
    "baselines.rl2.RL2": _CELL,
    "baselines.methods.mask_ri.MaskRI": _BACKBONE,
    "baselines.methods.mask_lc.MaskLC": _BACKBONE,
    "baselines.methods.mask_blc.MaskBLC": _BACKBONE,
    "curricula.nm_uniform_goals": {"kind": "full"},
    "curricula.from_axes": {
        "read_noise": 0,
        "read_rotation": 0,
        "random_graphs": None,
        "unique_decisions": None,
        "unique_waits": None,
        "decision_ids": None,
        "wait_ids": None,
        "num_images": None,
        "image_size": 12,
        "one_hot": False,
        "goal_reward": 1.0,
        "fail_reward": 0.0,
        "step_reward": 0.0,
        "reward_std": 0.0,
        "reward_fn": "needle",
        "goal_change": None,
    },
    "curricula.penn_a_swap": {"num_lives": None},
    "curricula.random_graphs": {"held_out": 0},
    "baselines.methods.finetune.Finetune": {"trunk": "trained"},
}
"""Settings that were added after runs had been stored, each with the value for "as before".

They are listed by their ``_target_``, as ``{"baselines.rl2.RL2": {"cell": "lstm"}}``; others by dotted names under
``run``, as ``{"run": {"meta.enabled": False}}``. With this value a setting is in no run name and no comparison, and
stored runs without it have it. So a new setting of a yaml file needs an entry here, and no earlier run is lost.
"""


_WITH_EXPONENT = re.compile(r"(?<![\w.])\d+(?:\.\d+)?[eE]\+?\d{1,2}(?![\w.])")


def flat(settings: ReadOnlyValues, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of nested settings by dotted names."""
    for key, value in settings.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


GONE: NamedValues = {"agent.deduplicate": False}
"""Removed settings, with the value that changed nothing; sums and digests leave them out."""


def as_before(settings: ReadOnlyValues) -> NamedValues:
    """Return a run's settings without those of `ADDED` at their value for "as before"."""
    kept = _without(settings, {**ADDED.get("run", {}), **GONE})
    for key, value in kept.items():
        if isinstance(value, Mapping):
            kept[key] = _without(value, _added_to(value))
    return kept


def _without(settings: ReadOnlyValues, added: ReadOnlyValues, prefix: str = "") -> NamedValues:
    kept: NamedValues = {}
    for key, value in settings.items():
        name = f"{prefix}{key}"
        inner = _without(value, added, f"{name}.") if isinstance(value, Mapping) else value
        is_added = name in added and json.dumps(value, sort_keys=True) == json.dumps(added[name], sort_keys=True)
        if not is_added and (inner != {} or value == {}):
            kept[key] = inner
    return kept


def _added_to(group: Any) -> NamedValues:
    return ADDED.get(str(group.get("_target_")), {}) if isinstance(group, Mapping) else {}


def with_added(settings: ReadOnlyValues) -> NamedValues:
    """Return a stored group's settings, such as ``agent``, with those added since."""
    return {**_added_to(settings), **settings}


def parameters_of(function: Any) -> dict[str, Parameter]:
    """Return a function's or class's arguments by name.

    A class's ``**`` stands for its ``Settings``, mostly a dataclass, or else its base's arguments.
    """
    own = signature(function).parameters
    stars = (Parameter.VAR_POSITIONAL, Parameter.VAR_KEYWORD)
    named = {name: parameter for name, parameter in own.items() if parameter.kind not in stars}
    hands_on = isinstance(function, type) and stars[1] in {parameter.kind for parameter in own.values()}
    if not hands_on:
        return named
    return parameters_of(vars(function).get("Settings", function.__mro__[1])) | named


def check_arguments(group: str, given: Sequence[str], function: Any) -> None:
    """Refuse unknown and missing settings of a group.

    Raises:
        ValueError: with the likely one or the choices.
    """
    parameters = parameters_of(function)
    choices = [name for name in parameters if name not in SPECS]
    unknown = []
    for name in given:
        if name not in choices:
            unknown.append(f"{group} has no {name}: {HINTS.get(name) or did_you_mean(name, choices)}")
    missing = [name for name in choices if name not in given and parameters[name].default is Parameter.empty]
    require(
        (not unknown, "; ".join(unknown)),
        (not missing, f"{group} needs {', '.join(missing)}; name them in conf/{group} or on the command line"),
    )


def names_in(folder: Path | str, group: str) -> list[str]:
    """Return the names of a group's yaml files."""
    return sorted(path.stem for path in Path(folder, group).glob("*.yaml"))


def curriculum_names(config_dir: Path | None) -> list[str]:
    """Return a configuration directory's curricula.

    Raises:
        ValueError: if there is no such directory.
    """
    if config_dir is None:
        return []
    require((config_dir.is_dir(), f"--config-dir must be a directory, got {config_dir}"))
    return names_in(config_dir, "curriculum")


def digest(settings: ReadOnlyValues) -> str:
    """Return the hash at the end of a run's name: 12 hexadecimal digits."""
    text = json.dumps(as_before(settings), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def differences(stored: ReadOnlyValues, given: ReadOnlyValues) -> list[str]:
    """Return in words how a stored run's settings differ from given ones."""
    before = dict(flat(as_before(stored)))
    now = dict(flat(as_before(given)))
    found = []
    for key in sorted({*before, *now}):
        group, _, name = key.partition(".")
        added = dict(flat(_added_to(given.get(group)))).get(name, ADDED.get("run", {}).get(key))
        old = before.get(key, added)
        new = now.get(key, added)
        if old != new:
            found.append(f"{key}={old!r} instead of {new!r}")
    return found


def in_digits(arguments: Sequence[str]) -> list[str]:
    """Write whole numbers such as ``1e5`` in digits, in a command line's arguments.

    Settings with a fraction or text in a file of ``conf`` stay unchanged.
    """
    written = []
    for each in arguments:
        name, sign, value = each.partition("=")
        known = list(_defaults(name.lstrip("+"))) if _WITH_EXPONENT.search(each) else []
        if known and all(default is None or type(default) is int for default in known):
            value = _WITH_EXPONENT.sub(_whole, value)
        written.append(f"{name}{sign}{value}")
    return written


def _whole(number: re.Match[str]) -> str:
    value = Decimal(number[0])
    return str(int(value)) if value == int(value) <= LARGEST_INT else number[0]


def _defaults(name: str) -> Iterator[Any]:
    group, _, key = name.rpartition(".")
    folder = Path(conf_dir(), group)
    for path in folder.glob("*.yaml") if group and folder.is_dir() else (Path(conf_dir(), "config.yaml"),):
        settings = yaml.safe_load(path.read_text(encoding="utf-8"))
        settings = settings if not group or folder.is_dir() else settings.get(group)
        if isinstance(settings, Mapping) and key in settings:
            yield settings[key]


def as_typed(message: str, settings: ReadOnlyValues, typed: Iterable[str]) -> str:
    """Return a message with the names of settings as typed: ``curriculum.depth`` for ``depth``.

    A word is a name only where a rule begins, as in ``depth must be``, and before a ``=``; after it, a value.

    Args:
        message: of objects that do not know their setting.
        typed: full names of given ones, which decide between equal last parts.
    """
    homes: dict[str, list[str]] = {}
    for name, _ in flat(settings):
        homes.setdefault(name.rpartition(".")[2], []).append(name)
    given = set(typed)
    for key, names in homes.items():
        meant = names if len(names) == 1 else [name for name in names if name in given]
        if len(meant) == 1:
            name = rf"(?<![\w.'\"/(=-]){re.escape(key)}"
            word = rf"{name}(?==)|(?:(?<=^)|(?<=; )){re.escape(key)}(?= must )"
            message = re.sub(rf"{name}(?![\w.'\"/(-])" if "_" in key else word, meant[0], message)
    return message
