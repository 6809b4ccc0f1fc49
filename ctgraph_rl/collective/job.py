"""A collective of a configuration: each member is an ordinary run in its directory."""

from __future__ import annotations

import io
import logging
import shutil
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

from rich.console import Console
from typing_extensions import override

from ctgraph_rl.checks import require
from ctgraph_rl.collective.summary import COLLECTIVE, FILES, describe_collective, read_collective, write_summary
from ctgraph_rl.learn.collective import ExchangeLike, learn_collective
from ctgraph_rl.learn.progress import ProgressBar
from ctgraph_rl.log.escape import terminal_text
from ctgraph_rl.log.files import CHECKPOINTS, METRICS, member_folder
from ctgraph_rl.log.provenance import versions
from ctgraph_rl.log.run_log import SCHEMA, RunLog
from ctgraph_rl.runs import config
from ctgraph_rl.runs.checkpoints import Checkpoints, RunState
from ctgraph_rl.runs.interrupt import Interrupt
from ctgraph_rl.runs.job import (
    ConfigAndPath,
    build,
    checkpoints_of,
    console_of_runs,
    is_finished,
    is_replaced,
    prepare,
    train_experts,
)
from ctgraph_rl.runs.session import Failures, RunMember, Session, SessionCoupling, mark_failure
from ctgraph_rl.tasks.curriculum import Curriculum, Stream

LONG_ID = 1000
"""Length of a one-hot task id above which a collective warns."""


def run_collective(cfg: Any, run_dir: Path) -> None:
    """Run a collective in an existing directory, unless its results are there.

    Raises:
        ValueError: before any work, for a value out of range, a detector, and members that cannot exchange messages.
        FileExistsError: if a member's directory holds results that ``overwrite`` does not allow to replace.
    """
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    batch = (
        "together=true trains seeds as one batch, members of a collective learn in turn: leave out together or exchange"
    )
    labels = "labels that learners give themselves do not name the same tasks for all: leave out detector or exchange"
    require((cfg.together is False, batch), ("detector" not in cfg, labels))
    exchange = config.target(cfg, "exchange")()
    cells = []
    for number in range(exchange.num_members):
        own = config.of_member(cfg, number, exchange.settings_of(number))
        cells.append((own, member_folder(run_dir, number)))
    with Session(console_of_runs()) as session:
        session.lock(run_dir)
        for each, _ in cells:
            config.check_values(each)
        with redirect_stdout(io.StringIO()):  # each would print it
            finished = [is_finished(each, folder) for each, folder in cells]
        if all(finished) and (run_dir / METRICS).exists():
            print("this configuration was run before; overwrite=true runs it again")
            shutil.rmtree(run_dir / CHECKPOINTS, ignore_errors=True)  # if it was killed at its very end
        else:
            _learn(session, cfg, cells, exchange, run_dir)
    if not config.in_sweep():
        print(describe_collective(read_collective(run_dir)))


def _learn(session: Session, cfg: Any, cells: Sequence[ConfigAndPath], exchange: ExchangeLike, run_dir: Path) -> None:
    with Interrupt() as interrupt, mark_failure(run_dir):
        members = []
        for number, (each, folder) in enumerate(cells):
            try:
                members.append(build(each, folder, interrupt))
            except ValueError as why:
                agent = f"curriculum.agent={each.curriculum.agent}, " if "agent" in each.curriculum else ""
                raise ValueError(f"member {number} ({agent}seed={each.seed}): {why}") from why
        listed = "a collective's tables list tasks, which a stream draws one by one: take Stream.first(n)"
        require((not any(isinstance(member.curriculum, Stream) for member in members), listed))
        _warn_of_long_ids([member.curriculum for member in members])
        exchange.connect([member.agent for member in members])
        checkpoints = checkpoints_of(cfg, run_dir, interrupt)
        if any(is_replaced(cfg, member) for member in members):
            checkpoints.clear()
        for member in members:
            session.lock(member.run_dir)
        for (each, _), member in zip(cells, members, strict=True):
            prepare(session, each, member)
            if each.experts:
                experts, failed = train_experts([each], member.curriculum, interrupt)
                for error in failed.values():
                    raise error
                member.experts = experts[member.seed]
        session.learn(members, Exchanging(cfg, exchange, run_dir, checkpoints))


class Exchanging(SessionCoupling):
    """A coupling of learners that exchange messages by `learn_collective`."""

    def __init__(self, cfg: Any, exchange: ExchangeLike, run_dir: Path, checkpoints: Checkpoints) -> None:
        self.cfg = cfg
        self.exchange = exchange
        self.run_dir = run_dir
        self.checkpoints = checkpoints
        self.saved: RunState | None = None

    @override
    def resume(self, members: Sequence[RunMember]) -> Sequence[RunState | None]:
        self.checkpoints.tidy()
        self.saved = self.checkpoints.newest()
        return [None] * len(members) if self.saved is None else self.saved["members"]

    @override
    def learn(
        self, members: Sequence[RunMember], saved: Sequence[RunState | None], console: Console | None
    ) -> Failures:
        done = 0 if self.saved is None else self.saved["frames"]
        total = sum(member.curriculum.num_frames for member in members)
        blocks = max(len(member.curriculum.blocks) for member in members)
        with ProgressBar(blocks, total, console, done) as progress:
            log = self._log(members)
            learn_collective(
                members,
                self.exchange,
                self.cfg.seed,
                log,
                progress,
                device=self.cfg.device,
                saved=self.saved,
                checkpoint=self.checkpoints.offer,
            )
            log.close()
        return {}

    @override
    def end(self, members: Sequence[RunMember], failed: Failures) -> None:
        write_summary(self.run_dir)
        self.checkpoints.clear()

    def _log(self, members: Sequence[RunMember]) -> RunLog:
        run_dir = self.run_dir
        if self.saved is not None:
            (run_dir / METRICS).unlink(missing_ok=True)
            return RunLog.resume(run_dir / COLLECTIVE, self.saved["log"])
        for name in reversed(FILES):
            (run_dir / name).unlink(missing_ok=True)
        log = RunLog(run_dir / COLLECTIVE)
        about = [
            {"seed": each.seed, "curriculum": each.curriculum.name, "labels": list(each.curriculum.labels)}
            for each in members
        ]
        log.append("collective", schema=SCHEMA, members=about, versions=versions(), config=config.plain(self.cfg))
        log.sync()
        return log


def _warn_of_long_ids(curricula: Sequence[Curriculum]) -> None:
    longest = max(curricula, key=lambda each: each.protocol.length(len(each.tasks)))
    length = longest.protocol.length(len(longest.tasks))
    if longest.protocol.task_id == "one_hot" and length > LONG_ID:
        print(
            f"note: each observation of {terminal_text(longest.name)} has a task id of {length:,} numbers, which are "
            "inputs of every network and mask, so members are slow and large; protocol.task_id=at_boundaries gives ids "
            "to learners without observations of them",
            file=sys.stderr,
        )
