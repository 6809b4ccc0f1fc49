"""Hydra's side of a run: its configuration, its name, and what its settings build."""

from __future__ import annotations

import io
import json
import os
import re
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.singleton import Singleton
from hydra.core.utils import JobRuntime
from hydra.errors import HydraException
from hydra.types import RunMode
from hydra.version import VersionBase
from omegaconf import DictConfig, OmegaConf
from omegaconf.basecontainer import BaseContainer
from omegaconf.errors import OmegaConfBaseException

from ctgraph_rl.checks import (
    Function,
    NamedValues,
    ReadOnlyValues,
    Rule,
    did_you_mean,
    is_int,
    is_real,
    one_of,
    positive,
    require,
)
from ctgraph_rl.core.goal import read_goal, write_goal
from ctgraph_rl.disk import make_folder, write_whole
from ctgraph_rl.log.named_curricula import curriculum_named
from ctgraph_rl.packages import check_packages, conf_dir, importing_from_here
from ctgraph_rl.portable import check_portable
from ctgraph_rl.runs.explain import explain
from ctgraph_rl.runs.settings import check_arguments, curriculum_names, digest, names_in

if TYPE_CHECKING:
    from ctgraph_rl.tasks.curriculum import Curriculum

IS_NEXT_HYDRA = hasattr(hydra.utils, "execution_whitelist")

PARTS = {"evaluation": "every=5120", "protocol": "task_id=one_hot"}
"""The groups that change a curriculum, each with an example."""

RESUME = ("warn", "strict")

STALE = "stale"

RENEWED: tuple[type, ...] = (GlobalHydra, JobRuntime, VersionBase)  # of Hydra's state: what composing changes
_HYDRA = threading.RLock()  # is held while Hydra's global state is ours


SEEDS_APART = 1000
"""Between seeds of a collective's members, so that collectives share none."""

NOT_HASHED = (
    *("overwrite", "experts_dir", "resume", "checkpoint_seconds"),
    *("logger", "objective", "report", "together", "seeds", "track"),
)


def of_hydra(function: Function) -> Function:
    """Return a function of Hydra that behaves as in 1.3, without ``version_base``."""
    return function if IS_NEXT_HYDRA else partial(function, version_base="1.3")  # type: ignore[return-value]


_PACKAGE = re.compile(r"(?:_target_|path): ['\"]?(\w+)")  # of a target, or of a class that hydra.utils.get_class gets


def plain(cfg: DictConfig) -> NamedValues:
    """Return the configuration as plain values, without Hydra's, those that do not change results, and empty groups.

    A tuning run keeps its objective, which tables show.
    """
    has_objective = cfg.get("objective_until") is not None
    values: NamedValues = {}
    for key in map(str, cfg):
        is_kept = key not in NOT_HASHED and key != "hydra"
        if is_kept or (key == "objective" and has_objective):
            value = cfg[key]
            values[key] = OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value
    curriculum = values.get("curriculum")
    if isinstance(curriculum, dict) and isinstance(curriculum.get("goals"), list):
        goals = map(read_goal, curriculum["goals"])  # one run, however its goals are written
        curriculum["goals"] = [write_goal(goal) if isinstance(goal, tuple) else goal for goal in goals]
    return {key: value for key, value in values.items() if value != {}}


def run_name(*, _root_: DictConfig) -> str:
    """Name a run's directory: curriculum, agent; the other parts if chosen, such as a method; seed, a hash of all."""
    return name_of(_root_, _root_.hydra.runtime.choices)


def name_of(cfg: DictConfig, choices: Any) -> str:
    """Return a configuration's run name, given each group's chosen file."""
    parts = {
        "cell": (None, "lstm"),
        "method": ("finetune",),
        "plasticity": (None, "none"),
        "detector": (None,),
        "exchange": (None, "null"),
    }
    learner = choices.agent
    for group, usual in parts.items():
        if choices.get(group) not in usual:
            learner += f"-{choices.get(group)}"
    seed = re.sub(r"\W", "_", str(cfg.seed))  # one that is refused later must not lead elsewhere
    return f"{choices.curriculum}/{learner}-seed{seed}-{digest(plain(cfg))}"


