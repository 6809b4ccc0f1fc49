"""Exact values against closed forms, hand calculation, and Markov chains built here in plain Python."""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import product

import pytest
import torch
from torch import Tensor

from ctgraph_rl import CTGraph, Needle, Observations, OneHot, StateType, Task
from ctgraph_rl.rewards import Arrival
from ctgraph_rl.tree import State, transition
from ctgraph_rl.tree import tree_params as make_tree
from ctgraph_rl.values import MAX_ENUMERATED_STATES
from curricula.paper import ct_su_b1

F64 = torch.float64
GRAPHS = [(2, 1, 0.0), (2, 2, 0.5), (3, 2, 0.25), (2, 4, 0.9), (3, 3, 0.0), (4, 2, 0.75)]
GAMMAS = [0.0, 0.5, 0.99, 1.0]
REWARDS = [(1.0, 0.0), (2.5, -0.5), (1.0, 0.3), (-1.0, 0.0), (-1.0, -0.25), (0.0, 2.0)]
"""goal_reward and fail_reward."""


@dataclass(frozen=True)
class OneAtTheGoal:
    """Needle under another name, so that every state is visited."""

    def __call__(self, arrival: Arrival) -> Tensor:
        return (arrival.leaf == arrival.goal_leaf).to(torch.float32)


@dataclass(frozen=True)
class Mixed:
    """Other end states pay too, some of them less than nothing: exact in float32."""

    def __call__(self, arrival: Arrival) -> Tensor:
        return torch.where(arrival.leaf == arrival.goal_leaf, 1.0, (arrival.leaf * 5 % 7 - 2) / 8)


@dataclass(frozen=True)
class LastDecision:
    """Pays by the last decision and the depth."""

    def __call__(self, arrival: Arrival) -> Tensor:
        return arrival.leaf % arrival.branching_factor / (4 * arrival.depth).float()


def make_task(
    b: int, d: int, p: float = 0.0, *, waits: int = 1, decisions: int = 1, unique: str = "", **fields
) -> Task:
    """A one-hot task; ``unique`` names the kinds whose states have ids of their own: "", "w", "d" or "wd"."""
    graph = CTGraph(b, d, p)
    waits = graph.num_wait_states if "w" in unique else waits
    decisions = graph.num_decision_states if "d" in unique else decisions
    first_end = 2 + waits + decisions
    ids = Observations(
        wait_ids=(2, 1 + waits),
        decision_ids=(2 + waits, first_end - 1),
        end_ids=(first_end, first_end),
        unique_waits="w" in unique,
        unique_decisions="d" in unique,
        unique_ends=False,
    )
    fields.setdefault("goal", tuple(1 + (k + 1) % b for k in range(d)))
    return Task(graph, observations=ids, images=OneHot(first_end + 1), **fields)


def rows_of(task: Task, kind: StateType) -> range:
    first, last = task.observations.ids(kind)
    return range(first, last + 1)


def table(task: Task, wait: Iterable[float], decide: Iterable[float]) -> Tensor:
    """One row of action probabilities for all wait ids and one for all decision ids."""
    wait, decide = torch.tensor(list(wait), dtype=F64), torch.tensor(list(decide), dtype=F64)
    policy = torch.full((task.images.num_images, len(wait)), 1 / len(wait), dtype=F64)
    policy[list(rows_of(task, StateType.WAIT))] = wait
    policy[list(rows_of(task, StateType.DECISION))] = decide
    return policy


def uniform(task: Task) -> Tensor:
    num_actions = task.graph.branching_factor + 1
    return torch.full((task.images.num_images, num_actions), 1 / num_actions, dtype=F64)


def navigation(task: Task) -> Tensor:
    b = task.graph.branching_factor
    return table(task, [1.0] + [0.0] * b, [0.0] + [1 / b] * b)


def random_policy(task: Task, num_actions: int, generator: torch.Generator, power: float = 1.0) -> Tensor:
    weights = torch.rand(task.images.num_images, num_actions, generator=generator, dtype=F64) ** power
    return weights / weights.sum(-1, keepdim=True)


