"""The environment on one device, from step by step to fused: ``python -m benchmarks.environments --device cuda``.

The yardstick is a copy of the observations' bytes, on the same device in the same run.
"""

from __future__ import annotations

import argparse
import platform
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from rich.console import Console
from rich.progress import track
from torch import Tensor

from ctgraph_rl.batch.rollout import Steps, rollout
from ctgraph_rl.batch.rows import Rows
from ctgraph_rl.checks import at_least_one, positive, require
from ctgraph_rl.core import dynamics
from ctgraph_rl.core.dynamics import RowState, Words
from ctgraph_rl.core.region import WARM_UP, Region
from ctgraph_rl.core.row_params import RowParams
from ctgraph_rl.core.tree import is_done
from ctgraph_rl.env import CTGraphEnv
from ctgraph_rl.log.escape import markdown_table
from ctgraph_rl.tasks.task import Task

Options = argparse.Namespace

TimedRun = Callable[[], int]

NUM_STEPS = 32

COPY = "copy of the observations"
GOAL, FUSED = 0.5e9, 5e9
"""Observations a second at 65,536 rows: the goal, and fused steps."""


@dataclass
class Rung:
    """A way to step or learn, and its observations a second."""

    name: str
    task: str
    num_rows: int
    make: Callable[[], TimedRun]
    goal: float = 0.0  # observations a second; 0: none
    speeds: list[float] = field(default_factory=list)
    failure: str = ""


def rungs(device: torch.device, num_rows: Sequence[int], tasks: Mapping[str, Task]) -> list[Rung]:
    """Return what is measured, in the order of the table."""
    size = next(iter(tasks.values())).images.shape
    measured = []
    for n in num_rows:
        measured.append(Rung(COPY, "", n, partial(_copy, n, size, device)))
        for name, task in tasks.items():
            for way, make in WAYS.items():
                goal = FUSED if make is _fused else GOAL
                measured.append(Rung(way, name, n, partial(make, [task] * n, device), goal))
    return measured


def _copy(num_rows: int, size: Sequence[int], device: torch.device) -> TimedRun:
    source = torch.randint(0, 255, (NUM_STEPS, num_rows, *size), dtype=torch.uint8, device=device)
    target = torch.empty_like(source)

    def run() -> int:
        target.copy_(source)
        return NUM_STEPS * num_rows

    return run


def _torchrl(tasks: Sequence[Task], device: torch.device) -> TimedRun:
    env = CTGraphEnv(tasks, device=device, check_actions=False, info=False, kernel="off")

    def run() -> int:
        with torch.no_grad():
            env.rollout(NUM_STEPS, break_when_any_done=False)
        return NUM_STEPS * len(tasks)

    return run


def _eager(tasks: Sequence[Task], device: torch.device) -> TimedRun:
    rows, steps, actions = _prepared(tasks, device)

    def run() -> int:
        rollout(rows, actions, steps, kernel="off")
        return actions.numel()

    return run


def _captured(tasks: Sequence[Task], device: torch.device) -> TimedRun:
    rows, steps, actions = _prepared(tasks, device)

    def taken(given: dict[Any, Tensor]) -> dict[Any, Tensor]:
        rows.state = RowState(**given)
        rollout(rows, actions, steps, kernel="off")
        return rows.state._asdict()

    return _replayed(Region(taken), rows, actions)


def _fused(tasks: Sequence[Task], device: torch.device) -> TimedRun:
    rows, steps, actions = _prepared(tasks, device)
    step = torch.compile(write_step, fullgraph=True, dynamic=False)
    draws = torch.compile(dynamics.words_of, fullgraph=True, dynamic=False)
    params, observation = in_words(rows, steps)

    @torch.no_grad()
    def taken(given: dict[Any, Tensor]) -> dict[Any, Tensor]:
        state = tuple(given.values())
        words = draws(given["tick"], params, rows.uses)
        for t in range(NUM_STEPS):
            outputs = (observation[t + 1], steps.reward[t], steps.done[t], steps.outcome[t])
            state, words = step(outputs, state, actions[t], words, params=params, uses=rows.uses)
        return dict(zip(given, state, strict=True))

    return _replayed(Region(taken), rows, actions)


