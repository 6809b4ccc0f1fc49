"""The curves of a stream's run, from its log."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from ctgraph_rl.checks import NamedValues
from ctgraph_rl.log.run_log import RunLog, tuning_share
from ctgraph_rl.metrics.inputs import INPUTS
from ctgraph_rl.metrics.record import Undefined, float64, ratio
from ctgraph_rl.metrics.windows import NUM_WINDOWS, LifeCurves
from ctgraph_rl.tasks.curriculum import LAGS, Stream
from ctgraph_rl.tasks.gain import optimal_gain
from ctgraph_rl.tasks.task import Task
from ctgraph_rl.tasks.values import optimal_value

NOT_OF_STREAMS = Undefined("a stream has too many tasks for a matrix: its metrics are those of windows")

PARTS = 16
"""Of a window, for curves of training."""

NOISY = Undefined(
    "rewards have noise, so that means of episodes do not say what is adapted to: set evaluation.exact=true"
)


def life_inputs(log: RunLog, stream: Stream) -> NamedValues:
    """Return the inputs of metrics that a stream's run gives, the others `Undefined`.

    An unfinished run gives none, and a tuning run those of the whole blocks of its part.
    """
    reached = max((m["frames"] for m in log.of_kind("evaluation")), default=0)
    done = reached // stream.blocks.num_frames
    share = next(map(tuning_share, log.of_kind("run")), None)
    needed = len(stream.blocks) if share is None else min(done, stream.frames_of(share) // stream.blocks.num_frames)
    if done < needed or not needed:
        reason = Undefined(f"the run is not finished: it ended block {done:,} of {max(needed, 1):,}")
        return dict.fromkeys(INPUTS, reason)
    return {**dict.fromkeys(INPUTS, NOT_OF_STREAMS), **life_of_blocks(log, stream, needed)}


def life_of_blocks(log: RunLog, stream: Stream, count: int) -> NamedValues:
    """Return the inputs of the first blocks of a life: its curves, and training by block in place of intervals."""
    frames = stream.blocks.num_frames
    drawn = [stream.blocks.choice(place) for place in range(count)]

    def by_block(value: Callable[[Task], float]) -> Tensor:
        return float64(list(map(value, stream.examples)))[drawn]

    best = by_block(lambda task: optimal_value(task, 1.0))
    zero = by_block(lambda task: task.fail_reward)
    step_reward = by_block(lambda task: task.step_reward)
    episodes, total, steps = _training(log, count)
    paid = total + step_reward * (frames - steps)
    hides = stream.protocol.hides_episodes
    if hides:
        paid[step_reward != 0] = torch.nan  # steps between episodes pay nothing, and the log does not count them
    first, *others = stream.examples
    seen = _evaluations(log, stream, count)
    curves = LifeCurves(
        frames,
        seen.moments,
        seen.returns,
        success=seen.success,
        untrained=seen.untrained,
        lagged=seen.lagged,
        best=best,
        zero=zero,
        reward=paid,
        gain=by_block(lambda task: optimal_gain(task, pause=int(hides))),
        alike=all(replace(task, goal=first.goal) == first for task in others),
    )
    noisy = not stream.evaluation.exact and any(task.reward_std for task in stream.examples)
    return {
        "life": NOISY if noisy else curves,
        "episodes": episodes,
        "returns": ratio(total, episodes),
        "interval_best": best,
    }


def _training(log: RunLog, count: int) -> Tensor:
    """Return each block's finished episodes, the sums of their returns, and their steps, float64 [3, blocks].

    Every step pays the step reward, and all else is paid as an episode ends. NaN for a block without a line.
    """
    sums = torch.full([3, count], torch.nan, dtype=torch.float64, device="cpu")
    for m in log.of_kind("training"):
        if m["block"] <= count:
            played = m["episodes"]
            sums_of_line = float64([played, played and played * m["return_mean"], played and played * m["length_mean"]])
            sums[:, m["block"] - 1] = sums[:, m["block"] - 1].nan_to_num() + sums_of_line
    return sums


class _Seen(NamedTuple):
    moments: Tensor
    returns: Tensor
    success: Tensor
    untrained: Tensor
    lagged: dict[int, Tensor]


def _evaluations(log: RunLog, stream: Stream, count: int) -> _Seen:
    frames = stream.blocks.num_frames
    moments = range(0, frames + 1, stream.evaluation.every or frames)
    nothing = torch.full([count], torch.nan, dtype=torch.float64, device="cpu")
    returns = nothing.unsqueeze(1).repeat(1, len(moments))
    success = nothing.clone()
    untrained = nothing.clone()
    lagged = {lag: nothing.clone() for lag in LAGS}
    trained = [block[0] for block in stream.trained[: count + 1]]
    for m in log.of_kind("evaluation"):
        block = max(m["block"] - 1, 0)
        if block >= count:
            continue
        task = m["task"] - 1
        value = _number(m["return_mean"])
        within = m["frames"] - block * frames
        if task == trained[block]:
            returns[block, moments.index(within)] = value
        if within < frames:
            continue
        if task == trained[block]:
            success[block] = _number(m["success_rate"])
        if block + 1 < count and task == trained[block + 1]:
            returns[block + 1, 0] = value
            untrained[block + 1] = _number(m.get("untrained_return"))
        for lag, values in lagged.items():
            if block >= lag and task == trained[block - lag] and task not in trained[block - lag + 1 : block + 1]:
                values[block] = value
    return _Seen(float64(list(moments)), returns, success, untrained, lagged)


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def by_windows(log: RunLog) -> RunLog:
    """Return a stream's log with a window of `NUM_WINDOWS` in place of each block and task, for tables and figures.

    Evaluations are means over a window's tasks at their blocks' ends, training those of up to `PARTS` parts.
    """
    about = log.of_kind("run")[0]
    ends: dict[int, NamedValues] = {}
    for m in log.of_kind("evaluation"):
        if m.get("moment") != "during":
            ends.setdefault(m["block"], m)  # the first of a block is of the task that it trains
    training: dict[int, list[NamedValues]] = {}
    for m in log.of_kind("training"):
        training.setdefault(m["block"], []).append(m)
    labels = []
    lines = [{**ends[0], "label": ""}] if 0 in ends else []
    blocks = torch.arange(1, about["life"] + 1, device="cpu")
    for number, window in enumerate(blocks.tensor_split(min(NUM_WINDOWS, about["life"])), 1):
        first, last = window[0].item(), window[-1].item()
        labels.append(f"tasks {first:,}-{last:,}" if last > first else f"task {first:,}")
        for part in window.tensor_split(min(PARTS, len(window))):
            own = [m for block in part.tolist() for m in training.get(block, ())]
            if own:
                lines.append({"kind": "training", "block": number, **_mean_line(own)})
        at_end = [ends[block] for block in window.tolist() if block in ends]
        if at_end:
            place = {"kind": "evaluation", "moment": "after", "block": number, "task": number, "held_out": False}
            lines.append({**place, **_mean_line(at_end)})
    found = RunLog()
    found.torn_lines = log.torn_lines
    found.measurements = [{**about, "tasks": labels, "trained": [[number] for number in range(1, len(labels) + 1)]}]
    for line in lines:
        found.measurements.append({**line, "label": labels[line.get("task", 1) - 1]})
    return found


def _mean_line(lines: Sequence[NamedValues]) -> NamedValues:
    line: NamedValues = {"frames": lines[-1]["frames"], "seconds": lines[-1].get("seconds", 0.0)}
    for name in ("return_mean", "success_rate", "end_rate", "length_mean"):
        known = [m for m in lines if m.get(name) is not None]
        weight = sum(m.get("episodes") or 1 for m in known)
        line[name] = sum(m[name] * (m.get("episodes") or 1) for m in known) / weight if known else None
    line["episodes"] = sum(m.get("episodes") or 0 for m in lines) or None
    return line
