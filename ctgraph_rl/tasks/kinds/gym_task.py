"""GymTask: an environment of Gymnasium as a task of a curriculum."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache, partial, wraps
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np

from ctgraph_rl.checks import as_tuple, is_int, is_real, make_fields_plain, require, true_or_false
from ctgraph_rl.packages import load_object
from ctgraph_rl.tasks.kinds.frozen_arguments import NONE, freeze
from ctgraph_rl.tasks.kinds.gym_spaces import ActionForm, ObservationForm
from ctgraph_rl.tasks.kinds.task_like import close_env, environment

if TYPE_CHECKING:
    import gymnasium

T = TypeVar("T")

WITH_TABLE = ("gymnasium.envs.toy_text.frozen_lake", "gymnasium.envs.toy_text.cliffwalking")
"""Modules of environments that step only by their table ``P``."""

ALREADY = {
    "max_episode_steps": "give it as GymTask(max_episode_steps=...)",
    "disable_env_checker": "the checker is always off",
    "id": "it is the first argument of GymTask",
}
"""Arguments of ``gymnasium.make`` that ``kwargs`` cannot give, and why."""


@dataclass(frozen=True)
class GymTask:
    """An environment of Gymnasium with a time limit, and images, vectors or integers as observations.

    `ctgraph_rl.tasks.kinds.gym_spaces.ObservationForm` says how observations are shown. Actions are integers; our
    agents refuse continuous ones.

    The seed of each ``reset(seed=...)`` follows from the run's seed, the row and the number of its episode, so that
    runs repeat. A stopped run resumes by replaying the present episodes.

    Two tasks are equal if all arguments are, types included: ``True`` differs from ``1``, a list from a tuple.

    Args:
        id: of the environment; ``module:Name-v0`` imports the module first.
        kwargs: arguments of the environment by name: numbers, texts, booleans, None, and lists, tuples and dicts of
            them. Arrays arrive as lists.
        wrappers: applied in order: classes, or functions of an environment, by ``module:name``. One with arguments is a
            pair, such as ``("gymnasium.wrappers:FrameStackObservation", {"stack_size": 4})``.
        max_episode_steps: truncates an episode; None: the limit of the id or of a wrapper ``TimeLimit``.
        label: short name in tables; None: the id with its arguments.
        return_range: lowest and highest return of an episode, if the best policy always gets the highest. None:
            computed within the time limit for environments of `WITH_TABLE`, else unknown.
        repeats: whether seed and actions determine an episode. If not, a stopped run resumes from its last announced
            block.
        channels: where images have their channels, ``first`` or ``last``; None: found by the length of the axis.

    Raises:
        ValueError: for a value that breaks a rule; the environment may refuse more when it is made.

    Example:
        >>> GymTask("FrozenLake-v1", {"is_slippery": False}).optimal_value(1.0)
        1.0
    """

    id: str
    kwargs: Any = NONE  # held as `ctgraph_rl.tasks.kinds.frozen_arguments.FrozenArguments`
    wrappers: Any = ()  # held as a tuple of names, and of pairs of a name and arguments
    max_episode_steps: int | None = None
    label: str | None = None
    return_range: tuple[float, float] | None = None
    repeats: bool = True
    channels: str | None = field(default=None, metadata={"added": True})

    def __post_init__(self) -> None:
        make_fields_plain(self)
        object.__setattr__(self, "kwargs", freeze("kwargs", self.kwargs))
        wrappers = as_tuple(self.wrappers)
        form = "[FlattenObservation, 'my_module:MyWrapper', (FrameStackObservation, {'stack_size': 4})]"
        rule = f"wrappers must be a list of classes, functions or their names, such as {form}, got {self.wrappers!r}"
        require((isinstance(wrappers, tuple), rule))
        object.__setattr__(self, "wrappers", tuple(_frozen_wrapper(each, rule) for each in wrappers))  # type: ignore[attr-defined]
        limit = self.max_episode_steps
        pair = self.return_range
        in_order = isinstance(pair, tuple) and len(pair) == 2 and is_real(pair[0]) and is_real(pair[1], pair[0])
        arguments = self.kwargs.thaw()
        human = "render_mode must be 'rgb_array', which AddRenderObservation shows, or left out: 'human' opens windows"
        channels = f"channels must be 'first', 'last' or None, got {self.channels!r}"
        require(
            (isinstance(self.id, str) and bool(self.id), f"id must be the id of an environment, got {self.id!r}"),
            (arguments.get("render_mode") != "human", human),
            *((name not in arguments, f"kwargs must leave out {name}: {why}") for name, why in ALREADY.items()),
            (limit is None or is_int(limit, 1), f"max_episode_steps must be an integer >= 1, got {limit!r}"),
            (self.label is None or isinstance(self.label, str), f"label must be a text, got {self.label!r}"),
            (pair is None or in_order, f"return_range must be the lowest and the highest return, got {pair!r}"),
            (self.channels in (None, "first", "last"), channels),
            *true_or_false(repeats=self.repeats),
        )

    @property
    def label_parts(self) -> dict[str, str]:
        """One part: the label."""
        kinds = (bool, int, float, str, type(None))
        given = [f"{name}={value}" for name, value in self.kwargs.thaw().items() if isinstance(value, kinds)]
        return {"task": self.label or " ".join([self.id, *given])}

    @property
    def resumes(self) -> bool:
        """Whether a saved environment can continue, by replaying its episodes."""
        return self.repeats

    @property
    def observation_shape(self) -> tuple[int, ...]:
        """The shape of a shown observation."""
        return make_forms(self)[0].shape

    @property
    def num_actions(self) -> int | None:
        """None where actions are continuous."""
        return make_forms(self)[1].num_actions

    @property
    def modules(self) -> tuple[str, ...]:
        """Modules to import where its environment is made."""
        import gymnasium

        module, _, name = self.id.rpartition(":")
        spec = None if module else gymnasium.registry.get(name)
        entry = spec.entry_point if spec is not None and isinstance(spec.entry_point, str) else ""
        names = [each if isinstance(each, str) else each[0] for each in self.wrappers]
        found = (module, entry.partition(":")[0], *(name.partition(":")[0] for name in names))
        return tuple(filter(None, dict.fromkeys(found)))

    @classmethod
    def make_env(cls, tasks: Sequence[GymTask], seed: int = 0, **settings: Any) -> Any:
        """Return a `ctgraph_rl.batch.gym_env.GymEnv` with a row per task."""
        return environment(GymTask)(tasks, seed, **settings)

    def make(self) -> gymnasium.Env[Any, Any]:
        """Return the wrapped environment.

        Raises:
            ValueError: if it cannot be made, has no time limit, or shows what networks cannot read.
        """
        import gymnasium

        env: Any = None
        try:
            try:
                env = gymnasium.make(self.id, self.max_episode_steps, disable_env_checker=True, **self.kwargs.thaw())
                for wrapper in self.wrappers:
                    name, arguments = (wrapper, NONE) if isinstance(wrapper, str) else wrapper
                    wrapped = load_object(name)(env, **arguments.thaw())
                    is_env = isinstance(wrapped, gymnasium.Env)
                    require((is_env, f"the wrapper {name} must return a gymnasium.Env, got {wrapped!r:.80}"))
                    env = wrapped
            except Exception as error:  # of an environment of anyone
                raise ValueError(f"GymTask({self.id!r}) cannot be made: {type(error).__name__}: {error}") from error
            limit = "has no time limit, so an episode may never end: give max_episode_steps"
            require((time_limit(env) is not None, f"{self.id} {limit}"))
            _read_forms(self, env)
        except BaseException:
            if env is not None:
                close_env(env)
            raise
        return env

    def optimal_value(self, gamma: float) -> float:
        """The best mean discounted return within the time limit, of a policy that sees state and time.

        Raises:
            ValueError: where it is not known.
        """
        if self.return_range is not None and gamma == 1:
            return self.return_range[1]
        table = _table(self)
        values = table.values(gamma, lambda after: (table.probs * after).sum(-1).max(1))
        return float(values @ table.initial)

    @property
    def return_bounds(self) -> tuple[float, float]:
        """Lowest and highest return of an episode; chance may exceed the best mean return.

        Raises:
            ValueError: where they are not known.
        """
        if self.return_range is not None:
            return self.return_range
        return _extreme_return(self, np.nanmin), _extreme_return(self, np.nanmax)


def time_limit(env: Any) -> int | None:
    """Return the shortest time limit among an environment's wrappers, or None."""
    from gymnasium import Wrapper
    from gymnasium.wrappers import TimeLimit

    limits = []
    while isinstance(env, Wrapper):
        if isinstance(env, TimeLimit):
            limits.append(env._max_episode_steps)
        env = env.env
    return min(limits, default=None)


