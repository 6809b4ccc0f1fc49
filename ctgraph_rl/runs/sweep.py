"""A sweep: only cells that are not done are launched, a failed cell stops no other, and all are reported."""

from __future__ import annotations

import io
import os
import re
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr
from copy import deepcopy
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, ClassVar

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import OverrideType, ValueType
from hydra.core.utils import JobReturn, JobStatus
from hydra.errors import ConfigCompositionException, HydraException, MissingConfigException
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf, read_write

from ctgraph_rl.checks import NamedValues, ReadOnlyValues, require
from ctgraph_rl.learn.progress import StepCounter
from ctgraph_rl.log.escape import terminal_text
from ctgraph_rl.log.files import CHECKPOINTS, EX_TEMPFAIL, member_folder
from ctgraph_rl.packages import check_packages, conf_dir
from ctgraph_rl.portable import become_portable
from ctgraph_rl.runs.config import check_overwrite, check_resolved, check_settings, of_member, save_yaml
from ctgraph_rl.runs.explain import explain
from ctgraph_rl.runs.status import (
    DONE,
    IN_USE,
    MISSING,
    NOTHING,
    SHOWN,
    STALE,
    RunOutcome,
    Status,
    SweepProgress,
    holds_results,
    report,
    status_of,
)

if TYPE_CHECKING:
    from hydra._internal.core_plugins.basic_sweeper import BasicSweeper as Base
else:
    Base = object  # Hydra may load its plugins again: `hydra_plugins`, which it loads then too, names the present class

Overrides = Sequence[str]

ALL_CORES = -1

SUBDIR = "${run_name:}"
"""Names a directory after the configuration, so that a cell is found before it runs."""


def swept(params: ReadOnlyValues) -> dict[str, list[str]]:
    """Return the choices of each swept setting as typed: ``seed=0``, ``seed=1`` of ``range(2)``."""
    parser = OverridesParser.create()
    found = {}
    for key, value in params.items():
        parsed = parser.parse_override(f"{key}={value}")
        found[key] = [f"{key}={choice}" for choice in parsed.sweep_string_iterator()]
    return found


