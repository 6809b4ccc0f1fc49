"""The environment on one device, from step by step to fused: ``python -m ctgraph_rl.benchmark --device cuda``.

The yardstick is a copy of as many bytes as the observations have, on the same device and in the same run.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import torch
from torch import Tensor

from ctgraph_rl.batch.rollout import Steps, rollout
from ctgraph_rl.batch.rows import Rows
from ctgraph_rl.core import dynamics
from ctgraph_rl.core.dynamics import RowState, Words
from ctgraph_rl.core.region import Region
from ctgraph_rl.env import CTGraphEnv
from ctgraph_rl.tasks.task import Task

T = TypeVar("T")
Run = Callable[[], int]
"""Runs for a while, and returns the number of observations."""

NUM_STEPS = 32
"""Steps of a rollout."""

COPY = "copy of the observations"
GOAL, FUSED = 0.5e9, 5e9
"""Observations a second at 65,536 rows: the goal, and that of fused steps."""


@dataclass
class Rung:
    """A way to step, and its observations a second."""

    name: str
    task: str
    num_rows: int
    make: Callable[[], Run]
    speeds: list[float] = field(default_factory=list)
    failure: str = ""


def rungs(device: torch.device, num_rows: Sequence[int], tasks: Mapping[str, Task]) -> list[Rung]:
    """Return what is measured, in the order of the table."""
    found = []
    for n in num_rows:
        size = next(iter(tasks.values())).images.shape
        found.append(Rung(COPY, "", n, lambda n=n, size=size: _copy(n, size, device)))  # type: ignore[misc]
        for name, task in tasks.items():
            for way, make in WAYS.items():
                found.append(Rung(way, name, n, lambda n=n, task=task, make=make: make([task] * n, device)))  # type: ignore[misc]
    return found


def _copy(num_rows: int, size: Sequence[int], device: torch.device) -> Run:
    source = torch.randint(0, 255, (NUM_STEPS, num_rows, *size), dtype=torch.uint8, device=device)
    target = torch.empty_like(source)

    def run() -> int:
        target.copy_(source)
        return NUM_STEPS * num_rows

    return run


def _torchrl(tasks: Sequence[Task], device: torch.device) -> Run:
    env = CTGraphEnv(tasks, device=device, check_actions=False, info=False, kernel="off")

    def run() -> int:
        with torch.no_grad():
            env.rollout(NUM_STEPS, break_when_any_done=False)
        return NUM_STEPS * len(tasks)

    return run


def _eager(tasks: Sequence[Task], device: torch.device) -> Run:
    rows, steps, actions = _prepared(tasks, device)

    def run() -> int:
        rollout(rows, actions, steps, kernel="off")
        return actions.numel()

    return run


def _captured(tasks: Sequence[Task], device: torch.device) -> Run:
    rows, steps, actions = _prepared(tasks, device)

    def taken(given: dict[Any, Tensor]) -> dict[Any, Tensor]:
        rows.state = RowState(**given)
        rollout(rows, actions, steps, kernel="off")
        return rows.state._asdict()

    return _replayed(Region(taken), rows, actions)


def _fused(tasks: Sequence[Task], device: torch.device) -> Run:
    rows, steps, actions = _prepared(tasks, device)
    rows.reset()
    step = torch.compile(one_step, fullgraph=True, dynamic=False)

    @torch.no_grad()
    def taken(given: dict[Any, Tensor]) -> dict[Any, Tensor]:
        state, params, uses = RowState(**given), rows.params, rows.uses
        words = dynamics.words_of(state.tick, params, uses)
        for t in range(NUM_STEPS):
            outputs = (steps.observation[t + 1], steps.reward[t], steps.done[t], steps.outcome[t])
            state, words, shown = step(state, actions[t], words, params, uses)
            for buffer, value in zip(outputs, shown, strict=True):
                buffer.copy_(value)
        return state._asdict()

    return _replayed(Region(taken), rows, actions)


def one_step(
    state: RowState, action: Tensor, words: Words, params: Any, uses: Any
) -> tuple[RowState, Words, tuple[Tensor, ...]]:
    """Take a step of `rollout` by the tensor engine; return states, their draws, and what the step's buffers hold."""
    state = dynamics.advance(state, action, words, params, uses, absorbing=False)
    done, reward = dynamics.is_done(state, params.tree), state.reward
    outcome = dynamics.arrivals(state, done, params)[0]
    state = dynamics.begin(state, done, params, uses)
    words = dynamics.words_of(state.tick, params, uses)
    return state, words, (dynamics.observe(state, words, params, uses), reward, done, outcome)


WAYS: dict[str, Callable[[Sequence[Task], torch.device], Run]] = {
    "TorchRL rollout": _torchrl,
    "rollout": _eager,
    "rollout, captured": _captured,
    "rollout, fused and captured": _fused,
}
"""The ways to step, from the slowest on."""


def _prepared(tasks: Sequence[Task], device: torch.device) -> tuple[Rows, Steps, Tensor]:
    rows = Rows(tasks, device=device, kernel="off")
    return rows, Steps.empty(rows, NUM_STEPS), torch.randint(0, 3, (NUM_STEPS, len(tasks)), device=device)


def _replayed(region: Region, rows: Rows, actions: Tensor) -> Run:
    """Return a run of a region that takes the states of rows and returns those that steps led to."""

    def run() -> int:
        rows.state = RowState(**region(rows.state._asdict()))
        return actions.numel()

    return run


def measure(rung: Rung, rounds: int, seconds: float, device: torch.device) -> None:
    """Measure observations a second; for a way that fails, note why, and measure the others."""
    try:
        run = rung.make()
        for _ in range(5):  # builds, compiles, captures
            run()
        for _ in range(rounds):
            rung.speeds.append(_speed(run, seconds, device))
    except (RuntimeError, torch.OutOfMemoryError) as error:
        rung.failure = f"{type(error).__name__}: {error}".splitlines()[0]


def _speed(run: Run, seconds: float, device: torch.device) -> float:
    count, start = 0, finished(device)
    while finished(device) - start < seconds:
        for _ in range(10):  # the device is not waited for after each
            count += run()
    return count / (finished(device) - start)


def finished(device: torch.device) -> float:
    """Return the time in seconds, once a device has done all that it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def until(limit: float, items: Iterable[T]) -> Iterator[T]:
    """Yield items for so many seconds, or until Ctrl-C, which ends it as the last item would."""
    start = time.perf_counter()
    for item in items:
        if time.perf_counter() - start > limit:
            return
        yield item


def table(measured: Sequence[Rung]) -> str:
    """Format medians in Markdown, with their ratios to the copy of the same rows, and to the goal."""
    lines = ["| rows | task | way | M obs/s | / copy | / goal |", "|---|---|---|---|---|---|"]
    copies = {rung.num_rows: statistics.median(rung.speeds) for rung in measured if rung.name == COPY and rung.speeds}
    for rung in measured:
        if rung.failure:
            lines.append(f"| {rung.num_rows:,} | {rung.task} | {rung.name} | {rung.failure} | | |")
        elif rung.speeds:
            speed, goal = statistics.median(rung.speeds), FUSED if "fused" in rung.name else GOAL
            share = f"{speed / copies[rung.num_rows]:.2g}" if rung.num_rows in copies else ""
            of_goal = f"{speed / goal:.2g} of {goal / 1e9:g}G" if rung.name != COPY else ""
            cells = [f"{rung.num_rows:,}", rung.task, rung.name, f"{speed / 1e6:.4g}", share, of_goal]
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)
