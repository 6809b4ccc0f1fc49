"""Several seeds as one batch: agents of equal structure act and learn in the same operations.

Weights are stacked only for forward passes and gradient steps. Saving, evaluation and hooks at task changes are those
of single agents.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch._inductor import compile
from torch.fx import GraphModule

from baselines.cells.cell import Cell
from baselines.methods.method import AgentWithMethod
from baselines.parts.hooks import Hooks
from baselines.parts.learner import Learner
from baselines.parts.networks import Data, Items, TensorsByName
from baselines.update.compiled import compiler_options
from baselines.update.measured import table_of
from baselines.update.stack import Stack
from baselines.update.update import has_parts, update, usual_update
from ctgraph_rl.agent import Agent
from ctgraph_rl.learn.collect import Policy
from ctgraph_rl.learn.loop import Learnt

HOOKS = ("on_batch", "transform_minibatch", "penalties", "transform_gradients", "after_step", "after_learning")

LARGEST_MINIBATCH = 512
"""Items of the largest stacked minibatches; larger ones keep a core busy by themselves."""


def why_not_together(agent: Agent) -> str | None:
    """Return why such agents cannot act and learn as one batch, if they cannot."""
    learner = learner_of(agent)
    name = type(learner).__name__
    if not isinstance(learner, Learner) or not learner.stackable:
        return f"{name} cannot be vectorised over seeds"
    if not has_stackable(learner, ("learn", "gradient_step")):
        return f"{name} does not learn by the steps that a batch of seeds shares"
    for part in learner.modules():
        if isinstance(part, Cell) and not part.gains_together:
            return f"{type(part).__name__} takes no less time on a CPU with several seeds in one process"
    return why_not_step(learner)


def why_not_step(learner: Learner) -> str | None:
    """Return why a learner's method and optimiser cannot step several seeds, if they cannot."""
    if not has_stackable(learner.method, HOOKS):
        name = type(learner.method).__name__
        return f"{name} cannot be vectorised over seeds: its hooks take the weights of one seed"
    if has_parts(learner.optimiser):
        return None
    return f"{type(learner.optimiser).__name__} with these settings cannot be vectorised over seeds"


def has_stackable(part: nn.Module, members: Sequence[str]) -> bool:
    """Return whether a learner or method is ``stackable``, with no member newer than the class that sets it."""
    kind = type(part)
    owner: Any = next(each for each in kind.__mro__ if "stackable" in vars(each))
    return owner.stackable and all(getattr(kind, name, None) is getattr(owner, name, None) for name in members)


