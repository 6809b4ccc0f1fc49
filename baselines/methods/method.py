"""The base classes of lifelong-learning methods, and an agent with a method.

An agent calls the method's hooks in each gradient step, `AgentWithMethod` those at batches, task changes and
evaluation. A method knows the weights as one vector and the losses by name.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from inspect import signature
from typing import Any, ClassVar, cast

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from typing_extensions import override

from baselines.methods.parts.weights import Weights
from baselines.parts.hooks import Hooks, PlasticityHooks
from baselines.parts.learner import Learner
from ctgraph_rl.agent import Agent
from ctgraph_rl.checks import NamedValues, TakesNumbers, require, require_memory
from ctgraph_rl.tasks.curriculum import Curriculum

NO_PLASTICITY = PlasticityHooks()

MOST_COPIES = 128
"""Policies with other weights that are kept; a task beyond gets a new copy each time."""

COPIES_TO_SAVE = 2


class Method(TakesNumbers, Hooks):
    """A method that does nothing, from which others derive: fine-tuning."""

    stackable = False

    needs_task_id: bool = False
    """Whether learning and evaluation need the task's id."""

    hidden_ids_hint = ""
    """The way out where ids are hidden, for the message that refuses them."""

    needs_boundaries: bool = True
    """Whether task changes must be announced."""

    needs_episodes: bool = False
    """Whether it needs data that say where episodes end."""

    reads_tasks: str = ""
    """What it reads of tasks beside ids, for the message that refuses a detector's labels."""

    max_labels: int | None = None
    """Most ids if they are a detector's labels; None: those of the curriculum's tasks."""

    may_recycle: bool = True
    """Whether a plasticity may draw some of the network's weights again: not where the method fixes or makes them."""

    agent_members: tuple[str, ...] = ("method", "weights")
    """Members of `Learner` that it uses beside those of `ctgraph_rl.agent.Agent`."""

    agent: Learner  # or another module with the members that `agent_members` lists
    weights: Weights
    curriculum: Curriculum

    def __init__(self) -> None:  # nn.Module takes any arguments, a method only those that it names
        super().__init__()

    def prepare(self, curriculum: Curriculum) -> Curriculum:
        """Return the curriculum to learn, mostly the given one.

        Raises:
            ValueError: if the curriculum's protocol hides what the method needs.
        """
        protocol = curriculum.protocol
        name = type(self).__name__
        several = curriculum.blocks_of_several
        or_detector = "" if self.reads_tasks else ", or add a detector, such as detector=swoks"
        require(
            (
                not self.needs_task_id or protocol.task_id != "hidden",
                f"{name} needs task ids, which are hidden: "
                f"set protocol.task_id=one_hot or at_boundaries{self.hidden_ids_hint}{or_detector}",
            ),
            (
                not self.needs_boundaries or protocol.announces,
                f"{name} needs announced task changes: set protocol.boundaries=announced{or_detector}",
            ),
            (
                not (self.needs_episodes and protocol.hides_episodes),
                f"{name} needs the ends of episodes, which are hidden: set protocol.episodes=shown",
            ),
            (
                not (self.needs_task_id and several),
                f"{name} needs blocks of one task each, and blocks {several} have several",
            ),
        )
        return curriculum

    def attach(self, agent: Agent, curriculum: Curriculum) -> Agent:
        """Return the agent with this method attached.

        Args:
            agent: a `Learner`, or a module with `agent_members` that calls the hooks of ``agent.method``.

        Raises:
            ValueError: if agent and method do not fit together.
        """
        missing = [f"`{name}`" for name in self.agent_members if not hasattr(agent, name)]
        missing += ["`torch.nn.Module` as its base"] * (not isinstance(agent, nn.Module))
        name = type(self).__name__
        learner = type(agent).__name__
        message = f"{name} needs an agent with {', '.join(missing)}, got {learner}"
        adapts = getattr(agent, "adapt_episodes", 0) > 0
        require(
            (not adapts, f"{name} learns tasks one after the other, and {learner} draws them: take method=finetune")
        )
        plasticity = getattr(agent, "plasticity", None)
        recycled = (
            f"{name} fixes or makes weights, which {type(plasticity).__name__} would draw again: take plasticity=none, "
            "or one that draws none, such as l2_init"
        )
        require((self.may_recycle or not getattr(plasticity, "recycles", False), recycled))
        for hook in ("penalties", "transform_gradients", "after_step"):
            taken = list(signature(getattr(self, hook)).parameters)
            rule = f"{name}.{hook} must take `weights`, those of the agent, as its last argument, got {taken}"
            require((taken[-1:] == ["weights"], rule))
        require((not missing, f"{message}: derive it from baselines.parts.learner.Learner, or take method=finetune"))
        return AgentWithMethod(cast(Learner, agent), self, curriculum)

    def begin(self, agent: Learner, weights: Weights, curriculum: Curriculum) -> None:
        """Set what it works on, and call `setup`."""
        object.__setattr__(self, "agent", agent)  # the method is a submodule of the agent, not the other way round
        self.weights = weights
        self.curriculum = curriculum
        self.setup()

    def setup(self) -> None:
        """Called once when the method is attached: register buffers and parameters here.

        Raises:
            ValueError: if agent and method do not fit together.
        """

    def network_weights(self, trained: list[nn.Parameter]) -> list[nn.Parameter]:
        """Return the network's, whatever the optimiser trains."""
        return self.weights.parameters

    def start_task(self, task: int | None) -> None:
        """Called at the start of a task, with its id if the protocol gives ids."""

    def end_task(self) -> None:
        """Called at the end of a task."""

    def on_batch(self, batch: TensorDictBase) -> None:
        """Called with each batch, [num_envs, num_steps], before learning."""

    def after_learning(self) -> None:
        """Called after each batch was learned from."""

    def task_weights(self, task: int) -> Tensor | None:
        """Return the weights to act with in a task, float32 [P]; None for the present ones."""
        return None

    @property
    def num_ids(self) -> int:
        """The most different ids that tasks start with."""
        return len(self.curriculum.tasks) if self.max_labels is None else self.max_labels


