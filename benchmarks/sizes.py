"""What reading costs against size: ``python -m ctgraph_rl.benchmark --sizes``.

A curriculum of n tasks learns each in a block; its log has an evaluation of every task before training and after every
block, as no run of this package has more of. Each reader is called on curricula of several sizes; the table has its
processor time, the exponent of the size by which the time grows from the first to the last, and the exponent of the
largest memory that it took. 1 is linear. Curricula are counted in tasks and logs in lines, about n^2.
"""

from __future__ import annotations

import math
import time
import tracemalloc
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from ctgraph_rl.describe import describe
from ctgraph_rl.learn.rules import check_rows
from ctgraph_rl.log.escape import markdown_table
from ctgraph_rl.log.files import LOG, METRICS
from ctgraph_rl.log.run_log import RunLog, write_metrics
from ctgraph_rl.log.scores import scores
from ctgraph_rl.log.tables import write_tables
from ctgraph_rl.report import formats, results
from ctgraph_rl.runs.read import find_runs
from ctgraph_rl.tasks.configurations import ct_su_b1
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.protocol import Block
from ctgraph_rl.tasks.similarity import shared_decisions
from ctgraph_rl.tasks.task import ct_graphs

SIZES = (50, 100, 200)
"""Numbers of tasks."""

OF_A_CURRICULUM = "tasks"
OF_A_LOG = "lines"


@dataclass
class Cost:
    """What a reader costs.

    Args:
        name: the reader.
        unit: what its sizes are counted in.
        sizes: how many of them there were.
        seconds: processor time for each size.
        peaks: for each size, the most bytes that it had allocated at once.
    """

    name: str
    unit: str
    sizes: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    peaks: list[int] = field(default_factory=list)

    def measure(self, size: int, read: Callable[[], object]) -> None:
        """Call a reader once for its time and once for its memory; before the first size once more, to import."""
        if not self.sizes:
            read()
        start = time.process_time()
        read()
        self.seconds.append(time.process_time() - start)
        tracemalloc.start()
        read()
        self.peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        self.sizes.append(size)

    def exponent(self, values: Sequence[float]) -> float:
        """The power of the size by which values grow from the first size to the last."""
        return math.log(values[-1] / values[0]) / math.log(self.sizes[-1] / self.sizes[0])


def sized_curriculum(num_tasks: int) -> Curriculum:
    """Return a curriculum of so many tasks of one graph, a block each."""
    base = ct_su_b1()
    graph = replace(base.graph, depth=max(1, (num_tasks - 1).bit_length()))
    goals = (graph.path(graph.num_decision_states + leaf) for leaf in range(num_tasks))
    blocks = tuple(Block((replace(base, graph=graph, goal=goal),), 256) for goal in goals)
    return Curriculum("sizes", 1, "the benchmark", blocks)


def write_sized_log(curriculum: Curriculum, path: Path) -> None:
    """Write the log of a run that evaluates all tasks before training and after every block; returns are drawn."""
    draw = torch.Generator(device="cpu").manual_seed(0)
    log = RunLog(path)
    trained = [[number + 1 for number in block] for block in curriculum.trained]
    config = {"seed": 0, "agent": "none"}
    log.append(
        "run",
        curriculum=curriculum.name,
        fingerprint=curriculum.fingerprint,
        config=config,
        schema=1,
        trained=trained,
        tasks=list(curriculum.labels),
    )
    for block, frames in enumerate((0, *curriculum.ends)):
        returns = torch.rand(len(curriculum.tasks), generator=draw, dtype=torch.float32, device="cpu").tolist()
        if block:
            log.append("training", block=block, frames=frames, **_means(returns[0]))
        for task, (label, value) in enumerate(zip(curriculum.labels, returns, strict=True), 1):
            log.append(
                "evaluation",
                moment="after" if block else "before",
                block=block,
                frames=frames,
                task=task,
                label=label,
                held_out=False,
                **_means(value),
            )
    log.close()


def _means(value: float) -> dict[str, float]:
    return {"episodes": 9, "return_mean": value, "success_rate": value, "end_rate": value, "length_mean": 6.0}


def readers_of_curricula(curriculum: Curriculum) -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield everything that reads a curriculum, by name; each works on a new one, which remembers nothing."""
    content = curriculum.to_json()
    tasks = ct_graphs(curriculum.tasks, "this benchmark")
    yield "`Curriculum.from_json`", lambda: Curriculum.from_json(content)
    yield "`Curriculum.to_json`", lambda: replace(curriculum).to_json()
    yield "`Curriculum.fingerprint`", lambda: replace(curriculum).fingerprint
    yield "`Curriculum.labels`", lambda: replace(curriculum).labels
    yield "`describe`", lambda: describe(replace(curriculum))
    yield "`check_rows`", lambda: check_rows(replace(curriculum), 8)
    yield "`shared_decisions`, of every two tasks", lambda: shared_decisions(tasks)


def readers_of_logs(curriculum: Curriculum, run: Path) -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield everything that reads a log, by name; ``run`` is the directory that holds it."""
    log = RunLog.read(run / LOG)
    write_metrics(run / METRICS, scores(log, curriculum))
    yield "`RunLog.read`", lambda: RunLog.read(run / LOG)
    yield "`RunLog.performance`", log.performance
    yield "`RunLog.curves`", log.curves
    yield "`RunLog.regime_table`", log.regime_table
    yield "`scores`", lambda: scores(log, curriculum)
    yield "`write_metrics`", lambda: write_metrics(run / METRICS, scores(log, curriculum))
    yield "`write_tables`", lambda: write_tables(log, run, parquet=False)
    yield "`ctgraph-rl results`, report tables", lambda: formats.text(results.table(find_runs([run])[0]))


def measured(sizes: Sequence[int]) -> list[Cost]:
    """Measure everything that reads a curriculum or a log at several sizes."""
    found: dict[str, Cost] = {}
    for num_tasks in sizes:
        curriculum = sized_curriculum(num_tasks)
        for name, read in readers_of_curricula(curriculum):
            found.setdefault(name, Cost(name, OF_A_CURRICULUM)).measure(num_tasks, read)
        with TemporaryDirectory() as folder:
            write_sized_log(curriculum, Path(folder) / LOG)
            lines = 1 + num_tasks + num_tasks * (num_tasks + 1)
            for name, read in readers_of_logs(curriculum, Path(folder)):
                found.setdefault(name, Cost(name, OF_A_LOG)).measure(lines, read)
    return list(found.values())


def table(costs: Sequence[Cost]) -> str:
    """Format costs in Markdown."""
    rows = []
    for cost in costs:
        cells = [
            cost.name,
            f"{' / '.join(f'{size:,}' for size in cost.sizes)} {cost.unit}",
            " / ".join(f"{seconds:.2g}" for seconds in cost.seconds),
            f"{cost.exponent(cost.seconds):.1f}",
            " / ".join(f"{peak / 1e6:.2g}" for peak in cost.peaks),
            f"{cost.exponent(cost.peaks):.1f}",
        ]
        rows.append(cells)
    return markdown_table(("reader", "size", "seconds", "exponent", "MB at once", "exponent"), rows)
