"""Metrics of the performance matrix.

``performance[i, j]`` is the performance on task j after block i, float64 [blocks + 1, tasks]; row 0 is before any
training; NaN is "not evaluated". ``trained`` has the tasks of each block, counted from 0; without it, block i trains
task i. A NaN that a formula needs makes the metric undefined.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from ctgraph_rl.metrics.bounds import of_changes, of_gains, of_performance, of_remembering, of_scaled_changes
from ctgraph_rl.metrics.record import Undefined, defined, ratio

Trained = Sequence[Sequence[int]]

LOPEZ_PAZ = "Lopez-Paz & Ranzato 2017, Gradient Episodic Memory (arXiv 1706.08840)"
CHAUDHRY = "Chaudhry et al. 2018, Riemannian Walk (arXiv 1801.10112)"
DIAZ = "Diaz-Rodriguez et al. 2018, Don't forget, there is more than forgetting (arXiv 1810.13166)"
CORA = "Powers et al. 2022, CORA (arXiv 2110.10067)"

OUT_OF_ORDER = "the definition needs each task trained once, alone, in the order of the columns"
ONE_TASK = "the definition needs at least two tasks"


@defined("lopez-paz2017/acc", "1/T sum_j R[T,j]", LOPEZ_PAZ, bounds=of_performance)
def average_performance(performance: Tensor, trained: Trained | None = None) -> Tensor:
    """ACC = 1/T sum_j R[last, j]: mean performance on all tasks after the last block, for any curriculum."""
    return performance[-1]


@defined("lopez-paz2017/fwt", "1/(T-1) sum_{j=2..T} (R[j-1,j] - R[0,j])", LOPEZ_PAZ, bounds=of_changes)
def forward_transfer(performance: Tensor, trained: Trained | None = None) -> Tensor:
    """FWT = 1/(T-1) sum_{j>1} (R[j-1, j] - R[0, j]).

    The gain of a task before its own block by the tasks before it, against the untrained agent (the b_j of the source).
    Undefined as `backward_transfer`, and without the evaluation before any training.
    """
    _several_in_order(performance, trained)
    _has_initial_evaluation(performance[:, 1:])
    before_own = performance[:-1].diagonal()
    return (before_own - performance[0])[1:]


@defined("lopez-paz2017/bwt", "1/(T-1) sum_{j=1..T-1} (R[T,j] - R[j,j])", LOPEZ_PAZ, bounds=of_changes)
def backward_transfer(performance: Tensor, trained: Trained | None = None) -> Tensor:
    """BWT = 1/(T-1) sum_{j<T} (R[T, j] - R[j, j]).

    The change on each earlier task from right after its own block to the end; negative when tasks are forgotten.
    Undefined for a single task, and unless each task is trained once, in a block without others, in order.

    Example:
        >>> R = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.5, 1.0]])
        >>> backward_transfer(R, [[0], [1]]).value
        -0.5
    """
    _several_in_order(performance, trained)
    own = performance[1:].diagonal()
    return (performance[-1] - own)[:-1]


@defined("chaudhry2018/f", "1/(T-1) sum_{j=1..T-1} (max_{l=1..T-1} R[l,j] - R[T,j])", CHAUDHRY, bounds=of_changes)
def forgetting(performance: Tensor, trained: Trained | None = None) -> Tensor:
    """F = 1/(T-1) sum_{j<T} (max_{1<=l<T} R[l, j] - R[T, j]).

    The drop on each earlier task from its best after any earlier block, not row 0, to the end. Undefined as
    `backward_transfer`.
    """
    _several_in_order(performance, trained)
    best = performance[1:-1].amax(dim=0)
    return (best - performance[-1])[:-1]


@defined("diaz-rodriguez2018/a", "2/(T(T+1)) sum_{i>=j} R[i,j]", DIAZ, bounds=of_performance)
def accuracy_over_time(performance: Tensor, trained: Trained | None = None) -> Tensor:
    """A: mean over all pairs of a block i and a task j that was trained by then.

    Undefined as `backward_transfer`, but defined for a single task.
    """
    _in_order(performance, trained)
    return _pairs(performance, torch.ge)


@defined("diaz-rodriguez2018/bwt", "2/(T(T-1)) sum_{i>j} (R[i,j] - R[j,j])", DIAZ, bounds=of_changes)
def backward_transfer_over_time(performance: Tensor, trained: Trained | None = None) -> Tensor:
    """BWT after every block: mean change on a task from its own block to each later block.

    Undefined as `backward_transfer`.
    """
    return _changes_after_own_block(performance, trained)


@defined(
    "diaz-rodriguez2018/rem",
    "1 - |min(BWT, 0)|",
    DIAZ,
    aggregate=lambda changes: 1 - changes.mean().clamp(max=0).abs(),
    bounds=of_remembering,
)
def remembering(performance: Tensor, trained: Trained | None = None) -> Tensor:
    """REM = 1 - |min(BWT, 0)| with BWT of `backward_transfer_over_time`; 1 without forgetting.

    In [0, 1] for performance in [0, 1], as the source assumes.
    """
    return _changes_after_own_block(performance, trained)


@defined(
    "diaz-rodriguez2018/bwt+",
    "max(BWT, 0)",
    DIAZ,
    aggregate=lambda changes: changes.mean().clamp(min=0),
    bounds=of_gains,
)
def positive_backward_transfer(performance: Tensor, trained: Trained | None = None) -> Tensor:
    """BWT+ = max(BWT, 0) with BWT of `backward_transfer_over_time`."""
    return _changes_after_own_block(performance, trained)


@defined("diaz-rodriguez2018/fwt", "2/(T(T-1)) sum_{i<j} R[i,j]", DIAZ, bounds=of_performance)
def zero_shot_performance(performance: Tensor, trained: Trained | None = None) -> Tensor:
    """FWT: mean performance on tasks that are yet to be trained, after each block but row 0.

    Unlike `forward_transfer` nothing is subtracted. Undefined as `backward_transfer`.
    """
    _several_in_order(performance, trained)
    return _pairs(performance, torch.lt)


@defined(
    "powers2022/isolated-forgetting",
    "mean over (i, j), j after i's first block and not training i, of (R[j-1,i] - R[j,i]) / scale[i]",
    CORA,
    missing="an evaluation is missing or a scale is 0",
    bounds=of_scaled_changes,
)
def isolated_forgetting(performance: Tensor, trained: Trained | None = None, scale: Tensor | None = None) -> Tensor:
    """F: what one block of another task takes from a task that was trained before; positive when it is forgotten.

    The source first smooths curves over 20 evaluations; its tables show the value times 10. Blocks of other tasks after
    a task's first training count. The source's code counts only the first cycle of tasks, or of more cycles a task's
    own later trainings, too. Undefined where a block trains several tasks, and for a single task.

    Args:
        scale: what each task's changes are divided by; default: max |R[i, task]| of this matrix. The source takes it
            over all seeds of a model, so that models are not comparable: give the known optimum.
    """
    return _changes_by_others(performance, trained, scale, before=False) * -1


@defined(
    "powers2022/zero-shot-transfer",
    "mean over (i, j), j before i's first block, of (R[j,i] - R[j-1,i]) / scale[i]",
    CORA,
    missing="an evaluation is missing or a scale is 0",
    bounds=of_scaled_changes,
)
def zero_shot_transfer(performance: Tensor, trained: Trained | None = None, scale: Tensor | None = None) -> Tensor:
    """Z: what one block of another task gives a task that was not yet trained.

    As `isolated_forgetting`; also undefined without the evaluation before any training.
    """
    _has_initial_evaluation(performance)
    return _changes_by_others(performance, trained, scale, before=True)


def _changes_after_own_block(performance: Tensor, trained: Trained | None) -> Tensor:
    _several_in_order(performance, trained)
    own = performance[1:].diagonal()
    return _pairs(torch.cat([performance[:1], performance[1:] - own]), torch.gt)


def _pairs(matrix: Tensor, chosen: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """Entries [block, task] of the rows 1.. with ``chosen(block, task)``, row by row."""
    count = torch.arange(matrix.shape[1], device="cpu")
    return matrix[1 : len(count) + 1][chosen(count.unsqueeze(1), count)]


def _changes_by_others(performance: Tensor, trained: Trained | None, scale: Tensor | None, before: bool) -> Tensor:
    """(R[j, i] - R[j-1, i]) / scale[i] for blocks j before, or after, the first one that trains i."""
    tasks = performance.shape[1]
    blocks = _blocks(performance, trained)
    if any(len(block) != 1 for block in blocks):
        raise Undefined("the definition needs blocks that train one task each")
    alone = [block[0] for block in blocks]
    if tasks == 1:
        raise Undefined(ONE_TASK)
    scale = performance.nan_to_num(0).abs().amax(dim=0) if scale is None else scale
    scale = torch.as_tensor(scale, dtype=performance.dtype, device=performance.device)
    changes = ratio(performance.diff(dim=0), scale.expand(performance.shape[0] - 1, tasks))
    first_blocks = {task: block for block, task in reversed([*enumerate(alone)])}
    block = torch.arange(len(alone), device="cpu")
    first = block.new_tensor([first_blocks.get(task, len(alone)) for task in range(tasks)]).unsqueeze(1)
    others = block.new_tensor(alone) != torch.arange(tasks, device="cpu").unsqueeze(1)
    chosen = others & ((block < first) == before)
    return changes.T[chosen]


def _several_in_order(performance: Tensor, trained: Trained | None) -> None:
    _in_order(performance, trained)
    if performance.shape[1] == 1:
        raise Undefined(ONE_TASK)


def _in_order(performance: Tensor, trained: Trained | None) -> None:
    if _blocks(performance, trained) != [[task] for task in range(performance.shape[1])]:
        raise Undefined(OUT_OF_ORDER)


def _blocks(performance: Tensor, trained: Trained | None) -> list[list[int]]:
    """The tasks of each block; without ``trained`` a block per task.

    Raises:
        ValueError: if the matrix has not one row more than blocks.
    """
    blocks = performance.shape[0] - 1
    tasks = performance.shape[1]
    if trained is None and blocks != tasks:
        got = f"got {blocks} blocks and {tasks} tasks"
        raise ValueError(f"without trained, the definition needs one block per task, {got}")
    if trained is None:
        return [[task] for task in range(tasks)]
    if len(trained) != blocks:
        raise ValueError(f"performance needs {len(trained) + 1} rows for {len(trained)} blocks, got {blocks + 1}")
    return [list(block) for block in trained]


def _has_initial_evaluation(performance: Tensor) -> None:
    if performance[0].isnan().any():
        raise Undefined("the definition needs the evaluation before any training (row 0)")
