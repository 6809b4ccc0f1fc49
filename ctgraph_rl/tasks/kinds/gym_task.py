"""GymTask: an environment of Gymnasium as a task of a curriculum."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ctgraph_rl.checks import as_tuple, is_int, is_real, make_fields_plain, require, true_or_false
from ctgraph_rl.tasks.kinds.registry import environment

if TYPE_CHECKING:
    import gymnasium

WITH_TABLE = ("gymnasium.envs.toy_text.frozen_lake", "gymnasium.envs.toy_text.cliffwalking")
"""Modules of environments that step only by their table of transitions ``P``."""


@dataclass(frozen=True)
class GymTask:
    """An environment of Gymnasium: any id with a time limit whose observations are images, vectors or integers.

    Images are uint8 [height, width] or [height, width, channels], and are shown channels first. Vectors are shown as
    float32, and integers as one-hot. Actions are integers; our agents refuse continuous ones. Nothing else is needed
    for a learner of one's own.

    Every episode begins with ``reset(seed=...)``. Its seed follows from the run's seed, the row and the number of the
    row's episode, so that a run repeats. A stopped run resumes by the seeds of the present episodes and their actions.

    Args:
        id: of the environment; ``module:Name-v0`` imports the module that registers it first.
        kwargs: arguments of the environment by name: numbers, texts, true or false, None, and lists of them.
        wrappers: wrap the environment one after the other: classes, or functions of an environment, by ``module:name``.
        max_episode_steps: the time limit, which truncates an episode; None: that of the id.
        label: short name in tables; None: the id with its arguments.
        return_range: the lowest and the highest return of an episode, where you know them and the best policy always
            gets the highest. None: computed within the time limit for environments of `WITH_TABLE`, and else unknown.
        repeats: whether an episode repeats with its seed and actions. If not, a stopped run resumes from its last
            announced block.

    Raises:
        ValueError: for a value that breaks a rule; what the environment itself refuses is found when it is first made.

    Example:
        >>> GymTask("FrozenLake-v1", {"is_slippery": False}).optimal_value(1.0)
        1.0
    """

    id: str
    kwargs: Any = ()  # held as pairs in the order of their names
    wrappers: Any = ()  # held as a tuple of names
    max_episode_steps: int | None = None
    label: str | None = None
    return_range: tuple[float, float] | None = None
    repeats: bool = True

    def __post_init__(self) -> None:
        make_fields_plain(self)
        object.__setattr__(self, "kwargs", _frozen_kwargs(self.kwargs))
        wrappers = as_tuple(self.wrappers)
        wrappers = tuple(map(_import_name, wrappers)) if isinstance(wrappers, tuple) else wrappers
        object.__setattr__(self, "wrappers", wrappers)
        names = isinstance(wrappers, tuple) and all(isinstance(each, str) and ":" in each for each in wrappers)
        limit = self.max_episode_steps
        pair = self.return_range
        in_order = isinstance(pair, tuple) and len(pair) == 2 and is_real(pair[0]) and is_real(pair[1], pair[0])
        require(
            (isinstance(self.id, str) and bool(self.id), f"id must be the id of an environment, got {self.id!r}"),
            (names, f"wrappers must be classes or functions, or names such as my_module:MyWrapper, got {wrappers!r}"),
            (limit is None or is_int(limit, 1), f"max_episode_steps must be an integer >= 1, got {limit!r}"),
            (self.label is None or isinstance(self.label, str), f"label must be a text, got {self.label!r}"),
            (pair is None or in_order, f"return_range must be the lowest and the highest return, got {pair!r}"),
            *true_or_false(repeats=self.repeats),
        )

    @property
    def label_parts(self) -> dict[str, str]:
        """One part: the label."""
        given = [f"{name}={value}" for name, value in self.kwargs if not isinstance(value, tuple)]
        return {"task": self.label or " ".join([self.id, *given])}

    @property
    def resumes(self) -> bool:
        """Whether an environment of it can be saved, see `TaskLike`: by replaying its episodes."""
        return self.repeats

    @property
    def observation_shape(self) -> tuple[int, ...]:
        """The shape of an observation that is shown."""
        space = spaces_of(self)[0]
        if _is_integer(space):
            return (int(space.n),)
        height_first = tuple(map(int, space.shape))
        if len(height_first) == 1:
            return height_first
        return (1, *height_first) if len(height_first) == 2 else (height_first[2], *height_first[:2])

    @property
    def num_actions(self) -> int | None:
        """The number of actions; None where they are continuous."""
        return int(spaces_of(self)[1].n) if _is_integer(spaces_of(self)[1]) else None

    @property
    def modules(self) -> tuple[str, ...]:
        """The modules that are imported where its environment is made."""
        import gymnasium

        module, _, name = self.id.rpartition(":")
        spec = None if module else gymnasium.registry.get(name)
        entry = spec.entry_point if spec is not None and isinstance(spec.entry_point, str) else ""
        found = (module, entry.partition(":")[0], *(each.partition(":")[0] for each in self.wrappers))
        return tuple(filter(None, dict.fromkeys(found)))

    @classmethod
    def make_env(cls, tasks: Sequence[GymTask], seed: int = 0, **settings: Any) -> Any:
        """Return a `ctgraph_rl.batch.gym_env.GymEnv` with one row for each of ``tasks``; see `TaskLike`."""
        return environment(GymTask)(tasks, seed, **settings)

    def make(self) -> gymnasium.Env[Any, Any]:
        """Return the environment, wrapped.

        Raises:
            ValueError: if it cannot be made, has no time limit, or shows what networks cannot read.
        """
        import gymnasium

        kwargs = {name: list(value) if isinstance(value, tuple) else value for name, value in self.kwargs}
        try:
            env = gymnasium.make(self.id, self.max_episode_steps, disable_env_checker=True, **kwargs)
            limit = env.spec.max_episode_steps if env.spec is not None else None
            for name in self.wrappers:
                env = _object_named(name)(env)
        except Exception as error:  # of an environment of anyone
            raise ValueError(f"GymTask({self.id!r}) cannot be made: {type(error).__name__}: {error}") from error
        flatten = "add the wrapper gymnasium.wrappers:FlattenObservation, or one of your own"
        shown = env.observation_space
        actions = env.action_space
        require(
            (limit is not None, f"{self.id} has no time limit, so an episode may never end: give max_episode_steps"),
            (_is_shown(shown), f"{self.id} shows {shown}, which cannot be stacked as images or vectors: {flatten}"),
            (_is_integer(actions) or _is_box(actions), f"{self.id} takes {actions}: actions must be integers or a Box"),
        )
        return env

    def optimal_value(self, gamma: float) -> float:
        """The best mean return within the time limit, of a policy that sees state and time; discounted by ``gamma``.

        Raises:
            ValueError: where it is not known.
        """
        if self.return_range is not None and gamma == 1:
            return self.return_range[1]
        return _best_mean_return(self, gamma)

    @property
    def return_bounds(self) -> tuple[float, float]:
        """The lowest and the highest return of an episode, which chance can make better than the best mean return.

        Raises:
            ValueError: where they are not known.
        """
        if self.return_range is not None:
            return self.return_range
        return _extreme_return(self, np.nanmin), _extreme_return(self, np.nanmax)


@cache
def spaces_of(task: GymTask) -> tuple[Any, Any]:
    """Return the spaces of a task's observations and actions."""
    env = task.make()
    try:
        return env.observation_space, env.action_space
    finally:
        env.close()