class TaskMethod(Method):
    """A method with a slot for each task, in the order in which tasks start.

    A task that has not started is played with the first slot.
    """

    needs_task_id = True
    agent_members = (*Method.agent_members, "weights_changed")

    counts: ClassVar[tuple[str, ...]] = ()
    """Attributes that are changing numbers and are saved."""

    def __init__(self) -> None:
        super().__init__()
        self.started: list[int] = []
        """The ids of started tasks, in the order of their slots."""

        self.slot = 0

    @override
    def setup(self) -> None:
        self.num_tasks = self.num_ids
        self.bytes_per_task = 4 * self.num_kept()
        kept = f"what {type(self).__name__} keeps of {self.num_tasks:,} tasks, {self.bytes_per_task:,} bytes each"
        needed = (1 + COPIES_TO_SAVE) * self.num_tasks * self.bytes_per_task
        require_memory(f"{kept}, and two copies while it is saved", needed, "tasks, such as curriculum.num_tasks")

    def num_kept(self) -> int:
        """Return how many numbers it keeps for each task: one for each weight."""
        return len(self.weights)

    @override
    def start_task(self, task: int | None) -> None:
        name = type(self).__name__
        if task is None:
            raise ValueError(
                f"{name} needs the id of the task that starts: blocks of one task, and ids that are not hidden"
            )
        if task not in self.started:
            message = f"there is room for {self.num_tasks} tasks, got another, {task}"
            require((len(self.started) < self.num_tasks, message))
            self.started.append(task)
        self.slot = self.started.index(task)

    def slot_of(self, task: int) -> int:
        """Return the slot of a task."""
        return self.started.index(task) if task in self.started else 0

    def other_slot(self, task: int) -> int | None:
        """Return a task's slot; None if it is the present one or no task has started."""
        slot = self.slot_of(task)
        return slot if self.started and slot != self.slot else None

    def present_with(self, task: int, inside: Tensor, kept: Tensor) -> Tensor | None:
        """Return the present weights with a task's part; None for the present task.

        Args:
            inside: where in the vector of all weights the part is, bool [P].
            kept: the part of each slot, [slots, n].
        """
        slot = self.other_slot(task)
        if slot is None:
            return None
        weights = self.weights.vector()
        weights[inside.to(weights.device)] = kept[slot]
        return weights

    @override
    def get_extra_state(self) -> NamedValues:
        counts = {name: getattr(self, name) for name in self.counts}
        return {"begun": list(self.started), "place": self.slot, **counts}

    @override
    def set_extra_state(self, state: NamedValues) -> None:
        self.started = list(state["begun"])
        self.slot = state["place"]
        for name in self.counts:
            setattr(self, name, state[name])


class AgentWithMethod(nn.Module):
    """An agent and a method, whose hooks it calls at batches, task changes and evaluation.

    Raises:
        ValueError: if agent and method do not fit together.
    """

    def __init__(self, agent: Learner, method: Method, curriculum: Curriculum) -> None:
        super().__init__()
        self.agent: Learner = agent
        method.begin(agent, Weights(agent.policy, agent.weights), curriculum)
        agent.method = method
        self.num_envs = agent.num_envs
        self.num_steps = agent.num_steps
        self.policy: TensorDictModuleBase = agent.policy
        self._copies: dict[int, TensorDictModuleBase] = {}
        """The last `MOST_COPIES` policies of tasks."""

    @property
    def method(self) -> Method:
        """The agent's method."""
        return cast(Method, self.agent.method)

    @property
    def plasticity(self) -> PlasticityHooks:
        """The agent's plasticity; one that does nothing where it has none."""
        return getattr(self.agent, "plasticity", NO_PLASTICITY)

    @property
    def unwrapped(self) -> Learner:
        """The agent without its method."""
        return self.agent

    def policy_for(self, task: int) -> TensorDictModuleBase:
        """Return the agent's policy, or a copy where the method has other weights for a task."""
        weights = self.method.task_weights(task)
        policy = self.agent.policy_for(task)
        if weights is None:
            return policy
        if task not in self._copies:
            self._copies[task] = deepcopy(policy)
        if len(self._copies) > MOST_COPIES:
            del self._copies[next(iter(self._copies))]
        copy = self._copies[task]
        copy.load_state_dict(policy.state_dict())
        self.method.weights.write_to(copy, weights)
        return copy

    def initial_state(self, num_envs: int) -> TensorDict:
        """Return the agent's recurrent state."""
        return self.agent.initial_state(num_envs)

    def start_task(self, task: int | None = None) -> None:
        """Start a task, for the plasticity, then the method, then the agent."""
        self.plasticity.start_task()
        self.method.start_task(task)
        self.agent.start_task(task)

    def end_task(self) -> None:
        """End a task, first for the agent, then for the method."""
        self.agent.end_task()
        self.method.end_task()

    def loss(self, batch: Mapping[Any, Tensor] | TensorDictBase) -> Mapping[str, Tensor]:
        """Return the agent's losses, and the penalties of plasticity and method."""
        kept = self.plasticity.penalties(batch, self.agent.weights)
        return {**self.agent.loss(batch), **kept, **self.method.penalties(batch, self.agent.weights)}

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Show the method a batch, and learn from it."""
        self.method.on_batch(batch)
        measured = self.agent.learn(batch)
        self.method.after_learning()
        return measured
