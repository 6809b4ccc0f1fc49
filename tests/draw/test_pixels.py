"""Pictures: what they show, and that they show nothing else."""

import numpy as np
import pytest
import torch

from ctgraph_rl.core.graph import CTGraph, StateType
from ctgraph_rl.draw.pixels import SCALE, STATE_COLOURS, Mark, _discs, render
from ctgraph_rl.tasks.images import OneHot, PaperImages
from ctgraph_rl.tasks.observations import Observations
from ctgraph_rl.tasks.task import Task

OBSERVATIONS = Observations(wait_ids=(2, 2), decision_ids=(3, 3), end_ids=(4, 4))
SMALL = Task(CTGraph(2, 2), (1, 2), OBSERVATIONS, PaperImages(5))
DEEP = Task(CTGraph(3, 30), (1, 3, 2) * 10, OBSERVATIONS, PaperImages(5))
VECTORS = Task(CTGraph(2, 2), (1, 2), OBSERVATIONS, OneHot(5))
SIZE = 192
FAIL_CORNER = (slice(0, 30), slice(-30, None))


def node_after(task, decisions):
    node = 0
    for decision in decisions:
        node = task.graph.branching_factor * node + decision
    return node


def draw(task, kind, decisions=(), observation_id=2, goal_leaf=None, size=SIZE):
    """The picture of one row, [size, 2 * size, 3]."""
    state = [int(kind)], [node_after(task, decisions)], [task.goal_leaf if goal_leaf is None else goal_leaf]
    observation = task.images.bank(0)[observation_id].unsqueeze(0)
    return render([task], *map(torch.tensor, state), observation, size)[0]


def halves(picture):
    return picture[:, : picture.shape[0]], picture[:, picture.shape[0] :]


def count(picture, colour):
    return int((picture == torch.tensor(colour)).all(-1).sum())


def every_position(graph):
    """All (kind, decisions) of a graph but the fail state."""
    ways = [()]
    for depth in range(graph.depth):
        ways += [(*way, branch) for way in ways if len(way) == depth for branch in range(1, graph.branching_factor + 1)]
    inner = [(StateType.END if len(way) == graph.depth else StateType.DECISION, way) for way in ways]
    return [(StateType.HOME, ()), *((StateType.WAIT, way) for way in ways), *inner]


@pytest.mark.parametrize("task", [SMALL, DEEP, VECTORS])
@pytest.mark.parametrize("size", [48, 100, 192])
def test_a_picture_per_row_is_uint8_and_twice_as_wide_as_high(task, size):
    rows = 3
    state = torch.full((rows,), int(StateType.HOME)), torch.zeros(rows, dtype=torch.int64)
    goal_leaf = torch.full((rows,), task.goal_leaf)

    pictures = render([task] * rows, *state, goal_leaf, task.images.bank(0)[:rows], size)

    assert pictures.dtype == torch.uint8
    assert pictures.shape == (rows, size, 2 * size, 3)
    assert pictures.device.type == "cpu"


@pytest.mark.parametrize("graph", [CTGraph(2, 1), CTGraph(3, 2), CTGraph(2, 5)])
def test_no_two_positions_have_the_same_picture(graph):
    task = Task(graph, (1,) * graph.depth, OBSERVATIONS, PaperImages(5))
    positions = every_position(graph)

    pictures = {draw(task, kind, way).numpy().tobytes() for kind, way in positions}

    assert len(pictures) == len(positions) == graph.num_states - 1


