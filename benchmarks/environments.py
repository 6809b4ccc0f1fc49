"""How fast the environment runs, with --device cuda on a GPU.

Every round measures each way to step once, in turn, so what slows the machine down slows all of them; the table has
medians, and an observation is one row for one step. The yardstick is memcpy of the observations' bytes. A TorchRL
environment that only counts is measured, too; some of its rows end at every step, as in any batch of episodes.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from benchmarks import environment_ladder as ladder
from benchmarks.environment_ladder import Rung, TimedRun
from ctgraph_rl.batch.rollout import Steps, rollout
from ctgraph_rl.batch.rows import Rows
from ctgraph_rl.checks import at_least_one, require
from ctgraph_rl.core.device import checked_device
from ctgraph_rl.env import CTGraphEnv
from ctgraph_rl.gym import CTGraphGymEnv, CTGraphVectorEnv
from ctgraph_rl.tasks.configurations import ct_co_b1, ct_su_b1
from ctgraph_rl.tasks.task import Task

MEMCPY = "memcpy"
TRIVIAL = "trivial environment: "
LEAN = ", info=False"
MAX_BUFFER = 2**26
"""Bytes of observations in the buffers, beyond the caches."""


NamedRuns = Iterator[tuple[str, TimedRun]]

NOISE_BANK = 4096
SUFFIX = {"off": "", "required": ", kernel"}


def configurations() -> dict[str, Task]:
    """The measured tasks: SU is CT-SU-B1, CO is CT-CO-B1 with p = 0.5 and up to ten degrees of rotation."""
    confounding = ct_co_b1()
    confounding = replace(
        confounding,
        graph=replace(confounding.graph, wait_prob=0.5),
        observations=replace(confounding.observations, read_rotation=10),
    )
    tasks = {"SU": ct_su_b1(), "CO": confounding}
    for name, task in tuple(tasks.items()):
        tasks[f"{name}, noise 10"] = replace(task, observations=replace(task.observations, read_noise=10))
    return tasks


class Counter(EnvBase):
    """The trivial environment: it counts to four and starts again.

    A batch starts at 0, 1, 2, 3, 0, ..., so that TorchRL merges a reset at every step.
    """

    batch_locked = True

    def __init__(self, num_rows: int) -> None:
        super().__init__(batch_size=torch.Size([num_rows]))
        count = Unbounded((num_rows, 1), dtype=torch.int64, device="cpu")
        self.observation_spec = Composite(observation=count, shape=(num_rows,), device="cpu")
        self.action_spec = Categorical(3, shape=(num_rows,), dtype=torch.int64, device="cpu")
        self.reward_spec = Unbounded((num_rows, 1), dtype=torch.float32, device="cpu")
        self.first = torch.arange(num_rows, device="cpu").unsqueeze(-1) % 4
        self.count = self.first

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDict:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        self.count = self.first if mask is None else self.count.masked_fill(mask, 0)
        return TensorDict({"observation": self.count}, self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self.count = self.count + 1
        return TensorDict(
            {"observation": self.count, "reward": self.count.float(), "done": self.count >= 4}, self.batch_size
        )

    def _set_seed(self, seed: int | None) -> None:
        pass


def _num_steps(num_rows: int) -> int:
    return max(4, min(512, MAX_BUFFER // (num_rows * 144)))


def _memory(num_rows: int) -> NamedRuns:
    steps = _num_steps(num_rows)
    target = torch.empty(steps, num_rows, 1, 12, 12, dtype=torch.uint8, device="cpu")
    source = torch.randint(0, 255, target.shape, dtype=torch.uint8, device="cpu")

    def run(write: Callable[[Tensor, int], object]) -> int:
        for t in range(steps):
            write(target[t], t)
        return steps * num_rows

    yield "memset", partial(run, lambda row, t: row.zero_())
    yield MEMCPY, partial(run, lambda row, t: row.copy_(source[t]))


def _fast(task: Task, num_rows: int, ways: tuple[str, ...]) -> NamedRuns:
    rows = Rows([task] * num_rows)
    banked = Rows([task] * num_rows, noise_bank=NOISE_BANK)
    steps = Steps.empty(rows, _num_steps(num_rows))
    actions = torch.randint(0, 3, steps.action.shape, device="cpu")

    def run(rows: Rows, kernel: str) -> int:
        rollout(rows, actions, steps, kernel)
        return steps.action.numel()

    def core(rows: Rows) -> int:
        for action in actions[:16]:
            rows.restart(rows.act(action)[1])
        return min(16, len(actions)) * num_rows

    for kernel in ways:
        own = Rows([task] * num_rows, kernel=kernel)
        yield f"core, observations of the step and of the reset{SUFFIX[kernel]}", partial(core, own)
        yield f"fast rollout{SUFFIX[kernel]}", partial(run, rows, kernel)
        if task.observations.read_noise:
            yield f"fast rollout, noise bank{SUFFIX[kernel]}", partial(run, banked, kernel)


def _torchrl(make: Callable[[], EnvBase], prefix: str = "", suffix: str = "") -> NamedRuns:
    env = make()
    collected = make()
    n = env.batch_size[0]
    steps = max(4, min(64, 2**25 // (n * 300)))
    policy = _Random(n)
    collector = Collector(
        collected,
        policy,
        frames_per_batch=n * steps,
        total_frames=-1,
        trust_policy=True,
        use_buffers=False,
        track_traj_ids=False,
        return_same_td=True,  # without buffers: the batch itself, a new one each time, instead of a copy
        auto_register_policy_transforms=True,
    )
    batches = iter(collector)

    def run() -> int:
        env.rollout(steps, policy, break_when_any_done=False)
        return steps * n

    yield f"{prefix}TorchRL rollout{suffix}", torch.no_grad()(run)
    yield f"{prefix}TorchRL Collector{suffix}", lambda: next(batches).numel()


class _Random(TensorDictModuleBase):
    in_keys: tuple[str, ...] = ("observation",)
    out_keys: tuple[str, ...] = ("action",)

    def __init__(self, num_rows: int) -> None:
        super().__init__()
        self.num_rows = num_rows

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set("action", torch.randint(0, 3, (self.num_rows,), device="cpu"))


def _gymnasium(task: Task, num_rows: int, kernel: str) -> NamedRuns:
    envs = CTGraphVectorEnv(num_rows, task, kernel=kernel)
    envs.reset(seed=0)
    actions = torch.randint(0, 3, (16, num_rows), device="cpu").numpy()

    def run() -> int:
        for action in actions:
            envs.step(action)
        return actions.size

    yield f"Gymnasium VectorEnv{SUFFIX[kernel]}", run


def _single(task: Task, kernel: str) -> NamedRuns:
    env = CTGraphGymEnv(task, kernel=kernel)
    actions = torch.randint(0, 3, (256,), device="cpu").tolist()
    env.reset(seed=0)

    def run() -> int:
        for action in actions:
            if env.step(action)[2]:
                env.reset()
        return len(actions)

    yield f"Gymnasium Env{SUFFIX[kernel]}", run


def contenders(num_rows: list[int], names: list[str], with_kernel: bool) -> list[Rung]:
    """Everything measured on the CPU, in the table's order."""
    found: list[Rung] = []

    def made(run: TimedRun) -> Callable[[], TimedRun]:
        return lambda: run

    def add(configuration: str, n: int, ways: NamedRuns) -> None:
        for name, run in ways:
            found.append(Rung(name, configuration, n, made(run)))

    tasks = configurations()
    ways = tuple(SUFFIX)[: 1 + with_kernel]
    for n in num_rows:
        add("", n, _memory(n))
        add("", n, _torchrl(partial(Counter, n), TRIVIAL))
        for name in names:
            task = tasks[name]
            add(name, n, _fast(task, n, ways))
            for kernel in ways:
                for info, suffix in ((True, ""), (False, LEAN)):
                    make = partial(CTGraphEnv, [task] * n, check_actions=False, kernel=kernel, info=info)
                    add(name, n, _torchrl(make, suffix=suffix + SUFFIX[kernel]))
                add(name, n, _gymnasium(task, n, kernel))
                if n == 1:
                    add(name, n, _single(task, kernel))
    return found


def main(arguments: list[str] | None = None) -> None:
    """Measure and print the table."""
    names = list(configurations())
    parser = argparse.ArgumentParser(prog="python -m benchmarks.environments", description=__doc__)
    parser.add_argument("--rows", type=int, nargs="+", help="batch sizes")
    parser.add_argument("--tasks", nargs="+", default=names, choices=names, help="what is measured")
    parser.add_argument("--skip-kernel", action="store_true", help="leave out the C kernel, which needs a compiler")
    parser.add_argument("--threads", type=int, default=None, help="threads of torch")
    options = ladder.parsed(parser, arguments, seconds=0.2)
    rows = options.rows or ([65536, 262144] if options.device else [1, 64, 1024, 16384])
    require(*at_least_one(rows=min(rows)))
    if options.threads:
        torch.set_num_threads(options.threads)
    if options.device:
        device = checked_device(options.device)
        tasks = {name: configurations()[name] for name in options.tasks}
        ladder.climb(ladder.rungs(device, rows, tasks), options, device)
        return
    measured = contenders(rows, options.tasks, not options.skip_kernel)
    ladder.climb(measured, options, torch.device("cpu"), MEMCPY, in_turn=True)


if __name__ == "__main__":
    main()
