"""Sweeps on a real SLURM: cells as an array, and cells that go back into the queue and end as if never stopped.

``pytest -m slurm`` installs and starts a SLURM of one node by ``slurm/up.sh``, as root on Debian, and stops it again.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
from helpers.paths import TESTS

from ctgraph_rl import RunLog
from ctgraph_rl.log.sums import metrics_of

pytestmark = pytest.mark.slurm

SHORT = ("agent=lstm_ppo", "agent.num_envs=64", "agent.num_steps=8", "agent.hidden_size=8")
SLOW = (*SHORT, "agent._target_=slow.SlowLSTMPPO", "curriculum.num_frames=8192")
GROUPS = (
    *("agent=ppo", "agent._target_=slow.SlowPPO", *SHORT[1:], "agent.num_epochs=1", "agent.gamma=0.9,0.99"),
    *("curriculum.num_frames=8192", "evaluation.num_episodes=2", "seed=0,1", "together=true"),
)
"""Two groups of two seeds."""

AGENT = '''
import time
from pathlib import Path

from baselines.lstm_ppo import LSTMPPO
from baselines.ppo import PPO


class SlowLSTMPPO(LSTMPPO):
    """Learns slowly while there is a file ``slow`` in the working directory."""

    def learn(self, *arguments):
        time.sleep(3 * Path("slow").exists())
        return super().learn(*arguments)


class SlowPPO(PPO):
    """Likewise, alone and in a group of seeds."""

    def after_batch(self, *arguments):
        time.sleep(Path("slow").exists())
        return super().after_batch(*arguments)
'''


@pytest.fixture(scope="module")
def slurm(tmp_path_factory) -> Iterator[Callable[..., str]]:
    """Runs one of SLURM's commands and returns what it prints."""
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher", reason="needs pip install 'ctgraph_rl[slurm]'")
    if os.geteuid() != 0 or shutil.which("apt-get") is None:
        pytest.skip("a SLURM is installed and started as root, from Debian's packages")
    folder = tmp_path_factory.mktemp("slurm")
    up = [str(TESTS / "slurm" / "up.sh"), str(folder)]
    started = subprocess.run(up, capture_output=True, text=True, timeout=300)
    try:
        if started.returncode != 0:
            pytest.skip(f"no SLURM can be installed and started here: {started.stderr[-500:]}")
        os.environ["SLURM_CONF"] = str(folder / "slurm.conf")
        yield lambda *command: subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout
    finally:
        os.environ.pop("SLURM_CONF", None)
        for name in ("slurmd", "slurmctld", "munged"):
            if (folder / f"{name}.pid").exists():
                os.kill(int((folder / f"{name}.pid").read_text()), signal.SIGTERM)


@pytest.fixture
def sweep(console_script, tmp_path) -> Iterator[Callable[..., subprocess.Popen]]:
    """Starts a sweep on SLURM in a folder, which has a slow agent; it is stopped at the end."""
    (tmp_path / "slow.py").write_text(AGENT)
    started = []

    def start(*settings: str) -> subprocess.Popen:
        command = [sys.executable, "-m", "ctgraph_rl.run", "-m", "hydra/launcher=slurm", *settings]
        streams = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": True}
        started.append(subprocess.Popen(command, cwd=tmp_path, **streams))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.wait()


@pytest.fixture(scope="module")
def uninterrupted(checkout, tmp_path_factory) -> Path:
    """The directory of a run that is not stopped."""
    folder = tmp_path_factory.mktemp("uninterrupted")
    (folder / "slow.py").write_text(AGENT)
    command = [sys.executable, "-m", "ctgraph_rl.run", *SLOW, "hydra.run.dir=run"]
    env = {**os.environ, "PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1"}
    subprocess.run(command, cwd=folder, env=env, check=True, capture_output=True, timeout=300)
    return folder / "run"


def wait_for(what: Callable[[], object], seconds: float = 240) -> None:
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.5)


