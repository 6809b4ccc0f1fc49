"""Reference policies that know the hidden state: what can be reached, and what random actions reach.

Each is built on the environment that it acts in and writes ``action``: ``env.rollout(100, OptimalPolicy(env))``, or
``evaluate(OptimalPolicy, tasks)``. Draws come from torch's global generator.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from typing_extensions import override

from ctgraph_rl.core.graph import WAIT_ACTION, StateType
from ctgraph_rl.core.tree import branch_of
from ctgraph_rl.env import CTGraphEnv


class RandomPolicy:
    """Every action of a row's graph is equally likely; it reaches the goal with probability P_R."""

    def __init__(self, env: CTGraphEnv) -> None:
        self.env = env

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action``, int64 [N]."""
        return tensordict.set("action", self.action(tensordict))

    def action(self, tensordict: TensorDictBase) -> Tensor:
        """Return the actions of all rows, int64 [N]."""
        return self._random_below(self.env.branching_factor + 1)

    def _random_below(self, high: Tensor) -> Tensor:
        return (torch.rand(high.shape, dtype=torch.float64, device=high.device) * high).long()


class NavigationPolicy(RandomPolicy):
    """Waits where it must and decides at random; it reaches the goal with probability b^-d."""

    @override
    def action(self, tensordict: TensorDictBase) -> Tensor:
        decides = self.env.state_type == StateType.DECISION
        return torch.where(decides, self.decision(tensordict), WAIT_ACTION)

    def decision(self, tensordict: TensorDictBase) -> Tensor:
        """Return decisions, in 1..b, for rows at a decision state."""
        return 1 + self._random_below(self.env.branching_factor)


class OptimalPolicy(NavigationPolicy):
    """Goes straight to the goal: return 1 in 2(d+1) steps at p = 0.

    Example:
        >>> from ctgraph_rl import evaluate
        >>> from ctgraph_rl.tasks.configurations import ct_su_b1
        >>> evaluate(OptimalPolicy, [ct_su_b1()], num_episodes=1)["step_count"].item()
        6
    """

    @override
    def decision(self, tensordict: TensorDictBase) -> Tensor:
        return self._towards(self.env.goal_leaf)

    def _towards(self, leaf: Tensor) -> Tensor:
        """The decision from each row's node to an end state; 1 off the way."""
        b = self.env.branching_factor
        node = self.env.node
        child = self.env.first_leaf + leaf
        decision = torch.ones_like(node)
        swap = self.env.swap
        for _ in range(self.env.max_depth):
            parent = (child - 1) // b
            decision = torch.where(parent == node, branch_of(node, child - b * parent, swap), decision)
            child = parent
        return decision


class SearchPolicy(OptimalPolicy):
    """Tries end states without replacement until it finds the goal, then stays with it until an episode misses it.

    It knows the graph, and only whether its last episode reached the goal. Each row tries the end states in order from
    a random one on, so the first success is uniform on 1..b^d with mean E[kappa] = (b^d + 1) / 2. Episode i after a new
    draw of the goal succeeds with probability min(1, i / b^d). An episode cut before the last wait state is tried
    again.
    """

    def __init__(self, env: CTGraphEnv) -> None:
        super().__init__(env)
        self.target: Tensor | None = None
        self.missed = torch.zeros_like(env.node, dtype=torch.bool)

    @override
    def decision(self, tensordict: TensorDictBase) -> Tensor:
        assert self.target is not None
        return self._towards(self.target)

    @override
    def action(self, tensordict: TensorDictBase) -> Tensor:
        if self.target is None:
            self.target = self._random_below(self.env.num_end_states)
        fails = tensordict.get("is_init").squeeze(-1) & self.missed
        self.target = torch.where(fails, (self.target + 1) % self.env.num_end_states, self.target)
        arrives = (self.env.state_type == StateType.WAIT) & (self.env.node == self.env.first_leaf + self.target)
        misses = arrives & (self.target != self.env.goal_leaf)  # the goal of this episode: the next may have another
        self.missed = misses | (self.missed & (self.env.state_type == StateType.END))  # which may take one more action
        return super().action(tensordict)
