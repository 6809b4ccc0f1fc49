"""Curricula of environments of Gymnasium: FrozenLake with a known optimum, CartPole, and MiniGrid."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import gymnasium
from gymnasium.envs.classic_control.cartpole import CartPoleEnv

from ctgraph_rl.checks import by_name, require
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.kinds.gym_task import GymTask
from ctgraph_rl.tasks.protocol import Block, Evaluation

GYMNASIUM = "ctgraph_rl, after Towers et al. 2024, arXiv 2407.17032"
MINIGRID = "ctgraph_rl, after Chevalier-Boisvert et al. 2023, arXiv 2306.13831"

EVALUATION = Evaluation(num_episodes=20)

MAPS = {
    "right": ("SFFF", "FHFH", "FFFG", "HFFF"),
    "below": ("SFFF", "FHFF", "FFFH", "HGFF"),
}
"""4 x 4 fields of start, frozen, hole and goal; the goals are in two places."""

LENGTHS = (0.25, 0.5, 1.0)
"""Half-lengths of poles; Gymnasium's is 0.5."""

POLE = "CartPoleOfLength-v0"

GRIDS = ("MiniGrid-Empty-5x5-v0", "MiniGrid-FourRooms-v0", "MiniGrid-DoorKey-5x5-v0")


class CartPoleOfLength(CartPoleEnv):
    """Gymnasium's CartPole with a pole of another length.

    Args:
        half_length: half the length of the pole, in metres, > 0.
        settings: as Gymnasium's.
    """

    def __init__(self, half_length: float = 0.5, **settings: Any) -> None:
        super().__init__(**settings)
        self.length = half_length
        self.polemass_length = self.masspole * self.length


gymnasium.register(POLE, entry_point=CartPoleOfLength, max_episode_steps=200)


def _in_blocks(name: str, source: str, tasks: list[GymTask], num_frames: int) -> Curriculum:
    blocks = tuple(Block((task,), num_frames) for task in tasks)
    return Curriculum(name, 1, source, blocks, EVALUATION)


def frozen_lake_4maps(num_frames: int = 20_480) -> Curriculum:
    """Gymnasium's FrozenLake: two maps, each first without and then with slippery ice; the optimum is known.

    Args:
        num_frames: frames per block.
    """
    tasks = [
        GymTask(
            "FrozenLake-v1",
            {"desc": list(rows), "is_slippery": slippery},
            label=f"{place}-{'slippery' if slippery else 'firm'}",
        )
        for place, rows in MAPS.items()
        for slippery in (False, True)
    ]
    return _in_blocks("frozen_lake_4maps", GYMNASIUM, tasks, num_frames)


def cartpole_3lengths(num_frames: int = 51_200) -> Curriculum:
    """Gymnasium's CartPole with poles of three lengths; an episode ends after 200 steps at the latest.

    Args:
        num_frames: frames per block.
    """
    tasks = [
        GymTask(f"curricula.gym:{POLE}", {"half_length": length}, label=f"length{length:g}", return_range=(1.0, 200.0))
        for length in LENGTHS
    ]
    return _in_blocks("cartpole_3lengths", GYMNASIUM, tasks, num_frames)


def minigrid_3tasks(num_frames: int = 102_400) -> Curriculum:
    """Three tasks of MiniGrid from its images of 7 x 7 fields; needs the extra ``minigrid``.

    Args:
        num_frames: frames per block.

    Raises:
        ValueError: if MiniGrid is not installed.
    """
    there = find_spec("minigrid") is not None
    require((there, "minigrid_3tasks needs MiniGrid: install it by pip install 'ctgraph_rl[minigrid]'"))
    image = ("minigrid.wrappers:ImgObsWrapper",)
    tasks = [GymTask(f"minigrid:{name}", wrappers=image, max_episode_steps=100, label=name) for name in GRIDS]
    return _in_blocks("minigrid_3tasks", MINIGRID, tasks, num_frames)


NEEDS = {"minigrid_3tasks": "minigrid"}

NAMED = by_name(frozen_lake_4maps, cartpole_3lengths, minigrid_3tasks)
