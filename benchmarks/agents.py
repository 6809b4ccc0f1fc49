"""How fast agents learn, beside Stable-Baselines3 and JAX: python -m benchmarks.agents.

Every agent learns with the settings of its yaml file on 256 rows, Stable-Baselines3's with the same ones as far as it
has them: on ctgraph_rl.sb3.SB3VecEnv, and on its make_vec_env of the single environment; and with its own defaults on
8 rows. JAX's PPO is that of benchmarks.jax_ppo. Every round lets each learn for a while in turn, so what slows the
machine down slows all of them; frames per second are medians of the rounds. Then each learns with several seeds until
it reaches the goal in 90 of 100 greedy episodes, JAX's in 0.9 of a batch's, whose time does not count. Seconds are
those of one core. --cells measures only LSTM-PPO, with each cell in place of the LSTM. Ctrl-C ends a measurement, and
prints what was measured until then.

--device cuda measures PPO and LSTM-PPO there instead, as they learn in a run: step by step, captured, and PPO compiled.
Many seeds learn as one job, with stacked weights. The yardstick is the environment with given actions.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import cache, partial
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import torch
import yaml
from rich.console import Console
from rich.progress import track

from baselines.parts.catalogue import catalogue
from baselines.parts.policy_gradient import PolicyGradient
from baselines.update.captured import CapturedGroup
from benchmarks import environment_ladder as ladder
from benchmarks.environment_ladder import Rung, TimedRun
from ctgraph_rl import CTGraphEnv, Task, evaluate
from ctgraph_rl.batch.specs import make_specs
from ctgraph_rl.checks import NamedValues, at_least_one, require
from ctgraph_rl.core.device import checked_device
from ctgraph_rl.learn.collect import collect
from ctgraph_rl.log.escape import markdown_table
from ctgraph_rl.packages import class_named, conf_dir
from ctgraph_rl.tasks.configurations import ct_co_b1, ct_fo_b1, ct_su_b1

CPU = torch.device("cpu")
ROWS = 256
GOAL = (1, 2)
SOLVED = 0.9
CHUNK = 8192
ENDLESS = 10**6

TASKS = {"CT-FO-B1": ct_fo_b1(GOAL), "CT-SU-B1": ct_su_b1(GOAL), "CT-CO-B1": ct_co_b1(GOAL)}
PAIRS = (
    ("a2c", "CT-FO-B1"),
    ("ppo", "CT-FO-B1"),
    ("dqn", "CT-FO-B1"),
    ("lstm_ppo", "CT-SU-B1"),
    ("lstm_ppo", "CT-CO-B1"),
)
IN_JAX = (("ppo", "CT-FO-B1"), ("lstm_ppo", "CT-SU-B1"))

ENVIRONMENT = "environment only"
ON_DEVICE = {"ppo": "CT-FO-B1", "ppo_published": "CT-FO-B1", "lstm_ppo": "CT-SU-B1"}

GOALS = {"ppo": 10e6, "lstm_ppo": 1e6}
"""Environment steps a second for one agent to learn from."""

MAIN_JOB = 4 * 204_800

SEEDS_GOAL = 1024 * MAIN_JOB / (15 * 60)
"""Environment steps a second for 1,024 seeds of the main job in 15 minutes."""


class Contender(NamedTuple):
    """A learner that is made for a seed.

    It has ``learn``, which returns the frames that it learned from, and ``success``, a share of greedy episodes.
    """

    agent: str
    who: str
    make: Callable[[int], Any]


def settings(name: str) -> NamedValues:
    """Return an agent's yaml file with those that it starts from."""
    own = yaml.safe_load(Path(conf_dir(), "agent", f"{name}.yaml").read_text(encoding="utf-8"))
    found: NamedValues = {}
    for other in own.pop("defaults", []):
        if other != "_self_":
            found |= settings(other)
    return found | own