def of_seed(cfg: DictConfig, seed: int, run_dir: Path) -> tuple[DictConfig, Path]:
    """Return the configuration and directory of one seed of a job; ``cfg`` is without its ``seeds``."""
    choices = HydraConfig.get().runtime.choices
    own = deepcopy(cfg)
    own.seed = seed
    name = Path(name_of(own, choices))
    return own, run_dir.parents[len(name.parts) - 1] / name


def of_member(cfg: DictConfig, number: int, settings: ReadOnlyValues) -> DictConfig:
    """Return the configuration of a collective's member: its seed, and its curriculum if they differ.

    Args:
        settings: only this member's, such as ``{"agent.learning_rate": 0.01}``.

    Raises:
        ValueError: for an unknown setting.
    """
    own = deepcopy(cfg)
    own.seed = cfg.seed + SEEDS_APART * number if is_int(cfg.seed) else cfg.seed
    OmegaConf.update(own, "exchange.member", number, force_add=True)
    if "agent" in cfg.curriculum:
        own.curriculum.agent = (cfg.curriculum.agent or 0) + number
    missing = object()
    for key, value in settings.items():
        known = OmegaConf.select(own, key, default=missing) is not missing
        require((known, f"the exchange gives member {number} {key}={value}, and there is no setting {key}"))
        OmegaConf.update(own, key, value)
    return own


def register_run_name() -> None:
    """Make `run_name` the resolver of ``${run_name:}`` in this process."""
    if IS_NEXT_HYDRA:
        OmegaConf.register_resolver("run_name", run_name, replace=True)  # type: ignore[call-arg]
    else:
        OmegaConf.register_new_resolver("run_name", run_name, replace=True)


def in_sweep() -> bool:
    """Return whether this run is a cell of a sweep, which reports itself."""
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


def check_one_cell() -> None:
    """Refuse to run one cell in place of a sweep.

    Raises:
        ValueError: without ``-m``, for a sweeper's settings.
    """
    if in_sweep():
        return
    chosen = HydraConfig.get()
    _ = chosen.run.dir  # one that is ??? would be a directory None
    swept = {**(chosen.sweeper.get("params") or {})}
    for variant in chosen.sweeper.get("variants") or ():
        swept |= dict.fromkeys(variant, "...")
    for setting in chosen.overrides.task:
        swept.pop(setting.partition("=")[0].lstrip("+"), None)
    shown = " ".join(f"{key}={value}" for key, value in swept.items())
    launcher = chosen.runtime.choices["hydra/launcher"]
    require(
        (launcher == "basic", f"hydra/launcher={launcher} runs the cells of a sweep: add -m, or leave it out"),
        (not swept, f"this configuration is a sweep, {shown}: add -m to run it, or give one value of each"),
        (not chosen.sweeper.get("status"), "hydra.sweeper.status=true lists a sweep's cells: add -m"),
    )


def check_resolved(cfg: DictConfig) -> None:
    """Refuse settings without a value: ``???``, or unresolved.

    Raises:
        OmegaConfBaseException: names the setting, for `explain`.
    """
    for key in cfg:
        value = None if key == "hydra" else cfg[key]
        if OmegaConf.is_config(value):
            OmegaConf.to_container(value, resolve=True, throw_on_missing=True)


