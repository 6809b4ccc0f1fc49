"""Environment files as the labs have them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any


def environment(
    depth: int,
    wait_ids: Sequence[int],
    decision_ids: Sequence[int],
    end_ids: Sequence[int],
    image_seed: int = 1,
    fail_reward: float = 0.0,
    unique: tuple[bool, bool] = (True, True),
    one_hot: bool = False,
) -> dict[str, Any]:
    """A file as the labs have them: b=2, p=0, one goal, reward 1, no noise, consecutive ids.

    ``unique``: decision states, and wait states, have their own images.
    """
    return {
        "graph_shape": {"d": depth, "b": 2, "p": 0.0},
        "reward": {
            "high_r": 1.0,
            "fail_r": fail_reward,
            "std_r": 0.0,
            "min_static_reward_episodes": 0,
            "max_static_reward_episodes": 0,
            "reward_distribution": "needle_in_haystack",
        },
        "observations": {
            "MDP_D": unique[0],
            "MDP_W": unique[1],
            "W_IDs": list(wait_ids),
            "D_IDs": list(decision_ids),
            "graph_ends": list(end_ids),
        },
        "image_dataset": {
            "seed": image_seed,
            "1D": one_hot,
            "nr_of_images": end_ids[1] + 1,
            "noise_on_read": 0,
            "rotation_on_read": 1,
        },
    }
