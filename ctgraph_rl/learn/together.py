"""The loop over a curriculum for several seeds as one batch: one environment, one forward pass, one gradient step."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Protocol

import torch
from tensordict import TensorDict, TensorDictBase

from ctgraph_rl.agent import Agent
from ctgraph_rl.checks import takes_numbers
from ctgraph_rl.core.device import checked_device
from ctgraph_rl.env import CTGraphEnv
from ctgraph_rl.learn.collect import Policy, make_env
from ctgraph_rl.learn.evaluate import Evaluator
from ctgraph_rl.learn.lifelong import (
    Progress,
    announced_id,
    collect_segment,
    log_training,
    require_finite,
    saved_state_fits,
    segments,
)
from ctgraph_rl.learn.rules import check_ids, check_rows
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.task import are_graphs

OfferCheckpoints = Callable[[Callable[[], list[dict[str, Any]]], bool], object]
"""Takes a function that makes the state of each seed's run, and whether a block ends here."""


class Group(Protocol):
    """Agents of one configuration with different seeds that act and learn together, such as `baselines.together.Group`.

    Between two calls each agent is as if it had learned alone.
    """

    agents: Sequence[Agent]
    generators: Sequence[torch.Generator]
    """What each agent draws from, in place of torch's global generator."""

    policy: Policy
    """Writes the actions of all rows, [seeds * num_envs], those of a seed one after the other."""

    def start_task(self, task: int | None = None) -> None:
        """See `ctgraph_rl.agent.Agent`."""
        ...

    def end_task(self) -> None:
        """See `ctgraph_rl.agent.Agent`."""
        ...

    def learn(self, batch: TensorDictBase) -> Sequence[dict[str, float] | FloatingPointError]:
        """Learn from a batch, [seeds * num_envs, num_steps]; return what each agent measured, or raised.

        An agent that raised gets batches as before. Neither then nor later does it change a bit of another's.
        """
        ...


def why_not_together(curriculum: Curriculum) -> str | None:
    """Return why seeds cannot learn a curriculum in one environment; None if they can."""
    kind = type(curriculum.tasks[0]).__name__
    if not are_graphs(curriculum.tasks):
        return f"the rows of {kind} cannot draw from the streams of several seeds, as those of CT-graphs can"
    shared = any(block.switch is not None and block.switch.together for block in curriculum.blocks)
    if curriculum.protocol.guide_frames:
        return "a guide draws from the generator of one seed"
    return "its blocks change the tasks of all rows at once" if shared else None


@takes_numbers
def learn_together(
    curriculum: Curriculum,
    group: Group,
    seeds: Sequence[int],
    logs: Sequence[RunLog],
    progress: Progress | None = None,
    *,
    device: torch.device | str = "cpu",
    saved: Sequence[Mapping[str, Any]] | None = None,
    checkpoint: OfferCheckpoints | None = None,
) -> dict[int, FloatingPointError]:
    """Let agents with different seeds learn a curriculum as `learn_curriculum` lets one.

    Each seed has the rows of the environment, the generator, the evaluations and the log that it has alone; no seed's
    numbers depend on another's data. Losses and actions differ from those of a run alone by rounding. A seed with a
    loss or weight that is not finite has failed: it measures nothing from then on, and the others learn on as ever.

    Args:
        curriculum: what to learn; `why_not_together` has no objection.
        group: the learners.
        seeds: of each agent.
        logs: where the measurements of each are appended.
        progress: is updated after every batch with the mean return of all seeds.
        device: where the environment lives.
        saved: the states of all seeds, as ``checkpoint`` was given them, to resume from with the same bits as if the
            group had never stopped.
        checkpoint: is offered the states after every batch.

    Returns:
        The error of each seed that failed, by its position in ``seeds``; names the seed, the block and the frames.

    Raises:
        ValueError: before any work, as `learn_curriculum` does.
    """
    device, [agent, *_] = checked_device(device), group.agents
    check_rows(curriculum, agent.num_envs)
    check_ids(curriculum, agent)
    env = _make_env(curriculum, agent.num_envs, seeds, device)
    evaluators = [Evaluator(curriculum, seed, log, device) for seed, log in zip(seeds, logs, strict=True)]
    actor = _Actor(group, agent.num_steps)
    failed = {} if saved is None else _saved_failures(saved)

    def evaluate(frames: int) -> None:
        for number, (evaluator, each) in enumerate(zip(evaluators, group.agents, strict=True)):
            if number not in failed:
                evaluator.evaluate_if_due(each, frames)

    if saved is None:
        evaluate(0)
    frames = 0 if saved is None else saved[0]["frames"]
    for segment in segments(curriculum, frames):
        if frames == segment.start:
            group.start_task(announced_id(curriculum, segment.blocks[0]))
            saved = None
        place = {"done": frames - segment.start, "num_seeds": len(seeds)}
        restore = None if saved is None else partial(_restore, saved, group, env)
        for batch, carried in collect_segment(segment, env, actor, evaluate, restore=restore, **place):
            start, frames = frames, frames + batch.numel() // len(seeds)
            block = curriculum.block_at(frames)
            where = f"in block {block} after {frames} frames; the run stops here"
            measured = group.learn(batch)
            for number, (seed, each) in enumerate(zip(seeds, measured, strict=True)):
                error = _failure(seed, each, where)
                if error is not None:
                    failed.setdefault(number, error)
            if len(failed) == len(seeds):
                return failed
            given = enumerate(zip(logs, batch.chunk(len(seeds)), measured, strict=True))
            returns = [
                log_training(log, curriculum, part, start, each)
                for number, (log, part, each) in given
                if number not in failed and not isinstance(each, FloatingPointError)
            ]
            if progress is not None:
                progress.update(block, frames, sum(returns) / len(returns))
            if checkpoint is not None:
                make_states = partial(_states, frames, group, env, carried, logs=logs, failed=failed)
                checkpoint(make_states, curriculum.is_end(frames))
        group.end_task()
        evaluate(frames)
    return failed


