"""Draws: equal when drawn ahead and from the bare core, however rows are run, and uniform where ids are drawn."""

from __future__ import annotations

import copy
import pickle
from dataclasses import replace
from functools import partial

import pytest
import torch
from helpers.oracles import WAIT, act, confounding, is_uniform, one_hot, optimal, scripts, surjective
from helpers.task_families import SWITCHED, VECTORS, calls, read, seen
from torch import Tensor

import curricula
from ctgraph_rl import CTGraphEnv, Steps, Task, rollout
from ctgraph_rl.batch.rows import Rows
from ctgraph_rl.batch.tensor_engine import MAX_TICKS, MAX_WORDS
from ctgraph_rl.core import dynamics

NOISY = replace(confounding(p=0.5, read_rotation=5), reward_std=0.3, goal_change=(1, 3), step_reward=0.5)
TASKS = [*SWITCHED[:4], confounding(p=0.5), NOISY]
PLAIN = [surjective(2, 3), surjective(3, 1)]
"""Nothing to draw: p is 0, one image an id."""

tensor_rows = partial(Rows, kernel="off")
every_engine = pytest.mark.parametrize("kernel", ["off", "required"])


def bare(rows: Rows, name: str, *args: Tensor) -> dynamics.Shown | Tensor:
    """A call of `Rows` by the function of the core alone, which makes every draw when it needs it."""
    rows.state, shown = getattr(dynamics, name)(rows.state, *args, rows.params, rows.uses)
    return shown


def play(rows: Rows, twin: Rows, made: list) -> None:
    """Make calls of rows, and those of a twin by the bare core: equal after each."""
    for number, (name, args) in enumerate(made):
        found, expected = getattr(rows, name)(*args), bare(twin, name, *args)
        pairs = zip([*found, *rows.state], [*expected, *twin.state], strict=True)
        assert all(torch.equal(*pair) for pair in pairs), (number, name)


@pytest.mark.parametrize(
    ("tasks", "num_calls"),
    [(TASKS, MAX_TICKS + 14), pytest.param(VECTORS, 50, marks=pytest.mark.slow), (PLAIN, 50)],
    ids=["images", "vectors", "plain"],
)
def test_draws_ahead_are_those_of_the_bare_core_through_hundreds_of_steps_with_resets(tasks, num_calls):
    rows, twin = (tensor_rows(tasks, seed=3, first_row=2) for _ in range(2))

    made = calls(num_calls, len(tasks))

    assert {name for name, _ in made} == {"step", "reset", "restart", "step_or_reset"}
    play(rows, twin, made)


@pytest.mark.parametrize("room", [0, 5, 6, 12, 6 * MAX_TICKS + 5])
def test_any_number_of_draws_ahead_gives_the_same_draws(monkeypatch, room):
    monkeypatch.setattr("ctgraph_rl.batch.tensor_engine.MAX_WORDS", room)
    rows, twin = (tensor_rows(TASKS, seed=4) for _ in range(2))

    play(rows, twin, calls(30, 6, seed=room))


