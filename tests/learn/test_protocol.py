"""What an agent gets to know: task ids, boundaries, and tasks that change without an announcement."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.oracles import one_hot
from helpers.scripted import ONE, TWO, Told, counting, decide, sequence
from helpers.task_families import RICH, env_of
from tensordict import TensorDict
from torchrl.envs import check_env_specs

from ctgraph_rl import Block, CTGraphEnv, Evaluation, Rows, Steps, learn_curriculum, rollout
from ctgraph_rl.core.dynamics import OUTCOME_GOAL, OUTCOME_OTHER_END
from ctgraph_rl.learn.collect import make_env
from ctgraph_rl.tasks.curriculum import Protocol
from ctgraph_rl.tasks.switch import AtRandom, ByEpisode, Drift

THREE = replace(ONE, goal_reward=3.0)


# Task ids in the data


def test_task_ids_are_shown_as_one_hot_and_as_zeros_where_a_task_has_none():
    env = CTGraphEnv([ONE, TWO, THREE], task_ids={ONE: 3, TWO: 0}, num_task_ids=5)

    shown = env.reset()["task_id"]

    assert shown.dtype == torch.uint8
    assert shown.tolist() == [[0, 0, 0, 1, 0], [1, 0, 0, 0, 0], [0, 0, 0, 0, 0]]
    assert env.observation_spec["task_id"].shape == (3, 5)
    check_env_specs(env, break_when_any_done="both")


def test_torchrl_finds_the_specs_of_changing_tasks_in_order():
    check_env_specs(env_of(RICH, ByEpisode()), break_when_any_done="both")
    check_env_specs(env_of(RICH, AtRandom(0.5, together=True)), break_when_any_done="both")


def test_ids_are_just_long_enough_and_tasks_may_share_one():
    env = CTGraphEnv([ONE, TWO], task_ids={ONE: 2, TWO: 2})

    assert env.reset()["task_id"].tolist() == [[0, 0, 1], [0, 0, 1]]


def test_without_ids_there_are_none_in_the_data():
    env = CTGraphEnv([ONE])

    assert env.num_task_ids == 0
    assert "task_id" not in env.reset() and "task_id" not in env.rollout(2)["next"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_task_ids": 3}, "num_task_ids=3 needs task_ids"),
        ({"task_ids": {}}, r"task_ids must give tasks their ids, integers in 0..1048575, got \[\]"),
        ({"task_ids": {ONE: -1}}, r"task_ids must give tasks their ids, integers in 0..1048575, got \[-1\]"),
        ({"task_ids": {ONE: True}}, r"task_ids must give tasks their ids, integers in 0..1048575, got \[True\]"),
        ({"task_ids": [0]}, r"task_ids must give tasks their ids, integers in 0..1048575, got \[\[0\]\]"),
        ({"task_ids": {ONE: 2}, "num_task_ids": 2}, r"num_task_ids must be an integer in 3..1048576, .*got 2"),
        ({"task_ids": {ONE: 2}, "num_task_ids": 3.5}, r"num_task_ids must be an integer in 3..1048576, .*got 3.5"),
    ],
)
def test_wrong_task_ids_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        CTGraphEnv([ONE], **arguments)


def test_a_task_id_is_a_copy_and_follows_every_change_of_tasks():
    env = CTGraphEnv([ONE, ONE], task_pool=[ONE, TWO], task_ids={ONE: 0, TWO: 1})
    data = env.reset()
    for _ in range(2):
        data["task_id"].fill_(7)
        step, data = env.step_and_maybe_reset(data.set("action", torch.tensor([0, 0])))
        assert step["next", "task_id"].tolist() == data["task_id"].tolist() == [[1, 0], [1, 0]]
        step["next", "task_id"].fill_(7)
    env.set_tasks([ONE, TWO])
    assert env.reset()["task_id"].tolist() == [[1, 0], [0, 1]]
    env.set_tasks([TWO, TWO], at_episode_end=True)
    assert env.reset()["task_id"].tolist() == [[0, 1], [0, 1]]
    env.load_state_dict(CTGraphEnv([TWO, ONE], task_pool=[ONE, TWO]).state_dict())
    assert env.reset()["task_id"].tolist() == [[0, 1], [1, 0]]


def test_an_environment_for_a_curriculum_shows_ids_only_where_the_protocol_does():
    held = Evaluation(held_out=THREE)
    told = sequence(protocol=Protocol("one_hot", num_task_ids=3), evaluation=held)

    shown = make_env(told, [TWO, THREE, ONE], 0).reset()["task_id"]

    assert shown.tolist() == [[0, 1, 0], [0, 0, 0], [1, 0, 0]]
    for without in (Protocol(), Protocol("at_boundaries")):
        assert "task_id" not in make_env(replace(told, protocol=without), [THREE], 0).reset()


# A change at the end of the episode


def fail(env: CTGraphEnv, rows: list[int]) -> TensorDict:
    """The next data after a step that ends the episodes of some rows at a wait state; it resets them."""
    action = torch.zeros(env.numel(), dtype=torch.int64)
    action[rows] = 1
    return env.step_and_maybe_reset(TensorDict({"action": action}, env.batch_size))[1]


WAITING = [one_hot(2, 2, p=0.999999, goal=goal) for goal in ((1, 1), (1, 2), (2, 1), (2, 2))]
"""An episode in a wait state goes on until an action ends it."""


def test_every_row_ends_its_episode_before_it_has_the_next_task():
    env = CTGraphEnv(WAITING[:1] * 3, task_pool=WAITING)
    env.reset()
    fail(env, [])
    env.set_tasks(WAITING[1:], at_episode_end=True)

    seen = [(env.tasks, env.goal_leaf.tolist())]
    for ending in ([1], [], [0], [1], [2]):
        fail(env, ending)
        seen.append((env.tasks, env.goal_leaf.tolist()))
        fail(env, [])

    a, b, c, d = WAITING
    assert [tasks for tasks, _ in seen] == [(a, a, a), (a, c, a), (a, c, a), (b, c, a), (b, c, a), (b, c, d)]
    assert [goals for _, goals in seen] == [[0] * 3, [0, 2, 0], [0, 2, 0], [1, 2, 0], [1, 2, 0], [1, 2, 3]]


def test_a_change_of_plan_before_all_rows_have_changed_replaces_it():
    env = CTGraphEnv(WAITING[:1] * 3, task_pool=WAITING)
    env.reset()
    a, b, c, _ = WAITING
    env.set_tasks([b] * 3, at_episode_end=True)
    fail(env, [])
    fail(env, [0])

    env.set_tasks([c] * 3, at_episode_end=True)
    fail(env, [1])

    assert env.tasks == (b, c, a)
    fail(env, [])
    fail(env, [0, 1, 2])
    assert env.tasks == (c, c, c)
    assert not env.rows.tasks_change


def test_tasks_that_are_set_at_once_replace_what_was_planned():
    env = CTGraphEnv(WAITING[:1] * 2, task_pool=WAITING)
    env.reset()
    env.switch_tasks(WAITING[1:3], ByEpisode(), at_episode_end=True)

    env.set_tasks(WAITING[2:])

    assert env.tasks == tuple(WAITING[2:])
    assert env.rows.is_done.all() and not env.rows.tasks_change
    env.reset(), env.reset()
    assert env.tasks == tuple(WAITING[2:])


def test_a_switch_at_the_end_of_the_episode_counts_each_rows_episodes_from_there():
    env = CTGraphEnv(WAITING[:1] * 2, task_pool=WAITING)
    env.reset()
    fail(env, [])
    env.switch_tasks(WAITING[2:], ByEpisode(2), at_episode_end=True)

    seen = []
    for ending in ([0], [0], [0, 1], [0], [1], [1]):
        fail(env, ending)
        seen.append([WAITING.index(task) for task in env.tasks])
        fail(env, [])

    assert seen == [[2, 0], [2, 0], [3, 2], [3, 2], [3, 2], [3, 3]]


@pytest.mark.parametrize("start", [lambda env: env.set_seed(9), lambda env: env.reset()])
def test_a_seed_or_a_reset_makes_a_planned_change(start):
    env = CTGraphEnv(WAITING[:1] * 2, task_pool=WAITING)
    env.reset()
    env.set_tasks(WAITING[1:3], at_episode_end=True)

    start(env)

    assert (env.tasks, env.goal_leaf.tolist()) == (tuple(WAITING[1:3]), [1, 2])
    assert env.reset()["is_init"].all() and env.tasks == tuple(WAITING[1:3])


def test_rows_that_change_cannot_be_run_fast_until_they_have_changed():
    rows = Rows(WAITING[:1] * 2, task_pool=WAITING)
    rows.reset()
    rows.set_tasks(WAITING[1:3], at_episode_end=True)
    steps = Steps.empty(rows, 4)
    actions = torch.zeros(4, 2, dtype=torch.int64)

    with pytest.raises(ValueError, match="rollout needs rows that keep their tasks"):
        rollout(rows, actions, steps)
    rows.reset()
    rollout(rows, actions, steps)

    rows.switch_tasks(WAITING, ByEpisode())
    with pytest.raises(ValueError, match="rollout needs rows that keep their tasks"):
        rollout(rows, actions, steps)


@pytest.mark.parametrize("at_episode_end", [False, True])
def test_a_checkpoint_keeps_the_tasks_that_were_set(at_episode_end):
    env, other = (CTGraphEnv(WAITING[:1] * 2, task_pool=WAITING) for _ in range(2))
    env.reset()
    env.set_tasks(WAITING[1:3], at_episode_end)

    other.load_state_dict(env.state_dict())
    other.reset()

    assert other.tasks == tuple(WAITING[1:3])
    other.set_seed(1)
    assert other.tasks == tuple(WAITING[1:3])


@pytest.mark.parametrize(
    ("tasks", "switch", "message"),
    [
        (WAITING[:1], ByEpisode(), "switch_tasks needs at least two tasks, got one; use set_tasks"),
        ([], ByEpisode(), "tasks must be a list with at least one Task"),
        ([ONE, TWO], ByEpisode(), "tasks must be in task_pool, got .*; name them at construction"),
        (WAITING[:2], None, r"switch must be one such as Drift\(100\), got None"),
        (WAITING[:2], Drift, r"switch must be one such as Drift\(100\), got <class"),
    ],
)
def test_a_refused_switch_changes_nothing(tasks, switch, message):
    rows = Rows(WAITING[:1] * 2, task_pool=WAITING[:2])
    rows.switch_tasks(WAITING[:2], ByEpisode())
    rows.reset()

    with pytest.raises(ValueError, match=message):
        rows.switch_tasks(tasks, switch, at_episode_end=True)

    assert [(rows.reset(), rows.task.tolist())[1] for _ in range(3)] == [[1, 1], [0, 0], [1, 1]]


def test_what_is_planned_moves_with_the_rows():
    rows = Rows(WAITING[:1] * 2, task_pool=WAITING)
    rows.switch_tasks(WAITING, ByEpisode())

    rows.to("meta")

    assert {part.device.type for part in (*rows.assignment[:4], rows.tables.number, rows.tables.goal_leaf)} == {"meta"}


# Learning with what is told


HIDDEN = Protocol("one_hot", "hidden")


def ends_of(batch: TensorDict) -> list[tuple[int, int, int]]:
    """(step, task id, outcome) of the episodes that end in the first row."""
    after = batch["next"][0]
    steps = after["done"].flatten().nonzero().flatten().tolist()
    return [(step, int(after["task_id"][step].argmax()), int(after["outcome"][step])) for step in steps]


def test_batches_go_over_a_hidden_boundary_and_the_agent_is_told_nothing():
    agent = Told()

    log = learn_curriculum(sequence(protocol=HIDDEN, evaluation=Evaluation(2)), agent)

    assert agent.events == [("start", None), *[("learn", 4, 3)] * 4, "end"]
    assert [(m["frames"], m["block"]) for m in log.of_kind("training")] == [(12, 1), (20, 1), (24, 2), (36, 2), (48, 2)]
    whole = torch.cat(agent.batches, dim=1)
    assert ends_of(whole) == [(3, 0, OUTCOME_GOAL), (7, 0, OUTCOME_GOAL), (11, 1, OUTCOME_OTHER_END)]
    assert whole["task_id"].argmax(-1).tolist() == [[0] * 8 + [1] * 4] * 4
    assert whole["is_init"].flatten().nonzero().flatten()[:3].tolist() == [0, 4, 8]


def test_a_row_whose_episode_ends_with_a_hidden_block_begins_the_next_ones_task():
    agent = Told()

    learn_curriculum(sequence(Block(ONE, 16), Block(TWO, 4), Block(ONE, 28), protocol=HIDDEN), agent)

    whole = torch.cat(agent.batches, dim=1)
    assert whole["task_id"].argmax(-1).tolist() == [[0] * 4 + [1] * 4 + [0] * 4] * 4


def test_a_hidden_block_of_one_step_at_the_start_is_played():
    agent = Told()

    learn_curriculum(sequence(Block(ONE, 4), Block(TWO, 44), protocol=HIDDEN), agent)

    assert torch.cat(agent.batches, dim=1)["task_id"].argmax(-1).tolist() == [[0] * 4 + [1] * 8] * 4


def test_an_announced_boundary_ends_the_episodes_and_shortens_the_batch():
    agent = Told()

    learn_curriculum(sequence(protocol=Protocol("one_hot"), evaluation=Evaluation(2)), agent)

    learnt = [("learn", 4, steps) for steps in (3, 2, 3, 3, 1)]
    assert agent.events == [("start", 0), *learnt[:2], "end", ("start", 1), *learnt[2:], "end"]
    assert ends_of(torch.cat(agent.batches, dim=1)) == [(3, 0, OUTCOME_GOAL), (8, 1, OUTCOME_OTHER_END)]


def test_every_row_goes_over_a_hidden_boundary_at_its_own_episodes_end():
    """Row 0 ends an episode in 4 steps, row 1 in 2, row 2 in 3, row 3 never."""

    def policy(data):
        if data.numel() != 4:  # in evaluation
            return data.set("action", torch.ones(data.batch_size, dtype=torch.int64))
        actions = torch.tensor([0, 1, 0, 0])
        return data.set("action", torch.where(torch.arange(4) == 0, decide(1)(data)["action"], actions))

    lasting = replace(ONE, graph=replace(ONE.graph, wait_prob=0.999999))
    blocks = (Block((ONE, ONE, ONE, lasting), 20), Block((TWO, THREE), 28))
    agent = Told(policy)

    learn_curriculum(sequence(*blocks, protocol=HIDDEN, evaluation=Evaluation(2)), agent)

    whole = torch.cat(agent.batches, dim=1)
    assert whole["task_id"].argmax(-1).tolist() == [[0] * 8 + [2] * 4, [0] * 6 + [3] * 6, [0] * 6 + [2] * 6, [1] * 12]
    assert whole["is_init"].sum(1).flatten().tolist() == [3, 6, 4, 1]


def test_recurrent_state_goes_on_over_a_hidden_boundary():
    agent = Told(counting)
    agent.initial_state = lambda num_envs: TensorDict({"memory": torch.full((num_envs, 1), -5)}, [num_envs])

    learn_curriculum(sequence(protocol=HIDDEN, evaluation=Evaluation(2)), agent)

    memory = torch.cat(agent.batches, dim=1)["memory"][..., 0]
    assert memory.tolist() == [[-5, 1, 2, 3] * 3] * 4


@pytest.mark.parametrize(("boundaries", "frames"), [("announced", (80, 32, 112)), ("hidden", (72, 32, 120))])
def test_a_switch_is_followed_within_its_block_and_starts_anew_with_the_next(boundaries, frames):
    tasks, switches = ((ONE, TWO), THREE, (TWO, ONE, THREE)), (ByEpisode(2), None, ByEpisode())
    blocks = map(Block, tasks, frames, switches)
    agent = Told(num_steps=7)

    learn_curriculum(sequence(*blocks, protocol=Protocol("one_hot", boundaries), evaluation=Evaluation(2)), agent)

    whole = torch.cat(agent.batches, dim=1)
    found = whole["task_id"][:, ::4].argmax(-1).tolist()
    assert found == [[0, 0, 1, 1, 0, 2, 2, 1, 0, 2, 1, 0, 2, 1]] * 4
    assert whole["next", "done"][:, 3::4].all() and whole["next", "done"].sum() == 4 * 14


def test_a_switch_of_all_rows_is_followed_in_learning():
    agent = Told(num_steps=8)

    learn_curriculum(
        sequence(Block((ONE, TWO), 96, ByEpisode(2, together=True)), protocol=HIDDEN, evaluation=Evaluation(2)), agent
    )

    assert torch.cat(agent.batches, dim=1)["task_id"][:, ::4].argmax(-1).tolist() == [[0, 0, 1, 1, 0, 0]] * 4


@pytest.mark.parametrize(
    ("protocol", "told"),
    [
        (Protocol(), [None, None, None]),
        (Protocol("one_hot"), [0, 1, 0]),
        (Protocol("at_boundaries"), [0, 1, 0]),
        (Protocol("at_boundaries", task_ids=(5, 2)), [5, 2, 5]),
    ],
)
def test_the_agent_is_given_the_tasks_id_at_announced_boundaries_unless_it_is_hidden(protocol, told):
    agent = Told()

    learn_curriculum(
        sequence(Block(ONE, 12), Block(TWO, 12), Block(ONE, 12), protocol=protocol, evaluation=Evaluation(2)), agent
    )

    assert [event[1] for event in agent.events if event[0] == "start"] == told
    assert ("task_id" in agent.batches[0]) == (protocol.task_id == "one_hot")


def test_blocks_that_do_not_fit_the_rows_are_refused_behind_hidden_boundaries_too():
    with pytest.raises(
        ValueError, match="num_frames=22 of block 1, 2 must be a multiple of num_envs=4; nearest: 20 or 24"
    ):
        learn_curriculum(sequence(Block(ONE, 22), Block(TWO, 22), protocol=HIDDEN), Told())
