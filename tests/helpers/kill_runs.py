"""Kill runs at random moments, start them again until they are done, and compare with runs that were never killed.

``python -m tests.helpers.kill_runs --kills 100`` prints a table and exits with 1 if anything differs. Half of the kills
(SIGKILL) come after a random time, half right before a random operation on a file of the run: before it is opened,
renamed, truncated or removed. Every tenth start is a new interpreter, so that imports are interrupted too; the others
fork one that has imported everything.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from ctgraph_rl.log.sums import damaged, metrics_of

TINY = ["agent.num_envs=16", "agent.num_steps=8", "agent.hidden_size=8", "checkpoint_seconds=0.01"]
BLOCKS = ["curriculum=fo_b1_4tasks", "curriculum.num_frames=512", "evaluation.num_episodes=4", "evaluation.every=256"]
MINIBATCHES = ["agent.num_minibatches=2", "agent.num_epochs=2"]
REPLAY = ["agent.num_updates=2", "agent.batch_size=16", "agent.buffer_size=512"]
TRIALS = ["curriculum=nm_uniform_goals", "curriculum.num_frames=2048", "evaluation.num_episodes=8"]
TRIALS += ["evaluation.episodes_per_row=4", "evaluation.every=1024"]

ADAPTS = ["evaluation.adapt_episodes=1"]

CONF = Path(__file__).resolve().parents[2] / "conf" / "agent"

RUNS: dict[str, list[str]] = {path.stem: BLOCKS for path in CONF.glob("*.yaml") if "_target_" in path.read_text()} | {
    "a2c": [*BLOCKS, "protocol.boundaries=hidden", "save_optimiser=false"],
    "dqn": [*BLOCKS, *REPLAY, "agent.priority_alpha=0.6"],
    "drqn": [*BLOCKS, *REPLAY],
    "lstm_ppo": [*BLOCKS, *MINIBATCHES, "protocol.task_id=one_hot"],
    "penn_a": [*BLOCKS, "agent.num_batches=2", "agent.num_updates=2", "agent.segment_size=2"],
    "ppo": [*BLOCKS, *MINIBATCHES, "protocol.task_id=at_boundaries"],
    "ppo_count": [*BLOCKS, *MINIBATCHES],
    "qrdqn_lstm": [*BLOCKS, *REPLAY, "agent.replay_on_task_change=keep", "protocol.boundaries=hidden"],
    "reinforce": [*BLOCKS, "experts=true"],
    "rl2": [*TRIALS, *MINIBATCHES],
    **{name: [*TRIALS, *ADAPTS, "agent.adapt_episodes=1", "agent.num_steps=16"] for name in ("cavia", "maml")},
    "pearl": [*TRIALS, *ADAPTS, "agent.num_updates=2", "agent.buffer_size=512"],
}
"""What every agent learns: small, with as many different things in it as a run can have."""

COMPARED = {"curriculum.json": bytes, "metrics.json": metrics_of}
"""Files, each with what is equal in equal runs."""

FILE_EVENTS = {"open", "os.rename", "os.remove", "os.truncate", "os.mkdir", "os.rmdir"}
"""What Python's audit hooks tell of before it happens."""


@dataclass
class Count:
    """What became of the runs of an agent."""

    kills: int = 0
    starts: int = 0
    runs: int = 0
    different: tuple[str, ...] = ()


class FileOperations:
    """Counts what the process is about to do to files below a folder, and kills it before one of them."""

    def __init__(self, folder: Path, last: int | None) -> None:
        self.folder, self.last, self.count = str(folder), last, 0
        sys.addaudithook(self)

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        if event in FILE_EVENTS and str(arguments[0]).startswith(self.folder):
            self.count += 1
            if self.count == self.last:
                os.kill(os.getpid(), signal.SIGKILL)


def command(agent: str, run_dir: Path) -> list[str]:
    """The arguments of a run."""
    return [f"agent={agent}", *RUNS[agent], *TINY, f"hydra.run.dir={run_dir}", f"experts_dir={run_dir}/experts"]


def forked(agent: str, run_dir: Path, last: int | None = None) -> int:
    """Start a run in a copy of this process, killed before its file operation ``last``; the number of the process."""
    process = os.fork()
    if process:
        return process
    with Path(f"{run_dir}.txt").open("ab", buffering=0) as output:
        os.dup2(output.fileno(), 1)
        os.dup2(output.fileno(), 2)
    sys.argv = ["ctgraph-rl", *command(agent, run_dir)]
    operations = FileOperations(run_dir, last)
    code: Any = 1
    try:
        from ctgraph_rl.run import main

        main()
        code = 0
    except SystemExit as end:
        code = end.code or 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        Path(f"{run_dir}.count").write_text(str(operations.count))
        os._exit(code)


def fresh(agent: str, run_dir: Path) -> int:
    """Start a run in an interpreter of its own; the number of the process."""
    with Path(f"{run_dir}.txt").open("ab") as output:
        arguments = [sys.executable, "-m", "ctgraph_rl.run", *command(agent, run_dir)]
        return subprocess.Popen(arguments, stdout=output, stderr=output).pid


