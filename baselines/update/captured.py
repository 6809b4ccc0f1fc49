"""Several seeds as one batch on a GPU: all act by one CUDA graph, and take a gradient step by another.

The number of operations does not grow with the seeds. Weights stay stacked between batches, and agents get theirs when
they are asked for. Each seed draws by counter.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor
from typing_extensions import override

from baselines.methods.method import Method
from baselines.parts.learner import Learner
from baselines.parts.networks import Data, Items, TensorsByName, is_greedy, most_likely
from baselines.parts.policy_gradient import PolicyGradient, Seeds
from baselines.update.measured import finite_means, table_of
from baselines.update.seeds import SeedGroup, has_stackable, learner_of, or_error, sampled, why_not_step, write_rows
from baselines.update.stack import Stack
from baselines.update.update import over_seeds, update, usual_update
from ctgraph_rl.agent import Agent
from ctgraph_rl.core import philox
from ctgraph_rl.core.region import Region
from ctgraph_rl.learn.collect import PREVIOUS_ACTION, Policy
from ctgraph_rl.learn.loop import Learnt

SHARED = ("learn", "gradient_step", "minibatches", "after_update", "one_step", "reward", "advantages")
"""Members of an agent that act on all seeds at once, or that `CapturedGroup` does not call."""


def why_not_captured(agent: Agent) -> str | None:
    """Return why such agents cannot act and learn as one batch on a GPU, if they cannot."""
    learner = learner_of(agent)
    name = type(learner).__name__
    if not isinstance(learner, PolicyGradient) or not learner.capturable:
        return f"{name} cannot be vectorised over seeds on a GPU"
    if not has_stackable(learner, SHARED):
        return f"{name} does not learn by the steps that a batch of seeds shares"
    if not learner.plasticity.stackable:
        kept = type(learner.plasticity).__name__
        return f"{kept} cannot be vectorised over seeds on a GPU: it acts between gradient steps"
    method = type(learner.method)
    if method.acts_on_batches or getattr(method, "after_learning", None) not in (None, Method.after_learning):
        return f"{method.__name__} cannot be vectorised over seeds on a GPU: it acts before or after a batch"
    return why_not_step(learner)


class Draws:
    """Draws of several seeds on a device, by the counters of `ctgraph_rl.core.philox`.

    The counters stay in place in memory, so that CUDA graphs advance them.

    Args:
        seeds: of each, in [0, 2**63).
    """

    def __init__(self, seeds: Sequence[int], device: torch.device) -> None:
        self.seed = torch.tensor(seeds, dtype=torch.int64, device="cpu").to(device).unsqueeze(1)
        self.tick = torch.zeros_like(self.seed)

    def words(self, count: int) -> Tensor:
        """Return words in [0, 2**32) of each seed, int64 [seeds, count]."""
        block = torch.arange(-(-count // 4), device=self.tick.device)
        row = torch.zeros_like(self.tick)
        words = philox.draw(self.seed, row, self.tick, philox.STREAM_AGENT, block)
        self.tick += 1
        return torch.stack(words, dim=-1).flatten(1)[:, :count]

    def exponential(self, count: int) -> Tensor:
        """Return exponential numbers of each seed, float32 [seeds, count], of 23 bits and never 0."""
        uniform = ((self.words(count) >> 9).to(torch.float32) + 0.5) * 2.0**-23
        return -uniform.log()

    def orders(self, count: int) -> Tensor:
        """Return a random order of items for each seed, int64 [seeds, count]."""
        upper, lower = self.words(2 * count).unflatten(1, (2, count)).unbind(1)
        return (upper << 31 | lower >> 1).argsort(dim=1)


class SeedDraws(NamedTuple):
    """One seed's draws, with the members of a `torch.Generator` that a checkpoint needs."""

    tick: Tensor
    """The counter of `Draws`, int64 [1]."""

    def get_state(self) -> Tensor:
        """Return a copy of the state, on the CPU."""
        return self.tick.cpu().clone()

    def set_state(self, state: Tensor) -> None:
        """Restore what `get_state` returned."""
        self.tick.copy_(state)


