"""The rules by which tasks change where episodes start."""

from __future__ import annotations

import copy
import random
from dataclasses import dataclass

import pytest
import torch
from helpers.oracles import (
    ALPHA,
    binomial_p_value,
    is_uniform,
    one_hot,
)
from helpers.task_families import started, switching
from torch import Tensor

from ctgraph_rl import Rows
from ctgraph_rl.core import philox
from ctgraph_rl.tasks.switch import AtRandom, ByEpisode, Drift

FORKS = [one_hot(2, 2, goal=goal) for goal in ((1, 1), (1, 2), (2, 1), (2, 2))]
"""Tasks without draws or images, for counting."""


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


@pytest.mark.parametrize(
    ("switch", "share"), [(AtRandom(0.25, True), 0.25), pytest.param(Drift(2, True), 0.5, marks=pytest.mark.slow)]
)
def test_together_all_rows_have_one_draw_with_the_same_chances(switch, share):
    rows, changed = switching(FORKS[:2], switch, 3), 0

    for seed in range(200):
        rows.set_seed(seed)
        first, second = started(rows, 2).tolist()
        assert first == [0, 0, 0] and second in ([0] * 3, [1] * 3)
        changed += second[0]

    assert binomial_p_value(changed, 200, share) >= ALPHA


@pytest.mark.parametrize("alone", [pytest.param(False, marks=pytest.mark.slow), True])
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


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3))])
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
        (lambda: ByEpisode(1.5), r"episodes must be an integer in 1..2\*\*31, got 1.5"),
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
