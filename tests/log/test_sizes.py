"""Work grows as the log and the curriculum do, and fast ways give the bits of slow ones."""

from __future__ import annotations

import itertools
import json
import math
import random
import sys
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
import torch

import ctgraph_rl
import curricula
from ctgraph_rl import Block, Curriculum, Evaluation, RunLog, Task, metrics
from ctgraph_rl.describe import describe
from ctgraph_rl.learn import refusals
from ctgraph_rl.learn.refusals import check_rows
from ctgraph_rl.log.scores import scores
from ctgraph_rl.log.sums import write_metrics
from ctgraph_rl.log.tables import write_tables
from ctgraph_rl.metrics import Regime
from ctgraph_rl.metrics.lifetime import theil_sen
from ctgraph_rl.runs.recorder import Recorder
from ctgraph_rl.tasks import protocol
from ctgraph_rl.tasks.configurations import ct_su_b1
from curricula import stream
from curricula.axes import all_goals

SOURCE = str(Path(ctgraph_rl.__file__).parent)


def tasks(count: int, depth: int = 6) -> list[Task]:
    base = ct_su_b1((1, 1))
    deep = replace(base.graph, depth=depth)
    goals = itertools.islice(itertools.product((1, 2), repeat=depth), count)
    return [replace(base, graph=deep, goal=goal) for goal in goals]


def curriculum(count: int, num_blocks: int = 0) -> Curriculum:
    """Blocks of the tasks in turn, each with a number of frames of its own."""
    them = tasks(count)
    blocks = tuple(Block(them[i % count], 8 * (1 + i % 5)) for i in range(num_blocks or count))
    return Curriculum("sizes", 1, "a test", blocks)


def logged(curriculum: Curriculum, seed: int = 0) -> RunLog:
    """A log with an evaluation of every task before training and after every block."""
    log, draw = RunLog(), random.Random(seed)

    def evaluate(moment: str, block: int, frames: int) -> None:
        for task, label in enumerate(curriculum.labels, 1):
            value = draw.choice((0.0, draw.random()))
            where = {"block": block, "frames": frames, "task": task, "label": label, "held_out": False}
            log.append("evaluation", moment=moment, **where, return_mean=value, success_rate=value, end_rate=1.0)

    evaluate("before", 0, 0)
    for block, frames in enumerate(curriculum.ends, 1):
        rate = draw.random()
        log.append("training", block=block, frames=frames, episodes=9, return_mean=rate, success_rate=rate)
        evaluate("after", block, frames)
    return log


@contextmanager
def counted() -> Iterator[list[int]]:
    """Count the lines of this package that run: each call and each pass of a loop, as every Python counts them."""
    count = [0]

    def trace(frame: FrameType, event: str, _: Any) -> Any:
        if not frame.f_code.co_filename.startswith(SOURCE):
            return None
        count[0] += event in ("call", "line")
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        yield count
    finally:
        sys.settrace(before)


def exponent(work: Callable[[Any], object], small: Any, large: Any, growth: float) -> float:
    """The power of the size by which the counted lines grow."""
    found = []
    for given in (small, large):
        with counted() as count:
            work(given)
        found.append(count[0])
    return math.log(found[1] / found[0]) / math.log(growth)


OF_A_CURRICULUM: dict[str, Callable[[Curriculum], object]] = {
    "check_rows": lambda each: check_rows(each, 4),
    "to_json": lambda each: replace(each).to_json(),
    "fingerprint": lambda each: replace(each).fingerprint,
    "describe": lambda each: describe(replace(each)),
    "labels": lambda each: replace(each).labels,
    "all moments": lambda each: [replace(each, version=2)] and [each.moment(frames) for frames in each.ends],
}


@pytest.mark.parametrize("name", OF_A_CURRICULUM)
def test_work_on_a_curriculum_grows_as_its_blocks(name):
    few, many = curriculum(4, 100), curriculum(4, 400)

    assert exponent(OF_A_CURRICULUM[name], few, many, 4) < 1.2


def test_reading_a_curriculum_grows_as_its_blocks():
    few, many = (curriculum(4, count).to_json() for count in (50, 200))

    assert exponent(Curriculum.from_json, few, many, 4) < 1.2


def test_held_out_tasks_are_compared_with_trained_ones_once():
    few, many = (tasks(count, 8) for count in (20, 80))

    def make(them: list[Task]) -> Curriculum:
        half = len(them) // 2
        evaluation = Evaluation(held_out=tuple(them[half:]))
        return Curriculum("half", 1, "a test", tuple(Block(task, 8) for task in them[:half]), evaluation)

    assert exponent(make, few, many, 4) < 1.2


