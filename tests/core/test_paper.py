from dataclasses import replace
from fractions import Fraction
from itertools import permutations, product

import pytest
import torch
from helpers.oracles import DECISION, END, FAIL, HOME, WAIT

from ctgraph_rl import CTGraph
from ctgraph_rl.core.tree import State, transition
from ctgraph_rl.core.tree import tree_params as make_tree
from ctgraph_rl.tasks.configurations import ct_co_b1, ct_fo_b1, ct_fo_b2, ct_graph, ct_posr_b1, ct_su_b1

PRINTED = [
    ((2, 1, "0"), "3.70e-2", "7.40e-2", "1/2", 8, 2),
    ((2, 2, "9/10"), "1.20e-5", "4.78e-5", "1/4", 16, 4),
    ((3, 2, "9/10"), "2.10e-6", "1.89e-5", "1/9", 28, 9),
    ((2, 4, "9/10"), "3.02e-9", "4.84e-8", "1/16", 64, 16),
    ((3, 10, "9/10"), "3.75e-23", "2.22e-18", "1/59049", 177148, 59049),
    ((2, 16, "1/2"), "3.04e-20", "1.99e-15", "1/65536", 262144, 65536),
]
"""Table 2 of the paper as printed: b, d and p; P_R, P_E, P_RNP, states and end states."""

CORRECTED = {"7.40e-2": "7.41e-2", "4.78e-5": "4.80e-5", "1.99e-15": "2.00e-15"}
"""The numbers of Table 2 that are not those of the paper's own formulas, rounded to three digits."""

TABLE = [shape for shape, *_ in PRINTED] + [(2, 2, "0"), (2, 2, "1/2"), (2, 3, "1/2"), (2, 4, "0"), (2, 5, "0")]
TABLE += [(3, 2, "99/100")]
"""b, d and p of the paper's tables and configurations, and of graphs around them."""

# place, printed, corrected, what the package says
MISPRINTS = [
    ("mean steps in a wait state, p=.9: 1/(p-1)", -10.0, 10.0, CTGraph(2, 2, 0.9).expected_episode_length / 3 - 1),
    ("P_R as a sum, b=2 d=2 p=.9: (1+p)^(d+1)", 3 * (1.9 / 6.3) ** 3, 1 / 83349, CTGraph(2, 2, 0.9).reward_prob_random),
    ("P_R of CT-FO-B1", 1 / 32, 1 / 243, CTGraph(2, 2).reward_prob_random),
    ("P_R of CT-SU-B1", 1 / 32, 1 / 243, ct_su_b1().graph.reward_prob_random),
    ("P_R of CT-CO-B1", 1 / 32, 1 / 243, CTGraph(2, 2, 0.0).reward_prob_random),
    ("E[rho] of CT-FO-B2", 11, 12, CTGraph(2, 3, 0.5).expected_episode_length),
    ("P_R of CT-POSR-B1", 8.8e-4, 1 / 1125, CTGraph(2, 2, 0.5).reward_prob_random),
]

# place, printed, what the package says
PRINTED_RIGHT = [
    ("P_R of CT-FO-B2", 5.93e-5, CTGraph(2, 3, 0.5).reward_prob_random),
    ("P_R of b=2 d=5 p=0, 1 in 177,147", 5.6e-6, CTGraph(2, 5).reward_prob_random),
    ("E[rho] of CT-POSR-B1", 9, CTGraph(2, 2, 0.5).expected_episode_length),
    ("E[rho] of p=.99", 303, CTGraph(3, 2, 0.99).expected_episode_length),
]


# configuration, P_R, E[rho], number of images
CONFIGURATIONS = [
    (ct_fo_b1, Fraction(1, 243), 6, 16),
    (ct_fo_b2, Fraction(1, 16875), 12, 32),
    (ct_su_b1, Fraction(1, 243), 6, 5),
    (ct_co_b1, Fraction(1, 243), 6, 104),
    (ct_posr_b1, Fraction(3, 3375), 9, 5),
]


def arrival_prob(b: int, d: int, p: Fraction, good_decisions: int) -> Fraction:
    """P that a uniformly random policy gets to an end state, by dynamic programming from the end states back.

    With one good decision per decision state that is P_R, with b of them P_E.
    """
    action = Fraction(1, b + 1)
    value = Fraction(1)
    for level in reversed(range(d + 1)):
        value = action * (1 - p) * value / (1 - action * p)  # V(wait) = action * (p * V(wait) + (1 - p) * V(next))
        value = value * action * good_decisions if level > 0 else value
    return value


