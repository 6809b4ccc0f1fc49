"""Tasks that change where episodes start: the rules, when they take effect, and that nothing else depends on them."""

from __future__ import annotations

import copy
import pickle
import random
from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch
from helpers.oracles import (
    ALPHA,
    PlainCTGraph,
    act,
    binomial_p_value,
    is_uniform,
    one_hot,
    record,
    scripts,
    surjective,
)
from helpers.task_families import RICH, env_of
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import step_mdp

from ctgraph_rl import CTGraphEnv, Rows
from ctgraph_rl.core import philox
from ctgraph_rl.tasks.switch import AtRandom, ByEpisode, Drift, Switch
from ctgraph_rl.tasks.task import Task

FORKS = [one_hot(2, 2, goal=goal) for goal in ((1, 1), (1, 2), (2, 1), (2, 2))]
"""Tasks without draws or images, for counting."""

TREES = [surjective(2, 1, goal=(2,)), surjective(3, 2, goal=(3, 1), image_seed=2), surjective(2, 3, image_seed=3)]
"""Tasks that `PlainCTGraph` knows, with images of their own."""


PER_ROW = [ByEpisode(2), AtRandom(0.4), Drift(3)]
TOGETHER = [ByEpisode(2, True), AtRandom(0.4, True), Drift(3, True)]


def switching(tasks: list[Task], switch: Switch, num_rows: int, **arguments: Any) -> Rows:
    """Rows that change between tasks."""
    rows = Rows(tasks[:1] * num_rows, task_pool=tasks, **arguments)
    rows.switch_tasks(tasks, switch)
    return rows


def started(rows: Rows, num_episodes: int) -> Tensor:
    """The tasks' numbers in as many episodes, each ended by the start of the next: int64 [episodes, rows]."""
    return torch.stack([(rows.restart(), rows.task)[1] for _ in range(num_episodes)])


def same(first: TensorDict, second: TensorDict) -> bool:
    """Whether data are equal, bit by bit and key by key."""
    return set(first.keys(True, True)) == set(second.keys(True, True)) and bool((first == second).all())


# The rules


@pytest.mark.parametrize("together", [False, True])
@pytest.mark.parametrize("episodes", [1, 3])
def test_by_episode_tasks_take_turns(episodes, together):
    rows = switching(FORKS[:3], ByEpisode(episodes, together), 4)

    found = started(rows, 8 * episodes)

    assert found.tolist() == [[turn % 3] * 4 for turn in range(8) for _ in range(episodes)]


def test_at_random_a_task_stays_for_a_geometric_number_of_episodes():
    prob, num_rows, num_episodes = 0.3, 4000, 7
    found = started(switching(FORKS, AtRandom(prob), num_rows, seed=5), num_episodes)

    changes = found[1:] != found[:-1]

    assert found[0].unique().tolist() == [0]
    first_change = torch.where(changes.any(0), changes.int().argmax(0) + 1, num_episodes)
    for length in range(1, num_episodes):
        count = (first_change == length).sum().item()
        assert binomial_p_value(count, num_rows, prob * (1 - prob) ** (length - 1)) >= ALPHA / num_episodes
    assert binomial_p_value(int(changes.sum()), changes.numel(), prob) >= ALPHA


def test_at_random_every_other_task_is_as_likely():
    found = started(switching(FORKS, AtRandom(0.9), 3000, seed=6), 5)

    steps = (found[1:] - found[:-1]) % 4

    for old in range(4):
        taken = steps[(found[:-1] == old) & (steps != 0)]
        assert is_uniform(taken.bincount(minlength=4)[1:].tolist(), ALPHA / 4)


@pytest.mark.parametrize("together", [False, True])
def test_at_random_with_probability_one_the_task_always_changes(together):
    found = started(switching(FORKS[:2], AtRandom(1, together), 3), 6)

    assert found.tolist() == [[episode % 2] * 3 for episode in range(6)]


