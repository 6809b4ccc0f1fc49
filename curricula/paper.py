"""Curricula over the configurations of the CT-graph paper.

Soltoggio et al. 2023 (arXiv 2302.10887), section on lifelong learning.
"""

from __future__ import annotations

from itertools import product

from ctgraph_rl.curriculum import Block, Curriculum
from ctgraph_rl.paper import ct_su_b1

PAPER = "Soltoggio et al. 2023, arXiv 2302.10887"


def su_b1_4tasks(num_frames: int = 204_800, image_seed: int = 1) -> Curriculum:
    """The four goals of CT-SU-B1 one after the other, in lexicographic order: (1,1), (1,2), (2,1), (2,2).

    Args:
        num_frames: frames per task.
        image_seed: seed of the image set that all tasks share.
    """
    goals = product((1, 2), repeat=2)
    blocks = tuple(Block((ct_su_b1(goal, image_seed),), num_frames) for goal in goals)
    return Curriculum("su_b1_4tasks", 1, PAPER, blocks)
