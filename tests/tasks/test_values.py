"""Exact values against closed forms, hand calculation, and Markov chains built here in plain Python."""

import math
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction

import pytest
import torch
from helpers.probability_tables import (
    F64,
    GAMMAS,
    GRAPHS,
    Mixed,
    OneAtTheGoal,
    make_task,
    random_policy,
)
from torch import Tensor

from ctgraph_rl import CTGraph, StateType, Task
from ctgraph_rl.core.tree import State, transition
from ctgraph_rl.core.tree import tree_params as make_tree
from ctgraph_rl.tasks.values import worst_value

REWARDS = [(1.0, 0.0), (2.5, -0.5), (1.0, 0.3), (-1.0, 0.0), (-1.0, -0.25), (0.0, 2.0)]
"""goal_reward and fail_reward."""


# --- closed forms of the graph


@pytest.mark.parametrize(("b", "d", "p"), GRAPHS)
def test_random_probabilities_are_the_closed_forms_correctly_rounded(b, d, p):
    exact = (b + 1) * ((1 - Fraction(p)) / ((b + 1) * (b + 1 - Fraction(p)))) ** (d + 1)

    graph = CTGraph(b, d, p)

    assert graph.reward_prob_random == exact.numerator / exact.denominator
    assert graph.end_prob_random == (b**d * exact).numerator / exact.denominator
    assert graph.exact_reward_prob_random == exact


def test_the_exact_probability_holds_at_b_3_d_30_p_999_and_where_floats_end():
    deep, beyond = CTGraph(3, 30, 0.999), CTGraph(2, 60, 1 - 2**-30)

    expected = [math.log(4) + 31 * math.log(1 / (4 * 3001)), math.log(3) - 61 * math.log(3 * (2 * 2**30 + 1))]

    exact = beyond.exact_reward_prob_random
    assert math.log(deep.reward_prob_random) == pytest.approx(expected[0], rel=1e-13)
    assert math.log(exact.numerator) - math.log(exact.denominator) == pytest.approx(expected[1], rel=1e-13)
    assert beyond.reward_prob_random == 0.0


@pytest.mark.parametrize(("b", "d", "p"), GRAPHS)
def test_the_episode_length_is_the_convolution_of_its_waits(b, d, p):
    graph, longest = CTGraph(b, d, p), 1500
    wait = [0.0] + [(1 - p) * p**stays for stays in range(longest)]
    expected = [1.0]

    for _ in range(d + 1):
        expected = [math.fsum(expected[i] * wait[n - i] for i in range(min(n + 1, len(expected)))) for n in range(80)]

    assert [graph.episode_length_prob(n + d + 1) for n in range(80)] == pytest.approx(expected, rel=1e-11, abs=0)
    assert math.fsum(map(graph.episode_length_prob, range(longest))) == pytest.approx(1, rel=1e-12)
    mean = math.fsum(n * graph.episode_length_prob(n) for n in range(longest))
    assert mean == pytest.approx(graph.expected_episode_length, rel=1e-12)
    assert [graph.episode_length_prob(n) for n in (-1, 0, 2 * d + 1)] == [0.0, 0.0, 0.0]


def test_without_waiting_the_episode_length_is_certain_and_the_shortest_needs_no_stay():
    sure, deep = CTGraph(2, 2, 0.0), CTGraph(3, 30, 0.999)

    assert [sure.episode_length_prob(n) for n in (5, 6, 7, 10**6)] == [0.0, 1.0, 0.0, 0.0]
    assert CTGraph(2, 2, 0.5).episode_length_prob(6) == pytest.approx(1 / 8, rel=1e-14)
    assert CTGraph(2, 2, 0.5).episode_length_prob(8) == pytest.approx(6 / 32, rel=1e-14)
    assert deep.episode_length_prob(62) == pytest.approx(0.001**31, rel=1e-11)
    mode = 31 + 31 + math.floor(30 / 0.001 - 30)
    assert deep.episode_length_prob(mode) > max(map(deep.episode_length_prob, (mode - 99, mode + 99)))


@pytest.mark.parametrize("length", [6.5, True, "6", None])
def test_an_episode_length_that_is_no_integer_is_refused(length):
    with pytest.raises(ValueError, match="length must be an integer"):
        CTGraph(2, 2).episode_length_prob(length)


# --- the chain inside the implementation


