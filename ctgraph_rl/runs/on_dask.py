"""A cell of a sweep as a task of a Dask cluster, in a process that ends with it."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus, run_job, setup_globals
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, open_dict


@dataclass(frozen=True)
class DaskCell:
    """Hydra's parts to run a cell in another process.

    Args:
        hydra_context: composes the cell's configuration.
        number: of the cell in its sweep.
    """

    hydra_context: HydraContext
    task_function: TaskFunction
    config: DictConfig
    overrides: list[str]
    number: int

    def pack(self) -> tuple[str, list[str], bytes]:
        """Return the working directory, modules' places, and the cell as bytes."""
        return os.getcwd(), sys.path, pickle.dumps(self)

    def run(self) -> JobReturn:
        """Run the cell as Hydra's launchers do."""
        setup_globals()
        Plugins.instance()  # registers the files of other launchers and sweepers
        config = self.hydra_context.config_loader.load_sweep_config(self.config, self.overrides)
        with open_dict(config):
            config.hydra.job.id = f"{config.hydra.job.name}_{self.number}"
            config.hydra.job.num = self.number
        HydraConfig.instance().set_config(config)
        return run_job(
            hydra_context=self.hydra_context,
            config=config,
            task_function=self.task_function,
            job_dir_key="hydra.sweep.dir",
            job_subdir_key="hydra.sweep.subdir",
        )


def run_cell(packed: tuple[str, list[str], bytes], wait: float) -> JobReturn:
    """Run a cell in a process, waiting while another process runs it.

    That may be the child of a killed worker or driver.

    Args:
        wait: seconds between two tries.

    Raises:
        RuntimeError: if the process ended without a result, so that Dask starts the cell again.
    """
    folder, places, cell = packed
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(places)}
    while True:
        with tempfile.TemporaryDirectory() as scratch:
            result = Path(scratch, "result")
            command = [sys.executable, "-m", "ctgraph_rl.runs.on_dask", str(result)]
            code = subprocess.run(command, input=cell, cwd=folder, env=environment).returncode
            if not result.exists():
                raise RuntimeError(f"the process of this cell ended with code {code}")
            returned: JobReturn = pickle.loads(result.read_bytes())
        in_use = str(returned._return_value).startswith("BlockingIOError")
        if returned.status != JobStatus.FAILED or not in_use:
            return returned
        time.sleep(wait)


if __name__ == "__main__":
    given = pickle.load(sys.stdin.buffer)
    Path(sys.argv[1]).write_bytes(pickle.dumps(given.run()))