def navigation_length(d: int, p: Fraction) -> Fraction:
    """Mean steps of a policy that never fails, by the same recursion; the step from home counts."""
    in_wait_state = 1 / (1 - p)  # x = 1 + p * x
    return 1 + sum((in_wait_state + 1 for _ in range(d)), Fraction(0)) + in_wait_state


@pytest.mark.parametrize(("place", "printed", "corrected", "ours"), MISPRINTS, ids=[row[0] for row in MISPRINTS])
def test_a_misprint_is_corrected(place, printed, corrected, ours):
    assert ours == pytest.approx(corrected, rel=1e-12, abs=0)
    assert ours != pytest.approx(printed, rel=1e-3, abs=0)


@pytest.mark.parametrize(("place", "printed", "ours"), PRINTED_RIGHT, ids=[row[0] for row in PRINTED_RIGHT])
def test_a_correctly_printed_value_is_met_to_its_printed_digits(place, printed, ours):
    assert ours == pytest.approx(printed, rel=1e-2, abs=0)


def as_printed(number: float) -> str:
    mantissa, exponent = f"{number:.2e}".split("e")
    return f"{mantissa}e{int(exponent)}"


@pytest.mark.parametrize(("shape", "p_r", "p_e", "p_rnp", "states", "ends"), PRINTED)
def test_a_row_of_table_2_is_met_to_every_printed_digit(shape, p_r, p_e, p_rnp, states, ends):
    b, d, p = shape
    graph = CTGraph(b, d, float(Fraction(p)))

    assert as_printed(graph.reward_prob_random) == p_r
    assert as_printed(graph.end_prob_random) == CORRECTED.get(p_e, p_e)
    assert graph.reward_prob_navigation == float(Fraction(p_rnp))
    assert (graph.num_states, graph.num_end_states) == (states, ends)


def test_sizes_and_counts_printed_in_the_text_of_the_paper():
    small, larger = ct_fo_b1().graph, ct_fo_b2().graph

    assert (small.num_decision_states, small.num_wait_states, small.num_end_states) == (3, 7, 4)
    assert (larger.num_decision_states, larger.num_wait_states, larger.num_end_states) == (7, 15, 8)
    assert small.expected_search_episodes == (2**2 + 1) / 2
    assert 1 / CTGraph(2, 2, 0.9).reward_prob_random == pytest.approx(83349, rel=1e-9)
    assert 1 / larger.reward_prob_random == pytest.approx(16875, rel=1e-9)
    assert 1 / CTGraph(2, 5).reward_prob_random == pytest.approx(177147, rel=1e-9)
    assert CTGraph(3, 2, 0.99).expected_episode_length == pytest.approx(303)
    assert 3 * 3**16 == 3**17 == 129_140_163


@pytest.mark.parametrize(("b", "d", "p"), TABLE)
def test_p_r_equals_an_exact_dynamic_program(b, d, p):
    expected = arrival_prob(b, d, Fraction(p), good_decisions=1)

    graph = CTGraph(b, d, float(Fraction(p)))

    assert graph.reward_prob_random == pytest.approx(float(expected), rel=1e-12, abs=0)


@pytest.mark.parametrize(("b", "d", "p"), TABLE)
def test_p_e_equals_an_exact_dynamic_program(b, d, p):
    expected = arrival_prob(b, d, Fraction(p), good_decisions=b)

    graph = CTGraph(b, d, float(Fraction(p)))

    assert graph.end_prob_random == pytest.approx(float(expected), rel=1e-12, abs=0)


@pytest.mark.parametrize(("b", "d", "p"), TABLE)
def test_p_rnp_is_one_over_the_number_of_end_states(b, d, p):
    graph = CTGraph(b, d, float(Fraction(p)))

    assert graph.reward_prob_navigation == pytest.approx(float(Fraction(1, b) ** d), rel=1e-15, abs=0)


@pytest.mark.parametrize(("b", "d", "p"), TABLE)
def test_e_rho_equals_an_exact_dynamic_program(b, d, p):
    expected = navigation_length(d, Fraction(p))

    graph = CTGraph(b, d, float(Fraction(p)))

    assert graph.expected_episode_length == pytest.approx(float(expected), rel=1e-12, abs=0)


@pytest.mark.parametrize(("b", "d"), [(2, 1), (3, 1), (2, 2)])
def test_e_kappa_equals_the_mean_over_all_orders_of_search(b, d):
    orders = list(permutations(range(b**d)))
    expected = sum(order.index(0) + 1 for order in orders) / len(orders)

    graph = CTGraph(b, d)

    assert graph.expected_search_episodes == expected


