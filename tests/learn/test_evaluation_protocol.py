"""When, on what and how a curriculum is evaluated, and that training does not notice."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from typing import Any

import pytest
import torch
from helpers.scripted import OBSERVATIONS, ONE, TWO, Scripted, Told, decide, random_decision, sequence, task
from helpers.small_agents import SMALL_AGENT
from tensordict import TensorDict
from torch import Tensor

from ctgraph_rl import Block, Curriculum, Evaluation, OneHot, RunLog, evaluate, learn_curriculum
from ctgraph_rl.core.dynamics import OUTCOME_GOAL
from ctgraph_rl.learn.collect import make_env
from ctgraph_rl.learn.evaluate import Evaluator
from ctgraph_rl.runs import config
from ctgraph_rl.tasks.curriculum import Protocol
from ctgraph_rl.tasks.switch import Drift

BLOCKS = (Block(ONE, 20), Block(TWO, 28), Block(ONE, 12))
THREE, FOUR = (replace(ONE, goal_reward=reward) for reward in (3.0, 4.0))


def at(log: RunLog) -> list[tuple[int, int, str]]:
    """(frames, block, moment) of the evaluations, each once, in order."""
    return list(dict.fromkeys((m["frames"], m["block"], m["moment"]) for m in log.of_kind("evaluation")))


# When


@pytest.mark.parametrize("boundaries", ["announced", "hidden"])
def test_evaluations_fall_on_their_frames_even_within_batches(boundaries):
    how = Evaluation(2, every=8)
    agent = Told()
    log = learn_curriculum(sequence(evaluation=how, protocol=Protocol(boundaries=boundaries)), agent)

    during = [(8, 1), (16, 1), (24, 2), (32, 2), (40, 2)]
    expected = sorted([(0, 0, "before"), *((*where, "during") for where in during), (20, 1, "after"), (48, 2, "after")])
    assert at(log) == expected
    order = [(m["kind"][0], m["frames"]) for m in log.measurements if m["kind"] == "training" or m["task"] == 1]
    assert (
        " ".join(f"{kind}{frames}" for kind, frames in order)
        == {
            "announced": "e0 e8 t12 e16 t20 e20 e24 t32 e32 e40 t44 t48 e48",
            "hidden": "e0 e8 t12 e16 e20 t20 t24 e24 e32 t36 e40 t48 e48",
        }[boundaries]
    )


def test_a_batch_over_a_hidden_boundary_is_a_line_for_each_block():
    log = learn_curriculum(sequence(evaluation=Evaluation(2), protocol=Protocol(boundaries="hidden")), Told())

    lines = [(m["block"], m["frames"], m["episodes"], m["return_mean"]) for m in log.of_kind("training")]
    assert lines == [(1, 12, 0, None), (1, 20, 4, 1.0), (2, 24, 0, None), (2, 36, 4, 1.0), (2, 48, 4, 0.0)]


def test_evaluations_within_a_batch_see_the_agent_as_it_acts():
    agent = Told(num_steps=4)
    agent.policy = lambda data: decide(1 + len(agent.batches) % 2)(data)

    log = learn_curriculum(sequence(Block(ONE, 48), evaluation=Evaluation(1, every=8)), agent)

    returns = {m["frames"]: m["return_mean"] for m in log.of_kind("evaluation")}
    assert returns == {0: 1.0, 8: 1.0, 16: 0.0, 24: 0.0, 32: 1.0, 40: 1.0, 48: 0.0}


def test_the_agent_is_told_of_the_end_of_a_task_before_it_is_evaluated():
    told: list[Any] = []
    agent = Told(lambda data: (told.append(agent.events[-1]) if data.numel() == 2 else None, decide(1)(data))[1])

    learn_curriculum(sequence(Block(ONE, 12), evaluation=Evaluation(2, before=False)), agent)

    assert set(told) == {"end"}


# On which tasks, and what the log holds


def matrix(log: RunLog) -> list[list[float | None]]:
    return [[None if math.isnan(value) else value for value in row] for row in log.performance().tolist()]


@pytest.mark.parametrize(
    ("how", "expected"),
    [
        ({}, [[1, 0]] * 4),
        ({"before": False}, [[None, None], *[[1, 0]] * 3]),
        ({"tasks": "seen"}, [[None, None], [1, None], [1, 0], [1, 0]]),
        ({"tasks": "seen", "held_out": THREE}, [[None, None], [1, None], [1, 0], [1, 0]]),
        ({"at_block_ends": False}, [[1, 0], *[[None, None]] * 3]),
        ({"at_block_ends": False, "before": False, "every": 12}, [[None, None], [None, None], [1, 0], [1, 0]]),
    ],
)
@pytest.mark.parametrize("boundaries", ["announced", "hidden"])
def test_performance_is_nan_where_nothing_was_evaluated(how, expected, boundaries):
    curriculum = sequence(*BLOCKS, evaluation=Evaluation(2, **how), protocol=Protocol(boundaries=boundaries))

    log = learn_curriculum(curriculum, Told())

    assert matrix(log) == expected


def test_seen_tasks_are_those_of_the_blocks_up_to_the_present_one():
    blocks = (Block(ONE, 8), Block((TWO, THREE), 8, Drift(2)), Block(ONE, 8), Block(FOUR, 8))
    curriculum = sequence(*blocks, evaluation=Evaluation(1, every=4, tasks="seen"))

    log = learn_curriculum(curriculum, Told())

    seen: dict[int, list[int]] = {}
    for m in log.of_kind("evaluation"):
        seen.setdefault(m["frames"], []).append(m["task"])
    assert seen == {
        frames: [1, 2, 3, 4][:known] for frames, known in zip(range(4, 36, 4), (1, 1, 3, 3, 3, 3, 4, 4), strict=True)
    }


@pytest.mark.parametrize("tasks", ["all", "seen"])
def test_held_out_tasks_are_evaluated_each_time_and_never_acted_in_otherwise(tasks):
    curriculum = sequence(evaluation=Evaluation(3, tasks=tasks, held_out=(THREE, FOUR)))
    agent = Told()

    log = learn_curriculum(curriculum, agent)

    held = [m for m in log.of_kind("evaluation") if m["held_out"]]
    found = [(m["frames"], m["task"], m["return_mean"], m["episodes"]) for m in held]
    assert found == [(frames, *of, 3) for frames in (0, 20, 48) for of in ((3, 3.0), (4, 4.0))]
    assert [m["label"] for m in held[:2]] == list(curriculum.evaluated_labels[2:])
    assert curriculum.labels == curriculum.evaluated_labels[:2]
    assert len(set(curriculum.evaluated_labels)) == 4
    assert log.performance().shape == (3, 2)
    assert torch.cat(agent.batches, dim=1)["next", "reward"].max() == 1


def test_evaluations_with_changing_goals_need_several_episodes_a_row_of_held_out_tasks_too():
    changing = replace(THREE, goal_change=(1, 1))

    with pytest.raises(ValueError, match="tasks with goal_change need episodes_per_row > 1"):
        idle = Told(lambda data: pytest.fail("acted"))
        learn_curriculum(sequence(evaluation=Evaluation(2, before=False, held_out=changing)), idle)
    log = learn_curriculum(sequence(evaluation=Evaluation(2, held_out=changing, episodes_per_row=2)), Told())

    assert {m["episodes"] for m in log.of_kind("evaluation")} == {2}


# Training does not notice


@contextmanager
def no_evaluation() -> Iterator[None]:
    """Nothing is evaluated, whatever a curriculum says."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Evaluator, "evaluate_if_due", lambda self, agent, frames: None)
        yield


