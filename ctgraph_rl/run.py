"""The main job: an agent learns a configured curriculum; results are files.

``python -m ctgraph_rl.run curriculum=su_b1_4tasks agent=lstm_ppo seed=0``
"""

from __future__ import annotations

import io
import os
import shlex
import sys
from argparse import Namespace
from collections.abc import Sequence
from contextlib import redirect_stdout
from importlib.util import find_spec
from pathlib import Path

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ctgraph_rl.checks import require
from ctgraph_rl.cli import first_imports, quiet_where_nobody_reads
from ctgraph_rl.disk import remove_empty
from ctgraph_rl.log.escape import terminal_lines, terminal_text
from ctgraph_rl.log.files import EX_TEMPFAIL, LOG
from ctgraph_rl.packages import check_packages, conf_dir, makes_page
from ctgraph_rl.portable import Restart, become_portable, restart
from ctgraph_rl.runs.config import (
    check_one_cell,
    check_resolved,
    composed,
    in_sweep,
    of_hydra,
    register_run_name,
)
from ctgraph_rl.runs.explain import explain
from ctgraph_rl.runs.settings import in_digits, names_in
from ctgraph_rl.runs.sweep import Sweeper, sweepable


def run(cfg: DictConfig, run_dir: Path) -> float | None:
    """Learn the configured curriculum with the configured agent; write the results to an existing directory.

    Returns:
        The metric of ``objective``, averaged over learners or seeds, or None.

    Raises:
        ValueError: before any work, for a value out of range; after it, if the objective has no value.
        FileExistsError: for results that ``overwrite`` does not replace.
    """
    check_packages()
    with first_imports():
        from ctgraph_rl.runner import run_configuration  # here: --help and a wrong setting need no torch

    return run_configuration(cfg, run_dir)


def show_sweep(run_dirs: Sequence[Path], tuning: bool = False) -> None:
    """Print a finished sweep's table, if short and with scipy, and the command for more.

    ``tuning`` tells whether some are tuning runs.
    """
    here = Path(os.path.relpath(os.path.commonpath(run_dirs)))
    folder = terminal_text(shlex.quote(str(here)))
    shows = "--tuning " * tuning + folder
    if not (run_dirs[0] / LOG).exists():
        print(makes_page(f"collectives {folder}"))
    elif find_spec("scipy") is None:
        print(f"ctgraph-rl results --per-seed {shows} prints the runs; for means, pip install 'ctgraph_rl[stats]'")
    elif len(run_dirs) > MOST_IN_TABLE:
        print(f"ctgraph-rl results {shows} prints a table")
    else:
        from ctgraph_rl.report.results import print_table  # here: --help and a wrong setting need no torch

        print_table(run_dirs)
        print(f"\n{makes_page(f'report {shows}')}")


class CellError(RuntimeError):
    """What stopped a cell of a sweep, in words that can travel between processes."""


ERRORS = (HydraException, OmegaConfBaseException, ValueError, ImportError, OSError, FloatingPointError, CellError)
"""Users' errors, each answered with one message."""

HELP = """ctgraph-rl run SETTING=VALUE ...: an agent learns a curriculum, and its transfer and forgetting are measured.

Example: ctgraph-rl curriculum=su_b1_4tasks agent=dqn seed=1. A sweep: ctgraph-rl -m seed=0,1,2;
in parallel with hydra/launcher=joblib or slurm. ctgraph-rl without settings lists the other commands.

Choices, GROUP=NAME:
{choices}

Settings, KEY=VALUE; the yaml files of conf/ say what each means:
{settings}
--hydra-help shows the options that Hydra adds."""

MOST_IN_TABLE = 50

SEARCHERS = ("ax", "nevergrad", "optuna")


class Stop(BaseException):
    """Takes an error past Hydra, which would print the settings before it."""

    def __init__(self, error: Exception, message: str) -> None:
        super().__init__(message)
        self.error = error
        self.message = message


