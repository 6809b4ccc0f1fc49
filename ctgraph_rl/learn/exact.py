"""Exact mean return, success rate, end rate and length of a policy on a CT-graph, without episodes.

A policy without memory is a table by image, valued by backward induction (`ctgraph_rl.tasks.values`). With memory, all
histories are played at once with their probabilities; without noise on reading, they are finitely many. They branch at
decisions, at waits and where images are drawn, as an action that fails ends an episode.

Where waits are drawn (p > 0), stays of a probability below `LEAST_STAY` are left out, which changes a success rate by
less than (d + 1) times that.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import one_hot
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ctgraph_rl.batch.specs import TASK_NUMBER
from ctgraph_rl.checks import Rule, fraction, require, takes_numbers
from ctgraph_rl.core.graph import WAIT_ACTION, StateType
from ctgraph_rl.learn.collect import PREVIOUS_ACTION, TRIAL, InitialState, Step
from ctgraph_rl.learn.logits_policy import as_policy
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.exactness import INSTEAD, MOST_HISTORIES, count_histories, longest_stay, num_views, task_rules
from ctgraph_rl.tasks.kinds.task_like import TaskLike
from ctgraph_rl.tasks.memory import bank_key, make_bank
from ctgraph_rl.tasks.task import Task, are_graphs
from ctgraph_rl.tasks.values import Measures, end_rewards, policy_measures

HISTORIES_AT_ONCE = 2**15

ActionProbs = Callable[[Tensor], Tensor]
"""Maps images, uint8 [n, *shape], to action probabilities, float [n, A], or to actions, int64 [n]."""


@torch.no_grad()
def exact_measures(
    policy: Any,
    task: TaskLike,
    *,
    greedy: bool,
    initial_state: InitialState | None = None,
    task_id: Tensor | None = None,
    shape: Sequence[int] | None = None,
    gamma: float = 1.0,
) -> Measures:
    """Return the exact measures of a policy on a task, without torch's global generator.

    Args:
        policy: has ``action_probs``, see `ctgraph_rl.agent.Agent`.
        task: a CT-graph for which `exact_rules` hold.
        greedy: take the most likely actions; False samples and explores as in training.
        initial_state: gives a recurrent policy's state for a number of rows; None or empty: no memory.
        task_id: one-hot, uint8 [num_task_ids], where the protocol shows ids.
        shape: of observations, where vectors are padded; None: the task's.
        gamma: discount of the return, in [0, 1].

    Raises:
        ValueError: lists the reasons why there are no exact measures.
    """
    shown = ShownTask(task, tuple(task.observation_shape if shape is None else shape), task_id)  # type: ignore[arg-type]
    [measures] = measures_by_seed(policy, 1, shown, greedy=greedy, initial_state=initial_state, gamma=gamma)
    return measures


@torch.no_grad()
def measures_by_seed(
    policy: Any,
    num_seeds: int,
    shown: ShownTask,
    *,
    greedy: bool,
    initial_state: InitialState | None,
    gamma: float = 1.0,
) -> list[Measures]:
    """Return `exact_measures` of several seeds, whose ``policy`` acts on as many adjacent rows of each."""
    start = {} if initial_state is None else dict(initial_state(num_seeds).items())
    require(*exact_rules(policy, shown.task, start))
    seeds = _Seeds(policy, num_seeds, shown)
    exploration = ExplorationType.DETERMINISTIC if greedy else ExplorationType.RANDOM
    with set_exploration_type(exploration):
        if not start:
            return policy_measures(shown.task, _tables(seeds), gamma)
        return _Enumeration(seeds, gamma).measures(start)


def exact_success(policy: ActionProbs | nn.Module, task: Task) -> float:
    """Return the probability that a policy without memory reaches the goal.

    Args:
        policy: maps images, uint8 [n, \\*shape], to action probabilities, float [n, A], or to actions, int64 [n], which
            are deterministic. A plain module maps them to logits, which are sampled.

    Raises:
        ValueError: for noise on reading, a changing goal, and probabilities of a wrong shape or sum.

    Example:
        >>> from ctgraph_rl.tasks.configurations import ct_su_b1
        >>> uniform = lambda images: images.new_full((len(images), 3), 1 / 3, dtype=torch.float64)
        >>> round(1 / exact_success(uniform, ct_su_b1()))  # P_R
        243
    """
    return _measure_function(policy, task, 1.0).success_rate


@takes_numbers
def exact_value(policy: ActionProbs | nn.Module, task: Task, gamma: float = 1.0) -> float:
    """Return the expected discounted return of a policy without memory.

    Args:
        gamma: discount, in [0, 1]; 1 gives the mean return.
    """
    require(*fraction(gamma=gamma))
    return _measure_function(policy, task, gamma).return_mean


def exact_rules(policy: object, task: TaskLike, start: Step, name: str | None = None) -> Iterator[Rule]:
    """Yield what exact measures require of a policy and a task.

    Args:
        start: the recurrent state before an episode, of one row; empty without memory.
        name: in messages; None: the policy's class.
    """
    yield from task_rules(task)
    name = type(policy).__name__ if name is None else name
    has_probs = hasattr(policy, "action_probs")
    yield has_probs, f"exact evaluation needs a policy with action_probs, which {name} has not: {INSTEAD}"
    lasts = f"exact evaluation needs episodes that do not depend on earlier ones, as those of {name} do: {INSTEAD}"
    yield TRIAL not in start, lasts
    if start and all(holds for holds, _ in task_rules(task)):
        count = count_histories(task, PREVIOUS_ACTION in start)  # type: ignore[arg-type]
        here = f"{count:.2g}" if math.isfinite(count) else "more than 1e308"
        many = f"exact evaluation with memory plays all histories, here {here}, and at most {MOST_HISTORIES:,}"
        yield count <= MOST_HISTORIES, f"{many}: {INSTEAD}"


def shown_id(curriculum: Curriculum, task: TaskLike) -> Tensor | None:
    """Return the one-hot id that observations show, uint8; zeros for a held-out task, None without ids."""
    protocol = curriculum.protocol
    if protocol.task_id != "one_hot":
        return None
    shown = torch.zeros(protocol.length(len(curriculum.tasks)), dtype=torch.uint8, device="cpu")
    if task in curriculum.task_ids:
        shown[curriculum.task_ids[task]] = 1
    return shown


def _measure_function(policy: ActionProbs | nn.Module, task: Task, gamma: float) -> Measures:
    require(
        (callable(policy), f"policy must be a function of images or a module, got {policy!r}"),
        (are_graphs([task]), f"exact values are those of CT-graphs, got {type(task).__name__}"),
    )
    acts = as_policy(policy, task.num_actions) if isinstance(policy, nn.Module) else _Function(policy, task.num_actions)
    return exact_measures(acts, task, greedy=False, gamma=gamma)


@dataclass(frozen=True)
class _Function:
    function: ActionProbs
    num_actions: int

    def action_probs(self, data: Step) -> tuple[Tensor, Step]:
        probs = self.function(data["observation"])
        is_tensor = isinstance(probs, Tensor) and len(probs) == len(data["observation"])
        acts = is_tensor and probs.dim() == 1 and not probs.is_floating_point()
        chooses = is_tensor and probs.dim() == 2 and probs.is_floating_point()
        got = f"{probs.dtype} {list(probs.shape)}" if isinstance(probs, Tensor) else type(probs).__name__
        rule = f"policy must map {len(data['observation'])} images to float [n, A] or int64 [n], got {got}"
        require((acts or chooses, rule))
        return (one_hot(probs.long(), self.num_actions).double() if acts else probs), {}


@dataclass(frozen=True)
class ShownTask:
    """What a policy reads of a task.

    Args:
        shape: of observations, to which images are padded.
        task_id: one-hot, or None.
    """

    task: Task
    shape: tuple[int, ...]
    task_id: Tensor | None

    @property
    def bank(self) -> Tensor:
        """All views, uint8 [num_images * views, *shape]."""
        bank = make_bank(bank_key(self.task))
        missing = self.shape[-1] - bank.shape[-1]
        return nn.functional.pad(bank, (0, missing)) if missing else bank

    def data(self, images: Tensor, is_init: bool) -> Step:
        """Return the data of rows that see images, uint8 [n, *shape]."""
        data: Step = {
            "observation": images,
            "is_init": torch.full([len(images), 1], is_init, dtype=torch.bool, device="cpu"),
        }
        if self.task_id is not None:
            data["task_id"] = self.task_id.expand(len(images), -1)
            number = self.task_id.long().argmax() if self.task_id.any() else -1
            data[TASK_NUMBER] = torch.full([len(images), 1], int(number), dtype=torch.int64, device="cpu")
        return data


@dataclass(frozen=True)
class _Seeds:
    """Seeds of one configuration that see the same images of a task."""

    policy: Any
    num_seeds: int
    shown: ShownTask

    @property
    def rows_at_once(self) -> int:
        return max(1, HISTORIES_AT_ONCE // self.num_seeds)

    def action_probs(self, images: Tensor, is_init: bool, state: Step) -> tuple[Tensor, Step]:
        """Return action probabilities, float64 [seeds, n, A], and what is written, [seeds, n, ...] each.

        Args:
            images: uint8 [n, *shape].
            state: recurrent, [seeds, n, ...] each.
        """
        data = self.shown.data(images.expand(self.num_seeds, *images.shape).flatten(0, 1), is_init)
        data |= {key: value.flatten(0, 1) for key, value in state.items()}
        weights = next(self.policy.parameters(), None) if isinstance(self.policy, nn.Module) else None
        device = None if weights is None else weights.device
        probs, written = self.policy.action_probs({key: value.to(device) for key, value in data.items()})
        return self.by_seed(probs).double(), {key: self.by_seed(value) for key, value in written.items()}

    def by_seed(self, value: Tensor) -> Tensor:
        return value.cpu().unflatten(0, (self.num_seeds, -1))


def _tables(seeds: _Seeds) -> Tensor:
    """Return action probabilities, float64 [seeds, num_images, A]: means over the views of an id.

    Those of ids that decide nothing are equal.
    """
    task = seeds.shown.task
    x = task.observations
    ids = torch.cat([torch.arange(first, last + 1, device="cpu") for first, last in (x.wait_ids, x.decision_ids)])
    views = num_views(task)
    rows = (ids.unsqueeze(1) * views + torch.arange(views, device="cpu")).flatten()
    bank = seeds.shown.bank
    found = []
    for some in rows.split(seeds.rows_at_once):
        found.append(seeds.action_probs(bank.index_select(0, some), False, {})[0])
    probs = torch.cat(found, dim=1)
    num_actions = probs.shape[2]
    shape = [seeds.num_seeds, task.images.num_images, num_actions]
    tables = torch.full(shape, 1 / num_actions, dtype=torch.float64, device="cpu")
    tables[:, ids] = probs.unflatten(1, (len(ids), views)).mean(2)
    return tables


@dataclass
class _Histories:
    """Histories that have not ended, all in the same kind of state.

    Args:
        node: where they are, int64 [n].
        weight: probabilities, float64 [seeds, n].
        discount: gamma to the power of their steps, float64 [n].
        state: recurrent states, [seeds, n, ...] each.
    """

    node: Tensor
    weight: Tensor
    discount: Tensor
    state: Step

    def select(self, rows: Tensor) -> _Histories:
        state = {key: value.index_select(1, rows) for key, value in self.state.items()}
        return _Histories(self.node[rows], self.weight[:, rows], self.discount[rows], state)


class _Enumeration:
    """All histories of policies with memory, played depth first in parts."""

    def __init__(self, seeds: _Seeds, gamma: float) -> None:
        self.seeds = seeds
        self.task = seeds.shown.task
        self.gamma = gamma
        self.bank = seeds.shown.bank
        self.paid = end_rewards(self.task)
        self.stays = longest_stay(self.task.graph.wait_prob)
        zeros = torch.zeros(seeds.num_seeds, dtype=torch.float64, device="cpu")
        self.sums = {each.name: zeros.clone() for each in fields(Measures)}

    def measures(self, start: Step) -> list[Measures]:
        ones = torch.ones(1, dtype=torch.float64, device="cpu")
        weight = ones.expand(self.seeds.num_seeds, 1)
        state = {key: self.seeds.by_seed(value) for key, value in start.items()}
        self._at_home(_Histories(torch.zeros(1, dtype=torch.int64, device="cpu"), weight, ones, state))
        return [Measures(*values) for values in torch.stack([*self.sums.values()], dim=1).tolist()]

    def _at_home(self, histories: _Histories) -> None:
        seen, probs, written = self._act(histories, StateType.HOME, 0, is_init=True)
        self._count_steps(seen)
        for action in range(probs.shape[2]) if PREVIOUS_ACTION in seen.state else [-1]:
            chance = probs[..., action] if action >= 0 else torch.ones_like(seen.weight)
            self._at_wait(self._after(seen, written, chance, action), 0)

    def _at_wait(self, histories: _Histories, level: int) -> None:
        for part in self._parts(histories):
            p = self.task.graph.wait_prob
            staying = part
            left = []
            for stay in range(self.stays):
                seen, probs, written = self._act(staying, StateType.WAIT, level)
                self._count_steps(seen)
                waits = probs[..., WAIT_ACTION]
                self._fail(seen, 1 - waits)
                left.append(self._after(seen, written, (1 - p) * waits, WAIT_ACTION))
                if stay + 1 < self.stays:
                    staying = self._after(seen, written, p * waits, WAIT_ACTION)
            leads_on = _join(left)
            if level == self.task.graph.depth:
                self._arrive(leads_on)
            else:
                self._at_decision(leads_on, level)

    def _at_decision(self, histories: _Histories, level: int) -> None:
        graph = self.task.graph
        b = graph.branching_factor
        for part in self._parts(histories):
            seen, probs, written = self._act(part, StateType.DECISION, level)
            self._count_steps(seen)
            self._fail(seen, 1 - probs[..., 1 : b + 1].sum(-1))
            for decision in range(1, b + 1):
                after = self._after(seen, written, probs[..., decision], decision)
                branch = torch.full_like(after.node, decision)
                swap = self.task.swapped_branches
                if swap is not None and decision in swap[1]:
                    at_swap = after.node.eq(self.task.swapped_node)  # type: ignore[arg-type]
                    branch = torch.where(at_swap, sum(swap[1]) - decision, branch)
                after.node = after.node * b + branch
                self._at_wait(after, level + 1)

    def _act(
        self, histories: _Histories, kind: StateType, level: int, is_init: bool = False
    ) -> tuple[_Histories, Tensor, Step]:
        """Return the histories split by images, and what `_Seeds.action_probs` returns."""
        x = self.task.observations
        views = num_views(self.task)
        count = len(histories.node)
        if x.is_unique(kind):
            number = histories.node - self.task.graph.first_node(level)
            ids = x.unique_id(self.task.graph, kind, level, number).unsqueeze(1)
        else:
            first, last = x.ids(kind)
            ids = torch.arange(first, last + 1, device="cpu").expand(count, -1)
        images = (ids.unsqueeze(2) * views + torch.arange(views, device="cpu")).flatten(1)
        rows = torch.arange(count, device="cpu").repeat_interleave(images.shape[1])
        seen = histories.select(rows)
        seen.weight = seen.weight / images.shape[1]
        return seen, *self.seeds.action_probs(self.bank.index_select(0, images.flatten()), is_init, seen.state)

    def _after(self, seen: _Histories, written: Step, chance: Tensor, action: int) -> _Histories:
        state = {}
        for key, value in seen.state.items():
            state[key] = written.get(("next", key), value)
        if PREVIOUS_ACTION in state:
            state[PREVIOUS_ACTION] = torch.full_like(state[PREVIOUS_ACTION], action)
        if "reward" in state:
            state["reward"] = torch.full_like(state["reward"], self.task.step_reward)
        weight = seen.weight * chance
        taken = _Histories(seen.node, weight, seen.discount * self.gamma, state)
        return taken.select((weight > 0).any(0).nonzero().squeeze(1))

    def _count_steps(self, histories: _Histories) -> None:
        self._add("length_mean", histories.weight)
        self._add("return_mean", self.task.step_reward * histories.weight * histories.discount)

    def _fail(self, seen: _Histories, chance: Tensor) -> None:
        self._add("return_mean", self.task.fail_reward * seen.weight * seen.discount * chance)

    def _arrive(self, histories: _Histories) -> None:
        graph = self.task.graph
        leaf = histories.node - graph.first_node(graph.depth)
        before = histories.discount / self.gamma if self.gamma else torch.zeros_like(histories.discount)
        self._add("return_mean", histories.weight * before * self.paid[leaf])
        self._add("success_rate", histories.weight[:, leaf == self.task.goal_leaf])
        self._add("end_rate", histories.weight)
        if self.task.extra_end_step:
            self._count_steps(histories)

    def _add(self, name: str, values: Tensor) -> None:
        self.sums[name] += values.sum(1)

    def _parts(self, histories: _Histories) -> Iterator[_Histories]:
        for rows in torch.arange(len(histories.node), device="cpu").split(self.seeds.rows_at_once):
            if len(rows):
                yield histories.select(rows)


def _join(parts: Sequence[_Histories]) -> _Histories:
    state = {key: torch.cat([part.state[key] for part in parts], dim=1) for key in parts[0].state}
    node = torch.cat([part.node for part in parts])
    weight = torch.cat([part.weight for part in parts], dim=1)
    return _Histories(node, weight, torch.cat([part.discount for part in parts]), state)