class CapturedGroup(SeedGroup):
    """Agents of one configuration with different seeds, which act and learn together on a GPU.

    Args:
        agents: at least one, from `ctgraph_rl.runs.train.new_agent`; `why_not_captured` has no objection.
        generators: of each agent, with torch's global state after it was built. They only give the seeds.
    """

    first: PolicyGradient

    def __init__(self, agents: Sequence[PolicyGradient], generators: Sequence[torch.Generator]) -> None:
        super().__init__(agents, generators)
        self.most_at_once = len(self.learners)
        self._is_behind = False  # whether the agents lack weights of the stack
        device = next(self.first.parameters()).device
        self.draws = Draws([generator.initial_seed() for generator in generators], device)
        self.device_generators = [SeedDraws(tick) for tick in self.draws.tick]
        self._region = Region(self._usual_update)
        self._words: list[int] = []
        """A seed of torch's generators for each agent, from which methods draw at boundaries."""

    @property
    @override
    def agents(self) -> Sequence[Agent]:
        self._write_weights()
        return self._agents

    def _write_weights(self) -> None:
        if self._is_behind:
            self.stack.write()
            self._is_behind = False

    @property
    def stack(self) -> Stack:
        """The agents' tensors, from the first step on, after a saved state was restored."""
        return self.stacks[0]

    @contextmanager
    def random(self, number: int) -> Iterator[None]:
        """Replace torch's global generators, also on the GPU, by one agent's."""
        with super().random(number):
            if self._words:
                torch.manual_seed(self._words[number])
            yield

    @override
    def start_task(self, task: int | None = None) -> None:
        self._draw_words()
        super().start_task(task)

    @override
    def end_task(self) -> None:
        self._draw_words()
        super().end_task()

    def _draw_words(self) -> None:
        if self.methods:
            self._words = self.draws.words(1).flatten().tolist()

    def _task_has_changed(self) -> None:
        if self.methods:
            super()._task_has_changed()
            self._region = Region(self._usual_update)
        for stack in self._stacks:
            stack.read()

    @override
    def policy(self, data: TensorDictBase) -> TensorDictBase:
        return super().policy(data)

    policy.capturable = True  # type: ignore[attr-defined]

    @property
    def greedy_policy(self) -> Policy | None:  # type: ignore[override]
        """Acts as `policy`, with the most likely actions; None with a method, whose policy depends on the task."""
        return None if self.methods else self._act_greedily

    def _act_greedily(self, data: TensorDictBase) -> TensorDictBase:
        return write_rows(data, self.acted(data, greedy=True))

    @override
    def acted(self, data: TensorDictBase, greedy: bool = False) -> Items:
        written = self.one_step(data)
        log_probs = written.pop("log_probs")
        if greedy:
            written["action"] = log_probs.argmax(dim=-1)
        else:
            noise = self.draws.exponential(log_probs[0].numel()).view_as(log_probs)
            written |= sampled({"log_probs": log_probs, "state_value": written["state_value"]}, noise)
        if PREVIOUS_ACTION in self.first.trunk.in_keys:
            written["next", PREVIOUS_ACTION] = written["action"]
        return written

    def one_step(self, data: Data) -> Items:
        """Return `PolicyGradient.one_step` of all agents, [seeds, num_envs, ...] each."""
        inputs = {key: self.by_seed(data[key]) for key in self.first.trunk.in_keys}
        return over_seeds(self.first, lambda learner, weights, data: learner.one_step(data), self.stack.state, inputs)

    def action_probs(self, data: Items) -> tuple[Tensor, Items]:
        """Return action probabilities of all rows and the next state, as `ctgraph_rl.agent.Agent`."""
        inputs = {key: value.to(self.draws.tick.device) for key, value in data.items()}
        written = {key: value.flatten(0, 1) for key, value in self.one_step(inputs).items()}
        chances = written.pop("log_probs").softmax(dim=-1)
        return most_likely(chances) if is_greedy() else chances, written

    @override
    def learn(self, batch: TensorDictBase) -> list[Learnt]:
        measured = super().learn(batch)
        if any(isinstance(each, FloatingPointError) for each in measured):
            self.stack.read()
        return measured

    @override
    def learnt(self, batch: TensorDictBase) -> list[Learnt]:
        for method, part in zip(self.methods, batch.chunk(len(self.learners)), strict=False):
            method.on_batch(part)
        steps = []
        for minibatch in self.first.minibatches_of(batch, self.seeds):
            steps.append(self.first.after_update(self.gradient_step(self._transformed(minibatch))))
        columns = table_of(steps).cpu().unbind(2)
        weights = [self.stack.kept[name].detach().flatten(1) for name in self.stack.learned]
        largest = torch.stack([each.abs().amax(dim=1) for each in weights]).amax(dim=0).cpu()
        names = list(steps[0])

        def measured(learner: Learner, column: Tensor, largest_weight: Tensor) -> dict[str, float]:
            return learner.after_batch(finite_means(names, column, largest_weight))

        found = [or_error(measured, *each) for each in zip(self.learners, columns, largest, strict=True)]
        self._is_behind = True
        if self.methods or any(isinstance(each, FloatingPointError) for each in found):
            self._write_weights()  # methods read them, and those of a failed agent are cleared
        return found

    @property
    def seeds(self) -> Seeds:
        """What the minibatches of all agents are made with."""
        return Seeds(
            len(self.learners), lambda data: self.one_step(data)["state_value"].flatten(0, 1), self.draws.orders
        )

    def _transformed(self, minibatch: TensorsByName) -> TensorsByName:
        if not self.methods:
            return minibatch
        parts = [{key: value[number] for key, value in minibatch.items()} for number in range(len(self.methods))]
        found = [method.transform_minibatch(part) for method, part in zip(self.methods, parts, strict=True)]
        return {key: torch.stack([each[key] for each in found]) for key in minibatch}

    def gradient_step(self, minibatch: TensorsByName) -> TensorsByName:
        """Take a gradient step of all seeds; return losses and norms, [seeds] each."""
        is_usual = minibatch["action"].shape[1] == self.first.minibatch_size
        if not is_usual or not self._region.takes(minibatch):
            return update(self.first, self.stack.state, minibatch)
        return self._region.copies(minibatch)

    def _usual_update(self, minibatch: Data) -> TensorsByName:
        return usual_update(self.first, self.stack.state, minibatch)
