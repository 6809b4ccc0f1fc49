"""CTGraphEnv: batched CT-graphs as a TorchRL environment, one row per task."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from ctgraph_rl import dynamics
from ctgraph_rl.checks import is_int, require
from ctgraph_rl.dynamics import ObservationParams, State, TreeParams
from ctgraph_rl.graph import StateType
from ctgraph_rl.observations import ImageSet
from ctgraph_rl.rewards import RewardFn
from ctgraph_rl.task import Task

OUTCOME_RUNNING, OUTCOME_FAIL, OUTCOME_OTHER_END, OUTCOME_GOAL = range(4)
"""Values of ``("next", "outcome")``. Success means `OUTCOME_GOAL`, never a reward threshold."""

NO_LEAF = -1
"""Value of ``("next", "leaf")`` for a row that has not arrived at an end state."""


class RewardParams(NamedTuple):
    """What the reward needs to know of each row's task; [N]."""

    goal_leaf: Tensor  # int64
    depth: Tensor  # int64
    goal_reward: Tensor  # float32
    fail_reward: Tensor  # float32
    reward_fn: Tensor  # int64: which of the environment's different reward functions


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

    Buffers for tests and analysis, never in the data: ``state_type``, ``node``, ``observation_id`` (int64 [N]).

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

    state_type: Tensor
    node: Tensor
    observation_id: Tensor
    _seed_key: Tensor
    _row: Tensor
    _tick: Tensor
    _step_count: Tensor
    _episode_reward: Tensor
    _zeros: Tensor
    _bank: Tensor

    def __init__(
        self,
        tasks: Iterable[Task],
        seed: int = 0,
        first_row: int = 0,
        task_pool: Iterable[Task] | None = None,
        device: torch.device | str = "cpu",
        check_actions: bool = True,
    ) -> None:
        tasks = tuple(tasks)
        pool = tuple(dict.fromkeys(tasks if task_pool is None else task_pool))
        num_rows = len(tasks)
        require(
            (num_rows > 0, "tasks must hold at least one task, got none"),
            (len(pool) > 0, "task_pool must hold at least one task, got none"),
            _seed_rule(seed),
            (is_int(first_row, 0, 2**32 - num_rows), f"rows must be numbered in [0, 2**32), got {first_row=}"),
        )
        super().__init__(device=device, batch_size=torch.Size([num_rows]))
        self.check_actions = check_actions
        self._pool = frozenset(pool)
        self._max_branching = max(task.graph.branching_factor for task in pool)
        self._image_shape, self._bank_start, bank = _shared_bank(pool)
        self._make_specs()
        self._register_state(seed, first_row)
        self.register_buffer("_bank", bank.to(self.device), persistent=False)
        self.set_tasks(tasks)

    def _make_specs(self) -> None:
        n, device = self.batch_size[0], self.device
        one_hot = len(self._image_shape) == 1
        self.observation_spec = Composite(
            observation=Bounded(0, 1 if one_hot else 255, shape=(n, *self._image_shape), dtype=torch.uint8),
            is_init=Binary(1, shape=(n, 1), dtype=torch.bool),
            step_count=Unbounded(shape=(n, 1), dtype=torch.int64),
            episode_reward=Unbounded(shape=(n, 1), dtype=torch.float32),
            outcome=Bounded(OUTCOME_RUNNING, OUTCOME_GOAL, shape=(n, 1), dtype=torch.uint8),
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

    def _register_state(self, seed: int, first_row: int) -> None:
        n, device = self.batch_size[0], self.device
        zeros = torch.zeros(n, dtype=torch.int64, device=device)
        self.register_buffer("_seed_key", torch.tensor(seed, device=device))
        self.register_buffer("_row", zeros + torch.arange(first_row, first_row + n, device=device))
        self.register_buffer("_tick", zeros.clone())
        self.register_buffer("state_type", zeros.clone())
        self.register_buffer("node", zeros.clone())
        self.register_buffer("observation_id", zeros.clone())
        self.register_buffer("_step_count", zeros.clone())
        self.register_buffer("_episode_reward", torch.zeros(n, device=device))
        self.register_buffer("_zeros", zeros, persistent=False)

    def set_tasks(self, tasks: Iterable[Task]) -> None:
        """Give every row a task, in place. All episodes end: `reset` before the next step.

        Args:
            tasks: one task of the pool per row.

        Raises:
            ValueError: if the number of tasks is not the number of rows, or a task is not in the pool.
        """
        tasks = tuple(tasks)
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

        self._fill_params(different, rows)
        self.state_type.fill_(int(StateType.FAIL))

    def _fill_params(self, tasks: tuple[Task, ...], rows: Callable[..., Tensor]) -> None:
        graphs, observations = [task.graph for task in tasks], [task.observations for task in tasks]
        self._tree = TreeParams(
            branching_factor=rows([graph.branching_factor for graph in graphs]),
            first_leaf=rows([graph.num_decision_states for graph in graphs]),
            stay_below=rows([int(graph.wait_prob * 2**63) for graph in graphs]),
        )
        self._x = ObservationParams(
            first_id=rows([[x.ids(kind)[0] for kind in StateType] for x in observations]),
            num_ids=rows([[x.ids(kind)[1] - x.ids(kind)[0] + 1 for kind in StateType] for x in observations]),
            unique=rows([[x.is_unique(kind) for kind in StateType] for x in observations], torch.bool),
            node_offset=rows(
                [[(kind == StateType.END) * graph.num_decision_states for kind in StateType] for graph in graphs]
            ),
            bank_start=rows([self._bank_start[_bank_key(task)] for task in tasks]),
            num_angles=rows([x.read_rotation + 1 for x in observations]),
            read_noise=rows([x.read_noise for x in observations]),
        )
        self._reward_fns: tuple[RewardFn, ...] = tuple(dict.fromkeys(task.reward_fn for task in tasks))
        self._g = RewardParams(
            goal_leaf=rows([task.goal_leaf for task in tasks]),
            depth=rows([graph.depth for graph in graphs]),
            goal_reward=rows([task.goal_reward for task in tasks], torch.float32),
            fail_reward=rows([task.fail_reward for task in tasks], torch.float32),
            reward_fn=rows([self._reward_fns.index(task.reward_fn) for task in tasks]),
        )
        waits = any(graph.wait_prob > 0 for graph in graphs)
        self._draws = waits or any(x.draws_ids or x.read_rotation for x in observations)
        self._noisy = any(x.read_noise for x in observations)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> CTGraphEnv:
        """Move the rows' parameters along with the buffers."""
        super()._apply(fn, recurse)
        self._tree, self._x = TreeParams(*map(fn, self._tree)), ObservationParams(*map(fn, self._x))
        self._g = RewardParams(*map(fn, self._g))
        return self

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDict:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        resets = torch.ones_like(self.state_type, dtype=torch.bool) if mask is None else mask.view(-1)
        self._tick.add_(resets)
        self.state_type.masked_fill_(resets, int(StateType.HOME))
        for buffer in (self.node, self._step_count, self._episode_reward):
            buffer.masked_fill_(resets, 0)
        return self._data(self._words(), is_init=resets)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        action = tensordict.get("action", None)
        if self.check_actions:
            self._check(action)
        self._tick.add_(1)
        words = self._words()
        before = State(self.state_type, self.node)
        after = dynamics.transition(before, action, dynamics.stays(words, self._tree), self._tree)
        reward = self._reward(before.state_type, after)
        self.state_type.copy_(after.state_type)
        self.node.copy_(after.node)
        self._step_count.add_(1)
        self._episode_reward.add_(reward)
        data = self._data(words, is_init=torch.zeros_like(self.state_type, dtype=torch.bool))
        return data.set("reward", reward.unsqueeze(-1))

    def _words(self) -> tuple[Tensor, ...]:
        """The row's random words at its tick; zeros where no row of the batch has any use for them."""
        if not self._draws:
            return (self._zeros,) * 4
        return dynamics.draw(self._seed_key, self._row, self._tick, dynamics.STREAM_STEP)

    def _reward(self, before: Tensor, after: State) -> Tensor:
        """float32 [N]: what is paid on entering an end or a fail state."""
        leaf, tree, g = after.node - self._tree.first_leaf, self._tree, self._g
        share = torch.zeros_like(g.goal_reward)
        for i, reward_fn in enumerate(self._reward_fns):
            paid = reward_fn(leaf, g.goal_leaf, tree.branching_factor, g.depth)
            share = torch.where(g.reward_fn == i, paid, share)
        entered = after.state_type != before
        at_end = entered & (after.state_type == StateType.END)
        failed = entered & (after.state_type == StateType.FAIL)
        return torch.where(at_end, share * g.goal_reward, torch.where(failed, g.fail_reward, 0.0))

    def _data(self, words: tuple[Tensor, ...], is_init: Tensor) -> TensorDict:
        """What the rows show now: observation, book-keeping and done flags."""
        at_end, failed = self.state_type == StateType.END, self.state_type == StateType.FAIL
        leaf = torch.where(at_end, self.node - self._tree.first_leaf, NO_LEAF)
        arrived = torch.where(leaf == self._g.goal_leaf, OUTCOME_GOAL, OUTCOME_OTHER_END)
        outcome = torch.where(at_end, arrived, torch.where(failed, OUTCOME_FAIL, OUTCOME_RUNNING))
        done = (at_end | failed).unsqueeze(-1)
        return TensorDict(
            {
                "observation": self._observe(words),
                "is_init": is_init.unsqueeze(-1),
                "step_count": self._step_count.unsqueeze(-1).clone(),
                "episode_reward": self._episode_reward.unsqueeze(-1).clone(),
                "outcome": outcome.to(torch.uint8).unsqueeze(-1),
                "leaf": leaf.unsqueeze(-1),
                "done": done,
                "terminated": done.clone(),
                "truncated": torch.zeros_like(done),
            },
            batch_size=self.batch_size,
            device=self.device,
        )

    def _observe(self, words: tuple[Tensor, ...]) -> Tensor:
        state = State(self.state_type, self.node)
        self.observation_id.copy_(dynamics.observation_id(state, words[2], self._x))
        images = dynamics.read_images(self._bank, self.observation_id, words[3], self._x)
        if not self._noisy:
            return images
        return dynamics.add_noise(images, self._seed_key, self._row, self._tick, self._x.read_noise)

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
        """Start all rows anew with another seed; the next `reset` gives their first episodes."""
        require(_seed_rule(seed))
        self._seed_key.fill_(seed or 0)
        self._tick.zero_()


def _seed_rule(seed: object) -> tuple[bool, str]:
    return is_int(seed, 0, 2**63 - 1), f"seed must be an integer in [0, 2**63), got {seed!r}"


def _bank_key(task: Task) -> tuple[ImageSet, int]:
    return task.images, task.observations.read_rotation


def _shared_bank(pool: tuple[Task, ...]) -> tuple[tuple[int, ...], dict[tuple[ImageSet, int], int], Tensor]:
    """One bank with each different image set of the pool once.

    Returns:
        The shape of an observation, the first row of each image set and rotation, and uint8 [rows, *shape].
    """
    shapes = list(dict.fromkeys(task.images.shape for task in pool))
    one_hot = all(len(shape) == 1 for shape in shapes)
    require((one_hot or len(shapes) == 1, f"all tasks of a batch must show observations of one shape, got {shapes}"))
    shape = max(shapes)
    banks, starts, rows = [], {}, 0
    for key in dict.fromkeys(map(_bank_key, pool)):
        images, rotation = key
        bank = images.bank(rotation)
        if one_hot:
            bank = torch.nn.functional.pad(bank, (0, shape[0] - bank.shape[1]))
        banks.append(bank)
        starts[key] = rows
        rows += len(bank)
    return shape, starts, torch.cat(banks)
