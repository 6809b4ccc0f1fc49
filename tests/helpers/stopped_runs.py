"""Runs that are stopped, cases that take too long, and checkpoints that are broken or hostile."""

from __future__ import annotations

import json
import os
import pickle
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from baselines.a2c import A2C
from ctgraph_rl import Block, Curriculum, Evaluation, RunLog, learn_curriculum
from ctgraph_rl.packages import conf_dir
from ctgraph_rl.runs.checkpoints import Checkpoints, decoded, encoded
from ctgraph_rl.runs.train import new_agent
from helpers.kill_runs import equal
from helpers.learning import train
from helpers.scripted import ONE, TWO

SETTINGS = {
    **OmegaConf.to_container(OmegaConf.load(f"{conf_dir()}/agent/a2c.yaml")),
    **{"num_envs": 8, "num_steps": 4, "hidden_size": 4},
}

OWN = {key: value for key, value in SETTINGS.items() if key != "_target_"}

LEARNED = Curriculum("loaded", 1, "here", (Block(ONE, 96), Block(TWO, 64)), Evaluation(4))


class Stopped(Exception):
    """Stands for a kill."""


class StopsAfter(Checkpoints):
    """Saves after every update, and stops the run after a number of frames."""

    def __init__(self, folder, frames: int = 64) -> None:
        super().__init__(folder, seconds=1e-9)
        self.frames = frames

    def offer(self, state, at_block_end):
        super().offer(state, at_block_end)
        if state()["frames"] == self.frames:
            raise Stopped


class Slow(Exception):
    """A case that takes too long."""


@contextmanager
def limited(seconds: int) -> Iterator[None]:
    """Stop what takes longer than a case may, in the main thread."""

    def stop(*_: Any) -> None:
        raise Slow(f"takes more than {seconds} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def make_agent(observation_spec, action_spec) -> A2C:
    """A small A2C."""
    return A2C(observation_spec, action_spec, **OWN)


def learn_into(run_dir: Path, checkpoints: Checkpoints | None = None) -> Path:
    """A short run in a directory, which is made or resumed."""
    run_dir.mkdir(exist_ok=True)
    agent = new_agent(LEARNED, make_agent, 3)
    train(LEARNED, agent, run_dir, 3, config={"agent": SETTINGS, "seed": 3}, checkpoints=checkpoints)
    return run_dir


def stopped_run(run_dir: Path) -> Path:
    """The run, stopped in the middle of its first block, with two checkpoints."""
    with pytest.raises(Stopped):
        learn_into(run_dir, StopsAfter(run_dir / "checkpoints"))
    return run_dir


def flip_bit(file: Path, position: int) -> None:
    content = bytearray(file.read_bytes())
    content[position] ^= 1
    file.write_bytes(content)


def with_header(content: bytes, **changes) -> bytes:
    """A checkpoint of a content, whose header is right but for changes."""
    header = {"format": 1, "frames": 64, "bytes": len(content), "sha256": sha256(content).hexdigest()}
    return json.dumps({**header, **changes}).encode() + b"\n" + content


class Bomb:
    """Writes a file when it is unpickled."""

    def __init__(self, canary: Path) -> None:
        self.canary = str(canary)

    def __reduce__(self):
        return os.mkdir, (self.canary,)


def bombs(canary: Path) -> dict[str, bytes]:
    """Files that would run code if they were unpickled: as `torch.save` writes them, its old form, and a plain one."""
    folder = canary.parent / "bombs"
    folder.mkdir()
    torch.save({"frames": 64, "agent": Bomb(canary)}, folder / "new")
    torch.save({"frames": 64, "agent": Bomb(canary)}, folder / "old", _use_new_zipfile_serialization=False)
    (folder / "plain").write_bytes(pickle.dumps({"frames": 64, "agent": Bomb(canary)}))
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def logs_of_equal_ends(curriculum: Curriculum, make: Callable[[], Any], folder: Path) -> list[RunLog]:
    """The logs of a run and of two that resume from its second and third checkpoint, of agents that end as equals."""
    states: list[Path] = []
    logs: list[RunLog] = []
    ends: list[dict[str, Any]] = []

    def keep(state, at_block_end):
        states.append(folder / f"{len(states)}.pt")
        states[-1].write_bytes(encoded(state()))

    def learn(log, saved=None, checkpoint=None):
        agent = make()
        torch.manual_seed(0 if saved is None else 1234)
        learn_curriculum(curriculum, agent, 7, log, saved=saved, checkpoint=checkpoint)
        log.close()
        logs.append(log)
        ends.append(agent.state_dict())

    learn(RunLog(folder / "run.jsonl"), checkpoint=keep)
    for path in states[1:3]:
        saved = decoded(path)
        (folder / path.stem).write_bytes((folder / "run.jsonl").read_bytes())
        learn(RunLog.resume(folder / path.stem, saved["log"]), saved)
    for other, log in zip(ends[1:], logs[1:], strict=True):
        assert equal(other, ends[0])
        torch.testing.assert_close(log.performance(), logs[0].performance(), rtol=0, atol=0, equal_nan=True)
    return logs
