"""The Agent protocol: what `learn_curriculum` asks of a learner; and what a run asks of a lifelong-learning method."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from ctgraph_rl.tasks.curriculum import Curriculum


class Agent(Protocol):
    """A learner. One module acts and learns, one method gives the loss; any class with these members is an agent.

    `ctgraph_rl.run` builds it as ``Class(observation_spec, action_spec, **yaml)``, with the environment's
    ``observation_spec_unbatched`` and ``action_spec_unbatched``.

    Exploration and sampling draw from torch's global generator, which the run seeds.
    """

    num_envs: int
    """Rows that it learns from."""

    num_steps: int
    """Steps of each row in a batch; the last batch of a block may be shorter."""

    policy: TensorDictModuleBase
    """Reads ``observation`` and ``is_init``, writes ``action``; explores unless TorchRL's exploration type forbids it.

    Where the protocol gives a task id, ``observation_spec`` has ``task_id``, a one-hot uint8 [n], and so has the data.

    A recurrent policy reads its state under its own keys and writes the new one under ``("next", key)``. Where
    ``is_init`` is set, the state that it reads is that of `initial_state`.

    For ``evaluation.exact=true`` it has ``action_probs(data)``, which returns the probabilities of all actions, float
    [n, A], as the exploration type says, and its next state, by ``("next", key)``, as far as the action does not
    decide it. It draws nothing, and treats each row as if there were no other.
    """

    def policy_for(self, task: int) -> TensorDictModuleBase:
        """Return the policy for the task with an id, where the protocol gives ids; mostly `policy` itself."""
        ...

    def initial_state(self, num_envs: int) -> TensorDict:
        """Return the recurrent state of ``num_envs`` rows before their first observation; empty without memory.

        Every episode starts with it. A state with a key ``trial`` lasts over episodes: the policy resets it.
        """
        ...

    def start_task(self, task: int | None = None) -> None:
        """Called before the first batch of a block whose start is announced.

        Args:
            task: the task's id, where the curriculum's protocol gives ids and the block has one task; else None.
        """
        ...

    def end_task(self) -> None:
        """Called after the last batch of such a block."""
        ...

    def loss(self, batch: Mapping[Any, Tensor] | TensorDictBase) -> Mapping[str, Tensor] | TensorDictBase:
        """Return the losses of a batch as scalars named ``loss_*``; their sum is what is minimised."""
        ...

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Learn from a batch of shape [num_envs, num_steps] in time order; returns what is worth logging.

        Raises:
            FloatingPointError: if a loss or a weight is not finite; names it.
        """
        ...

    def to(self, device: Any) -> Any:
        """Move to a device and return itself, as ``torch.nn.Module`` does."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Return all that a resumed run needs to continue with the same bits, as tensors and plain Python values."""
        ...

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> Any:
        """Restore what `state_dict` gave."""
        ...


class Model(Protocol):
    """What an agent may add, to be scored as a model of its environment; see property 9 of `ctgraph_rl.profile`."""

    def predict_next(self, history: TensorDictBase, choices: TensorDictBase) -> Tensor:
        """Return how likely each pair of observation and reward is to come next.

        Args:
            history: what each row has met since its episode began, [rows, steps] in time order: ``observation``, the
                ``action`` that followed, int64, and ``reward``, float32, that came with the observation, 0 with the
                first. The method predicts the outcome of the last action.
            choices: all pairs that can come, [choices]: ``observation`` and ``reward``.

        Returns:
            Natural logarithms of probabilities that sum to 1 in each row, float [rows, choices].
        """
        ...


class DetectorLike(Protocol):
    """A detector of task changes, which gives tasks labels. `ctgraph_rl.run` builds it as ``Class(**yaml)``."""

    def labelling(self, method: MethodLike) -> MethodLike:
        """Return a method whose task ids and boundaries are this detector's."""
        ...


class MethodLike(Protocol):
    """A lifelong-learning method: it changes how an agent learns. `ctgraph_rl.run` builds it as ``Class(**yaml)``."""

    def prepare(self, curriculum: Curriculum) -> Curriculum:
        """Return the curriculum to learn in place of the given one, mostly the same.

        Raises:
            ValueError: if the curriculum's protocol hides what the method needs.
        """
        ...

    def attach(self, agent: Agent, curriculum: Curriculum) -> Agent:
        """Return the agent with this method attached.

        Args:
            agent: a new agent, which is part of what is returned.
            curriculum: what `prepare` returned.

        Raises:
            ValueError: if agent and method do not fit together.
        """
        ...
