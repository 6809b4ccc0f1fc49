"""CTGraphEnv: batched CT-graphs as a TorchRL environment, one row per task."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch
from tensordict import LazyStackedTensorDict, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from typing_extensions import override

from ctgraph_rl.batch.assignment import one_hot_ids, require_num_ids
from ctgraph_rl.batch.native import Stepped
from ctgraph_rl.batch.rows import Rows
from ctgraph_rl.batch.specs import TASK_NUMBER, done_spec, make_specs, reward_spec
from ctgraph_rl.checks import one_of, require, require_all, takes_numbers, true_or_false
from ctgraph_rl.core import dynamics
from ctgraph_rl.core.device import checked_device
from ctgraph_rl.core.dynamics import NO_LEAF, RowState, Shown
from ctgraph_rl.core.goal import Goal
from ctgraph_rl.core.graph import StateType
from ctgraph_rl.core.tree import Swap, is_done
from ctgraph_rl.draw.pixels import render
from ctgraph_rl.tasks.kinds.gym_task import GymTask
from ctgraph_rl.tasks.kinds.task_like import ENVIRONMENTS
from ctgraph_rl.tasks.protocol import EPISODES
from ctgraph_rl.tasks.switch import Switch
from ctgraph_rl.tasks.task import Task

RowData = dict[str, Tensor]


class CTGraphEnv(EnvBase):
    """A batch of CT-graphs, ``batch_size=[len(tasks)]``, with a task per row.

    A row's trajectory depends only on seed, row number and actions: rows 4..7 of eight equal a batch of four with
    ``first_row=4``. Tasks may differ in all but kind and size of observations.

    Observation keys, for N rows:

    - ``observation``: uint8 [N, 1, r, r], or [N, K] when one-hot.
    - ``is_init``: bool [N, 1], True at the first observation of an episode.
    - ``step_count``: int64 [N, 1], steps of the episode. No policy should read it: it reveals the phase.
    - ``episode_reward``: float32 [N, 1], sum of the episode's rewards.
    - ``outcome``: uint8 [N, 1]: 0 running, 1 fail, 2 another end state, 3 the goal.
    - ``leaf``: int64 [N, 1], the end state reached, else -1.

    ``action`` is int64 [N]: 0 waits, 1..b decides. Home takes any action; one above a row's own b fails. ``reward`` is
    float32 [N, 1], paid on entering an end or fail state. These are terminal, as in the paper; ``truncated`` is always
    False (TorchRL's ``StepCounter`` adds a time limit).

    For tests and analysis, not in the data: ``state_type``, ``node``, ``goal_leaf``, ``observation_id``. For planners,
    `get_state` and ``reset(TensorDict(state=...), set_state=True)`` save and restore rows.

    Args:
        tasks: one task per row; ``[task] * 512`` trains on one task.
        seed: decides all that is random in the rows, in [0, 2**63).
        first_row: number of the first row, for a batch that is split.
        task_pool: tasks that `set_tasks` takes; it fixes specs and images. Default: ``tasks``.
        check_actions: refuse actions of a wrong shape, dtype or range, and steps of finished rows. On a GPU the check
            waits for the device at every step.
        noise_bank: 0, or the number of noises drawn in advance, as in `Rows`.
        task_ids: the id of each task, an integer >= 0. Observations then have ``task_id``, uint8 [N, num_task_ids]: the
            row's id as one-hot, zeros for a task without one.
        num_task_ids: length of ``task_id``; None: just enough.
        kernel: ``"auto"``, ``"off"`` or ``"required"``, as in `Rows`.
        info: False leaves out ``step_count``, ``episode_reward``, ``outcome``, ``leaf`` and ``truncated``, so that
            TorchRL copies less.
        episodes: ``"hidden"`` hides where episodes end, as `Protocol` says: without ``info``, done flags are False and
            ``is_init`` is True only after `reset`. ``ends`` has what is hidden of the last step, by key.

    Raises:
        ValueError: for no tasks, values out of range, different shapes of observations, and what a required kernel
            cannot run.

    Example:
        >>> from ctgraph_rl.tasks.configurations import ct_su_b1
        >>> env = CTGraphEnv([ct_su_b1(goal="1.1"), ct_su_b1(goal="1.2")], seed=0)
        >>> env.rollout(10)["observation"].shape[2:]
        torch.Size([1, 12, 12])
    """

    batch_locked = True

    _supports_set_state = True

    @takes_numbers
    def __init__(
        self,
        tasks: Iterable[Task],
        seed: int = 0,
        first_row: int = 0,
        task_pool: Iterable[Task] | None = None,
        device: torch.device | str = "cpu",
        check_actions: bool = True,
        noise_bank: int = 0,
        task_ids: Mapping[Task, int] | None = None,
        num_task_ids: int | None = None,
        kernel: str = "auto",
        info: bool = True,
        episodes: str = "shown",
    ) -> None:
        require(*true_or_false(check_actions=check_actions, info=info), *one_of(EPISODES, episodes=episodes))
        tasks = require_all(Task, "tasks", tasks)
        self.num_task_ids = require_num_ids(task_ids, num_task_ids)
        device = None if device is None else checked_device(device)
        super().__init__(device=device, batch_size=torch.Size([len(tasks)]))
        self.check_actions = check_actions
        self.hides_episodes = episodes == "hidden"
        self.info = info and not self.hides_episodes
        self.ends: RowData = {}
        self.rows = Rows(
            tasks, seed, first_row, task_pool=task_pool, device=self.device, noise_bank=noise_bank, kernel=kernel
        )
        numbers = torch.zeros(0, device=self.device, dtype=torch.int64)
        if task_ids is not None:
            numbers = numbers.new_tensor([task_ids.get(task, -1) for task in self.rows.pool])
        self.register_buffer("_id_of_task", numbers, persistent=False)
        self._task_id: tuple[Tensor | None, RowData] = None, {}
        self._steps: list[TensorDictBase] | None = None
        self._running: RowData = {}
        specs = make_specs(self.rows.examples, self.batch_size, self.num_task_ids, self.info)
        self.observation_spec = specs.observation.to(self.device)
        self.action_spec = specs.action.to(self.device)
        self.reward_spec = reward_spec(self.batch_size).to(self.device)
        self.full_done_spec = done_spec(self.batch_size, truncated=self.info).to(self.device)

    @property
    def tasks(self) -> tuple[Task, ...]:
        """The task of each row."""
        return self.rows.tasks

    def set_tasks(self, tasks: Iterable[Task], at_episode_end: bool = False) -> None:
        """Give every row a task of the pool, now or at its episode's end, as `Rows.set_tasks`."""
        self.rows.set_tasks(tasks, at_episode_end)

    def switch_tasks(self, tasks: Iterable[Task], switch: Switch, at_episode_end: bool = False) -> None:
        """Let rows change between tasks by the episode, as `Rows.switch_tasks`."""
        self.rows.switch_tasks(tasks, switch, at_episode_end)

    def set_goals(self, goals: Iterable[Goal] | Tensor) -> None:
        """Give every row a goal, as `Rows.set_goals`. An episode's outcome follows from its last goal."""
        self.rows.set_goals(goals)

    @property
    def state_type(self) -> Tensor:
        """The `StateType` of each row, int64 [N]."""
        return self.rows.state_type.long()

    @property
    def node(self) -> Tensor:
        """Each row's heap index in the tree, int64 [N]."""
        return self.rows.node.clone()

    @property
    def goal_leaf(self) -> Tensor:
        """Each row's end state with the goal, int64 [N]."""
        return self.rows.goal_leaf.clone()

    @property
    def observation_id(self) -> Tensor:
        """The id that each row shows, int64 [N]."""
        return self.rows.observation_id

    @property
    def branching_factor(self) -> Tensor:
        """b of each row, int64 [N]."""
        return self.rows.params.tree.branching_factor

    @property
    def swap(self) -> Swap | None:
        """The rows' swapped branches; None for no row."""
        return self.rows.params.tree.swap

    @property
    def first_leaf(self) -> Tensor:
        """Heap index of each row's first end state, int64 [N]; ``node - first_leaf`` numbers end states."""
        return self.rows.params.tree.first_leaf

    @property
    def num_end_states(self) -> Tensor:
        """b^d of each row, int64 [N]."""
        return self.rows.params.g.num_leaves

    @property
    def max_depth(self) -> int:
        """The largest depth of the rows."""
        return self.rows.uses.max_depth

    def get_state(self) -> TensorDict:
        """A copy of the rows' states for ``reset(TensorDict(state=state), set_state=True)``.

        It holds the hidden Markov state, which no policy may see. Rows may be reordered; their randomness follows their
        row numbers. With a ``_reset`` mask, give a clone: TorchRL writes into it.
        """
        fields = {field: value.clone() for field, value in self.rows.state._asdict().items()}
        return TensorDict(fields, batch_size=self.batch_size, device=self.device)

    def _reset(
        self, tensordict: TensorDictBase | None = None, set_state: bool = False, **kwargs: Any
    ) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        mask = None if mask is None else mask.view(-1)
        if set_state:
            self.rows.state = self._read_state(tensordict, mask)
            shown = self.rows.show()
        else:
            shown = self.rows.reset(mask)
        is_init = self.rows.step_count == 0
        is_init = is_init if mask is None else is_init & mask
        if self.hides_episodes:
            return self._tensordict(self._hide(shown) | {"is_init": is_init.unsqueeze(-1)})
        return self._tensordict(self._data(shown.observation, shown.done.unsqueeze(-1), is_init.unsqueeze(-1), shown))

    def _read_state(self, tensordict: TensorDictBase | None, mask: Tensor | None) -> RowState:
        given = TensorDict() if tensordict is None else tensordict.get("state", TensorDict())
        complete = set(RowState._fields) <= set(given.keys())
        require((complete, "set_state=True needs the rows' state under 'state', as get_state() gives it"))
        present = self.rows.state
        state = RowState(*(given[field].to(like.dtype) for field, like in zip(RowState._fields, present, strict=True)))
        nodes = self.first_leaf + self.num_end_states
        leaves = self.num_end_states
        kind = state.state_type
        is_leaf = state.node >= self.first_leaf
        running = (kind >= 0) & ~is_done(state, self.rows.params.tree)
        misplaced = ((kind == StateType.DECISION) & is_leaf) | ((kind == StateType.END) & ~is_leaf)
        misplaced = misplaced | ((kind == StateType.HOME) & (state.node != 0))
        inside = (state.node >= 0) & (state.node < nodes) & (state.goal_leaf >= 0) & (state.goal_leaf < leaves)
        counts = (state.tick >= 0) & (state.step_count >= 0) & (state.episodes_left >= 0)
        sound = running & inside & ~misplaced & counts
        sound = sound if mask is None else sound | ~mask
        wrong = (~sound).nonzero().flatten()[:5].tolist()
        require((not wrong, f"rows {wrong} of the given state are finished or no states of their trees"))
        if mask is None:
            return RowState(*(value.clone() for value in state))
        return dynamics.choose(mask, state, present)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        mask = tensordict.get("_step", None)
        mask = None if mask is None else mask.view(self.batch_size)
        return self._tensordict(self.step_data(tensordict.get("action", None), mask))

    def _step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """The standard method with equal data, without asking whether rows are done and without a merge."""
        if "_step" in tensordict or self.hides_episodes:
            return super()._step_and_maybe_reset(tensordict)
        tensordict = self.step(tensordict.to(self.device) if tensordict.device != self.device else tensordict)
        tensordict_ = self._step_mdp(tensordict)
        if self._post_step_mdp_hooks is not None:
            tensordict, tensordict_ = self._post_step_mdp_hooks(tensordict, tensordict_)
        done = tensordict.get(("next", "done"))
        for key, value in _own(self.restart_data(done.clone(), tensordict.get(("next", "observation")))).items():
            tensordict_.set(key, value)
        return tensordict, tensordict_

    def rollout(self, *args: Any, **kwargs: Any) -> TensorDictBase:
        """`EnvBase.rollout` with the same data, [N, T], in time-major memory, which is faster to fill.

        ``reshape`` then copies, and ``view`` refuses to merge rows and steps. Memory is row-major for
        ``return_contiguous=True``, ``out`` and ``set_truncated``.
        """
        row_major = kwargs.get("out") is not None or kwargs.get("set_truncated")
        if row_major or kwargs.get("return_contiguous", False) is not False:
            return super().rollout(*args, **kwargs)
        steps: list[TensorDictBase] = []
        outer = self._steps
        self._steps = steps
        try:
            stacked = super().rollout(*args, **kwargs)
        finally:
            self._steps = outer
        data = LazyStackedTensorDict.maybe_dense_stack(steps, 0).transpose(0, 1)
        return data.refine_names(*stacked.names)

    def _rollout_nonstop(self, **kwargs: Any) -> list[TensorDictBase]:
        return self._keep_steps(super()._rollout_nonstop(**kwargs))

    def _rollout_stop_early(self, **kwargs: Any) -> list[TensorDictBase]:
        return self._keep_steps(super()._rollout_stop_early(**kwargs))

    def _keep_steps(self, steps: list[TensorDictBase]) -> list[TensorDictBase]:
        if self._steps is None:
            return steps
        self._steps.extend(steps)
        return [step.empty() for step in steps[:1]]

    def step_data(self, action: Tensor | None, mask: Tensor | None = None) -> RowData:
        """Step all rows; return the data after the step by key, with ``reward``.

        Values may share memory with each other and the rows' state: do not write into them.

        Args:
            action: int64 [N].
            mask: bool [N], TorchRL's ``_step``: the rows to step. Others stay unchanged, draw nothing and have reward
                0.

        Raises:
            ValueError: for actions that ``check_actions`` refuses.
        """
        if self.hides_episodes:
            require((mask is None, "rows with hidden episodes step together: leave out _step"))
            over = self.rows.is_done
            if self.check_actions:
                self.rows.check_actions(action, ~over)
            seen = self.rows.step_or_reset(action, over)  # type: ignore[arg-type]
            return self._hide(seen) | {"reward": self.rows.reward.unsqueeze(-1)}
        if self.check_actions:
            self.rows.check_actions(action, mask)
        shown = self.rows.step(action, mask)  # type: ignore[arg-type]
        done = shown.done.unsqueeze(-1)
        reward = self.rows.reward
        is_init = torch.zeros_like(done)
        if mask is not None:
            is_init = (~mask & (self.rows.step_count == 0)).unsqueeze(-1)
            reward = reward * mask
        data = self._data(shown.observation, done, is_init, shown)
        data["reward"] = reward.unsqueeze(-1)
        return data

    def _hide(self, shown: Shown) -> RowData:
        ends = {"done": shown.done, "outcome": shown.outcome, "leaf": shown.leaf}
        ends |= {"step_count": self.rows.step_count, "episode_reward": self.rows.episode_reward}
        self.ends = {key: value.unsqueeze(-1) for key, value in ends.items()}
        never = torch.zeros_like(self.ends["done"])
        data = {"observation": shown.observation, "is_init": never, "done": never, "terminated": never}
        return data | self._show_ids() if self.num_task_ids else data

    def step_and_restart_data(self, action: Tensor | None) -> tuple[RowData, RowData]:
        """Return `step_data`, and `restart_data` for done rows; on CPUs in one call of the kernel."""
        rows = self.rows
        if self.hides_episodes:
            after = self.step_data(action)
            return after, {key: value for key, value in after.items() if key != "reward"}
        stepped = None
        if rows.uses_kernel and not rows.tasks_change:
            most = rows.max_branching if self.check_actions else -1
            stepped = rows.native.step_and_restart(rows.state, action, most)
        if stepped is None:  # also where an action is refused: here it is said why
            after = self.step_data(action)
            return after, self.restart_data(after["done"], after["observation"])
        rows.state, shown = stepped
        if not self._running:  # shared by all steps
            self._running = self._not_done()
        done = shown.done.unsqueeze(-1)
        rewards = shown.reward.unsqueeze(-1)
        after = {**self._data(shown.observation, done, self._running["done"], shown), "reward": rewards}
        return after, self._restart_data(shown.following, done, self._running)

    def restart_data(self, done: Tensor, observation: Tensor) -> RowData:
        """Start an episode in done rows; return the data that the next step starts from.

        Args:
            done: bool [N, 1], after the last step.
            observation: uint8 [N, *shape], after the last step.
        """
        return self._restart_data(self.rows.restart(done.squeeze(-1), observation), done, self._not_done())

    def _data(self, observation: Tensor, done: Tensor, is_init: Tensor, shown: Shown | Stepped) -> RowData:
        data = {"observation": observation, "is_init": is_init, "done": done, "terminated": done}
        if self.info:
            ends = {"outcome": shown.outcome.unsqueeze(-1), "leaf": shown.leaf.unsqueeze(-1)}
            data |= {**ends, "truncated": torch.zeros_like(done)}
        return data | self._counts(shown if isinstance(shown, Stepped) else self.rows)

    def _restart_data(self, observation: Tensor, is_init: Tensor, running: RowData) -> RowData:
        return {"observation": observation, "is_init": is_init, **running, **self._counts(self.rows)}

    def _not_done(self) -> RowData:
        false = torch.zeros_like(self.rows.row, dtype=torch.bool).unsqueeze(-1)
        data = {"done": false, "terminated": false}
        if self.info:
            leaf = torch.full_like(self.rows.row, NO_LEAF).unsqueeze(-1)
            data |= {"outcome": false.to(torch.uint8), "leaf": leaf, "truncated": false.clone()}
        return data

    def _counts(self, counts: Rows | Stepped) -> RowData:
        keys = ("step_count", "episode_reward") if self.info else ()
        data = {key: getattr(counts, key).unsqueeze(-1) for key in keys}
        return data | self._show_ids() if self.num_task_ids else data

    def _show_ids(self) -> RowData:
        """Return the rows' task ids, one-hot and as numbers, by key; the same tensors until tasks change."""
        task, shown = self._task_id
        if task is not self.rows.task:
            ids = self._id_of_task.index_select(0, self.rows.task)
            shown = {"task_id": one_hot_ids(ids, self.num_task_ids), TASK_NUMBER: ids.unsqueeze(-1)}
            self._task_id = self.rows.task, shown
        return shown

    def _tensordict(self, data: RowData) -> TensorDict:
        return TensorDict(_own(data), batch_size=self.batch_size, device=self.device)

    def render(self, size: int = 192) -> Tensor:
        """A picture of every row: the observation, and the tree with position and goal.

        TorchRL's ``PixelRenderTransform`` and ``VideoRecorder`` make videos of it.

        Args:
            size: height, at least 48.

        Returns:
            uint8 [N, size, 2 * size, 3] on the CPU.
        """
        observation = self.rows.show().observation
        return render(self.tasks, self.state_type, self.node, self.goal_leaf, observation, size=size)

    @takes_numbers
    @override
    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        return super().set_seed(seed, static_seed)

    def _set_seed(self, seed: int | None) -> None:
        self.rows.set_seed(seed)  # type: ignore[arg-type]


_SHARED = ("is_init", "terminated", "step_count", "episode_reward", "reward", "task_id", TASK_NUMBER)


def _own(data: RowData) -> RowData:
    return {key: value.clone() if key in _SHARED else value for key, value in data.items()}


def _make_gym_env(tasks: Sequence[GymTask], seed: int = 0, **settings: Any) -> EnvBase:
    from ctgraph_rl.batch.gym_env import GymEnv  # importing Gymnasium takes a tenth of a second

    return GymEnv(tasks, seed, **settings)


ENVIRONMENTS[Task] = CTGraphEnv
ENVIRONMENTS[GymTask] = _make_gym_env