def trained(build: Callable[[], Any], curriculum: Curriculum) -> dict[str, Tensor]:
    """The weights after learning a curriculum, and the state of torch's generator."""
    agent = build()
    torch.manual_seed(11)
    learn_curriculum(curriculum, agent, seed=5)
    return {**{name: value.clone() for name, value in agent.named_parameters()}, "rng": torch.get_rng_state()}


@pytest.mark.parametrize(
    ("name", "protocol", "greedy"),
    [
        ("dqn", Protocol(boundaries="hidden"), False),
        ("lstm_ppo", Protocol("one_hot", "hidden"), True),
        pytest.param("dqn", Protocol(), True, marks=pytest.mark.slow),
        pytest.param("lstm_ppo", Protocol(), True, marks=pytest.mark.slow),
    ],
)
def test_agents_learn_the_same_weights_with_and_without_evaluation(compose, name, protocol, greedy):
    waiting = task(wait_prob=0.3)
    blocks = (Block(waiting, 16 * 11), Block((TWO, waiting), 16 * 10, Drift(3)))
    often = Evaluation(2, greedy, every=16 * 3, held_out=THREE)
    curriculum = sequence(*blocks, evaluation=often, protocol=protocol)

    def build():
        cfg = compose(f"agent={name}", *SMALL_AGENT[name])
        env = make_env(curriculum, [TWO], 0)
        torch.manual_seed(1)
        return config.target(cfg, "agent")(env.observation_spec_unbatched, env.action_spec_unbatched)

    with no_evaluation():
        first = trained(build, curriculum)
    second = trained(build, curriculum)

    untrained = dict(build().named_parameters())
    assert any(not torch.equal(untrained[key], first[key]) for key in untrained)
    assert all(torch.equal(first[key], second[key]) for key in first)


