"""What the authors' implementation left: a configuration file of each dialect, and recorded traces."""

import copy
import json

from helpers.paths import DATA

TRACES = json.loads((DATA / "reference_traces.json").read_text(encoding="utf-8"))

MOHQA_2019 = {
    "general_seed": 2,
    "graph_shape": {"depth": 2, "branching_factor": 2, "delay_prob": 0.9},
    "reward": {
        "high_reward_value": 1.0,
        "crash_reward_value": 0.0,
        "stochastic_sampling": False,
        "reward_std": 0.1,
        "min_static_reward_episodes": 30,
        "max_static_reward_episodes": 70,
        "reward_distribution": "needle_in_haystack",
    },
    "observations": {
        "MDP_decisions": True,
        "MDP_delays": True,
        "delay_states": [3, 67],
        "decision_points": [68, 75],
        "graph_ends": [76, 80],
    },
    "image_dataset": {
        "seed": 1,
        "1D": False,
        "nr_of_images": 81,
        "noise_on_images_on_read": 0,
        "small_rotation_on_read": 1,
    },
}

L2D2C_2021 = {
    "general_seed": 3,
    "graph_shape": {"depth": 2, "branching_factor": 2, "wait_prob": 0.5},
    "reward": {
        "high_reward_value": 1.0,
        "crash_reward_value": 0.0,
        "stochastic_sampling": False,
        "reward_std": 0.1,
        "min_static_reward_episodes": 5000,
        "max_static_reward_episodes": 5001,
        "reward_distribution": "needle_in_haystack",
    },
    "observations": {
        "MDP_decision_s": True,
        "MDP_wait_s": True,
        "wait_states": [2, 8],
        "decision_states": [9, 11],
        "graph_ends": [12, 15],
    },
    "image_dataset": {
        "seed": 3,
        "1D": False,
        "nr_of_images": 16,
        "noise_on_images_on_read": 0,
        "small_rotation_on_read": 1,
    },
}

SHIPPED_2023 = {
    "general_seed": 3,
    "graph_shape": {"d": 2, "b": 2, "p": 0.0},
    "reward": {
        "high_r": 1.0,
        "fail_r": 0.0,
        "std_r": 0.0,
        "min_static_reward_episodes": -1,
        "max_static_reward_episodes": -1,
        "reward_distribution": "needle_in_haystack",
    },
    "observations": {"MDP_D": False, "MDP_W": False, "W_IDs": [2, 2], "D_IDs": [3, 3], "graph_ends": [4, 4]},
    "image_dataset": {"seed": 2, "1D": False, "nr_of_images": 40, "noise_on_read": 0.05, "rotation_on_read": 10},
}

FILES = {"2019": MOHQA_2019, "2021": L2D2C_2021, "2023": SHIPPED_2023}

DELETED = object()


def changed(content, **changes):
    """A copy of a file with values of ``section__key`` replaced, added or deleted."""
    content = copy.deepcopy(content)
    for name, value in changes.items():
        section, key = name.split("__")
        if value is DELETED:
            del content[section][key]
        else:
            content[section][key] = value
    return content


def one_hot_file(**changes):
    return changed(SHIPPED_2023, image_dataset__1D=True, image_dataset__rotation_on_read=1, **changes)