def wait(process: int, seconds: float) -> int:
    """The exit code of a process, which is killed after a time; negative for a signal."""
    end = time.monotonic() + seconds
    while True:
        found, status = os.waitpid(process, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() >= end:
            os.kill(process, signal.SIGKILL)
            end += 600
        time.sleep(0.002)


def whole(agent: str, run_dir: Path) -> tuple[float, int]:
    """A run that is never killed; its seconds and file operations."""
    start = time.monotonic()
    code = wait(forked(agent, run_dir), 600)
    if code:
        raise RuntimeError(f"{agent}: exit code {code}\n{Path(f'{run_dir}.txt').read_text()[-2000:]}")
    return time.monotonic() - start, int(Path(f"{run_dir}.count").read_text())


def killed(agent: str, folder: Path, kills: int, rng: random.Random) -> Count:
    """Runs of an agent that are killed so many times in all, each compared with one that never was."""
    reference, count = folder / "whole", Count()
    seconds, operations = whole(agent, reference)
    while count.kills < kills:
        run_dir = folder / f"run{count.runs}"
        code = -signal.SIGKILL
        while code == -signal.SIGKILL:
            count.starts += 1
            if count.kills == kills:
                code = wait(forked(agent, run_dir), 600)
            elif count.starts % 10 == 0:
                code = wait(fresh(agent, run_dir), rng.uniform(0, 6 + seconds))
            elif rng.random() < 0.5:
                code = wait(forked(agent, run_dir), rng.uniform(0, seconds))
            else:
                code = wait(forked(agent, run_dir, rng.randint(1, operations)), 600)
            count.kills += code == -signal.SIGKILL
        count.runs += 1
        found = [f"exit code {code}"] if code else differences(reference, run_dir)
        count.different += tuple(f"{run_dir}: {each}" for each in found)
    return count


def differences(one: Path, other: Path) -> list[str]:
    """The results in which two run directories differ, and what should not be there any more."""
    found = other_files(one, other)
    weights = [torch.load(run_dir / "agent.pt", weights_only=True) for run_dir in (one, other)]
    found += ["agent.pt"] if not equal(*weights) else []
    logs = [lines(run_dir) for run_dir in (one, other)]
    found += ["run.jsonl"] if logs[0] != logs[1] else []
    left = [path for path in other.rglob("*") if path.name.endswith(".part") or path.name in ("checkpoints", ".lock")]
    return found + [f"{path} is left" for path in left]


def other_files(one: Path, other: Path) -> list[str]:
    """The files of `COMPARED` that differ."""
    return [
        name for name, read in COMPARED.items() if read((one / name).read_bytes()) != read((other / name).read_bytes())
    ]


def unlike(whole: Path, other: Path) -> list[str]:
    """All in which the runs of two folders differ."""
    pairs = [(path.parent, other / path.parent.relative_to(whole)) for path in sorted(whole.rglob("run.jsonl"))]
    found = [f"{run} has no metrics.json" for _, run in pairs if not (run / "metrics.json").exists()]
    for one, run in () if found else pairs:
        found += [f"{name} is damaged" for name in damaged(run)]
        found += differences(one, run) if (one / "agent.pt").exists() else []
        found += other_files(one, run)
        found += ["run.jsonl"] if lines(one) != lines(run) else []
    return found


def lines(run_dir: Path) -> list[dict[str, Any]]:
    """A run's log without times and without where it is."""
    read = [json.loads(line.replace(str(run_dir), "")) for line in (run_dir / "run.jsonl").read_text().splitlines()]
    return [{key: value for key, value in line.items() if key != "seconds"} for line in read]


def equal(one: Any, other: Any) -> bool:
    """Whether nested plain values and tensors are equal bit by bit."""
    if isinstance(one, torch.Tensor):
        same_kind = isinstance(other, torch.Tensor) and (one.dtype, one.shape) == (other.dtype, other.shape)
        return same_kind and torch.equal(*(each.reshape(-1).view(torch.uint8) for each in (one, other)))
    if isinstance(one, dict):
        same_keys = isinstance(other, dict) and list(one) == list(other)
        return same_keys and all(equal(one[key], other[key]) for key in one)
    if isinstance(one, (list, tuple)):
        same_length = type(one) is type(other) and len(one) == len(other)
        return same_length and all(map(equal, one, other))
    return one == other


def main() -> None:
    """Kill and compare; the exit code is 1 if anything differs."""
    parser = argparse.ArgumentParser(prog="python -m tests.helpers.kill_runs", description=__doc__.partition("\n")[0])
    parser.add_argument("--kills", type=int, default=100, help="in all, shared among the agents")
    parser.add_argument("--agents", default=",".join(RUNS), help="default: all")
    parser.add_argument("--seed", type=int, default=0, help="decides the moments, as far as the machine lets it")
    arguments = parser.parse_args()
    agents = arguments.agents.split(",")
    import ctgraph_rl.runs.train  # noqa: F401, so that the copies have it

    print(f"{'agent':12} {'kills':>6} {'starts':>6} {'runs':>6}  equal")
    counts = []
    for number, agent in enumerate(agents):
        kills = arguments.kills // len(agents) + (number < arguments.kills % len(agents))
        with tempfile.TemporaryDirectory() as folder:
            count = killed(agent, Path(folder), kills, random.Random(f"{arguments.seed} {agent}"))
        counts.append(count)
        verdict = "yes" if not count.different else f"NO: {'; '.join(count.different)}"
        print(f"{agent:12} {count.kills:6} {count.starts:6} {count.runs:6}  {verdict}", flush=True)
    sums = [sum(getattr(count, name) for count in counts) for name in ("kills", "starts", "runs")]
    print(f"{'all':12} {sums[0]:6} {sums[1]:6} {sums[2]:6}")
    sys.exit(any(count.different for count in counts))


if __name__ == "__main__":
    main()
