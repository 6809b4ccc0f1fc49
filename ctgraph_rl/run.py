"""The main job: a configuration becomes a curriculum and an agent, which learns it; results are files.

``python -m ctgraph_rl.run curriculum=su_b1_4tasks agent=lstm_ppo seed=0``
"""

from __future__ import annotations

import hashlib
import importlib
import io
import json
import logging
import os
import re
import shlex
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, redirect_stdout, suppress
from dataclasses import replace
from importlib.util import find_spec
from inspect import Parameter, signature
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, MissingConfigException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ctgraph_rl.checks import is_int, positive, require
from ctgraph_rl.log.files import CHECKPOINTS, FAILURE, LOG, METRICS, locked

if TYPE_CHECKING:
    from rich.console import Console

    from ctgraph_rl.runs.checkpoints import Checkpoints
    from ctgraph_rl.runs.experts import Expert
    from ctgraph_rl.runs.interrupt import Interrupt
    from ctgraph_rl.runs.trackers import Tracker
    from ctgraph_rl.tasks.curriculum import Curriculum

SPECS = ("observation_spec", "action_spec", "folder")
"""Arguments that the run gives itself: to agents the environment's specs, to trackers where to write."""

KEYS = {"evaluation": "every=5120", "protocol": "task_id=one_hot"}
"""An example of each group that changes a curriculum."""

RESUME = ("warn", "strict")

LAUNCHERS = {"hydra/launcher/joblib": "joblib", "hydra/launcher/submitit_slurm": "slurm"}
"""Configurations that come with other packages, and the extras that install these."""

NOT_HASHED = ("overwrite", "experts_dir", "resume", "checkpoint_seconds", "logger", "report")
"""Keys of the configuration that do not change results."""


def conf_dir() -> str:
    """The folder with the configuration: in the package when installed from a wheel, beside it in a checkout."""
    here = Path(__file__).resolve().parent
    for candidate in (here / "conf", here.parent / "conf"):
        if (candidate / "config.yaml").is_file():
            return str(candidate)
    raise FileNotFoundError(f"no conf/config.yaml in {here} or {here.parent}; reinstall ctgraph_rl")


def check_packages() -> None:
    """Refuse to run with a ``curricula`` or ``baselines`` that is not ours.

    Raises:
        ValueError: if a folder, usually in the working directory, shadows one of them; names it.
    """
    ours = Path(__file__).resolve().parent.parent
    for name in ("curricula", "baselines"):
        spec = find_spec(name)
        found = None if spec is None or spec.origin is None else Path(spec.origin).resolve().parent
        message = f"package {name!r} was found in {found} instead of {ours / name}; rename or move the folder found"
        require((found == ours / name, message))


def plain(cfg: DictConfig) -> dict[str, Any]:
    """The configuration as plain values, without Hydra's own and what does not change results."""
    kept = [str(key) for key in cfg if key != "hydra" and key not in NOT_HASHED]
    return OmegaConf.to_container(OmegaConf.masked_copy(cfg, kept), resolve=True)  # type: ignore[return-value]


def run_name(*, _root_: DictConfig) -> str:
    """Name of a run's directory: curriculum, agent, method if there is one, seed and a hash of the configuration."""
    text = json.dumps(plain(_root_), sort_keys=True)
    choices = _root_.hydra.runtime.choices
    digest = hashlib.sha256(text.encode()).hexdigest()[:12]
    learner = "-".join([choices.agent, *([choices.method] if choices.method != "finetune" else [])])
    seed = re.sub(r"\W", "_", str(_root_.seed))  # one that is refused later must not lead elsewhere
    return f"{choices.curriculum}/{learner}-seed{seed}-{digest}"


OmegaConf.register_new_resolver("run_name", run_name, replace=True)


def in_sweep() -> bool:
    """Whether this run is a cell of a sweep, which says itself how its cells go."""
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