def test_a_drift_rises_linearly_from_task_to_task_and_stays_with_the_last():
    episodes, num_rows = 4, 4000
    found = started(switching(FORKS[:3], Drift(episodes), num_rows, seed=7), 3 * episodes)

    for clock, row in enumerate(found):
        base, share = min(clock // episodes, 2), clock % episodes / episodes
        counts = row.bincount(minlength=4).tolist()
        if base == 2 or share == 0:
            assert counts[base] == num_rows
        else:
            assert counts[base] + counts[base + 1] == num_rows
            assert binomial_p_value(counts[base + 1], num_rows, share) >= ALPHA / 6


def test_a_drift_draws_anew_for_every_episode_and_row():
    found = started(switching(FORKS[:2], Drift(3), 6000, seed=8), 3)

    pairs = (2 * found[1] + found[2])[found[1] >= 0].bincount(minlength=4).tolist()

    for count, prob in zip(pairs, (2 / 9, 4 / 9, 1 / 9, 2 / 9), strict=True):
        assert binomial_p_value(count, 6000, prob) >= ALPHA / 4


@pytest.mark.parametrize(("switch", "share"), [(Drift(2, True), 0.5), (AtRandom(0.25, True), 0.25)])
def test_together_all_rows_have_one_draw_with_the_same_chances(switch, share):
    rows, changed = switching(FORKS[:2], switch, 3), 0

    for seed in range(200):
        rows.set_seed(seed)
        first, second = started(rows, 2).tolist()
        assert first == [0, 0, 0] and second in ([0] * 3, [1] * 3)
        changed += second[0]

    assert binomial_p_value(changed, 200, share) >= ALPHA


@pytest.mark.parametrize("alone", [False, True])
def test_together_draws_are_new_for_every_episode_even_where_the_first_row_has_but_one(alone):
    rows, starting = switching(FORKS[:2], AtRandom(0.5, True), 2, seed=1), torch.tensor([not alone, True])
    rows.reset()

    found = torch.stack([(rows.restart(starting), rows.task)[1] for _ in range(500)])[1 :: 1 + alone, 1]

    changes = (found[1:] != found[:-1]).long()
    assert is_uniform((2 * changes[1:] + changes[:-1]).bincount(minlength=4).tolist())


class Plan:
    """Which tasks rows have, in plain Python, for turns by the episode; tasks by their places in `FORKS`."""

    def __init__(self, num_rows: int) -> None:
        self.tasks, self.goals = [0] * num_rows, [0] * num_rows
        self.set([0] * num_rows, None, False)

    def set(self, places: list[int], switch: ByEpisode | None, at_episode_end: bool) -> None:
        self.places, self.switch = places, switch
        self.begun, self.place = [0] * len(self.tasks), [0] * len(self.tasks)
        if not at_episode_end:
            self.tasks = places[:] if switch is None else places[:1] * len(self.tasks)
            self.goals = self.tasks[:]

    def start(self, mask: list[bool]) -> None:
        n, before = len(mask), sum(self.begun) // len(mask) - 1
        self.begun = [count + starts for count, starts in zip(self.begun, mask, strict=True)]
        together = sum(self.begun) // n - 1
        for row in range(n):
            clock = self.begun[row] - 1
            if self.switch is not None and self.switch.together and max(before, 0) < together:
                self.place[row] = together // self.switch.episodes % len(self.places)
            elif self.switch is not None and not self.switch.together and mask[row]:
                self.place[row] = clock // self.switch.episodes % len(self.places)
            task = self.places[row if self.switch is None else self.place[row]]
            if mask[row] and task != self.tasks[row]:
                self.tasks[row] = self.goals[row] = task


@pytest.mark.parametrize("seed", range(6))
def test_any_order_of_calls_leads_to_the_tasks_and_goals_of_a_plain_plan(seed):
    chance, n = random.Random(seed), 4
    rows, plan = Rows(FORKS[:1] * n, task_pool=FORKS, seed=seed), Plan(n)
    rows.reset()
    plan.start([True] * n)

    for _ in range(150):
        call, later, mask = chance.randrange(11), chance.random() < 0.6, [chance.random() < 0.4 for _ in range(n)]
        action, places = torch.tensor(chance.choices(range(3), k=n)), chance.choices(range(4), k=n)
        if call < 6:
            arguments = (action, torch.tensor(mask)) if call < 2 else (torch.tensor(mask),)
            getattr(rows, ("step_or_reset", "reset", "restart")[call // 2])(*arguments)
            plan.start(mask)
        elif call == 6:
            rows.set_tasks([FORKS[place] for place in places], later)
            plan.set(places, None, later)
        elif call == 7:
            switch = ByEpisode(chance.randint(1, 2), chance.random() < 0.5)
            rows.switch_tasks([FORKS[place] for place in places], switch, later)
            plan.set(places, switch, later)
        elif call == 8:
            rows.set_goals(torch.tensor(places))
            plan.goals = places
        elif call == 9:
            rows.set_seed(chance.randrange(100))
            plan.set(plan.places, plan.switch, False)
        else:
            rows.load_state_dict(copy.deepcopy(rows).state_dict())
            rows = copy.deepcopy(rows)
        assert (rows.task.tolist(), rows.goal_leaf.tolist()) == (plan.tasks, plan.goals)
        rows.step(action)


@dataclass(frozen=True)
class Asked:
    """A user's own switch: to the next task, and what it was asked."""

    log: list
    together: bool = False

    def next_task(self, task: Tensor, clock: Tensor, num_tasks: int, words: tuple[Tensor, ...]) -> Tensor:
        self.log.append((task.tolist(), clock.tolist(), num_tasks, [word.tolist() for word in words[:2]]))
        return (task + 1) % num_tasks


@pytest.mark.parametrize("together", [False, True])
def test_a_users_own_switch_is_asked_with_the_last_task_and_new_words(together):
    log: list = []
    rows = switching(FORKS[1:], Asked(log, together), 3)

    found = started(rows, 4)

    assert found.tolist() == [[number] * 3 for number in (0, 1, 2, 0)]
    asked = log[-3:]
    assert [(task, clock, number) for task, clock, number, _ in asked] == [
        ([last] * 3, [clock] * 3, 3) for last, clock in ((0, 1), (1, 2), (2, 3))
    ]
    assert min(clock for _, clocks, *_ in log for clock in clocks) == 1
    words = [word for *_, both in asked for one in both for word in one]
    assert all(0 <= word < 2**32 for word in words)
    assert len(set(words)) == (6 if together else 18)
    others = philox.draw(rows.seed, rows.row, torch.arange(6).unsqueeze(-1), philox.STREAM_STEP)
    assert not {word for both in others[:2] for word in both.flatten().tolist()} & set(words)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ByEpisode(0), r"episodes must be an integer in 1..2\*\*31, got 0"),
        (lambda: ByEpisode(2**31 + 1), r"episodes must be an integer in 1..2\*\*31, got 2147483649"),
        (lambda: ByEpisode(1.0), r"episodes must be an integer in 1..2\*\*31, got 1.0"),
        (lambda: Drift(True), r"episodes must be an integer in 1..2\*\*31, got True"),
        (lambda: Drift(3, together=1), "together must be true or false, got 1"),
        (lambda: ByEpisode(3, together=None), "together must be true or false, got None"),
        (lambda: AtRandom(0), r"prob must be in \(0, 1\], got 0"),
        (lambda: AtRandom(1.01), r"prob must be in \(0, 1\], got 1.01"),
        (lambda: AtRandom(float("nan")), r"prob must be in \(0, 1\], got nan"),
        (lambda: AtRandom("often"), r"prob must be in \(0, 1\], got 'often'"),
        (lambda: AtRandom(0.5, together="no"), "together must be true or false, got 'no'"),
        (lambda: Drift(0, together=2), r"episodes must be .*got 0; together must be true or false, got 2"),
    ],
)
def test_a_switch_out_of_range_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_the_largest_drift_and_the_rarest_change_are_drawn_as_they_should():
    words = tuple(torch.tensor([word]) for word in (0, 2**32 - 1))
    last = torch.tensor([2**31 - 1])

    assert Drift(2**31).next_task(torch.tensor([0]), last, 2, words[:1] * 2).item() == 1
    assert Drift(2**31).next_task(torch.tensor([0]), last, 2, words[1:] * 2).item() == 0
    assert AtRandom(2.0**-32).next_task(torch.tensor([0]), last, 2, words).item() == 1
    assert AtRandom(2.0**-32).next_task(torch.tensor([0]), last, 2, words[::-1]).item() == 0


