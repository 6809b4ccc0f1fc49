"""Measures of similarity against hand calculation, plain enumeration, and what the environment shows."""

import math
from dataclasses import dataclass, replace
from itertools import product

import pytest
import torch
from helpers.oracles import confounding, fully_observable, scripts, surjective, tree_states
from torch import Tensor

import curricula
from ctgraph_rl.core.graph import CTGraph, StateType
from ctgraph_rl.core.rewards import Arrival, Gradient
from ctgraph_rl.env import CTGraphEnv
from ctgraph_rl.tasks.images import OneHot, PaperImages, ReferenceImages
from ctgraph_rl.tasks.observations import Observations
from ctgraph_rl.tasks.similarity import (
    MEASURES,
    graph_containment,
    observation_agreement,
    shared_decisions,
    shared_images,
    state_agreement,
)
from ctgraph_rl.tasks.task import Task

WAIT, DECISION = StateType.WAIT, StateType.DECISION
GOALS = ((1, 1), (1, 2), (2, 1))


@dataclass(frozen=True)
class OneAtTheGoal:
    """Needle under another name, so that every state is visited."""

    def __call__(self, arrival: Arrival) -> Tensor:
        return (arrival.leaf == arrival.goal_leaf).to(torch.float32)


def pays(task: Task, path: tuple[int, ...]) -> float:
    """The rewards of the paper in plain Python."""
    b, d = task.graph.branching_factor, task.graph.depth
    if task.reward_fn == Gradient():
        lost = sum(b ** (d - 1 - k) * abs(taken - task.goal[k]) for k, taken in enumerate(path))
        return task.goal_reward * (1 - lost / (b**d - 1))
    return task.goal_reward * (path == task.goal)


def optimal_sets(task: Task, num_actions: int) -> dict:
    """The best actions at every wait and decision state, by the decisions that lead to it."""
    b, d, p, s = task.graph.branching_factor, task.graph.depth, task.graph.wait_prob, task.step_reward
    sets = {}

    def best(key: tuple, values: dict[int, float]) -> float:
        every = {action: values.get(action, s + task.fail_reward) for action in range(num_actions)}
        top = max(every.values())
        sets[key] = frozenset(action for action, value in every.items() if value > top - 1e-9)
        return top

    def at_wait(path: tuple[int, ...]) -> float:
        arrival = pays(task, path) if len(path) == d else at_decision(path)
        return best((WAIT, path), {0: (s + (1 - p) * arrival) / (1 - p)})

    def at_decision(path: tuple[int, ...]) -> float:
        return best((DECISION, path), {a: s + at_wait((*path, a)) for a in range(1, b + 1)})

    at_wait(())
    return sets


def plain_agreement(one: Task, other: Task, num_actions: int) -> float:
    sets = [optimal_sets(task, num_actions) for task in (one, other)]
    shared = sets[0].keys() & sets[1].keys()
    return sum(sets[0][key] == sets[1][key] for key in shared) / len(shared)


def as_bytes(images: torch.Tensor) -> list[bytes]:
    """The bytes of each row."""
    rows = images.flatten(1).contiguous().numpy()
    return rows.view(f"V{rows.shape[1] * rows.itemsize}").ravel().tolist()


def images_of_states(task: Task) -> dict:
    """What the environment shows at each state, by kind and decisions; recorded in many random episodes."""
    b, d = task.graph.branching_factor, task.graph.depth
    first = {path: number for number, (_, path) in enumerate(s for s in tree_states(b, d) if s[0] == WAIT)}
    paths = {number: path for path, number in first.items()}
    env, shown = CTGraphEnv([task] * 64, seed=3), set()
    data = env.reset()
    for action in scripts(200, 64, b + 1):
        data = env.step(data.set("action", action))["next"]
        shown.update(zip(env.state_type.tolist(), env.node.tolist(), as_bytes(data["observation"]), strict=True))
        done = data["done"].squeeze(-1)
        if done.any():
            data = env.reset(data.set("_reset", data["done"].clone()))
            shown.update((StateType.HOME, 0, image) for image in as_bytes(data["observation"][done]))
    seen: dict = {}
    for kind, node, image in shown:
        path = paths[node] if kind in (WAIT, DECISION, StateType.END) else ()
        seen.setdefault((StateType(kind), path), set()).add(image)
    return seen


def test_shared_decisions_are_a_share_of_the_shorter_goal():
    tasks = [surjective(d=d, goal=goal) for d, goal in ((3, (1, 2, 1)), (2, (1, 2)), (3, (1, 1, 1)), (1, (2,)))]

    expected = [[1, 1, 1 / 3, 0], [1, 1, 1 / 2, 0], [1 / 3, 1 / 2, 1, 0], [0, 0, 0, 1]]
    assert shared_decisions(tasks).tolist() == expected