def check_one_cell() -> None:
    """Refuse to run one cell in place of a sweep.

    Raises:
        ValueError: without ``-m``, for what a sweeper should do.
    """
    if in_sweep():
        return
    chosen = HydraConfig.get()
    given = {setting.partition("=")[0].lstrip("+") for setting in chosen.overrides.task}
    swept = {key: value for key, value in (chosen.sweeper.get("params") or {}).items() if key not in given}
    shown = " ".join(f"{key}={value}" for key, value in swept.items())
    require(
        (not swept, f"this configuration is a sweep, {shown}: add -m to run it, or give one value of each"),
        (not chosen.sweeper.get("status"), "hydra.sweeper.status=true tells of a sweep's cells: add -m"),
    )


@hydra.main(version_base="1.3", config_path=conf_dir(), config_name="config")
def _job(cfg: DictConfig) -> None:
    run_dir = Path(HydraConfig.get().runtime.output_dir)
    try:
        check_one_cell()
        with redirect_stdout(io.StringIO()) if in_sweep() else nullcontext():
            run(cfg, run_dir)
    except BaseException as error:
        with suppress(OSError):
            run_dir.rmdir()  # only a directory that nothing was written into
        if in_sweep() and isinstance(error, Exception):  # not every exception can travel between processes
            raise RuntimeError(f"{type(error).__name__}: {explain(error)}") from None
        raise


def run(cfg: DictConfig, run_dir: Path) -> None:
    """Learn the configured curriculum with the configured agent and write the results to a directory.

    Args:
        cfg: the composed configuration.
        run_dir: an existing directory.

    Raises:
        ValueError: before any work, for a value out of range.
        FileExistsError: if the directory holds results that ``overwrite`` does not allow to replace.
    """
    check_packages()
    from ctgraph_rl.report.style import require_packages
    from ctgraph_rl.runs.interrupt import Interrupt

    if cfg.report:
        require_packages()
    with locked(run_dir):
        with marked_if_it_fails(run_dir) if in_sweep() and not (run_dir / METRICS).exists() else nullcontext():
            check_values(cfg)
            finished = is_finished(cfg, run_dir)
        if finished:
            shutil.rmtree(run_dir / CHECKPOINTS, ignore_errors=True)  # if it was killed at its very end
        else:
            with Interrupt() as interrupt, marked_if_it_fails(run_dir):
                learn(cfg, run_dir, interrupt)
    if cfg.report or not in_sweep():
        show(run_dir, cfg.report)


def check_values(cfg: DictConfig) -> None:
    """Refuse values of the run's own keys.

    Raises:
        ValueError: for one out of range.
    """
    require((is_int(cfg.seed, 0, 2**63 - 1), f"seed must be an integer in [0, 2**63), got {cfg.seed!r}"))
    cores = os.cpu_count() or 1
    threads_rule = f"num_threads must be in 1..{cores}, the cores of this machine, got {cfg.num_threads!r}"
    require((is_int(cfg.num_threads, 1, cores), threads_rule))
    folder = cfg.experts_dir
    require((isinstance(folder, str) and bool(folder), f"experts_dir must be the path of a folder, got {folder!r}"))
    for switch in ("overwrite", "experts", "report"):
        require((isinstance(cfg[switch], bool), f"{switch} must be true or false, got {cfg[switch]!r}"))
    require(
        (cfg.resume in RESUME, f"resume must be one of {', '.join(RESUME)}, got {cfg.resume!r}"),
        *positive(checkpoint_seconds=cfg.checkpoint_seconds),
    )


def show(run_dir: Path, report: bool) -> None:
    """Print the results of a finished run, and make its report or say how."""
    from ctgraph_rl.report.page import write_report
    from ctgraph_rl.report.terminal import print_summary

    print_summary(run_dir)
    here = Path.cwd()
    shown = run_dir.relative_to(here) if run_dir.is_relative_to(here) else run_dir
    print(f"results: {shown}")
    how = f"ctgraph-rl report {shlex.quote(str(shown))}"
    print(f"report: {write_report([shown]).page}" if report else f"{how} makes a page of figures and tables")


