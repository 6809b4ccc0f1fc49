"""TaskLike: what a block of a curriculum holds, a CT-graph or anything else that makes its environment."""

from __future__ import annotations

import sys
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any, Protocol

from ctgraph_rl.checks import Rule, require


class TaskLike(Hashable, Protocol):
    """A task of any kind: a frozen dataclass with the four members below, equal and hashable by value.

    Its fields are plain values, tuples of them, or such dataclasses again: fingerprints cover them and JSON holds them.
    `ctgraph_rl.Task` is the first kind, `ctgraph_rl.GymTask` the second. All tasks of a curriculum are of one kind.

    Further members are optional. With ``resumes`` the environment can be saved: a new one continues with the same bits
    after ``load_state_dict(state_dict())``. Without it a stopped run resumes from its last announced block.
    ``optimal_value(gamma)``, the best mean return, and ``return_bounds``, the lowest and highest return of an episode,
    serve metrics and figures; they raise a ``ValueError`` with the reason where unknown.
    """

    @property
    def label_parts(self) -> Mapping[str, str]:
        """Parts of the short name. A curriculum shows the first, and those in which its tasks differ."""
        ...

    @property
    def observation_shape(self) -> tuple[int, ...]:
        """Of one row."""
        ...

    @property
    def num_actions(self) -> int | None:
        """None where actions are continuous."""
        ...

    @classmethod
    def make_env(
        cls,
        tasks: Sequence[Any],
        seed: int = 0,
        *,
        task_pool: Sequence[Any] | None = None,
        device: Any = "cpu",
        task_ids: Mapping[Any, int] | None = None,
        num_task_ids: int | None = None,
    ) -> Any:
        """Return a TorchRL ``EnvBase`` with one row per task, ``batch_size=[len(tasks)]``, which the caller closes.

        Its data have ``observation``, ``is_init``, ``step_count`` and ``episode_reward``, the last three [N, 1], beside
        ``reward``, ``done`` and ``terminated``; TorchRL's ``InitTracker``, ``StepCounter`` and ``RewardSum`` can write
        them. A further method, ``set_tasks(tasks, at_episode_end=False)``, gives each row a task of the pool: before
        the next reset of all rows, or when the row's episode ends.

        Args:
            tasks: one for each row.
            seed: decides all that is random.
            task_pool: all tasks that ``set_tasks`` may be given; None: ``tasks``.
            device: where the tensors live.
            task_ids: the id of each task. Observations then have ``task_id``, one-hot, uint8 [N, num_task_ids], zeros
                for a task without one.
            num_task_ids: the length of ``task_id``.
        """
        ...


ENVIRONMENTS: dict[type, Callable[..., Any]] = {}
"""Makers of environments by kind of task, filled by `ctgraph_rl.env`; they take `TaskLike.make_env`'s arguments."""

MEMBERS = ("label_parts", "observation_shape", "num_actions", "make_env")


def are_tasks(name: str, values: object) -> list[Rule]:
    """Return the rules that values are tasks of one kind, asking no task for anything.

    Args:
        name: what needs them; begins the message.
        values: checked to be a tuple.
    """
    if not isinstance(values, tuple) or not all(map(_is_value, values)):
        fix = f"a task is a Task, a GymTask or a frozen dataclass with {', '.join(MEMBERS)}"
        return [(False, f"{name}, got {values!r:.200}; {fix}")]
    kinds = list(dict.fromkeys(map(type, values)))
    several = " and ".join(dict.fromkeys(kind.__name__ for kind in kinds))
    one_kind = (
        len(kinds) < 2,
        f"tasks of one environment must be of one kind, got {several}; make two curricula",
    )
    return [*map(_task_rule, kinds), one_kind]


def most_actions(tasks: Iterable[TaskLike]) -> int:
    """Return the largest number of actions.

    Raises:
        ValueError: for continuous ones.
    """
    counts = [task.num_actions for task in tasks]
    known = [count for count in counts if count is not None]
    require((len(known) == len(counts), "actions must be discrete here, these tasks have continuous ones"))
    return max(known)


def _is_value(value: object) -> bool:
    return is_dataclass(value) and not isinstance(value, type)


def is_kind(kind: type) -> bool:
    """Return whether tasks can be of a class."""
    return is_dataclass(kind) and _task_rule(kind)[0]


def _task_rule(kind: type) -> Rule:
    known = {field.name for field in fields(kind)}
    missing = [name for name in MEMBERS if name not in known and not hasattr(kind, name)]
    if not missing and kind.__hash__ is None:
        return False, f"{kind.__name__} is no task, it cannot be hashed: put @dataclass(frozen=True) above its class"
    fix = "see ctgraph_rl.tasks.kinds.task_like.TaskLike"
    return not missing, f"{kind.__name__} is no task, it lacks {', '.join(missing)}: {fix}"


def environment(kind: type) -> Callable[..., Any]:
    """Return the maker of environments for a kind of tasks.

    Raises:
        ImportError: if `ctgraph_rl.env` is not imported.
    """
    if kind not in ENVIRONMENTS:
        raise ImportError(f"{kind.__name__}.make_env needs its environment: import ctgraph_rl.env first")
    return ENVIRONMENTS[kind]


def close_env(env: Any) -> None:
    """Close an environment. A failure is printed, not raised: results or a first error come first."""
    try:
        if hasattr(env, "close"):
            env.close()
    except Exception as error:  # of an environment of anyone
        name = type(getattr(env, "unwrapped", env)).__name__
        print(f"note: {name} failed to close: {error!r:.200}", file=sys.stderr)