def deterministic_policies(task: Task) -> Iterator[Tensor]:
    """Every map from wait and decision ids to actions."""
    num_actions = task.graph.branching_factor + 1
    rows = [*rows_of(task, StateType.WAIT), *rows_of(task, StateType.DECISION)]
    for actions in product(range(num_actions), repeat=len(rows)):
        policy = uniform(task)
        policy[rows] = torch.eye(num_actions, dtype=F64)[list(actions)]
        yield policy


# --- closed forms of the graph


@pytest.mark.parametrize(("b", "d", "p"), GRAPHS)
def test_random_probabilities_are_the_closed_forms_correctly_rounded(b, d, p):
    exact = (b + 1) * ((1 - Fraction(p)) / ((b + 1) * (b + 1 - Fraction(p)))) ** (d + 1)

    graph = CTGraph(b, d, p)

    assert graph.reward_prob_random == exact.numerator / exact.denominator
    assert graph.end_prob_random == (b**d * exact).numerator / exact.denominator
    assert math.exp(graph.log_reward_prob_random) == pytest.approx(float(exact), rel=1e-13, abs=0)
    assert math.exp(graph.log_end_prob_random) == pytest.approx(float(b**d * exact), rel=1e-13, abs=0)


def test_log_probabilities_hold_at_b_3_d_30_p_999_and_where_floats_end():
    deep, beyond = CTGraph(3, 30, 0.999), CTGraph(2, 60, 1 - 2**-30)

    expected = [math.log(4) + 31 * math.log(1 / (4 * 3001)), math.log(3) - 61 * math.log(3 * (2 * 2**30 + 1))]

    assert deep.log_reward_prob_random == pytest.approx(expected[0], rel=1e-13)
    assert math.log(deep.reward_prob_random) == pytest.approx(expected[0], rel=1e-13)
    assert deep.log_end_prob_random == pytest.approx(expected[0] + 30 * math.log(3), rel=1e-13)
    assert beyond.log_reward_prob_random == pytest.approx(expected[1], rel=1e-13)
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


@pytest.mark.parametrize("length", [6.0, True, "6", None])
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
    ("b", "d", "p", "printed"), [(3, 10, 0.9, "3.75e-23"), (2, 16, 0.5, "3.04e-20"), (2, 5, 0.0, "5.65e-06")]
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


def best_by_plain_recursion(task: Task, gamma: float, end_reward: Callable[[int], float]) -> float:
    b, d, p = task.graph.branching_factor, task.graph.depth, task.graph.wait_prob

    def wait(path: tuple[int, ...]) -> float:
        arrival = end_reward(sum((a - 1) * b ** (d - 1 - k) for k, a in enumerate(path)))
        if len(path) < d:
            arrival = gamma * max(task.fail_reward, *(gamma * wait((*path, a)) for a in range(1, b + 1)))
        value = task.fail_reward
        for _ in range(3000):  # value iteration: stays at most p of the error per sweep
            value = max(task.fail_reward, (1 - p) * arrival + p * gamma * value)
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


def test_failing_at_once_is_optimal_where_it_pays_more():
    task = make_task(2, 2, 0.5, fail_reward=0.5)

    values = {gamma: task.optimal_value(gamma) for gamma in (0.5, 1.0)}

    assert values == {0.5: 0.5 * 0.5, 1.0: 1.0}


# --- the value of a policy


@pytest.mark.parametrize(
    ("b", "d", "p", "unique"),
    [(*graph, unique) for graph in GRAPHS for unique in ("", "w", "d", "wd")]
    + [(2, 16, 0.5, ""), (3, 10, 0.9, ""), (3, 30, 0.999, "")],
)
def test_the_uniform_policy_reaches_the_goal_with_p_r(b, d, p, unique):
    task = make_task(b, d, p, waits=2, decisions=3, unique=unique)

    probs = [task.policy_value(uniform(task)), task.success_prob(uniform(task))]

    assert probs == pytest.approx([task.graph.reward_prob_random] * 2, rel=1e-12, abs=0)


