"""Whatever is given: random legal tasks do what the paper says, random illegal ones are refused and say why."""

from __future__ import annotations

import random
import re
from contextlib import nullcontext
from copy import deepcopy
from dataclasses import fields, replace
from itertools import product
from typing import Any

import pytest
import torch
from helpers.oracles import (
    END,
    FAIL,
    HOME,
    WAIT,
    TreeState,
    act,
    optimal,
    play,
    record,
    surjective,
    tree_step,
)
from helpers.probability_tables import success_prob
from helpers.task_families import INF, KINDS, NAN, batches, counts_of, examples, flips, seeds, tasks
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDictBase

from ctgraph_rl import CTGraph, CTGraphEnv, Gradient, Needle, Observations, OneHot, ReferenceLinear, Task
from ctgraph_rl.policies import OptimalPolicy
from ctgraph_rl.tasks.curriculum import Block, Curriculum, Evaluation
from ctgraph_rl.tasks.images import GroupedImages


def next_actions(env: CTGraphEnv, rng: random.Random) -> torch.Tensor:
    """Mostly on the way to the task's first goal, else any action of the specs."""
    best, largest = optimal(env).tolist(), env.action_spec.n - 1
    return torch.tensor([action if rng.random() < 0.8 else rng.randint(0, largest) for action in best])


def rollout(env: CTGraphEnv, seed: int, steps: int, data: TensorDictBase | None = None) -> TensorDictBase:
    """Data [N, steps] of such actions, with finished rows reset; starts with a reset unless data is given."""
    rng, data, taken = random.Random(seed), env.reset() if data is None else data, []
    for _ in range(steps):
        step, data = env.step_and_maybe_reset(data.set("action", next_actions(env, rng)))
        taken.append(step.clone())
    return torch.stack(taken, 1)


def unchanged(env: CTGraphEnv, before: dict[str, torch.Tensor], rows: torch.Tensor | slice = slice(None)) -> bool:
    """Whether these rows of all buffers are the same."""
    now = ((value, before[name]) for name, value in env.state_dict().items())
    return all(torch.equal(*(x[rows] if x.numel() > 1 else x for x in pair)) for pair in now)


def within_specs(env: CTGraphEnv, data: TensorDictBase) -> bool:
    specs = [env.observation_spec, env.full_done_spec, *([env.full_reward_spec] if "reward" in data else [])]
    return all(spec.contains(data.select(*spec.keys())) for spec in specs)


@examples(6)
@given(batches(least=2), seeds, st.sampled_from([0, 7, 2**32 - 4]))
def test_any_row_of_any_batch_equals_its_task_alone(batch, seed, first_row):
    data = rollout(CTGraphEnv(batch, seed=seed, first_row=first_row), seed, 12)

    for i, task in enumerate(batch):
        solo = CTGraphEnv([task], seed=seed, first_row=first_row + i, check_actions=False)
        alone = record(solo, data["action"][i].unsqueeze(-1))[0]["next"]
        seen, length = data[i]["next", "observation"], alone["observation"].shape[-1]

        assert (alone.exclude("observation") == data[i]["next"].exclude("observation")).all()
        assert torch.equal(alone["observation"], seen[..., :length]) and not seen[..., length:].any()


@examples(6)
@given(batches(), seeds)
def test_the_optimal_policy_reaches_the_goal_of_any_task(batch, seed):
    env = CTGraphEnv(batch, seed=seed, check_actions=False)

    last = play(env, OptimalPolicy(env).action)

    assert last["outcome"].flatten().tolist() == [3] * len(batch)
    assert last["leaf"].flatten().tolist() == env.goal_leaf.tolist()
    for task, steps, total in zip(batch, last["step_count"], last["episode_reward"], strict=True):
        shortest = 2 * (task.graph.depth + 1)
        assert steps.item() == shortest or (task.graph.wait_prob and steps.item() > shortest)
        expected = task.goal_reward + task.step_reward * steps.item()
        assert task.reward_std or total.item() == pytest.approx(expected, rel=1e-5, abs=1e-5)