def extract(graph: CTGraph) -> tuple[Tensor, Tensor, Tensor]:
    """What `transition` does: kinds and nodes of all states, and the successors [states, actions, 2] with stays last.

    States are in the order home, waits, decisions, ends, fail; all fail states are one, the last.
    """
    b, waits, decisions = graph.branching_factor, graph.num_wait_states, graph.num_decision_states
    counts = torch.tensor([1, waits, decisions, graph.num_end_states, 1])
    first = torch.cat([counts.new_zeros(1), counts.cumsum(0)[:-1]])
    kind = torch.arange(5).repeat_interleave(counts)
    node = torch.arange(len(kind)) - first[kind] + decisions * (kind == StateType.END)
    shape = (len(kind), b + 1, 2)
    tree = make_tree(torch.tensor(b), torch.tensor(decisions), torch.tensor(0))
    state = State(kind[:, None, None].expand(shape), node[:, None, None].expand(shape))
    action, stays = torch.arange(b + 1)[None, :, None].expand(shape), torch.tensor([False, True]).expand(shape)
    after = State(*(part.long() for part in transition(state, action, stays, tree)))
    offset = after.node - decisions * (after.state_type == StateType.END)
    offset = torch.where(after.state_type == StateType.FAIL, 0, offset)
    return kind, node, first[after.state_type] + offset


def chain(graph: CTGraph, kind: Tensor, successors: Tensor, navigates: bool) -> Tensor:
    """float64 [states, states]: one step of the random or the navigation policy."""
    n, num_actions, _ = successors.shape
    probs = torch.full((n, num_actions), 1 / num_actions, dtype=F64)
    if navigates:
        probs[kind == StateType.WAIT] = torch.eye(num_actions, dtype=F64)[0]
        deciding = torch.tensor([0.0] + [1.0] * (num_actions - 1), dtype=F64) / (num_actions - 1)
        probs[kind == StateType.DECISION] = deciding
    stay_law = torch.tensor([1 - graph.wait_prob, graph.wait_prob], dtype=F64)
    flat = (probs[:, :, None] * stay_law).flatten(1)
    return torch.zeros(n, n, dtype=F64).scatter_add_(1, successors.flatten(1), flat)


def from_home(step: Tensor, kind: Tensor) -> tuple[Tensor, float]:
    """Solve the chain: the probability of ending in each state, and the mean number of steps until then."""
    running = kind < StateType.END
    inside, exits = step[running][:, running], step[running][:, ~running]
    visits = torch.linalg.solve((torch.eye(len(inside), dtype=F64) - inside).T, torch.eye(len(inside), dtype=F64)[0])
    return visits @ exits, visits.sum().item()


@pytest.mark.parametrize(("b", "d", "p"), GRAPHS)
def test_the_chain_of_transition_solved_gives_the_closed_forms(b, d, p):
    graph = CTGraph(b, d, p)
    kind, _, successors = extract(graph)

    at_random, _ = from_home(chain(graph, kind, successors, navigates=False), kind)
    navigating, steps = from_home(chain(graph, kind, successors, navigates=True), kind)

    assert len(kind) == graph.num_states
    assert at_random[:-1].tolist() == pytest.approx([graph.reward_prob_random] * b**d, rel=1e-12, abs=0)
    assert at_random[:-1].sum().item() == pytest.approx(graph.end_prob_random, rel=1e-12, abs=0)
    assert navigating.tolist() == pytest.approx([graph.reward_prob_navigation] * b**d + [0.0], rel=1e-12, abs=0)
    assert steps == pytest.approx(graph.expected_episode_length, rel=1e-12, abs=0)


