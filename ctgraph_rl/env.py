"""CTGraphEnv: batched CT-graphs as a TorchRL environment, one row per task."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from ctgraph_rl import dynamics
from ctgraph_rl.checks import is_int, require, require_all
from ctgraph_rl.dynamics import ObservationParams, RewardParams, RowParams, RowState, Shown, TreeParams, Uses
from ctgraph_rl.graph import StateType
from ctgraph_rl.images import ImageSet
from ctgraph_rl.render import render
from ctgraph_rl.rewards import RewardFn
from ctgraph_rl.task import Task

PUBLIC_STATE = ("state_type", "node", "goal_leaf")
"""Fields of a row's state that are buffers under their own name; the others start with an underscore."""


class CTGraphEnv(EnvBase):
    """A batch of CT-graphs, ``batch_size=[len(tasks)]``; every row has a task of its own.

    A row's trajectory depends on (seed, row number, its actions) alone: rows 4..7 of a batch of eight equal a batch of
    four with ``first_row=4``. Rows may differ in every field of `Task` but the kind and size of the observations.

    Observation keys, for N rows:

    - ``observation``: uint8 [N, 1, r, r], or [N, K] when one-hot.
    - ``is_init``: bool [N, 1], True at the first observation of an episode.
    - ``step_count``: int64 [N, 1], steps taken in the episode. It reveals the phase: no policy should read it.
    - ``episode_reward``: float32 [N, 1], sum of the episode's rewards so far.
    - ``outcome``: uint8 [N, 1]: 0 running, 1 fail, 2 another end state, 3 the goal.
    - ``leaf``: int64 [N, 1], the end state arrived at, else -1.

    ``action`` is int64 [N]: 0 waits, 1..b decides; the home state takes any action, and an action above a row's own b
    fails as a wrong one does. ``reward`` is float32 [N, 1], paid on entering an end or fail state. These states are
    terminal, as in the paper; ``truncated`` is always False (wrap in TorchRL's ``StepCounter`` for a time limit).

    Buffers for tests and analysis, never in the data: ``state_type``, ``node``, ``goal_leaf``, ``observation_id``
    (int64 [N]). For planners, `get_state` and ``reset(TensorDict(state=...), set_state=True)`` save and restore rows.

    Args:
        tasks: one task per row; ``[task] * 512`` trains on one task.
        seed: decides all that is random in the rows, in [0, 2**63).
        first_row: number of the first row, for a batch that is split.
        task_pool: the tasks that `set_tasks` may be given; specs and images are fixed by it. Default: ``tasks``.
        device: where the tensors live.
        check_actions: refuse actions of a wrong shape, dtype or range, and steps of finished rows, with a
            ``ValueError``. False trusts them for speed.

    Raises:
        ValueError: for no tasks, values out of range, and observations of different shapes.
    """

    batch_locked = True

    _supports_set_state = True

    state_type: Tensor
    node: Tensor
    goal_leaf: Tensor
    observation_id: Tensor
    _seed_key: Tensor
    _tick: Tensor
    _episodes_left: Tensor
    _row: Tensor
    _bank: Tensor
    _normal_table: Tensor

    def __init__(
        self,
        tasks: Iterable[Task],
        seed: int = 0,
        first_row: int = 0,
        task_pool: Iterable[Task] | None = None,
        device: torch.device | str = "cpu",
        check_actions: bool = True,
    ) -> None:
        tasks = require_all(Task, "tasks", tasks)
        pool = tuple(dict.fromkeys(tasks if task_pool is None else require_all(Task, "task_pool", task_pool)))
        num_rows = len(tasks)
        require(
            _seed_rule(seed),
            (isinstance(check_actions, bool), f"check_actions must be true or false, got {check_actions!r}"),
            (is_int(first_row, 0, 2**32 - num_rows), f"rows must be numbered in [0, 2**32), got {first_row=}"),
        )
        super().__init__(device=device, batch_size=torch.Size([num_rows]))
        self.check_actions = check_actions
        self._pool = frozenset(pool)
        self._max_branching = max(task.graph.branching_factor for task in pool)
        self._image_shape, self._bank_start, bank = _shared_bank(pool, num_rows)
        self._make_specs()
        self._register_state(seed)
        self.register_buffer("_row", torch.arange(first_row, first_row + num_rows, device=self.device))
        self.register_buffer("_bank", bank.to(self.device), persistent=False)
        self.register_buffer("_normal_table", dynamics.normal_table().to(self.device), persistent=False)
        self.set_tasks(tasks)

    def _make_specs(self) -> None:
        n, device = self.batch_size[0], self.device
        one_hot = len(self._image_shape) == 1
        self.observation_spec = Composite(
            observation=Bounded(0, 1 if one_hot else 255, shape=(n, *self._image_shape), dtype=torch.uint8),
            is_init=Binary(1, shape=(n, 1), dtype=torch.bool),
            step_count=Unbounded(shape=(n, 1), dtype=torch.int64),
            episode_reward=Unbounded(shape=(n, 1), dtype=torch.float32),
            outcome=Bounded(dynamics.OUTCOME_RUNNING, dynamics.OUTCOME_GOAL, shape=(n, 1), dtype=torch.uint8),
            leaf=Unbounded(shape=(n, 1), dtype=torch.int64),
            shape=(n,),
            device=device,
        )
        self.action_spec = Categorical(self._max_branching + 1, shape=(n,), dtype=torch.int64, device=device)
        self.reward_spec = Unbounded(shape=(n, 1), dtype=torch.float32, device=device)
        flag = Binary(1, shape=(n, 1), dtype=torch.bool, device=device)
        self.full_done_spec = Composite(
            done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=(n,), device=device
        )

    def _register_state(self, seed: int) -> None:
        self.register_buffer("_seed_key", torch.tensor(seed, device=self.device))
        zeros = torch.zeros(self.batch_size, dtype=torch.int64, device=self.device)
        for field in RowState._fields:
            dtype = torch.float32 if field in ("episode_reward", "reward") else torch.int64
            self.register_buffer(_buffer(field), zeros.to(dtype, copy=True))
        self.register_buffer("observation_id", zeros)

    def set_tasks(self, tasks: Iterable[Task]) -> None:
        """Give every row a task, in place. All episodes end: `reset` before the next step.

        Args:
            tasks: one task of the pool per row.

        Raises:
            ValueError: if the number of tasks is not the number of rows, or a task is not in the pool.
        """
        tasks = require_all(Task, "tasks", tasks)
        different = tuple(dict.fromkeys(tasks))
        unknown = [task for task in different if task not in self._pool]
        n = self.batch_size[0]
        require(
            (len(tasks) == n, f"set_tasks needs one task per row, {n} in all, got {len(tasks)}"),
            (not unknown, f"set_tasks got tasks that are not in task_pool: {unknown[:3]}; name them at construction"),
        )
        self.tasks = tasks
        number = {task: i for i, task in enumerate(different)}
        index = torch.tensor([number[task] for task in self.tasks], device=self.device)

        def rows(values: Sequence[Any], dtype: torch.dtype = torch.int64) -> Tensor:
            return torch.tensor(values, dtype=dtype, device=self.device).index_select(0, index)

        self._params, self._uses = self._make_params(different, rows)
        self._task_goals = rows([task.goal_leaf for task in different])
        self._begin()

    def set_goals(self, goals: Iterable[Sequence[int]] | Tensor) -> None:
        """Give every row a goal at any time, in the middle of an episode too; the tree and all else stay.

        ``goal_leaf`` changes and ``tasks`` does not: `set_tasks` and `set_seed` go back to the tasks' own goals.

        Args:
            goals: for every row its decisions in 1..b, or the numbers of end states, int64 [N].

        Raises:
            ValueError: if a goal is not one of its row's tree.
        """
        if not isinstance(goals, Tensor):
            goals = list(goals)
            n = len(self.tasks)
            require((len(goals) == n, f"set_goals needs one goal per row, {n} in all, got {len(goals)}"))
            changed = [replace(task, goal=goal) for task, goal in zip(self.tasks, map(tuple, goals), strict=True)]
            goals = torch.tensor([task.goal_leaf for task in changed], device=self.device)
        fits = goals.shape == self.batch_size and goals.dtype == torch.int64
        require((fits, f"goals must be int64 of shape {list(self.batch_size)}, got {goals.dtype} {list(goals.shape)}"))
        outside = (goals < 0) | (goals >= self._params.g.num_leaves)
        require((not outside.any(), f"goals must be end states of the rows' trees, got {goals[outside][:5].tolist()}"))
        self.goal_leaf.copy_(goals)

    def _make_params(self, tasks: tuple[Task, ...], rows: Callable[..., Tensor]) -> tuple[RowParams, Uses]:
        """The rows' parameters from their different tasks, and what they have use for."""
        reward_fns = tuple(dict.fromkeys(task.reward_fn for task in tasks))
        params = self._row_params(
            self._tree_params(tasks, rows),
            self._observation_params(tasks, rows),
            self._reward_params(tasks, rows, reward_fns),
        )
        observations = [task.observations for task in tasks]
        waits = any(task.graph.wait_prob > 0 for task in tasks)
        views = any(_num_views(task) > 1 for task in tasks)
        uses = Uses(
            draws=waits or views or any(x.draws_ids for x in observations),
            pixel_noise=any(x.read_noise for x in observations),
            reward_noise=any(task.reward_std for task in tasks),
            reward_cue=any(x.reward_cue for x in observations),
            goal_change=any(task.goal_change for task in tasks),
            max_depth=max(task.graph.depth for task in tasks),
            reward_fns=reward_fns,
        )
        return params, uses

    def _tree_params(self, tasks: tuple[Task, ...], rows: Callable[..., Tensor]) -> TreeParams:
        graphs = [task.graph for task in tasks]
        return TreeParams(
            branching_factor=rows([graph.branching_factor for graph in graphs]),
            first_leaf=rows([graph.num_decision_states for graph in graphs]),
            stay_below=rows([int(graph.wait_prob * 2**63) for graph in graphs]),
        )

    def _observation_params(self, tasks: tuple[Task, ...], rows: Callable[..., Tensor]) -> ObservationParams:
        observations = [task.observations for task in tasks]
        first_leaves = [task.graph.num_decision_states for task in tasks]
        return ObservationParams(
            first_id=rows([[x.ids(kind)[0] for kind in StateType] for x in observations]),
            num_ids=rows([[x.ids(kind)[1] - x.ids(kind)[0] + 1 for kind in StateType] for x in observations]),
            unique=rows([[x.is_unique(kind) for kind in StateType] for x in observations], torch.bool),
            node_offset=rows([[leaf * (kind == StateType.END) for kind in StateType] for leaf in first_leaves]),
            bank_start=rows([self._bank_start[_bank_key(task)] for task in tasks]),
            num_views=rows([_num_views(task) for task in tasks]),
            read_noise=rows([x.read_noise for x in observations]),
            reward_cue=rows([x.reward_cue for x in observations], torch.bool),
        )

    def _reward_params(
        self, tasks: tuple[Task, ...], rows: Callable[..., Tensor], reward_fns: tuple[RewardFn, ...]
    ) -> RewardParams:
        changes = [task.goal_change or (0, 0) for task in tasks]
        return RewardParams(
            depth=rows([task.graph.depth for task in tasks]),
            num_leaves=rows([task.graph.num_end_states for task in tasks]),
            reward_fn=rows([reward_fns.index(task.reward_fn) for task in tasks]),
            goal_reward=rows([task.goal_reward for task in tasks], torch.float32),
            fail_reward=rows([task.fail_reward for task in tasks], torch.float32),
            step_reward=rows([task.step_reward for task in tasks], torch.float32),
            reward_std=rows([task.reward_std for task in tasks], torch.float32),
            multiplicative=rows([task.reward_noise == "multiplicative" for task in tasks], torch.bool),
            change_first=rows([first for first, _ in changes]),
            change_last=rows([last for _, last in changes]),
        )

    @property
    def branching_factor(self) -> Tensor:
        """b of each row, int64 [N]."""
        return self._params.tree.branching_factor

    @property
    def first_leaf(self) -> Tensor:
        """Heap index of each row's first end state, int64 [N]: ``node - first_leaf`` is the number of an end state."""
        return self._params.tree.first_leaf

    @property
    def num_end_states(self) -> Tensor:
        """b^d of each row, int64 [N]."""
        return self._params.g.num_leaves

    @property
    def max_depth(self) -> int:
        """The largest depth of the rows."""
        return self._uses.max_depth

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> CTGraphEnv:
        """Move what is no buffer along with the buffers."""
        super()._apply(fn, recurse)
        old = self._params
        self._params = self._row_params(
            TreeParams(*map(fn, old.tree)), ObservationParams(*map(fn, old.x)), RewardParams(*map(fn, old.g))
        )
        return self

    def _row_params(self, tree: TreeParams, x: ObservationParams, g: RewardParams) -> RowParams:
        return RowParams(self._seed_key, self._row, tree, x, g, self._bank, self._normal_table)

    def _state(self) -> RowState:
        return RowState(*(getattr(self, _buffer(field)) for field in RowState._fields))

    def _keep(self, state: RowState) -> None:
        for field, value in zip(RowState._fields, state, strict=True):
            getattr(self, _buffer(field)).copy_(value)

    def get_state(self) -> TensorDict:
        """A copy of the rows' states, to go back to with ``reset(TensorDict(state=state), set_state=True)``.

        It holds the hidden Markov state: a planner may see it, a policy may not. Rows of it may be put in any order, to
        branch several rows off one; their further randomness is that of their own row numbers. With a ``_reset`` mask,
        give a clone: TorchRL writes into the TensorDict of a partial reset.
        """
        fields = {field: value.clone() for field, value in self._state()._asdict().items()}
        return TensorDict(fields, batch_size=self.batch_size, device=self.device)

    def _reset(self, tensordict: TensorDictBase | None = None, set_state: bool = False, **kwargs: Any) -> TensorDict:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        resets = torch.ones_like(self.state_type, dtype=torch.bool) if mask is None else mask.view(-1)
        if set_state:
            given = self._given_state(tensordict)
            state = RowState(*(torch.where(resets, new, old) for old, new in zip(self._state(), given, strict=True)))
            shown = dynamics.show(state, self._params, self._uses)
        else:
            state, shown = dynamics.reset(self._state(), resets, self._params, self._uses)
        self._keep(state)
        return self._data(state, shown, is_init=(state.step_count == 0) & resets)

    def _given_state(self, tensordict: TensorDictBase | None) -> RowState:
        """The state to go back to; refuses what no state of the rows' trees can be."""
        given = TensorDict() if tensordict is None else tensordict.get("state", TensorDict())
        complete = set(RowState._fields) <= set(given.keys())
        require((complete, "set_state=True needs the rows' state under 'state', as get_state() gives it"))
        state = RowState(*(given[field] for field in RowState._fields))
        nodes, leaves = self.first_leaf + self.num_end_states, self.num_end_states
        running = (state.state_type >= StateType.HOME) & (state.state_type <= StateType.DECISION)
        inside = (state.node >= 0) & (state.node < nodes) & (state.goal_leaf >= 0) & (state.goal_leaf < leaves)
        wrong = (~(running & inside)).nonzero().flatten()[:5].tolist()
        require((not wrong, f"rows {wrong} of the given state are finished or no states of their trees"))
        return state

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        action = tensordict.get("action", None)
        if self.check_actions:
            self._check(action)
        state, shown = dynamics.step(self._state(), action, self._params, self._uses)
        self._keep(state)
        data = self._data(state, shown, is_init=torch.zeros_like(shown.done))
        return data.set("reward", state.reward.unsqueeze(-1).clone())

    def _data(self, state: RowState, shown: Shown, is_init: Tensor) -> TensorDict:
        """Observation, book-keeping and done flags; nothing shares memory with the buffers."""
        self.observation_id.copy_(shown.observation_id)
        done = shown.done.unsqueeze(-1)
        return TensorDict(
            {
                "observation": shown.observation,
                "is_init": is_init.unsqueeze(-1),
                "step_count": state.step_count.unsqueeze(-1).clone(),
                "episode_reward": state.episode_reward.unsqueeze(-1).clone(),
                "outcome": shown.outcome.unsqueeze(-1),
                "leaf": shown.leaf.unsqueeze(-1),
                "done": done,
                "terminated": done.clone(),
                "truncated": torch.zeros_like(done),
            },
            batch_size=self.batch_size,
            device=self.device,
        )

    def render(self, size: int = 192) -> Tensor:
        """A picture of every row: the observation, and the tree with position and goal.

        TorchRL's ``PixelRenderTransform`` and ``VideoRecorder`` make videos of it.

        Args:
            size: height in pixels, at least 48.

        Returns:
            uint8 [N, size, 2 * size, 3] on the CPU.
        """
        shown = dynamics.show(self._state(), self._params, self._uses)
        return render(self.tasks, self.state_type, self.node, self.goal_leaf, shown.observation, size)

    def _check(self, action: Tensor) -> None:
        spec = f"action must be int64 of shape {list(self.batch_size)} with values in 0..{self._max_branching}"
        require((action is not None, f"{spec}, got none: a policy must write it before a step"))
        require(
            (action.dtype == torch.int64, f"{spec}, got dtype {action.dtype}"),
            (action.shape == self.batch_size, f"{spec}, got shape {list(action.shape)}"),
        )
        outside = (action < 0) | (action > self._max_branching)
        finished = self.state_type >= StateType.END
        if (outside | finished).any():
            require(
                (not outside.any(), f"{spec}, got {action[outside][:5].tolist()}"),
                (not finished.any(), f"rows {finished.nonzero().flatten()[:5].tolist()} are done: reset them first"),
            )

    def _set_seed(self, seed: int | None) -> None:
        """Start all rows anew with another seed and their tasks' goals; the next `reset` gives their first episodes."""
        require(_seed_rule(seed))
        self._seed_key.fill_(seed)  # type: ignore[arg-type]
        self._tick.zero_()
        self._begin()

    def _begin(self) -> None:
        """End all episodes; the next one of every row is the first with its task's goal."""
        self.goal_leaf.copy_(self._task_goals)
        self.state_type.fill_(int(StateType.FAIL))
        self._episodes_left.zero_()


