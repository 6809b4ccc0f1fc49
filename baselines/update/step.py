"""A gradient step of one learner: `update` as written, compiled, or replayed as a CUDA graph."""

from __future__ import annotations

from functools import partial

from baselines.parts.hooks import Hooks
from baselines.parts.networks import Data, TensorsByName
from baselines.update.trained import Trained
from baselines.update.update import UpdateState, parts_of, update
from ctgraph_rl.core.region import Region, captures


def take_step(learner: Trained, batch: Data) -> TensorsByName:
    """Take a step; the first one and unusual sizes run `update` as written."""
    if len(batch["action"]) != learner.minibatch_size or not learner.optimiser.state:
        return update(learner, update_state(learner), batch)
    if not is_captured(learner):
        return usual_update(learner, batch)
    learner.region = learner.region or Region(partial(usual_update, learner))
    if not learner.region.takes(batch):
        return update(learner, update_state(learner), batch)
    return learner.region.copies(batch)


def usual_update(learner: Trained, batch: Data) -> TensorsByName:
    """Take the step, compiled where the agent is."""
    return (learner.compiled_step or update)(learner, update_state(learner), batch)


def update_state(learner: Trained) -> UpdateState:
    """Return what an update of a learner changes."""
    return UpdateState(learner.weights, parts_of(learner.optimiser), others=learner.other_weights())


def is_captured(learner: Trained) -> bool:
    """Return whether steps are CUDA graphs: on GPUs, without a method."""
    return learner.capturable and type(learner.method) is Hooks and captures(next(learner.parameters()).device)