class _Actor:
    """The agents of a group as one that acts; none has a recurrent state."""

    def __init__(self, group: Group, num_steps: int) -> None:
        self.policy, self.num_steps = group.policy, num_steps

    def initial_state(self, num_envs: int) -> TensorDict:
        """Return an empty state."""
        return TensorDict(batch_size=[num_envs])


def _make_env(curriculum: Curriculum, num_envs: int, seeds: Sequence[int], device: torch.device) -> CTGraphEnv:
    """Return an environment with the rows of each seed as it has them alone, one seed after the other."""
    env: CTGraphEnv = make_env(curriculum, len(seeds) * curriculum.blocks[0].rows(num_envs), seeds[0], device)
    seed = torch.tensor(seeds, device=device).repeat_interleave(num_envs)
    env.rows.set_streams(seed, torch.arange(num_envs, device=device).repeat(len(seeds)))
    return env


def _failure(seed: int, measured: dict[str, float] | FloatingPointError, where: str) -> FloatingPointError | None:
    """Return the error of a seed whose measurements are not finite; None where they are."""
    try:
        if isinstance(measured, FloatingPointError):
            raise measured
        require_finite(measured)
    except FloatingPointError as error:
        return FloatingPointError(f"seed {seed}: {error} {where}")
    return None


def _saved_failures(saved: Sequence[Mapping[str, Any]]) -> dict[int, FloatingPointError]:
    """Return the errors of seeds that had failed when the states were saved."""
    return {number: FloatingPointError(state["failed"]) for number, state in enumerate(saved) if "failed" in state}


def _states(
    frames: int,
    group: Group,
    env: CTGraphEnv,
    carried: TensorDictBase,
    *,
    logs: Sequence[RunLog],
    failed: Mapping[int, FloatingPointError],
) -> list[dict[str, Any]]:
    """Return the state of each seed's run, as `learn_curriculum` saves that of one; a run alone cannot resume it."""
    count = len(group.agents)
    of_env = {key: value.chunk(count) for key, value in env.state_dict().items()}
    given = zip(group.agents, group.generators, carried.chunk(count), logs, strict=True)
    return [
        {
            "frames": frames,
            "agent": agent.state_dict(),
            "env": {key: parts[number].clone() for key, parts in of_env.items()},
            "carried": part.clone().to_dict(),
            "random": generator.get_state(),
            "random_cuda": None,
            "log": log.position(),
            **({"failed": str(failed[number])} if number in failed else {}),
        }
        for number, (agent, generator, part, log) in enumerate(given)
    ]


def _restore(saved: Sequence[Mapping[str, Any]], group: Group, env: CTGraphEnv) -> TensorDictBase:
    """Restore the saved states; return the data that the next step starts from."""
    with saved_state_fits():
        for agent, generator, state in zip(group.agents, group.generators, saved, strict=True):
            agent.load_state_dict(state["agent"])
            generator.set_state(state["random"])
        states = [state["env"] for state in saved]
        env.load_state_dict({key: torch.cat([state[key] for state in states]) for key in states[0]})
    num_envs = env.numel() // len(saved)
    return torch.cat([TensorDict(state["carried"], [num_envs], device=env.device) for state in saved])
