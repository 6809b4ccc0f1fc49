"""The base class of detectors, which tell tasks apart, and an agent whose tasks a detector labels.

Pausing, rolling back and trying known labels after a suspicion follow Dick et al. 2024 (CoLLAs, arXiv 2405.19047).
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy, deepcopy
from dataclasses import replace
from typing import Any, ClassVar, cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from typing_extensions import override

from baselines.detectors.seen import SUSPICION, Seen, Verdict
from baselines.parts.networks import sequences_of, trunk_of
from ctgraph_rl.agent import Agent, MethodLike
from ctgraph_rl.checks import NamedValues, ReadOnlyValues, TakesNumbers, at_least_one, at_most, is_int, require
from ctgraph_rl.tasks.curriculum import Curriculum, Stream
from ctgraph_rl.tasks.kinds.task_like import most_actions
from ctgraph_rl.tasks.protocol import Block, Protocol

MOST_LABELS = 2**20
"""Most labels, as of task ids; memory grows with each."""


class Detector(TakesNumbers):
    """Judges from what the learner sees whether the task is still that of the present label.

    So a method needs neither ids nor boundaries of tasks: labels start and end tasks as ids at announced boundaries do.
    With the oracle and announced boundaries this is ``protocol.task_id=at_boundaries``, bit for bit.

    Subclasses define `observe`, which is called with each batch before it is learned from; `start_label` is called with
    the label that acts next. Labels count from 0 in the order of opening. Nothing is drawn from torch's global
    generator.

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

    method: MethodLike

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

    def labelling(self, method: MethodLike) -> Detector:
        """Return this detector as a method, with its task ids and boundaries in place of the curriculum's."""
        self.method = method
        return self

    def prepare(self, curriculum: Curriculum) -> Curriculum:
        """Return the curriculum, whose ids are hidden, as `ctgraph_rl.agent.MethodLike`.

        Raises:
            ValueError: if there is nothing to detect, or the method needs more than labels.
        """
        how = curriculum.protocol
        detector = type(self).__name__
        method = type(self.method).__name__
        hidden = not how.announces or self.is_oracle
        several = curriculum.blocks_of_several
        reads = getattr(self.method, "reads_tasks", "")
        room = self.num_labels(curriculum)
        wants = len(curriculum.tasks) if self.is_oracle else 0
        drawn = "labels all tasks of a curriculum, which a stream draws one by one: take Stream.first(n)"
        require(
            (not isinstance(curriculum, Stream), f"{detector} {drawn}, or leave the detector out"),
            (
                how.task_id == "hidden",
                f"{detector} labels tasks itself: set protocol.task_id=hidden, got {how.task_id}",
            ),
            (
                hidden,
                f"{detector} detects task changes that are not announced: set protocol.boundaries=hidden, "
                "or leave the detector out",
            ),
            (
                not (self.is_oracle and several),
                f"{detector} needs blocks of one task each, and blocks {several} have several: take another detector",
            ),
            (
                not reads,
                f"{method} needs {reads}, which no detector gives: take another method, or leave the detector out",
            ),
            (
                not (self.needs_episodes and how.hides_episodes),
                f"{detector} needs the ends of episodes, which are hidden: set protocol.episodes=shown",
            ),
            (wants <= room, f"max_labels={room} is too few for {wants} tasks: set detector.max_labels=null"),
        )
        labelled = as_labelled(curriculum)
        same = self.method.prepare(labelled) == labelled
        require((same, f"{method} learns another curriculum in place of this one, without changes to detect"))
        return curriculum

    def num_labels(self, curriculum: Curriculum) -> int:
        """Return the largest number of labels."""
        most = self.max_labels
        return len(curriculum.tasks) if most is None else most

    def attach(self, agent: Agent, curriculum: Curriculum) -> SelfLabelledAgent:
        """Return the agent with the method, whose tasks the detector labels.

        Raises:
            ValueError: if agent, method and detector do not fit together.
        """
        name = type(self).__name__
        shape = curriculum.tasks[0].observation_shape
        missing = "features" in self.needs and trunk_of(agent.policy) is None
        fix = "its policy has no trunk with `over_time`, as those of baselines have"
        require(
            (
                not missing,
                f"{name} needs features of {type(agent).__name__}: {fix}; take another agent or detector",
            ),
            (
                "observation_id" not in self.needs or len(shape) == 1,
                f"{name} needs one-hot observations, got images {list(shape)}: take another detector",
            ),
        )
        self.max_labels = self.num_labels(curriculum)
        self.method.max_labels = self.max_labels  # type: ignore[attr-defined]
        tasks = curriculum.tasks
        one_hot = max(task.observation_shape[0] for task in tasks) if len(shape) == 1 else None
        self.setup(agent.num_envs, agent.num_steps, most_actions(tasks), one_hot)
        policy = agent.policy
        learner = self.method.attach(agent, as_labelled(curriculum))
        return SelfLabelledAgent(learner, self, policy)

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