def in_words(rows: Rows, steps: Steps) -> tuple[RowParams, Tensor]:
    """Return rows' tasks and the buffer of observations, as 64-bit words if steps only copy images.

    Returns:
        The tasks, with a bank of int64 [views, bytes / 8], and the buffer, int64 [steps + 1, N, bytes / 8]; both
        unchanged for images with noise, late rotation or a cue, or without whole words.
    """
    params = rows.params
    uses = rows.uses
    observation = steps.observation
    bank = params.bank.flatten(1)
    buffer = observation.flatten(2)
    if uses.pixel_noise or uses.reward_cue or params.x.taps is not None or bank.shape[1] % 8:
        return params, observation
    return params._replace(bank=bank.view(torch.int64)), buffer.view(torch.int64)


def write_step(
    outputs: Sequence[Tensor], state: Sequence[Tensor], action: Tensor, words: Words, params: Any, uses: Any
) -> tuple[tuple[Tensor, ...], Words]:
    """Take a step of `rollout` by the tensor engine, and write it into buffers.

    Compiled, it writes each observation once.

    Args:
        outputs: buffers of the next observation, and the step's reward, done and outcome.
        state: the fields of `RowState`; ``torch.compile`` returns no named tuples.
        action: int64 [N].

    Returns:
        The next states, and their draws.
    """
    after = dynamics.advance(RowState(*state), action, words, params, uses, absorbing=False)
    done = is_done(after, params.tree)
    reward = after.reward
    outcome = dynamics.arrivals(after, done, params)[0]
    after = dynamics.begin(after, done, params, uses)
    words = dynamics.words_of(after.tick, params, uses)
    shown = (dynamics.observe(after, words, params, uses), reward, done, outcome)
    for buffer, value in zip(outputs, shown, strict=True):
        buffer.copy_(value)
    return tuple(after), words


WAYS: dict[str, Callable[[Sequence[Task], torch.device], TimedRun]] = {
    "TorchRL rollout": _torchrl,
    "rollout": _eager,
    "rollout, captured": _captured,
    "rollout, fused and captured": _fused,
}


def _prepared(tasks: Sequence[Task], device: torch.device) -> tuple[Rows, Steps, Tensor]:
    rows = Rows(tasks, device=device, kernel="off")
    return rows, Steps.empty(rows, NUM_STEPS), torch.randint(0, 3, (NUM_STEPS, len(tasks)), device=device)


def _replayed(region: Region, rows: Rows, actions: Tensor) -> TimedRun:
    def run() -> int:
        rows.state = RowState(**region(rows.state._asdict()))
        return actions.numel()

    return run


def parsed(parser: argparse.ArgumentParser, arguments: list[str] | None, seconds: float) -> Options:
    """Return the options of a benchmark.

    Args:
        arguments: None: those of this process.
        seconds: default of the least time of a measurement.

    Raises:
        ValueError: for numbers out of range.
    """
    parser.add_argument("--rounds", type=int, default=5, help="how often each is measured")
    parser.add_argument("--seconds", type=float, default=seconds, help="least time of a measurement")
    parser.add_argument("--device", default=None, help="instead: the ladder of the tensor engine there, such as cuda")
    options = parser.parse_args(arguments)
    require(*at_least_one(rounds=options.rounds), *positive(seconds=options.seconds))
    return options