@pytest.mark.parametrize("boundaries", ["hidden", pytest.param("announced", marks=pytest.mark.slow)])
def test_training_data_are_the_same_with_and_without_evaluation(boundaries):
    blocks = (Block(task(wait_prob=0.5), 52), Block((TWO, task(wait_prob=0.9)), 48, Drift(2)))
    agents = [Scripted(decide(random_decision), num_steps=5) for _ in range(2)]

    often = Evaluation(3, greedy=False, every=4, held_out=FOUR)
    for agent, context in zip(agents, (no_evaluation(), nullcontext()), strict=True):
        torch.manual_seed(7)
        with context:
            learn_curriculum(
                sequence(*blocks, evaluation=often, protocol=Protocol(boundaries=boundaries)), agent, seed=3
            )

    assert all((one == other).all() for one, other in zip(*(agent.batches for agent in agents), strict=True))
    assert all(torch.equal(*states) for states in zip(*(agent.rng_states for agent in agents), strict=True))


def test_evaluations_at_the_same_frames_have_the_same_seed_whatever_else_is_evaluated():
    waiting = task(wait_prob=0.5)
    lengths = []
    for how in (Evaluation(40, every=8), Evaluation(40, before=False)):
        log = learn_curriculum(sequence(Block(waiting, 16), Block(waiting, 8), evaluation=how), Told(), seed=2)
        lengths.append({m["frames"]: m["length_mean"] for m in log.of_kind("evaluation")})

    assert lengths[1] == {frames: lengths[0][frames] for frames in (16, 24)}
    assert len(set(lengths[0].values())) == 4


# What the policy is told in evaluation


def marked(home: int, goal: int) -> Any:
    """A task that is known by what its home state shows."""
    x = replace(OBSERVATIONS, home_ids=(home, home))
    return replace(ONE, goal=(goal,), observations=x, images=OneHot(8))


MARKED = [marked(5, 1), marked(6, 2), marked(7, 1)]


class PerTask(Told):
    """Knows by the task's id what to decide, and keeps what each of its policies acts in."""

    def __init__(self, decisions: dict[int | None, int]) -> None:
        super().__init__()
        self.decisions, self.acted = decisions, []
        self.policy = self.policy_for(None)

    def policy_for(self, task):
        def policy(data):
            homes = data["observation"][data["is_init"].flatten()][:, 5:].argmax(-1) + 5
            self.acted.append((task, data.numel(), tuple(homes.unique().tolist())))
            return decide(self.decisions[task])(data)

        return policy