def as_labelled(curriculum: Curriculum) -> Curriculum:
    """Return the curriculum with each task in a block, announced with its id."""
    blocks = tuple(Block((task,), curriculum.num_frames) for task in curriculum.tasks)
    return replace(curriculum, blocks=blocks, protocol=Protocol("at_boundaries", episodes=curriculum.protocol.episodes))


class SelfLabelledAgent(nn.Module):
    """An agent with a method, whose tasks a detector labels.

    A suspicion restores the older of two snapshots of agent, optimiser and method and ends the task. Then the known
    labels start in the order of their opening, for `Detector.patience` frames each, without learning. If the detector
    accepts none, a new label starts, or the old one resumes if there are `max_labels`. If it accepts the old label,
    there was no boundary, and the snapshot stays.
    """

    events = ("alarm", "rolled_back")

    def __init__(self, learner: Agent, detector: Detector, policy: nn.Module) -> None:
        super().__init__()
        self.learner: Any = learner
        self.detector = detector
        self.num_envs = learner.num_envs
        self.num_steps = learner.num_steps
        object.__setattr__(self, "_trunk", trunk_of(policy))  # a part of the agent, which holds it
        self.label = 0
        """The label that acts, and learns unless labels are tried."""

        self.num_labels = 0
        self.home: int | None = None
        """The label before the suspicion, while labels are tried."""

        self.waiting: list[int] = []

        self.num_tried = 0

        self.snapshots: list[NamedValues] = []
        """The older one first; each with ``state`` and ``frames``, those learned until the next one."""

    @property
    def policy(self) -> TensorDictModuleBase:
        """The agent's policy with the acting label's weights."""
        return self.learner.policy

    @property
    def unwrapped(self) -> Agent:
        """The agent without detector and method."""
        return getattr(self.learner, "unwrapped", self.learner)

    def policy_for(self, task: int) -> TensorDictModuleBase:
        """Return the policy for a label."""
        return self.learner.policy_for(task)

    def policy_for_label(self, label: int | None) -> TensorDictModuleBase:
        """Return the policy for a label; for None that for an unopened label."""
        return self.policy_for(self.num_labels if label is None else label)

    def initial_state(self, num_envs: int) -> TensorDict:
        """Return the agent's recurrent state."""
        return self.learner.initial_state(num_envs)

    def start_task(self, task: int | None = None) -> None:
        """Start the detector's first label, or the oracle's at each announced boundary."""
        self._start(self.detector.present_label())

    def end_task(self) -> None:
        """End the present label's task."""
        if self.home is None:
            self.learner.end_task()

    def loss(self, batch: Mapping[Any, Tensor] | TensorDictBase) -> Mapping[str, Tensor] | TensorDictBase:
        """Return the agent's losses and the method's penalties."""
        return self.learner.loss(batch)

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Ask the detector, and learn from a batch unless it suspects a change or labels are tried.

        Returns:
            The agent's measurements, if it learned; ``acted_label``, from 1; ``learned``, 1 or 0; ``alarm``, 1 where
            the detector left the learned label, or 0; ``rolled_back``, the earlier frames whose learning was undone;
            ``oracle``, 1, where the detector knows the true tasks.
        """
        verdict = self.detector.observe(self._seen(batch))
        measured: dict[str, float] = {"acted_label": self.label + 1, "learned": 0, "alarm": 0, "rolled_back": 0}
        if self.detector.is_oracle:
            measured["oracle"] = 1
        if self.home is not None:
            self.num_tried += batch.numel()
            if isinstance(verdict, int):
                self._accept(verdict)
            elif self.num_tried >= self.detector.patience:
                self._try_next()
        elif verdict is SUSPICION:
            measured |= {"alarm": 1, "rolled_back": self._suspect()}
        else:
            measured |= self.learner.learn(batch) | {"learned": 1}
            self._learned(batch.numel())
            if verdict is not None and verdict != self.label:
                measured["alarm"] = 1
                self.learner.end_task()
                self._start(verdict)
        return measured

    @torch.no_grad()
    def _seen(self, batch: TensorDictBase) -> Seen:
        after = batch["next"]
        needs = self.detector.needs
        given = {
            "action": batch["action"],
            "is_init": batch["is_init"].squeeze(-1),
            **{key: after[key].squeeze(-1) for key in ("reward", "done")},
            "episode_return": after.get("episode_reward", torch.full_like(after["reward"], torch.nan)).squeeze(-1),
        }
        if "features" in needs:
            trunk: Any = self._trunk
            given["features"] = trunk.over_time(sequences_of(batch, trunk.in_keys))
        if "observation_id" in needs:
            given["observation_id"] = batch["observation"].argmax(-1)
            given["next_observation_id"] = after["observation"].argmax(-1)
        return Seen(**{key: value.detach().cpu() for key, value in given.items()})

    def _start(self, label: int) -> None:
        self.learner.start_task(label)
        self._resume(label)

    def _resume(self, label: int) -> None:
        self.label = label
        self.num_labels = max(self.num_labels, label + 1)
        self.home = None
        self.waiting = []
        self.detector.start_label(label, trial=False)
        self.snapshots = []
        if self.detector.snapshot_every is not None:
            self._take_snapshot()

    def _take_snapshot(self) -> None:
        self.snapshots = [*self.snapshots[-1:], {"state": deepcopy(self.learner.state_dict()), "frames": 0}]

    def _learned(self, num_frames: int) -> None:
        if self.snapshots:
            self.snapshots[-1]["frames"] += num_frames
            if self.snapshots[-1]["frames"] >= cast(int, self.detector.snapshot_every):
                self._take_snapshot()

    def _suspect(self) -> int:
        undone = sum(each["frames"] for each in self.snapshots)
        self.snapshots = self.snapshots[:1]
        self._restore()
        self.learner.end_task()
        self.home = self.label
        self.waiting = list(range(self.num_labels))
        self._try_next()
        return undone

    def _restore(self) -> None:
        for snapshot in self.snapshots[:1]:
            self.learner.load_state_dict(deepcopy(snapshot["state"]))

    def _try_next(self) -> None:
        if self.waiting:
            self.label = self.waiting.pop(0)
            self.num_tried = 0
            self.learner.start_task(self.label)
            self.detector.start_label(self.label, trial=True)
        else:
            most = cast(int, self.detector.max_labels)
            self._accept(self.num_labels if self.num_labels < most else cast(int, self.home))

    def _accept(self, label: int) -> None:
        if label == self.home and self.snapshots:
            self._restore()
        elif label != self.label:
            self.learner.start_task(label)
        self._resume(label)

    @override
    def get_extra_state(self) -> NamedValues:
        own = {name: getattr(self, name) for name in STATE}
        snapshots = [{**each, "state": dict(each["state"])} for each in self.snapshots]
        return {**own, "waiting": list(self.waiting), "snapshots": snapshots, "detector": self.detector.state_dict()}

    @override
    def set_extra_state(self, state: NamedValues) -> None:
        for name in STATE:
            setattr(self, name, state[name])
        self.waiting = list(state["waiting"])
        self.snapshots = deepcopy(state["snapshots"])
        self.detector.load_state_dict(state["detector"])


STATE = ("label", "num_labels", "home", "num_tried")