# Where a change takes effect


@pytest.mark.parametrize("switch", PER_ROW[:1] + TOGETHER[:1])
def test_every_episode_follows_the_tree_goal_and_images_of_its_own_task(switch):
    env = env_of(TREES, switch, 5)
    plain, shown_ids = [PlainCTGraph(TREES[0]) for _ in range(5)], set()
    data = env.reset()

    for actions in scripts(150, 5, num_actions=4):
        before = env.tasks
        step, data = env.step_and_maybe_reset(data.set("action", actions))
        expected = [row.step(action) for row, action in zip(plain, actions.tolist(), strict=True)]
        assert {key: [now[key] for now in expected] for key in expected[0]} == {
            key: step["next", key].flatten().tolist() for key in expected[0]
        }
        assert data["is_init"].flatten().tolist() == [now["done"] for now in expected]
        for row, now in enumerate(expected):
            assert env.tasks[row] == before[row] or now["done"]
            assert step["next", "task_id"][row].argmax() == TREES.index(before[row])
            assert data["task_id"][row].argmax() == TREES.index(env.tasks[row])
            if now["done"]:
                plain[row] = PlainCTGraph(env.tasks[row])
                assert torch.equal(data["observation"][row, 0], env.tasks[row].images.images[0])
                shown_ids.add(data["task_id"][row].argmax().item())

    assert shown_ids == {0, 1, 2}


