"""Tasks that compare memories: confounding graphs with long waits, after Ladosz et al. 2021.

Their graph was not published. By section 4.2 of Soltoggio et al. 2023 the most complex one had p = 0.9 and 500
observations. It is unknown whether decisions had their own images: an argument says it.
"""

from __future__ import annotations

from ctgraph_rl.checks import is_int, is_real, require, true_or_false
from ctgraph_rl.core.graph import CTGraph
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.images import PaperImages
from ctgraph_rl.tasks.observations import Observations
from ctgraph_rl.tasks.task import Task
from curricula.axes import sequence

SOURCE = "Ladosz et al. 2021; the numbers of its graph in Soltoggio et al. 2023, arXiv 2302.10887"

MOST_DEPTH = 16


def co_hard(
    depth: int = 2,
    wait_prob: float = 0.9,
    expected_length: float | None = None,
    unique_decisions: bool = False,
    num_wait_images: int = 500,
    read_noise: int = 0,
    num_frames: int = 512_000,
    image_seed: int = 1,
) -> Curriculum:
    """One confounding graph, b=2, whose goal is reached by turns in alternation: 1, 2, 1, 2, ...

    With shared decision images a policy must remember its decisions. With unique ones it only must find out which
    decision was right, despite waits that say nothing.

    Args:
        depth: d.
        wait_prob: p, in [0, 1).
        expected_length: E[rho], the mean steps of an episode without fail, which then decides p; None: p is given.
        unique_decisions: whether each decision state has its own image; False: all show one image.
        num_wait_images: images that wait states draw from; 1 is a surjective graph.
        read_noise: largest addition to a pixel on each read, in 0..255.
        num_frames: frames to learn from.
        image_seed: seed of the image set.
    """
    require(
        (is_int(depth, 1, MOST_DEPTH), f"depth must be an integer in 1..{MOST_DEPTH}, got {depth!r}"),
        (is_int(num_wait_images, 1), f"num_wait_images must be an integer >= 1, got {num_wait_images!r}"),
        *true_or_false(unique_decisions=unique_decisions),
    )
    p = wait_prob
    if expected_length is not None:
        least = CTGraph(2, depth).expected_episode_length
        rule = f"expected_length must be a number >= {least:g} at depth {depth}, got {expected_length!r}"
        require((is_real(expected_length) and least <= expected_length, rule))
        waits = (expected_length - least) / (depth + 1)  # E[rho] = 2 (d + 1) + (d + 1) p / (1 - p)
        p = waits / (1 + waits)
    graph = CTGraph(2, depth, p)
    first_wait = 2 + (graph.num_decision_states if unique_decisions else 1)
    end = first_wait + num_wait_images
    observations = Observations(
        wait_ids=(first_wait, end - 1),
        decision_ids=(2, first_wait - 1),
        end_ids=(end, end),
        unique_decisions=unique_decisions,
        unique_ends=False,
        read_noise=read_noise,
    )
    goal = tuple(1 + place % 2 for place in range(depth))
    task = Task(graph, goal, observations, PaperImages(end + 1, image_seed))
    return sequence("co_hard", [task], num_frames, source=SOURCE)


NAMED = {"co_hard": co_hard}
