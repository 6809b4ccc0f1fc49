"""The curves of a stream's run, from its log."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from statistics import fmean

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
    done = log.reached("evaluation") // stream.blocks.num_frames
    share = tuning_share(log.about)
    needed = len(stream.blocks) if share is None else min(done, stream.frames_of(share) // stream.blocks.num_frames)
    if done < needed or not needed:
        reason = Undefined(f"the run is not finished: it ended block {done:,} of {max(needed, 1):,}")
        return dict.fromkeys(INPUTS, reason)
    frames = stream.blocks.num_frames
    drawn = [stream.blocks.choice(place) for place in range(needed)]

    def by_block(value: Callable[[Task], float]) -> Tensor:
        return float64(list(map(value, stream.examples)))[drawn]

    step_reward = by_block(lambda task: task.step_reward)
    episodes, total, steps = _training(log, needed)
    paid = total + step_reward * (frames - steps)
    hides = stream.protocol.hides_episodes
    if hides:
        paid[step_reward != 0] = torch.nan  # steps between episodes pay nothing, and the log does not count them
    first = stream.examples[0]
    nothing = torch.full([needed], torch.nan, dtype=torch.float64, device="cpu")
    moments = float64(list(range(0, frames + 1, stream.evaluation.every or frames)))
    curves = LifeCurves(
        frames,
        moments,
        returns=nothing.unsqueeze(1).repeat(1, len(moments)),
        success=nothing.clone(),
        best=by_block(lambda task: optimal_value(task, 1.0)),
        zero=by_block(lambda task: task.fail_reward),
        untrained=nothing.clone(),
        lagged={lag: nothing.clone() for lag in LAGS},
        reward=paid,
        gain=by_block(lambda task: optimal_gain(task, pause=int(hides))),
        alike=all(replace(task, goal=first.goal) == first for task in stream.examples[1:]),
    )
    _fill(curves, log, [block[0] for block in stream.trained[: needed + 1]])
    noisy = not stream.evaluation.exact and any(task.reward_std for task in stream.examples)
    found: NamedValues = dict.fromkeys(INPUTS, NOT_OF_STREAMS)
    found |= {"life": NOISY if noisy else curves, "interval_best": curves.best}
    return found | {"episodes": episodes, "returns": ratio(total, episodes)}


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


def _fill(curves: LifeCurves, log: RunLog, trained: Sequence[int]) -> None:
    """Write what was evaluated into the curves; ``trained`` is each block's task, and that of the next block."""
    count = len(curves.success)
    last = len(curves.moments) - 1
    for m in log.of_kind("evaluation"):
        block = max(m["block"] - 1, 0)
        if block >= count:
            continue
        task = m["task"] - 1
        value = _number(m["return_mean"])
        within = m["frames"] - block * curves.frames
        if task == trained[block]:
            curves.returns[block, within * last // curves.frames] = value
        if within < curves.frames:
            continue
        if task == trained[block]:
            curves.success[block] = _number(m["success_rate"])
        if block + 1 < count and task == trained[block + 1]:
            curves.returns[block + 1, 0] = value
            curves.untrained[block + 1] = _number(m.get("untrained_return"))
        for lag, values in curves.lagged.items():
            if block >= lag and task == trained[block - lag] and task not in trained[block - lag + 1 : block + 1]:
                values[block] = value


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def by_windows(log: RunLog) -> RunLog:
    """Return a stream's log with a window of `NUM_WINDOWS` in place of each block and task, for tables and figures.

    Evaluations are means over a window's tasks at their blocks' ends, training those of up to `PARTS` parts.
    """
    ends: dict[int, NamedValues] = {}
    training: dict[int, list[NamedValues]] = {}
    for m in log.measurements:
        if m["kind"] == "training":
            training.setdefault(m["block"], []).append(m)
        elif m["kind"] == "evaluation" and m.get("moment") != "during":
            ends.setdefault(m["block"], m)  # the first of a block is of the task that it trains
    about = log.about
    count = about["life"] if tuning_share(about) is None else max(ends, default=0)
    blocks = torch.arange(1, max(count, 1) + 1, device="cpu")
    windows = [window.tolist() for window in blocks.tensor_split(min(NUM_WINDOWS, len(blocks)))]
    labels = [f"tasks {own[0]:,}-{own[-1]:,}" if len(own) > 1 else f"task {own[0]:,}" for own in windows]
    found = RunLog()
    found.torn_lines = log.torn_lines
    found.measurements = [{**about, "tasks": labels, "trained": [[number] for number in range(1, len(labels) + 1)]}]
    if 0 in ends:
        found.measurements.append({**ends[0], "label": labels[0]})
    for number, window in enumerate(windows, 1):
        for part in torch.tensor(window, dtype=torch.int64, device="cpu").tensor_split(min(PARTS, len(window))):
            own = [m for block in part.tolist() for m in training.get(block, ())]
            if own:
                found.measurements.append({"kind": "training", "block": number, **_mean_line(own)})
        at_end = [ends[block] for block in window if block in ends]
        if at_end:
            place = {"moment": "after", "block": number, "task": number, "label": labels[number - 1], "held_out": False}
            found.measurements.append({"kind": "evaluation", **place, **_mean_line(at_end)})
    return found


def _mean_line(lines: Sequence[NamedValues]) -> NamedValues:
    line: NamedValues = {"frames": lines[-1]["frames"], "seconds": lines[-1].get("seconds", 0.0)}
    for name in ("return_mean", "success_rate", "end_rate", "length_mean"):
        known = [m for m in lines if m.get(name) is not None]
        weights = [m.get("episodes") or 1 for m in known]
        line[name] = fmean([m[name] for m in known], weights) if known else None
    line["episodes"] = sum(m.get("episodes") or 0 for m in lines) or None
    return line