def test_scores_grow_as_the_log(tmp_path):
    (few, short), (many, long) = ((each, logged(each)) for each in (curriculum(8), curriculum(32)))
    growth = len(long.measurements) / len(short.measurements)

    assert exponent(lambda each: scores(*each), (short, few), (long, many), growth) < 1.05
    assert exponent(lambda log: write_tables(log, tmp_path, parquet=False), short, long, growth) < 1.05


def test_the_metrics_of_a_run_do_not_grow_with_its_tasks(tmp_path):
    sizes = []
    for count in (8, 32):
        each = curriculum(count)
        write_metrics(tmp_path / "metrics.json", scores(logged(each), each))
        sizes.append((tmp_path / "metrics.json").stat().st_size)

    assert sizes[1] < 1.05 * sizes[0]


def test_a_log_that_grows_with_the_square_of_tasks_is_refused_before_any_work(monkeypatch):
    each = curriculum(4)
    lines = len(logged(each).of_kind("evaluation"))

    monkeypatch.setattr(refusals, "MOST_LINES", lines)
    check_rows(each, 4)
    Recorder(each, seed=0).close()

    monkeypatch.setattr(refusals, "MOST_LINES", lines - 1)
    message = "^evaluating 4 tasks 5 times writes 20 lines to the log, more than 19: .* curriculum=stream$"
    with pytest.raises(ValueError, match=message):
        check_rows(each, 4)
    with pytest.raises(ValueError, match=message):
        Recorder(each, seed=0)
    check_rows(replace(each, evaluation=Evaluation(at_block_ends=False, every=each.num_frames)), 4)
    with pytest.raises(ValueError, match="evaluating 4 tasks 11 times writes 44 lines"):
        check_rows(replace(each, evaluation=Evaluation(at_block_ends=False, every=8)), 4)


def test_more_tasks_than_can_be_made_at_once_are_refused_wherever_they_come_from(monkeypatch):
    """And before they are made: what else is wrong is not seen."""
    each = curriculum(4)
    broken = {**each.to_json(), "tasks": [None] * 4}
    monkeypatch.setattr(protocol, "MOST_TASKS", 3)
    message = (
        "a curriculum has at most 3 tasks, here are more: curriculum.goals=random or a list takes fewer, .*=stream"
    )

    for make in (
        lambda: replace(each, version=2),
        lambda: Curriculum.from_json(broken),
        lambda: all_goals(each.tasks[0]),
        lambda: curricula.from_axes(depth=1, image_seeds=[1, 2], num_frames=0),
        lambda: curricula.from_axes(goals=[1.1, 1.2], image_seeds=[1, 2], num_frames=0),
    ):
        with pytest.raises(ValueError, match=message):
            make()
    assert len(stream(num_tasks=5, depth=1).tasks) == 5


