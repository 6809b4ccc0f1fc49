"""The blocks of a stream: a task each, drawn by seed when it is needed."""

from __future__ import annotations

import random
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import Any

from ctgraph_rl.checks import MOST_STREAMED, are_ints, at_least_one, is_int, is_real, make_fields_plain, one_of, require
from ctgraph_rl.core.goal import write_goal
from ctgraph_rl.tasks.protocol import Block
from ctgraph_rl.tasks.task import Task

ORDERS = ("similar", "dissimilar", "returning", "drifting", "conflicting")

IMAGE_SEEDS = 2**40

KEPT = 256


class Lazy(Sequence[Any]):
    """Items that are made when asked for; slices are tuples."""

    def __init__(self, count: int, make: Callable[[int], Any]) -> None:
        self._count = count
        self._make = make

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, place: Any) -> Any:
        if isinstance(place, slice):
            return tuple(self[i] for i in range(*place.indices(len(self))))
        if not -len(self) <= place < len(self):
            raise IndexError(place)
        return self._make(place % len(self))


class DrawnTasks(Lazy):
    """The tasks of a stream; the last `KEPT` that were asked for are kept.

    Args:
        examples: tasks that have every graph, reward and kind of image.
    """

    def __init__(self, count: int, make: Callable[[int], Task], examples: tuple[Task, ...]) -> None:
        super().__init__(count, self._kept)
        self.examples = examples
        self._draw = make
        self._made: dict[int, Task] = {}

    def _kept(self, place: int) -> Task:
        task = self._made.pop(place, None) or self._draw(place)
        self._made[place] = task
        if len(self._made) > KEPT:
            del self._made[next(iter(self._made))]
        return task

    def index(self, value: Any, start: int = 0, stop: int | None = None) -> int:
        """Return the number of a task, one that is kept first."""
        for place, task in reversed(self._made.items()):
            if task == value:
                return place
        return super().index(value, start, len(self) if stop is None else stop)