def test_where_ids_are_given_at_boundaries_each_tasks_own_policy_acts_in_its_rows_alone():
    first, second, third = MARKED
    protocol, how = Protocol("at_boundaries", task_ids=(4, 9)), Evaluation(3, before=False, held_out=third)
    agent = PerTask({4: 1, 9: 2, None: 2})
    blocks = (Block(first, 12), Block(second, 12))

    log = learn_curriculum(sequence(*blocks, protocol=protocol, evaluation=how), agent)

    evaluated = [acted for acted in agent.acted if acted[1] == 3]
    assert evaluated[:3] == [(4, 3, (5,)), (9, 3, (6,)), (None, 3, (7,))]
    assert {(task, homes) for task, _, homes in evaluated if homes} == {(4, (5,)), (9, (6,)), (None, (7,))}
    assert len(evaluated) == 2 * 3 * 4
    assert [m["success_rate"] for m in log.of_kind("evaluation")] == [1.0, 1.0, 0.0] * 2
    assert {task for task, rows, _ in agent.acted if rows == 4} == {None}


def test_seen_tasks_alone_are_asked_for_their_policies():
    agent = PerTask({0: 1, 1: 2, None: 1})
    protocol, how = Protocol("at_boundaries"), Evaluation(2, tasks="seen")

    learn_curriculum(sequence(*(Block(one, 12) for one in MARKED[:2]), protocol=protocol, evaluation=how), agent)

    evaluated = [(task, homes) for task, rows, homes in agent.acted if rows == 2 and homes]
    assert list(dict.fromkeys(evaluated)) == [(0, (5,)), (1, (6,))]
    assert sum(task == 0 for task, _ in evaluated) == 2 * sum(task == 1 for task, _ in evaluated)


def test_memory_of_each_slice_is_its_own():
    """A policy that counts the steps of its rows: its memory would be of a wrong shape or value otherwise."""
    agent = Told()

    def counting_to(limit: int):
        def policy(data):
            memory = data["memory"] + 1
            assert (data["memory"][:, 0] == data["step_count"][:, 0]).all()
            return decide(limit)(data).set(("next", "memory"), memory)

        return policy

    agent.policy_for = lambda task: counting_to(task + 1)
    agent.policy = counting_to(1)
    agent.initial_state = lambda rows: TensorDict({"memory": torch.zeros(rows, 1, dtype=torch.int64)}, [rows])

    log = learn_curriculum(sequence(protocol=Protocol("at_boundaries"), evaluation=Evaluation(3)), agent)

    assert log.performance().tolist() == [[1.0, 1.0]] * 3


def by_id(data):
    """Decides what the shown id says; 1 where there is none."""
    return decide(1 + data["task_id"][:, 1].long())(data)


def test_one_hot_ids_are_shown_in_training_and_evaluation_and_held_out_tasks_have_none():
    agent = Told(by_id)
    how = Evaluation(2, every=4, held_out=(FOUR, replace(TWO, goal_reward=5.0)))

    log = learn_curriculum(sequence(protocol=Protocol("one_hot", "hidden", 3), evaluation=how), agent)

    outcomes = torch.cat(agent.batches, dim=1)["next", "outcome"].unique().tolist()
    assert outcomes == [0, OUTCOME_GOAL]
    assert agent.batches[0]["task_id"].shape == (4, 3, 3)
    assert {(m["task"], m["return_mean"]) for m in log.of_kind("evaluation")} == {(1, 1), (2, 1), (3, 4), (4, 0)}


def test_evaluate_shows_the_ids_of_a_curriculum_that_it_is_given():
    told = sequence(protocol=Protocol("one_hot"))

    result = evaluate(by_id, [TWO, ONE], 4, curriculum=told)

    assert result["outcome"].flatten().tolist() == [OUTCOME_GOAL] * 8
    with pytest.raises(ValueError, match="tasks must be in task_pool"):
        evaluate(by_id, [THREE], 4, curriculum=told)
    with pytest.raises(KeyError, match="task_id"):
        evaluate(by_id, [TWO, ONE], 4)
