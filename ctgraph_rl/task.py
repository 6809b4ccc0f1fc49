"""Task: the paper's <b, d, O, X, p, g> and the goal."""

from __future__ import annotations

from dataclasses import dataclass, field

from torch import Tensor

from ctgraph_rl import values
from ctgraph_rl.checks import as_tuple, is_int, is_real, require
from ctgraph_rl.graph import CTGraph
from ctgraph_rl.observations import ImageSet, Observations, PaperImages
from ctgraph_rl.rewards import Needle, RewardFn

LARGEST_REWARD = 3.4e38
"""Rewards are float32."""


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
            *(_reward_rule(name, getattr(self, name)) for name in ("goal_reward", "fail_reward")),
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

    def optimal_value(self, gamma: float) -> float:
        """The best expected discounted return from the home state; see `values.optimal_value`."""
        return values.optimal_value(self, gamma)

    def policy_value(self, policy: Tensor, gamma: float = 1.0) -> float:
        """The expected discounted return of action probabilities per observation id; see `values.policy_value`."""
        return values.policy_value(self, policy, gamma)

    def success_prob(self, policy: Tensor) -> float:
        """The probability that such a policy reaches the goal; see `values.success_prob`."""
        return values.success_prob(self, policy)

    def memoryless_ceiling(self, deterministic: bool = False) -> float:
        """The best mean return of a policy that remembers nothing; see `values.memoryless_ceiling`."""
        return values.memoryless_ceiling(self, deterministic)

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


def _reward_rule(name: str, value: object) -> tuple[bool, str]:
    holds = is_real(value, -LARGEST_REWARD, LARGEST_REWARD)
    return holds, f"{name} must be a finite number, got {value!r}; rewards are float32"