def _seed_rule(seed: object) -> tuple[bool, str]:
    return is_int(seed, 0, 2**63 - 1), f"seed must be an integer in [0, 2**63), got {seed!r}"


def _buffer(field: str) -> str:
    return field if field in PUBLIC_STATE else f"_{field}"


def _num_views(task: Task) -> int:
    """Bank rows that one id of a task has."""
    return task.images.num_variants * (task.observations.read_rotation + 1)


def _bank_key(task: Task) -> tuple[ImageSet, int]:
    return task.images, task.observations.read_rotation


def _require_memory(pool: tuple[Task, ...], bytes_each: int, num_rows: int) -> None:
    """Refuse image sets and observations that cannot be held, before anything is allocated; POSIX systems only."""
    if not hasattr(os, "sysconf"):
        return
    sets = dict.fromkeys(map(_bank_key, pool))
    images_held = sum(images.num_images * images.num_variants * (rotation + 1) for images, rotation in sets)
    needed = bytes_each * (images_held + 2 * num_rows)  # a step holds two observations of every row
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    message = f"images and observations need {needed:,} bytes, this machine has {memory:,}; use fewer images or rows"
    require((needed < memory, message))


def _shared_bank(
    pool: tuple[Task, ...], num_rows: int
) -> tuple[tuple[int, ...], dict[tuple[ImageSet, int], int], Tensor]:
    """One bank with each different image set of the pool once.

    Returns:
        The shape of an observation, the first row of each image set and rotation, and uint8 [rows, *shape].
    """
    shapes = list(dict.fromkeys(task.images.shape for task in pool))
    one_hot = all(len(shape) == 1 for shape in shapes)
    require((one_hot or len(shapes) == 1, f"all tasks of a batch must show observations of one shape, got {shapes}"))
    shape = max(shapes)
    _require_memory(pool, math.prod(shape), num_rows)
    banks, starts, rows = [], {}, 0
    for key in dict.fromkeys(map(_bank_key, pool)):
        images, rotation = key
        bank = images.bank(rotation)
        if one_hot:
            bank = torch.nn.functional.pad(bank, (0, shape[0] - bank.shape[1]))
        banks.append(bank)
        starts[key] = rows
        rows += len(bank)
    return shape, starts, banks[0] if len(banks) == 1 else torch.cat(banks)  # one may be large