@pytest.mark.parametrize(("b", "d", "p"), [*GRAPHS, (3, 30, 0.999)])
def test_the_navigation_policy_reaches_the_goal_with_b_to_the_minus_d(b, d, p):
    task = make_task(b, d, p, waits=2, decisions=3)

    prob = task.policy_value(navigation(task))

    assert prob == pytest.approx(float(b) ** -d, rel=1e-12, abs=0)


@pytest.mark.parametrize(("b", "d", "p"), GRAPHS)
@pytest.mark.parametrize("waits", ["", "w"])
def test_the_optimal_policy_over_unique_decisions_has_the_optimal_value(b, d, p, waits):
    task = make_task(b, d, p, unique=f"{waits}d", goal_reward=2.0, fail_reward=-1.0)
    policy, node = navigation(task), 0
    for decision in task.goal:
        policy[task.observations.decision_ids[0] + node] = torch.eye(b + 1, dtype=F64)[decision]
        node = b * node + decision

    values = {gamma: task.policy_value(policy, gamma) for gamma in GAMMAS}

    assert values == pytest.approx({gamma: task.optimal_value(gamma) for gamma in GAMMAS}, rel=1e-12)
    assert [values[1.0], task.success_prob(policy)] == pytest.approx([2.0, 1.0], rel=1e-12)


def test_a_policy_by_hand_at_d_1_with_every_probability_different():
    task = make_task(2, 1, 0.5, goal=(2,), goal_reward=3.0, fail_reward=-1.0)
    policy = table(task, [0.8, 0.2, 0.0], [0.1, 0.3, 0.6])
    gamma = 0.5

    wait_before = {"goal": (0.4 * 3 - 0.2) / 0.8, "other": -0.2 / 0.8}  # V = 0.4 R + 0.4 * 0.5 V - 0.2
    decision = gamma * (0.6 * wait_before["goal"] + 0.3 * wait_before["other"]) - 0.1
    first_wait = (0.4 * gamma * decision - 0.2) / 0.8

    assert task.policy_value(policy, gamma) == pytest.approx(gamma * first_wait, rel=1e-14)
    assert task.success_prob(policy) == pytest.approx((0.4 / 0.6) * 0.6 * (0.4 / 0.6), rel=1e-14)


def value_by_chain(task: Task, policy: Tensor, gamma: float, end_reward: Callable[[int], float]) -> float:
    """The value by a linear solve over (path, kind, observation id), each id a state of its own."""
    b, d, p = task.graph.branching_factor, task.graph.depth, task.graph.wait_prob
    x = task.observations

    def node(path: tuple[int, ...]) -> int:
        """Its place when the nodes are counted level by level from the root, the branches of a level in order."""
        shorter = sum(b**k for k in range(len(path)))
        return shorter + sum((a - 1) * b ** (len(path) - 1 - k) for k, a in enumerate(path))

    def shown(path: tuple[int, ...], kind: str) -> list[tuple[tuple[int, ...], str, int]]:
        unique = x.unique_waits if kind == "wait" else x.unique_decisions
        first, last = x.wait_ids if kind == "wait" else x.decision_ids
        return [(path, kind, i) for i in ([first + node(path)] if unique else range(first, last + 1))]

    paths = [path for k in range(d + 1) for path in product(range(1, b + 1), repeat=k)]
    states = [s for path in paths for s in shown(path, "wait")]
    states += [s for path in paths if len(path) < d for s in shown(path, "decision")]
    number = {s: i for i, s in enumerate(states)}
    matrix, rewards = torch.eye(len(states), dtype=F64), torch.zeros(len(states), dtype=F64)

    def go(i: int, prob: float, targets: list[tuple[tuple[int, ...], str, int]]) -> None:
        for target in targets:
            matrix[i, number[target]] -= gamma * prob / len(targets)

    for i, (path, kind, image) in enumerate(states):
        for action, prob in enumerate(policy[image].tolist()):
            if kind == "wait" and action == 0:
                go(i, prob * p, shown(path, "wait"))
                if len(path) == d:
                    rewards[i] += prob * (1 - p) * end_reward(node(path) - node((1,) * d))
                else:
                    go(i, prob * (1 - p), shown(path, "decision"))
            elif kind == "decision" and 1 <= action <= b:
                go(i, prob, shown((*path, action), "wait"))
            else:
                rewards[i] += prob * task.fail_reward
    values = torch.linalg.solve(matrix, rewards)
    first_seen = [values[number[s]].item() for s in shown((), "wait")]
    return gamma * sum(first_seen) / len(first_seen)