@examples(6)
@given(batches(), seeds, st.integers(1, 12))
def test_a_state_dict_of_any_moment_of_any_tasks_resumes_bit_exactly(batch, seed, moment):
    env = CTGraphEnv(batch, seed=seed, first_row=5)
    now = rollout(env, seed, moment)[:, -1].exclude("action", "next")
    resumed = CTGraphEnv(batch, seed=seed // 2)

    resumed.load_state_dict(deepcopy(env.state_dict()))

    expected = rollout(env, seed, 8, now.clone())
    assert (record(resumed, expected["action"].T, now) == expected).all() and unchanged(resumed, env.state_dict())


def leaf_of(b: int, path: tuple[int, ...]) -> int:
    return sum((decision - 1) * b**place for place, decision in enumerate(reversed(path)))


def path_of(b: int, d: int, leaf: int) -> tuple[int, ...]:
    return tuple(1 + leaf // b**place % b for place in reversed(range(d)))


def place_in_level_order(b: int, path: tuple[int, ...]) -> int:
    return sum(b**level for level in range(len(path))) + leaf_of(b, path)


def share_of(task: Task, path: tuple[int, ...], goal: tuple[int, ...]) -> float:
    """What an end state pays."""
    b, d, off = task.graph.branching_factor, task.graph.depth, [abs(x - g) for x, g in zip(path, goal, strict=True)]
    if task.reward_fn == Gradient():
        return 1 - sum(b ** (d - k) * x for k, x in enumerate(off, 1)) / (b**d - 1)
    if task.reward_fn == ReferenceLinear():
        return sum((d - k) * (1 - x) for k, x in enumerate(off)) / (d * (d + 1) / 2)
    return float(path == goal)


def ids_of(task: Task, state: TreeState) -> range:
    """The ids that a state may show."""
    (kind, path), x, b = state, task.observations, task.graph.branching_factor
    first, last = getattr(x, f"{kind.name.lower()}_ids")
    if not getattr(x, f"unique_{kind.name.lower()}s", False):
        return range(first, last + 1)
    own = first + (leaf_of(b, path) if kind == END else place_in_level_order(b, path))
    return range(own, own + 1)


def shows(task: Task, seen: torch.Tensor, shown_id: int) -> bool:
    """Whether an observation of a state without a cue is one of an id, with the noise that the task allows."""
    if seen.ndim == 1:
        return torch.equal(seen, torch.eye(len(seen), dtype=torch.uint8)[shown_id])
    turns = task.observations.read_rotation + 1
    added = seen.int() - task.images.bank(turns - 1)[shown_id * turns : (shown_id + 1) * turns].int()
    fits = (added >= 0) & ((added <= task.observations.read_noise) | (seen == 255))
    return bool(fits.flatten(1).all(1).any())


@examples(6)
@given(batches(), seeds)
def test_the_data_of_any_tasks_lie_within_the_specs_and_follow_the_papers_tree_step_by_step(batch, seed):
    env, rng, states = CTGraphEnv(batch, seed=seed), random.Random(seed), [(HOME, ())] * len(batch)
    data = env.reset()

    for _ in range(12):
        data = env.reset(data.set("_reset", data["done"].clone())) if data["done"].any() else data
        assert within_specs(env, data.exclude("reward"))
        goals, actions = env.goal_leaf.tolist(), next_actions(env, rng)
        data = act(env, actions, data)
        assert within_specs(env, data) and env.action_spec.is_in(actions)
        for i, task in enumerate(batch):
            b, d = task.graph.branching_factor, task.graph.depth
            before = (HOME, ()) if states[i][0] in (END, FAIL) else states[i]
            stayed = before[0] == WAIT and env.state_type[i].item() == WAIT
            kind, path = states[i] = tree_step(b, d, before, actions[i].item(), stayed)
            goal, now, shown_id = path_of(b, d, goals[i]), data[i], env.observation_id[i].item()
            paid = share_of(task, path, goal) * task.goal_reward if kind == END else task.fail_reward * (kind == FAIL)
            reward = pytest.approx(paid + task.step_reward, rel=1e-6, abs=1e-5)
            outcome = {END: 3 if path == goal else 2, FAIL: 1}.get(kind, 0)

            assert task.graph.wait_prob > 0 or not stayed
            assert task.goal_change or goal == task.goal
            assert (env.state_type[i].item(), env.node[i].item()) == (kind, place_in_level_order(b, path))
            assert (now["outcome"].item(), now["done"].item()) == (outcome, kind in (END, FAIL))
            assert now["leaf"].item() == (leaf_of(b, path) if kind == END else -1)
            assert now["reward"].item() == reward or (task.reward_std and kind == END)
            assert shown_id in ids_of(task, states[i])
            assert shows(task, now["observation"], shown_id) or (task.observations.reward_cue and kind == END)


def mean_random_return(task: Task) -> float:
    """Level by level: the chance to get so far, the steps that it takes, and the mean of what end states pay."""
    b, d, p = task.graph.branching_factor, task.graph.depth, task.graph.wait_prob
    waits, steps, there = 1 / (b + 1), 1.0, 1.0
    for level in range(d + 1):
        steps += there / (1 - waits * p)
        there *= waits * (1 - p) / (1 - waits * p)
        if level < d:
            steps, there = steps + there, there * b / (b + 1)
    paths = [task.goal] if task.reward_fn == Needle() else product(range(1, b + 1), repeat=d)
    share = sum(share_of(task, path, task.goal) for path in paths) / b**d
    return there * task.goal_reward * share + (1 - there) * task.fail_reward + steps * task.step_reward


@examples(40)
@given(st.sampled_from([None, 4]).flatmap(tasks))
def test_the_closed_forms_of_any_task_agree_with_the_value_of_the_random_policy(task):
    graph, actions = task.graph, task.graph.branching_factor + 1
    policy = torch.full((task.images.num_images, actions), 1 / actions, dtype=torch.float64)

    assert success_prob(task, policy) == pytest.approx(graph.reward_prob_random, rel=1e-9, abs=0)
    assert graph.end_prob_random == pytest.approx(graph.reward_prob_random * graph.num_end_states, rel=1e-12, abs=0)
    assert graph.num_states == sum(counts_of(graph.branching_factor, graph.depth).values())
    if task.reward_fn == Needle() or graph.depth <= 4:
        rounding = 1e-9 if task.reward_fn == Needle() else 1e-5  # other shares are float32 numbers
        assert task.policy_value(policy) == pytest.approx(mean_random_return(task), rel=1e-9, abs=rounding)
        assert task.optimal_value(1.0) >= task.policy_value(policy) - 1e-9
    else:
        with pytest.raises(ValueError, match=f"each of its {graph.num_states} states.*use a smaller depth"):
            task.policy_value(policy)


NO_INT = [1.5, True, None, "a", NAN, INF, "1", [1]]
NO_NUMBER = [NAN, INF, -INF, None, "a", True, [1.0], "1.0"]
NO_IDS = [(3, 2), (-1, 0), (0,), (0, 1, 2), (0.0, 1), ("a", "b"), None, 5, "ab", (True, True), (NAN, 1), (), {0: 1}]
NO_FLAG = [1, 0, "yes", 0.5, "", NAN]
IDS = ("home_ids", "fail_ids", "wait_ids", "decision_ids", "end_ids")

ILLEGAL: dict[str, list[Any]] = {
    **dict.fromkeys(IDS, NO_IDS),
    **{name: [0, -1, *NO_INT] for name in ("depth", "num_images", "num_frames", "num_episodes", "version")},
    **{name: [None, *NO_FLAG] for name in ("unique_waits", "unique_decisions", "reward_cue", "greedy")},
    **{name: [1e39, *NO_NUMBER] for name in ("goal_reward", "fail_reward", "step_reward")},
    **{name: [0, 1, -0.1, 0.01, *NO_NUMBER] for name in ("within", "between")},
    "branching_factor": [1, 0, -2, 2.5, *NO_INT],
    "wait_prob": [1, 1.0, -0.1, 1.5, -1e-300, *NO_NUMBER],
    "unique_ends": NO_FLAG,
    **{"read_noise": [-1, 256, *NO_INT], "read_rotation": [-1, 360, *NO_INT]},
    "groups": [(), (0,), (1, -1), (1.0,), (True,), ("a",), None, 5, "ab"],
    "seed": [-1, 2**63, *NO_INT],
    "size": [0, 5, -4, 2, 8.5, *NO_INT],
    "goal": [(), None, "11", 11, (0,), (1.0,), (True,), (NAN,), ("1",), (None,), {1: 1}],
    "reward_std": [-0.1, -1, 1e39, *NO_NUMBER],
    "reward_noise": ["gauss", "", None, 1, ["additive"]],
    "goal_change": [(2, 1), (0, 3), (-2, 1), (1,), (1.0, 2), "ab", 5, (True, 2), (), (1, NAN), (None, 1)],
}


@st.composite
def broken(draw: Any) -> tuple[Any, dict[str, Any]]:
    """A legal object, and illegal values for one or more of its fields."""
    task = draw(st.sampled_from([None, 4, 12]).flatmap(tasks))
    parts = [task.graph, task.observations, task.images, GroupedImages((1, 4), 0.2, 0.3), Evaluation(), task, task]
    target = draw(st.sampled_from([*parts, Block(task, 10), Curriculum("c", 1, "", (Block(task, 10),))]))
    illegal = [field.name for field in fields(target) if field.name in ILLEGAL]
    names = draw(st.lists(st.sampled_from(illegal), min_size=1, unique=True))
    return target, {name: draw(st.sampled_from(ILLEGAL[name])) for name in names}


@examples(80)
@given(broken())
def test_every_broken_field_is_named_with_its_value_in_one_value_error(target_and_values):
    target, values = target_and_values

    with pytest.raises(ValueError) as error:
        replace(target, **values)

    for name, value in values.items():
        assert re.search(rf"\b{name}\b[^;]*, got {re.escape(repr(value))}", str(error.value))


@examples(30)
@given(tasks(4), st.sampled_from([0, -1, 5, 10**9, 1.0, NAN, None, True, 2**63, "longer", "shorter"]), st.data())
def test_a_goal_that_does_not_fit_names_its_bound_and_length(task, wrong, data):
    b, d, place = task.graph.branching_factor, task.graph.depth, data.draw(st.integers(0, task.graph.depth - 1))
    replaced = (*task.goal[:place], wrong, *task.goal[place + 1 :])
    goal = {"longer": (*task.goal, 1), "shorter": task.goal[1:]}.get(str(wrong), replaced)

    with pytest.raises(ValueError, match=rf"goal must be {d} decisions in 1\.\.{b}, .*{re.escape(repr(goal))}"):
        replace(task, goal=goal)


@examples(30)
@given(tasks(4), st.permutations(IDS), st.integers(0, 2))
def test_overlapping_ids_are_refused_with_both_names(task, names, more):
    (moved, other), (_, last) = names[:2], getattr(task.observations, names[1])

    with pytest.raises(ValueError, match="overlaps") as error:
        replace(task.observations, **{moved: (last, last + more)})

    assert {moved, other} <= set(re.findall(r"(\w+)=\(", str(error.value)))


@examples(40)
@given(st.integers(2, 4), st.integers(2, 4), st.sets(st.sampled_from(KINDS), min_size=1))
def test_every_range_with_too_few_unique_ids_is_named_with_the_number_it_needs(b, d, short):
    counts, start, ids = counts_of(b, d), 2, {}
    for kind in KINDS:
        ids[f"{kind.name.lower()}_ids"] = (start, start + counts[kind] - 1 - (kind in short))
        start += counts[kind]
    x = Observations(**ids, unique_waits=True, unique_decisions=True)

    with pytest.raises(ValueError, match=rf"goal must .*num_images=2 is too .* id {x.last_id} .*goal_reward must") as e:
        Task(CTGraph(b, d), (b + 1,) * d, x, OneHot(2), goal_reward=NAN)

    needs = re.findall(r"unique_(\w+)s needs (\d+) \1_ids, got (\d+)", str(e.value))
    wanted = {kind: (kind.name.lower(), str(counts[kind]), str(counts[kind] - 1)) for kind in KINDS}
    assert needs == [wanted[kind] for kind in KINDS if kind in short]


@examples(30)
@given(st.integers(2, 12) | st.integers(2, 2**63), st.integers(1, 70) | st.integers(1, 10**6))
def test_a_graph_is_legal_as_long_as_its_states_fit_int64(b, d):
    if d < 64 and sum(counts_of(b, d).values()) < 2**63:
        last = play(CTGraphEnv([surjective(b, d, goal=(b,) * d)], check_actions=False), optimal)
        assert (last["outcome"].item(), last["leaf"].item()) == (3, b**d - 1)
        return
    with pytest.raises(ValueError, match=rf"depth={d} .*branching_factor={b} .*2\*\*63 - 1 states; use a smaller"):
        CTGraph(b, d)


MIXED = [surjective(2, 1), surjective(3, 3, p=0.5, read_noise=3), replace(surjective(2, 40), goal_change=(1, 2))]
NO_ACTIONS = [
    *((torch.tensor([0, 0, value]), rf"\[{value}\]") for value in (-1, 4, 2**31, 2**62, -(2**63))),
    *((torch.zeros(3, dtype=dtype), f"dtype {dtype}") for dtype in (torch.int32, torch.bool, torch.float64)),
    *((torch.tensor([0, 0, value]), "dtype torch.float32") for value in (1.0, NAN, INF)),
    *((torch.zeros(shape, dtype=torch.int64), "shape") for shape in ((3, 1), (3, 4), (3, 0), (3, 1, 1))),
    (None, "none"),
]


@examples(20)
@given(seeds, st.integers(1, 8), st.sampled_from(NO_ACTIONS))
def test_a_wrong_action_is_refused_with_the_expected_spec_and_changes_nothing(seed, steps, wrong):
    env, (action, got) = CTGraphEnv(MIXED, seed=seed), wrong
    data = rollout(env, seed, steps)[:, -1].exclude("action", "next")
    before = deepcopy(env.state_dict())

    with pytest.raises(ValueError, match=rf"action must be int64 of shape \[3\] with values in 0\.\.3, got {got}"):
        env.step(data if action is None else data.set("action", action))

    assert unchanged(env, before)


@examples(6)
@given(batches(least=2), seeds, st.integers(0, 8), st.lists(flips, min_size=4, max_size=4))
def test_a_reset_of_any_rows_leaves_the_present_and_the_future_of_the_others_alone(batch, seed, steps, resets):
    mask, rng = torch.tensor([*resets[1 : len(batch)], True]), random.Random(seed)
    env, twin = (CTGraphEnv(batch, seed=seed, check_actions=False) for _ in range(2))
    now, before = env.reset(), twin.reset()
    for _ in range(steps):
        action = next_actions(env, rng)
        now, before = act(env, action).exclude("reward"), act(twin, action).exclude("reward")

    after = env.reset(now.clone().set("_reset", mask.unsqueeze(-1)))

    assert (after.select(*before.keys()) == before)[~mask].all() and unchanged(env, twin.state_dict(), ~mask)
    assert (env.state_type[mask] == HOME).all() and after["is_init"][mask].all() and not after["done"][mask].any()
    for _ in range(6):
        action = next_actions(env, rng)
        assert (act(env, action) == act(twin, action))[~mask].all()
    assert unchanged(env, twin.state_dict(), ~mask)
    env.check_actions, done = True, (env.state_type >= END).nonzero().flatten().tolist()
    refused = pytest.raises(ValueError, match=rf"rows {re.escape(str(done))} are done: reset them first")
    with refused if done else nullcontext():
        act(env, [0] * len(batch))


TASK, HUGE = surjective(), 10**400
BUGS = {
    "an integer beyond all floats as a reward": (lambda: replace(TASK, goal_reward=HUGE), "goal_reward"),
    "an integer beyond all floats as a probability": (lambda: CTGraph(2, 2, HUGE), "wait_prob"),
    "a reward whose noise is inf or nan": (lambda: replace(TASK, reward_std=3e38), "reward_std"),
    "rewards whose sum is inf": (lambda: replace(TASK, step_reward=3e38), "step_reward"),
    "overlap and noise": (lambda: replace(TASK.observations, wait_ids=(1, 2), read_noise=-1), "read_noise overlaps"),
    "two overlaps": (lambda: replace(TASK.observations, wait_ids=(2, 9)), "wait_ids decision_ids end_ids"),
    "a tree too large and another": (lambda: CTGraph(10, 30, 1.0), "depth wait_prob"),
    "a missing part": (lambda: replace(TASK, graph=None, images=None, reward_fn=None), "graph images reward_fn"),
    "missing observations": (lambda: replace(TASK, observations=None), "observations"),
    "a reward's class": (lambda: replace(TASK, reward_fn=Needle), "reward_fn"),
    "a goal without a dimension": (lambda: replace(TASK, goal=torch.tensor(1)), "goal"),
    "a goal change drawn wrongly": (lambda: CTGraphEnv([replace(TASK, goal_change=(1, 2**33))]), "goal_change"),
    "images beyond all memory": (lambda: CTGraphEnv([replace(TASK, images=OneHot(2**40))]), "bytes"),
    "no tasks": (lambda: CTGraphEnv(None), "tasks"),
    "rows that are no tasks": (lambda: CTGraphEnv([TASK, None]), "tasks"),
    "a pool that is no list": (lambda: CTGraphEnv([TASK], task_pool=TASK), "task_pool"),
    "a block of no tasks": (lambda: Block(None, 0), "num_frames"),
}


@pytest.mark.parametrize("bug", BUGS)
def test_bug_broken_input_is_refused_with_all_broken_names(bug):
    build, names = BUGS[bug]

    with pytest.raises(ValueError) as error:
        build()

    assert all(name in str(error.value) for name in names.split())
