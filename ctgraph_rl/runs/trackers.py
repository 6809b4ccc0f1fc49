"""Trackers: a run's measurements in CSV files, TensorBoard, W&B, MLflow or Trackio, while it learns.

``logger=NAME`` chooses one of TorchRL's loggers. The run's own files do not depend on it, and its errors cannot stop a
run that has begun.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
import warnings
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from torchrl.record.loggers import CSVLogger, MLFlowLogger, TensorboardLogger, WandbLogger
from torchrl.record.loggers.common import Logger
from torchrl.record.loggers.trackio import TrackioLogger

from ctgraph_rl.checks import ReadOnlyValues, is_real, require
from ctgraph_rl.disk import require_no_link
from ctgraph_rl.log.files import LOG
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.runs import config

FOLDER = "tracker"

MODES = ("offline", "online")

ENVIRONMENT = {
    "WANDB_ERROR_REPORTING": "false",
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "3",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "10",
}
"""Defaults: no package reports home, and a server that is down costs seconds, not minutes."""

NOT_SENT = ("frames", "task")
"""Numbers that are a measurement's step and name."""


class Tracker:
    """Sends measurements to a logger: a listener of a run's log, and a context manager that closes the logger.

    After the logger's first error, a warning, nothing more is sent.

    Args:
        make_logger: builds the logger of an empty folder.
        run_dir: the folder there is replaced, as a resumed run sends all measurements again.

    Raises:
        ModuleNotFoundError: if the logger's package is missing; names the extra to install.
        ValueError: for a value that the logger does not take.
    """

    def __init__(self, make_logger: Callable[[Path], Logger], run_dir: Path, hyperparameters: ReadOnlyValues) -> None:
        folder = run_dir.resolve() / FOLDER
        require_no_link(folder)
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        self.name = getattr(make_logger, "func", make_logger).__name__
        self._log: Path | None = run_dir / LOG
        self._logger: Logger | None = None
        try:
            self._logger = make_logger(folder)
        except (ModuleNotFoundError, ValueError):
            shutil.rmtree(folder)
            raise
        except Exception as error:
            self._give_up(error)
        kinds = (bool, int, float, str)  # that every logger takes
        given = {name: each if isinstance(each, kinds) else str(each) for name, each in hyperparameters.items()}
        self._send("log_hparams", given)

    def __call__(self, measurement: ReadOnlyValues) -> None:
        """Send one measurement, with the run's frames as the step; before the first, a resumed run's."""
        log = self._log
        self._log = None
        if log is not None and log.exists():
            for earlier in RunLog.read(log).measurements[:-1]:  # the last one is this
                self(earlier)
        values = scalars(measurement)
        if values:
            self._send("log_metrics", values, step=measurement["frames"])

    def __enter__(self) -> Tracker:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the logger."""
        self._send("close")

    def _send(self, method: str, *args: Any, **kwargs: Any) -> None:
        try:
            if self._logger is not None:
                getattr(self._logger, method)(*args, **kwargs)
        except Exception as error:
            self._give_up(error)

    def _give_up(self, error: Exception) -> None:
        self._logger = None
        warnings.warn(f"{self.name} failed, the run continues without it: {error}", stacklevel=3)


def logger_of(given: Any) -> Callable[..., Any] | None:
    """Return what builds a logger in a folder: a given function, or by a name in ``conf/logger``.

    Raises:
        ValueError: for an unknown name, with the likely one, and for other values.
    """
    fits = given is None or isinstance(given, str) or callable(given)
    require((fits, f"logger must be a name such as 'csv', a function of a folder, or None, got {given!r:.80}"))
    return config.target(config.with_names({"logger": given}), "logger") if isinstance(given, str) else given


def scalars(measurement: ReadOnlyValues) -> dict[str, float]:
    """Return the numbers of a training or evaluation measurement, named as ``train/return_mean``.

    A task's have its label, with ``_`` for anything but letters, digits and hyphens: in W&B dots begin groups, and
    MLflow and TensorBoard take no ``#``.
    """
    if measurement["kind"] == "training":
        group = "train"
    elif measurement["kind"] == "evaluation":
        group = "eval/" + re.sub(r"[^\w-]", "_", measurement["label"])
    else:
        return {}
    return {f"{group}/{name}": value for name, value in measurement.items() if is_real(value) and name not in NOT_SENT}


def csv_logger(folder: Path) -> Logger:
    """One CSV file of steps and values per number."""
    return CSVLogger(exp_name="", log_dir=str(folder))


def tensorboard_logger(folder: Path) -> Logger:
    """Event files of TensorBoard."""
    _need("tensorboard")
    return TensorboardLogger(exp_name="", log_dir=str(folder))


def wandb_logger(folder: Path, mode: str, project: str) -> Logger:
    """A run of Weights & Biases.

    Args:
        mode: ``offline`` or ``online``.
        project: groups runs.
    """
    require((mode in MODES, f"logger.mode must be one of {', '.join(MODES)}, got {mode!r}"))
    _need("wandb")
    return WandbLogger(
        exp_name=_name(folder),
        log_dir=str(folder),
        project=project,
        mode=mode,
        log_env_packages=False,
        settings={"silent": mode == "offline", "console": "off"},
    )


def mlflow_logger(folder: Path, uri: str | None, experiment: str) -> Logger:
    """A run of MLflow.

    Args:
        uri: address of a store; None makes one in the folder.
        experiment: groups runs.
    """
    _need("mlflow")
    return _MLFlow(folder, uri, experiment)


class _MLFlow(MLFlowLogger):
    def __init__(self, folder: Path, uri: str | None, experiment: str) -> None:
        import mlflow

        artifacts = None if uri else (folder / "artifacts").as_uri()
        super().__init__(experiment, uri or f"sqlite:///{folder / 'mlflow.db'}", artifact_location=artifacts)
        mlflow.set_tag("mlflow.runName", _name(folder))

    def shutdown(self, timeout: float | None = None) -> None:
        import mlflow

        mlflow.end_run()
        super().shutdown(timeout)


def trackio_logger(folder: Path, project: str) -> Logger:
    """A run of Trackio; ``project`` groups runs."""
    _need("trackio")
    os.environ["TRACKIO_DIR"] = str(folder)
    for name in [name for name in sys.modules if name.split(".")[0] == "trackio"]:
        del sys.modules[name]  # it reads its folder when it is imported, and a sweep has many
    return TrackioLogger(exp_name=_name(folder), project=project, embed=False)


def _need(package: str) -> None:
    if find_spec(package) is None:
        raise ModuleNotFoundError(f"logger={package} needs {package}: pip install 'ctgraph_rl[{package}]'")
    for name, value in ENVIRONMENT.items():
        os.environ.setdefault(name, value)


def _name(folder: Path) -> str:
    return "/".join(folder.parent.parts[-2:])