def test_states_of_two_needles_agree_off_both_ways_and_before_they_part():
    tasks = [surjective(goal=goal) for goal in GOALS]

    agreement = state_agreement(tasks)

    # of 3 decision and 7 wait states, (1,1) and (1,2) part after the first decision: one decision and two waits differ
    assert agreement.tolist() == [[1.0, 0.7, 0.3], [0.7, 1.0, 0.3], [0.3, 0.3, 1.0]]
    assert agreement.dtype == torch.float64


@pytest.mark.parametrize("depth", [1, 2, 11, 40])
def test_two_needles_at_opposite_ends_differ_on_their_ways_only(depth):
    tasks = [surjective(d=depth, goal=(decision,) * depth) for decision in (1, 2)]

    states = 2 * (2**depth - 1) + 2**depth
    assert state_agreement(tasks)[0, 1].item() == (states - (4 * depth - 1)) / states


def test_a_nested_goal_agrees_with_its_deeper_version_in_the_whole_common_tree():
    tasks = [surjective(d=d, goal=(1, 2, 2, 1, 2)[:d]) for d in range(1, 6)]

    assert torch.equal(state_agreement(tasks), torch.ones(5, 5, dtype=torch.float64))


def test_goals_of_ct8_multi_depth_agree_where_one_policy_solves_all_of_them():
    """One policy per group, though depths differ: what docs/results/lifelong.md explains PPO's transfer by."""
    agree = observation_agreement(curricula.ct8_md().tasks) == 1

    for group in ((0, 2, 4, 6), (0, 2, 4, 7)):  # 00, 000, 0000, then 00000 or 00001
        assert agree[list(group)][:, list(group)].all()
    assert not agree[[1, 3, 5, 6], [0, 2, 4, 7]].any()  # of one depth


MIXED = [
    (surjective(2, 2, goal=(1, 2)), surjective(3, 2, goal=(1, 3))),
    (surjective(2, 3, 0.5, goal=(1, 2, 1)), replace(surjective(3, 2, goal=(2, 2)), fail_reward=-1.0)),
    (replace(surjective(2, 3, goal=(1, 2, 1)), reward_fn=Gradient()), surjective(3, 2, 0.9, goal=(3, 1))),
    (
        replace(surjective(3, 3, goal=(1, 3, 2)), reward_fn=Gradient(), fail_reward=0.6),
        replace(surjective(2, 3, goal=(1, 2, 2)), reward_fn=OneAtTheGoal()),
    ),
    (replace(surjective(2, 2, 0.9, goal=(1, 1)), fail_reward=0.3), surjective(2, 2, goal=(1, 1))),
    (
        replace(surjective(2, 2, 0.5, goal=(1, 1)), step_reward=-0.1, fail_reward=0.25),
        replace(surjective(2, 2, 0.0, goal=(2, 2)), goal_reward=-1.0),
    ),
]


@pytest.mark.parametrize("pair", MIXED, ids=range(len(MIXED)))
def test_agreement_equals_that_of_plain_enumeration(pair):
    num_actions = 1 + max(task.graph.branching_factor for task in pair)

    expected = plain_agreement(*pair, num_actions)

    assert state_agreement(pair)[0, 1].item() == expected
    assert state_agreement(pair).diagonal().tolist() == [1.0, 1.0]


def test_a_needle_agrees_as_one_whose_states_are_all_visited():
    shapes = [(2, 3, goal) for goal in product((1, 2), repeat=3)] + [(3, 2, (3, 1)), (3, 2, (1, 2))]
    needles = [surjective(b, d, goal=goal) for b, d, goal in shapes]

    visited = [replace(task, reward_fn=OneAtTheGoal()) for task in needles]

    assert torch.equal(state_agreement(needles), state_agreement(visited))
    assert torch.equal(state_agreement([*needles, *visited])[:10, 10:], state_agreement(needles))


def test_gradients_agree_where_their_goals_take_the_same_decision():
    """The decision of the goal is best in all of a level; waiting is, but before the end that pays nothing."""
    tasks = [replace(surjective(d=11, goal=goal), reward_fn=Gradient()) for goal in ((1,) * 11, (1, 2) * 5 + (1,))]

    different = sum(2**level for level in range(1, 11, 2))
    assert state_agreement(tasks)[0, 1].item() == (6142 - different - 2) / 6142


def test_observations_agree_where_one_action_is_right_in_both_tasks():
    tasks = [surjective(goal=goal) for goal in GOALS]

    agreement = observation_agreement(tasks)

    # one image for all waits, always agreed, and one for all decisions, which leaves an action only to (1, 1)
    assert agreement.tolist() == [[1.0, 0.5, 0.5], [0.5, 0.5, 0.5], [0.5, 0.5, 0.5]]


def test_an_observation_that_asks_for_different_actions_is_never_agreed():
    """Failing pays: waiting is right before the goal and wrong before the other end, which look the same."""
    task = replace(surjective(d=1), fail_reward=0.5, step_reward=-0.1)

    assert observation_agreement([task]).tolist() == [[0.5]]


def test_observations_of_fully_observable_tasks_agree_as_their_states():
    tasks = [fully_observable(goal=goal) for goal in GOALS]

    assert torch.equal(observation_agreement(tasks), state_agreement(tasks))


