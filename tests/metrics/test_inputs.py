"""A metric that is written is computed wherever its inputs are there, or refused where it is defined."""

import pytest
import torch
from torch import Tensor

from ctgraph_rl import Curriculum, RunLog, metrics
from ctgraph_rl.log import scores
from ctgraph_rl.metrics.inputs import INPUTS
from ctgraph_rl.metrics.record import METRICS, Undefined, defined
from ctgraph_rl.tasks.configurations import ct_su_b1
from ctgraph_rl.tasks.protocol import Block

PERFORMANCE = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.5, 1.0]], dtype=torch.float64)


@pytest.fixture
def own(monkeypatch):
    """A metric of its own, listed as those of the modules are until the test is over."""
    monkeypatch.setattr("ctgraph_rl.metrics.record.METRICS", dict(METRICS))

    @defined("test/worst", "min_j R[last,j]", "test", aggregate=torch.amin)
    def worst_performance(performance: Tensor, margin: float = 0.0) -> Tensor:
        return performance[-1] - margin

    return metrics.record.METRICS["worst_performance"]


def test_a_metric_takes_the_inputs_that_its_arguments_name(own):
    metric = own.of({"performance": PERFORMANCE, "trained": ((0,), (1,))})

    assert (metric.value, metric.terms) == (0.5, (0.5, 1.0))
    assert own.inputs == {"performance": "performance"} and own.required == ("performance",)


def test_an_input_that_a_run_does_not_give_makes_a_metric_undefined_for_its_reason(own):
    metric = own.of({"performance": Undefined("nothing was evaluated")})

    assert (metric.value, metric.undefined) == (None, "nothing was evaluated")


def test_a_metric_of_anything_else_is_refused_where_it_is_defined():
    with pytest.raises(ValueError, match=r"metric best_colour: no input for colours\. Inputs: performance, trained,"):

        @defined("test/colour", "max c", "test")
        def best_colour(colours: Tensor) -> Tensor:
            return colours

    with pytest.raises(ValueError, match="metric renamed: no input for best"):

        @defined("test/renamed", "x", "test", inputs={"best": "interval_best"})
        def renamed(performance: Tensor) -> Tensor:
            return performance

    assert not {"best_colour", "renamed"} & METRICS.keys()


def misspelt(performance: Tensor, curve: object = None) -> Tensor:
    return performance


def starred(*performance: Tensor) -> Tensor:
    return performance[0]


def without_inputs() -> Tensor:
    return torch.tensor([1.0])


@pytest.mark.parametrize(
    ("terms", "what"), [(misspelt, "curve"), (starred, "performance"), (without_inputs, "any argument")]
)
def test_a_metric_that_would_be_computed_of_something_else_is_refused(terms, what):
    with pytest.raises(ValueError, match=f"metric {terms.__name__}: no input for {what}"):
        defined(f"test/{terms.__name__}", "x", "test")(terms)


def test_a_metric_that_a_users_script_defines_is_computed():
    before = dict(METRICS)
    try:
        defined("test/late", "x", "test")(late)
        found = metrics.of_matrix(torch.tensor([[0.0], [1.0]]), [(0,)])
    finally:
        METRICS.clear()
        METRICS.update(before)

    assert found["late"].value == 0.5


def late(performance: Tensor) -> Tensor:
    return performance


def test_a_metric_of_a_module_that_does_not_postpone_annotations_takes_lists():
    def own(performance):
        return performance[-1]

    own.__annotations__["performance"] = Tensor
    before = dict(METRICS)
    try:
        metric = defined("test/own", "x", "test")(own)
    finally:
        METRICS.clear()
        METRICS.update(before)

    assert metric([[0.0, 0.0], [0.5, 1.0]]).value == 0.75


@pytest.mark.parametrize(("name", "which"), [("forgetting", "test/new"), ("another_name", "chaudhry2018/f")])
def test_a_name_and_an_id_are_those_of_one_metric(name, which):
    def terms(performance: Tensor) -> Tensor:
        return performance

    terms.__name__ = name

    with pytest.raises(ValueError, match="another metric has its name or its id; choose others"):
        defined(which, "x", "test")(terms)


def test_a_run_gives_every_input():
    curriculum = Curriculum("c", 1, "", (Block(ct_su_b1(), 8),))

    given = scores.inputs_of(RunLog(), curriculum, None)

    assert list(INPUTS) == sorted(given, key=list(INPUTS).index) and given.keys() == INPUTS.keys()


def test_every_metric_is_an_attribute_and_listed_once():
    assert len(metrics.definitions()) == len(METRICS) >= 35
    assert all(getattr(metrics, name) is entry.metric for name, entry in METRICS.items())
    with pytest.raises(AttributeError, match="no attribute 'forgetfulness'"):
        _ = metrics.forgetfulness


def test_every_name_that_is_exported_is_listed_and_there():
    names = metrics.__all__

    assert sorted(names) == [
        *(
            "AGAINST_EXPERTS",
            "Curves",
            "Definition",
            "MASTERED",
            "METRICS",
            "Metric",
            "Regime",
            "RegimeTable",
        ),
        *("STAGES", "SUMMARY", "Trained", "Undefined", "check_experts", "definitions", "mean_area", "of_curves"),
        *("of_inputs", "of_matrix", "of_regimes", "prepare", "stage_areas", "summary", "trapezoid_area", "undefined"),
    ]
    assert {*names, *METRICS} == set(dir(metrics))
    assert all(getattr(metrics, name) is not None for name in names)