def results(run_dir: Path) -> tuple[object, ...]:
    """What a run leaves, but for times."""
    log = [{**m, "seconds": 0} for m in RunLog.read(run_dir / "run.jsonl").measurements]
    weights = torch.load(run_dir / "agent.pt", weights_only=True)
    metrics = metrics_of((run_dir / "metrics.json").read_bytes())
    return log, metrics, {name: value.tolist() for name, value in weights.items() if hasattr(value, "tolist")}


def waiting(slurm: Callable[..., str]) -> list[str]:
    """Jobs that were put into the queue again, and wait there for two minutes."""
    jobs = [line.split() for line in slurm("squeue", "-h", "-r", "-o", "%i %r").splitlines()]
    return [job for job, reason in jobs if reason == "BeginTime"]


def start_again(slurm: Callable[..., str], jobs: list[str]) -> None:
    """Spare jobs that were put into the queue again most of their two minutes."""
    time.sleep(5)  # the node refuses a job that it stopped a second ago
    for job in jobs:
        slurm("scontrol", "update", f"JobId={job}", "StartTime=now", "TimeLimit=30")


def end_after_one_requeue(slurm, heads: list[subprocess.Popen], folder: Path, num_jobs: int) -> dict[str, Path]:
    """Let the requeued jobs of sweeps run to their ends; the directories of the runs that were stopped, by name."""
    wait_for(lambda: len(waiting(slurm)) == num_jobs)
    jobs = waiting(slurm)
    (folder / "slow").unlink()
    start_again(slurm, jobs)
    for head in heads:
        shown, _ = head.communicate(timeout=240)
        assert head.returncode == 0, shown
    shown = "".join(slurm("scontrol", "show", "job", job) for job in jobs)
    assert set(re.findall(r"Restarts=(\d+)", shown)) == {"1"}
    stopped = list(folder.glob("runs/*/*/restarts.jsonl"))
    assert {len(restarts.read_text().splitlines()) for restarts in stopped} == {1}
    return {restarts.parent.name: restarts.parent for restarts in stopped}


def test_six_cells_are_one_array_and_a_second_start_submits_none(slurm, sweep, tmp_path):
    cells = (*SHORT, "curriculum.num_frames=512", "seed=range(6)")

    for _ in range(2):
        head = sweep(*cells)
        shown, _ = head.communicate(timeout=300)

        assert "sweep of 6 cells: 6 done, 0 failed, 0 in use, 0 missing" in shown.splitlines()
        assert head.returncode == 0
        assert len(list(tmp_path.glob("runs/*/*/metrics.json"))) == 6
        [script] = tmp_path.glob("runs/.slurm/*_submission.sh")
        assert "#SBATCH --array=0-5%6" in script.read_text()


def test_a_cell_at_its_time_limit_goes_back_into_the_queue_and_ends_bit_equal(slurm, sweep, tmp_path, uninterrupted):
    (tmp_path / "slow").touch()

    # SLURM may send the signal a minute earlier: 30 to 90 seconds after the start
    head = sweep(*SLOW, "hydra.launcher.timeout_min=2", "hydra.launcher.signal_delay_s=30")

    [run_dir] = end_after_one_requeue(slurm, [head], tmp_path, 1).values()
    assert "SIGUSR2: saving" in next(tmp_path.glob("runs/.slurm/*log.out")).read_text()
    assert results(run_dir) == results(uninterrupted)


