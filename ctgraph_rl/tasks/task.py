"""Task: the paper's <b, d, O, X, p, g> and the goal."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from typing import Any, ClassVar, Self, TypeGuard

from torch import Tensor

from ctgraph_rl.checks import (
    Rule,
    are_ints,
    as_path,
    as_tuple,
    is_int,
    is_real,
    make_fields_plain,
    one_of,
    require,
    takes_numbers,
    true_or_false,
)
from ctgraph_rl.core.goal import Goal, read_goal, write_goal
from ctgraph_rl.core.graph import CTGraph
from ctgraph_rl.core.rewards import Needle, RewardFn
from ctgraph_rl.tasks import reference, values
from ctgraph_rl.tasks.images import ImageSet, has_cue_element
from ctgraph_rl.tasks.kinds.task_like import TaskLike, environment
from ctgraph_rl.tasks.observations import Observations

REWARDS = ("goal_reward", "fail_reward", "step_reward", "reward_std")
NOISES = ("additive", "multiplicative")

MAX_EPISODES = 2**31
"""Episodes draw 32-bit words."""

SMALLEST_CUED_REWARD = 1e-30
LARGEST_REWARD = 1e30
"""Keeps float32 rewards, their sums and noise finite."""


@dataclass(frozen=True)
class Task:
    """One CT-graph problem. Frozen, validated, equal and hashable by value.

    ``dataclasses.replace(task, goal="2.1")`` gives a variation.

    Args:
        graph: shape of the tree, <b, d, p>.
        goal: branches to the goal, d integers in 1..b, as ``"1.2"`` or (1, 2), kept as a tuple; the decisions to take,
            but for ``swapped_branches``.
        observations: X.
        images: O.
        reward_fn: the share of ``goal_reward`` that each end state pays, g.
        goal_reward: reward at the goal, high_r of the paper.
        fail_reward: reward on entering the fail state, fail_r.
        step_reward: reward of every step, in addition.
        reward_std: standard deviation of end states' rewards, std_r.
        reward_noise: ``additive``, N(c, reward_std) as in the paper, or ``multiplicative``, c (1 + N(0, reward_std)) as
            in the authors' implementation.
        goal_change: (first, last): each row's goal lasts for a number of episodes drawn from first..last; the next is
            drawn from all end states. None: forever.
        extra_end_step: as in the authors' implementation, an end state takes one more action, and the episode's last
            observation is of the home state. The reward still comes on entering the end state.
        legacy_goal_change: as there, the first goal lasts one episode less than drawn.
        swapped_branches: (path, (first, second)): at the decision state behind ``path`` the decisions ``first`` <
            ``second`` lead to each other's branch. States keep places, images and rewards, so tasks differ in one
            transition.

    Raises:
        ValueError: names all fields that break a rule.

    Example:
        >>> from dataclasses import replace
        >>> from ctgraph_rl import PaperImages
        >>> x = Observations(wait_ids=(2, 2), decision_ids=(3, 3), end_ids=(4, 4))
        >>> task = Task(CTGraph(2, 2), goal="1.2", observations=x, images=PaperImages(5))
        >>> task.optimal_value(1.0)
        1.0
        >>> replace(task, goal="2.2").goal
        (2, 2)
    """

    graph: CTGraph
    goal: tuple[int, ...]
    observations: Observations
    images: ImageSet
    reward_fn: RewardFn = field(default_factory=Needle)
    goal_reward: float = 1.0
    fail_reward: float = 0.0
    step_reward: float = 0.0
    reward_std: float = 0.0
    reward_noise: str = "additive"
    goal_change: tuple[int, int] | None = None
    extra_end_step: bool = False
    legacy_goal_change: bool = False
    swapped_branches: tuple[tuple[int, ...], tuple[int, int]] | None = field(default=None, metadata={"added": True})

    resumes: ClassVar[bool] = True

    def __repr__(self) -> str:
        """Return graph, goal and images, in one line."""
        graph = self.graph
        shape = f"b={graph.branching_factor}, d={graph.depth}, p={graph.wait_prob:g}"
        return f"<Task {shape}, goal {write_goal(self.goal):.40}, {self.images!r:.80}>"

    def __post_init__(self) -> None:
        make_fields_plain(self)
        images = self.images
        pays = callable(self.reward_fn) and not isinstance(self.reward_fn, type)
        has_images = hasattr(images, "bank") and not isinstance(images, type)
        x = self.observations
        require(
            (isinstance(self.graph, CTGraph), f"graph must be a CTGraph, got {self.graph!r}"),
            (isinstance(x, Observations), f"observations must be Observations, got {x!r}"),
            (has_images, f"images must be an image set such as PaperImages(5), got {images!r}"),
            (pays, f"reward_fn must be a reward such as Needle(), got {self.reward_fn!r}"),
        )
        given = self.goal
        object.__setattr__(self, "goal", read_goal(given))
        if isinstance(self.swapped_branches, tuple):
            object.__setattr__(self, "swapped_branches", tuple(map(as_tuple, self.swapped_branches)))
        one_hot = len(images.shape) == 1
        varies = x.read_noise or x.read_rotation or (x.reward_cue and not has_cue_element(images))
        room = images.num_images
        last_id = x.last_id
        too_few = f"num_images={room} is too few for id {last_id} in observations: needs at least {last_id + 1}"
        require(
            self._goal_rule(given),
            self._swap_rule(),
            *x.rules(self.graph),
            (last_id < room, too_few),
            (
                not (one_hot and varies),
                "read_noise, read_rotation and reward_cue need images, not one-hot observations",
            ),
            *self._reward_rules(),
        )
        for name in REWARDS:
            object.__setattr__(self, name, float(getattr(self, name)))

    @classmethod
    def from_json(cls, path_or_dict: str | PathLike[str] | Mapping[str, Any], goal: Goal | None = None) -> Self:
        """The task of a configuration file: of the paper's Table 3 (`ctgraph_rl.tasks.paper_json`), or of the authors'.

        A file with a section ``image_dataset`` is of the authors' implementation, with keys of 2019 (``delay_prob``),
        2021 (``wait_prob``) or 2023 (``p``), and the task behaves as there. If it has ``stochastic_sampling``, the
        standard deviation of rewards counts only where that is true. ``general_seed`` or ``Seed`` is not of the task:
        give it to ``CTGraphEnv(seed=...)``, whose random numbers differ.

        Args:
            path_or_dict: the file, or its content.
            goal: d decisions in 1..b, such as ``"1.2"``; the file has none. A path for
                ``set_high_reward_path`` counts from 0: add 1.

        Raises:
            ValueError: for a missing goal, an unreadable file, keys that are missing, unknown or of several dialects,
                and values out of range, also those that the authors' implementation silently repairs.
        """
        return cls(**reference.read_task(path_or_dict, goal))

    @takes_numbers
    def to_json(self, path: str | PathLike[str] | None = None, general_seed: int = 1) -> dict[str, Any]:
        """This task as a file of the authors' implementation, with the keys of 2023; written to ``path`` if given.

        The file has no goal: call ``set_high_reward_path`` there with the decisions less 1, [1, 0] for the goal 2.1.
        ``Task.from_json(task.to_json(), goal=task.goal)`` equals every task that `from_json` made.

        Args:
            path: must not exist.
            general_seed: seed of the authors' environment, in [0, 2**32).

        Raises:
            ValueError: lists everything of the task that the file cannot express.
        """
        return reference.write_task(self, None if path is None else as_path("path", path), general_seed)

    @classmethod
    def make_env(cls, tasks: Sequence[Task], seed: int = 0, **settings: Any) -> Any:
        """Return a `ctgraph_rl.CTGraphEnv` with a row per task."""
        return environment(Task)(tasks, seed, **settings)

    def _reward_rules(self) -> list[Rule]:
        cue = self.observations.reward_cue
        change = self.goal_change
        pair = isinstance(change, tuple) and len(change) == 2 and is_int(change[0], 1, MAX_EPISODES)
        lasts = change is None or (pair and is_int(change[1], change[0], MAX_EPISODES))
        cues = not cue or is_real(self.goal_reward, SMALLEST_CUED_REWARD)
        rewards = []
        for name in REWARDS:
            value = getattr(self, name)
            holds = is_real(value, -LARGEST_REWARD, LARGEST_REWARD)
            rewards.append((holds, f"{name} must be a finite number, got {value!r}; at most 1e30 in size"))
        multiplies = isinstance(self.reward_noise, str) and self.reward_noise == "multiplicative"
        products = multiplies and is_real(self.goal_reward) and is_real(self.reward_std)
        finite = not products or abs(self.goal_reward * self.reward_std) <= LARGEST_REWARD
        return [
            *rewards,
            *true_or_false(extra_end_step=self.extra_end_step, legacy_goal_change=self.legacy_goal_change),
            (is_real(self.reward_std, 0), f"reward_std must be >= 0, got {self.reward_std!r}"),
            (finite, f"goal_reward times reward_std must be at most {LARGEST_REWARD:g} in size"),
            *one_of(NOISES, reward_noise=self.reward_noise),
            (lasts, f"goal_change must be (first, last) with 1 <= first <= last <= 2**31, got {change!r}"),
            (cues, f"reward_cue needs goal_reward > 0, got {self.goal_reward!r}"),
        ]

    def _goal_rule(self, given: object) -> Rule:
        b = self.graph.branching_factor
        d = self.graph.depth
        goal = self.goal
        may_be_another = isinstance(given, float) and b > 9
        holds = isinstance(goal, tuple) and len(goal) == d and are_ints(goal, 1, b) and not may_be_another
        got = given if isinstance(given, str) and given and given.isprintable() else repr(given)
        message = f"goal must be {d} decisions in 1..{b}, such as {write_goal((1,) * d)}, got {got}"
        if may_be_another:
            message += """, a number, and as numbers 1.1 and 1.10 are equal: put it in quotes, in a shell '"1.10"'"""
        elif not holds and isinstance(goal, tuple) and 0 in goal and are_ints(goal, 0, b - 1):
            decisions = write_goal(branch + 1 for branch in goal)
            message += f"; a path of the authors' implementation counts from 0: use {decisions}"
        return holds, message

    def _swap_rule(self) -> Rule:
        b = self.graph.branching_factor
        d = self.graph.depth
        swap = self.swapped_branches
        holds = False
        if isinstance(swap, tuple) and len(swap) == 2 and isinstance(swap[0], tuple) and isinstance(swap[1], tuple):
            path, pair = swap
            holds = are_ints((*path, *pair), 1, b) and len(path) < d and len(pair) == 2 and pair[0] < pair[1]
        rule = f"(path, (first, second)): fewer than {d} branches, and two of that decision state with first < second"
        return swap is None or holds, f"swapped_branches must be {rule}, in 1..{b}, such as ((), (1, 2)), got {swap!r}"

    @property
    def swapped_node(self) -> int | None:
        """Heap index of the decision state with swapped branches."""
        return None if self.swapped_branches is None else self.graph.node_at(self.swapped_branches[0])

    def decision_to(self, node: int) -> int:
        """Return the decision, in 1..b, from the parent of ``node`` > 0."""
        branch = self.graph.decision(node)
        swap = self.swapped_branches
        if swap is None or self.graph.parent(node) != self.swapped_node or branch not in swap[1]:
            return branch
        return sum(swap[1]) - branch

    @property
    def goal_decisions(self) -> tuple[int, ...]:
        """The d decisions to the goal: its branches, unless swapped."""
        nodes = self.graph.nodes_to(self.graph.node_at(self.goal))
        return tuple(map(self.decision_to, nodes[1:]))

    @property
    def goal_leaf(self) -> int:
        """The goal's end state: its base-b digits are the branches, the first one leading."""
        return self.graph.leaf_of(self.goal)

    @takes_numbers
    def optimal_value(self, gamma: float) -> float:
        """The best expected discounted return; gamma in [0, 1]."""
        return values.optimal_value(self, gamma)

    @takes_numbers
    def policy_value(self, policy: Tensor, gamma: float = 1.0) -> float:
        """The expected discounted return of action probabilities per observation id, float [num_images, A]."""
        return values.policy_value(self, policy, gamma)

    def memoryless_ceiling(self, deterministic: bool = False) -> float:
        """The best mean return without memory, by `values.memoryless_ceiling`."""
        return values.memoryless_ceiling(self, deterministic)

    @property
    def return_bounds(self) -> tuple[float, float]:
        """Lowest and highest return of an episode, without noise; infinite if unbounded."""
        return values.return_bounds(self)

    @property
    def return_noise(self) -> float:
        """Largest standard deviation of a return by the noise of rewards."""
        return values.return_noise(self)

    @property
    def is_deterministic(self) -> bool:
        """Whether actions determine an episode."""
        x = self.observations
        ranges = ((x.wait_ids, x.unique_waits), (x.decision_ids, x.unique_decisions), (x.home_ids, False))
        drawn = any(first != last and not unique for (first, last), unique in ranges)
        noise = x.read_noise or x.read_rotation or self.reward_std or self.goal_change is not None
        return self.graph.wait_prob == 0 and not drawn and not noise

    @property
    def observation_shape(self) -> tuple[int, ...]:
        """Of one row; a batch pads one-hot vectors to its longest."""
        return tuple(self.images.shape)

    @property
    def num_actions(self) -> int:
        """b + 1: waiting, and the decisions."""
        return self.graph.branching_factor + 1

    @property
    def image_seed(self) -> int | None:
        """The seed of a generated image set."""
        return getattr(self.images, "seed", None)

    @property
    def label_parts(self) -> dict[str, str]:
        """Parts of the label in tables: goal, depth, branching factor, wait probability, images and swap.

        A swap is ``swap1.2at2`` for the branches 1 and 2 of the decision state behind branch 2.
        """
        images = type(self.images).__name__.lower() if self.image_seed is None else f"img{self.image_seed}"
        swap = "noswap"
        if self.swapped_branches is not None:
            path, pair = map(write_goal, self.swapped_branches)
            swap = f"swap{pair}" + (f"at{path}" if path else "")
        return {
            "goal": f"goal{write_goal(self.goal)}",
            "depth": f"d{self.graph.depth}",
            "branching_factor": f"b{self.graph.branching_factor}",
            "wait_prob": f"p{self.graph.wait_prob:g}",
            "images": images,
            "swapped_branches": swap,
        }


def are_graphs(tasks: Iterable[TaskLike]) -> TypeGuard[Sequence[Task]]:
    """Return whether all tasks are CT-graphs."""
    return all(isinstance(task, Task) for task in tasks)


def ct_graphs(tasks: Sequence[TaskLike], what: str) -> Sequence[Task]:
    """Return tasks that are all CT-graphs; ``what`` names what needs them.

    Raises:
        ValueError: for another kind.
    """
    require((are_graphs(tasks), f"{what} needs CT-graphs, not {type(tasks[0]).__name__}; take another curriculum"))
    return tasks  # type: ignore[return-value]