@pytest.mark.parametrize(
    ("b", "d", "expected"), [(2, 2, 2.5), (3, 2, 5.0), (2, 4, 8.5), (2, 16, 32768.5), (3, 10, 29525)]
)
def test_e_kappa_is_that_of_the_paper(b, d, expected):
    graph = CTGraph(b, d)

    assert graph.expected_search_episodes == expected


@pytest.mark.parametrize(("b", "d", "p"), [(2, 1, "0"), (2, 2, "1/2"), (2, 3, "9/10"), (3, 2, "1/4"), (4, 2, "0")])
def test_the_implemented_transition_has_exactly_the_p_r_of_every_end_state(b, d, p):
    stay, first_leaf = Fraction(p), (b**d - 1) // (b - 1)
    expected = (b + 1) * ((1 - stay) / ((b + 1) * (b + 1 - stay))) ** (d + 1)

    arrivals = implemented_arrivals(b, d, stay)

    assert arrivals == dict.fromkeys(range(first_leaf, first_leaf + b**d), expected)


@pytest.mark.parametrize(("configuration", "p_r", "e_rho", "num_images"), CONFIGURATIONS)
def test_a_configuration_has_the_closed_forms_of_the_paper(configuration, p_r, e_rho, num_images):
    graph, task = configuration().graph, configuration(image_seed=3)

    assert graph.reward_prob_random == pytest.approx(float(p_r), rel=1e-12, abs=0)
    assert graph.expected_episode_length == pytest.approx(e_rho, rel=1e-12)
    assert (task.images.num_images, task.image_seed) == (num_images, 3)
    assert task.observations.last_id == num_images - 1
    assert task.optimal_value(1.0) == pytest.approx(1)


@pytest.mark.parametrize(("configuration", "_p_r", "_e_rho", "_num_images"), CONFIGURATIONS)
def test_a_configuration_takes_any_goal(configuration, _p_r, _e_rho, _num_images):
    depth = configuration().graph.depth

    goals = {configuration(goal).goal_leaf for goal in product((1, 2), repeat=depth)}

    assert goals == set(range(2**depth))


def test_the_ids_of_fully_observable_configurations_are_the_published_ones():
    small, large = ct_fo_b1().observations, ct_fo_b2().observations

    assert (small.wait_ids, small.decision_ids, small.end_ids) == ((2, 8), (9, 11), (12, 15))
    assert (large.wait_ids, large.decision_ids, large.end_ids) == ((2, 16), (17, 23), (24, 31))


def test_wait_states_of_the_confounding_configuration_share_a_hundred_images():
    x = ct_co_b1().observations

    assert (x.wait_ids, x.decision_ids, x.end_ids) == ((3, 102), (2, 2), (103, 103))
    assert x.draws_ids


def test_sparse_rewards_of_the_partially_observable_configuration_have_no_noise():
    assert ct_posr_b1() == replace(ct_su_b1(), graph=CTGraph(2, 2, 0.5))
    assert ct_posr_b1().reward_std == 0


def test_a_task_of_any_size_has_an_image_for_each_state_or_kind_of_state():
    full, shared = ct_graph(3, 2, 0.5), ct_graph(3, 2, 0.5, goal=(3, 1), fully_observable=False, one_hot=True)

    assert full.images.num_images == full.graph.num_states
    assert (full.goal, shared.goal, shared.images.shape) == ((1, 1), (3, 1), (5,))


def implemented_arrivals(b: int, d: int, stay: Fraction) -> dict[int, Fraction]:
    """P of each end node under the uniformly random policy, pushed forward through `transition`."""
    tree = make_tree(*(torch.tensor([value]) for value in (b, (b**d - 1) // (b - 1), 0)))
    mass, arrived = {(int(HOME), 0): Fraction(1)}, {}
    while mass:
        state, prob = mass.popitem()
        after = {}
        for action in range(b + 1):
            for stays, chance in ((True, stay), (False, 1 - stay)):
                now = State(torch.tensor([state[0]]), torch.tensor([state[1]]))
                kind, node = (int(x) for x in transition(now, torch.tensor([action]), torch.tensor([stays]), tree))
                after[kind, node] = after.get((kind, node), 0) + chance / (b + 1)
        back = after.pop(state, Fraction(0))
        for (kind, node), chance in after.items():
            share = prob * chance / (1 - back)
            if kind == END and share:
                arrived[node] = arrived.get(node, 0) + share
            elif kind in (WAIT, DECISION) and share:
                mass[kind, node] = mass.get((kind, node), 0) + share
            else:
                assert kind == FAIL or not share
    return arrived