def test_rewards_and_waiting_are_those_of_the_episodes_task():
    poor, rich = replace(one_hot(2, 1), fail_reward=-1), replace(one_hot(2, 1, p=0.9), goal_reward=4, step_reward=0.25)
    env = env_of([poor, rich], ByEpisode(), 400)
    env.reset()

    failed = [act(env, [1] * 400)["reward"].unique().tolist() for _ in range(2)]
    env.reset()
    act(env, [0] * 400)
    stayed = act(env, [0] * 400)

    assert failed == [[0.0], [-1.0]]
    assert stayed["reward"].unique().tolist() == [0.25]
    assert binomial_p_value(int((env.state_type == 1).sum()), 400, 0.9) >= ALPHA


def test_goals_that_change_start_anew_with_their_task_and_last_as_long():
    first, second = (
        replace(one_hot(2, 8, goal=goal), goal_change=(n, n)) for goal, n in (((1,) * 8, 3), ((2,) * 8, 4))
    )
    rows = switching([first, second], ByEpisode(5), 2, seed=1)

    goals = torch.stack([(rows.reset(), rows.goal_leaf)[1] for _ in range(15)])

    for start, own, lasts in ((0, 0, 3), (5, 255, 4), (10, 0, 3)):
        assert goals[start : start + lasts].unique().tolist() == [own]
        assert (goals[start + lasts : start + 5] != own).all()


def test_a_goal_that_changes_goes_on_where_another_row_has_a_new_task():
    changing, other = replace(one_hot(2, 8), goal_change=(3, 3)), one_hot(2, 8, goal=(2,) * 8)
    rows = Rows([changing] * 2, task_pool=[changing, other])
    rows.reset(), rows.reset()
    rows.set_tasks([other, changing], at_episode_end=True)

    goals = [(rows.reset(), rows.goal_leaf.tolist())[1] for _ in range(2)]

    assert goals[0] == [255, 0]
    assert goals[1][0] == 255 and goals[1][1] != 0


def drive(kind: str, env: CTGraphEnv, actions: Tensor) -> TensorDict:
    """Data of actions by one of the ways in which TorchRL starts episodes."""
    if kind == "fused":
        return record(env, actions)
    if kind == "wrapped":
        return record(TransformedEnv(env), actions)
    if kind == "rollout":
        script = iter(actions)
        return env.rollout(
            len(actions), lambda tensordict: tensordict.set("action", next(script)), break_when_any_done=False
        )
    data, steps = env.reset(), []
    for action in actions:
        steps.append(env.step(data.set("action", action)).clone())
        data = step_mdp(steps[-1])
        if data["done"].any():
            data = env.reset(data.set("_reset", data["done"].clone()))
    return torch.stack(steps, dim=1)


@pytest.mark.parametrize("switch", [*PER_ROW, *TOGETHER])
def test_every_way_of_starting_episodes_gives_the_same_data(switch):
    actions = scripts(36, 6, num_actions=4)

    fused, *others = (
        drive(kind, env_of(RICH, switch), actions) for kind in ("fused", "wrapped", "rollout", "reset by hand")
    )

    assert fused["task_id"].flatten(0, 1).sum(0).min() > 10
    assert all(same(fused.select(*other.keys(True, True)), other) for other in others)


