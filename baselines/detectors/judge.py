"""Judges whether the task has changed: a detector without the method that it labels."""

from __future__ import annotations

from copy import copy
from typing import ClassVar

from baselines.detectors.seen import Seen, Verdict
from ctgraph_rl.checks import NamedValues, ReadOnlyValues, TakesNumbers, at_least_one, at_most, is_int, require
from ctgraph_rl.tasks.curriculum import Curriculum

MOST_LABELS = 2**20
"""Most labels, as of task ids; memory grows with each."""


class Judge(TakesNumbers):
    """Judges from what the learner sees whether the task is still that of the present label.

    Labels count from 0 in the order of opening. `SelfLabelled` calls `observe` with each batch before it is learned
    from, and `start_label` with the label that acts next. Nothing is drawn from torch's global generator.

    Args:
        max_labels: most labels; None, where allowed: one for each task of the curriculum.
        patience: frames for which a known label is tried before the next one.
        snapshot_every: frames between snapshots of what is learned; a suspicion restores the older of two. None: no
            snapshots.
    """

    reads: ClassVar[str] = ""
    needs: ClassVar[tuple[str, ...]] = ()
    """Optional fields of `Seen` that it reads: ``features``, ``observation_id``."""

    needs_episodes: ClassVar[bool] = False
    """Whether it reads where episodes end, and their returns."""

    is_oracle: ClassVar[bool] = False
    changing: ClassVar[tuple[str, ...]] = ()

    def __init__(self, max_labels: int | None, patience: int, snapshot_every: int | None) -> None:
        labels = is_int(max_labels, 1) or (max_labels is None and self.is_oracle)
        require(
            (labels, f"max_labels must be an integer >= 1, got {'null' if max_labels is None else repr(max_labels)}"),
            *at_most(MOST_LABELS, max_labels=max_labels),
            *at_least_one(patience=patience),
            *(() if snapshot_every is None else at_least_one(snapshot_every=snapshot_every)),
        )
        self.max_labels = max_labels
        self.patience = patience
        self.snapshot_every = snapshot_every

    def tell(self, curriculum: Curriculum) -> None:
        """Called once with what will be learned, if it is an oracle."""

    def setup(self, num_rows: int, num_steps: int, num_actions: int, num_observations: int | None) -> None:
        """Called once before the first batch.

        Args:
            num_steps: steps of a batch; blocks may end with a shorter one.
            num_observations: number of one-hot observations; None for images.

        Raises:
            ValueError: if it cannot work with them.
        """

    def present_label(self) -> int:
        """Return the label to begin with; an oracle is asked at each announced boundary."""
        return 0

    def observe(self, seen: Seen) -> Verdict:
        """Return what a batch says of the present label.

        Returns:
            None: the label stays. `SUSPICION`: learning is rolled back and pauses, and the known labels are tried. A
                label: this one from the next batch on, without a rollback; in a trial it is accepted. The number of
                labels so far is a new one.
        """
        raise NotImplementedError

    def start_label(self, label: int, trial: bool) -> None:
        """Called when the next batch will be the first of a label.

        Args:
            trial: whether it is tried after a suspicion; False where learning begins or resumes with it.
        """

    def state_dict(self) -> NamedValues:
        """Return all that verdicts depend on, as tensors and plain values."""
        return {name: copy(getattr(self, name)) for name in self.changing}

    def load_state_dict(self, state: ReadOnlyValues) -> None:
        """Restore what `state_dict` returned."""
        for name in self.changing:
            setattr(self, name, copy(state[name]))
