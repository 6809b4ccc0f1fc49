"""Lifelong learning: an agent learns and is evaluated as a curriculum says."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack, closing

import torch

from ctgraph_rl.agent import Agent
from ctgraph_rl.checks import NamedValues, ReadOnlyValues, takes_numbers
from ctgraph_rl.core.device import checked_device
from ctgraph_rl.learn.loop import Alone, Lockstep, Progress, run_loop
from ctgraph_rl.learn.progress import ProgressBar
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.tasks.curriculum import Curriculum

OfferCheckpoint = Callable[[Callable[[], NamedValues], bool], object]
"""Takes a function that makes the run's state, and whether a block ends here; saves the state if due."""


@takes_numbers
def learn_curriculum(
    curriculum: Curriculum,
    agent: Agent,
    seed: int = 0,
    log: RunLog | None = None,
    progress: Progress | bool | None = None,
    device: torch.device | str = "cpu",
    saved: ReadOnlyValues | None = None,
    checkpoint: OfferCheckpoint | None = None,
    log_units: bool | str = False,
) -> RunLog:
    """Let an agent learn a curriculum block by block, evaluated as the curriculum says.

    The environment draws from streams of ``seed``, the agent from torch's global generator, which the caller seeds.
    Evaluation disturbs neither. A batch ends with its block where boundaries are announced, and may hold frames of two
    where they are hidden. An environment that cannot be saved within an episode offers ``checkpoint`` its state at
    announced boundaries only.

    Args:
        seed: of the environment, in [0, 2**63).
        log: where measurements are appended; default: a new one in memory.
        progress: updated after every batch; True: a bar on a terminal and in a notebook, lines elsewhere.
        saved: a state that ``checkpoint`` was given, to resume with the same bits. The agent is built the same way, and
            the log holds what it held then.
        checkpoint: is offered the state after every batch.
        log_units: True: measure hidden units at starts, ends and evaluations of blocks; ``batch``: after batches, too.

    Returns:
        The log; ``log.performance()`` is the performance matrix.

    Raises:
        ValueError: before any work, if frames are not a multiple of the agent's environments, or it reads hidden task
            ids.
        FloatingPointError: if a loss or weight is not finite; names it, block and frames.

    Example:
        >>> import curricula
        >>> from ctgraph_rl import make_agent
        >>> curriculum = curricula.load("ct2_interfering", num_frames=4096)
        >>> log = learn_curriculum(curriculum, make_agent("ppo", curriculum))
        >>> log.performance(2).shape  # before training and after each of two blocks, on two tasks
        torch.Size([3, 2])
    """
    log = RunLog() if log is None else log
    device = checked_device(device)
    states = None if saved is None else [saved]
    members = Lockstep(curriculum, Alone(agent), [seed], [log], device=device, saved=states, log_units=log_units)

    def offer(make_states: Callable[[], list[NamedValues]], at_block_end: bool) -> None:
        if checkpoint is not None:
            checkpoint(lambda: make_states()[0], at_block_end)

    with ExitStack() as stack:
        stack.enter_context(closing(members))
        if isinstance(progress, bool):
            bar = ProgressBar(len(curriculum.blocks), curriculum.num_frames)
            progress = stack.enter_context(bar) if progress else None
        run_loop(members, progress, offer)
    for error in members.failed.values():
        raise error
    return log