@pytest.mark.parametrize("task", [SMALL, DEEP])
def test_no_two_goals_have_the_same_tree(task):
    last = task.graph.num_end_states - 1
    leaves = {0, 1, task.graph.branching_factor, last // 2 + 1, last}

    trees = {halves(draw(task, StateType.HOME, goal_leaf=leaf))[1].numpy().tobytes() for leaf in leaves}

    assert len(trees) == len(leaves)


@pytest.mark.parametrize("task", [SMALL, VECTORS])
def test_an_observation_changes_the_left_half_and_nothing_else(task):
    ids = range(task.images.num_images)

    pictures = [halves(draw(task, StateType.DECISION, (1,), observation_id)) for observation_id in ids]

    assert len({left.numpy().tobytes() for left, _ in pictures}) == len(ids)
    assert len({right.numpy().tobytes() for _, right in pictures}) == 1


def test_a_position_and_a_goal_change_the_right_half_and_nothing_else():
    before, _ = halves(draw(SMALL, StateType.HOME, goal_leaf=0))

    after, _ = halves(draw(SMALL, StateType.END, (2, 2), goal_leaf=3))

    assert torch.equal(before, after)


def test_what_is_not_drawn_does_not_change_the_picture():
    graph = CTGraph(2, 2, wait_prob=0.5)
    other = Task(graph, (2, 1), OBSERVATIONS, SMALL.images, goal_reward=5.0)

    pictures = [draw(task, StateType.WAIT, (1,), goal_leaf=2) for task in (SMALL, other, SMALL)]

    assert torch.equal(pictures[0], pictures[1])
    assert torch.equal(pictures[0], pictures[2])


def test_a_row_of_a_mixed_batch_equals_the_row_alone():
    tasks = [SMALL, DEEP, SMALL, DEEP]
    kinds = torch.tensor([StateType.END, StateType.WAIT, StateType.FAIL, StateType.HOME])
    nodes = torch.tensor([node_after(SMALL, (1, 2)), node_after(DEEP, DEEP.goal[:17]), 1, 0])
    leaves = torch.tensor([task.goal_leaf for task in tasks])
    observation = SMALL.images.bank(0)[:4]

    batch = render(tasks, kinds, nodes, leaves, observation)

    for i, task in enumerate(tasks):
        row = slice(i, i + 1)
        assert torch.equal(batch[row], render([task], kinds[row], nodes[row], leaves[row], observation[row]))


def test_an_image_is_shown_in_its_grey_levels_with_cells_repeated():
    image = SMALL.images.bank(0)[3, 0]
    scale = 168 // 12

    left, _ = halves(draw(SMALL, StateType.DECISION, observation_id=3))

    expected = image.repeat_interleave(scale, 0).repeat_interleave(scale, 1)
    assert torch.equal(left[12:180, 12:180], expected.unsqueeze(-1).expand(-1, -1, 3))


@pytest.mark.parametrize("num_images", [5, 16, 1000, 30_000])
def test_exactly_the_active_entry_of_a_one_hot_vector_is_lit(num_images):
    task = Task(SMALL.graph, SMALL.goal, OBSERVATIONS, OneHot(num_images))

    vectors = torch.zeros(2, num_images, dtype=torch.uint8)
    vectors[0, num_images - 1] = 1
    pictures = render([task] * 2, *torch.zeros(3, 2, dtype=torch.int64), vectors)

    lit, dark = (count(halves(picture)[0], (255, 255, 255)) for picture in pictures)
    assert lit >= 1
    assert dark == 0


def test_the_colours_of_all_state_types_are_in_a_tree_and_differ():
    _, tree = halves(draw(SMALL, StateType.DECISION))

    areas = {kind: count(tree, colour) for kind, colour in STATE_COLOURS.items()}

    assert len(set(STATE_COLOURS.values())) == len(StateType)
    assert all(area >= 20 for area in areas.values())
    assert areas[StateType.END] > areas[StateType.DECISION] > areas[StateType.HOME]


def test_the_discs_of_states_are_filled():
    canvas = np.zeros((64, 64), dtype=np.uint8)

    _discs(canvas, [Mark(8.0, 8.0, 6.0)], 3)

    inside = np.hypot(*(np.indices(canvas.shape) - 8 * SCALE)) <= 6 * SCALE
    assert np.array_equal(canvas == 3, inside)


def test_the_fail_mark_is_outlined_on_failure_and_only_then():
    ways = {StateType.HOME: (), StateType.END: (1, 2)}
    corners = {kind: halves(draw(SMALL, kind, ways.get(kind, (1,))))[1][FAIL_CORNER] for kind in StateType}

    black = {kind: count(corner, (0, 0, 0)) for kind, corner in corners.items()}

    assert black.pop(StateType.FAIL) > 50
    assert set(black.values()) == {0}
    assert all(count(corner, STATE_COLOURS[StateType.FAIL]) > 50 for corner in corners.values())


def test_a_failed_row_shows_where_it_failed():
    decisions = [(), (1,), (2,), (1, 1), (2, 2)]

    pictures = {draw(SMALL, StateType.FAIL, way).numpy().tobytes() for way in decisions}

    assert len(pictures) == len(decisions)


def test_a_cross_of_the_colour_of_failure_is_where_a_row_failed():
    tree = slice(FAIL_CORNER[0].stop, None)

    failed, there = (halves(draw(SMALL, kind, (1,)))[1][tree] for kind in (StateType.FAIL, StateType.DECISION))

    assert count(failed, STATE_COLOURS[StateType.FAIL]) > 10
    assert count(there, STATE_COLOURS[StateType.FAIL]) == 0


def test_the_way_to_a_position_goes_beneath_the_states_that_it_passes():
    at_home, at_end = (halves(draw(SMALL, *place))[1] for place in ((StateType.HOME,), (StateType.END, (2, 1))))

    for kind in (StateType.WAIT, StateType.DECISION):
        assert count(at_home, STATE_COLOURS[kind]) == count(at_end, STATE_COLOURS[kind])


def test_a_tree_of_depth_30_shows_one_path_to_the_goal_and_one_to_the_position():
    on_the_way, astray = DEEP.goal[:10], (*DEEP.goal[:5], 2, 1, 1, 3, 2)

    trees = [halves(draw(DEEP, StateType.DECISION, way, size=768))[1] for way in (on_the_way, astray)]

    decision, end = STATE_COLOURS[StateType.DECISION], STATE_COLOURS[StateType.END]
    beside, below = slice(220, 280), slice(290, None)  # three levels up to the position, and what comes after it
    assert count(trees[1][beside], decision) > 1.5 * count(trees[0][beside], decision) > 0
    assert abs(count(trees[1][below], decision) / count(trees[0][below], decision) - 1) < 0.1
    assert count(trees[0], end) == count(trees[1], end) > 0


def test_a_tree_with_a_billion_branches_is_drawn():
    task = Task(CTGraph(10**9, 2), (7, 10**9), OBSERVATIONS, SMALL.images)

    there, elsewhere = draw(task, StateType.END, task.goal), draw(task, StateType.END, (10**9, 1))

    assert not torch.equal(there, elsewhere)


def test_wrong_arguments_are_named():
    zeros, image = torch.zeros(1, dtype=torch.int64), torch.zeros(1, 1, 12, 12, dtype=torch.uint8)

    with pytest.raises(ValueError, match="N >= 1 rows of each, got 2"):
        render([SMALL] * 2, zeros, zeros, zeros, image)
    with pytest.raises(ValueError, match="N >= 1 rows of each, got 0"):
        render([], zeros[:0], zeros[:0], zeros[:0], image[:0])
    with pytest.raises(ValueError, match="size must be an integer >= 48, got 47"):
        render([SMALL], zeros, zeros, zeros, image, size=47)
    with pytest.raises(ValueError, match=r"observation must be .* got \[1, 12, 12\]"):
        render([SMALL], zeros, zeros, zeros, image[:, 0])