def _is_integer(space: Any) -> bool:
    return type(space).__name__ == "Discrete"


def _is_box(space: Any) -> bool:
    return type(space).__name__ == "Box"


def _is_shown(space: Any) -> bool:
    """Return whether a space is of integers, vectors or images."""
    if not _is_box(space):
        return _is_integer(space)
    return len(space.shape) == 1 or (len(space.shape) in (2, 3) and space.dtype == np.uint8)


class _Table(NamedTuple):
    """Transitions of an environment of `WITH_TABLE`: arrays [states, actions, outcomes], padded with probability 0."""

    probs: np.ndarray
    following: np.ndarray  # int64: states
    rewards: np.ndarray
    ends: np.ndarray  # 1 where the outcome ends the episode
    initial: np.ndarray  # [states]: probability of each state at the start
    limit: int  # steps of an episode


@cache
def _table(task: GymTask) -> _Table:
    env = task.make()
    inner = env.unwrapped
    known = type(inner).__module__ in WITH_TABLE and not task.wrappers
    fix = "give return_range where you know it"
    require((known, f"the best mean return of {task.id} is not known, it has no table of transitions: {fix}"))
    transitions = inner.P  # type: ignore[attr-defined]
    most = max(len(outcomes) for of_state in transitions.values() for outcomes in of_state.values())
    padded = np.zeros((len(transitions), len(transitions[0]), most, 4))
    for state, of_state in transitions.items():
        for action, outcomes in of_state.items():
            padded[state, action, : len(outcomes)] = outcomes
    probs, following, rewards, ends = np.moveaxis(padded, -1, 0)
    initial = np.asarray(inner.initial_state_distrib)  # type: ignore[attr-defined]
    limit = env.spec.max_episode_steps  # type: ignore[union-attr]
    following = following.astype(np.int64)
    return _Table(probs, following, rewards, ends, initial=initial, limit=limit)  # type: ignore[arg-type]


