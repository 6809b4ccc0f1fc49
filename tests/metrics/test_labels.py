"""Metrics of labels that a learner gives to tasks itself, on runs made by hand."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from helpers.scripted import ONE, THREE, TWO, of

from ctgraph_rl import Block, Curriculum, RunLog
from ctgraph_rl.learn.labels import task_labels
from ctgraph_rl.log.scores import scores
from ctgraph_rl.metrics.labels import adjusted_rand_index

NAMES = ("detection_delay", "false_alarms", "labels_per_task", "label_agreement", "frames_not_learned")

FIRST_TWICE = of(Block(ONE, 400), Block(TWO, 400), Block(ONE, 400), boundaries="hidden")


def log_of(*lines: tuple[int, int, int, int, int, int]) -> RunLog:
    """A log with training intervals: block, frames so far, label, whether learned from, alarm, frames rolled back."""
    log = RunLog()
    for block, frames, label, learned, alarm, back in lines:
        own = {"acted_label": label, "learned": learned, "alarm": alarm, "rolled_back": back}
        log.append("training", block=block, frames=frames, episodes=10, return_mean=frames / 1200, **own)
    evaluate_at_end(log)
    return log


def evaluate_at_end(log: RunLog) -> None:
    last = log.measurements[-1]
    log.append("evaluation", moment="after", block=last["block"], frames=last["frames"], task=1, return_mean=1.0)


BY_HAND = log_of(
    (1, 100, 1, 1, 0, 0),
    (1, 200, 1, 0, 1, 50),  # a false alarm
    (1, 400, 1, 1, 0, 0),
    (2, 500, 1, 1, 0, 0),
    (2, 600, 1, 0, 1, 200),  # 200 frames after the change
    (2, 800, 2, 1, 0, 0),
    (3, 1000, 2, 1, 0, 0),  # the change back is missed
    (3, 1200, 2, 1, 0, 0),
)


def found(log: RunLog, curriculum: Curriculum = FIRST_TWICE) -> dict[str, Any]:
    return scores(log, curriculum)


def test_delays_false_alarms_and_frames_that_taught_nothing_are_as_counted_by_hand():
    metrics = found(BY_HAND)

    delay = metrics["detection_delay"]
    assert (delay.value, delay.terms, delay.n_undefined) == (200, (200.0, None), 1)
    assert metrics["false_alarms"].value == 100_000 * 1 / 1200
    assert (metrics["frames_not_learned"].value, metrics["frames_rolled_back"].value) == (200, 250)
    assert metrics["labels_per_task"].value == 1
    assert metrics["online_return"].value == pytest.approx(4800 / 1200 / 8)


def test_label_agreement_is_the_adjusted_rand_index_of_all_pairs_of_frames():
    """a, b, c, d over all pairs, as scikit-learn's ``adjusted_rand_score`` counts them."""
    tasks, labels = [0] * 400 + [1] * 400 + [0] * 400, [1] * 600 + [2] * 600
    task, label = (torch.tensor(each) for each in (tasks, labels))
    upper = torch.triu(torch.ones(1200, 1200), diagonal=1).bool()
    same_task, same_label = ((each[:, None] == each)[upper] for each in (task, label))
    a, b = (same_task & same_label).sum().item(), (same_task & ~same_label).sum().item()
    c, d = (~same_task & same_label).sum().item(), (~same_task & ~same_label).sum().item()

    value = found(BY_HAND)["label_agreement"].value

    assert value == 2 * (a * d - b * c) / ((a + b) * (b + d) + (a + c) * (c + d))


