"""Every setting in ``conf`` with values of wrong kinds and extremes: it works, or one line says why it does not."""

from __future__ import annotations

import math
import pickle
import random
from collections.abc import Callable, Container
from pathlib import Path
from typing import Any

import pytest
from helpers.stopped_runs import limited
from helpers.sweeping import command_line
from omegaconf import DictConfig, OmegaConf

import curricula
from baselines.parts.catalogue import catalogue
from ctgraph_rl.packages import conf_dir
from ctgraph_rl.run import ERRORS
from ctgraph_rl.runs import config, explain, job

SECONDS = 120
"""For one case; most take a hundredth of a second."""

ALIKE: tuple[tuple[Any, ...], ...] = (
    *(("", "text", "a\nb"), (math.nan, math.inf), (1.5, 1e-9), (1e30, 2**63), ([1, 2], [])),
    *((-1,), (0,), (True,), (None,), ({"a": 1},)),
)
"""Values by what may be wrong with them."""

VALUES = [value for values in ALIKE for value in values]

OVER = {
    "agent": (),
    "cell": ("agent=lstm_ppo",),
    "curriculum": ("agent=ppo",),
    "detector": ("agent=ppo", "method=mask_ri"),
    "exchange": ("agent=ppo", "method=mask_shared", "curriculum=l2d2c_2x2"),
    "logger": ("agent=ppo",),
    "method": ("agent=ppo", "protocol.task_id=at_boundaries"),
}
"""What the settings of a group are tried with."""

ADAPTING = ("curriculum=nm_uniform_goals", "agent.adapt_episodes=1")

FITTING = {
    "maml": ADAPTING,
    "cavia": ADAPTING,
    "pearl": ADAPTING[:1],
    "l2d2c": ("agent=ppo", "method=mask_ri", "curriculum=l2d2c_2x2"),
    "isolated": ("agent=ppo",),
}

SMALL = {"num_envs": 4, "num_steps": 16, "hidden_size": 8, "batch_size": 4, "buffer_size": 64, "num_minibatches": 1}

FREE = ("checkpoint_seconds", "experts", "max_grad_norm")
"""Settings that may be of another kind than their value in the file: any number, and what a sweep also lists."""


def few_alike(group: str) -> list[str]:
    """The files of a group, but of curricula with the same settings three."""
    alike: dict[tuple[Any, ...], list[str]] = {}
    for path in sorted(Path(conf_dir(), group).glob("*.yaml")):
        settings = tuple(OmegaConf.load(path)) if group == "curriculum" else (path,)
        alike.setdefault(settings, []).append(f"{group}={path.stem}")
    return [file for files in alike.values() for file in files[:3]]


FILES = [file for group in OVER for file in few_alike(group)]

RUN = ("seed", "device", "num_threads", "together", "portable", "experts", "experts_dir", "report", "overwrite")
OF_RUN = (*RUN, "resume", "checkpoint_seconds", "evaluation", "protocol")


def build(cfg: DictConfig) -> None:
    """Make all that a run makes before it works."""
    if "logger" in cfg:
        config.target(cfg, "logger")
    if "exchange" not in cfg:
        config.check_values(cfg)
        job.build(cfg, Path())
        return
    exchange = config.target(cfg, "exchange")()
    members = [config.of_member(cfg, number, exchange.settings_of(number)) for number in range(exchange.num_members)]
    for each in members[:1]:
        config.check_values(each)
        job.build(each, Path())


def small(compose: Callable[..., DictConfig], file: str) -> DictConfig:
    """The configuration with a file, made small."""
    group, _, name = file.partition("=")
    cfg = compose(*FITTING.get(name, OVER[group]), file)
    for key in SMALL.keys() & cfg.agent.keys():
        cfg.agent[key] = SMALL[key]
    if "num_frames" in cfg.curriculum:
        cfg.curriculum.num_frames = 1024
    return cfg


def settings_of(cfg: DictConfig, file: str) -> list[str]:
    """The names of a file's settings in the configuration."""
    group = file.partition("=")[0]
    place = {"cell": "agent.cell"}.get(group, group)
    node = OmegaConf.select(cfg, place) or {}
    return [f"{place}.{key}" for key in node if not str(key).startswith("_") and key != "cell"]


def differs_in_kind(value: Any, usual: Any) -> bool:
    """Whether a value cannot be meant where another one is usual; null and lists may stand for what is not there."""
    alike = type(value) is type(usual) is bool or value is None or usual is None
    if alike or isinstance(usual, (list, str)) or isinstance(value, list):
        return False
    numbers = (int, float)
    both = type(value) in numbers and type(usual) in numbers
    fraction = type(usual) is int and type(value) is float and not value.is_integer()
    return not both or fraction or (isinstance(value, float) and not math.isfinite(value))


def fault(cfg: DictConfig, name: str, value: Any) -> str | None:
    """What is wrong with the way in which a setting is answered; None if it works or is refused in one line."""
    usual = OmegaConf.select(cfg, name)
    changed = pickle.loads(pickle.dumps(cfg))  # OmegaConf takes six times as long to copy it
    OmegaConf.update(changed, name, value, merge=False)
    case = f"{name}={value!r}"
    try:
        with limited(SECONDS):
            build(changed)
    except ERRORS as error:
        cause = explain.find_cause(error)
        said = isinstance(cause, (ValueError, ImportError)) and str(cause) and "\n" not in str(cause).strip()
        return None if said else f"{case}: {type(cause).__name__}: {cause}"
    except Exception as error:
        return f"{case}: {type(error).__name__}: {error}"
    fits = usual is None or not differs_in_kind(value, usual) or name.rpartition(".")[2] in FREE
    return None if fits else f"{case} is accepted, where {usual!r} is usual"


