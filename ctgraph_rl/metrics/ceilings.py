"""Metrics of what tasks allow: three ceilings on the mean return, the gap that memory closes, and what is observed.

Ceilings and entropies are equal for every run of a curriculum, and say why they are not known where they are not. Noise
and rotation on read are left out of what is observed.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ctgraph_rl.metrics.bounds import at_most_1
from ctgraph_rl.metrics.record import HERE, Undefined, defined, ratio

NO_GAP = 1e-12
"""Smallest gap between the best memoryless policy and the optimum."""


@defined("ctgraph_rl/ceiling-open-loop", "1/T sum_j o_j", HERE, is_exact=True)
def open_loop_ceiling(open_loop_ceilings: Tensor) -> Tensor:
    """Mean over tasks of the best mean return of a fixed sequence of actions, which ignores all observations.

    Args:
        open_loop_ceilings: by `ctgraph_rl.tasks.values.open_loop_ceiling`, float64 [tasks].
    """
    return open_loop_ceilings


@defined("ctgraph_rl/ceiling-memoryless", "1/T sum_j m_j", HERE, is_exact=True)
def memoryless_ceiling(memoryless_ceilings: Tensor) -> Tensor:
    """Mean over tasks of the best mean return of a policy that sees an observation and remembers nothing.

    Args:
        memoryless_ceilings: by `ctgraph_rl.tasks.values.memoryless_ceiling`, of any policy, float64 [tasks].
    """
    return memoryless_ceilings


@defined(
    "ctgraph_rl/ceiling-optimal",
    "1/T sum_j best_j",
    HERE,
    missing="a task's optimal value is not known: its graph is too large",
    is_exact=True,
)
def optimal_performance(best: Tensor) -> Tensor:
    """Mean over tasks of the best mean return of any policy, which knows goals that change.

    Args:
        best: each task's `Task.optimal_value(1.0)`.
    """
    return best


@defined(
    "ctgraph_rl/memory-gap-closed",
    "mean over tasks with m_j < best_j of (R[last,j] - m_j) / (best_j - m_j)",
    HERE,
    partial=True,
    missing="memory gains nothing there, or an evaluation is missing",
    bounds=at_most_1,
)
def memory_gap_closed(performance: Tensor, memoryless_ceilings: Tensor, best: Tensor) -> Tensor:
    """Share of the gap between the best memoryless policy and the optimum that is closed after the last block.

    1 is optimal, 0 is the best policy without memory, and less is negative: forgetting counts, too. Tasks that need no
    memory are left out.

    Args:
        performance: float64 [blocks + 1, tasks], mean undiscounted returns.
        memoryless_ceilings: as for `memoryless_ceiling`.
        best: each task's `Task.optimal_value(1.0)`.
    """
    if performance[-1].isnan().any():
        raise Undefined("the last evaluation of a task is missing")
    gap = best - memoryless_ceilings
    return ratio(performance[-1] - memoryless_ceilings, torch.where(gap > NO_GAP, gap, 0.0))


@defined("ctgraph_rl/state-entropy-random", "1/T sum_j H_j(state | observation), random", HERE, is_exact=True)
def state_entropy_random(random_entropies: Tensor) -> Tensor:
    """Mean over tasks of H(state | observation) in bits under the uniformly random policy; 0 is fully observable.

    Args:
        random_entropies: by `ctgraph_rl.tasks.observability.state_entropy`, float64 [tasks].
    """
    return random_entropies


@defined("ctgraph_rl/state-entropy-navigation", "1/T sum_j H_j(state | observation), navigating", HERE, is_exact=True)
def state_entropy_navigation(navigation_entropies: Tensor) -> Tensor:
    """The same under the policy that waits at wait states and decides at random.

    Args:
        navigation_entropies: as for `state_entropy_random`.
    """
    return navigation_entropies


@defined("ctgraph_rl/state-entropy-optimal", "1/T sum_j H_j(state | observation), optimal", HERE, is_exact=True)
def state_entropy_optimal(optimal_entropies: Tensor) -> Tensor:
    """The same under the policy that waits at wait states and decides for the goal.

    Args:
        optimal_entropies: as for `state_entropy_random`.
    """
    return optimal_entropies
