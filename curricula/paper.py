"""The configurations of the CT-graph paper and curricula over them.

Soltoggio et al. 2023 (arXiv 2302.10887), baseline configurations and section on lifelong learning.
"""

from __future__ import annotations

from itertools import product

from ctgraph_rl.curriculum import Block, Curriculum
from ctgraph_rl.graph import CTGraph
from ctgraph_rl.images import PaperImages
from ctgraph_rl.observations import Observations
from ctgraph_rl.task import Task

PAPER = "Soltoggio et al. 2023, arXiv 2302.10887"


def ct_su_b1(goal: tuple[int, ...] = (1, 1), image_seed: int = 1) -> Task:
    """CT-SU-B1: surjective, b=2, d=2, p=0; one image for all decision states, one for all wait states.

    Args:
        goal: two decisions in 1..2.
        image_seed: seed of the image set.
    """
    observations = Observations(decision_ids=(2, 2), wait_ids=(3, 3), end_ids=(4, 4))
    return Task(CTGraph(2, 2, 0.0), goal, observations, PaperImages(num_images=5, seed=image_seed))


def su_b1_4tasks(num_frames: int = 204_800, image_seed: int = 1) -> Curriculum:
    """The four goals of CT-SU-B1 one after the other, in lexicographic order: (1,1), (1,2), (2,1), (2,2).

    Args:
        num_frames: frames per task.
        image_seed: seed of the image set that all tasks share.
    """
    goals = product((1, 2), repeat=2)
    blocks = tuple(Block((ct_su_b1(goal, image_seed),), num_frames) for goal in goals)
    return Curriculum("su_b1_4tasks", 1, PAPER, blocks)