def is_finished(cfg: DictConfig, run_dir: Path) -> bool:
    """Whether the directory already holds the results of this configuration, complete.

    Raises:
        FileExistsError: if it holds a run, finished or not, of another configuration; shows the difference.
    """
    begun = None if cfg.overwrite else config_of(run_dir)
    if begun is None:
        return False
    from ctgraph_rl.runs.read import flat

    before, now = dict(flat(begun)), dict(flat(plain(cfg)))
    changed = [key for key in sorted({*before, *now}) if before.get(key) != now.get(key)]
    if changed:
        shown = ", ".join(f"{key}={before.get(key)!r} instead of {now.get(key)!r}" for key in changed)
        advice = "choose another hydra.run.dir, or overwrite=true to replace it"
        raise FileExistsError(f"{run_dir} holds a run with {shown}; {advice}")
    finished = (run_dir / METRICS).exists()
    if finished:
        print("this configuration was run before; overwrite=true runs it again, as a change of code may need")
    return finished


def config_of(run_dir: Path) -> Mapping[str, Any] | None:
    """The configuration of the run that a directory holds; None without a run.

    Raises:
        FileExistsError: if it holds files that a run would replace, and that are of no run.
    """
    from ctgraph_rl.log.run_log import RunLog
    from ctgraph_rl.runs.train import RESULTS

    there = [name for name in RESULTS if (run_dir / name).exists()]
    log = RunLog.read(run_dir / LOG) if LOG in there else RunLog()
    runs = log.of_kind("run")
    if runs:
        return runs[0].get("config") or {}
    if not there or (there == [LOG] and not log.measurements):  # stopped while its first line was written
        return None
    advice = "choose another hydra.run.dir, or overwrite=true to replace them"
    raise FileExistsError(f"{run_dir} holds {', '.join(there)}, which are of no run; {advice}")


@contextmanager
def marked_if_it_fails(run_dir: Path) -> Iterator[None]:
    """Leave the reason in ``failed.txt`` where a run that began or failed before, or a cell, ends by an error."""
    mark = run_dir / FAILURE
    failed_before = mark.exists()
    mark.unlink(missing_ok=True)
    try:
        yield
    except Exception as error:
        if failed_before or (run_dir / LOG).exists() or in_sweep():
            with suppress(OSError):
                mark.write_text(f"{type(error).__name__}: {explain(error)}\n", encoding="utf-8")
        raise


def learn(cfg: DictConfig, run_dir: Path, interrupt: Interrupt | None = None) -> None:
    """The run itself: build, check, learn, measure, write; the experts before it, where they are asked for."""
    import torch

    from ctgraph_rl.runs.checkpoints import Checkpoints
    from ctgraph_rl.runs.experts import expert_curriculum
    from ctgraph_rl.runs.train import new_agent, remove_results, train, with_method

    logging.getLogger("torchrl").setLevel(logging.WARNING)
    device = checked_device(cfg.device)
    torch.set_num_threads(cfg.num_threads)
    torch.set_flush_denormal(True)
    make_method = target(cfg, "method")
    curriculum = make_method().prepare(with_changes(target(cfg, "curriculum")(), cfg))
    if cfg.experts and not curriculum.evaluation.every:
        print("note: forward transfer against experts needs evaluations within blocks: set evaluation.every")
    make_alone = target(cfg, "agent")

    make_agent = with_method(make_alone, make_method, curriculum)
    new_agent(curriculum, make_agent, cfg.seed)
    for task in curriculum.tasks if cfg.experts else ():
        new_agent(expert_curriculum(curriculum, task), make_alone, cfg.seed)

    def checkpoints(folder: Path) -> Checkpoints:
        return Checkpoints(folder / CHECKPOINTS, cfg.checkpoint_seconds, cfg.resume == "strict", interrupt)

    with tracking(cfg, run_dir) as listeners:
        if cfg.overwrite:
            checkpoints(run_dir).clear()
            remove_results(run_dir)
        write_configuration(cfg, run_dir / ".hydra")
        experts = train_experts(cfg, curriculum, checkpoints) if cfg.experts else None
        settings, saved, shown = plain(cfg), checkpoints(run_dir), progress_console()
        train(curriculum, make_agent, run_dir, cfg.seed, device, settings, experts, saved, listeners, shown)


