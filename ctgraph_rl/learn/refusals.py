"""What is refused of a curriculum and an agent before any work, and notes on them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from torch import nn
from torchrl.envs import EnvBase

from ctgraph_rl.agent import Agent
from ctgraph_rl.batch.specs import TASK_NUMBER
from ctgraph_rl.checks import Rule, require
from ctgraph_rl.core.rewards import KERNEL_REWARDS
from ctgraph_rl.env import CTGraphEnv
from ctgraph_rl.learn.exact import exact_rules
from ctgraph_rl.tasks.curriculum import Curriculum, Stream
from ctgraph_rl.tasks.task import Task, are_graphs

MOST_LINES = 2**20
"""Most lines of evaluations in a log."""


def check_learner(curriculum: Curriculum, agent: Agent) -> None:
    """Refuse an agent that cannot learn a curriculum, or be evaluated on it.

    Raises:
        ValueError: as the functions below.
    """
    check_rows(curriculum, agent.num_envs)
    for check in (check_ids, check_episodes, check_adaptation, check_exact):
        check(curriculum, agent)


def check_rows(curriculum: Curriculum, num_envs: int) -> None:
    """Refuse a curriculum whose blocks are not whole steps of ``num_envs`` rows, and too many evaluations.

    Raises:
        ValueError: names the block and the nearest possible frames, or the tasks that cannot share the rows.
    """
    evaluation = curriculum.evaluation
    evaluation.check((*curriculum.examples, *evaluation.held_out))
    rules: dict[Any, Rule] = {"every": evaluation.every_rule(num_envs)}
    alike: dict[int, list[str]] = {}
    for number, block in enumerate(curriculum.example_blocks, 1):
        block.rows(num_envs)
        numbers = alike.setdefault(block.num_frames, [])
        numbers.append(str(number))
        rules[block.num_frames] = block.frame_rule(num_envs, f"block {', '.join(numbers)}")
    require(*rules.values())
    check_lines(curriculum)


def check_lines(curriculum: Curriculum) -> None:
    """Refuse a curriculum whose evaluations write too many lines.

    Raises:
        ValueError: names the lines.
    """
    if isinstance(curriculum, Stream):
        return
    how = curriculum.evaluation
    tasks = len(curriculum.tasks) + len(how.held_out)
    moments = how.before + how.at_block_ends * len(curriculum.blocks)
    moments += curriculum.num_frames // how.every if how.every else 0
    lines = tasks * moments
    writes = f"evaluating {tasks:,} tasks {moments:,} times writes {lines:,} lines to the log, more than {MOST_LINES:,}"
    fix = "set evaluation.at_block_ends=false and a larger evaluation.every, or take curriculum=stream"
    require((lines <= MOST_LINES, f"{writes}: {fix}"))


def resumes(curriculum: Curriculum) -> bool:
    """Return whether environments of all tasks can be saved within an episode."""
    return all(getattr(task, "resumes", False) for task in curriculum.examples)


def check_env(curriculum: Curriculum, env: EnvBase) -> None:
    """Refuse a curriculum that asks for what an environment cannot do.

    Raises:
        ValueError: for a switch within a block, or a guide.
    """
    kind = type(curriculum.examples[0]).__name__
    switches = any(block.switch is not None for block in curriculum.example_blocks)
    guide = f"protocol.guide_frames={curriculum.protocol.guide_frames} needs CT-graphs, not {kind}: set it to 0"
    switch = f"a block with a switch needs an environment with switch_tasks, which {kind} has not: leave it out"
    require(
        (isinstance(env, CTGraphEnv) or not curriculum.protocol.guide_frames, guide),
        (hasattr(env, "switch_tasks") or not switches, switch),
    )


def check_ids(curriculum: Curriculum, agent: Agent) -> None:
    """Refuse an agent made for task ids where the curriculum shows none."""
    reads = {"task_id", TASK_NUMBER} & set(getattr(agent.policy, "in_keys", None) or ())
    shows = curriculum.protocol.task_id == "one_hot"
    message = f"{type(agent).__name__} reads task ids, which {curriculum.name} does not show"
    require((shows or not reads, f"{message}; give it a curriculum with protocol.task_id=one_hot, or make a new agent"))


def check_episodes(curriculum: Curriculum, agent: Agent) -> None:
    """Refuse an agent with ``needs_episodes`` where the curriculum hides their ends.

    Raises:
        ValueError: names the agent.
    """
    learner = getattr(agent, "unwrapped", agent)
    hides = curriculum.protocol.hides_episodes
    needs = f"{type(learner).__name__} needs the ends of episodes, which are hidden: set protocol.episodes=shown"
    require((not hides or not getattr(learner, "needs_episodes", False), needs))


def check_share(curriculum: Curriculum, agent: Agent, until: float | None) -> None:
    """Refuse a tuning run of fewer than two batches, after which trials hardly differ.

    Raises:
        ValueError: names the frames of both.
    """
    if until is None:
        return
    frames = curriculum.frames_of(until)
    batch = agent.num_envs * agent.num_steps
    share = f"objective_until={until} is {frames:,} of num_frames={curriculum.num_frames:,}"
    shape = f"num_envs={agent.num_envs} x num_steps={agent.num_steps} = {batch:,} frames"
    fix = "set a larger share or more frames, or a smaller num_envs or num_steps"
    require((frames >= 2 * batch, f"{share}, less than two batches of {shape}: {fix}"))


def check_exact(curriculum: Curriculum, agent: Agent) -> None:
    """Refuse exact evaluation of an agent, or on a task, that has no exact measures.

    Raises:
        ValueError: names the first reason and the setting to use.
    """
    if not curriculum.evaluation.exact:
        return
    start = dict(agent.initial_state(1).items())
    for task in (*curriculum.examples, *curriculum.evaluation.held_out):
        for rule in exact_rules(agent.policy, task, start, type(agent).__name__):
            require(rule)


def check_adaptation(curriculum: Curriculum, agent: Agent) -> None:
    """Refuse an agent that adapts where it has nothing to adapt to, or too few episodes or steps.

    Args:
        agent: with ``adapt_episodes`` it adapts to a row's task after so many of its episodes. With
            ``needs_whole_trials`` it learns nothing from trials of ``trial_episodes`` that a batch cuts.
    """
    needed = getattr(agent, "adapt_episodes", 0)
    if not needed:
        return
    name = type(agent).__name__
    how = curriculum.evaluation
    row = f"rows of an evaluation have {how.row_episodes} episodes, and {name} adapts after {needed}"
    without = []
    for number, block in enumerate(curriculum.example_blocks, 1):
        if len(set(block.tasks)) == 1 and getattr(block.tasks[0], "goal_change", None) is None:
            without.append(str(number))
    one = f"{name} learns to adapt to tasks that are drawn, and block {', '.join(without)} has one task"
    steps = 0
    if getattr(agent, "needs_whole_trials", False):
        lengths = [task.graph.expected_episode_length for task in curriculum.examples if isinstance(task, Task)]
        steps = math.ceil(agent.trial_episodes * max(lengths, default=0))  # type: ignore[attr-defined]
    trial = f"a trial of {getattr(agent, 'trial_episodes', 0)} episodes that reach an end takes {steps} steps"
    cut = f"num_steps={agent.num_steps} of {name}: {trial}, and {name} learns from whole trials in a batch"
    require(
        (agent.num_steps >= steps, f"{cut}: set agent.num_steps={2 * steps}, which is two trials"),
        (not without, f"{one}: give a block all goals, as nm_uniform_goals does, or its task a goal_change"),
        (how.row_episodes > needed, f"{row}: set evaluation.adapt_episodes={needed}"),
    )


def why_not_together(curriculum: Curriculum) -> str | None:
    """Return why seeds cannot learn a curriculum in one environment, if they cannot."""
    kind = type(curriculum.examples[0]).__name__
    if not are_graphs(curriculum.examples):
        return f"the rows of {kind} cannot draw from the streams of several seeds, as those of CT-graphs can"
    shared = any(block.switch is not None and block.switch.together for block in curriculum.example_blocks)
    if isinstance(curriculum, Stream) and curriculum.blocks.seed is None:
        return "each seed draws its own tasks: give curriculum.seed=0, and all learn one life"
    if curriculum.protocol.guide_frames:
        return "a guide draws from the generator of one seed"
    return "its blocks change the tasks of all rows at once" if shared else None


def notes(curriculum: Curriculum, agent: Agent) -> Iterator[str]:
    """Yield what to know of a curriculum, and of an agent on it, before a run."""
    method = getattr(agent, "method", None)
    parts = method.modules() if isinstance(method, nn.Module) else ()
    kept = sum(getattr(part, "bytes_per_task", 0) for part in parts)
    if kept and isinstance(curriculum, Stream):
        whole = kept * len(curriculum.blocks)
        yield f"{type(method).__name__} keeps {kept:,} bytes for each task, {whole:,} in all, and in each checkpoint"
    rewards = {type(task.reward_fn) for task in curriculum.examples if isinstance(task, Task)}
    slow = sorted(kind.__name__ for kind in rewards - {*KERNEL_REWARDS})
    if slow:
        yield f"the C kernel does not know {', '.join(slow)}: steps take the tensor engine, which is slower"
    if not resumes(curriculum):
        kind = type(curriculum.examples[0]).__name__
        yield f"{kind} cannot be saved within an episode: a run that is stopped resumes from its last announced block"
