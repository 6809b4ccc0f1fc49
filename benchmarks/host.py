"""What the host does for many seeds as one batch, beside learning: python -m benchmarks.host.

Seeds of LSTM-PPO go through four tasks as a job with ``together=true`` does, with a learner that costs nothing, as on a
fast device: actions are 0 and no weight changes. Each part is one line: milliseconds of a seed each time, how often a
seed of the main job (4 x 204,800 frames) needs it, and seconds of all seeds. Time is the process's CPU time.
"""

from __future__ import annotations

import argparse
import gc
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout
from copy import deepcopy
from functools import wraps
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import torch
from tensordict import TensorDictBase

from baselines.parts.networks import Items
from baselines.update.captured import CapturedGroup
from ctgraph_rl.checks import at_least_one, require
from ctgraph_rl.cli import FULL_COLLECTIONS
from ctgraph_rl.learn import loop
from ctgraph_rl.log.escape import markdown_table
from ctgraph_rl.runs import config, job, session

SMALL = ("agent.num_envs=32", "curriculum.num_frames=1024", "together=true", "checkpoint_seconds=1e9")
"""One batch a block; the host's work does not depend on its size but for `log`."""

PARTS: dict[str, tuple[list[tuple[Any, str]], int, int]] = {
    "build": ([(job, "build"), (job, "prepare")], 1, 1),
    "begin": ([(session.RunMember, "begin")], 1, 1),
    "log": ([(loop, "log_training")], 4, 100),
    "evaluate": ([(loop.Lockstep, "_evaluate")], 5, 5),
    "checkpoint": ([(session, "offer_all")], 4, 4),
    "finish": ([(session.RunMember, "finish")], 1, 1),
}


class Costless(CapturedGroup):
    """Agents that take action 0 and measure constants: no operation of a device is counted."""

    def acted(self, data: TensorDictBase, greedy: bool = False) -> Items:
        """Return action 0, and the recurrent state unchanged."""
        written: Items = {
            "action": torch.zeros(len(self.learners), len(data) // len(self.learners), dtype=torch.int64, device="cpu")
        }
        for key in data.keys():  # noqa: SIM118, rows otherwise
            if key.startswith("recurrent_state"):
                written["next", key] = self.by_seed(data[key])
        return written

    def learnt(self, batch: TensorDictBase) -> list[loop.Learnt]:
        """Return what PPO measures; the agents' weights count as learned."""
        self._is_behind = True
        names = ("loss_objective", "loss_critic", "loss_entropy", "grad_norm")
        return [dict.fromkeys(names, 0.123456789) for _ in self.learners]


class Timer:
    """CPU seconds of functions by part; what one part calls of another counts to the first."""

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(PARTS, 0.0)
        self.is_within = False

    def timed(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function that adds its time to a part."""

        @wraps(function)
        def measured(*given: Any, **named: Any) -> Any:
            if self.is_within:
                return function(*given, **named)
            self.is_within = True
            start = time.process_time()
            try:
                return function(*given, **named)
            finally:
                self.seconds[part] += time.process_time() - start
                self.is_within = False

        return measured


@contextmanager
def measured_parts() -> Iterator[Timer]:
    """Measure the parts of a group's job, with a learner that costs nothing."""
    timer = Timer()
    with ExitStack() as stack:
        for part, (functions, _, _) in PARTS.items():
            for owner, name in functions:
                stack.enter_context(patch.object(owner, name, timer.timed(part, getattr(owner, name))))
        stack.enter_context(patch.object(session, "agents_together", lambda agents, draws, _: Costless(agents, draws)))
        stack.enter_context(patch.object(config, "in_sweep", lambda: True))
        yield timer


def run(num_seeds: int) -> Timer:
    """Run a group of seeds in a temporary folder."""
    first = config.composed(["agent=lstm_ppo", *SMALL])
    with TemporaryDirectory() as folder:
        cells = []
        for seed in range(num_seeds):
            run_dir = Path(folder, str(seed))
            run_dir.mkdir()
            own = deepcopy(first)
            own.seed = seed
            cells.append((own, run_dir))
        with measured_parts() as timer, redirect_stdout(StringIO()), redirect_stderr(StringIO()):
            job.run_as_one(cells)
    return timer


def table(timer: Timer, num_seeds: int) -> str:
    """Return the parts as a table in Markdown."""
    rows = []
    total = 0.0
    for part, (_, here, times) in PARTS.items():
        once = timer.seconds[part] / here
        total += once * times
        rows.append([part, f"{1e3 * once / num_seeds:.2f}", str(times), f"{once * times:.1f}"])
    rows.append(["all", f"{1e3 * total / num_seeds:.2f}", "", f"{total:.1f}"])
    return markdown_table(["part", "ms a seed", "times", f"s of {num_seeds:,} seeds"], rows)


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.host", description=__doc__.partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=128, help="seeds of the group; default: 128")
    arguments = parser.parse_args()
    require(*at_least_one(seeds=arguments.seeds))
    gc.freeze()  # as the command does
    young, middle, _ = gc.get_threshold()
    gc.set_threshold(young, middle, FULL_COLLECTIONS)
    print(table(run(arguments.seeds), arguments.seeds))


if __name__ == "__main__":
    main()