def test_a_preempted_cell_and_groups_of_an_array_go_back_into_the_queue_and_end_bit_equal(
    slurm, sweep, tmp_path, uninterrupted
):
    (tmp_path / "slow").touch()
    (whole := tmp_path / "whole").mkdir()
    (whole / "slow.py").write_text(AGENT)
    command = [sys.executable, "-m", "ctgraph_rl.run", "-m", *GROUPS]
    groups = subprocess.Popen(command, cwd=whole, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    heads = [sweep(*settings, "hydra.launcher.partition=low") for settings in (SLOW, GROUPS)]
    wait_for(lambda: len({path.parent for path in tmp_path.glob("runs/*/*/checkpoints/*.pt")}) == 5)
    slurm("sbatch", "--partition=high", "--exclusive", "--output=/dev/null", "--wrap=sleep 1")

    stopped = end_after_one_requeue(slurm, heads, tmp_path, 3)
    logs = [path.read_text() for path in tmp_path.glob("runs/.slurm/*log.out")]
    assert len(logs) == 3 and all("SIGTERM: saving" in log for log in logs)
    assert groups.wait(timeout=240) == 0
    expected = {path.parent.name: path.parent for path in whole.glob("runs/*/*/metrics.json")}
    [alone] = stopped.keys() - expected.keys()
    assert results(stopped[alone]) == results(uninterrupted)
    assert len(expected) == 4
    assert all(results(stopped[name]) == results(expected[name]) for name in expected)


def test_a_cancelled_cell_saves_and_stays_cancelled(slurm, sweep, tmp_path):
    (tmp_path / "slow").touch()

    sweep(*SLOW)
    wait_for(lambda: list(tmp_path.glob("runs/*/*/checkpoints/*.pt")))
    [job] = slurm("squeue", "-h", "-o", "%A").split()
    slurm("scancel", job)
    wait_for(lambda: not slurm("squeue", "-h"))

    assert re.findall(r"(?:JobState|Restarts)=(\w+)", slurm("scontrol", "show", "job", job)) == ["CANCELLED", "0"]
    told = next(tmp_path.glob("runs/.slurm/*log.out")).read_text()  # with lines of SLURM's own in between
    assert re.search(r"SIGTERM: saving after this update \.\.\. .*saved; the same command resumes", told, re.DOTALL)


@pytest.fixture
def packed(slurm, checkout, console_script, tmp_path) -> None:
    """Two tasks of the page's array, with two cells each, run."""
    script = (
        (checkout / "docs/how-to/large_sweeps.md").read_text().split("<!-- packed -->\n```bash\n")[1].split("```")[0]
    )
    for old, new in {"0-999": "0-1", "100": "2", "agent=lstm_ppo": " ".join(SLOW)}.items():
        assert old in script
        script = script.replace(old, new)
    (tmp_path / "packed.sh").write_text(script)
    (tmp_path / "slow.py").write_text(AGENT)
    (tmp_path / "slow").touch()

    slurm("sbatch", f"--chdir={tmp_path}", str(tmp_path / "packed.sh"))
    wait_for(lambda: len(list(tmp_path.glob("runs/part-*/*/*/checkpoints/*.pt"))) > 1)


def test_the_page_s_packed_cells_stay_cancelled(slurm, packed):
    jobs = slurm("squeue", "-h", "-o", "%A").split()

    slurm("scancel", *jobs)

    wait_for(lambda: not slurm("squeue", "-h"))
    shown = "".join(slurm("scontrol", "show", "job", job) for job in jobs)
    assert set(re.findall(r"(?:JobState|Restarts)=(\w+)", shown)) == {"CANCELLED", "0"}


def test_the_page_s_packed_cells_go_on_after_preemption(slurm, packed, tmp_path):
    slurm("sbatch", "--partition=high", "--exclusive", "--output=/dev/null", "--wrap=sleep 1")
    wait_for(lambda: len(waiting(slurm)) == 2)
    (tmp_path / "slow").unlink()
    start_again(slurm, waiting(slurm))
    wait_for(lambda: not slurm("squeue", "-h"))

    seeds = {path.parent.name.split("-")[1] for path in tmp_path.glob("runs/part-*/*/*/metrics.json")}
    assert seeds == {"seed0", "seed1", "seed2", "seed3"}
    assert list(tmp_path.glob("runs/part-*/*/*/restarts.jsonl"))
