"""The base class of methods that keep a network able to learn."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from typing_extensions import override

from baselines.methods.parts.selection import own_generator
from baselines.methods.parts.weights import flat, require_drawn
from baselines.parts.hooks import PlasticityHooks
from baselines.parts.learner import Learner
from baselines.parts.units import hidden_layers
from ctgraph_rl.agent import Agent
from ctgraph_rl.checks import NamedValues, TakesNumbers, require
from ctgraph_rl.tasks.curriculum import Curriculum

STREAM = 0x91A571


class Plasticity(TakesNumbers, PlasticityHooks):
    """A plasticity that does nothing, from which others derive.

    It draws from a separate generator of the run's seed, so that all other draws stay. A lifelong-learning method acts
    after it.
    """

    needs_boundaries: bool = False
    reads_units: ClassVar[bool] = False
    """Whether it acts on hidden units."""

    counts: tuple[str, ...] = ()
    agent: Learner

    def __init__(self) -> None:
        super().__init__()
        self.num_started = 0

    def attach(self, agent: Agent, curriculum: Curriculum) -> Agent:
        """Return the agent with this plasticity, to which a method can be attached.

        Raises:
            ValueError: if agent, plasticity and curriculum do not fit together.
        """
        name = type(self).__name__
        kind: Any = type(agent)
        usual = isinstance(agent, Learner) and kind.gradient_step is Learner.gradient_step
        require(
            (usual, f"{name} needs an agent with the gradient steps of Learner, not {kind.__name__}: take agent=ppo"),
            (
                curriculum.protocol.announces or not self.needs_boundaries,
                f"{name} acts at announced task changes: set protocol.boundaries=announced",
            ),
        )
        assert isinstance(agent, Learner)
        drawn = f"{name} acts where a task starts, and {kind.__name__} draws its tasks: take plasticity=none"
        require((not (self.needs_boundaries and getattr(agent, "adapt_episodes", None)), drawn))
        self.layers = [layer for layer in hidden_layers(agent.policy) if layer.linear is not None]
        units = f"{name} acts on hidden units, and {kind.__name__} has none that it tells: take agent=ppo or lstm_ppo"
        require((bool(self.layers) or not self.reads_units, units))
        object.__setattr__(self, "agent", agent)  # the plasticity is a submodule of the agent, not the other way round
        self.needs_starts = self.needs_boundaries
        self.generator = own_generator(STREAM)
        if self.recycles:
            require_drawn(agent.policy, name)
        self.setup(agent)
        agent.plasticity = self
        return agent

    def setup(self, agent: Learner) -> None:
        """Called once when it is attached: register buffers and replace the optimiser here."""

    def at_boundary(self) -> None:
        """Called at each start of a task but the first, where task changes are announced."""

    @override
    def start_task(self) -> None:
        self.num_started += 1
        if self.num_started > 1:
            self.at_boundary()

    @torch.no_grad()
    def draw_weights(self) -> dict[nn.Parameter, Tensor]:
        """Return new values of the network's parameters, drawn as at construction."""
        parameters = list(self.agent.policy.parameters())
        kept = [parameter.clone() for parameter in parameters]
        seed = int(torch.randint(2**62, (), generator=self.generator, dtype=torch.int64, device="cpu"))
        with torch.random.fork_rng(devices={each.device for each in parameters if each.is_cuda}):
            torch.manual_seed(seed)
            self.agent.reset_parameters()
        drawn = {parameter: parameter.clone() for parameter in parameters}
        for parameter, value in zip(parameters, kept, strict=True):
            parameter.copy_(value)
        return drawn

    @contextmanager
    def rewriting(self) -> Iterator[None]:
        """Tell the method how much the weights change within."""
        before = flat(self.agent.weights).detach()
        with torch.no_grad():
            yield
        self.agent.method.weights_rewritten(flat(self.agent.weights).detach() - before)

    def clear_moments(self, parameter: Tensor, index: Any = ...) -> None:
        """Set a parameter's moments to zero, all or at an index; the optimiser's count of its steps stays."""
        for value in self.agent.optimiser.state.get(parameter, {}).values():
            if value.shape == parameter.shape:
                value[index] = 0

    @override
    def get_extra_state(self) -> NamedValues:
        counts = {name: getattr(self, name) for name in ("num_started", *self.counts)}
        return {"generator": self.generator.get_state(), **counts}

    @override
    def set_extra_state(self, state: NamedValues) -> None:
        self.generator.set_state(state["generator"])
        for name in ("num_started", *self.counts):
            setattr(self, name, state[name])
