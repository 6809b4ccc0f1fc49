"""Lifelong metrics: the values of l2metrics 3.1.0 on recorded runs, and its known traps."""

from __future__ import annotations

import json
import math

import pytest
import torch
from helpers.paths import DATA

from ctgraph_rl import metrics
from ctgraph_rl.metrics import Regime
from ctgraph_rl.metrics.lifetime import recovery_times, smooth, theil_sen

CASES = sorted((DATA / "l2metrics").glob("*.json"))

OURS = {
    "perf_recovery": "performance_recovery",
    "avg_train_perf": "mean_training_performance",
    "avg_eval_perf": "mean_evaluation_performance",
    "perf_maintenance_mrlep": "maintenance_of_evaluation",
    "perf_maintenance_mrtlp": "maintenance_of_training",
    "forward_transfer_ratio": "forward_transfer_ratio",
    "forward_transfer_contrast": "forward_transfer_contrast",
    "backward_transfer_ratio": "backward_transfer_ratio",
    "backward_transfer_contrast": "backward_transfer_contrast",
    "ste_rel_perf": "relative_performance",
    "sample_efficiency": "sample_efficiency",
}


def tensor(values) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def train(task: str, *values: float) -> Regime:
    return Regime(task, True, tensor(values))


def evaluated(**values: float) -> list[Regime]:
    return [Regime(task, False, tensor([value])) for task, value in values.items()]


@pytest.mark.parametrize("path", CASES, ids=lambda path: path.stem)
def test_every_lifetime_metric_equals_that_of_l2metrics(path):
    case = json.loads(path.read_text(encoding="utf-8"))
    regimes = [Regime(task, training, tensor(values)) for task, training, values in case["regimes"]]
    experts = {task: [tensor(curve) for curve in curves] for task, curves in case.get("experts", {}).items()}

    if "settings" not in case:
        regimes, experts = metrics.prepare(regimes, experts, case.get("ranges"))
    found = metrics.of_regimes(regimes, experts)

    values = {theirs: found[ours].value for theirs, ours in OURS.items()}
    defined = {name: value for name, value in case["l2metrics"].items() if value is not None}
    assert {name for name, value in values.items() if value is not None} == set(defined)
    assert [values[name] for name in defined] == pytest.approx(list(defined.values()), rel=1e-9, abs=1e-9)


def test_the_recorded_cases_define_every_metric_and_leave_some_undefined():
    recorded = [json.loads(path.read_text(encoding="utf-8"))["l2metrics"] for path in CASES]

    assert len(CASES) >= 9
    assert all(list(values) == list(OURS) for values in recorded)
    assert all(sum(values[name] is not None for values in recorded) >= 2 for name in OURS)
    assert sum(value is None for values in recorded for value in values.values()) >= 10


def test_smoothing_keeps_the_length_and_leaves_short_curves_alone():
    rise = torch.arange(30, dtype=torch.float64)

    smoothed = smooth(rise)

    assert torch.equal(smooth(rise[:14]), rise[:14])
    assert len(smoothed) == 30
    assert smoothed[10:20].tolist() == pytest.approx((rise[10:20] - 0.5).tolist(), abs=1e-12)  # a window of 6
    assert smooth(rise[:15])[:3].tolist() == pytest.approx([1.0, 2 / 3, 1.0], abs=1e-12)  # a window of 3
    assert smoothed[0].item() == pytest.approx((3 + 2 + 1 + 0 + 1 + 2) / 6, abs=1e-12)


def test_terminal_performance_is_of_the_last_tenth_of_training_and_all_of_an_evaluation():
    values = tensor([0.0] * 18 + [0.5, 1.0])

    assert Regime("a", True, values).terminal == 0.75
    assert Regime("a", False, values).terminal == 0.075


def test_preparing_scales_each_task_to_its_own_range_and_a_constant_one_to_one():
    regimes = [train("a", 0.0, 0.5), *evaluated(a=2.0), train("b", 3.0, 3.0)]

    scaled, _ = metrics.prepare(regimes)
    given, experts = metrics.prepare(regimes, {"a": [tensor([4.0])]}, {"a": (0.0, 4.0), "b": (2.0, 4.0)})

    assert [each.values.tolist() for each in scaled] == [[1.0, 26.0], [101.0], [1.0, 1.0]]
    assert [each.values.tolist() for each in given] == [[1.0, 13.5], [51.0], [51.0, 51.0]]
    assert experts["a"][0].tolist() == [101.0]
    with pytest.raises(ValueError, match=r"ranges must have each task, there is none of \['b'\]"):
        metrics.prepare(regimes, ranges={"a": (0.0, 4.0)})