def check_settings(cfg: DictConfig) -> None:
    """Refuse values of the run's own keys that are out of range on every machine.

    Raises:
        ValueError: for one out of range.
    """
    require((is_int(cfg.seed, 0, 2**63 - 1), f"seed must be an integer in [0, 2**63), got {cfg.seed!r}"))
    folder = cfg.experts_dir
    require((isinstance(folder, str) and bool(folder), f"experts_dir must be the path of a folder, got {folder!r}"))
    for name in ("objective_until", "freeze_after"):
        share = cfg[name]
        alone = f"{name}={share} is of a learner by itself: leave out {name} or exchange"
        is_share = share is None or (is_real(share, 0, 1) and share != 0)
        require(
            (is_share, f"{name} must be a share of the frames in (0, 1], such as 0.1, got {share!r}"),
            (share is None or "exchange" not in cfg, alone),
        )
    until = cfg.objective_until
    frozen = cfg.freeze_after
    freezes = frozen is None or until is None or frozen < until
    later = f"freeze_after={frozen} freezes nothing before objective_until={until}, where the run ends"
    require((freezes, f"{later}: set freeze_after below {until}, or leave it out"))
    for switch in ("experts", "report", "portable", "together", "save_optimiser"):
        require((isinstance(cfg[switch], bool), f"{switch} must be true or false, got {cfg[switch]!r}"))
    evaluation = cfg.evaluation if isinstance(cfg.evaluation, DictConfig) else {}
    if evaluation.get("exact") is True:
        for name in ("num_episodes", "episodes_per_row"):
            given = evaluation.get(name)
            rule = f"evaluation.exact=true plays no episodes, got evaluation.{name}={given}: leave it out"
            require((given is None, rule))
    require(
        check_overwrite(cfg.overwrite),
        *one_of(RESUME, resume=cfg.resume),
        (
            cfg.log_units in (None, "batch") or isinstance(cfg.log_units, bool),
            f"log_units must be true, false, batch or null, got {cfg.log_units!r}",
        ),
        *positive(checkpoint_seconds=cfg.checkpoint_seconds),
    )


def check_values(cfg: DictConfig) -> None:
    """Refuse values of the run's own keys, for this machine too.

    Raises:
        ValueError: for one out of range.
    """
    check_settings(cfg)
    seeds = "add -m and several seeds, such as seed=range(20), or together=false for one run"
    require((in_sweep() or not cfg.together, f"together=true trains the seeds of a sweep as one batch: {seeds}"))
    cores = os.cpu_count() or 1
    threads_rule = f"num_threads must be in 1..{cores}, the cores of this machine, got {cfg.num_threads!r}"
    require((is_int(cfg.num_threads, 1, cores), threads_rule))
    if cfg.portable:
        check_portable()
        compiled = "portable=true needs agent.compile=false: compiled code is made for the CPU of this machine"
        require(
            (cfg.device == "cpu", f"portable=true needs device=cpu, got {cfg.device}: bits depend on the kind of GPU"),
            (not cfg.agent.get("compile"), compiled),
        )


def check_overwrite(given: Any) -> Rule:
    """Return the rule of ``overwrite``."""
    return isinstance(given, bool) or given == STALE, f"overwrite must be true, false or {STALE}, got {given!r}"


def changes_of(cfg: DictConfig, part: str) -> NamedValues:
    """Return the changes of a configuration's ``evaluation`` or ``protocol``; null changes nothing.

    Raises:
        ValueError: for a part without keys.
    """
    message = f"{part} must have keys, such as {part}.{PARTS[part]}, got {cfg[part]!r}"
    require((isinstance(cfg[part], DictConfig), message))
    return {str(key): value for key, value in OmegaConf.to_container(cfg[part]).items() if value is not None}  # type: ignore[union-attr]


def target(cfg: DictConfig, group: str) -> Callable[..., Any]:
    """Return what builds a group of the configuration, with its arguments bound.

    Raises:
        ValueError: for an unknown argument, with the likely one or the choices.
    """
    given = [str(key) for key in cfg[group] if not str(key).startswith("_")]
    check_arguments(group, given, hydra.utils.get_object(cfg[group]["_target_"]))
    allowed: AbstractContextManager[Any] = nullcontext()  # Hydra 1.3 refuses what it knows to do harm
    if IS_NEXT_HYDRA:  # any package but Python's standard library, which has functions that do harm
        packages = {name.partition(".")[0] for name in sys.modules}
        packages |= set(_PACKAGE.findall(OmegaConf.to_yaml(cfg[group])))  # which may not be imported yet
        allow = vars(hydra.utils)["execution_whitelist"]  # type checkers read Hydra 1.3
        allowed = allow([f"{name}.*" for name in packages - sys.stdlib_module_names])
    with allowed:
        return hydra.utils.instantiate(cfg[group], _partial_=True, _convert_="all")