def progress_console() -> Console | None:
    """Where a run shows how far it is: on standard error, but nowhere in a sweep."""
    from rich.console import Console

    return Console(quiet=True) if in_sweep() else None


@contextmanager
def tracking(cfg: DictConfig, run_dir: Path) -> Iterator[list[Tracker]]:
    """The tracker that ``logger`` names, if it does; closed at the end."""
    from ctgraph_rl.runs.read import flat
    from ctgraph_rl.runs.trackers import FOLDER, Tracker

    if "logger" not in cfg:
        if cfg.overwrite:
            shutil.rmtree(run_dir / FOLDER, ignore_errors=True)
        yield []
        return
    with Tracker(target(cfg, "logger"), run_dir, dict(flat(plain(cfg)))) as tracker:
        yield [tracker]


def train_experts(cfg: DictConfig, curriculum: Curriculum, checkpoints: Callable[[Path], Checkpoints]) -> list[Expert]:
    """The experts of a curriculum, found or trained with the run's own agent, seed and threads."""
    from ctgraph_rl.log.provenance import versions
    from ctgraph_rl.runs.experts import find_or_train
    from ctgraph_rl.runs.train import train

    settings = {key: value for key, value in plain(cfg).items() if key in ("agent", "seed", "device", "num_threads")}

    def learn_alone(alone: Curriculum, run_dir: Path) -> None:
        device = checked_device(cfg.device)
        saved, shown = checkpoints(run_dir), progress_console()
        train(alone, target(cfg, "agent"), run_dir, cfg.seed, device, settings, checkpoints=saved, console=shown)

    folder = Path(cfg.experts_dir)
    waiting = checkpoints(folder).interrupt.check
    return find_or_train(curriculum, learn_alone, folder, {**settings, "versions": versions()}, print, waiting)


def write_configuration(cfg: DictConfig, folder: Path) -> None:
    """Write what Hydra writes, but only once nothing is refused any more."""
    folder.mkdir(exist_ok=True)
    OmegaConf.save(cfg, folder / "config.yaml")
    if HydraConfig.initialized():
        OmegaConf.save(HydraConfig.instance().cfg, folder / "hydra.yaml")
        OmegaConf.save(HydraConfig.get().overrides.task, folder / "overrides.yaml")


def target(cfg: DictConfig, group: str) -> Callable[..., Any]:
    """What a group of the configuration builds, with its arguments bound.

    Raises:
        ValueError: for an argument that the target does not take; lists the choices.
    """
    given = [str(key) for key in cfg[group] if not str(key).startswith("_")]
    parameters = parameters_of(hydra.utils.get_object(cfg[group]["_target_"]))
    choices = [name for name in parameters if name not in SPECS]
    unknown = [name for name in given if name not in choices]
    missing = [name for name in choices if name not in given and parameters[name].default is Parameter.empty]
    require(
        (not unknown, f"{group} has no {', '.join(unknown)}. Choices: {', '.join(choices)}"),
        (not missing, f"{group} needs {', '.join(missing)}; name them in conf/{group} or on the command line"),
    )
    return hydra.utils.instantiate(cfg[group], _partial_=True, _convert_="all")


def parameters_of(function: Any) -> dict[str, Parameter]:
    """The arguments by name; what a class takes as ``**`` it hands on to its base, whose arguments they are."""
    own = signature(function).parameters
    named = {name: parameter for name, parameter in own.items() if parameter.kind is not Parameter.VAR_KEYWORD}
    hands_on = isinstance(function, type) and len(named) < len(own)
    return parameters_of(function.__mro__[1]) | named if hands_on else named


def checked_device(name: str) -> Any:
    """The torch device of a name.

    Raises:
        ValueError: if there is no such device on this machine; lists the choices.
    """
    import torch

    choices = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    choices += [f"cuda:{i}" for i in range(torch.cuda.device_count())]
    require((name in choices, f"device must be one of {', '.join(choices)} on this machine, got {name!r}"))
    return torch.device(name)