@pytest.mark.parametrize("num_rows", [MAX_WORDS // 2, MAX_WORDS // 2 + 1, MAX_WORDS + 1])
def test_batches_around_the_size_that_draws_nothing_ahead_have_the_draws_of_the_bare_core(num_rows):
    rows, twin = (tensor_rows([one_hot(p=0.5)] * num_rows, seed=5) for _ in range(2))

    play(rows, twin, calls(5, num_rows, seed=3))


CHANGES = {
    "a seed": lambda rows, saved: rows.set_seed(9),
    "streams": lambda rows, saved: rows.set_streams(torch.arange(7, 13), torch.arange(5, -1, -1)),
    "tasks": lambda rows, saved: rows.set_tasks(TASKS[::-1]),
    "tasks without draws": lambda rows, saved: rows.set_tasks(PLAIN * 3),
    "a state": lambda rows, saved: setattr(rows, "state", saved["state"]),
    "a checkpoint": lambda rows, saved: rows.load_state_dict(saved["checkpoint"]),
    "an assigned checkpoint": lambda rows, saved: rows.load_state_dict(copy.deepcopy(saved["checkpoint"]), assign=True),
    "another's checkpoint": lambda rows, saved: rows.load_state_dict(saved["other"]),
    "another's assigned checkpoint": lambda rows, saved: rows.load_state_dict(saved["other"], assign=True),
    "goals": lambda rows, saved: rows.set_goals(torch.arange(6) % 2),
}


@pytest.mark.parametrize("name", CHANGES)
def test_after_a_change_in_the_middle_the_draws_are_those_of_the_bare_core(name):
    pool = [*TASKS, *PLAIN]
    rows, fresh, other = (tensor_rows(TASKS, seed=seed, task_pool=pool) for seed in (3, 3, 8))
    saved = {}
    for number, (call, args) in enumerate(calls(16, 6)):
        getattr(rows, call)(*args)
        getattr(other, call)(*args)
        if number == 11:
            saved = {"state": rows.state, "checkpoint": copy.deepcopy(rows.state_dict())}
    saved["other"] = copy.deepcopy(other.state_dict())

    CHANGES[name](rows, saved)

    twin = fresh
    if name in ("tasks", "tasks without draws"):
        twin.set_tasks(rows.tasks)
    twin.set_streams(rows.seed.clone(), rows.row.clone())
    twin.state = rows.state
    play(rows, twin, calls(14, 6, seed=1))


def test_new_tasks_have_draws_for_all_that_they_use():
    rows, twin = (
        tensor_rows([surjective()] * 3, seed=1, task_pool=[surjective(), confounding(p=0.5), NOISY]) for _ in range(2)
    )

    for task in (surjective(), confounding(p=0.5), NOISY, surjective(), NOISY):
        for batch in (rows, twin):
            batch.set_tasks([task] * 3)
        play(rows, twin, calls(20, 3))


def test_a_checkpoint_of_another_batch_is_continued_as_there():
    for assign in (False, True):
        rows, other = tensor_rows(TASKS, seed=1), tensor_rows(TASKS, seed=2, first_row=5)
        for batch, steps in ((rows, 12), (other, 20)):
            for name, args in calls(steps, 6):
                getattr(batch, name)(*args)

        rows.load_state_dict(copy.deepcopy(other.state_dict()), assign=assign)

        data = [seen(batch, scripts(15, 6)) for batch in (rows, other)]
        assert all(torch.equal(*pair) for pair in zip(*data, strict=True)), assign


@pytest.mark.parametrize(
    "clone",
    [pytest.param(copy.deepcopy, marks=pytest.mark.slow), lambda rows: pickle.loads(pickle.dumps(rows))],
    ids=["copy", "pickle"],
)
def test_a_clone_goes_on_as_its_original_and_neither_disturbs_the_other(clone):
    rows, twin = (tensor_rows(TASKS, seed=3) for _ in range(2))
    play(rows, twin, calls(15, 6))

    cloned, alike = clone(rows), copy.deepcopy(twin)

    play(cloned, alike, calls(15, 6, seed=1))
    play(rows, twin, calls(15, 6, seed=2))


@pytest.mark.parametrize("kernel", [pytest.param("off", marks=pytest.mark.slow), "required"])
def test_steps_that_are_taken_elsewhere_move_the_draws_too(kernel):
    rows, twin = (tensor_rows(TASKS * 5, seed=3) for _ in range(2))
    play(rows, twin, calls(20, 30))
    waits = torch.zeros(300, 30, dtype=torch.int64)

    for first in (("step", (waits[0],)), ("restart", (torch.arange(30) < 15,))):
        for one in (rows, twin):
            rollout(one, waits, Steps.empty(one, 300), kernel=kernel)
        play(rows, twin, [first, *[("step", (waits[0],))] * 3])


def test_a_step_that_was_refused_changes_nothing():
    rows, twin = (tensor_rows(TASKS, seed=3) for _ in range(2))
    made = calls(30, 6)

    for call in made:
        play(rows, twin, [call])
        with pytest.raises(RuntimeError):
            rows.step(torch.zeros(5, dtype=torch.int64))


def test_rows_can_be_moved_in_the_middle_of_an_episode():
    rows = tensor_rows(TASKS)
    play(rows, tensor_rows(TASKS), calls(20, 6))

    shown = rows.to("meta").step(torch.zeros(6, dtype=torch.int64, device="meta"))

    assert shown.observation.device.type == "meta"


@every_engine
def test_a_step_or_reset_is_a_step_of_some_rows_and_a_reset_of_the_others(kernel):
    rows, stepped, begun = (Rows(TASKS, seed=6, kernel=kernel) for _ in range(3))
    for batch in (rows, stepped, begun):
        batch.reset()

    for action, mask in zip(scripts(50, 6, 4), scripts(50, 6, 2, seed=1).bool(), strict=True):
        shown, steps, begins = rows.step_or_reset(action, mask), stepped.step(action), begun.reset()
        found, step, begin = ([*shown, *rows.state], [*steps, *stepped.state], [*begins, *begun.state])
        for value, going, new in zip(found, step, begin, strict=True):
            assert torch.equal(value[mask], new[mask]) and torch.equal(value[~mask], going[~mask])
        stepped.state = begun.state = rows.state


@every_engine
@pytest.mark.parametrize("tasks", [TASKS, SWITCHED, VECTORS], ids=["draws", "images", "vectors"])
def test_an_act_of_running_rows_is_a_step_that_tells_less(tasks, kernel):
    rows, twin = (Rows(tasks, seed=7, kernel=kernel) for _ in range(2))
    assert torch.equal(rows.restart(), twin.reset().observation)

    for action in scripts(30, len(tasks), 3):
        (observation, done), shown = rows.act(action), twin.step(action)
        found = [
            observation,
            done,
            *(torch.where(done, *pair) for pair in zip(rows.result(done), (0, -1), strict=True)),
        ]
        assert all(torch.equal(*pair) for pair in zip(found, [shown[0], shown[3], *shown[1:3]], strict=True))
        assert torch.equal(rows.restart(done), twin.reset(done).observation)
        assert all(torch.equal(*pair) for pair in zip(rows.state, twin.state, strict=True))


# The same bits


@every_engine
def test_rows_with_all_switches_do_not_depend_on_how_a_batch_is_split(kernel):
    actions = scripts(30, len(SWITCHED), 4)

    whole = seen(Rows(SWITCHED, seed=2, kernel=kernel), actions)
    rows = [Rows([task], seed=2, first_row=i, kernel=kernel) for i, task in enumerate(SWITCHED)]
    parts = [seen(row, actions[:, i : i + 1]) for i, row in enumerate(rows)]

    for i, part in enumerate(parts):
        assert all(torch.equal(x[:, i : i + 1], y) for x, y in zip(whole, part, strict=True))


@pytest.mark.slow
def test_all_switches_compile_into_one_graph():
    rows = tensor_rows(SWITCHED, seed=1)
    rows.reset()
    params, uses = rows.params, rows.uses
    compiled = torch.compile(dynamics.step, fullgraph=True, backend="eager")

    for action in scripts(24, len(SWITCHED), 3):
        expected, found = (flat(step(rows.state, action, params, uses)) for step in (dynamics.step, compiled))
        assert all(torch.equal(*pair) for pair in zip(found, expected, strict=True))
        rows.reset(rows.step(action).done)


def test_all_switches_map_with_vmap():
    rows = tensor_rows(SWITCHED, seed=1)
    rows.reset()
    params, uses = rows.params, rows.uses

    for actions in scripts(24, 2 * len(SWITCHED), 3).view(24, 2, -1):
        expected = [flat(dynamics.step(rows.state, action, params, uses)) for action in actions]
        mapped = flat(torch.vmap(lambda action: dynamics.step(rows.state, action, params, uses))(actions))
        assert all(torch.equal(x, torch.stack(y)) for x, y in zip(mapped, zip(*expected, strict=True), strict=True))
        rows.reset(rows.step(actions[0]).done)


def flat(pair: tuple) -> list[Tensor]:
    state, shown = pair
    return [*state, *shown]


# Ids that are drawn


def test_a_wait_state_draws_another_id_at_every_look_without_unique_ids():
    env = CTGraphEnv([read(p=0.999)] * 20_000, seed=1)
    env.reset()
    act(env, [0] * 20_000)
    before = env.observation_id.clone()

    act(env, [0] * 20_000)

    stayed = env.state_type == WAIT
    pairs = (before - 2) * 5 + env.observation_id - 2
    assert stayed.sum() > 19_900
    assert is_uniform(pairs[stayed].bincount(minlength=25).tolist())


def test_the_ids_of_decision_and_end_states_are_drawn_independently_without_unique_ids():
    env, shown = CTGraphEnv([read()] * 20_000, seed=1), []
    env.reset()
    for _ in range(6):
        act(env, optimal(env))
        shown.append(env.observation_id.clone())

    triples = ((shown[1] - 7) * 3 + shown[3] - 7) * 4 + shown[5] - 10

    assert is_uniform(triples.bincount(minlength=36).tolist())


def test_a_change_of_tasks_reads_no_other_task_of_the_pool(monkeypatch):
    curriculum = curricula.load("su_b1_4tasks")
    task = curriculum.tasks[2]
    rows = Rows([curriculum.tasks[0]] * 2, task_pool=curriculum.tasks)
    read = []
    original = Task.__hash__
    monkeypatch.setattr(Task, "__hash__", lambda task: (read.append(task), original(task))[1])

    rows.set_tasks([task] * 2)

    assert {*map(id, read)} == {id(task)}


def test_ids_of_tasks_are_found_once():
    curriculum = curricula.load("su_b1_4tasks")

    assert curriculum.task_ids is curriculum.task_ids
