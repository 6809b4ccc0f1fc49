"""What lifelong-learning methods, and methods against lost plasticity, can change in a gradient step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from tensordict import TensorDictBase
from torch import Tensor, nn

from baselines.parts.networks import Data, TensorsByName


class Hooks(nn.Module):
    """Hooks that change nothing; an agent calls them in each gradient step, in this order.

    Those after the first get the weights by which the agent's losses are differentiated, a tensor of each layer's.
    Buffers and parameters are saved with the agent.
    """

    stackable: ClassVar[bool] = True
    """Whether several seeds can share a gradient step (`baselines.update.seeds`). A subclass that overrides a hook must
    set it again.
    """

    of_one_seed: ClassVar[bool] = False
    """Whether `transform_gradients` and `after_step` take one seed's tensors and are vectorised; else they also take
    several seeds', as a leading dimension.
    """

    acts_on_batches: ClassVar[bool] = False
    """Whether `on_batch` draws or changes weights, which seeds on a GPU cannot follow."""

    step_buffers: ClassVar[tuple[str, ...]] = ()
    """Buffers that the hooks of a step write in place."""

    def network_weights(self, trained: list[nn.Parameter]) -> list[nn.Parameter]:
        """Return the parameters by which losses are differentiated, given what the optimiser trains."""
        return trained

    def transform_minibatch(self, batch: Data) -> Data:
        """Return the minibatch to learn from."""
        return batch

    def penalties(self, batch: Data, weights: Sequence[Tensor]) -> TensorsByName:
        """Return scalars to add to the agent's losses, named ``loss_*``."""
        return {}

    def transform_gradients(self, gradients: Sequence[Tensor], weights: Sequence[Tensor]) -> Sequence[Tensor]:
        """Return the gradients of the optimiser's parameters, given those of the weights."""
        return gradients

    def after_step(self, weights: Sequence[Tensor]) -> None:
        """Called after each step of the optimiser; may write the weights."""

    def weights_rewritten(self, change: Tensor) -> None:
        """Called after a plasticity changed the weights by this much between two gradient steps, float32 [P]."""


class PlasticityHooks(nn.Module):
    """Hooks that keep nothing plastic; a `Learner` calls them around each gradient step, in this order."""

    stackable: bool = True
    """Whether it acts on gradient steps by `penalties` only, which several seeds can share."""

    needs_starts: bool = False
    """Whether `start_task` does anything."""

    recycles: bool = False
    """Whether it writes weights other than by the optimiser, which methods that fix weights refuse."""

    def start_task(self) -> None:
        """Called at the start of a task, before the method's."""

    def on_batch(self, batch: TensorDictBase) -> None:
        """Called with each batch, [num_envs, num_steps], before learning."""

    def transform_minibatch(self, batch: Data) -> Data:
        """Return the minibatch to learn from."""
        return batch

    def penalties(self, batch: Data, weights: Sequence[Tensor]) -> TensorsByName:
        """Return scalars to add to the agent's losses, named ``loss_*``; arguments as in `Hooks`."""
        return {}

    def after_step(self, batch: Data, measured: TensorsByName) -> TensorsByName:
        """Called after a gradient step with what it measured; may write the weights, and measure more."""
        return measured
