"""Where nodes stand, which transitions there are and which ids states show; the graph as a DOT file."""

import re
from dataclasses import replace

import pytest
import torch

from ctgraph_rl.core.graph import CTGraph, StateType
from ctgraph_rl.draw.dot import to_dot
from ctgraph_rl.draw.layout import Edge, lay_out, shown_ids, write_ids, write_short
from ctgraph_rl.env import CTGraphEnv
from ctgraph_rl.tasks.configurations import CONFIGURATIONS, ct_fo_b1, ct_fo_b2, make_task

HOME, WAIT, DECISION, END, FAIL = StateType


def test_a_small_tree_is_laid_out_whole_with_parents_in_the_middle():
    layout = lay_out(CTGraph(2, 2), [3])

    assert layout.is_whole
    assert layout.x == {0: 0.5, 1: 0.25, 2: 0.75, 3: 0.125, 4: 0.375, 5: 0.625, 6: 0.875}
    assert list(layout.x) == list(layout.level) == list(range(7))
    assert layout.level == {0: 0, 1: 1, 2: 1, 3: 2, 4: 2, 5: 2, 6: 2}
    assert (layout.stubs, layout.left_out) == ([], {})


def test_of_a_large_tree_only_the_paths_asked_for_are_laid_out():
    graph = CTGraph(5, 6)
    first, last = graph.node_at((1,) * 6), graph.node_at((1, 5, 5, 5, 5, 5))

    layout = lay_out(graph, [last, first, first])

    assert not layout.is_whole
    assert layout.leaves == [first, last]
    assert set(layout.x) == {*graph.nodes_to(first), *graph.nodes_to(last)}
    assert (layout.x[first], layout.x[last]) == (0.25, 0.75)
    assert layout.left_out[0] == 4 and layout.left_out[1] == 3
    of_root = [x for node, x in layout.stubs if node == 0]
    beside_last = [x for node, x in layout.stubs if node == graph.parent(last)]
    assert len(of_root) == len(beside_last) == 3  # at most three of the four on a side
    assert min(of_root) > layout.x[1] and max(beside_last) < layout.x[last]


def test_the_time_to_lay_out_does_not_grow_with_the_tree():
    graph = CTGraph(10**9, 2)
    end = graph.node_at((10**9, 5))

    layout = lay_out(graph, [end])

    assert list(layout.x) == [0, 10**9, end]
    assert layout.left_out == {0: 10**9 - 1, 10**9: 10**9 - 1}


@pytest.mark.parametrize(
    ("goal", "text"),
    [
        ((1, 2), "1.2"),
        ((11, 2), "11.2"),
        ((1, 2) * 4, "1.2.1.2.1.2.1.2"),
        ((1, 2, 3, 4, 5, 6, 7, 8, 9), "1.2.3.4 ... 6.7.8.9"),
    ],
)
def test_a_long_goal_is_written_without_its_middle(goal, text):
    assert write_short(goal) == text


def test_every_state_and_transition_of_a_graph_is_there():
    task = make_task(branching_factor=3, depth=2)
    graph, layout = task.graph, lay_out(task.graph, [4])

    found, moves = list(layout.states()), list(layout.edges(task))

    assert len(found) == len(set(found)) == graph.num_states - 1  # fail aside
    assert len(moves) == 1 + 2 * graph.num_wait_states - 1  # into and out of each wait state
    assert {end for _, end, _ in moves} == set(found) - {(HOME, 0)}
    assert {Edge((HOME, 0), (WAIT, 0), None), Edge((WAIT, 0), (DECISION, 0), 0)} <= set(moves)
    assert {Edge((DECISION, 1), (WAIT, 6), 3), Edge((WAIT, 6), (END, 6), 0)} <= set(moves)
    assert Edge((DECISION, 0), (DECISION, 2), 2) in set(layout.edges(task, waits=False))


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("name", ["CT-FO-B2", "CT-SU-B1", "CT-CO-B1", "b3"])
def test_ids_are_those_of_the_environment(name, legacy):
    task = make_task(branching_factor=3, depth=2) if name == "b3" else CONFIGURATIONS[name]()
    task = replace(task, observations=replace(task.observations, legacy_index=legacy))
    layout = lay_out(task.graph, [0])
    found = list(layout.states())
    env = CTGraphEnv([task] * len(found))
    env.reset()
    kinds, nodes = (torch.tensor(values) for values in zip(*found, strict=True))
    env.rows.state = env.rows.state._replace(state_type=kinds.to(torch.uint8), node=nodes)
    shown = env.observation_id.tolist()

    ranges = [shown_ids(task, state, layout.level[state[1]]) for state in found]

    assert all(first <= number <= last for number, (first, last) in zip(shown, ranges, strict=True))
    several = {state[0] for state, (first, last) in zip(found, ranges, strict=True) if first < last}
    assert several == ({WAIT} if name == "CT-CO-B1" else set())


def test_a_range_of_ids_is_written_with_a_dash():
    assert write_ids(CONFIGURATIONS["CT-CO-B1"](), (WAIT, 0), 0) == "3-102"
    assert write_ids(ct_fo_b1(), (END, 5), 2) == "14"


def test_a_dot_file_has_every_state_and_transition():
    lines = to_dot(ct_fo_b2((2, 1, 2))).splitlines()

    nodes = [line for line in lines if "shape=" in line]
    moves = [line for line in lines if "->" in line]
    graph = ct_fo_b2().graph
    assert (lines[0], lines[-1]) == ("digraph {", "}")
    assert len(nodes) == graph.num_states
    fails = graph.num_wait_states + graph.num_decision_states
    assert len(moves) == 2 * graph.num_wait_states + graph.num_wait_states + fails
    assert [line for line in lines if "peripheries" in line] == [
        '  end12 [label="29", shape="box", fillcolor="#009e73", peripheries="2"];'
    ]
    assert '  wait3 -> wait3 [label="0 (p=0.5)"];' in lines
    assert '  decision1 -> wait3 [label="1"];' in lines
    assert '  decision1 -> fail0 [label="0", style="dashed"];' in lines


def test_without_waiting_in_place_there_are_no_loops_in_a_dot_file():
    assert not re.search(r"(\w+) -> \1 ", to_dot(ct_fo_b1()))


def test_names_are_escaped_in_a_dot_file():
    assert r'label="a \"b\" \\N\n[c]"' in to_dot(ct_fo_b1(), 'a "b" \\N\n[c]')


def test_a_large_graph_is_cut_in_a_dot_file():
    text = to_dot(make_task(branching_factor=5, depth=6, goal=(5,) * 6, fully_observable=False))

    assert text.count("4 more branches") == 6
    assert text.count('shape="box"') == 1
    assert len(text) < 5000
