"""Rows: a batch of CT-graphs as plain tensors, which every environment wraps."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from ctgraph_rl.batch.assignment import Assignment
from ctgraph_rl.batch.native import Native, kernel_rule, knows, require_kernel
from ctgraph_rl.batch.params import make_shared_bank, make_tables
from ctgraph_rl.batch.tensor_engine import TensorEngine
from ctgraph_rl.checks import Rule, TakesNumbers, is_int, plain, require, require_all, takes_numbers
from ctgraph_rl.core import dynamics, philox
from ctgraph_rl.core.device import checked_device
from ctgraph_rl.core.dynamics import RowState, Shown
from ctgraph_rl.core.goal import Goal
from ctgraph_rl.core.graph import StateType
from ctgraph_rl.core.kernel import is_available, is_traced
from ctgraph_rl.core.row_params import RowParams
from ctgraph_rl.core.tree import is_done
from ctgraph_rl.tasks.images import white_level
from ctgraph_rl.tasks.life import DrawnTasks
from ctgraph_rl.tasks.switch import Switch, switch_rule
from ctgraph_rl.tasks.task import Task

T = TypeVar("T")


class Rows(TakesNumbers, nn.Module):
    """A batch of CT-graphs without TorchRL or Gymnasium: one task, random stream and state per row.

    ``state`` is replaced at every step and never written into. Its fields are buffers, which follow ``to()``.

    Args:
        tasks: one per row.
        seed: of all draws, in [0, 2**63).
        first_row: number of the first row, for a batch that is split.
        task_pool: the tasks that `set_tasks` may be given, which fix the images. Default: ``tasks``.
        noise_bank: 0 draws noise for every pixel of every observation. M >= 1 takes an observation's noise from M drawn
            in advance, which is faster; two observations then share noise with probability 1 / M.
        kernel: whether the C kernel takes the steps, with the same bits. It needs a CPU, a C compiler and rewards of
            this package. ``"auto"`` uses it where it can run and steps are not traced, as by ``torch.compile``;
            ``"off"`` never does; ``"required"`` refuses what it cannot run.

    Raises:
        ValueError: for no tasks, values out of range, observations of different shapes, and what a required kernel
            cannot run.
    """

    seed: Tensor
    row: Tensor
    bank: Tensor
    noises: Tensor
    normal_table: Tensor
    state_type: Tensor
    node: Tensor
    tick: Tensor
    step_count: Tensor
    episode_reward: Tensor
    goal_leaf: Tensor
    episodes_left: Tensor
    reward: Tensor
    paid: Tensor
    task: Tensor
    choice: Tensor
    episodes: Tensor
    tasks_change: bool
    """Whether rows may change tasks when they start episodes."""

    def __init__(
        self,
        tasks: Iterable[Task],
        seed: int = 0,
        first_row: int = 0,
        task_pool: Iterable[Task] | None = None,
        device: torch.device | str | None = "cpu",
        noise_bank: int = 0,
        kernel: str = "auto",
    ) -> None:
        tasks = require_all(Task, "tasks", tasks)
        if isinstance(task_pool, DrawnTasks):
            self.pool: Sequence[Task] = task_pool
            self.examples = task_pool.examples
        else:
            pool = tasks if task_pool is None else require_all(Task, "task_pool", task_pool)
            self.pool = self.examples = tuple(dict.fromkeys(pool))
        self._number = {task: number for number, task in enumerate(self.examples)}
        self.num_rows = len(tasks)
        require(
            seed_rule(seed),
            (is_int(first_row, 0, 2**32 - self.num_rows), f"rows must be numbered in [0, 2**32), got {first_row=}"),
            (is_int(noise_bank, 0, 2**31), f"noise_bank must be an integer in 0..2**31, got {noise_bank!r}"),
            kernel_rule(kernel),
        )
        device = None if device is None else checked_device(device)
        super().__init__()
        self.kernel = kernel
        self.max_branching = max(task.graph.branching_factor for task in self.examples)
        self.register_buffer("seed", torch.tensor([seed], device=device, dtype=torch.int64))
        self.register_buffer("row", torch.arange(first_row, first_row + self.num_rows, device=device))
        self._choose_engine()
        self.register_buffer("bank", None, persistent=False)
        self.register_buffer("noises", None, persistent=False)
        self._noise_bank = noise_bank
        self._fill_bank(self.examples)
        self.image_shape = self._bank.shape
        self.white = max(int(white_level(task.images)) for task in self.examples)
        self.register_buffer("normal_table", philox.normal_table().to(device), persistent=False)
        zeros = torch.zeros(self.num_rows, dtype=torch.int64, device=device)
        for field, dtype in dynamics.STATE_DTYPES.items():
            self.register_buffer(field, zeros.to(dtype, copy=True))
        for field in _ASSIGNED:
            self.register_buffer(field, zeros.clone())
        self.tensors = TensorEngine()
        self.native = Native()
        self.set_tasks(tasks)

    @property
    def device(self) -> torch.device:
        """The device of the tensors."""
        return self.row.device

    def _choose_engine(self) -> None:
        reward_fns = [task.reward_fn for task in self.examples]
        if self.kernel == "required":
            require_kernel(reward_fns, self.device)
        self._kernel_fits = self.kernel == "auto" and type(self.row) is Tensor and knows(reward_fns, self.device)

    @property
    def uses_kernel(self) -> bool:
        """Whether the C kernel takes the steps, not the tensor engine."""
        return self.kernel == "required" or (self._kernel_fits and not is_traced() and is_available())

    @property
    def engine(self) -> TensorEngine | Native:
        """The engine that takes the next step."""
        return self.native if self.uses_kernel else self.tensors

    @property
    def state(self) -> RowState:
        """The state of all rows."""
        buffers = self._buffers
        return RowState(*(buffers[field] for field in RowState._fields))  # type: ignore[arg-type]

    @state.setter
    def state(self, state: RowState) -> None:
        self._buffers.update(zip(RowState._fields, state, strict=True))

    @property
    def assignment(self) -> Assignment:
        """The task of each row, and its choices for the next episodes."""
        return Assignment(self.task, self.choice, self.episodes, self._choices, self._switch)

    @assignment.setter
    def assignment(self, assignment: Assignment) -> None:
        self.task, self.choice, self.episodes, self._choices, self._switch = assignment
        self.tasks_change = assignment.may_change

    @property
    def tasks(self) -> tuple[Task, ...]:
        """The task of each row."""
        return tuple(self.pool[number] for number in self.task.tolist())

    def find_numbers(self, tasks: Iterable[Task]) -> list[int]:
        """Return the numbers of tasks in the pool.

        Raises:
            ValueError: for a task that is not in it.
        """
        tasks = require_all(Task, "tasks", tasks)
        if isinstance(self.pool, DrawnTasks):
            drawn = {task: self.pool.index(task) for task in dict.fromkeys(tasks)}
            return [drawn[task] for task in tasks]
        objects = {id(task): task for task in tasks}  # few, and a task's hash takes longer than its identity
        unknown = [task for task in dict.fromkeys(objects.values()) if task not in self._number]
        require((not unknown, f"tasks must be in task_pool, got {unknown[:3]}; name them at construction"))
        numbers = {identity: self._number[task] for identity, task in objects.items()}
        return [numbers[id(task)] for task in tasks]

    def set_tasks(self, tasks: Iterable[Task], at_episode_end: bool = False) -> None:
        """Give every row a task, in place.

        Args:
            at_episode_end: each row has its new task from its next reset on. False ends all episodes: `reset` before
                the next step.

        Raises:
            ValueError: if there is not one task per row, or a task is not in the pool.
        """
        numbers = torch.tensor(self.find_numbers(tasks), device=self.device, dtype=torch.int64)
        n = self.num_rows
        require((len(numbers) == n, f"set_tasks needs one task per row, {n} in all, got {len(numbers)}"))
        whole_pool = torch.arange(len(self.pool), device=self.device)
        self._choose(whole_pool, numbers, None, at_episode_end)

    def switch_tasks(self, tasks: Iterable[Task], switch: Switch, at_episode_end: bool = False) -> None:
        """Let rows change between tasks from episode to episode, beginning with the first.

        Args:
            tasks: at least two tasks of the pool.
            switch: decides the task of each episode; its clock starts now.
            at_episode_end: as in `set_tasks`.

        Raises:
            ValueError: for less than two tasks, one that is not in the pool, and what is no switch.
        """
        choices = torch.tensor(self.find_numbers(tasks), device=self.device, dtype=torch.int64)
        enough = len(choices) > 1, "switch_tasks needs at least two tasks, got one; use set_tasks"
        require(enough, switch_rule(switch))
        self._choose(choices, torch.zeros_like(self.row), switch, at_episode_end)

    def _choose(self, choices: Tensor, choice: Tensor, switch: Switch | None, at_episode_end: bool) -> None:
        chosen = Assignment(self.task, choice, torch.zeros_like(choice), choices, switch)
        if at_episode_end:
            self.assignment = chosen
            self._make_tables()
        else:
            self._restart(chosen)

    def _restart(self, assignment: Assignment) -> None:
        self.assignment = assignment.restarted()
        self._make_tables()
        self._end_episodes()

    def _fill_bank(self, tasks: tuple[Task, ...]) -> None:
        bank = make_shared_bank(tasks, self.num_rows, self._noise_bank)
        no_images = bank.images.new_empty(0, *bank.shape)
        self._bank = bank._replace(images=no_images, noises=no_images)
        self.bank = bank.images.to(self.device)
        self.noises = bank.noises.to(self.device)

    def _make_tables(self) -> None:
        number = self.assignment.in_use
        tasks = tuple(self.pool[i] for i in number.tolist())
        if self.pool is not self.examples:
            self._fill_bank((*self.examples, *tasks))
        self.tables = make_tables(tasks, number, self._bank)
        self.uses = self.tables.uses
        self._take_params()

    def _take_params(self) -> None:
        self.tables = self.tables.assigned(self.task)
        images = (self.bank, self.noises, self.normal_table)
        self._bind(RowParams(self.seed, self.row, *self.tables.by_row(), *images))

    def _bind(self, params: RowParams) -> None:
        self.params = params
        self.tensors.bind(params, self.tables)
        self.native.bind(params, self.tables)

    def _start_episodes(self, mask: Tensor | None) -> None:
        if not self.tasks_change:
            return
        mask = torch.ones_like(self.task, dtype=torch.bool) if mask is None else mask
        before = self.task
        self.assignment = self.assignment.begin(mask, (self.seed, self.row, self.tick))
        changed = self.task != before
        if changed.any():
            self._take_params()
            self.goal_leaf = torch.where(changed, self.tables.row_goals, self.goal_leaf)
            self.episodes_left = torch.where(changed, 0, self.episodes_left)

    def set_goals(self, goals: Iterable[Goal] | Tensor) -> None:
        """Give every row a goal, also within an episode; `set_tasks` and `set_seed` restore the tasks' goals.

        Args:
            goals: decisions in 1..b for every row, such as ``"1.2"``, also as [N, d]; or numbers of end states,
                int64 [N].

        Raises:
            ValueError: if a goal is not one of its row's tree.
        """
        if not isinstance(goals, Tensor) or goals.ndim == 2:
            listed = list(plain(goals))
            n = self.num_rows
            require((len(listed) == n, f"set_goals needs one goal per row, {n} in all, got {len(listed)}"))
            numbers = [goal for goal in listed if is_int(goal)]  # decisions or end states?
            fix = 'write decisions as "1" or "1.2", and numbers of end states as an int64 tensor'
            require((not numbers, f"goals must be decisions, got {numbers[:3]}: {fix}"))
            leaves = [replace(task, goal=goal).goal_leaf for task, goal in zip(self.tasks, listed, strict=True)]
            goals = torch.tensor(leaves, device=self.device, dtype=torch.int64)
        fits = goals.shape == (self.num_rows,) and goals.dtype == torch.int64
        require((fits, f"goals must be int64 of shape [{self.num_rows}], got {goals.dtype} {list(goals.shape)}"))
        outside = (goals < 0) | (goals >= self.params.g.num_leaves)
        require((not outside.any(), f"goals must be end states of the rows' trees, got {goals[outside][:5].tolist()}"))
        self.goal_leaf = goals.to(self.device, copy=True)

    @takes_numbers
    def set_seed(self, seed: int) -> None:
        """Restart all rows with another seed and their tasks' goals; `reset` gives their first episodes."""
        require(seed_rule(seed))
        self.set_streams(torch.tensor([seed], device=self.device, dtype=torch.int64), self.row)

    def set_streams(self, seed: Tensor, row: Tensor) -> None:
        """Restart all rows with separate random streams.

        Args:
            seed: int64 [N], or [1] for all.
            row: int64 [N], distinguishes rows of one seed.
        """
        self.seed = seed.clone()
        self.row = row.clone()
        self.tick = torch.zeros_like(self.row)
        if self.tasks_change:
            self._restart(self.assignment)
        else:
            self._bind(self.params._replace(seed=self.seed, row=self.row))
            self._end_episodes()

    def reset(self, mask: Tensor | None = None) -> Shown:
        """Start an episode in the rows of a mask, bool [N], or in all; return what all rows show."""
        mask = torch.ones_like(self.row, dtype=torch.bool) if mask is None else mask
        self._start_episodes(mask)
        return self._keep(*self.engine.take(self.state, None, mask))

    def step(self, action: Tensor, mask: Tensor | None = None) -> Shown:
        """Step all rows, or those of a mask, bool [N], with actions, int64 [N]; return what all rows show.

        The reward is in ``state``. Rows outside the mask stay unchanged, draw nothing, and may have any action.
        """
        before = self.state
        engine = self.engine
        state, shown = engine.take(before, action if mask is None else action * mask, None)
        if mask is not None:
            state = dynamics.choose(mask, state, before)
            shown = dynamics.choose(mask, shown, engine.take(before, None, torch.zeros_like(mask))[1])
        return self._keep(state, shown)

    def act(self, action: Tensor) -> tuple[Tensor, Tensor]:
        """Step rows of which none is finished; return only their observations and which are done, bool [N].

        `result` returns more.
        """
        observation, done = self._keep(*self.engine.observe(self.state, action, None))
        assert done is not None
        return observation, done

    def step_or_reset(self, action: Tensor, mask: Tensor) -> Shown:
        """Start an episode in the rows of a mask, whatever their action, and step the others; return what all rows
        show.
        """
        self._start_episodes(mask)
        return self._keep(*self.engine.take(self.state, action, mask))

    def result(self, done: Tensor) -> tuple[Tensor, Tensor]:
        """Return outcome, uint8 [N], and leaf, int64 [N], of the rows that are done."""
        return dynamics.outcome(self.state, done, self.params)

    def restart(self, mask: Tensor | None = None, shown: Tensor | None = None) -> Tensor:
        """Start an episode in all rows, or in all finished ones, the mask; return what all rows observe.

        ``shown``, uint8 [N, *shape], is their last observation, if known.
        """
        self._start_episodes(mask)
        return self._keep(*self.engine.observe(self.state, None, mask, shown))[0]

    def _keep(self, state: RowState, result: T) -> T:
        self._buffers.update(zip(RowState._fields, state, strict=True))
        return result

    def show(self) -> Shown:
        """Return the present observations of all rows."""
        return dynamics.show(self.state, self.params, self.uses)

    @property
    def observation_id(self) -> Tensor:
        """The ids that the rows show, int64 [N]."""
        return dynamics.observation_id(self.state, self.params, self.uses)

    @property
    def is_done(self) -> Tensor:
        """Rows whose episode is over, bool [N]."""
        return is_done(self.state, self.params.tree)

    def check_actions(self, action: Tensor | None, mask: Tensor | None = None) -> None:
        """Raise a ValueError for actions of a wrong shape, dtype or range, and for steps of finished rows."""
        spec = f"action must be int64 of shape [{self.num_rows}] with values in 0..{self.max_branching}"
        require((action is not None, f"{spec}, got none: a policy must write it before a step"))
        assert action is not None
        require(
            (action.dtype == torch.int64, f"{spec}, got dtype {action.dtype}"),
            (action.shape == (self.num_rows,), f"{spec}, got shape {list(action.shape)}"),
        )
        outside = (action < 0) | (action > self.max_branching)
        finished = self.is_done
        outside, finished = (outside, finished) if mask is None else (outside & mask, finished & mask)
        if (outside | finished).any():
            require(
                (not outside.any(), f"{spec}, got {action[outside][:5].tolist()}"),
                (not finished.any(), f"rows {finished.nonzero().flatten()[:5].tolist()} are done: reset them first"),
            )

    def _end_episodes(self) -> None:
        self.goal_leaf = self.tables.row_goals
        self.state_type = torch.full_like(self.state_type, int(StateType.FAIL))
        self.episodes_left = torch.zeros_like(self.episodes_left)

    def _load_from_state_dict(self, *args: Any, **kwargs: Any) -> None:
        """Load into copies, as others may hold the present buffers."""
        for field in ("seed", "row", *_ASSIGNED, *RowState._fields):
            self._buffers[field] = self._buffers[field].clone()  # type: ignore[union-attr]
        super()._load_from_state_dict(*args, **kwargs)
        self.tasks_change = self.assignment.may_change
        self._make_tables()

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Rows:
        super()._apply(fn, recurse)

        def moved(part: Any) -> Any:
            if isinstance(part, tuple):
                return type(part)(*map(moved, part)) if hasattr(part, "_fields") else tuple(map(moved, part))
            return fn(part) if isinstance(part, Tensor) else part

        self._choices = fn(self._choices)
        self.tables = moved(self.tables)
        self._take_params()
        self._choose_engine()
        return self


_ASSIGNED = ("task", "choice", "episodes")


def seed_rule(seed: object) -> Rule:
    """The rule for seeds of environments."""
    return is_int(seed, 0, 2**63 - 1), f"seed must be an integer in [0, 2**63), got {seed!r}"