def kept_while_registered(find: Callable[[GymTask], T]) -> Callable[[GymTask], T]:
    """Keep what a function finds for as long as the registration of the task's id stays what it is."""

    @cache
    def found(task: GymTask, registration: tuple[Any, ...]) -> T:
        return find(task)

    @wraps(find)
    def look_up(task: GymTask) -> T:
        from gymnasium import registry

        spec = registry.get(task.id.rpartition(":")[2])
        return found(task, () if spec is None else (spec.entry_point, spec.max_episode_steps, repr(spec.kwargs)))

    return look_up


@kept_while_registered
def make_forms(task: GymTask) -> tuple[ObservationForm, ActionForm]:
    """Return the forms of a task's observations and actions."""
    env = task.make()
    try:
        return _read_forms(task, env)
    finally:
        close_env(env)


def _read_forms(task: GymTask, env: Any) -> tuple[ObservationForm, ActionForm]:
    try:
        return ObservationForm(env.observation_space, task.channels), ActionForm(env.action_space)
    except ValueError as error:
        raise ValueError(f"{task.id} {error}") from None


class _Table(NamedTuple):
    """Transitions of an environment of `WITH_TABLE`: arrays [states, actions, outcomes], padded with probability 0."""

    probs: np.ndarray
    following: np.ndarray  # int64: states
    rewards: np.ndarray
    ends: np.ndarray  # 1 where the outcome ends the episode
    initial: np.ndarray  # [states]: probability of each state at the start
    limit: int  # steps of an episode

    def values(self, gamma: float, best: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """V_0 = 0, V_t(s) = best of r_o + gamma V_{t-1}(s_o), but for ends of episodes; [states]."""
        values = np.zeros(len(self.initial))
        for _ in range(self.limit):
            values = best(self.rewards + gamma * (1 - self.ends) * values[self.following])
        return values


@kept_while_registered
def _table(task: GymTask) -> _Table:
    env: Any = task.make()
    try:
        inner = env.unwrapped
        known = type(inner).__module__ in WITH_TABLE and not task.wrappers
        fix = "give return_range where you know it"
        require((known, f"the best mean return of {task.id} is not known, it has no table of transitions: {fix}"))
        transitions = inner.P
        initial = np.asarray(inner.initial_state_distrib)
        limit = time_limit(env)
    finally:
        close_env(env)
    assert limit is not None, "`make` requires one"
    most = max(len(outcomes) for of_state in transitions.values() for outcomes in of_state.values())
    padded = np.zeros((len(transitions), len(transitions[0]), most, 4))
    for state, of_state in transitions.items():
        for action, outcomes in of_state.items():
            padded[state, action, : len(outcomes)] = outcomes
    probs, following, rewards, ends = np.moveaxis(padded, -1, 0)
    return _Table(probs, following.astype(np.int64), rewards, ends, initial=initial, limit=limit)


def _extreme_return(task: GymTask, choose: Callable[..., Any]) -> float:
    table = _table(task)
    impossible = table.probs == 0
    values = table.values(1.0, lambda after: choose(np.where(impossible, np.nan, after), axis=(1, 2)))
    return float(choose(values[table.initial > 0]))


def _frozen_wrapper(wrapper: Any, rule: str) -> Any:
    given: Any = ()
    if isinstance(wrapper, partial):
        given = wrapper.keywords
        require(
            (not wrapper.args, f"a partial function of a wrapper needs its arguments by name, got {wrapper!r:.200}")
        )
        wrapper = wrapper.func
    elif isinstance(wrapper, (tuple, list)) and len(wrapper) == 2:
        wrapper, given = wrapper
    name = wrapper
    if callable(wrapper) and hasattr(wrapper, "__qualname__"):
        name = f"{wrapper.__module__}:{wrapper.__qualname__}"
    require((isinstance(name, str) and ":" in name, rule))
    found = not {"<lambda>", "<locals>"} & set(name.replace(":", ".").split("."))
    fix = "define it by class or def at the top of a module"
    require((found, f"the wrapper {name} has no name by which another process finds it, got {wrapper!r}: {fix}"))
    arguments = freeze(f"arguments of the wrapper {name}", given)
    return name if arguments == NONE else (name, arguments)


def require_wrapper_classes(task: GymTask) -> None:
    """Refuse wrappers that others' files must not name: functions, and classes that write files or open windows.

    Raises:
        ValueError: for a wrapper that is no class of `gymnasium.Wrapper`, or one of `gymnasium.wrappers` that writes.
    """
    from gymnasium import Wrapper
    from gymnasium.wrappers import HumanRendering, RecordVideo

    for wrapper in task.wrappers:
        name = wrapper if isinstance(wrapper, str) else wrapper[0]
        try:
            kind = load_object(name)
        except (ImportError, AttributeError) as error:
            raise ValueError(f"the wrapper {name} cannot be found: {error}") from error
        is_class = isinstance(kind, type) and issubclass(kind, Wrapper)
        allowed = is_class and not issubclass(kind, (RecordVideo, HumanRendering))
        fix = "give the curriculum as Python"
        require((allowed, f"a file may name only classes of gymnasium.Wrapper that write nothing, got {name}: {fix}"))
