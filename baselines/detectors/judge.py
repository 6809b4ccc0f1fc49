"""What judges whether the task has changed: all of a detector but the method that it labels."""

from __future__ import annotations

from copy import copy
from typing import ClassVar

from baselines.detectors.seen import Seen, Verdict
from ctgraph_rl.checks import NamedValues, ReadOnlyValues, TakesNumbers, at_least_one, at_most, is_int, require
from ctgraph_rl.tasks.curriculum import Curriculum

MOST_LABELS = 2**20
"""The largest number of labels, equal to that of task ids; memory grows with each."""


class Judge(TakesNumbers):
    """Judges from what the learner sees whether the task is still that of the present label.

    Labels are 0, 1, 2, ... in the order in which they are opened. `SelfLabelled` calls `observe` once with each batch,
    before the batch is learned from, and tells by `start_label` with which label it acts next. Nothing is drawn from
    torch's global generator.

    Args:
        max_labels: most labels; None, where a detector allows it: one for each task of the curriculum.
        patience: frames for which a known label is tried before the next one.
        snapshot_every: frames between two snapshots of what is learned; a suspicion restores the older of two. None:
            there are none, and a suspicion restores nothing.
    """

    reads: ClassVar[str] = ""
    """What its verdicts depend on, in a few words."""

    needs: ClassVar[tuple[str, ...]] = ()
    """What it reads of `Seen` beside the fields that are always there: ``features``, ``observation_id``."""

    is_oracle: ClassVar[bool] = False
    """Whether it is given the curriculum."""

    changing: ClassVar[tuple[str, ...]] = ()
    """The attributes that its verdicts depend on, tensors and plain values."""

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
            num_rows: rows of a batch.
            num_steps: steps of a batch, unless the end of a block has shortened it.
            num_actions: number of different actions.
            num_observations: number of different observations where they are one-hot; None for images.

        Raises:
            ValueError: if it cannot work with them.
        """

    def present_label(self) -> int:
        """Return the label to begin with; an oracle is asked at each announced boundary."""
        return 0

    def observe(self, seen: Seen) -> Verdict:
        """Return what a batch says of the present label.

        Returns:
            None: nothing; the label stays. `SUSPICION`: what is learned is rolled back, learning pauses, and the known
            labels are tried. A label: this one from the next batch on, without a rollback; while labels are tried it is
            accepted. The number of labels so far stands for a new one.
        """
        raise NotImplementedError

    def start_label(self, label: int, trial: bool) -> None:
        """Called when the next batch will be the first one that is acted with a label.

        Args:
            label: the label.
            trial: whether it is tried after a suspicion; False where learning begins, or resumes, with it.
        """

    def state_dict(self) -> NamedValues:
        """Return all that verdicts depend on, as tensors and plain values."""
        return {name: copy(getattr(self, name)) for name in self.changing}

    def load_state_dict(self, state: ReadOnlyValues) -> None:
        """Restore what `state_dict` returned."""
        for name in self.changing:
            setattr(self, name, copy(state[name]))