@pytest.mark.parametrize("unique", ["", "w", "d", "wd"])
@pytest.mark.parametrize(
    ("b", "d", "p", "num_actions"), [(2, 1, 0.5, 3), (2, 2, 0.5, 3), (3, 2, 0.9, 6), (2, 3, 0.0, 4)]
)
@pytest.mark.parametrize("reward_fn", [Needle(), Mixed()])
def test_a_random_policys_value_is_that_of_a_chain_with_one_state_per_image(b, d, p, num_actions, unique, reward_fn):
    fields = {"reward_fn": reward_fn, "goal_reward": 2.0, "fail_reward": -0.5}
    task = make_task(b, d, p, waits=3, decisions=2, unique=unique, **fields)
    policy = random_policy(task, num_actions, torch.Generator().manual_seed(7))

    def end_reward(leaf: int) -> float:
        other = 0.0 if reward_fn == Needle() else (leaf * 5 % 7 - 2) / 8
        return 2.0 if leaf == task.goal_leaf else 2.0 * other

    for gamma in GAMMAS:
        expected = value_by_chain(task, policy, gamma, end_reward)
        assert task.policy_value(policy, gamma) == pytest.approx(expected, rel=1e-12, abs=1e-14)


def test_rows_of_home_end_and_fail_have_no_effect_and_float32_is_welcome():
    task = make_task(2, 2, 0.5, waits=2, decisions=2)
    policy = random_policy(task, 3, torch.Generator().manual_seed(1))
    other = policy.clone()
    other[[0, 1, 6]] = torch.tensor([0.0, 0.0, 1.0], dtype=F64)

    value = task.policy_value(policy)

    assert task.policy_value(other) == value
    assert task.policy_value(policy.float()) == task.policy_value(policy.float().double())
    assert task.policy_value(policy.float()) == pytest.approx(value, rel=1e-6)


def test_a_reward_gets_the_branching_factor_and_the_depth():
    task = make_task(3, 2, 0.5, reward_fn=LastDecision(), goal_reward=2.0)

    values = [task.policy_value(navigation(task)), task.optimal_value(1.0)]

    assert values == pytest.approx([2 * (0 + 1 + 2) / 3 / 8, 2 * 2 / 8], rel=1e-14)


def test_a_policy_of_certain_failure_gets_the_fail_reward_when_it_fails():
    task = make_task(2, 2, fail_reward=-2.0)
    fails_waiting = table(task, [0.0, 1.0, 0.0], [0.0, 1.0, 0.0])
    fails_deciding = table(task, [1.0, 0.0, 0.0], [1.0, 0.0, 0.0])

    values = [task.policy_value(policy, 0.5) for policy in (fails_waiting, fails_deciding)]

    assert values == [0.5 * -2, 0.25 * -2]
    assert task.success_prob(fails_waiting) == 0.0


def test_the_success_probability_does_not_depend_on_rewards():
    needle = make_task(2, 2, 0.5, decisions=2)
    policy = random_policy(needle, 3, torch.Generator().manual_seed(2))

    others = [replace(needle, reward_fn=fn, goal_reward=-3.0, fail_reward=2.0) for fn in (Needle(), Mixed())]

    assert [task.success_prob(policy) for task in others] == pytest.approx([needle.policy_value(policy)] * 2, rel=1e-14)


# --- the ceiling without memory


