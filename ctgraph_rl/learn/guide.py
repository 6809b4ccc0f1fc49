"""A guide: a navigating policy that acts in an agent's place, less and less, so that first rewards are found."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase

from ctgraph_rl.checks import require
from ctgraph_rl.env import CTGraphEnv
from ctgraph_rl.learn.collect import Policy
from ctgraph_rl.policies import NavigationPolicy

GUIDED_ACTION = "guided_action"
"""Key of the actions that a policy must take where they are not negative, int64 [num_envs]."""


GUIDED = "guided"


def guided_share(frames: int, guide_frames: int) -> float:
    """Return the share of new episodes that are guided: it falls linearly from 1 to 0."""
    return max(0.0, 1 - frames / guide_frames) if guide_frames else 0.0


class Guide:
    """A policy in whose place `NavigationPolicy` acts through a share of the episodes.

    The agent learns from these actions as from its own, as the policy writes all else, such as their probability. Draws
    come from torch's global generator and stop once the share is 0. ``guided``, bool [num_envs], marks rows in such an
    episode.

    Args:
        guide_frames: frames over which the share falls from 1 to 0.
    """

    def __init__(self, policy: Policy, env: CTGraphEnv, guide_frames: int) -> None:
        self.policy = policy
        self.env = env
        self.guide_frames = guide_frames
        self.navigation = NavigationPolicy(env)
        self.frames = 0

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` and the policy's other outputs.

        Raises:
            ValueError: if the policy did not take the given actions.
        """
        share = guided_share(self.frames, self.guide_frames)
        if not share:
            return self.policy(tensordict)
        actions = self.navigation.action(tensordict)
        before = tensordict.get(GUIDED, None)
        guided = torch.rand(actions.shape, device=actions.device, dtype=torch.float32) < share
        if before is not None:
            guided = torch.where(tensordict["is_init"].squeeze(-1), guided, before)
        given = torch.where(guided, actions, -1)
        taken = self.policy(tensordict.set(GUIDED, guided).set(GUIDED_ACTION, given))
        del taken[GUIDED_ACTION]
        obeys = torch.where(given < 0, taken["action"], given).equal(taken["action"])
        name = type(self.policy).__name__
        require((obeys, f"{name} does not take the actions under {GUIDED_ACTION!r}: set protocol.guide_frames=0"))
        return taken