def _best_mean_return(task: GymTask, gamma: float) -> float:
    """Return the best mean return within the time limit, by finite-horizon dynamic programming.

    V_0 = 0 and V_t(s) = max_a sum_o p_o (r_o + gamma V_{t-1}(s_o)), without the last term where o ends the episode.
    """
    table = _table(task)
    values = np.zeros(len(table.initial))
    for _ in range(table.limit):
        after = table.rewards + gamma * (1 - table.ends) * values[table.following]
        values = (table.probs * after).sum(-1).max(1)
    return float(values @ table.initial)


def _extreme_return(task: GymTask, choose: Callable[..., Any]) -> float:
    """Return the best or the worst return that an episode can have: as above, with any outcome that is possible."""
    table = _table(task)
    impossible = table.probs == 0
    values = np.zeros(len(table.initial))
    for _ in range(table.limit):
        after = table.rewards + (1 - table.ends) * values[table.following]
        values = choose(np.where(impossible, np.nan, after), axis=(1, 2))
    return float(choose(values[table.initial > 0]))


def _frozen_kwargs(kwargs: Any) -> tuple[tuple[str, Any], ...]:
    """Return arguments as pairs in the order of their names.

    Raises:
        ValueError: for values that JSON has no form for, and a way to render, which an agent does not see.
    """
    pairs: Any = kwargs.items() if isinstance(kwargs, Mapping) else as_tuple(kwargs)
    try:
        given = {name: as_tuple(value) for name, value in pairs}
    except (TypeError, ValueError):
        given = {"": object()}
    rule = f"kwargs must be plain values by name, such as {{'is_slippery': False}}, got {kwargs!r}"
    plain = all(isinstance(name, str) and name and _is_plain(value) for name, value in given.items())
    require((plain, rule), ("render_mode" not in given, "kwargs must leave out render_mode: nothing is rendered"))
    return tuple(sorted(given.items()))


def _is_plain(value: Any) -> bool:
    if isinstance(value, tuple):
        return all(map(_is_plain, value))
    return value is None or isinstance(value, (bool, int, float, str))


def _import_name(wrapper: Any) -> Any:
    """Return ``module:name`` of a class or function; anything else unchanged."""
    named = callable(wrapper) and hasattr(wrapper, "__qualname__")
    return f"{wrapper.__module__}:{wrapper.__qualname__}" if named else wrapper


def _object_named(name: str) -> Any:
    """Return the class or function of ``module:name``."""
    module, _, own_name = name.partition(":")
    return getattr(import_module(module), own_name)
