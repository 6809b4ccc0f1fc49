"""How fast agents learn, beside Stable-Baselines3 and JAX: python -m benchmarks.agents.

Every agent learns with the settings of its yaml file on 256 rows, Stable-Baselines3's with the same ones as far as it
has them: on ctgraph_rl.sb3.SB3VecEnv, and on its make_vec_env of the single environment; and with its own defaults on
8 rows. JAX's PPO is that of benchmarks.jax_ppo. Every round lets each learn for a while in turn, so what slows the
machine down slows all of them; frames per second are medians of the rounds. Then each learns with several seeds until
it reaches the goal in 90 of 100 greedy episodes, JAX's in 0.9 of a batch's, whose time does not count. Seconds are
those of one core. --cells measures only LSTM-PPO, with each cell in place of the LSTM. Ctrl-C ends a measurement, and
prints what was measured until then.

--device cuda measures benchmarks.agent_ladder instead.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from importlib.util import find_spec
from typing import Any, Protocol

import torch
from rich.console import Console
from rich.progress import track

from baselines.parts.catalogue import catalogue
from benchmarks import agent_ladder
from benchmarks import environment_ladder as ladder
from ctgraph_rl import CTGraphEnv, Task, evaluate
from ctgraph_rl.checks import NamedValues, at_least_one, require
from ctgraph_rl.core.device import checked_device
from ctgraph_rl.learn.collect import collect
from ctgraph_rl.log.escape import markdown_table
from ctgraph_rl.tasks.configurations import ct_co_b1, ct_fo_b1, ct_su_b1

ROWS = 256
GOAL = (1, 2)
SOLVED = 0.9
CHUNK = 8192

TASKS = {"CT-FO-B1": ct_fo_b1(GOAL), "CT-SU-B1": ct_su_b1(GOAL), "CT-CO-B1": ct_co_b1(GOAL)}
PAIRS = (
    ("a2c", "CT-FO-B1"),
    ("ppo", "CT-FO-B1"),
    ("dqn", "CT-FO-B1"),
    ("lstm_ppo", "CT-SU-B1"),
    ("lstm_ppo", "CT-CO-B1"),
)
IN_JAX = (("ppo", "CT-FO-B1"), ("lstm_ppo", "CT-SU-B1"))


class Learning(Protocol):
    """An agent with its environments."""

    def learn(self) -> int:
        """Learn for a while; return the frames."""
        ...

    def success(self) -> float:
        """Return the share of greedy episodes that reach the goal."""
        ...


@dataclass
class Contender:
    """A learner and its measurements."""

    agent: str
    task: str
    who: str
    make: Callable[[int], Learning]  # of a seed
    speeds: list[float] = field(default_factory=list)
    solved: list[tuple[int, float] | None] = field(default_factory=list)

    def measure(self, learning: Learning, seconds: float) -> None:
        """Measure frames per second over so many seconds."""
        frames = 0
        start = time.process_time()
        while time.process_time() - start < seconds:
            frames += learning.learn()
        self.speeds.append(frames / (time.process_time() - start))

    def solve(self, seed: int, max_frames: int) -> None:
        """Learn until the task is solved; note frames and seconds, or None after ``max_frames``."""
        learning = self.make(seed)
        frames = 0
        seconds = 0.0
        checked = 0
        while frames < max_frames:
            start = time.process_time()
            frames += learning.learn()
            seconds += time.process_time() - start
            if frames - checked >= CHUNK:
                checked = frames
                if learning.success() >= SOLVED:
                    self.solved.append((frames, seconds))
                    return
        self.solved.append(None)


def cell_named(name: str) -> partial[Any]:
    """Return what builds a cell with its file's settings."""
    entry = next(entry for entry in catalogue("cell") if entry.name == name)
    return partial(entry.kind, **entry.settings)