@dataclass(frozen=True)
class Life(Sequence[Block]):
    """Blocks of one task each. The first n do not depend on how many follow.

    Orders: ``similar`` tasks share one image set, and neighbours differ otherwise; of ``dissimilar`` ones each has
    another image set; ``returning``: as dissimilar, but ``share`` of the blocks have the task of ``lag`` blocks before;
    ``drifting``: a task has another image set than the one before, or one other decision on the way to its goal;
    ``conflicting``: all on one image set, each goal another one than before at every decision.

    Args:
        choices: the tasks from which all but the image set is drawn.
        image_seeds: the image sets to draw from; none: a new set each time.
        share: of ``returning`` blocks, in (0, 1].
        lag: blocks between a task and its return.
        seed: of the draws, in [0, 2**63); None: ``run_seed``.
        run_seed: of the run; no part of the curriculum's fingerprint.

    Raises:
        ValueError: for values out of range, and an order that the choices do not allow.
    """

    choices: tuple[Task, ...]
    num_tasks: int
    num_frames: int
    order: str = "dissimilar"
    image_seeds: tuple[int, ...] = ()
    share: float = 0.5
    lag: int = 10
    seed: int | None = None
    run_seed: int = field(default=0, compare=False)

    def __post_init__(self) -> None:
        make_fields_plain(self)
        is_share = is_real(self.share, 0, 1) and self.share > 0
        is_seed = self.seed is None or is_int(self.seed, 0, 2**63 - 1)
        are_choices = bool(self.choices) and all(isinstance(task, Task) for task in self.choices)
        images = self.image_seeds
        are_sets = are_ints(images, 0, 2**63 - 1) and len(set(images)) == len(images)
        most = f"num_tasks must be in 1..{MOST_STREAMED:,}, got {self.num_tasks!r}"
        require(
            (are_choices, f"a stream draws from at least one Task, got {self.choices!r:.80}"),
            (is_int(self.num_tasks, 1, MOST_STREAMED), most),
            *at_least_one(num_frames=self.num_frames, lag=self.lag),
            *one_of(ORDERS, order=self.order),
            (are_sets, f"image_seeds must be different integers in [0, 2**63), got {images!r:.80}"),
            (is_share, f"share must be in (0, 1], got {self.share!r}"),
            (is_seed, f"seed must be an integer in [0, 2**63) or null, got {self.seed!r}"),
            (is_int(self.run_seed, 0, 2**63 - 1), f"run_seed must be in [0, 2**63), got {self.run_seed!r}"),
        )
        many_images = len(images) != 1 and all(task.image_seed is not None for task in self.choices)
        several = len(self.choices) > 1
        returns = f"lag={self.lag} must be less than num_tasks={self.num_tasks}, else no task returns"
        one_set = self.order in ("similar", "conflicting")
        drifts = self.order == "drifting" and several
        fix = "needs goals that differ in one decision: give goals=all, or one goal"
        every = "needs goals that differ in every decision: give goals=all, or two goals such as [1.1,2.2]"
        require(
            (one_set or many_images, f"order={self.order} needs several generated image sets"),
            (self.order != "similar" or several, "order=similar needs tasks that differ in more than their images"),
            (self.order != "returning" or self.lag < self.num_tasks, returns),
            (not drifts or all(self.followers), f"order=drifting {fix}"),
            (self.order != "conflicting" or all(self.followers), f"order=conflicting {every}"),
        )

    @cached_property
    def followers(self) -> list[list[int]]:
        """For each choice those with another goal: in one decision, or in all where tasks are conflicting."""
        places = {task: place for place, task in enumerate(self.choices)}
        found = []
        for task in self.choices:
            branches = range(1, task.graph.branching_factor + 1)
            turns = [[branch for branch in branches if branch != own] for own in task.goal]
            goals = [*product(*turns)]
            if self.order == "drifting":
                goals = []
                for level, others in enumerate(turns):
                    goals += [(*task.goal[:level], branch, *task.goal[level + 1 :]) for branch in others]
            changed = [places.get(replace(task, goal=goal)) for goal in goals]
            found.append([place for place in changed if place is not None])
        return found

    @cached_property
    def _draws(self) -> _Draws:
        return _Draws(self)

    @cached_property
    def tasks(self) -> DrawnTasks:
        """The task of each block."""
        return DrawnTasks(self.num_tasks, self._draw_task, self.choices)

    def _draw_task(self, place: int) -> Task:
        choice, image_seed, _ = self._draws.at(place)
        task = self.choices[choice]
        if task.image_seed is None:
            return task
        return replace(task, images=replace(task.images, seed=image_seed))  # type: ignore[type-var]

    def origin(self, place: int) -> int:
        """Return the first block, from 0, that has the task of a block."""
        return self._draws.at(place)[2]

    def choice(self, place: int) -> int:
        """Return the position in ``choices`` of what a block's task is drawn from."""
        return self._draws.at(place)[0]

    def label(self, place: int) -> str:
        """Return a short name of a block's task: its number, from 1, and its goal."""
        return f"{place + 1}:goal{write_goal(self.choices[self.choice(place)].goal)}"

    def __len__(self) -> int:
        return self.num_tasks

    def __getitem__(self, place: Any) -> Any:
        tasks = self.tasks[place]
        if isinstance(place, slice):
            return tuple(Block((task,), self.num_frames) for task in tasks)
        return Block((tasks,), self.num_frames)


class _Draws:
    """The draws up to the last block that was asked for, 16 bytes each."""

    def __init__(self, life: Life) -> None:
        self.life = life
        self._source = random.Random(life.run_seed if life.seed is None else life.seed)
        self._choices = array("I")
        self._images = array("Q")
        self._origins = array("I")

    def at(self, place: int) -> tuple[int, int, int]:
        """Return a block's choice, image seed and first block with its task."""
        while len(self._origins) <= place:
            self._draw()
        return self._choices[place], self._images[place], self._origins[place]

    def _below(self, count: int) -> int:
        return int(self._source.random() * count)

    def _draw(self) -> None:
        life = self.life
        place = len(self._origins)
        origin = place
        if life.order == "returning" and place >= life.lag and self._source.random() < life.share:
            before = place - life.lag
            choice = self._choices[before]
            image = self._images[before]
            origin = self._origins[before]
        elif place == 0 or life.order in ("dissimilar", "returning"):
            choice = self._below(len(life.choices))
            image = self._new_image()
        else:
            choice = self._choices[-1]
            image = self._images[-1]
            if life.order == "similar":
                choice = (choice + 1 + self._below(len(life.choices) - 1)) % len(life.choices)
            else:
                others = life.followers[choice]
                if life.order == "conflicting" or (others and self._below(len(life.choices[choice].goal) + 1)):
                    choice = others[self._below(len(others))]
                else:
                    image = self._new_image()
        self._choices.append(choice)
        self._images.append(image)
        self._origins.append(origin)

    def _new_image(self) -> int:
        known = self.life.image_seeds
        if not known:
            return self._below(IMAGE_SEEDS)
        last = known.index(self._images[-1]) if self._images else self._below(len(known))
        return known[(last + 1 + self._below(max(len(known) - 1, 1))) % len(known)]
