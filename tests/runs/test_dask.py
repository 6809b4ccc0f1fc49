"""Sweeps on a real Dask scheduler with two worker processes; CI installs Dask for it before the slow tests."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml
from helpers.kill_runs import lines
from helpers.paths import CHECKOUT
from helpers.sweeping import sweep

SHORT = ("curriculum.num_frames=512", "agent.num_envs=64", "agent.num_steps=8", "agent.hidden_size=8")
CELLS = ("seed=range(10)", "agent=ppo,dqn")
SWEEP = (sys.executable, "-m", "ctgraph_rl.run", "-m", *SHORT, *CELLS)


@pytest.fixture
def cluster(tmp_path, monkeypatch) -> Iterator[object]:
    """A scheduler and two workers of one thread, whose processes start again when they are killed."""
    distributed = pytest.importorskip("distributed")
    monkeypatch.chdir(tmp_path)
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        yield cluster


def on(cluster) -> tuple[str, ...]:
    return (
        *SWEEP,
        "hydra/launcher=dask",
        f"hydra.launcher.address={cluster.scheduler_address}",
        "hydra.launcher.wait=1",
    )


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


def num_begun() -> int:
    return len(list(Path("runs").rglob("run.jsonl")))


def wait_for_runs(number: int) -> None:
    wait_for(lambda: num_begun() >= number)


def kill_a_worker(cluster) -> None:
    """Kill the process of the first worker, whose cell then has no end, and wait until another has its place."""
    nanny = cluster.workers[0]
    before = nanny.pid
    os.kill(before, signal.SIGKILL)
    wait_for(lambda: nanny.pid not in (None, before))


@pytest.mark.slow
def test_cells_survive_killed_workers_and_a_killed_driver(cluster, tmp_path):
    driver = subprocess.Popen(on(cluster))
    for num_cells in (2, 5):
        wait_for_runs(num_cells)
        kill_a_worker(cluster)
    wait_for_runs(8)
    driver.send_signal(signal.SIGKILL)
    driver.wait()
    assert num_begun() < 20

    again = subprocess.run(on(cluster), capture_output=True, text=True)
    plain = subprocess.run((*SWEEP, "hydra.sweep.dir=plain"), capture_output=True, text=True)

    assert (again.returncode, plain.returncode) == (0, 0), again.stdout + again.stderr
    assert "sweep of 20 cells: 20 done" in again.stdout
    runs = sorted(path.parent.relative_to("runs") for path in Path("runs").rglob("run.jsonl"))
    assert len(runs) == 20
    for run in runs:
        resumed = [line for line in lines(Path("runs", run)) if line["kind"] != "resumed"]
        assert resumed == lines(Path("plain", run))


@pytest.mark.slow
def test_the_file_for_kubernetes_is_one_of_its_schema():
    validate = pytest.importorskip("kubernetes_validate")
    [job] = re.findall(r"```yaml\n(.*?)```", (CHECKOUT / "docs/how-to/queues.md").read_text(), re.DOTALL)

    validate.validate(yaml.safe_load(job), "1.37", strict=True)


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("hydra.launcher.retries=-1", "hydra.launcher.retries must be at least 0, got -1"),
        ("hydra.launcher.wait=0", "hydra.launcher.wait must be positive, got 0"),
        ("hydra.launcher.wait=1", "pip install 'ctgraph_rl[dask]'"),
    ],
)
def test_a_launcher_that_cannot_run_is_refused(setting, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "distributed", None)

    assert sweep(monkeypatch, "hydra/launcher=dask", setting) == 1
    assert said in capsys.readouterr().err
