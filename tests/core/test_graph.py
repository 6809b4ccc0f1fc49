import dataclasses
import math

import pytest

from ctgraph_rl import CTGraph


@pytest.mark.parametrize(
    ("b", "d", "ends", "decisions", "waits", "states"),
    [
        (2, 1, 2, 1, 3, 8),
        (2, 2, 4, 3, 7, 16),
        (3, 2, 9, 4, 13, 28),
        (2, 4, 16, 15, 31, 64),
        (3, 10, 59049, 29524, 88573, 177148),
        (2, 16, 65536, 65535, 131071, 262144),
    ],
)
def test_the_numbers_of_states_are_those_of_the_paper(b, d, ends, decisions, waits, states):
    graph = CTGraph(b, d)

    counts = (graph.num_end_states, graph.num_decision_states, graph.num_wait_states, graph.num_states)

    assert counts == (ends, decisions, waits, states)


@pytest.mark.parametrize(("b", "deepest", "num_states"), [(2, 60, 2**62), (3, 38, 3**39 + 1), (2**61, 1, 2**62 + 4)])
def test_the_deepest_tree_that_fits_int64_is_accepted_and_one_level_more_is_refused(b, deepest, num_states):
    graph = CTGraph(b, deepest)

    with pytest.raises(ValueError, match=rf"depth={deepest + 1} .* more than 2\*\*63 - 1 states; use a smaller depth"):
        CTGraph(b, deepest + 1)

    assert graph.num_states == num_states


@pytest.mark.parametrize("depth", [62, 64, 10**9])
def test_a_tree_too_large_for_int64_is_refused_at_once(depth):
    message = rf"depth={depth} with branching_factor=2 gives more than 2\*\*63 - 1 states; use a smaller depth"

    with pytest.raises(ValueError, match=message):
        CTGraph(2, depth)


def test_a_branching_factor_too_large_for_int64_is_refused():
    with pytest.raises(ValueError, match=r"more than 2\*\*63 - 1 states"):
        CTGraph(2**62, 1)


@pytest.mark.parametrize("depth", [0, -1, True, 2.5, "2", None])
def test_a_depth_that_is_not_a_positive_integer_is_refused(depth):
    with pytest.raises(ValueError, match=f"depth must be an integer >= 1, got {depth!r}"):
        CTGraph(2, depth)


@pytest.mark.parametrize("branching_factor", [1, 0, -2, True, 2.5, None])
def test_a_branching_factor_below_two_is_refused(branching_factor):
    with pytest.raises(ValueError, match=f"branching_factor must be an integer >= 2, got {branching_factor!r}"):
        CTGraph(branching_factor, 2)


@pytest.mark.parametrize("wait_prob", [1, 1.0, 1.5, -0.1, math.nan, math.inf, -math.inf, False, "0.5", None])
def test_a_wait_probability_outside_zero_to_one_is_refused(wait_prob):
    with pytest.raises(ValueError, match=rf"wait_prob must be in \[0, 1\), got {wait_prob!r}"):
        CTGraph(2, 2, wait_prob)


def test_every_broken_field_is_named_in_one_message():
    with pytest.raises(
        ValueError, match=r"branching_factor must .* got 1; depth must .* got 0; wait_prob must .* got 1"
    ):
        CTGraph(1, 0, 1)


def test_the_largest_wait_probability_below_one_is_accepted():
    graph = CTGraph(2, 2, math.nextafter(1, 0))

    assert graph.expected_episode_length == pytest.approx(3 * 2**53)


def test_a_graph_is_frozen_and_equal_and_hashable_by_value():
    graph = CTGraph(2, 3)

    with pytest.raises(dataclasses.FrozenInstanceError):
        graph.depth = 4

    assert {graph, CTGraph(2, 3, 0), CTGraph(2, 3, 0.0), CTGraph(3, 3)} == {CTGraph(2, 3), CTGraph(3, 3)}
    assert isinstance(CTGraph(2, 3, 0).wait_prob, float)


def test_paths_and_nodes_follow_the_heap_whose_branch_a_of_node_n_is_b_n_plus_a():
    graph = CTGraph(3, 3)
    end = 3 * (3 * 2 + 1) + 3

    assert graph.path(end) == (2, 1, 3) and graph.node_at((2, 1, 3)) == end
    assert graph.nodes_to(end) == (0, 2, 7, end)
    assert [graph.parent(node) for node in (end, 7, 2)] == [7, 2, 0]
    assert [graph.decision(node) for node in (2, 7, end)] == [2, 1, 3]
    assert [graph.first_node(level) for level in range(4)] == [0, 1, 4, graph.num_decision_states]
    assert (graph.path(0), graph.nodes_to(0)) == ((), (0,))


def test_the_leaf_of_a_goal_has_its_decisions_as_digits():
    graph = CTGraph(3, 3)

    assert graph.leaf_of((1, 1, 1)) == 0
    assert graph.leaf_of((2, 1, 3)) == 1 * 9 + 0 * 3 + 2
    assert graph.leaf_of((3, 3, 3)) == graph.num_end_states - 1
