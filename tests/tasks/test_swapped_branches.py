"""Two tasks that differ in one transition: dynamics, closed forms and similarity against a plain tree."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.oracles import confounding, fully_observable, scripts, surjective, tree_states, tree_step
from helpers.probability_tables import success_prob

from ctgraph_rl import CTGraphEnv, Gradient, Task
from ctgraph_rl.core.graph import StateType
from ctgraph_rl.draw.dot import to_dot
from ctgraph_rl.learn.evaluate import evaluate
from ctgraph_rl.policies import OptimalPolicy, SearchPolicy
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.observability import state_entropy
from ctgraph_rl.tasks.protocol import Block
from ctgraph_rl.tasks.similarity import graph_containment, observation_agreement, shared_decisions, state_agreement
from ctgraph_rl.tasks.values import open_loop_ceiling, random_frames_to_goal

HOME, WAIT, DECISION, END, FAIL = StateType

SWAPPED = [
    replace(fully_observable(2, 2), swapped_branches=((), (1, 2))),
    replace(fully_observable(3, 2, 0.5, goal=(2, 3)), swapped_branches=((2,), (1, 3))),
    replace(surjective(2, 3, 0.2, goal=(1, 2, 2)), swapped_branches=((1,), (1, 2)), reward_fn=Gradient()),
    replace(confounding(3, 2, 0.3), goal=(2, 2), swapped_branches=((2,), (1, 2)), fail_reward=-0.5, step_reward=-0.1),
    replace(surjective(2, 2, goal=(1, 2)), swapped_branches=((2,), (1, 2))),
]


def after(task: Task, state, action: int, stays: bool):
    """The state that an action leads to, by branches, in plain Python."""
    path, pair = task.swapped_branches
    if state == (DECISION, path) and action in pair:
        action = sum(pair) - action
    return tree_step(task.graph.branching_factor, task.graph.depth, state, action, stays)


def value(task: Task, choose) -> float:
    """The expected return, where ``choose`` picks from the values of all actions of a state, by plain recursion."""
    graph = task.graph
    b, p = graph.branching_factor, graph.wait_prob
    leaf = {state[1]: number for number, state in enumerate(s for s in tree_states(b, graph.depth) if s[0] == END)}

    def entered(state) -> float:
        if state[0] == FAIL:
            return task.fail_reward
        if state[0] != END:
            return of(state)
        if task.reward_fn == Gradient():
            taken, wanted = (leaf[path] for path in (state[1], task.goal))
            return task.goal_reward * sum_of_digits(taken, wanted, b, graph.depth)
        return task.goal_reward * (state[1] == task.goal)

    def of(state) -> float:
        outcomes = [entered(after(task, state, action, False)) for action in range(b + 1)]
        stay = p if state[0] == WAIT else 0.0  # staying costs step_reward each time: 1 / (1 - p) times in the mean
        return choose(state, outcomes, stay) if state[0] != HOME else task.step_reward + outcomes[0]

    return of((HOME, ()))


def sum_of_digits(taken: int, wanted: int, b: int, depth: int) -> float:
    powers = [b**k for k in range(depth)]
    lost = sum(abs(taken // power % b - wanted // power % b) * power for power in powers)
    return 1 - lost / (b**depth - 1)


def best(task: Task):
    def choose(state, outcomes, stay):
        waiting = [task.step_reward / (1 - stay) + outcomes[0]]
        return max(waiting + [task.step_reward + outcome for outcome in outcomes[1:]])

    return choose


def table(task: Task, policy):
    """The choice of a policy by kind, [A] each; staying is solved as a geometric series."""

    def choose(state, outcomes, stay):
        chances = policy(state)
        total = task.step_reward + sum(c * o for c, o in zip(chances, outcomes, strict=True))
        total -= chances[0] * stay * outcomes[0]
        return total / (1 - chances[0] * stay)

    return choose


@pytest.mark.parametrize("task", SWAPPED)
@pytest.mark.parametrize("kernel", ["off", "auto"])
def test_every_action_leads_where_the_plain_tree_leads(task, kernel):
    actions = scripts(120, 8, task.graph.branching_factor + 1)
    env = CTGraphEnv([replace(task, graph=replace(task.graph, wait_prob=0.0))] * 8, seed=1, kernel=kernel)
    data = env.reset()
    states = [(HOME, ())] * 8

    for action in actions:
        states = [after(task, state, int(a), False) for state, a in zip(states, action, strict=True)]
        step, data = env.step_and_maybe_reset(data.set("action", action))
        leaves = [task.graph.leaf_of(path) if kind == END else -1 for kind, path in states]
        assert step["next", "leaf"].flatten().tolist() == leaves
        won = [kind == END and path == task.goal for kind, path in states]
        assert (step["next", "outcome"].flatten() == 3).tolist() == won
        states = [(HOME, ()) if kind in (END, FAIL) else (kind, path) for kind, path in states]
        assert env.node.tolist() == [task.graph.node_at(path) for _, path in states]


@pytest.mark.parametrize("task", SWAPPED)
def test_optimal_values_are_those_of_plain_recursion(task):
    assert task.optimal_value(1.0) == pytest.approx(value(task, best(task)), rel=1e-6)


@pytest.mark.parametrize("task", SWAPPED)
def test_values_of_policies_are_those_of_plain_recursion(task):
    x, b = task.observations, task.graph.branching_factor
    generator = torch.Generator().manual_seed(1)
    policy = torch.rand(task.images.num_images, b + 1, generator=generator, dtype=torch.float64).softmax(-1)

    def shown(state):
        kind, path = state
        if not x.is_unique(kind):
            first, last = x.ids(kind)
            return policy[first : last + 1].mean(0).tolist()
        number = task.graph.node_at(path) - task.graph.first_node(len(path))
        return policy[x.unique_id(task.graph, kind, len(path), number)].tolist()

    assert task.policy_value(policy) == pytest.approx(
        value(task, table(task, shown)), rel=1e-6
    )  # shares of rewards are float32


def test_ceilings_without_memory_count_the_decisions_that_lead_to_the_goal():
    same, other = surjective(2, 2, goal=(1, 1)), surjective(2, 2, goal=(1, 2))
    swapped = [replace(task, swapped_branches=((1,), (1, 2))) for task in (same, other)]

    assert [task.goal_decisions for task in swapped] == [(1, 2), (1, 1)]
    assert [task.memoryless_ceiling(deterministic=True) for task in (same, *swapped)] == [1.0, 0.0, 1.0]
    assert [task.memoryless_ceiling() for task in (same, *swapped)] == [1.0, 0.25, 1.0]
    for task in swapped:
        shares = [value(task, table(task, fixed(q))) for q in (0, 0.3, 0.5, 1)]
        assert max(shares) == pytest.approx(task.memoryless_ceiling())


def fixed(q: float):
    return lambda state: [0, q, 1 - q] if state[0] == DECISION else [1, 0, 0]


@pytest.mark.parametrize("task", SWAPPED)
def test_what_the_shape_alone_decides_does_not_change(task):
    plain = replace(task, swapped_branches=None)

    assert task.graph.reward_prob_random == plain.graph.reward_prob_random
    assert random_frames_to_goal(task) == random_frames_to_goal(plain)
    assert [state_entropy(task, who) for who in ("random", "navigation", "optimal")] == [
        state_entropy(plain, who) for who in ("random", "navigation", "optimal")
    ]
    if task.reward_fn != Gradient() and task.step_reward == 0:
        assert open_loop_ceiling(task) == open_loop_ceiling(plain)


@pytest.mark.parametrize("task", SWAPPED)
def test_random_actions_reach_the_goal_with_probability_p_r(task):
    uniform = torch.full(
        (task.images.num_images, task.graph.branching_factor + 1), 1 / (task.graph.branching_factor + 1)
    )

    assert success_prob(task, uniform) == pytest.approx(task.graph.reward_prob_random)


@pytest.mark.parametrize("policy", [OptimalPolicy, SearchPolicy])
def test_policies_that_know_the_state_know_what_is_swapped(policy):
    tasks = [*SWAPPED[:2], fully_observable(3, 2, 0.5, goal=(2, 3))]
    episodes = 9 if policy is SearchPolicy else 1

    ends = evaluate(policy, tasks, episodes * 8, seed=1, episodes_per_row=episodes)

    assert (ends["outcome"] == 3).view(len(tasks), 8, episodes)[..., -1].all()


def test_similarity_sees_the_one_transition():
    plain = fully_observable(2, 2, goal=(1, 2))
    on_the_way, aside = (replace(plain, swapped_branches=((branch,), (1, 2))) for branch in (1, 2))
    tasks = [plain, on_the_way, aside]

    assert graph_containment(tasks)[0].tolist() == pytest.approx([1, 2 / 3, 2 / 3])
    assert graph_containment(tasks)[1, 2].item() == pytest.approx(1 / 3)
    assert shared_decisions(tasks)[0].tolist() == [1, 0.5, 1]
    assert state_agreement(tasks)[0].tolist() == pytest.approx([1, 9 / 10, 1])
    assert observation_agreement(tasks)[0, 1].item() < observation_agreement(tasks)[0, 2].item() == 1


def test_what_is_swapped_outside_of_the_common_tree_does_not_count():
    small = fully_observable(2, 2, goal=(1, 2))
    deep = replace(fully_observable(2, 3, goal=(1, 2, 1)), swapped_branches=((1, 1), (1, 2)))
    wide = replace(fully_observable(3, 2, goal=(1, 2)), swapped_branches=((3,), (1, 2)))

    assert graph_containment([small, deep])[0, 1].item() == 1
    assert graph_containment([small, wide])[0, 1].item() == 1


def test_a_pair_has_labels_of_its_own_and_survives_json_and_replaces_nothing_else():
    plain = fully_observable(2, 2)
    pair = (plain, replace(plain, swapped_branches=[[2], [1, 2]]))
    made = Curriculum("pair", 1, "test", [Block(task, 512) for task in pair])

    assert made.labels == ("goal1.1-noswap", "goal1.1-swap1.2at2")
    assert Curriculum.from_json(made.to_json()) == made
    assert made.fingerprint != Curriculum("pair", 1, "test", [Block(plain, 512)] * 2).fingerprint
    older = made.to_json()
    older["tasks"] = [{key: item for key, item in task.items() if key != "swapped_branches"} for task in older["tasks"]]
    with pytest.raises(ValueError, match="fingerprint is"):
        Curriculum.from_json(older)


def test_pictures_show_the_decisions_and_the_terminal_says_what_is_swapped():
    task = replace(fully_observable(2, 2), swapped_branches=((2,), (1, 2)))
    env, plain = (CTGraphEnv([each]) for each in (task, replace(task, swapped_branches=None)))
    env.reset(), plain.reset()

    edges = [line.split()[0:3] + line.split('"')[1:2] for line in to_dot(task).splitlines() if "->" in line]

    assert {tuple(edge) for edge in edges} >= {
        ("decision2", "->", "wait5", "2"),
        ("decision2", "->", "wait6", "1"),
        ("decision1", "->", "wait3", "1"),
    }
    assert not torch.equal(env.render(), plain.render())


@pytest.mark.parametrize(
    "given",
    [
        ((), (1, 1)),
        ((), (2, 1)),
        ((), (0, 1)),
        ((), (1, 3)),
        ((3,), (1, 2)),
        ((1, 1), (1, 2)),
        ((), (1,)),
        ((1.0,), (1, 2)),
        (1, 2),
        "swap",
        ((), (1, 2), ()),
    ],
)
def test_what_is_no_pair_of_branches_of_a_decision_state_is_refused(given):
    rule = r"swapped_branches must be \(path, \(first, second\)\): fewer than 2 branches, .* in 1\.\.2, such as .*, got"

    with pytest.raises(ValueError, match=rule):
        replace(fully_observable(2, 2), swapped_branches=given)


def test_a_file_of_the_authors_implementation_cannot_hold_swapped_branches():
    with pytest.raises(ValueError, match=r"swapped_branches=\(\(\), \(1, 2\)\): use None"):
        replace(fully_observable(2, 2), swapped_branches=((), (1, 2))).to_json()