class SeedGroup:
    """Agents of one configuration with different seeds, which act and learn together.

    Each draws from a separate generator, in the order of a run of one seed.

    Args:
        agents: at least one, from `ctgraph_rl.runs.train.new_agent`; `why_not_together` has no objection.
        generators: of each agent, with torch's global state after it was built.
    """

    device_generators: Sequence[Any] | None = None
    greedy_policy: Policy | None = None

    def __init__(self, agents: Sequence[Agent], generators: Sequence[torch.Generator]) -> None:
        self._agents = list(agents)
        self.generators = list(generators)
        self.learners = [learner_of(agent) for agent in agents]
        self.methods = [agent.method for agent in agents if isinstance(agent, AgentWithMethod)]
        self.first = self.learners[0]
        self.is_stacked = _gains_from_stacking(self.first) and self.first.plasticity.stackable
        self.most_at_once = _most_at_once(self.first) if self.first.compiled_step else len(self.learners)
        self._compiled: dict[str, Outputs] = {}
        self._stacks: list[Stack] = []
        self._acting: Stack | None = None
        self._outputs: Outputs | None = None

    @property
    def agents(self) -> Sequence[Agent]:
        """The agents after the last batch."""
        return self._agents

    def _task_has_changed(self) -> None:
        self._stacks = []
        self._acting = self._outputs = None

    @contextmanager
    def random(self, number: int) -> Iterator[None]:
        """Replace torch's global generator by one agent's."""
        generator = self.generators[number]
        before = torch.get_rng_state()
        torch.set_rng_state(generator.get_state())
        try:
            yield
        finally:
            generator.set_state(torch.get_rng_state())
            torch.set_rng_state(before)

    @property
    def stacks(self) -> list[Stack]:
        """The learners' tensors, a stack for those that learn at once."""
        if not self._stacks:
            count = len(self.learners)
            bounds = torch.arange(count, device="cpu").tensor_split(math.ceil(count / self.most_at_once))
            self._stacks = [Stack([self.learners[number] for number in numbers.tolist()]) for numbers in bounds]
        return self._stacks

    def start_task(self, task: int | None = None) -> None:
        """Start a task of all agents."""
        for number, agent in enumerate(self.agents):
            with self.random(number):
                agent.start_task(task)
        self._task_has_changed()

    def end_task(self) -> None:
        """End a task of all agents."""
        self._acting = None
        for number, agent in enumerate(self.agents):
            with self.random(number):
                agent.end_task()

    def by_seed(self, value: Tensor) -> Tensor:
        """Return a tensor of all rows, [seeds * rows, ...], as [seeds, rows, ...]."""
        return value.unflatten(0, (len(self.learners), -1))

    def policy(self, data: TensorDictBase) -> TensorDictBase:
        """Write the actions of all agents, [seeds * num_envs], and what learning needs of them."""
        return write_rows(data, self.acted(data))

    def acted(self, data: TensorDictBase) -> Items:
        """Return what the policies write, [seeds, num_envs, ...] each."""
        keys = [key for key in self.first.policy.in_keys if key in data.keys()]  # noqa: SIM118, rows otherwise
        inputs = {key: self.by_seed(data[key]) for key in keys}
        if self.first.memory:
            written = []
            for number, learner in enumerate(self.learners):
                with self.random(number):
                    written.append(learner.policy.act_on_tensors({key: value[number] for key, value in inputs.items()}))
            return {key: torch.stack([each[key] for each in written]) for key in written[0]}
        if self._acting is None:
            self._acting = Stack(self.learners)
        outputs = self._act(self._acting, inputs)
        if "action_value" in outputs:
            return self._explored(outputs)
        noise = torch.empty_like(outputs["log_probs"], memory_format=torch.contiguous_format)
        for row, generator in zip(noise, self.generators, strict=True):
            row.exponential_(generator=generator)
        return sampled(outputs, noise)

    def _act(self, stack: Stack, data: Items) -> TensorsByName:
        """Return the networks' outputs by a graph of operations, compiled where the agents set it.

        Binding tensors and gaps between operations would take most of the time.
        """
        inputs = stack.acting_inputs(data)
        if self._outputs is None:
            graph = stack.traced_outputs(data)
            self._outputs = self._compile(graph, inputs) if self.first.compiled_step else graph
        return self._outputs(*inputs)

    def _compile(self, graph: GraphModule, inputs: Sequence[Tensor]) -> Outputs:
        if graph.code not in self._compiled:
            self._compiled[graph.code] = compile(graph, [*inputs], compiler_options())
        return self._compiled[graph.code]

    def _explored(self, outputs: Mapping[str, Tensor]) -> TensorsByName:
        actions = outputs["action_value"].argmax(dim=-1)
        for number, (learner, action) in enumerate(zip(self.learners, actions, strict=True)):
            with self.random(number):
                action.copy_(learner.exploration(TensorDict({"action": action}, action.shape))["action"])
        return {"action": actions}

    def learn(self, batch: TensorDictBase) -> list[Learnt]:
        """Let each agent learn from its rows of a batch, [seeds * num_envs, num_steps].

        Returns:
            What each measured, or the error that names what is not finite.
        """
        self._acting = None
        measured = self.learnt(batch)
        for learner, each in zip(self.learners, measured, strict=True):
            if isinstance(each, FloatingPointError):
                clear(learner)
        return measured

    def learnt(self, batch: TensorDictBase) -> list[Learnt]:
        """Learn as `learn` does; an agent that failed keeps weights that are not finite."""
        parts = batch.chunk(len(self.learners))
        measured: list[Learnt] = []
        if not self.is_stacked:
            for number, (agent, part) in enumerate(zip(self.agents, parts, strict=True)):
                with self.random(number):
                    measured.append(or_error(agent.learn, part))
            return measured
        for number, (method, part) in enumerate(zip(self.methods, parts, strict=False)):
            with self.random(number):
                method.on_batch(part)
        for stack in self.stacks:
            numbers = range(len(measured), len(measured) + len(stack.learners))
            measured += self._learn_at_once(stack, numbers, parts)
        for number, method in enumerate(self.methods):
            if not isinstance(measured[number], FloatingPointError):
                with self.random(number):
                    method.after_learning()
        return measured

    def _learn_at_once(self, stack: Stack, numbers: Sequence[int], parts: Sequence[TensorDictBase]) -> list[Learnt]:
        stack.read()
        minibatches = {number: self.learners[number].minibatches(parts[number]) for number in numbers}
        errors: dict[Learner, FloatingPointError] = {}
        steps = []
        while given := self._next(minibatches):
            steps.append(self._update(stack, given, errors))
        stack.write()
        names = list(steps[0])
        table = table_of(steps).unbind(-1)

        def measured(learner: Learner, column: Tensor) -> dict[str, float]:
            if learner in errors:
                raise errors[learner]
            return learner.after_batch(learner.means(names, column))

        return [or_error(measured, *pair) for pair in zip(stack.learners, table, strict=True)]

    def _next(self, minibatches: Mapping[int, Iterator[Items]]) -> list[Data]:
        given = []
        for number, iterator in minibatches.items():
            with self.random(number):
                minibatch = next(iterator, None)
                if minibatch is not None:
                    given.append(self.learners[number].method.transform_minibatch(minibatch))
        return given

    def _update(
        self, stack: Stack, minibatches: Sequence[Data], errors: dict[Learner, FloatingPointError]
    ) -> TensorsByName:
        needs_weights = stack.learners[0].needs_weights
        batch = {key: torch.stack([each[key] for each in minibatches]) for key in minibatches[0]}
        measured = self._step(stack, batch)
        if type(stack.learners[0]).after_update is Learner.after_update:
            return measured
        if needs_weights:
            stack.write()
        for number, learner in enumerate(stack.learners):
            if learner not in errors:
                try:
                    learner.after_update({key: value[number] for key, value in measured.items()})
                except FloatingPointError as error:
                    errors[learner] = error
        if needs_weights:
            stack.read_others()
        return {key: value for key, value in measured.items() if value.ndim == 1}

    def _step(self, stack: Stack, batch: Items) -> TensorsByName:
        first = stack.learners[0]
        take = usual_update if batch["action"].shape[1] == first.minibatch_size else update
        return take(first, stack.state, batch)