class HydraJob:
    """What Hydra calls with a configuration.

    Launchers' processes get it by pickle, with the run name's resolver, which an import does not register.
    """

    def __init__(self) -> None:
        register_run_name()

    def __reduce__(self) -> tuple[type[HydraJob], tuple[()]]:
        return HydraJob, ()

    def __call__(self, cfg: DictConfig) -> float | None:
        """Run one cell; return its value for a sweeper that searches."""
        run_dir = Path(HydraConfig.get().runtime.output_dir)
        if HydraConfig.get().job.chdir:
            os.chdir(HydraConfig.get().runtime.cwd)  # relative paths are of the directory that the command was given in
        try:
            check_resolved(cfg)
            check_one_cell()
            sweeper = HydraConfig.get().runtime.choices["hydra/sweeper"] if in_sweep() else None
            name_one = f"hydra/sweeper={sweeper} searches by a metric: name it, such as objective=average_performance"
            require((cfg.objective is not None or sweeper not in SEARCHERS, name_one))
            if cfg.portable is True and not in_sweep():
                become_portable()
            with redirect_stdout(io.StringIO()) if in_sweep() else quiet_where_nobody_reads():
                return run(cfg, run_dir)
        except BaseException as error:
            remove_empty(run_dir)
            if in_sweep() and isinstance(error, Exception):
                raise CellError(f"{type(error).__name__}: {explain(error, cfg)}") from None
            if isinstance(error, ERRORS):
                raise Stop(error, explain(error, cfg)) from error
            raise


def main() -> None:
    """Entry point: a user's error is one message and an exit code; HYDRA_FULL_ERROR=1 shows its origin."""
    environment = dict(os.environ)
    arguments = sys.argv[1:]
    full_error = os.environ.setdefault("HYDRA_FULL_ERROR", "0") not in ("", "0")
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra then leaves errors to us
    sys.path.append(os.getcwd())  # where a user's own agent may be, for the console script too
    try:
        try:
            with quiet_where_nobody_reads():
                words = options_first(arguments)
                given = get_args_parser().parse_args(words)
                if given.help:
                    print(settings_help(given))
                    return
                words = in_digits(words)
                if given.multirun:
                    words = sweepable(words)
                sys.argv = ["ctgraph-rl", *words]
                Sweeper.done = ()
                of_hydra(hydra.main)(config_path=conf_dir(), config_name="config")(HydraJob())()
                if Sweeper.done:
                    show_sweep(Sweeper.done, Sweeper.tuning)
        except Restart:
            restart(environment, arguments)
    except (Stop, *ERRORS) as error:
        cause, message = (error.error, error.message) if isinstance(error, Stop) else (error, explain(error))
        if full_error:
            raise cause from cause.__cause__
        print(f"error: {terminal_lines(message)}", file=sys.stderr)
        sys.exit(EX_TEMPFAIL if isinstance(cause, BlockingIOError) else 1)
    except KeyboardInterrupt:
        print("interrupted; the same command resumes from the last checkpoint", file=sys.stderr)
        sys.exit(130)


def settings_help(given: Namespace) -> str:
    """Return a run's choices and settings, faster than Hydra's help; ``given`` is a parsed command line."""
    own = None if given.config_dir is None else Path(given.config_dir)
    folders = [folder for folder in (Path(conf_dir()), own) if folder is not None]
    groups = sorted({path.parent.name for folder in folders for path in folder.glob("*/*.yaml")})
    choices = [f"{group}: {', '.join(name for each in folders for name in names_in(each, group))}" for group in groups]
    settings = OmegaConf.to_yaml(composed(given.overrides, own))
    return HELP.format(choices="\n".join(choices), settings=settings)


def options_first(arguments: Sequence[str]) -> list[str]:
    """Return a command line with its options first, as Hydra 1.3 wants.

    Raises:
        SystemExit: with code 2, for an option that Hydra does not know.
    """
    known, unknown = get_args_parser().parse_known_intermixed_args(arguments)
    for option in (word for word in unknown if word.startswith("-")):
        setting = option.strip("-").partition("=")[0].replace("-", "_")
        as_setting = f"a setting is written without dashes, {setting}=VALUE; " if option.startswith("--") else ""
        said = f"error: unknown option {option}: {as_setting}ctgraph-rl --help names the options"
        print(terminal_text(said), file=sys.stderr)
        sys.exit(2)
    return [*(word for word in arguments if word not in known.overrides), *known.overrides]


if __name__ == "__main__":  # not this module's own: other processes of a sweep import what is in it
    import ctgraph_rl.run

    ctgraph_rl.run.main()