def curriculum_of(name: str, config_dir: Path | None = None) -> Curriculum:
    """Return the curriculum that ``ctgraph-rl --config-dir DIR curriculum=NAME`` learns.

    Args:
        name: of a published curriculum, or of a file in the directory's ``curriculum`` folder.
        config_dir: the directory; None: a published curriculum.

    Raises:
        ValueError: for an unknown name or directory, and a file that makes no curriculum.
    """
    from ctgraph_rl.tasks.curriculum import Curriculum  # here: --help and a wrong setting need no torch

    own = curriculum_names(config_dir)
    if config_dir is None or name not in own:
        try:
            return curriculum_named(name)
        except ValueError as error:
            there = f"; in {config_dir}: {', '.join(own) or 'none'}" if config_dir is not None else ""
            raise ValueError(f"{error}{there}") from None
    check_packages()
    try:
        with importing_from_here():
            cfg = composed([f"curriculum={name}"], config_dir)
            made = target(cfg, "curriculum")()
    except (HydraException, OmegaConfBaseException) as error:
        raise ValueError(explain(error)) from None
    kind = type(made).__name__
    require((isinstance(made, Curriculum), f"{cfg.curriculum._target_} must make a Curriculum, it made a {kind}"))
    return made


def composed(settings: Sequence[str], config_dir: Path | None = None) -> DictConfig:
    """Return the configuration of a command line, leaving a program's own Hydra unchanged.

    Its ``version_base``, resolvers and job name, on which further directories depend, stay.

    Args:
        settings: such as ``agent=ppo``.
        config_dir: is searched after ``conf``.
    """
    searched = [] if config_dir is None else [f"hydra.searchpath=[{json.dumps(str(config_dir.resolve()))}]"]
    with _HYDRA:  # Hydra starts from nothing, in one thread at a time
        singletons = {kind: Singleton._instances.pop(kind) for kind in RENEWED if kind in Singleton._instances}
        resolvers = dict(BaseContainer._resolvers)
        try:
            register_run_name()
            with of_hydra(hydra.initialize_config_dir)(conf_dir()):
                return hydra.compose("config", [*settings, *searched])
        finally:
            for kind in RENEWED:
                Singleton._instances.pop(kind, None)
            Singleton._instances.update(singletons)
            BaseContainer._resolvers.clear()
            BaseContainer._resolvers.update(resolvers)


def with_names(names: Mapping[str, str | None], config_dir: Path | None = None) -> DictConfig:
    """Return the configuration with other choices of groups, such as ``{"agent": "dqn"}``; None: the default.

    Raises:
        ValueError: for an unknown name, with the likely one, and a path that is no directory.
    """
    is_folder = config_dir is None or config_dir.is_dir()
    require((is_folder, f"config_dir must be a directory, got {config_dir}"))
    check_packages()
    settings = []
    for group, name in names.items():
        if name is not None:
            own = [] if config_dir is None else names_in(config_dir, group)
            choices = [*names_in(conf_dir(), group), *own]
            require((name in choices, f"unknown {group} {name!r}: {did_you_mean(str(name), choices)}"))
            settings.append(f"{group}={name}")
    try:
        return composed(settings, config_dir)
    except (HydraException, OmegaConfBaseException) as error:
        raise ValueError(explain(error)) from None


def write_configuration(cfg: DictConfig, folder: Path) -> None:
    """Write Hydra's files, after all checks."""
    make_folder(folder)
    save_yaml(cfg, folder / "config.yaml")
    if HydraConfig.initialized():
        save_yaml(HydraConfig.instance().cfg, folder / "hydra.yaml")
        settings = []
        for setting in HydraConfig.get().overrides.task:  # those of a job for several seeds name the first and all
            key = setting.partition("=")[0]
            if key != "+seeds":
                settings.append(f"seed={cfg.seed}" if key == "seed" else setting)
        save_yaml(settings, folder / "overrides.yaml")


def save_yaml(settings: Any, path: Path) -> None:
    """Write settings as Hydra does."""
    buffer = io.StringIO()
    OmegaConf.save(settings, buffer)
    write_whole(path, buffer.getvalue(), synced=False)