def test_mean_performance_is_of_each_tasks_own_regimes_first():
    run = [train("a", 0, 1), *evaluated(a=1.0, b=0.5), train("a", 1), *evaluated(a=0.5)]

    assert metrics.mean_training_performance(run).terms == (0.75, None)
    assert metrics.mean_evaluation_performance(run).terms == (0.75, 0.5)


def test_recovery_is_positive_when_it_gets_faster():
    blocks = [train("a", 0, 0, 0, 1), train("a", 0, 0, 0, 1), train("a", 0, 0, 1, 1), train("a", 1, 1, 1, 1)]

    assert recovery_times(blocks) == [3, 2, 0]
    assert metrics.performance_recovery(blocks).value == 1.5
    assert theil_sen([3, 2, 0]) == -1.5


def test_what_is_never_recovered_takes_one_experience_more_than_there_are():
    assert recovery_times([train("a", 1, 1), train("a", 0, 0, 0)]) == [4]


def test_recovery_needs_a_task_that_is_trained_three_times():
    metric = metrics.performance_recovery([train("a", 0, 1), train("a", 0, 1), train("b", 1)])

    assert (metric.value, metric.n_undefined) == (None, 2)
    assert metric.undefined == "2 of 2 terms have no value: a task has fewer than two recovery times"


def test_maintenance_compares_later_evaluations_with_the_one_right_after_training():
    run = [train("a", 0.5), *evaluated(a=1.0, b=0.0), train("b", 1.0), *evaluated(a=0.25, b=1.0)]

    by_evaluation, by_training = metrics.maintenance_of_evaluation(run), metrics.maintenance_of_training(run)

    assert (by_evaluation.value, by_evaluation.terms) == (-0.75, (-0.75, None))
    assert (by_training.value, by_training.n_undefined) == (-0.25, 1)


def test_a_task_trained_again_has_a_new_reference():
    run = [
        train("a", 1),
        *evaluated(a=1.0),
        train("b", 1),
        *evaluated(a=0.5),
        train("a", 1),
        *evaluated(a=0.75),
        *evaluated(a=0.5),
    ]

    assert metrics.maintenance_of_evaluation(run).terms == ((-0.5 - 0.25) / 2, None)


def test_two_tasks_between_two_evaluations_have_no_transfer_of_either():
    run = [*evaluated(a=0.1, b=0.1, c=0.1), train("a", 1), train("b", 1), *evaluated(a=0.5, b=0.6, c=0.2)]

    metric = metrics.forward_transfer_ratio(run)

    assert (metric.value, metric.n_undefined) == (None, 3)
    assert "around a training of one task alone" in metric.undefined


def test_a_ratio_from_zero_is_undefined_and_counted_while_the_contrast_shows_the_gain():
    run = [*evaluated(a=0.0, b=0.0), train("a", 1), *evaluated(a=1.0, b=1.0)]

    ratio, contrast = metrics.forward_transfer_ratio(run), metrics.forward_transfer_contrast(run)

    assert (ratio.value, ratio.n_undefined) == (None, 1)
    assert contrast.value == 1.0


@pytest.mark.parametrize(("after", "value"), [(0.5, 51.0), (1.0, 101.0)])
def test_the_default_scale_makes_a_ratio_of_its_own_offset(after, value):
    run, _ = metrics.prepare(
        [*evaluated(a=0.0, b=0.0), train("a", 1), *evaluated(a=1.0, b=after)], None, {"a": (0, 1), "b": (0, 1)}
    )

    assert metrics.forward_transfer_ratio(run).value == value


def test_a_task_never_solved_has_no_transfer_where_the_scale_would_say_one():
    run = [*evaluated(a=0.0, b=0.0), train("a", 1), *evaluated(a=1.0, b=0.0)]
    scaled, _ = metrics.prepare(run)

    found = [metrics.forward_transfer_contrast(run), metrics.forward_transfer_ratio(scaled)]

    assert [(metric.value, metric.n_undefined) for metric in found] == [(None, 1), (1.0, 0)]


