"""Registers a launcher for Dask with Hydra, which takes launchers only from packages below ``hydra_plugins``.

``conf/hydra/launcher/dask.yaml`` chooses it.
"""

from collections.abc import Sequence
from importlib.util import find_spec

from hydra.core.utils import JobReturn, JobStatus
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig

from ctgraph_rl.checks import require
from ctgraph_rl.runs.on_dask import DaskCell, run_cell


class DaskLauncher(Launcher):
    """Runs each cell as a task of a Dask cluster.

    Args:
        address: of the scheduler; None: Dask's configuration names it.
        retries: times that a cell is started again, at least 0.
        wait: seconds until a cell that another process runs is tried again, positive.
    """

    def __init__(self, address: str | None, retries: int, wait: float) -> None:
        require(
            (isinstance(retries, int) and retries >= 0, f"hydra.launcher.retries must be at least 0, got {retries!r}"),
            (isinstance(wait, (int, float)) and wait > 0, f"hydra.launcher.wait must be positive, got {wait!r}"),
        )
        self.address = address
        self.retries = retries
        self.wait = wait

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Keep what the cells need.

        Raises:
            ModuleNotFoundError: if Dask is not installed.
            ValueError: if nothing names a scheduler.
        """
        if find_spec("distributed") is None:
            raise ModuleNotFoundError("hydra/launcher=dask needs Dask: pip install 'ctgraph_rl[dask]'")
        import dask

        address = self.address or dask.config.get("scheduler-address", None)
        require((address is not None, "hydra/launcher=dask needs a scheduler: hydra.launcher.address=tcp://HOST:8786"))
        self.address = address
        self.hydra_context = hydra_context
        self.task_function = task_function
        self.config = config

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Run the cells and return what became of each, in their order."""
        from distributed import Client

        with Client(self.address, set_as_default=False) as client:
            futures = []
            for number, overrides in enumerate(job_overrides, initial_job_idx):
                cell = DaskCell(self.hydra_context, self.task_function, self.config, list(overrides), number)
                packed = cell.pack()
                futures.append(client.submit(run_cell, packed, self.wait, retries=self.retries, pure=False))
            returned = []
            for future in futures:
                error = future.exception()
                lost = JobReturn(status=JobStatus.FAILED, _return_value=error)
                returned.append(future.result() if error is None else lost)
            return returned
