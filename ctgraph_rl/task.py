"""Task: the paper's <b, d, O, X, p, g> and the goal."""

from __future__ import annotations

from dataclasses import dataclass, field

from ctgraph_rl.checks import as_tuple, is_int, is_real, require
from ctgraph_rl.graph import CTGraph
from ctgraph_rl.observations import ImageSet, Observations, PaperImages
from ctgraph_rl.rewards import Needle, RewardFn


@dataclass(frozen=True)
class Task:
    """One CT-graph problem. Frozen, validated, equal and hashable by value.

    ``dataclasses.replace(task, goal=(2, 1))`` gives a variation.

    Args:
        graph: shape of the tree, <b, d, p>.
        goal: the decisions that lead to the goal, d integers in 1..b.
        observations: which id each state shows, X.
        images: what is behind the ids, O.
        reward_fn: the share of ``goal_reward`` that each end state pays, g.
        goal_reward: reward at the goal, high_r of the paper.
        fail_reward: reward on entering the fail state, fail_r.

    Raises:
        ValueError: names every field that breaks a rule.
    """

    graph: CTGraph
    goal: tuple[int, ...]
    observations: Observations
    images: ImageSet
    reward_fn: RewardFn = field(default_factory=Needle)
    goal_reward: float = 1.0
    fail_reward: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "goal", as_tuple(self.goal))
        one_hot = len(self.images.shape) == 1
        varies = self.observations.read_noise or self.observations.read_rotation
        room, last_id = self.images.num_images, self.observations.last_id
        too_few = f"num_images={room} is too few for id {last_id} in observations: needs at least {last_id + 1}"
        require(
            self._goal_rule(),
            *self.observations.rules(self.graph),
            (last_id < room, too_few),
            (not (one_hot and varies), "read_noise and read_rotation must be 0 with one-hot observations"),
            (is_real(self.goal_reward), f"goal_reward must be a finite number, got {self.goal_reward!r}"),
            (is_real(self.fail_reward), f"fail_reward must be a finite number, got {self.fail_reward!r}"),
        )
        object.__setattr__(self, "goal_reward", float(self.goal_reward))
        object.__setattr__(self, "fail_reward", float(self.fail_reward))

    def _goal_rule(self) -> tuple[bool, str]:
        b, d = self.graph.branching_factor, self.graph.depth
        goal = self.goal
        holds = isinstance(goal, tuple) and len(goal) == d and all(is_int(decision, 1, b) for decision in goal)
        return holds, f"goal must be {d} decisions in 1..{b}, such as {(1,) * d}, got {goal!r}"

    @property
    def goal_leaf(self) -> int:
        """Number of the end state with the goal: its base-b digits are the decisions, the first one leading."""
        leaf = 0
        for decision in self.goal:
            leaf = leaf * self.graph.branching_factor + decision - 1
        return leaf

    @property
    def image_seed(self) -> int | None:
        """The image seed of a `PaperImages` set, None for other sets."""
        return self.images.seed if isinstance(self.images, PaperImages) else None

    @property
    def label_parts(self) -> dict[str, str]:
        """What tells tasks apart in tables: goal, depth, branching factor, wait probability and images."""
        images = type(self.images).__name__.lower() if self.image_seed is None else f"img{self.image_seed}"
        return {
            "goal": f"goal{'.'.join(map(str, self.goal))}",
            "depth": f"d{self.graph.depth}",
            "branching_factor": f"b{self.graph.branching_factor}",
            "wait_prob": f"p{self.graph.wait_prob:g}",
            "images": images,
        }