def peak(work: Callable[[], object]) -> int:
    """The most bytes that Python has allocated at once."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.slow
def test_memory_grows_as_the_files_that_are_read_and_written(tmp_path):
    def shares(count: int) -> list[float]:
        log, each = logged(curriculum(count)), curriculum(count)
        path, metrics_path = tmp_path / f"{count}.jsonl", tmp_path / f"{count}.json"
        path.write_text("".join(json.dumps(line) + "\n" for line in log.measurements), encoding="utf-8")
        found = scores(log, each)
        read, scored = peak(lambda: RunLog.read(path)), peak(lambda: scores(log, each))
        written = peak(lambda: write_metrics(metrics_path, found))
        size = path.stat().st_size
        return [read / size, scored / size, written / metrics_path.stat().st_size]

    few, many = shares(16), shares(48)

    assert all(large < 1.1 * small for small, large in zip(few, many, strict=True)), (few, many)


def a_run(draw: random.Random) -> list[Regime]:
    """Regimes in any order, some values 0 or negative."""
    names = "abcde"[: draw.randint(1, 5)]
    regimes = []
    for _ in range(draw.randint(1, 40)):
        training = draw.random() < 0.3
        values = [draw.choice((0.0, draw.random(), -draw.random())) for _ in range(draw.choice((1, 1, 3, 40)))]
        regimes.append(Regime(draw.choice(names), training, torch.tensor(values, dtype=torch.float64)))
    return regimes


def ratio(before: float, after: float) -> float:
    return after / before if before > 0 and after >= 0 else math.nan


def contrast(before: float, after: float) -> float:
    return (after - before) / (before + after) if min(before, after) >= 0 < before + after else math.nan


def transfer(regimes: list[Regime], measure: Callable[[float, float], float], forward: bool) -> list[float]:
    """The definition, pair after pair and regime after regime."""
    terms = []
    for a, b in itertools.permutations(dict.fromkeys(each.task for each in regimes), 2):
        of_b = [i for i, each in enumerate(regimes) if each.training and each.task == b]
        start = of_b[0] if of_b else len(regimes)
        of_a = [i for i, r in enumerate(regimes) if r.training and r.task == a and (i < start) == forward]
        if of_a:
            evaluations = [i for i, each in enumerate(regimes) if not each.training and each.task == b]
            terms.append(next(values(regimes, of_a, evaluations, measure), math.nan))
    return terms


def values(regimes: list[Regime], trainings: list[int], evaluations: list[int], measure: Any) -> Iterator[float]:
    for before, after in itertools.pairwise(evaluations):
        between = [i for i in range(before, after) if regimes[i].training]
        value = measure(regimes[before].terminal, regimes[after].terminal)
        if len({regimes[i].task for i in between}) == 1 and between[-1] in trainings and not math.isnan(value):
            yield value


def maintenance(regimes: list[Regime], to_evaluation: bool) -> list[float]:
    """The definition, task after task."""
    terms = []
    for task in dict.fromkeys(each.task for each in regimes):
        training = reference = None
        changes = []
        for each in (each for each in regimes if each.task == task):
            if each.training:
                training, reference = each.terminal, None
            elif training is not None and reference is None:
                reference = each.terminal
            elif training is not None:
                changes.append(each.terminal - (reference if to_evaluation else training))
        terms.append(math.fsum(changes) / len(changes) if changes else math.nan)
    return terms


def means(regimes: list[Regime], training: bool) -> list[float]:
    terms = []
    for task in dict.fromkeys(each.task for each in regimes):
        own = [each.values.mean().item() for each in regimes if each.task == task and each.training == training]
        terms.append(math.fsum(own) / len(own) if own else math.nan)
    return terms


REFERENCES: dict[str, Callable[[list[Regime]], list[float]]] = {
    "forward_transfer_ratio": lambda regimes: transfer(regimes, ratio, True),
    "forward_transfer_contrast": lambda regimes: transfer(regimes, contrast, True),
    "backward_transfer_ratio": lambda regimes: transfer(regimes, ratio, False),
    "backward_transfer_contrast": lambda regimes: transfer(regimes, contrast, False),
    "maintenance_of_evaluation": lambda regimes: maintenance(regimes, True),
    "maintenance_of_training": lambda regimes: maintenance(regimes, False),
    "mean_training_performance": lambda regimes: means(regimes, True),
    "mean_evaluation_performance": lambda regimes: means(regimes, False),
}


@pytest.mark.parametrize("name", REFERENCES)
def test_lifelong_metrics_of_a_table_have_the_bits_of_their_definitions(name):
    draw = random.Random(name)
    runs = [a_run(draw) for _ in range(60)]

    found = [getattr(metrics, name)(run).terms for run in runs]

    expected = [[None if math.isnan(term) else term for term in REFERENCES[name](run)] for run in runs]
    assert [list(terms) for terms in found] == expected
    assert sum(map(len, expected)) > 60


def test_scaling_all_regimes_at_once_has_the_bits_of_scaling_each():
    draw = random.Random(5)
    for run in (a_run(draw) for _ in range(40)):
        low, high = -1.5, 2.7

        prepared, _ = metrics.prepare(run, None, {each.task: (low, high) for each in run})

        for before, after in zip(run, prepared, strict=True):
            smoothed = metrics.lifetime.smooth(before.values) if before.training else before.values
            assert after.values.tolist() == ((smoothed - low) / (high - low) * 100.0 + 1.0).tolist()


def test_pairs_of_the_matrix_are_taken_row_by_row():
    draw = random.Random(6)
    matrix = torch.tensor([[draw.random() for _ in range(7)] for _ in range(8)], dtype=torch.float64)
    places = [(i, j) for i in range(1, 8) for j in range(1, 8)]

    at = {(i, j): matrix[i, j - 1].item() for i, j in places}

    assert list(metrics.accuracy_over_time(matrix).terms) == [at[i, j] for i, j in places if i >= j]
    assert list(metrics.zero_shot_performance(matrix).terms) == [at[i, j] for i, j in places if i < j]
    own = [at[i, j] - at[j, j] for i, j in places if i > j]
    assert list(metrics.backward_transfer_over_time(matrix).terms) == own


def test_the_slope_of_recovery_times_is_the_median_over_all_pairs():
    draw = random.Random(7)
    for count in (2, 3, 4, 9, 40):
        times = [draw.randint(0, 50) for _ in range(count)]
        slopes = sorted((times[j] - times[i]) / (j - i) for i, j in itertools.combinations(range(count), 2))
        middle = len(slopes) // 2
        median = slopes[middle] if len(slopes) % 2 else (slopes[middle - 1] + slopes[middle]) / 2

        assert theil_sen(times) == median