def climb(
    rungs: list[Rung], options: Options, device: torch.device, yardstick: str = COPY, in_turn: bool = False
) -> None:
    """Measure a ladder as the options say, or until Ctrl-C, and print the machine and the table.

    Args:
        in_turn: every round measures each rung once, so that all suffer alike; else each rung is made, measured and
            dropped.
    """
    rounds = 1 if in_turn else options.rounds
    times = options.rounds if in_turn else 1
    with suppress(KeyboardInterrupt):
        for rung in track(rungs * times, "measuring", console=Console(stderr=True)):
            measure(rung, rounds, options.seconds, device)
    print(f"{machine(device)}; medians of {options.rounds} rounds\n\n{table(found(rungs, yardstick), yardstick)}")


def machine(device: torch.device) -> str:
    """Return what was measured on."""
    if device.type == "cuda":
        return f"{torch.cuda.get_device_name(device)}, CUDA {torch.version.cuda}, torch {torch.__version__}"
    threads = torch.get_num_threads()
    capability = torch.backends.cpu.get_cpu_capability()
    return f"{platform.processor() or platform.machine()}, {capability}, {threads} threads, torch {torch.__version__}"


def measure(rung: Rung, rounds: int, seconds: float, device: torch.device) -> None:
    """Measure observations a second, or note why a way fails."""
    try:
        run = rung.make()
        for _ in range(WARM_UP + 1 if device.type == "cuda" else 1):
            run()
        start = finished(device)
        run()
        at_once = max(1, min(10, round(seconds / (finished(device) - start))))
        for _ in range(rounds):
            count = 0
            start = finished(device)
            while (now := finished(device)) - start < seconds:
                count += sum(run() for _ in range(at_once))
            rung.speeds.append(count / (now - start))
    except (RuntimeError, torch.OutOfMemoryError) as error:
        rung.failure = f"{type(error).__name__}: {error}".splitlines()[0]


def finished(device: torch.device) -> float:
    """Return the time in seconds, once a device is idle; with one thread that of the process."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    elif torch.get_num_threads() == 1:
        return time.process_time()
    return time.perf_counter()


def found(measured: Sequence[Rung], yardstick: str) -> list[dict[str, Any]]:
    """Return medians and their ratios to the yardstick as plain values.

    The yardstick has the same task and rows, or else the most rows.

    Args:
        measured: the ladder; unmeasured rungs are left out.
        yardstick: the rung to compare with.
    """
    known = [rung for rung in measured if rung.speeds or rung.failure]
    median = {(rung.name, rung.num_rows, rung.task): statistics.median(rung.speeds) for rung in known if rung.speeds}
    rows = []
    for rung in known:
        row: dict[str, Any] = {"rows": rung.num_rows, "task": rung.task, "way": rung.name}
        speed = median.get((rung.name, rung.num_rows, rung.task))
        if speed is None:
            rows.append({**row, "failure": rung.failure})
            continue
        yardsticks = {}
        for (name, n, task), each in median.items():
            if name == yardstick and task in ("", rung.task):
                yardsticks[n] = each
        ratio = speed / yardsticks.get(rung.num_rows, yardsticks[max(yardsticks)]) if yardsticks else None
        rows.append({**row, "per_second": speed, "ratio": ratio, "goal": rung.goal or None, "rounds": len(rung.speeds)})
    return rows


def table(rows: Sequence[Mapping[str, Any]], yardstick: str) -> str:
    """Format `found` in Markdown, with ratios to the yardstick and shares of the goal."""
    lines = []
    for row in rows:
        numbers = [row.get("failure", ""), "", ""]
        if "per_second" in row:
            speed = row["per_second"]
            ratio = row["ratio"]
            goal = row["goal"]
            share = "" if goal is None else f"{speed / goal:.2g} of {goal / 1e6:,.3g}M"
            numbers = [f"{speed / 1e6:.4g}", "" if ratio is None else f"{ratio:.2g}", share]
        lines.append([f"{row['rows']:,}", row["task"], row["way"], *numbers])
    return markdown_table(("rows", "task", "way", "M/s", f"/ {yardstick}", "/ goal"), lines)
