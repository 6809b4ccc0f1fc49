"""Ways to put tasks in order, and `sequence`, which makes a `Curriculum` of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import chain, zip_longest

from ctgraph_rl.checks import as_tuple, is_int, require, require_all, takes_numbers
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.protocol import Block, Evaluation, Protocol
from ctgraph_rl.tasks.switch import Switch
from ctgraph_rl.tasks.task import Task
from curricula.draws import shuffled

Tasks = tuple[Task, ...]
OneOrMore = Task | Iterable[Task]
Axis = Callable[[Tasks], Tasks]

MOST_TASKS = 100_000
"""More tasks than this are refused before they are built."""


def as_tasks(tasks: OneOrMore) -> Tasks:
    """A task or several as a tuple.

    Raises:
        ValueError: for anything else, and for no task.
    """
    return (tasks,) if isinstance(tasks, Task) else require_all(Task, "tasks", tasks)


def each(tasks: OneOrMore, vary: Callable[[Task], Iterable[Task]]) -> Tasks:
    """Return the variations of each task, those of the first task first."""
    return tuple(chain.from_iterable(map(vary, as_tasks(tasks))))


def product(tasks: OneOrMore, *axes: Axis) -> Tasks:
    """Axes applied one after the other: the last one varies fastest."""
    varied = as_tasks(tasks)
    for axis in axes:
        varied = axis(varied)
    return varied


def concatenate(*sequences: OneOrMore) -> Tasks:
    """One sequence after the other."""
    return tuple(chain.from_iterable(map(as_tasks, sequences)))


def interleave(*sequences: OneOrMore) -> Tasks:
    """The first task of each sequence, then the second of each; a sequence that has ended is left out.

    Example:
        >>> from ctgraph_rl.tasks.configurations import ct_su_b1
        >>> a, b, c = (ct_su_b1(goal=goal) for goal in ((1, 1), (1, 2), (2, 1)))
        >>> [task.goal for task in interleave((a, b), c)]
        [(1, 1), (2, 1), (1, 2)]
    """
    rounds = zip_longest(*map(as_tasks, sequences))
    return tuple(filter(None, chain.from_iterable(rounds)))


@takes_numbers
def repeat(tasks: OneOrMore, times: int) -> Tasks:
    """Each task several times in a row: A A B B."""
    _check_times(times)
    return each(tasks, lambda task: [task] * times)


@takes_numbers
def cycle(tasks: OneOrMore, times: int) -> Tasks:
    """The whole sequence several times: A B A B."""
    _check_times(times)
    return as_tasks(tasks) * times


def _check_times(times: object) -> None:
    require((is_int(times, 1, MOST_TASKS), f"times must be an integer >= 1, got {times!r}"))


@takes_numbers
def shuffle(tasks: OneOrMore, seed: int) -> Tasks:
    """The tasks in an order drawn uniformly from a seed, an integer >= 0."""
    return tuple(shuffled(as_tasks(tasks), seed))


def reverse(tasks: OneOrMore) -> Tasks:
    """The last task first."""
    return as_tasks(tasks)[::-1]


@takes_numbers
def split(tasks: OneOrMore, num_held_out: int, seed: int) -> tuple[Tasks, Tasks]:
    """Tasks to train and tasks to hold out, drawn without replacement; both keep their order.

    Args:
        tasks: different tasks.
        num_held_out: how many to hold out, fewer than there are.
        seed: an integer >= 0.
    """
    everything = as_tasks(tasks)
    count = len(everything)
    require(
        (is_int(num_held_out, 1, count - 1), f"num_held_out must be in 1..{count - 1}, got {num_held_out!r}"),
        (len(set(everything)) == count, "tasks to split must differ, else a task is both trained and held out"),
    )
    held_out = set(shuffled(range(count), seed)[:num_held_out])
    rest = tuple(task for i, task in enumerate(everything) if i not in held_out)
    return rest, tuple(everything[i] for i in sorted(held_out))


@takes_numbers
def sequence(
    name: str,
    tasks: Iterable[OneOrMore],
    num_frames: int | Sequence[int],
    version: int = 1,
    source: str = "",
    protocol: Protocol | None = None,
    evaluation: Evaluation | None = None,
    switch: Switch | None = None,
) -> Curriculum:
    """A curriculum with a block for each item.

    Args:
        name: name that a paper cites.
        tasks: a task, or several that share a block, for each block.
        num_frames: frames of every block, or a list with those of each.
        version: raised when the content changes.
        source: where the sequence comes from.
        protocol: what the learner knows of tasks; None: no task ids, announced boundaries.
        evaluation: how performance is measured; None: the defaults of `Evaluation`.
        switch: how rows change between the tasks of a block.
    """
    items = [tasks] if isinstance(tasks, Task) else list(tasks)
    frames = as_tuple(num_frames)
    budgets = frames if isinstance(frames, tuple) else (num_frames,) * len(items)
    require((len(budgets) == len(items), f"num_frames must be one for each of {len(items)} blocks, got {len(budgets)}"))
    blocks = tuple(Block(as_tasks(item), n, switch) for item, n in zip(items, budgets, strict=True))
    return Curriculum(name, version, source, blocks, evaluation or Evaluation(), protocol=protocol or Protocol())