def test_tasks_without_a_shared_image_have_no_agreement():
    tasks = [surjective(goal=(1, 1), image_seed=seed) for seed in (1, 2)]

    agreement = observation_agreement(tasks)

    assert math.isnan(agreement[0, 1]) and math.isnan(agreement[1, 0])
    assert agreement.diagonal().tolist() == [1.0, 1.0]


def legacy(goal: tuple[int, ...], images: object) -> Task:
    """b = 3: states share ids, and end states begin with another id than the first."""
    x = Observations((2, 14), (15, 18), (19, 30), unique_waits=True, unique_decisions=True, legacy_index=True)
    return Task(CTGraph(3, 2), goal, x, images)


SHOWN = [
    [confounding(goal=(1, 1)), confounding(goal=(2, 2)), surjective(goal=(1, 2))],
    [fully_observable(goal=(1, 2)), fully_observable(3, 1, goal=(2,)), fully_observable(2, 1, goal=(1,))],
    [legacy((3, 1), ReferenceImages(31)), legacy((1, 3), ReferenceImages(40)), legacy((3, 3), ReferenceImages(31, 2))],
    [legacy((3, 1), PaperImages(31)), fully_observable(goal=(1, 1)), fully_observable(3, 2, goal=(1, 1))],
]


@pytest.mark.parametrize("tasks", SHOWN, ids=range(len(SHOWN)))
def test_images_and_observations_are_those_that_the_environment_shows(tasks):
    recorded = [images_of_states(task) for task in tasks]
    num_actions = 1 + max(task.graph.branching_factor for task in tasks)

    shown = [set().union(*images.values()) for images in recorded]
    left = []
    for task, images in zip(tasks, recorded, strict=True):
        actions = {}
        for key, best in optimal_sets(task, num_actions).items():
            for image in images[key]:
                actions[image] = actions.get(image, best) & best
        left.append(actions)

    def agree(one: dict, other: dict) -> float:
        both = one.keys() & other.keys()
        return sum(bool(one[i]) and one[i] == other[i] for i in both) / len(both) if both else math.nan

    jaccard = [[len(a & z) / len(a | z) for z in shown] for a in shown]
    assert shared_images(tasks).tolist() == jaccard
    expected = torch.tensor([[agree(a, z) for z in left] for a in left], dtype=torch.float64)
    torch.testing.assert_close(observation_agreement(tasks), expected, rtol=0, atol=0, equal_nan=True)


def test_images_are_shared_by_content_and_vectors_by_their_ones():
    shorter = surjective()
    longer = replace(shorter, images=PaperImages(9))
    vectors = [replace(shorter, images=OneHot(5)), replace(shorter, images=OneHot(9))]
    moved = replace(shorter, images=PaperImages(9), observations=replace(shorter.observations, end_ids=(8, 8)))

    assert shared_images([shorter, longer])[0, 1].item() == 1.0
    assert shared_images([shorter, moved])[0, 1].item() == 4 / 6
    assert shared_images(vectors)[0, 1].item() == 1.0


def test_a_smaller_graph_is_contained_as_far_as_its_decisions_go():
    shapes = [(2, 2), (2, 5), (3, 2), (3, 5), (2, 2, 0.5)]
    tasks = [surjective(*shape) for shape in shapes]

    containment = graph_containment(tasks)

    # 3, 31, 4 and 121 decision states; (2, 5) and (3, 2) have a root and two more in common, of the 4
    assert containment[0].tolist() == [1.0] * 5
    assert containment[1].tolist() == [1.0, 1.0, 3 / 4, 1.0, 1.0]


def test_measures_are_symmetric_shares_over_a_published_curriculum():
    tasks = curricula.load("su_b1_4tasks").tasks

    for measure in MEASURES.values():
        matrix = measure(tasks)
        assert matrix.shape == (4, 4)
        assert torch.equal(matrix, matrix.T)
        assert (matrix >= 0).all() and (matrix <= 1).all()


def test_depths_to_11_are_compared_whole():
    tasks = [
        surjective(d=d, goal=(1, 2, 1, 2, 2, 1, 2, 1, 1, 2, 1)[:d], image_seed=s) for d in (2, 8, 11) for s in (1, 2)
    ]
    large = [fully_observable(d=11, goal=(decision,) * 11) for decision in (1, 2)]

    assert all(measure(tasks).shape == (6, 6) for measure in MEASURES.values())
    assert observation_agreement(large)[0, 1].item() == (6142 - 43) / 6142


def test_what_cannot_be_compared_is_refused():
    dense = replace(surjective(d=30), reward_fn=Gradient())
    huge = replace(surjective(), images=OneHot(10**6))

    with pytest.raises(ValueError, match="tasks must be a list with at least one Task, got none"):
        shared_decisions([])
    with pytest.raises(ValueError, match="Gradient on this graph needs a visit to each"):
        state_agreement([dense])
    with pytest.raises(ValueError, match="images of 1,000,000,000,000 bytes are too many to compare"):
        shared_images([huge])
