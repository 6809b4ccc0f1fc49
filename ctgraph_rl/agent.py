"""The Agent protocol: what `learn_curriculum` asks of a learner, and a run of a lifelong-learning method."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from ctgraph_rl.tasks.curriculum import Curriculum


class Agent(Protocol):
    """A learner: any class with these members.

    `ctgraph_rl.run` builds it as ``Class(observation_spec, action_spec, **yaml)``, with the environment's
    ``observation_spec_unbatched`` and ``action_spec_unbatched``.

    Exploration and sampling draw from torch's global generator.
    """

    num_envs: int
    """Rows to learn from."""

    num_steps: int
    """Steps of each row in a batch; a block's last batch may be shorter."""

    policy: TensorDictModuleBase
    """Reads ``observation`` and ``is_init``, writes ``action``; explores unless TorchRL's exploration type forbids it.

    Where the protocol gives a task id, specs and data have ``task_id``, a one-hot uint8 [n].

    A recurrent policy reads its state under its own keys and writes the new one under ``("next", key)``. Where
    ``is_init`` is set, it reads `initial_state`.

    For ``evaluation.exact=true`` it has ``action_probs(data)``, which returns the probabilities of all actions, float
    [n, A], by the exploration type, and its next state, by ``("next", key)``, as far as the action does not decide it.
    It draws nothing, and treats rows independently.
    """

    def policy_for(self, task: int) -> TensorDictModuleBase:
        """Return the policy for a task's id, where the protocol gives ids; mostly `policy` itself."""
        ...

    def initial_state(self, num_envs: int) -> TensorDict:
        """Return the rows' recurrent state before their first observation; empty without memory.

        Every episode starts with it. A state with a key ``trial`` lasts over episodes; the policy resets it.
        """
        ...

    def start_task(self, task: int | None = None) -> None:
        """Called before the first batch of an announced block.

        Args:
            task: its id, where the protocol gives ids and the block has one task; else None.
        """
        ...

    def end_task(self) -> None:
        """Called after an announced block's last batch."""
        ...

    def loss(self, batch: Mapping[Any, Tensor] | TensorDictBase) -> Mapping[str, Tensor] | TensorDictBase:
        """Return a batch's losses as scalars named ``loss_*``; their sum is minimised."""
        ...

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Learn from a batch [num_envs, num_steps] in time order; return numbers to log.

        Raises:
            FloatingPointError: if a loss or a weight is not finite; names it.
        """
        ...

    def to(self, device: Any) -> Any:
        """Move to a device and return itself."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Return all that a resumed run needs for the same bits, as tensors and plain Python values."""
        ...

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> Any:
        """Restore the result of `state_dict`."""
        ...


class Model(Protocol):
    """Optional for agents: a model of the environment, scored as property 9 of `ctgraph_rl.profile`."""

    def predict_next(self, history: TensorDictBase, choices: TensorDictBase) -> Tensor:
        """Return the probability of each pair of observation and reward to come next.

        Args:
            history: each row's episode so far, [rows, steps] in time order: ``observation``, the ``action`` that
                followed, int64, and ``reward``, float32, that came with the observation, 0 with the first. The last
                action's outcome is predicted.
            choices: all possible pairs, [choices]: ``observation`` and ``reward``.

        Returns:
            Natural logarithms of probabilities that sum to 1 in each row, float [rows, choices].
        """
        ...


class PlasticityLike(Protocol):
    """Keeps an agent's network able to learn. `ctgraph_rl.run` builds it as ``Class(**yaml)``."""

    needs_boundaries: bool
    """Whether it acts at task changes, which must be announced."""

    def attach(self, agent: Agent, curriculum: Curriculum) -> Agent:
        """Return the agent with it; arguments and errors as in `MethodLike`, which is attached next."""
        ...


class MethodLike(Protocol):
    """A lifelong-learning method: it changes how an agent learns. `ctgraph_rl.run` builds it as ``Class(**yaml)``."""

    def prepare(self, curriculum: Curriculum) -> Curriculum:
        """Return the curriculum to learn instead, mostly the same.

        Raises:
            ValueError: if the curriculum's protocol hides what the method needs.
        """
        ...

    def attach(self, agent: Agent, curriculum: Curriculum) -> Agent:
        """Return the agent, new until then, with this method attached.

        Args:
            agent: is part of what is returned.
            curriculum: by `prepare`.

        Raises:
            ValueError: if agent and method do not fit.
        """
        ...