def on_256_rows(name: str) -> NamedValues:
    """Return an agent's hyperparameters for `ROWS` rows, with the yaml file's frames per batch."""
    given = settings(name)
    frames = given["num_envs"] * given["num_steps"]
    return {**given, "num_envs": ROWS, "num_steps": max(1, frames // ROWS)}


def built(values: NamedValues, task: Task) -> PolicyGradient:
    """Return an agent with these settings, on the CPU."""
    values = dict(values)
    module, _, of_class = values.pop("_target_").rpartition(".")
    kind: Any = class_named(module, of_class)
    return kind(*make_specs([task]), **values)


class Ours:
    """An agent of this package that learns from a batch.

    Args:
        values: its settings.
        captured: whether a GPU replays its steps.
        checked: whether the environment checks actions and says how episodes end.
    """

    def __init__(
        self,
        values: NamedValues,
        task: Task,
        seed: int,
        device: torch.device = CPU,
        captured: bool = True,
        checked: bool = True,
    ) -> None:
        torch.manual_seed(seed)
        rows = CTGraphEnv([task] * values["num_envs"], seed, device=device, check_actions=checked, info=checked)
        self.task = task
        self.agent = agent = built(values, task).to(device)
        if not captured:
            agent.capturable = agent.policy.capturable = False  # type: ignore[misc]
        agent.start_task()
        frames = ENDLESS * agent.num_envs * agent.num_steps
        self.batches = collect(rows, agent.policy, frames, agent.num_steps, agent.initial_state)

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
        values = on_256_rows(name)
        yield Contender(f"{name} on {label}", "ours", partial(Ours, values, task))
        if find_spec("sb3_contrib"):
            from benchmarks import stable  # needs Stable-Baselines3, which is optional

            for who, way in stable.ways().items():
                yield Contender(f"{name} on {label}", who, partial(stable.Stable, name, values, task, way))
        if find_spec("jax") and (name, label) in IN_JAX:
            from benchmarks import jax_ppo  # needs JAX, which is optional

            yield Contender(f"{name} on {label}", "JAX", partial(jax_ppo.JAX, name, values, task))


def cells(names: list[str]) -> Iterator[Contender]:
    """Yield LSTM-PPO with each cell, on the task that needs memory and has fewest images."""
    for entry in catalogue("cell"):
        if entry.name in names:
            values = {**on_256_rows("lstm_ppo"), "cell": partial(entry.kind, **entry.settings)}
            yield Contender(f"lstm_ppo cell={entry.name}", "ours", partial(Ours, values, TASKS["CT-SU-B1"]))


def solve(learner: Any, max_frames: int) -> tuple[int, float] | None:
    """Let a learner solve its task; return frames and seconds, or None after ``max_frames``."""
    frames = 0
    seconds = 0.0
    checked = 0
    while frames < max_frames:
        start = time.process_time()
        frames += learner.learn()
        seconds += time.process_time() - start
        if frames - checked >= CHUNK:
            checked = frames
            if learner.success() >= SOLVED:
                return frames, seconds
    return None


def times_to_solve(measured: Sequence[Contender], options: ladder.Options) -> str:
    """Let all solve their tasks, or until Ctrl-C; return a table of median frames and seconds."""
    found: list[list[tuple[int, float] | None]] = [[] for _ in measured]
    work = list(product(range(options.seeds), zip(measured, found, strict=True)))
    with suppress(KeyboardInterrupt):
        for seed, (one, times) in track(work, "learning", console=Console(stderr=True)):
            times.append(solve(one.make(seed), options.max_frames))
    rows = [[one.agent, one.who, *medians(times)] for one, times in zip(measured, found, strict=True)]
    return markdown_table(("agent", "who", "frames to 90 %", "seconds to 90 %"), rows)


def medians(found: list[tuple[int, float] | None]) -> tuple[str, str]:
    """Return median frames and seconds, or how many seeds solved the task if these are not most."""
    times = sorted(one for one in found if one is not None)
    if len(times) * 2 <= len(found):
        return f"{len(times)} of {len(found)} seeds", ""
    frames, seconds = (statistics.median(values) for values in zip(*times, strict=True))
    return f"{frames:,.0f}", f"{seconds:.2f}"


def rungs(device: torch.device, num_rows: Sequence[int], num_seeds: Sequence[int]) -> Iterator[Rung]:
    """Yield what is measured on a device, in the order of the table.

    Args:
        num_rows: environments of one agent, of those with a goal.
        num_seeds: agents of one job, each with its yaml file's environments.
    """
    for name, label in ON_DEVICE.items():
        task = TASKS[label]
        values = settings(name)
        learner = partial(Ours, task=task, seed=0, device=device, checked=False)
        for n in num_rows if name in GOALS else ():
            yield Rung(ENVIRONMENT, label, n, partial(ladder.WAYS["rollout, captured"], [task] * n, device))
            given = {**values, "num_envs": n}
            ways = {"step by step": partial(learner, given, captured=False), "captured": partial(learner, given)}
            if name == "ppo":
                ways["compiled and captured"] = partial(learner, {**given, "compile": True})
            for way, make in ways.items():
                yield Rung(f"{name}, {way}", label, n, partial(_begin, make), GOALS[name])
        for count in num_seeds:
            goal = SEEDS_GOAL if name == "lstm_ppo" else 0.0
            together = partial(seeds, values, task, count, device)
            yield Rung(f"{name}, {count:,} seeds as one job", label, count * values["num_envs"], together, goal)


def _begin(make: Callable[[], Any]) -> TimedRun:
    return make().learn


def seeds(values: NamedValues, task: Task, num_seeds: int, device: torch.device) -> TimedRun:
    """Return a run of many seeds, as of ``together=true``, each learning from its batch."""
    agents = [built(values, task).to(device) for _ in range(num_seeds)]
    generators = [torch.Generator(device="cpu").manual_seed(seed) for seed in range(num_seeds)]
    group = CapturedGroup(agents, generators)
    num_envs = agents[0].num_envs
    num_steps = agents[0].num_steps
    env = CTGraphEnv([task] * num_seeds * num_envs, device=device, check_actions=False, info=False)
    row = torch.arange(num_seeds * num_envs, device=device)
    env.rows.set_streams(row // num_envs, row % num_envs)
    frames = ENDLESS * env.numel() * num_steps
    collected = collect(env, group.policy, frames, num_steps, agents[0].initial_state)

    def run() -> int:
        batch = next(collected)
        group.learn(batch)
        return batch.numel()

    return run


def main(arguments: list[str] | None = None) -> None:
    """Measure and print the tables."""
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
    options = ladder.parsed(parser, arguments, seconds=2.0)
    require(
        *at_least_one(max_frames=options.max_frames, rows=min(options.rows), together=min(options.together, default=1)),
        (options.seeds >= 0, f"seeds must be >= 0, got {options.seeds}"),
    )
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    if options.device:
        device = checked_device(options.device)
        on_device = []
        for rung in rungs(device, options.rows, options.together):
            if rung.name == ENVIRONMENT or rung.name.partition(",")[0] in options.agents:
                on_device.append(rung)
        ladder.climb(on_device, options, device, ENVIRONMENT)
        return
    console = Console(stderr=True)
    if not find_spec("sb3_contrib"):
        missing = "Stable-Baselines3 is missing and not measured: pip install 'ctgraph_rl[benchmark]'"
        console.print(missing, markup=False, soft_wrap=True)
    if not find_spec("jax"):
        console.print("JAX is missing and not measured: pip install jax", markup=False, soft_wrap=True)
    measured = list(contenders(options.agents) if options.cells is None else cells(options.cells or known))
    speeds = []
    for one in measured:
        learner = cache(partial(one.make, 0))  # one learns in all rounds
        speeds.append(Rung(one.who, one.agent, ROWS, partial(_begin, learner)))
    ladder.climb(speeds, options, CPU, "ours", in_turn=True)
    if options.seeds:
        print(f"\n{times_to_solve(measured, options)}")


if __name__ == "__main__":
    main()