def faults(compose: Callable[..., DictConfig], file: str, num_cases: int, new: Container[str] = ()) -> list[str]:
    """The faults of new settings of a file with a value of each kind, and of so many other cases that are drawn."""
    cfg = small(compose, file)
    draw = random.Random(file)
    of_new, others = [], []
    for name in settings_of(cfg, file):
        if name.rpartition(".")[2] in new:
            of_new += [(name, draw.choice(values)) for values in ALIKE]
        else:
            others += [(name, value) for value in VALUES]
    chosen = [*of_new, *draw.sample(others, min(num_cases, len(others)))]
    return [found for case in chosen if (found := fault(cfg, *case)) is not None]


def new_settings() -> dict[str, set[str]]:
    """The settings of each file that no file of its group before it has."""
    found, seen = {}, set()
    for file in FILES:
        group, _, name = file.partition("=")
        settings = {(group, key) for key in OmegaConf.load(Path(conf_dir(), group, f"{name}.yaml"))}
        found[file] = {key for _, key in settings - seen}
        seen |= settings
    return found


NEW = new_settings()


SAMPLED = ("agent=ppo", "curriculum=axes", "method=mask_sc", "exchange=l2d2c")


@pytest.mark.parametrize("file", SAMPLED)
def test_some_values_of_some_files_work_or_are_refused_in_one_line(compose, file):
    assert faults(compose, file, num_cases=12) == []


@pytest.mark.slow
@pytest.mark.parametrize("file", FILES)
def test_values_of_every_kind_of_new_settings_and_some_of_others_work_or_are_refused_in_one_line(compose, file):
    assert faults(compose, file, 6, NEW[file]) == []


@pytest.mark.parametrize(
    "value",
    [value if value in ("a\nb", 1.5) else pytest.param(value, marks=pytest.mark.slow) for value in VALUES],
    ids=repr,
)
def test_values_of_the_run_itself_work_or_are_refused_in_one_line(compose, value):
    cfg = small(compose, "agent=reinforce")
    names = [f"{key}.{part}" for key in OF_RUN[-2:] for part in cfg[key]] + list(OF_RUN)

    assert [found for name in names if (found := fault(cfg, name, value)) is not None] == []


@pytest.mark.parametrize("part", ["evaluation", "protocol"])
def test_a_key_that_a_part_of_a_curriculum_has_not_is_refused_with_the_one_that_was_meant(compose, part):
    cfg = compose(f"+{part}.task_idd=1")

    with pytest.raises(ValueError, match=f"{part} has no task_idd: did you mean 'tasks?_?i?d?'"):
        build(cfg)


ODD: tuple[Any, ...] = ("", 1.5, math.nan, {"a": 1})

REPORTED = [
    ("su_b1_4images", "image_seed", ODD, "image_seed must be an integer, got "),
    ("su_b1_uncorrelated", "image_seed", ODD, "image_seed must be an integer, got "),
    ("fo_b2_dissimilar", "image_seed", ODD, "image_seed must be an integer, got "),
    ("from_axes", "switch", ([1, 2],), r"switch must be a text or null, got \[1, 2\]"),
    ("from_axes", "num_goals", (1e-9, 0, -1), "num_goals must be an integer"),
    ("from_axes", "seed", (-1, "x"), "seed must be an integer"),
    ("from_axes", "num_frames", (2**63,), r"num_frames must be an integer < 2\*\*63, got 9223372036854775808"),
    ("from_axes", "num_frames", (2**62,), "the blocks have 18,446,744,073,709,551,616 frames together, at most 2"),
    ("penn_a_swap", "num_rows", (1e30, 0, 1.5), "num_rows must be an integer"),
    ("dick2020_pair", "one_hot", ({"a": 1}, 1, ""), "one_hot must be true or false, got "),
    ("ct28_blocked_skips_d5", "seed_set", ({"a": 1}, True), "seed_set must be an integer, got "),
    ("nm_uniform_goals", "depth", ([1, 2],), "depth must be an integer, got"),
    ("random_graphs", "image_seed", ([1, 2],), "image_seed must be an integer, got"),
]


@pytest.mark.parametrize(("name", "argument", "values", "said"), REPORTED)
def test_values_of_other_kinds_are_refused_by_curricula_also_where_they_are_not_used(name, argument, values, said):
    for value in values:
        with pytest.raises(ValueError, match=said):
            getattr(curricula, name)(**{argument: value})


@pytest.mark.parametrize("seed", [{"a": 1}, -1, 2**63, True])
def test_a_seed_of_an_exchange_that_is_none_is_refused(seed):
    [mosaic] = [entry for entry in catalogue("exchange") if entry.name == "mosaic"]

    with pytest.raises(ValueError, match=r"seed must be an integer in \[0, 2\*\*63\), got "):
        mosaic.kind(**{**mosaic.settings, "seed": seed})


def test_what_no_member_of_a_collective_can_do_is_said_once(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)

    code = command_line(monkeypatch, "agent=ppo", "exchange=mosaic")

    error = capsys.readouterr().err
    assert code == 1
    assert error.count("needs masks, which 28 of 28 members lack") == 1 and len(error.splitlines()) == 1
