"""Several seeds as one batch: one environment, one forward pass, one gradient step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing

import torch

from ctgraph_rl.checks import NamedValues, takes_numbers
from ctgraph_rl.core.device import checked_device
from ctgraph_rl.learn.loop import Group, Lockstep, Progress, SavedState, run_loop
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.tasks.curriculum import Curriculum, Stream
from ctgraph_rl.tasks.task import are_graphs

OfferCheckpoints = Callable[[Callable[[], list[NamedValues]], bool], object]
"""Takes a function that makes the state of each seed's run, and whether a block ends here."""


def why_not_together(curriculum: Curriculum) -> str | None:
    """Return why seeds cannot learn a curriculum in one environment, if they cannot."""
    kind = type(curriculum.examples[0]).__name__
    if not are_graphs(curriculum.examples):
        return f"the rows of {kind} cannot draw from the streams of several seeds, as those of CT-graphs can"
    shared = any(block.switch is not None and block.switch.together for block in curriculum.example_blocks)
    if isinstance(curriculum, Stream) and curriculum.blocks.seed is None:
        return "each seed draws its own tasks: give curriculum.seed=0, and all learn one life"
    if curriculum.protocol.guide_frames:
        return "a guide draws from the generator of one seed"
    return "its blocks change the tasks of all rows at once" if shared else None


@takes_numbers
def learn_together(
    curriculum: Curriculum,
    group: Group,
    seeds: Sequence[int],
    logs: Sequence[RunLog],
    progress: Progress | None = None,
    *,
    device: torch.device | str = "cpu",
    saved: Sequence[SavedState] | None = None,
    checkpoint: OfferCheckpoints | None = None,
    log_units: bool | str = False,
) -> dict[int, FloatingPointError]:
    """Let agents with different seeds learn a curriculum as `learn_curriculum` lets one.

    Each seed has the rows, generator, evaluations and log of a single run and differs from it by rounding. One with a
    loss or weight that is not finite has failed and measures nothing from then on.

    Args:
        curriculum: one for which `why_not_together` has no objection.
        progress: updated after every batch with the mean return of all seeds.
        saved: all states that ``checkpoint`` was given, to resume with the same bits.
        checkpoint: is offered the states after every batch.
        log_units: as for `learn_curriculum`.

    Returns:
        The error of each failed seed by its position in ``seeds``; names the seed, block and frames.

    Raises:
        ValueError: before any work, as `learn_curriculum` does.
    """
    device = checked_device(device)
    members = Lockstep(curriculum, group, seeds, logs, device=device, saved=saved, log_units=log_units)
    with closing(members):
        run_loop(members, progress, checkpoint)
    return members.failed