@pytest.mark.parametrize(
    ("goal", "deterministic", "stochastic"),
    [((1, 1), 1.0, 1.0), ((2, 2), 1.0, 1.0), ((1, 2), 0.0, 0.25), ((2, 1), 0.0, 0.25)],
)
def test_ceilings_of_ct_su_b1(goal, deterministic, stochastic):
    task = ct_su_b1(goal)

    ceilings = [task.memoryless_ceiling(deterministic=True), task.memoryless_ceiling()]

    assert ceilings == [deterministic, stochastic]


def test_two_decision_images_let_a_deterministic_policy_have_a_quarter():
    task = make_task(2, 2, decisions=2, goal=(1, 2), goal_reward=8.0)

    ceilings = [task.memoryless_ceiling(deterministic=True), task.memoryless_ceiling()]

    assert ceilings == [2.0, 2.0]


@pytest.mark.parametrize("goal", [(1, 1), (1, 2), (2, 1), (1, 1, 2), (2, 1, 2)])
@pytest.mark.parametrize(("waits", "decisions"), [(1, 1), (2, 2), (1, 3), (1, 4)])
@pytest.mark.parametrize("fail_reward", [0.0, -1.0])
def test_the_best_of_all_deterministic_policies_has_the_deterministic_ceiling(goal, waits, decisions, fail_reward):
    task = make_task(2, len(goal), 0.5, waits=waits, decisions=decisions, goal=goal, fail_reward=fail_reward)

    best = max(task.policy_value(policy) for policy in deterministic_policies(task))

    assert best == pytest.approx(task.memoryless_ceiling(deterministic=True), rel=1e-12, abs=1e-15)


def test_unique_waits_do_not_help_a_deterministic_policy_that_forgets_them():
    task = make_task(2, 2, 0.5, unique="w", goal=(1, 2), fail_reward=-1.0)
    same = make_task(2, 2, 0.5, unique="w", goal=(2, 2), fail_reward=-1.0)
    wait_or_fail = product([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], repeat=7)

    policies = [(waits, decide) for waits in wait_or_fail for decide in torch.eye(3, dtype=F64)]
    best = {task: -math.inf, same: -math.inf}
    for waits, decide in policies:
        policy = table(task, [1.0, 0.0, 0.0], decide.tolist())
        policy[list(rows_of(task, StateType.WAIT))] = torch.tensor(waits, dtype=F64)
        best = {each: max(value, each.policy_value(policy)) for each, value in best.items()}

    assert list(best.values()) == [0.0, 1.0]
    assert [each.memoryless_ceiling(deterministic=True) for each in best] == [0.0, 1.0]


@pytest.mark.parametrize("num_ids", range(1, 12))
@pytest.mark.parametrize("goal", [(1, 1, 1), (1, 2, 3), (1, 1, 2, 3), (3, 3, 3, 1, 1, 2), (2, 2, 2, 2, 2, 2, 2, 3, 1)])
def test_the_division_of_images_among_decisions_is_the_best_of_all_divisions(goal, num_ids):
    task = make_task(3, len(goal), decisions=num_ids, goal=goal)
    counts = Counter(goal)

    divisions = [n for n in product(range(num_ids + 1), repeat=3) if sum(n) == num_ids]
    best = max(math.prod(Fraction(n[a - 1], num_ids) ** count for a, count in counts.items()) for n in divisions)

    assert task.memoryless_ceiling(deterministic=True) == pytest.approx(float(best), rel=1e-13, abs=0)
    assert task.memoryless_ceiling(deterministic=True) <= task.memoryless_ceiling() * (1 + 1e-13)


