"""Recorder: anyone's learner, measured by a curriculum's protocol, with a run's files."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from types import FunctionType
from typing import Any

from torchrl.record.loggers.common import Logger

from ctgraph_rl.checks import (
    NamedValues,
    Rule,
    as_path,
    is_int,
    is_json_object,
    not_negative,
    plain,
    require,
    takes_numbers,
    true_or_false,
)
from ctgraph_rl.disk import is_writable
from ctgraph_rl.learn.adapt import adapt
from ctgraph_rl.learn.collect import Policy, agent_specs
from ctgraph_rl.learn.evaluate import Evaluator, by_slices
from ctgraph_rl.learn.exact import exact_rules
from ctgraph_rl.learn.refusals import check_lines
from ctgraph_rl.log.files import CHECKPOINTS, LOG, METRICS
from ctgraph_rl.log.provenance import code_changes, full_name
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.log.scores import scores
from ctgraph_rl.runs.checkpoints import SECONDS, Checkpoints
from ctgraph_rl.runs.session import RunMember, Session, is_whole
from ctgraph_rl.runs.settings import differences, flat
from ctgraph_rl.runs.trackers import FOLDER, Tracker, logger_of
from ctgraph_rl.tasks.curriculum import Curriculum


class Recorder:
    """Evaluates policies by a curriculum's protocol, when your loop asks for it, and keeps a run log.

    A policy is one of

    - a function of observations, uint8 [n, 1, r, r] or [n, K], that returns n integer actions, or float ones where
      actions are continuous. A second argument named ``task_id`` gets the one-hot task ids, uint8 [n, num_task_ids], or
      None where the protocol shows none;
    - a function ``(observation, state, episode_start)`` that returns ``(actions, state)``, for memory: the first state
      is None, and ``episode_start``, bool [n], says which rows start an episode;
    - an object with ``predict``, such as a model of Stable-Baselines3, greedy where the protocol is;
    - a plain ``torch.nn.Module`` from observations to logits, as for `ctgraph_rl.learn.logits_policy.LogitsPolicy`;
    - a TensorDict module without recurrent state, or a class of `ctgraph_rl.policies`.

    Observations are NumPy arrays. Where the protocol shows task ids, other functions and ``predict`` get a dict of
    ``observation`` and ``task_id``. A function draws its own random numbers; where the protocol is greedy it should
    take its best action.

    Use it as a context manager, or call `close`::

        with Recorder(curriculum, "runs/mine/0", resume=True) as recorder:
            if recorder.saved is None:
                recorder.evaluate(policy, 0)
            else:
                policy.load_state_dict(recorder.saved)
            for block, frames in zip(curriculum.blocks, curriculum.ends):
                if frames <= recorder.frames:
                    continue  # learned before the run was stopped
                ...  # learn block.tasks for block.num_frames
                recorder.evaluate(policy, frames)
                recorder.checkpoint(policy.state_dict, frames)

    Args:
        run_dir: for a run's files but ``agent.pt``; None: measurements stay in ``log``.
        seed: of the run; evaluations derive theirs from it, in [0, 2**63).
        about: the learner's name and settings for the log, as JSON: ``{"learner": "SAC", "learning_rate": 0.01}``. Runs
            in one folder that name no learner are one learner, with the folder's name.
        code: classes and functions that learn; the log records their source, so that results of changed code are not
            averaged with earlier ones.
        resume: resume the directory's run from its last `checkpoint`, or from the start without one. ``saved`` is what
            was saved, and ``frames`` after how many frames. A finished run is shown: ``finished`` is true, ``frames``
            is the curriculum's, so that nothing is learned again, ``log`` and ``metrics`` hold its results, `evaluate`
            returns what was measured, and no file changes.
        logger: also gets measurements at once: a file in ``conf/logger``, such as ``"tensorboard"``, or a function that
            builds a logger of TorchRL in a folder.
        checkpoint_seconds: time between two checkpoints within a block, >= 0.

    Raises:
        ValueError: before anything is written: for values out of range, or to resume a run of other settings or changed
            code.
        FileExistsError: if the directory holds a run, without ``overwrite`` or ``resume``.
        BlockingIOError: if another writer is there, such as an open recorder.

    Example:
        >>> import curricula
        >>> import numpy as np
        >>> curriculum = curricula.load("su_b1_4tasks")
        >>> with Recorder(curriculum) as recorder:
        ...     for frames in (0, *curriculum.ends):  # learn a block before each but the first
        ...         recorder.evaluate(lambda observation: np.zeros(len(observation), dtype=np.int64), frames)
        {'goal1.1': 0.0, 'goal1.2': 0.0, 'goal2.1': 0.0, 'goal2.2': 0.0}
        {'goal1.1': 0.0, 'goal1.2': 0.0, 'goal2.1': 0.0, 'goal2.2': 0.0}
        {'goal1.1': 0.0, 'goal1.2': 0.0, 'goal2.1': 0.0, 'goal2.2': 0.0}
        {'goal1.1': 0.0, 'goal1.2': 0.0, 'goal2.1': 0.0, 'goal2.2': 0.0}
        {'goal1.1': 0.0, 'goal1.2': 0.0, 'goal2.1': 0.0, 'goal2.2': 0.0}
        >>> recorder.log.performance(4).shape
        torch.Size([5, 4])
    """

    @takes_numbers
    def __init__(
        self,
        curriculum: Curriculum,
        run_dir: Path | str | None = None,
        seed: int = 0,
        about: Mapping[str, Any] | None = None,
        code: Sequence[type | FunctionType] | None = None,
        *,
        overwrite: bool = False,
        resume: bool = False,
        logger: str | Callable[[Path], Logger] | None = None,
        checkpoint_seconds: float = SECONDS,
    ) -> None:
        about = plain(about)
        listed = code is None or isinstance(code, (list, tuple))
        is_code = listed and all(isinstance(each, (type, FunctionType)) for each in code or ())
        writes = run_dir is not None or not (overwrite or resume or logger is not None)
        require(
            (isinstance(curriculum, Curriculum), f"curriculum must be a Curriculum, got {curriculum!r}"),
            (is_int(seed, 0, 2**63 - 1), f"seed must be an integer in [0, 2**63), got {seed!r}"),
            ("seed" not in (about or {}), "about must leave out the seed, which is a separate argument"),
            (is_json_object(about), f"about must be plain JSON values by name, got {about!r}"),
            (is_code, f"code must be a list of classes and functions, such as [MyAgent], got {code!r}"),
            *true_or_false(overwrite=overwrite, resume=resume),
            *not_negative(checkpoint_seconds=checkpoint_seconds),
            (
                not (overwrite is True and resume is True),
                "give either overwrite or resume: a run is replaced or resumed",
            ),
            (writes, "overwrite, resume and logger need a run_dir"),
        )
        how = curriculum.evaluation
        how.check((*curriculum.examples, *how.held_out))
        late = "evaluation.exact=true needs evaluation.before=true: it shows before training whether a policy has exact"
        require((how.before or not how.exact, f"{late} means"))
        check_lines(curriculum)
        self.curriculum = curriculum
        self.run_dir = None if run_dir is None else as_path("run_dir", run_dir)
        self.saved: Mapping[str, Any] | None = None
        self.frames = 0
        self.finished = False
        self._evaluated = -1
        self._trained = 0
        self._session: Session | None = None  # while this writes into its directory
        self._member = RunMember(
            curriculum,
            None,  # type: ignore[arg-type] # its user's
            seed,
            run_dir=Path() if self.run_dir is None else self.run_dir,
            config={"seed": seed, **(about or {})},
            checkpoints=Checkpoints(Path(self.run_dir or "", CHECKPOINTS), checkpoint_seconds),
            sources=None if code is None else [full_name(each) for each in code],
        )
        if self.run_dir is None:
            self._member.log.append("run", **self._member.about)
        else:
            make_logger = logger_of(logger)
            is_read_only = resume and (self.run_dir / METRICS).exists() and not is_writable(self.run_dir)
            with Session() as session:
                if not is_read_only:  # else no process can write
                    session.lock(self.run_dir)
                self._open(self.run_dir, overwrite, resume)
                if not self.finished:
                    if make_logger is not None:
                        tracker = Tracker(make_logger, self.run_dir, dict(flat(self._member.config)))
                        self.log.listeners.append(session.enter(tracker))
                    self._session = session.pop_all()
        self._evaluator = Evaluator(curriculum, seed, self.log)

    @property
    def log(self) -> RunLog:
        """What was measured so far."""
        return self._member.log

    def _open(self, run_dir: Path, overwrite: bool, resume: bool) -> None:
        path = run_dir / LOG
        begun = RunLog.begun(path)
        stopped = begun is not None and not (run_dir / METRICS).exists()
        if not overwrite and not (resume and begun is not None) and path.exists() and not RunLog.is_blank(path):
            what = "a run that was stopped" if stopped else "no run" if begun is None else "a finished run"
            fix = "choose another run_dir, or overwrite=True to replace it" + ", or resume=True" * (begun is not None)
            raise FileExistsError(f"{path} exists and is of {what}: {fix}")
        if begun is None:
            self._note_twin(run_dir)
        if resume and begun is not None:
            self._check_same(begun)
            if not stopped and is_whole(run_dir):
                self._show(run_dir)
                return
        checkpoints = self._member.checkpoints
        checkpoints.tidy()
        state = checkpoints.newest() if resume else None
        if state is not None:
            require(("learner" in state, f"{checkpoints.folder} holds no checkpoint of a Recorder"))
            self.saved = state["learner"]
            self.frames = state["frames"]
            self._evaluated = state["evaluated"]
            self._trained = state["trained"]
        else:
            checkpoints.clear()
            if begun is not None:
                shutil.rmtree(run_dir / FOLDER, ignore_errors=True)
        self._member.begin(state)

    def _note_twin(self, run_dir: Path) -> None:
        ours = self._member.about
        for path in sorted(run_dir.parent.glob(f"*/{LOG}")):
            other = RunLog.begun(path) or {}
            if path.parent != run_dir and all(other.get(key) == ours[key] for key in ("fingerprint", "config")):
                seed = f"{path.parent} has seed {ours['config']['seed']} of the same learner, so tables count one"
                print(f"note: {seed}: give this run another seed, or about={{'learner': NAME}}")
                return

    def _check_same(self, begun: Mapping[str, Any]) -> None:
        before = begun.get("fingerprint")
        now = self.curriculum.fingerprint
        other = f"{self.run_dir} holds a run of {begun.get('curriculum')} (fingerprint {before}), this one has {now}"
        changed = differences(begun.get("config") or {}, self._member.config)
        fix = "give what it was begun with, choose another run_dir, or overwrite=True"
        require(
            (before == now, f"{other}: {fix}"),
            (not changed, f"{self.run_dir} holds a run with {', '.join(changed)}: {fix}"),
        )

    def _show(self, run_dir: Path) -> None:
        self._member.log = RunLog.read(run_dir / LOG)
        changed = ", ".join(code_changes(self.log.about, self._member.about))
        fix = "choose another run_dir, or overwrite=True to run it again"
        require((not changed, f"{run_dir} was made by other code: {changed} changed; {fix}"))
        self.finished = True
        self.frames = self._evaluated = self._trained = self.curriculum.num_frames
        print(f"{run_dir} holds this run, finished: its results are shown; overwrite=True runs it again")

    @takes_numbers
    def checkpoint(self, state: Callable[[], Mapping[str, Any]], frames: int) -> None:
        """Save the learner if it is time: at first, at a block's end, and after ``checkpoint_seconds``.

        A stopped run resumes from its last readable checkpoint. Later measurements are removed and made again.

        Args:
            state: makes what the learner needs to learn on, as tensors and plain Python values, such as
                ``model.state_dict``; `saved` is what it returned.
            frames: frames learned so far, at least those of the last evaluation and training.

        Raises:
            ValueError: for frames out of order or beyond the curriculum, without a run_dir, and for an unreadable
                state.
        """
        least = max(self._evaluated, self._trained, self.frames)
        last = self.curriculum.num_frames
        require(
            self._open_rule(),
            (self.run_dir is not None, "a checkpoint needs a run_dir: Recorder(curriculum, run_dir)"),
            (
                callable(state),
                f"state must be a function that makes the state, such as model.state_dict, got {state!r:.80}",
            ),
            (is_int(frames, least, last), f"frames must be an integer in {least}..{last}, got {frames!r}"),
        )

        def make() -> NamedValues:
            reached = {"frames": frames, "evaluated": self._evaluated, "trained": self._trained}
            return {**reached, "learner": dict(state()), "log": self.log.position()}

        if not self.finished:
            self._member.checkpoints.offer(make, self.curriculum.is_end(frames))
        self.frames = frames

    @property
    def moments(self) -> tuple[int, ...]:
        """All frames after which the protocol wants an evaluation."""
        return self.curriculum.moments

    @takes_numbers
    def evaluate(
        self, policy: Any = None, frames: int = 0, policy_for: Callable[[int], Any] | None = None
    ) -> dict[str, float]:
        """Evaluate by the protocol after ``frames`` frames of the run.

        Evaluations exactly at a block's end are rows of the performance matrix, others are logged as during a block.

        Args:
            policy: of a kind that the class lists.
            frames: frames learned so far, more than at the last evaluation.
            policy_for: instead of ``policy``, where the protocol gives task ids: the policy for an id.

        Returns:
            The mean return on each task, by label.

        Raises:
            ValueError: for frames out of order or beyond the curriculum, and other than policies.
        """
        if self.finished:
            return self._measured(frames)
        last = self.curriculum.num_frames
        require(
            self._open_rule(),
            (is_int(frames, 0, last), f"frames must be an integer in 0..{last}, the curriculum's, got {frames!r}"),
            ((policy is None) != (policy_for is None), "give either policy or policy_for"),
        )
        require((frames > self._evaluated, f"frames must grow: {frames} comes after {self._evaluated}"))
        acts = self._adapted(policy, policy_for, frames)
        where = "after" if frames in self.curriculum.ends else "during" if frames else "before"
        self._evaluator.evaluate(acts, frames, where)
        self.log.sync()
        self._evaluated = frames
        return self._measured(frames)

    def _measured(self, frames: int) -> dict[str, float]:
        found = {m["label"]: m["return_mean"] for m in self.log.of_kind("evaluation") if m["frames"] == frames}
        require((bool(found), f"the run is finished and has no evaluation after {frames!r} frames"))
        return found

    @takes_numbers
    def training(self, frames: int, **values: Any) -> None:
        """Log what training measured since the last time, or the start of the block.

        Args:
            frames: frames learned so far, more than the last time.
            values: numbers by name: ``return_mean``, ``success_rate`` and ``length_mean`` of the finished ``episodes``,
                which metrics use, and any others.

        Raises:
            ValueError: for frames out of order or beyond the curriculum, and other values than numbers.
        """
        last = self.curriculum.num_frames
        numbers = {name: plain(value) for name, value in values.items()}
        no_numbers = [name for name, value in numbers.items() if not isinstance(value, (int, float, type(None)))]
        taken = sorted({"kind", "block", "seconds"} & set(values))
        require(
            self._open_rule(),
            (is_int(frames, 1, last), f"frames must be an integer in 1..{last}, the curriculum's, got {frames!r}"),
            (not no_numbers, f"{', '.join(no_numbers)} must be numbers or None; leave out what is none"),
            (not taken, f"{', '.join(taken)} are fields of every line of the log: choose other names"),
        )
        require((frames > self._trained, f"frames must grow: {frames} comes after {self._trained}"))
        self._trained = frames
        common = {"episodes": 0, "return_mean": None, "success_rate": None, "length_mean": None}
        self.log.append("training", block=self.curriculum.block_at(frames), frames=frames, **{**common, **numbers})

    @property
    def metrics(self) -> NamedValues:
        """The metrics of the evaluations so far, undefined with the reason where some are missing."""
        return dict(scores(self.log, self.curriculum))

    def close(self) -> None:
        """Write tables and metrics, close the log and the logger, and remove the checkpoints.

        Without the protocol's last evaluation a run is unfinished: it gets no results and keeps its checkpoints.
        """
        session = self._session
        self._session = None
        with session or nullcontext():
            last = self.moments[-1]
            if session is None:
                self.log.close()
            elif self._evaluated < last:
                self.log.close()
                unfinished = f"{self.run_dir} is not finished: it needs the evaluation after {last:,} frames"
                print(f"{unfinished}; resume=True resumes it")
            else:
                self._member.finish()

    def _open_rule(self) -> Rule:
        is_open = self.run_dir is None or self.finished or self._session is not None
        return is_open, f"this Recorder of {self.run_dir} is closed: a Recorder with resume=True resumes its run"

    def __getstate__(self) -> NamedValues:
        """Return a copy's state; two recorders cannot write into one directory."""
        if self.run_dir is not None and not self.finished:
            raise TypeError(f"a Recorder that writes into {self.run_dir} has no copies; copy one without a run_dir")
        return dict(vars(self))

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if error is None:
            self.close()
            return
        session = self._session
        self._session = None
        with session or nullcontext():
            self.log.close()

    def _adapted(self, policy: Any, policy_for: Callable[[int], Any] | None, frames: int) -> Policy:
        if policy_for is None:
            return self._adapt(policy)
        ids = self.curriculum.task_ids
        shown = self.curriculum.protocol.task_id
        require((shown != "hidden", "policy_for is for task ids, which are hidden in this protocol: give policy"))
        tasks = list(self._evaluator.tasks_at(frames))
        unknown = [task for task in tasks if task not in ids]
        require((not unknown, "policy_for cannot play held-out tasks, which have no task id: give policy"))
        return by_slices([self._adapt(policy_for(ids[task])) for task in tasks])

    def _adapt(self, policy: Any) -> Policy:
        curriculum = self.curriculum
        acts = adapt(
            policy,
            greedy=curriculum.evaluation.greedy,
            num_actions=getattr(agent_specs(curriculum).action, "n", None),
            shows_ids=curriculum.protocol.task_id == "one_hot",
        )
        if curriculum.evaluation.exact:
            name = getattr(policy, "__name__", type(policy).__name__)
            require(*exact_rules(acts, curriculum.examples[0], {}, name))
        return acts