@pytest.mark.parametrize(
    ("tasks", "labels", "frames", "value"),
    [
        ([0, 0, 1, 1], [0, 0, 1, 1], 1, 1.0),
        ([0, 0, 1, 1], [1, 1, 0, 0], 1, 1.0),
        ([0, 0, 1, 2], [0, 0, 1, 1], 1, 4 / 7),  # the examples of scikit-learn's documentation, 0.57...
        ([0, 0, 1, 1], [0, 0, 1, 2], 1, 4 / 7),
        ([0, 0, 0, 0], [0, 1, 2, 3], 1, 0.0),
        ([0, 0, 1, 1], [0, 1, 0, 1], 1, -0.5),
        ([0, 0, 0, 0], [0, 0, 0, 0], 1, 1.0),
        ([0, 1], [0, 1], 10**9, 1.0),
        ([0, 0, 1, 1], [0, 1, 0, 1], 10**9, pytest.approx(-1 / (4 * 10**9), rel=1e-6)),
    ],
)
def test_the_adjusted_rand_index_has_published_values_and_is_exact_for_many_frames(tasks, labels, frames, value):
    given = (torch.tensor(each) for each in (labels, tasks, [frames] * len(tasks)))

    assert adjusted_rand_index(*given) == value


AT_CHANGES = (
    *((1, 400, 1, 1, 1, 0), (2, 600, 2, 1, 0, 0), (2, 700, 1, 1, 0, 0)),
    *((2, 800, 1, 1, 1, 0), (3, 1200, 1, 1, 0, 0)),
)
"""Alarms at 400 and 800 frames, right at the changes."""


def test_an_alarm_counts_for_the_last_change_of_whose_task_its_batch_has_frames():
    metrics = found(log_of(*AT_CHANGES))

    assert metrics["detection_delay"].terms == (400.0, None)
    assert metrics["false_alarms"].value == pytest.approx(100_000 / 1200)  # that of 400 frames


def test_a_second_alarm_after_a_change_is_a_false_one():
    metrics = found(log_of((1, 400, 1, 1, 0, 0), (2, 600, 1, 1, 1, 0), (2, 800, 1, 1, 1, 0), (3, 1200, 1, 1, 0, 0)))

    assert metrics["detection_delay"].terms == (200.0, None)
    assert metrics["false_alarms"].value == pytest.approx(100_000 / 1200)


def test_the_oracle_is_right_at_the_change():
    log = log_of(*AT_CHANGES)
    for m in log.of_kind("training"):
        m["oracle"] = 1

    metrics = found(log)

    assert metrics["detection_delay"].terms == (0.0, 0.0)
    assert metrics["false_alarms"].value == 0


@pytest.mark.parametrize(
    ("curriculum", "reasons"),
    [
        (of(Block(ONE, 600), Block(TWO, 600)), dict.fromkeys(NAMES[:2], "announced")),
        (
            of(Block((ONE, TWO), 600), Block(ONE, 600), boundaries="hidden"),
            dict.fromkeys(NAMES[:4], "several|one task"),
        ),
        (of(Block(ONE, 600), Block(ONE, 600), boundaries="hidden"), {"detection_delay": "no terms"}),
    ],
)
def test_what_has_no_meaning_is_undefined_with_the_reason(curriculum, reasons):
    metrics = found(log_of((1, 600, 1, 1, 0, 0), (2, 1200, 1, 1, 0, 0)), curriculum)

    undefined = {name: metrics[name].undefined for name in NAMES if metrics[name].value is None}
    assert undefined.keys() == reasons.keys()
    assert all(any(part in str(undefined[name]) for part in reasons[name].split("|")) for name in reasons)


def test_a_run_without_labels_says_so_and_has_an_online_return():
    log = RunLog()
    log.append("training", block=1, frames=600, episodes=3, return_mean=0.5)
    log.append("training", block=2, frames=1200, episodes=0, return_mean=math.nan)
    evaluate_at_end(log)

    metrics = found(log, of(Block(ONE, 600), Block(TWO, 600)))

    assert {metrics[name].undefined for name in (*NAMES, "frames_rolled_back")} == {
        "the learner gives tasks no labels of its own: it has no detector"
    }
    assert metrics["online_return"].value == 0.5


def test_the_label_of_a_task_is_that_of_most_frames_and_blocks_of_several_tasks_count_for_each():
    assert task_labels(BY_HAND, FIRST_TWICE) == {0: 0, 1: 0}
    several = of(Block(ONE, 400), Block((TWO, THREE), 400), Block(TWO, 400), boundaries="hidden")

    assert task_labels(BY_HAND, several) == {0: 0, 1: 1, 2: 0}
    assert task_labels(RunLog(), several) == {}