Outputs = Callable[..., TensorsByName]

CACHED_BYTES = 2**23
"""A core's cache, of weights, gradients and moments."""


def _gains_from_stacking(learner: Learner) -> bool:
    """Return whether gradient steps of a stack are faster than those of each learner in turn.

    With penalties or masks they are slower: they write all seeds' weights to memory, where one learner's stay in the
    cache.
    """
    method = type(learner.method)
    plain = method.penalties is Hooks.penalties and method.transform_gradients is Hooks.transform_gradients
    small = learner.minibatch_size <= LARGEST_MINIBATCH and not learner.memory
    return small and (plain or learner.compiled_step is None)


def _most_at_once(learner: Learner) -> int:
    of_one = sum(4 * parameter.numel() * parameter.element_size() for parameter in learner.weights)
    return max(1, CACHED_BYTES // of_one)


def or_error(measure: Callable[..., dict[str, float]], *given: Any) -> Learnt:
    """Return a function's measurements, or its error where they are not finite."""
    try:
        return measure(*given)
    except FloatingPointError as error:
        return error


@torch.no_grad()
def clear(learner: Learner) -> None:
    """Set a failed agent's weights to zero, so that it keeps its place in the batch and raises nothing.

    A batch of another size might round the others' products differently.
    """
    learner.clear_optimiser_state(learner.trainable)
    for parameter in learner.parameters():
        parameter.zero_()


def sampled(outputs: Mapping[str, Tensor], noise: Tensor) -> TensorsByName:
    """Draw actions from categorical distributions, as `torch.multinomial` draws one of each row.

    Args:
        outputs: ``log_probs``, [seeds, num_envs, num_actions], and ``state_value``.
        noise: exponential numbers, as many as log-probabilities.

    Returns:
        ``action`` and ``action_log_prob``, [seeds, num_envs], and ``state_value``.
    """
    log_probs = outputs["log_probs"]
    action = (log_probs.softmax(dim=-1) / noise).argmax(dim=-1)
    of_action = log_probs.gather(-1, action.unsqueeze(-1)).squeeze(-1)
    return {"action": action, "action_log_prob": of_action, "state_value": outputs["state_value"]}


def write_rows(data: TensorDictBase, written: Items) -> TensorDictBase:
    """Write what policies wrote, [seeds, rows, ...] each, into the data of all rows."""
    for key, value in written.items():
        data.set(key, value.flatten(0, 1))
    return data


def learner_of(agent: Agent) -> Any:
    """Return the learner that a method changes, or the agent."""
    return agent.agent if isinstance(agent, AgentWithMethod) else agent
