"""Segments of a curriculum between announced boundaries: their batches, and the lines that they log."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from ctgraph_rl.agent import Agent
from ctgraph_rl.learn.collect import ENDS, Policy, batches
from ctgraph_rl.learn.evaluate import EPISODE_KEYS, means_by_part
from ctgraph_rl.learn.guide import Guide, guided_share
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.protocol import Block


class Segment(NamedTuple):
    """Blocks with no announced boundary between them."""

    start: int  # frames of the run before it
    blocks: Sequence[Block]
    ends: Sequence[int]  # frames of the run at the end of each block

    @property
    def end(self) -> int:
        """Frames of the run at its end."""
        return self.ends[-1]

    def block_at(self, frames: int) -> Block:
        """Return the block that comes after ``frames`` frames of the run; at the end the last."""
        return self.blocks[bisect_right(self.ends, frames, hi=len(self.ends) - 1)]


def segments(curriculum: Curriculum, frames: int) -> Iterator[Segment]:
    """Yield the segments that end at or after ``frames`` frames of the run."""
    if not curriculum.protocol.announces:
        yield Segment(0, curriculum.blocks, curriculum.ends)
        return
    for number in range(max(curriculum.block_at(frames), 1), len(curriculum.blocks) + 1):
        start = curriculum.ends[number - 2] if number > 1 else 0
        yield Segment(start, curriculum.blocks[number - 1 : number], curriculum.ends[number - 1 : number])


def collect_segment(
    segment: Segment,
    env: EnvBase,
    agent: Agent,
    evaluate: Callable[[int], object],
    *,
    policy: Policy,
    done: int,
    restore: Callable[[], TensorDictBase] | None,
    num_seeds: int,
    guide_frames: int,
) -> Iterator[tuple[TensorDictBase, TensorDictBase]]:
    """Yield the batches of a segment, each with the data of the next step.

    Args:
        segment: what is learned; its frames are those of one seed.
        agent: says how many steps a batch has, and the first recurrent state.
        evaluate: called between two steps with the frames of the run so far.
        done: frames of the segment that were learned before.
        restore: restores a state between two batches, and returns the data of the next step.
    """
    _set_tasks(env, segment.block_at(segment.start + done), num_seeds)
    carried = None if restore is None else restore()
    num_rows = env.numel() // num_seeds
    guide = Guide(policy, env, guide_frames) if done < guide_frames else None

    def between_steps(of_all_seeds: int) -> None:
        frames = of_all_seeds // num_seeds
        if guide is not None:
            guide.frames = frames
        if frames:
            evaluate(segment.start + frames)
        following = segment.start + frames + num_rows
        if following in segment.ends[:-1]:  # so that a row whose episode ends with the block begins none of its task
            _set_tasks(env, segment.block_at(following), num_seeds, at_episode_end=True)

    return batches(
        env,
        policy if guide is None else guide,
        num_seeds * (segment.end - segment.start),
        agent.num_steps,
        agent.initial_state,
        between_steps=between_steps,
        carried=carried,
        done=num_seeds * done,
    )


def _set_tasks(env: EnvBase, block: Block, num_seeds: int, at_episode_end: bool = False) -> None:
    if block.switch is None:
        env.set_tasks(num_seeds * block.rows(env.numel() // num_seeds), at_episode_end)
    else:
        env.switch_tasks(block.tasks, block.switch, at_episode_end)


def announced_id(curriculum: Curriculum, block: Block) -> int | None:
    """Return the task id announced at the start of a block of one task, unless ids are hidden."""
    how = curriculum.protocol
    known = how.task_id != "hidden" and how.announces and len(set(block.tasks)) == 1
    return curriculum.task_ids[block.tasks[0]] if known else None


def guided(frames: int, curriculum: Curriculum) -> dict[str, float]:
    """Return the guided share of new episodes when a batch began; empty without a guide."""
    guide_frames = curriculum.protocol.guide_frames
    return {"guided_share": guided_share(frames, guide_frames)} if guide_frames else {}


def log_training(
    logs: Sequence[RunLog],
    curriculum: Curriculum,
    batch: TensorDictBase,
    start: int,
    measurements: Sequence[Mapping[str, float] | None],
    *,
    events: Collection[str],
) -> list[float]:
    """Append a line of each learner for each block that a batch has frames of; return the last lines' mean returns.

    Args:
        batch: [learners * rows, steps].
        start: frames of a learner before it.
        measurements: of each learner on the batch; None for one that measures nothing any more.
        events: names of measurements of the batch's end, 0 in its other parts.
    """
    frames = start
    num_rows = len(batch) // len(logs)
    end = start + num_rows * batch.shape[1]
    returns: list[float] = []
    within = curriculum.ends[bisect_right(curriculum.ends, start) : bisect_left(curriculum.ends, end)]
    cuts = [0, *((each - start) // num_rows for each in within), batch.shape[1]]
    for first, last in pairwise(cuts):
        part = batch[:, first:last]
        frames += num_rows * (last - first)
        block = curriculum.block_at(frames)
        after = part["next"].get(ENDS, part["next"])
        is_end = after["done"].squeeze(-1)
        counts = is_end.unflatten(0, (len(logs), num_rows)).sum(dim=(1, 2)).tolist()
        means = means_by_part(after.select(*EPISODE_KEYS, strict=False)[is_end], counts)
        returns = []
        for log, episodes, own in zip(logs, means, measurements, strict=True):
            if own is None:
                continue
            measured = episodes | dict(own)
            if frames != end:
                measured |= dict.fromkeys(own.keys() & set(events), 0)
            log.append("training", block=block, frames=frames, **measured)
            returns.append(episodes["return_mean"])
    return returns