@pytest.mark.parametrize(
    ("b", "d", "p", "printed"),
    [
        pytest.param(3, 10, 0.9, "3.75e-23", marks=pytest.mark.slow),
        pytest.param(2, 16, 0.5, "3.04e-20", marks=pytest.mark.slow),
        (2, 5, 0.0, "5.65e-06"),
    ],
)
def test_the_papers_small_probabilities_follow_from_every_transition_of_the_whole_graph(b, d, p, printed):
    graph = CTGraph(b, d, p)
    kind, node, successors = extract(graph)
    starts = torch.tensor([(b**level - 1) // (b - 1) for level in range(d + 2)])
    level = torch.bucketize(node, starts, right=True) - 1
    path = torch.tensor([0] * (d + 1))
    for k in range(d):
        path[k + 1] = b * path[k] + 1 + k % b
    label = torch.stack([level, kind, node == path[level]], -1)
    label[-1] = torch.tensor([d + 1, StateType.FAIL, 0])  # where it failed does not matter

    classes, member = torch.unique(label, dim=0, return_inverse=True)  # sorted by level and kind: no way leads back
    reached = member[successors]
    lumped = reached.new_zeros(len(classes), b + 1, 2)
    lumped[member] = reached
    class_kind, ends = classes[:, 1], classes[classes[:, 1] >= StateType.END]
    at_random, _ = from_home(chain(graph, class_kind, lumped, navigates=False), class_kind)
    navigating, steps = from_home(chain(graph, class_kind, lumped, navigates=True), class_kind)

    assert torch.equal(lumped[member], reached)  # all states of a class go to the same classes: lumping is exact
    assert ends.tolist() == [[d, StateType.END, 0], [d, StateType.END, 1], [d + 1, StateType.FAIL, 0]]
    assert at_random[1].item() == pytest.approx(graph.reward_prob_random, rel=1e-12, abs=0)
    assert f"{at_random[1].item():.2e}" == printed
    assert at_random[:2].sum().item() == pytest.approx(graph.end_prob_random, rel=1e-12, abs=0)
    assert navigating[1].item() == pytest.approx(graph.reward_prob_navigation, rel=1e-12, abs=0)
    assert steps == pytest.approx(graph.expected_episode_length, rel=1e-12, abs=0)


# --- the optimal value


def best_by_plain_recursion(
    task: Task, gamma: float, end_reward: Callable[[int], float], best: Callable[..., float] = max
) -> float:
    b, d, p = task.graph.branching_factor, task.graph.depth, task.graph.wait_prob

    def wait(path: tuple[int, ...]) -> float:
        arrival = end_reward(sum((a - 1) * b ** (d - 1 - k) for k, a in enumerate(path)))
        if len(path) < d:
            arrival = gamma * best(task.fail_reward, *(gamma * wait((*path, a)) for a in range(1, b + 1)))
        value = task.fail_reward
        for _ in range(3000):  # value iteration: stays at most p of the error per sweep
            value = best(task.fail_reward, (1 - p) * arrival + p * gamma * value)
        return value

    return gamma * wait(())


@pytest.mark.parametrize(("b", "d", "p"), [*GRAPHS, (3, 30, 0.999), (2, 60, 0.5)])
@pytest.mark.parametrize("gamma", [0.5, 0.99, 1.0])
def test_the_optimal_value_of_a_plain_needle_is_its_closed_form(b, d, p, gamma):
    task = make_task(b, d, p)

    value = task.optimal_value(gamma)

    assert value == pytest.approx((gamma**2 * (1 - p) / (1 - gamma * p)) ** (d + 1) / gamma, rel=1e-12, abs=0)


def test_without_waits_the_optimal_value_is_gamma_to_the_number_of_steps_before_the_reward():
    task = make_task(2, 2)

    assert task.optimal_value(0.5) == 0.5 ** (2 * 3 - 1)
    assert task.optimal_value(1) == 1.0
    assert task.optimal_value(0.0) == 0.0


def test_with_d_1_p_half_gamma_half_the_optimal_value_is_2_27ths():
    task = make_task(2, 1, 0.5)

    value = task.optimal_value(0.5)

    # the second wait is worth 1/2 + 1/4 V = 2/3, the decision 1/3, the first wait 2/3 of half of that
    assert value == pytest.approx(0.5 * (0.5 * 1 / 3 * 1 / 2) / (1 - 1 / 4), rel=1e-15)


@pytest.mark.parametrize(("b", "d", "p"), GRAPHS)
@pytest.mark.parametrize(("goal_reward", "fail_reward"), REWARDS)
def test_the_two_nodes_per_level_of_a_needle_give_what_all_nodes_give(b, d, p, goal_reward, fail_reward):
    task = make_task(b, d, p, goal_reward=goal_reward, fail_reward=fail_reward)
    generator = torch.Generator().manual_seed(b * d)

    every_node = replace(task, reward_fn=OneAtTheGoal())
    policy = random_policy(task, b + 1, generator)

    for gamma in GAMMAS:
        assert task.optimal_value(gamma) == pytest.approx(every_node.optimal_value(gamma), rel=1e-13, abs=0)
        value = every_node.policy_value(policy, gamma)
        assert task.policy_value(policy, gamma) == pytest.approx(value, rel=1e-12, abs=1e-15)


@pytest.mark.parametrize(("b", "d", "p"), [(2, 1, 0.5), (2, 2, 0.5), (3, 2, 0.25)])
@pytest.mark.parametrize(("goal_reward", "fail_reward"), REWARDS)
def test_the_optimal_value_is_that_of_value_iteration(b, d, p, goal_reward, fail_reward):
    needle = make_task(b, d, p, goal_reward=goal_reward, fail_reward=fail_reward)
    mixed = replace(needle, reward_fn=Mixed())

    def mixed_reward(leaf: int) -> float:
        return goal_reward * (1.0 if leaf == needle.goal_leaf else (leaf * 5 % 7 - 2) / 8)

    for gamma in GAMMAS:
        expected = best_by_plain_recursion(needle, gamma, lambda leaf: goal_reward * (leaf == needle.goal_leaf))
        assert needle.optimal_value(gamma) == pytest.approx(expected, rel=1e-12)
        assert mixed.optimal_value(gamma) == pytest.approx(best_by_plain_recursion(mixed, gamma, mixed_reward))
        lowest = best_by_plain_recursion(mixed, gamma, mixed_reward, best=min)
        assert worst_value(mixed, gamma) == pytest.approx(lowest)


def test_failing_at_once_is_optimal_where_it_pays_more():
    task = make_task(2, 2, 0.5, fail_reward=0.5)

    values = {gamma: task.optimal_value(gamma) for gamma in (0.5, 1.0)}

    assert values == {0.5: 0.5 * 0.5, 1.0: 1.0}