def settings(name: str) -> NamedValues:
    """Return hyperparameters for `ROWS` rows, with the yaml file's frames per batch."""
    given = agent_ladder.settings(name)
    frames = given["num_envs"] * given["num_steps"]
    return {**given, "num_envs": ROWS, "num_steps": max(1, frames // ROWS)}


class Ours:
    """An agent of this package.

    Args:
        cell: a file of ``conf/cell``; None: the agent's.
    """

    def __init__(self, name: str, task: Task, seed: int, cell: str | None = None) -> None:
        changes = settings(name) | ({} if cell is None else {"cell": cell_named(cell)})
        torch.manual_seed(seed)
        env = CTGraphEnv([task] * ROWS, seed)
        self.task = task
        self.agent = agent = agent_ladder.built(name, task, **changes)
        batch = agent.num_envs * agent.num_steps
        agent.start_task()
        self.batches = collect(env, agent.policy, 10**6 * batch, agent.num_steps, agent.initial_state)

    def learn(self) -> int:
        """Learn from one batch."""
        batch = next(self.batches)
        self.agent.learn(batch)
        return batch.numel()

    def success(self) -> float:
        """Return the share of 100 greedy episodes that reach the goal."""
        ends = evaluate(self.agent.policy, [self.task], seed=1, initial_state=self.agent.initial_state)
        return (ends["outcome"] == 3).double().mean().item()


def contenders(agents: list[str]) -> Iterator[Contender]:
    """Yield everything to measure, Stable-Baselines3 and JAX if installed."""
    for name, label in PAIRS:
        if name not in agents:
            continue
        task = TASKS[label]
        yield Contender(name, label, "ours", partial(Ours, name, task))
        if find_spec("sb3_contrib"):
            from benchmarks import stable  # needs Stable-Baselines3, which is optional

            for who, way in stable.ways().items():
                yield Contender(name, label, who, partial(stable.Stable, name, settings(name), task, way))
        if find_spec("jax") and (name, label) in IN_JAX:
            from benchmarks import jax_ppo  # needs JAX, which is optional

            yield Contender(name, label, "JAX", partial(jax_ppo.JAX, name, settings(name), task))


def cells(names: list[str]) -> Iterator[Contender]:
    """Yield LSTM-PPO with each cell, on the task that needs memory and has fewest images."""
    for name in names:
        make = partial(Ours, "lstm_ppo", TASKS["CT-SU-B1"], cell=name)
        yield Contender(f"lstm_ppo cell={name}", "CT-SU-B1", "ours", make)


def table(measured: list[Contender]) -> str:
    """Format medians in Markdown, with the speed relative to ours."""
    ours = {
        (one.agent, one.task): statistics.median(one.speeds) for one in measured if one.who == "ours" and one.speeds
    }
    measured = [one for one in measured if one.speeds and (one.agent, one.task) in ours]
    rows = []
    for one in measured:
        speed = statistics.median(one.speeds)
        ratio = "" if one.who == "ours" else f"{ours[one.agent, one.task] / speed:.1f} x"
        rows.append([one.agent, one.task, one.who, f"{speed:,.0f}", ratio, *_solved(one.solved)])
    head = ("agent", "task", "who", "frames/s", "ours is", "frames to 90 %", "seconds to 90 %")
    return markdown_table(head, rows)


def _solved(found: list[tuple[int, float] | None]) -> tuple[str, str]:
    times = sorted(one for one in found if one is not None)
    if len(times) * 2 <= len(found):
        return (f"{len(times)} of {len(found)} seeds", "") if found else ("", "")
    frames, seconds = (statistics.median(values) for values in zip(*times, strict=True))
    return f"{frames:,.0f}", f"{seconds:.2f}"


def on_device(device: torch.device, options: ladder.Options) -> str:
    """Measure `benchmarks.agent_ladder`; return its table."""
    rungs = []
    for rung in agent_ladder.rungs(device, options.rows, options.together):
        if rung.name == agent_ladder.ENVIRONMENT or rung.name.partition(",")[0] in options.agents:
            rungs.append(rung)
    ladder.climb(rungs, options, device)
    return ladder.report(rungs, options, device, agent_ladder.ENVIRONMENT)


def main(arguments: list[str] | None = None) -> None:
    """Measure and print the table."""
    names = list(dict.fromkeys(name for name, _ in PAIRS))
    known = [entry.name for entry in catalogue("cell")]
    parser = argparse.ArgumentParser(prog="python -m benchmarks.agents", description=__doc__)
    parser.add_argument("--agents", nargs="+", default=names, choices=names, help="who is measured")
    parser.add_argument("--cells", nargs="*", choices=known, help="instead: lstm_ppo with these cells; none named: all")
    parser.add_argument("--seeds", type=int, default=3, help="how often each learns from scratch")
    longest = "frames after which a task counts as not solved"
    parser.add_argument("--max-frames", type=int, default=500_000, help=longest)
    parser.add_argument("--rows", type=int, nargs="+", default=[4096, 65536], help="with --device: environments")
    parser.add_argument("--together", type=int, nargs="*", default=[64, 1024], help="with --device: seeds of one job")
    options = ladder.parsed(parser, arguments, seconds=2.0, limit=3600.0)
    require(
        *at_least_one(max_frames=options.max_frames, rows=min(options.rows), together=min(options.together, default=1)),
        (options.seeds >= 0, f"seeds must be >= 0, got {options.seeds}"),
    )
    if options.cells == []:
        options.cells = known
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    if options.device:
        print(on_device(checked_device(options.device), options))
        return
    measured = learned(options)
    about = f"{ladder.machine(torch.device('cpu'))}; medians of {options.rounds} rounds and {options.seeds} seeds"
    print(f"{about}\n\n{table(measured)}")


def learned(options: ladder.Options) -> list[Contender]:
    """Let agents learn as the options say, or until Ctrl-C; return them."""
    console = Console(stderr=True)
    if not find_spec("sb3_contrib"):
        missing = "Stable-Baselines3 is missing and not measured: pip install 'ctgraph_rl[benchmark]'"
        console.print(missing, markup=False, soft_wrap=True)
    if not find_spec("jax"):
        console.print("JAX is missing and not measured: pip install jax", markup=False, soft_wrap=True)
    measured = list(contenders(options.agents) if options.cells is None else cells(options.cells))
    learners = [contender.make(0) for contender in track(measured, "building", console=console)]
    for learner in learners:
        learner.learn()
    start = time.perf_counter()
    pairs = list(zip(measured, learners, strict=True))
    with suppress(KeyboardInterrupt):
        for contender, learner in ladder.until(
            options.limit, track(pairs * options.rounds, "measuring", console=console)
        ):
            contender.measure(learner, options.seconds)
        left = options.limit - (time.perf_counter() - start)
        work = [(seed, contender) for seed in range(options.seeds) for contender in measured]
        for seed, contender in ladder.until(left, track(work, "learning", console=console)):
            contender.solve(seed, options.max_frames)
    return measured


if __name__ == "__main__":
    main()