def test_only_the_first_value_of_a_pair_counts():
    run = [*evaluated(a=0.5, b=0.5), train("a", 1), *evaluated(a=0.5, b=1.0), train("a", 1), *evaluated(a=0.5, b=0.25)]

    assert metrics.forward_transfer_ratio(run).terms == (2.0,)


def test_without_an_evaluation_before_training_the_first_task_has_no_forward_transfer():
    run = [train("a", 1), *evaluated(a=1, b=0.5), train("b", 1), *evaluated(a=0.5, b=1)]

    forward, backward = metrics.forward_transfer_ratio(run), metrics.backward_transfer_ratio(run)

    assert (forward.value, forward.n_undefined) == (None, 1)
    assert backward.value == 0.5


def test_negative_performance_has_no_ratio_no_contrast_and_no_relative_performance():
    run = [*evaluated(a=-1.0, b=-1.0), train("a", -1.0, -0.5), *evaluated(a=-0.5, b=-0.5)]

    found = metrics.of_regimes(run, {"a": [tensor([-1.0, -1.0])]})

    names = ("forward_transfer_ratio", "forward_transfer_contrast", "relative_performance", "sample_efficiency")
    assert [(found[name].value, found[name].n_undefined) for name in names] == [(None, 1)] * 4


def test_relative_performance_compares_equally_many_experiences():
    run = [train("a", 0.5, 0.5), train("b", 1.0), train("a", 1.0)]
    experts = {"a": [tensor([0.5, 0.5, 0.5, 9.0])]}

    metric = metrics.relative_performance(run, experts)

    assert (metric.value, metric.terms) == (2.0 / 1.5, (2.0 / 1.5, None))


def test_an_expert_of_nothing_makes_relative_performance_undefined_and_not_infinite():
    metric = metrics.relative_performance([train("a", 0.5)], {"a": [tensor([0.0])]})

    assert (metric.value, metric.n_undefined) == (None, 1)


def test_sample_efficiency_is_height_times_speed_of_saturation():
    run, expert = [train("a", 0, 0.25, 0.5, 0.5)], tensor([0, 0, 0, 0, 1.0])

    assert metrics.sample_efficiency(run, {"a": [expert]}).value == (0.5 / 1.0) * (4 / 2)


@pytest.mark.parametrize("values", [(1, 1, 1, 1), (1, 0.5, 0.25, 0)], ids=["jump-start", "decline"])
def test_a_curve_that_is_best_at_its_start_has_no_sample_efficiency_and_is_counted(values):
    metric = metrics.sample_efficiency([train("a", *values)], {"a": [tensor([0, 0, 1.0])]})

    assert (metric.value, metric.n_undefined) == (None, 1)


@pytest.mark.parametrize("values", [(0.5, 1.0, 0, 0, 0), (0, 0.125, 0.125, 0.125)], ids=["falls", "stays low"])
def test_training_that_falls_or_stays_low_has_a_sample_efficiency_of_zero(values):
    metric = metrics.sample_efficiency([train("a", *values)], {"a": [tensor([0, 0, 1.0])]})

    assert (metric.value, metric.n_undefined) == (0.0, 0)


@pytest.mark.parametrize("level", [1.0, 1000.0])
def test_a_plateau_is_reached_at_its_start_whatever_the_last_bit_says(level):
    above = math.nextafter(level, math.inf)
    experts = {"a": [tensor([0, 0, level])]}

    assert recovery_times([train("a", above), train("a", 0, level, above)]) == [1]
    assert metrics.sample_efficiency([train("a", 0, level, above)], experts).value == pytest.approx(2, abs=1e-12)


def test_a_fifth_of_the_experts_saturation_is_enough():
    experts = {"a": [tensor([0, 2.0])]}

    found = [metrics.sample_efficiency([train("a", 0, level)], experts).value for level in (0.375, 0.4)]

    assert found == [0.0, 0.2]


def test_one_expert_without_a_value_makes_the_tasks_undefined():
    experts = {"a": [tensor([0, 0, 1.0]), tensor([1.0, 0, 0])]}

    assert metrics.sample_efficiency([train("a", 0, 1.0)], experts).n_undefined == 1


@pytest.mark.parametrize("values", [[], [math.nan], [1.0, math.inf], [[1.0]]])
def test_a_regime_needs_finite_values(values):
    with pytest.raises(ValueError, match="a regime of a needs finite values"):
        Regime("a", True, tensor(values))
