"""Learning as the command line lets agents learn: into a directory, and seeds together."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import torch

from ctgraph_rl import Curriculum, RunLog
from ctgraph_rl.learn.loop import Lockstep, run_loop
from ctgraph_rl.log.provenance import learners
from ctgraph_rl.runs.checkpoints import Checkpoints
from ctgraph_rl.runs.session import OneBatch, RunMember, Session


def train(
    curriculum: Curriculum,
    agent: Any,
    run_dir: Path,
    seed: int,
    *,
    config: dict[str, Any] | None = None,
    checkpoints: Checkpoints | None = None,
    console: Any = None,
    log_units: bool = False,
) -> None:
    """Let an agent that was just built learn into a directory, or resume there."""
    config = {"seed": seed, **(config or {})}
    member = RunMember(
        curriculum,
        agent,
        seed,
        run_dir=run_dir,
        config=config,
        checkpoints=Checkpoints(run_dir / "checkpoints") if checkpoints is None else checkpoints,
        sources=learners(config, agent),
        log_units=log_units,
    )
    with Session(console) as session:
        session.lock(run_dir)
        failed = session.learn([member], OneBatch(torch.device("cpu")))
    for error in failed.values():
        raise error


def learn_together(
    curriculum: Curriculum, group: Any, seeds: Sequence[int], logs: Sequence[RunLog], checkpoint: Any = None, **how: Any
) -> dict[int, FloatingPointError]:
    """Let a group of seeds learn; return the errors of those that failed, by position."""
    with closing(Lockstep(curriculum, group, seeds, logs, **{"device": torch.device("cpu"), **how})) as members:
        run_loop(members, None, checkpoint)
    return members.failed
