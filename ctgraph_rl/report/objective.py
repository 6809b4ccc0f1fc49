"""The metric that a run gives to a sweeper."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ctgraph_rl.checks import did_you_mean, require
from ctgraph_rl.log.files import METRICS
from ctgraph_rl.log.sums import metrics_of
from ctgraph_rl.metrics import METRICS as DEFINED
from ctgraph_rl.metrics.inputs import OF_A_PART


def check_objective(name: str | None, experts: bool, until: float | None) -> None:
    """Refuse an objective that a run cannot have.

    Args:
        name: of a metric; None: no objective.
        until: the share of the frames that a tuning run learns; None: the run is none.

    Raises:
        ValueError: for an unknown name, one that needs experts, and one that a tuning run has not.
    """
    if name is None:
        require((until is None, f"objective_until={until} needs a metric, such as objective=online_return"))
        return
    is_known = isinstance(name, str) and name in DEFINED
    require((is_known, f"objective must be a metric, got {name!r}: {did_you_mean(str(name), list(DEFINED))}"))
    needs_experts = any("expert" in each for each in DEFINED[name].required)
    require((experts or not needs_experts, f"objective={name} compares with single-task experts: add experts=true"))
    if until is not None:
        of_a_part = [each for each, entry in DEFINED.items() if {*entry.required} <= {*OF_A_PART}]
        choices = f"objective={name} must be a metric of training with objective_until={until}"
        require(
            (name in of_a_part, f"{choices}: {', '.join(of_a_part)}"),
            (not experts, f"objective_until={until} compares with no experts: set experts=false"),
        )


def objective_of(name: str, run_dirs: Sequence[Path]) -> float:
    """Return the mean of a metric over finished runs.

    Raises:
        ValueError: if a run has no value; says why.
    """
    values = []
    for run_dir in run_dirs:
        metric = metrics_of((run_dir / METRICS).read_bytes())[name]
        why = f"objective={name} has no value in {run_dir}: {metric['undefined']}"
        require((metric["value"] is not None, why))
        values.append(metric["value"])
    return sum(values) / len(values)