@pytest.mark.parametrize("switch", [*PER_ROW, *TOGETHER])
def test_rows_change_their_tasks_alike_in_all_calls_that_start_episodes(switch):
    batches = [switching(RICH, switch, 6, seed=4) for _ in range(3)]
    first, second, third = batches
    generator, seen = torch.Generator().manual_seed(2), set()
    everyone = torch.ones(6, dtype=torch.bool)
    begun = [first.reset().observation, second.restart(), third.reset(everyone).observation]
    assert all(torch.equal(begun[0], other) for other in begun)

    for actions in scripts(40, 6, num_actions=4):
        mask = torch.rand(6, generator=generator) < 0.3
        reset, restarted = first.reset(mask).observation, second.restart(mask)
        mixed = third.step_or_reset(actions, mask).observation
        assert torch.equal(reset, restarted) and torch.equal(reset[mask], mixed[mask])
        assert all(torch.equal(first.task, other.task) for other in batches)
        third.state = first.state
        assert all(torch.equal(*pair) for pair in zip(first.state, second.state, strict=True))
        stepped = [rows.step(actions).observation for rows in batches]
        assert all(torch.equal(stepped[0], other) for other in stepped)
        seen.update(first.task.tolist())
    assert len(seen) > 1


@pytest.mark.parametrize("switch", PER_ROW)
def test_a_changing_row_depends_on_its_seed_and_number_alone(switch):
    actions = scripts(36, 6, num_actions=4)

    whole = record(env_of(RICH, switch), actions)

    assert whole["task_id"].flatten(0, 1).sum(0).min() > 5
    for first, last in ((0, 1), (1, 4), (4, 6)):
        part = record(env_of(RICH, switch, last - first, first_row=first), actions[:, first:last])
        assert same(whole[first:last], part)


@pytest.mark.parametrize("switch", PER_ROW[1:])
def test_rows_and_seeds_change_their_tasks_differently(switch):
    found = [started(switching(FORKS[:2], switch, 64, seed=seed), 3)[2] for seed in (1, 2)]

    assert not torch.equal(*found)
    assert all(0 < row.sum() < 64 for row in found)


@pytest.mark.parametrize("switch", [*PER_ROW, *TOGETHER])
def test_a_seed_starts_the_switch_anew(switch):
    env, actions = env_of(RICH, switch), scripts(40, 6, num_actions=4)
    first = record(env, actions)

    env.set_seed(3)

    assert env.tasks == (RICH[0],) * 6
    assert same(record(env, actions), first)


# Checkpoints and copies


def half_way(switch: Switch | None, pending: bool) -> CTGraphEnv:
    """In the middle of a switch, or of a change at the end of the episode."""
    env = env_of(RICH, switch)
    record(env, scripts(15, 6, num_actions=4))
    if pending and switch is not None:
        env.switch_tasks(RICH[1:], switch, at_episode_end=True)
    elif pending:
        env.set_tasks(RICH[1:] * 3, at_episode_end=True)
        action, data = scripts(1, 6)[0], env.reset(TensorDict({"_reset": torch.arange(6).view(6, 1) < 2}, [6]))
        env.step_and_maybe_reset(data.set("action", action))
    return env


HALF_WAY = [(None, True), *((switch, pending) for switch in (*PER_ROW, *TOGETHER[1:]) for pending in (False, True))]


@pytest.mark.parametrize(("switch", "pending"), HALF_WAY)
def test_a_checkpoint_in_the_middle_of_a_change_is_continued_bit_for_bit(switch, pending):
    env, other = half_way(switch, pending), env_of(RICH, None, seed=8)
    if switch is not None:
        other.switch_tasks(RICH[1:] if pending else RICH, switch)
    saved = copy.deepcopy(env.state_dict())
    actions, data = scripts(30, 6, num_actions=4, seed=1), env.reset(TensorDict({"_reset": env.rows.is_done}, [6]))

    other.load_state_dict(saved)
    again = other.reset(TensorDict({"_reset": other.rows.is_done}, [6]))

    assert other.tasks == env.tasks
    assert same(record(other, actions, again), record(env, actions, data))


@pytest.mark.parametrize(("switch", "pending"), HALF_WAY[:3])
@pytest.mark.parametrize("clone", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"])
def test_a_copy_goes_on_as_its_original_and_neither_disturbs_the_other(clone, switch, pending):
    env, twin = half_way(switch, pending), half_way(switch, pending)
    actions, data = scripts(20, 6, num_actions=4, seed=1), env.reset(TensorDict({"_reset": env.rows.is_done}, [6]))
    again = twin.reset(TensorDict({"_reset": twin.rows.is_done}, [6]))

    cloned = clone(env)
    expected = record(twin, actions, again)

    assert same(record(cloned, actions, data.clone()), expected)
    assert same(record(env, actions, data), expected)
