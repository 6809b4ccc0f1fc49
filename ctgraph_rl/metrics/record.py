"""A metric as a record: the value with its meaning, or the reason why there is none."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from functools import wraps
from inspect import Parameter, signature
from typing import Any, NamedTuple, ParamSpec

import numpy as np
import torch
from torch import Tensor

from ctgraph_rl.metrics.bounds import BoundsOf, unbounded
from ctgraph_rl.metrics.inputs import INPUTS

HERE = "ctgraph_rl"

MASTERED = 0.9
"""Share of episodes, or of the optimal value, that counts as mastered."""

TENSORS = ("Tensor", "Tensor | None", Tensor, Tensor | None)

Arguments = ParamSpec("Arguments")


@dataclass(frozen=True)
class Definition:
    """The meaning of a metric.

    Args:
        id: short name of source and metric, such as ``lopez-paz2017/bwt``.
        formula: the formula; tasks and blocks are counted from 1.
        source: where it is defined.
        partial: whether terms without a value are left out of the mean, and counted; else one makes the metric
            undefined.
    """

    id: str
    formula: str
    source: str
    partial: bool = False


@dataclass(frozen=True)
class Metric:
    """A metric's value with its meaning.

    Args:
        value: in units of performance; None when undefined.
        formula: with R for the performance matrix and tasks counted from 1.
        terms: in order; None for those without a value.
    """

    value: float | None
    definition: str
    formula: str
    source: str
    undefined: str | None = None
    n_undefined: int = 0
    terms: tuple[float | None, ...] = ()


class Entry(NamedTuple):
    """A metric with its inputs."""

    metric: Callable[..., Metric]
    meaning: Definition
    inputs: dict[str, str]
    """Names in `INPUTS` by argument."""
    required: tuple[str, ...]
    """Inputs without which there is no metric."""

    bounds: BoundsOf = unbounded
    """Lowest and highest value of a run."""

    is_time: bool = False
    """Whether it is a time, infinite in a run that never got there."""
    is_exact: bool = False
    """Whether it follows from the curriculum, with one value for all runs."""

    def of(self, given: Mapping[str, Any]) -> Metric:
        """Compute the metric; undefined where an input is `Undefined`, for its reason."""
        arguments = {argument: given[name] for argument, name in self.inputs.items() if name in given}
        reasons = [str(value) for value in arguments.values() if isinstance(value, Undefined)]
        return undefined(self.metric, reasons[0]) if reasons else self.metric(**arguments)


METRICS: dict[str, Entry] = {}
"""Every metric by its function's name."""


class Undefined(Exception):
    """Raised where a definition says nothing; the message is the reason."""


def defined(
    definition: str,
    formula: str,
    source: str,
    *,
    partial: bool = False,
    missing: str | Callable[..., str] = "an evaluation is missing",
    aggregate: Callable[[Tensor], Tensor] = torch.mean,
    inputs: Mapping[str, str] | None = None,
    bounds: BoundsOf = unbounded,
    is_time: bool = False,
    is_exact: bool = False,
) -> Callable[[Callable[Arguments, Tensor]], Callable[Arguments, Metric]]:
    """Make a metric of a function that returns the terms of its formula, NaN for a term without a value.

    It also takes lists and NumPy arrays, is listed in `METRICS`, and is computed wherever its inputs are there: those
    of `INPUTS` that its arguments are named after. An argument with a default keeps it without its input.

    Args:
        definition: id of the definition.
        formula: the formula.
        source: where it is defined.
        partial: as in `Definition`.
        missing: why a term may lack a value, or a function of the same arguments that says why terms do.
        aggregate: makes the value of the terms.
        inputs: the inputs of arguments with other names.
        bounds: lowest and highest value, one of `ctgraph_rl.metrics.bounds`. Intervals over seeds stay within.
        is_time: as in `Entry`.
        is_exact: as in `Entry`.

    Raises:
        ValueError: for a function without inputs, an argument without default that is no input or nearly the name of
            one, and a name or id that another metric has.
    """
    meaning = Definition(definition, formula, source, partial)

    def decorate(terms: Callable[Arguments, Tensor]) -> Callable[Arguments, Metric]:
        given_as = signature(terms)
        tensors = [name for name, each in given_as.parameters.items() if each.annotation in TENSORS]

        @wraps(terms)
        def metric(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Metric:
            given = given_as.bind(*args, **kwargs)
            for name in tensors:
                if isinstance(given.arguments.get(name), (list, tuple, np.ndarray)):
                    given.arguments[name] = float64(given.arguments[name])
            try:
                why = missing if isinstance(missing, str) else missing(*given.args, **given.kwargs)
                return _metric(meaning, terms(*given.args, **given.kwargs).flatten(), why, aggregate)
            except Undefined as reason:
                return undefined(metric, str(reason))

        metric.definition = meaning  # type: ignore[attr-defined]
        entry = _entry(metric, meaning, inputs or {})
        METRICS[metric.__name__] = entry._replace(bounds=bounds, is_time=is_time, is_exact=is_exact)
        return metric

    return decorate


def _entry(metric: Callable[..., Metric], meaning: Definition, renamed: Mapping[str, str]) -> Entry:
    name = metric.__name__
    arguments = signature(metric).parameters
    inputs = {}
    required = []
    unknown = [*(renamed.keys() - arguments.keys())]
    for argument, each in arguments.items():
        source = renamed.get(argument, argument)
        if source in INPUTS:
            inputs[argument] = source
        if each.default is Parameter.empty:
            required.append(source)
            is_star = each.kind in (Parameter.VAR_POSITIONAL, Parameter.VAR_KEYWORD)
            is_wrong = is_star or source not in INPUTS
        else:
            is_wrong = source not in INPUTS and bool(get_close_matches(argument, INPUTS, cutoff=0.8))
        if is_wrong:
            unknown.append(argument)
    if not required:
        unknown.append("any argument")
    if unknown:
        raise ValueError(f"metric {name}: no input for {', '.join(unknown)}. Inputs: {', '.join(INPUTS)}")
    if name in METRICS or meaning.id in (entry.meaning.id for entry in METRICS.values()):
        raise ValueError(f"metric {name} ({meaning.id}): another metric has its name or its id; choose others")
    return Entry(metric, meaning, inputs, tuple(required))


def undefined(metric: Callable[..., Metric], reason: str) -> Metric:
    """Return a metric without a value, for a reason beyond its arguments."""
    meaning: Definition = metric.definition  # type: ignore[attr-defined]
    return Metric(None, meaning.id, meaning.formula, meaning.source, reason)


def _metric(meaning: Definition, terms: Tensor, missing: str, aggregate: Callable[[Tensor], Tensor]) -> Metric:
    has_value = terms.isfinite()
    count = len(terms)
    without = int((~has_value).sum())
    reason = None
    if count == 0:
        reason = "the formula has no terms here"
    elif without == count or (without and not meaning.partial):
        reason = f"{without} of {count} terms have no value: {missing}"
    value = None if reason else aggregate(terms[has_value]).item()
    shown = tuple(term if finite else None for term, finite in zip(terms.tolist(), has_value.tolist(), strict=True))
    return Metric(value, meaning.id, meaning.formula, meaning.source, reason, n_undefined=without, terms=shown)


def ratio(above: Tensor, below: Tensor) -> Tensor:
    """``above / below``, NaN where ``below`` is 0."""
    return torch.where(below == 0, torch.nan, above / below)


def float64(values: Any) -> Tensor:
    """Return numbers as a tensor on the CPU."""
    return torch.tensor(values, dtype=torch.float64, device="cpu")