class Sweeper(Base):
    """Sweeps over all combinations of choices, with any launcher; a mixin of Hydra's ``BasicSweeper``.

    Args:
        max_batch_size: cells given to the launcher at a time; None: all.
        status: only report the status of each cell.
        variants: settings that change together, each combined with all of ``params``.
    """

    done: ClassVar[Sequence[Path]] = ()
    """Run directories of this process's last finished sweep."""

    tuning: ClassVar[bool] = False
    """Whether some cells of that sweep are tuning runs."""

    def __init__(
        self,
        max_batch_size: int | None,
        params: dict[str, str] | None,
        status: bool,
        variants: Sequence[ReadOnlyValues] | None = None,
    ) -> None:
        super().__init__(max_batch_size, params)
        self.status = status
        self.variants = variants or ({},)
        self._values: dict[str, tuple[str, Any] | None] = {}
        self._is_file: dict[str, bool] = {}
        self._stale: dict[Path, str] = {}
        self._begun: dict[Path, tuple[int, ...]] = {}
        self._known: dict[str, NamedValues] = {}
        self._num_unknown = 0
        self._num_processes = 1
        self._has_tuning = False

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Set up as Hydra does; a launcher for all cores gets processes of ``num_threads`` each."""
        own = deepcopy(config)
        if config.hydra.launcher.get("n_jobs") == ALL_CORES:
            cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
            with read_write(own.hydra.launcher):
                own.hydra.launcher.n_jobs = max(1, cores // config.num_threads)
        self._num_processes = own.hydra.launcher.get("n_jobs") or 1
        super().setup(hydra_context=hydra_context, task_function=task_function, config=own)
        assert self.launcher is not None
        self.config = config  # Hydra 1.4 refuses cells that say another number of processes than this
        self.launcher.setup(hydra_context=hydra_context, task_function=task_function, config=config)

    def sweep(self, arguments: list[str]) -> None:
        """Run the cells that are not done, then report on all.

        Cells of other code are stale: they run again with ``overwrite``; without it nothing runs.

        Raises:
            ValueError: if ``overwrite`` is not true, false or stale.
            SystemExit: with code 75 if all that are not done are in use, else 1.
        """
        assert self.config is not None
        overwrite = self.config.overwrite
        together = self.config.together
        seeds = [setting for setting in arguments if setting.lstrip("+").startswith("seeds=")]
        require(
            check_overwrite(overwrite),
            (isinstance(together, bool), f"together must be true or false, got {together!r}"),
            (not seeds, f"a sweep's seeds are given as seed=0,1 or seed=range(2), got {' '.join(seeds)}"),
        )
        if self.config.portable is True:
            become_portable()  # processes that a launcher starts have its variables
        batch: list[list[str]] = []
        for variant in self.variants:
            batch += self._combined(variant, arguments)
        cells = self.cells(batch)
        again = cells if overwrite is True else self._stale
        before = {}
        left = {}
        for folder, overrides in cells.items():
            before[folder] = RunOutcome.of(folder) if folder in again else NOTHING
            is_done = status_of(folder, before[folder]).state == DONE
            if not is_done or (folder / CHECKPOINTS).exists():  # to remove these
                left[folder] = overrides
        errors: dict[Path, str] = {}
        try:
            if left and not self.status and (overwrite or not self._stale):
                with sigterm_exits(), SweepProgress(before):
                    self._launch(self._jobs(left), errors)
        finally:
            found = {}
            for folder in cells:
                found[folder] = status_of(folder, before[folder], errors.get(folder))
                if found[folder].state == MISSING and folder in self._stale:
                    found[folder] = Status(STALE, f"{self._stale[folder]} changed")
            if self._num_unknown:
                unsaid = "cells do not say of which source they are, so it may have changed since"
                print(f"note: {self._num_unknown} {unsaid}")
            statuses = dict(zip(shortened(list(cells.values())), found.values(), strict=True))
            print(report(statuses, len(batch) - len(cells), None if self.status else SHOWN))
        left_over = {state for state, _ in found.values()} - {DONE}
        if left_over:
            sys.exit(EX_TEMPFAIL if left_over == {IN_USE} else 1)
        if not self.status:
            Sweeper.done = list(cells)
            Sweeper.tuning = self._has_tuning

    def _combined(self, variant: ReadOnlyValues, arguments: Sequence[str]) -> list[list[str]]:
        own = [f"{key}={value}" for key, value in variant.items()]
        assert self.hydra_context is not None
        parser = OverridesParser.create(config_loader=self.hydra_context.config_loader)
        overrides = parser.parse_overrides([*self._parse_config(), *own, *arguments])
        for each in overrides:
            if each.value_type == ValueType.GLOB_CHOICE_SWEEP:
                assert self.hydra_context is not None
                group = each.key_or_group
                names = self.hydra_context.config_loader.get_group_options(group)
                given = each.input_line
                values = (
                    f"{given}: glob chooses files of a group, such as agent or method; {group} has values, such as 1,2"
                )
                require((bool(names), values))
                require((any(each.sweep_iterator()), f"{given} matches none of {', '.join(names)}"))
        batch: list[list[str]]
        [batch] = self.split_arguments(overrides, None)
        return batch

    def cells(self, batch: Sequence[Overrides]) -> dict[Path, Overrides]:
        """Return the cells by run directory, the first of equal ones; changes of code are kept, unless all run again.

        Of cells that choose the same files and set the same values only the first is composed.

        Raises:
            ValueError: if directories are not named after the configuration, and for run settings out of range.
            HydraException: for what cannot be composed.
        """
        assert self.config is not None and self.hydra_context is not None
        subdir = OmegaConf.to_container(self.config.hydra.sweep)["subdir"]  # type: ignore[call-overload,index]
        require((subdir == SUBDIR, f"hydra.sweep.subdir must be {SUBDIR}, got {subdir}; change hydra.sweep.dir"))
        composed: dict[tuple[Overrides, Overrides], DictConfig] = {}
        found: dict[Path, Overrides] = {}
        with StepCounter() as count:
            for number, overrides in enumerate(batch, 1):
                count("cells composed", number, len(batch))
                values = {}
                choices = []
                for setting in overrides:
                    changed = self._value(setting)
                    if changed is None:
                        choices.append(setting)
                    else:
                        values[changed[0]] = changed[1]
                alike = tuple(choices), tuple(values)
                if alike not in composed:
                    composed[alike] = self._composed(overrides, choices)
                    check_resolved(composed[alike])
                cfg = composed[alike]
                for key, value in values.items():
                    OmegaConf.update(cfg, key, value)
                check_settings(cfg)
                self._has_tuning |= cfg.objective_until is not None
                sweep = cfg.hydra.sweep
                folder = Path(sweep.dir).absolute() / sweep.subdir
                if folder not in found and self.config.overwrite is not True:
                    self._compare(cfg, folder)
                found.setdefault(folder, overrides)
        return found

    def _composed(self, overrides: Overrides, choices: Overrides) -> DictConfig:
        assert self.config is not None and self.hydra_context is not None
        try:
            return self.hydra_context.config_loader.load_sweep_config(self.config, list(overrides))
        except MissingConfigException:
            raise
        except ConfigCompositionException as error:
            cell = f"with {' '.join(choices)}: " if choices else ""
            raise ValueError(f"{cell}{explain(error)}") from error

    def _compare(self, cfg: DictConfig, folder: Path) -> None:
        if not holds_results(folder):
            return
        check_packages()
        from ctgraph_rl.runs.job import changed_code, first_line  # here: a sweep that begins needs no torch

        try:
            shared = "exchange" in cfg  # then the first member stands for all
            one, run_dir = (of_member(cfg, 0, {}), member_folder(folder, 0)) if shared else (cfg, folder)
            self._begun[folder] = tuple((first_line(run_dir) or {}).get("together", ()))
            changed, unknown = changed_code(one, run_dir, self._known)
        except Exception as error:  # of the code of a user, which may have changed so that it cannot be run
            changed = [f"what builds it, which now fails ({type(error).__name__}: {error}),"]
            unknown = False
        if changed:
            self._stale[folder] = ", ".join(changed)
        self._num_unknown += unknown

    def _value(self, setting: str) -> tuple[str, Any] | None:
        assert self.hydra_context is not None
        if setting not in self._values:
            [parsed] = OverridesParser.create().parse_overrides([setting])
            key = parsed.key_or_group
            value = parsed.value()
            plain = parsed.type == OverrideType.CHANGE and parsed.package is None and not isinstance(value, dict)
            if key not in self._is_file:  # asking Hydra is slow
                options = self.hydra_context.config_loader.get_group_options
                self._is_file[key] = key.startswith("hydra") or ("." not in key and bool(options(key)))
            self._values[setting] = (key, value) if plain and not self._is_file[key] else None
        return self._values[setting]

    def _jobs(self, cells: Mapping[Path, Overrides]) -> dict[Overrides, list[Path]]:
        """Return the settings of jobs, each with its cells: one, or with ``together`` all seeds, split over processes.

        Cells that began together, or singly, stay so; those without a checkpoint join.
        """
        assert self.config is not None
        if not self.config.together:
            return {tuple(overrides): [folder] for folder, overrides in cells.items()}
        by_seed: dict[Overrides, dict[str, Path]] = {}
        for folder, overrides in cells.items():
            seed = ""
            others = []
            for setting in overrides:
                key, _, value = setting.partition("=")
                if key == "seed":
                    seed = value
                elif key != "together":
                    others.append(setting)
            by_seed.setdefault(tuple(others), {})[seed] = folder
        groups: dict[Any, dict[str, Path]] = {}
        for alike, folders in by_seed.items():
            group_of = {str(seed): begun for begun in map(self._begun.get, folders.values()) for seed in begun or ()}
            for seed, folder in folders.items():
                begun = self._begun.get(folder, group_of.get(seed))
                alone = seed if begun == () or not seed else ""
                groups.setdefault((alike, begun, alone), {})[seed] = folder
        jobs: dict[Overrides, list[Path]] = {}
        for (shared, begun, _), group in groups.items():
            number = 1 if begun else max(1, min(self._num_processes // len(groups), len(group) // 2))
            for part in range(number):
                seeds = list(group)[part::number]
                own = [f"seed={seeds[0]}"] if seeds[0] else []
                own += ["together=true", f"+seeds=[{','.join(seeds)}]"] if len(seeds) > 1 else []
                jobs[*shared, *own] = [group[seed] for seed in seeds]
        return jobs

    def _launch(self, jobs: Mapping[Overrides, Sequence[Path]], errors: dict[Path, str]) -> None:
        assert self.config is not None and self.launcher is not None
        folder = Path(self.config.hydra.sweep.dir)
        folder.mkdir(parents=True, exist_ok=True)
        save_yaml(self.config, folder / "multirun.yaml")
        settings = list(jobs)
        size = self.max_batch_size or len(jobs)
        for first in range(0, len(settings), size):
            batch = settings[first : first + size]
            try:
                returned = self.launcher.launch(list(map(list, batch)), initial_job_idx=first)
            except Exception as error:  # such as a worker that was killed: the cells' directories say how far they are
                print(f"the launcher stopped: {type(error).__name__}: {terminal_text(explain(error))}", file=sys.stderr)
                return
            for of_job, job in zip(batch, returned, strict=True):
                if job.status == JobStatus.FAILED:
                    errors.update(dict.fromkeys(jobs[of_job], why(job)))


@contextmanager
def sigterm_exits() -> Iterator[None]:
    """Let SIGTERM end the sweep as Ctrl-C does, so that a launcher ends its processes."""

    def leave(number: int, frame: FrameType | None) -> None:
        sys.exit(128 + number)

    if signal.getsignal(signal.SIGTERM) == signal.SIG_DFL:
        signal.signal(signal.SIGTERM, leave)
    try:
        yield
    finally:
        if signal.getsignal(signal.SIGTERM) == leave:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)


def why(job: JobReturn) -> str:
    """Return what a failed job raised."""
    try:
        with redirect_stderr(io.StringIO()):  # Hydra prints the settings
            job.return_value  # noqa: B018 - it raises
    except Exception as error:
        return str(error)
    return ""


def shortened(cells: Sequence[Overrides]) -> list[str]:
    """Return the cells' settings without those shared by all."""
    common = set.intersection(*map(set, cells)) if len(cells) > 1 else set()
    return [" ".join(setting for setting in cell if setting not in common) for cell in cells]


def sweepable(arguments: Sequence[str]) -> list[str]:
    """Write settings of groups, such as ``agent.compile=true``, as choices of one value for a sweep.

    Hydra first composes swept groups with their defaults, and would refuse a setting that a default lacks.
    """
    groups = "|".join(path.name for path in Path(conf_dir()).iterdir() if path.is_dir() and path.name != "hydra")
    setting = re.compile(rf"((?:{groups})\.[\w.]+)=(.+)")
    return [_as_choice(*match.groups()) if (match := setting.fullmatch(each)) else each for each in arguments]


def _as_choice(key: str, value: str) -> str:
    setting = f"{key}={value}"
    choice = f"{key}=choice({value})"
    parse = OverridesParser.create().parse_override
    try:
        before = parse(setting).value()
        after = [parse(f"{key}={text}").value() for text in parse(choice).sweep_string_iterator()]
    except HydraException:  # which Hydra reports, if the setting itself is at fault
        return setting
    return choice if after == [before] else setting