def with_changes(curriculum: Curriculum, cfg: DictConfig) -> Curriculum:
    """The curriculum with what ``evaluation`` and ``protocol`` of the configuration change; null leaves a value.

    Raises:
        ValueError: for values out of range.
    """
    from ctgraph_rl.tasks.curriculum import Curriculum, Protocol

    made = type(curriculum).__name__
    require((isinstance(curriculum, Curriculum), f"{cfg.curriculum._target_} must make a Curriculum, it made a {made}"))
    for part in ("evaluation", "protocol"):
        require(
            (isinstance(cfg[part], DictConfig), f"{part} must have keys, such as {part}.{KEYS[part]}, got {cfg[part]}")
        )
    evaluation, protocol = (
        {str(key): value for key, value in OmegaConf.to_container(cfg[part]).items() if value is not None}  # type: ignore[union-attr]
        for part in ("evaluation", "protocol")
    )
    told = curriculum.protocol
    if protocol.get("task_id") == "hidden":
        told = Protocol(boundaries=told.boundaries)  # the ids go with the telling
    return replace(
        curriculum, evaluation=replace(curriculum.evaluation, **evaluation), protocol=replace(told, **protocol)
    )


def explain(error: BaseException) -> str:
    """One message for a user's error: its cause within Hydra's errors, and the choices where a key is unknown."""
    cause = error
    while cause.__cause__ is not None and not _is_told(cause):
        cause = cause.__cause__
    message = str(error if isinstance(cause, OmegaConfBaseException) else cause).strip()
    extra = LAUNCHERS.get(cause.missing_cfg_file or "") if isinstance(cause, MissingConfigException) else None
    if extra is not None:
        return f"this launcher is another package: pip install 'ctgraph_rl[{extra}]'"
    node = getattr(cause, "parent_node", None)
    if isinstance(node, DictConfig):
        message += f"\nChoices: {', '.join(sorted(map(str, node)))}"
    return message


def _is_told(error: BaseException) -> bool:
    """Whether an error says what to do, so that what caused it says less."""
    return isinstance(error, (ValueError, OSError)) and not isinstance(error, OmegaConfBaseException)


def sweepable(arguments: Sequence[str]) -> list[str]:
    """A command line in which settings of a group, such as ``agent.compile=true``, are choices of one in a sweep.

    Hydra composes what a sweep's cells have in common with the default of every group that is swept, and would refuse
    a setting that this default lacks.
    """
    if not any(each == "-m" or (each.startswith("--m") and "--multirun".startswith(each)) for each in arguments):
        return list(arguments)
    groups = "|".join(path.name for path in Path(conf_dir()).iterdir() if path.is_dir() and path.name != "hydra")
    setting = re.compile(rf"((?:{groups})\.[\w.]+)=(.+)")
    return [_as_choice(*match.groups()) if (match := setting.fullmatch(each)) else each for each in arguments]


def _as_choice(key: str, value: str) -> str:
    """A setting as the choice of its one value; as it is, if it has several, or would not be read the same again."""
    setting, choice = f"{key}={value}", f"{key}=choice({value})"
    parse = OverridesParser.create().parse_override
    try:
        before = parse(setting).value()
        after = [parse(f"{key}={text}").value() for text in parse(choice).sweep_string_iterator()]
    except HydraException:  # which Hydra tells, if the setting itself is at fault
        return setting
    return choice if after == [before] else setting


def main() -> None:
    """Entry point: a user's error is one message and exit code 1; HYDRA_FULL_ERROR=1 shows where it came from."""
    full_error = os.environ.setdefault("HYDRA_FULL_ERROR", "0") not in ("", "0")
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra then leaves errors to us
    sys.argv[1:] = sweepable(sys.argv[1:])
    sys.path.append(os.getcwd())  # where a user's own agent may be, for the console script too
    try:
        _job()
    except (HydraException, OmegaConfBaseException, ValueError, ImportError, OSError, FloatingPointError) as error:
        if full_error:
            raise
        print(f"error: {explain(error)}", file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:
        print("interrupted; the same command goes on from the last checkpoint", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":  # not this module's own: other processes of a sweep import what is in it
    importlib.import_module("ctgraph_rl.run").main()