@pytest.mark.parametrize("goal", [(1, 2), (1, 1, 2), (1, 2, 3, 3), (2, 2, 2)])
@pytest.mark.parametrize("unique", ["", "w"])
def test_the_stochastic_ceiling_is_attained_and_never_exceeded(goal, unique):
    task = make_task(3, len(goal), 0.5, waits=2, decisions=2, unique=unique, goal=goal, fail_reward=-0.5)
    ceiling, generator = task.memoryless_ceiling(), torch.Generator().manual_seed(3)
    best = table(task, [1.0, 0.0, 0.0, 0.0], [0.0] + [goal.count(a) / len(goal) for a in (1, 2, 3)])

    noise = [random_policy(task, 4, generator, power=power) for power in (1, 3, 9) for _ in range(20)]
    nearby = [(1 - share) * best + share * policy for policy in noise for share in (1.0, 0.1, 1e-3)]

    assert task.policy_value(best) == pytest.approx(ceiling, rel=1e-12)
    assert max(task.policy_value(policy) for policy in nearby) < ceiling
    assert ceiling == pytest.approx(math.prod((goal.count(a) / len(goal)) ** goal.count(a) for a in {*goal}), rel=1e-15)


@pytest.mark.parametrize("unique", ["d", "wd"])
@pytest.mark.parametrize("deterministic", [False, True])
def test_unique_decisions_allow_the_whole_goal_reward(unique, deterministic):
    task = make_task(2, 2, 0.5, unique=unique, goal=(1, 2), goal_reward=3.0, fail_reward=-1.0)

    assert task.memoryless_ceiling(deterministic) == 3.0


# --- refusals


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"reward_fn": Mixed()}, "Needle reward.*got Mixed"),
        ({"goal_reward": 0.0}, "goal_reward > 0"),
        ({"goal_reward": -1.0}, "goal_reward > 0"),
        ({"fail_reward": 0.1}, "fail_reward <= 0"),
        ({"reward_fn": Mixed(), "goal_reward": -1.0, "fail_reward": 1.0}, "Needle.*goal_reward > 0.*fail_reward <= 0"),
    ],
)
def test_a_ceiling_that_would_not_be_exact_is_refused(fields, message):
    task = make_task(2, 2, **fields)

    with pytest.raises(ValueError, match=message):
        task.memoryless_ceiling()


def test_enumeration_stops_at_its_documented_limit():
    largest, beyond = (make_task(2, d, reward_fn=OneAtTheGoal()) for d in (19, 20))

    assert largest.graph.num_states == MAX_ENUMERATED_STATES == 2**21
    assert largest.optimal_value(1.0) == 1.0
    for value in (lambda: beyond.optimal_value(1.0), lambda: beyond.policy_value(uniform(beyond))):
        with pytest.raises(ValueError, match=r"OneAtTheGoal.*4194304 states.*limit of 2097152 \(2\*\*21\)"):
            value()


@pytest.mark.parametrize("gamma", [-0.1, 1.5, math.nan, "1"])
def test_a_gamma_out_of_range_is_refused(gamma):
    task = make_task(2, 2)

    for value in (lambda: task.optimal_value(gamma), lambda: task.policy_value(uniform(task), gamma)):
        with pytest.raises(ValueError, match=r"gamma must be in \[0, 1\]"):
            value()


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (torch.full((4, 3), 1 / 3), r"float tensor \[5, A\] with A >= 3.*got .*\[4, 3\]"),
        (torch.full((5, 2), 1 / 2), r"got .*\[5, 2\]"),
        (torch.full((5,), 1.0), r"got .*\[5\]"),
        (torch.tensor([[1, 0, 0]] * 5), r"got .*int64"),
        ([[1.0, 0.0, 0.0]] * 5, "got 'list'|got list"),
        (torch.full((5, 3), 0.3), r"sum to 1, not so rows \[0, 1, 2, 3, 4\]"),
        (torch.tensor([[1.0, 0, 0]] * 2 + [[1.5, -0.5, 0]] + [[1.0, 0, 0]] * 2), r"not so rows \[2\]"),
        (torch.tensor([[1.0, 0, 0]] * 4 + [[math.nan, 1, 0]]), r"not so rows \[4\]"),
    ],
)
def test_a_policy_that_is_no_table_of_probabilities_is_refused(policy, message):
    task = ct_su_b1()

    with pytest.raises(ValueError, match=message):
        task.policy_value(policy)
