"""The loop: learn_curriculum, collect and evaluate, with agents that follow a script."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction

import pytest
import torch
from helpers.scripted import DECISION_ID, ONE, TWO, Scripted, counting, curriculum, decide, random_decision, task
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, exploration_type

from ctgraph_rl import (
    Block,
    CTGraphEnv,
    RunLog,
    evaluate,
    learn_curriculum,
)
from ctgraph_rl.core.dynamics import OUTCOME_FAIL, OUTCOME_GOAL, OUTCOME_OTHER_END
from ctgraph_rl.learn import evaluate as evaluation


def test_all_tasks_are_evaluated_before_training_and_after_every_block():
    agent = Scripted(decide(2))

    log = learn_curriculum(curriculum(Block(ONE, 12), Block(TWO, 24), Block(ONE, 12)), agent)

    evaluations = [(m["block"], m["frames"], m["task"], m["label"]) for m in log.of_kind("evaluation")]
    boundaries = ((0, 0), (1, 12), (2, 36), (3, 48))
    assert evaluations == [(*at, *of) for at in boundaries for of in ((1, "goal1"), (2, "goal2"))]
    assert {m["episodes"] for m in log.of_kind("evaluation")} == {5}
    assert log.performance().tolist() == [[0.0, 1.0]] * 4


def test_evaluations_stand_at_the_boundaries_of_the_log():
    log = learn_curriculum(curriculum(Block(ONE, 24), Block(TWO, 12)), Scripted())

    kinds = "".join(measurement["kind"][0] for measurement in log.measurements)

    assert kinds == "ee" + "tt" + "ee" + "t" + "ee"


def test_the_agent_is_told_of_every_task_change():
    agent = Scripted()

    learn_curriculum(curriculum(Block(ONE, 24), Block(TWO, 12)), agent)

    assert agent.events == ["start", ("learn", 4, 3), ("learn", 4, 3), "end", "start", ("learn", 4, 3), "end"]


def test_the_last_batch_of_a_block_is_shortened_and_frames_are_never_overrun():
    agent = Scripted()

    log = learn_curriculum(curriculum(Block(ONE, 28), Block(TWO, 8)), agent)

    assert [tuple(batch.batch_size) for batch in agent.batches] == [(4, 3), (4, 3), (4, 1), (4, 2)]
    assert [m["frames"] for m in log.of_kind("training")] == [12, 24, 28, 36]
    assert [m["block"] for m in log.of_kind("training")] == [1, 1, 1, 2]


def test_every_block_starts_new_episodes_and_none_crosses_its_boundary():
    agent = Scripted()

    learn_curriculum(curriculum(Block(ONE, 24), Block(TWO, 24)), agent)

    first, second = (torch.cat(agent.batches[i : i + 2], dim=1) for i in (0, 2))
    for block in (first, second):
        assert block["is_init"][..., 0].tolist() == [[True, False, False, False, True, False]] * 4
        assert block["step_count"][..., 0].tolist() == [[0, 1, 2, 3, 0, 1]] * 4
    assert set(first["next", "outcome"].flatten().tolist()) == {0, OUTCOME_GOAL}
    assert set(second["next", "outcome"].flatten().tolist()) == {0, OUTCOME_OTHER_END}


def test_episodes_cut_by_a_boundary_are_not_counted():
    log = learn_curriculum(curriculum(Block(ONE, 24), Block(ONE, 12)), Scripted())

    training = log.of_kind("training")

    assert [m["episodes"] for m in training] == [0, 4, 0]
    assert [m["return_mean"] for m in training] == [None, 1.0, None]
    assert [m["length_mean"] for m in training] == [None, 4.0, None]


def test_no_episode_is_no_episode():
    env = CTGraphEnv([ONE, TWO])
    ends = env.reset()[torch.tensor([False, False])]

    [means] = evaluation.means_by_part(ends, [0])

    assert means["episodes"] == 0
    assert all(math.isnan(means[name]) for name in ("return_mean", "success_rate", "length_mean"))


def test_a_batch_is_measured_by_return_success_and_length_of_its_finished_episodes():
    agent = Scripted(decide(lambda data: torch.tensor([1, 2, 1, 1])), num_steps=5)
    paying = replace(ONE, goal_reward=3.0)

    log = learn_curriculum(curriculum(Block(paying, 20), num_episodes=4), agent)

    measured = log.of_kind("training")[0]
    assert (measured["episodes"], measured["return_mean"], measured["success_rate"]) == (4, 2.25, 0.75)
    assert (measured["length_mean"], measured["loss_value"]) == (4.0, 0.5)


def test_success_is_the_goal_and_no_threshold_of_reward():
    agent = Scripted(decide(lambda data: torch.tensor([1, 2, 1, 1])), num_steps=4)
    punishing = replace(ONE, goal_reward=-2.0)

    log = learn_curriculum(curriculum(Block(punishing, 16), num_episodes=4), agent)

    for measured in (log.of_kind("training")[0], log.of_kind("evaluation")[0]):
        assert (measured["success_rate"], measured["return_mean"]) == (0.75, -1.5)


def test_tasks_of_one_block_share_the_rows():
    agent = Scripted(num_steps=4)

    learn_curriculum(curriculum(Block((ONE, TWO), 16)), agent)

    outcomes = agent.batches[0]["next", "outcome"][:, -1, 0].tolist()
    assert outcomes == [OUTCOME_GOAL, OUTCOME_OTHER_END, OUTCOME_GOAL, OUTCOME_OTHER_END]


@pytest.mark.parametrize(
    ("blocks", "message"),
    [
        (
            (Block(ONE, 12), Block(ONE, 13)),
            "num_frames=13 of block 2 must be a multiple of num_envs=4; nearest: 12 or 16",
        ),
        ((Block((ONE, TWO, task((1, 1))), 12),), "num_envs=4 must be a multiple of the block's 3 tasks"),
    ],
)
def test_a_curriculum_that_does_not_fit_the_rows_is_refused_before_any_work(blocks, message):
    agent = Scripted(policy=lambda data: pytest.fail("acted"))
    log = RunLog()

    with pytest.raises(ValueError, match=message):
        learn_curriculum(curriculum(*blocks), agent, log=log)

    assert (log.measurements, agent.events) == ([], [])


@pytest.mark.parametrize("greedy", [True, False])
def test_evaluation_does_not_disturb_training(monkeypatch, greedy):
    blocks = (Block(task(wait_prob=0.5), 40), Block(TWO, 40))
    disturbed, alone = (Scripted(decide(random_decision), num_steps=5) for _ in range(2))

    torch.manual_seed(7)
    learn_curriculum(curriculum(*blocks, greedy=greedy), disturbed, seed=3)
    monkeypatch.setattr(evaluation, "evaluate", lambda policy, tasks, *args, **how: finished_episodes(len(tasks)))
    torch.manual_seed(7)
    learn_curriculum(curriculum(*blocks, greedy=greedy), alone, seed=3)

    assert len(alone.batches) == 4
    assert all((one == other).all() for one, other in zip(disturbed.batches, alone.batches, strict=True))
    assert all(torch.equal(*states) for states in zip(disturbed.rng_states, alone.rng_states, strict=True))


def finished_episodes(num_tasks: int) -> TensorDict:
    """What evaluate gives, without playing."""
    values = {"episode_reward": 0.0, "step_count": 1, "outcome": OUTCOME_FAIL}
    return TensorDict({k: torch.full((num_tasks, 5, 1), v) for k, v in values.items()}, batch_size=[num_tasks, 5])


def test_evaluate_leaves_the_global_generator_as_it_was_found():
    before = torch.get_rng_state()

    evaluate(decide(random_decision), [ONE], 50, greedy=False)

    assert torch.equal(torch.get_rng_state(), before)


def test_evaluate_depends_on_its_seed_and_not_on_the_global_generator():
    policy = decide(random_decision)

    torch.manual_seed(1)
    first = evaluate(policy, [ONE], 50, seed=5, greedy=False)
    torch.manual_seed(2)
    again, other = (evaluate(policy, [ONE], 50, seed=seed, greedy=False) for seed in (5, 6))

    assert (first == again).all()
    assert not torch.equal(first["outcome"], other["outcome"])


@pytest.mark.parametrize(("greedy", "expected"), [(True, "DETERMINISTIC"), (False, "RANDOM")])
def test_evaluate_is_greedy_or_samples(greedy, expected):
    seen = set()

    def policy(data):
        seen.add(exploration_type())
        return decide(1)(data)

    evaluate(policy, [ONE], 2, greedy=greedy)

    assert seen == {ExplorationType[expected]}


def test_training_explores():
    seen = []
    agent = Scripted(policy=lambda data: (seen.append(exploration_type()), decide(1)(data))[1])

    learn_curriculum(curriculum(Block(ONE, 12), num_episodes=1), agent)

    greedy, explores = ExplorationType.DETERMINISTIC, ExplorationType.RANDOM
    assert seen == [greedy] * 4 + [explores] * 3 + [greedy] * 4


def test_evaluate_plays_the_same_number_of_episodes_on_every_task():
    tasks = [ONE, TWO, task((1, 1)), task((1, 2))]

    result = evaluate(decide(1), tasks, 7)

    assert result.batch_size == (4, 7)
    assert result["outcome"][..., 0].tolist() == [[3] * 7, [2] * 7, [3] * 7, [2] * 7]
    assert result["episode_reward"][..., 0].tolist() == [[1.0] * 7, [0.0] * 7, [1.0] * 7, [0.0] * 7]
    assert result["step_count"][..., 0].tolist() == [[4] * 7, [4] * 7, [6] * 7, [6] * 7]
    assert result["leaf"][..., 0].tolist() == [[0] * 7] * 4


def test_evaluate_refuses_no_episodes():
    with pytest.raises(ValueError, match="num_episodes must be an integer >= 1, got 0"):
        evaluate(decide(1), [ONE], 0)


LIMIT = 18
"""The step at which the impatient policy fails if it is still in a wait state."""


def impatient(data):
    """Solves the task, but gives up at a late step: long episodes fail."""
    action = decide(1)(data)["action"]
    waiting = data["observation"][..., 3].bool()
    return data.set("action", torch.where(waiting & (data["step_count"][..., 0] >= LIMIT), 1, action))


def test_evaluate_takes_the_first_episode_of_every_row():
    patient = task(wait_prob=0.9)
    env = CTGraphEnv([patient] * 200, seed=11)
    first, data = {}, env.reset()
    while len(first) < 200:
        step, data = env.step_and_maybe_reset(impatient(data))
        ends = step["next", "done"].flatten().nonzero().flatten().tolist()
        for row in ends:
            first.setdefault(row, [step["next", key][row].item() for key in ("step_count", "outcome", "leaf")])

    result = evaluate(impatient, [patient], 200, seed=11)

    expected = [first[row] for row in range(200)]
    found = torch.stack([result[key][0, :, 0].long() for key in ("step_count", "outcome", "leaf")], dim=1)
    assert found.tolist() == expected


def test_evaluate_is_not_biased_towards_short_episodes():
    num_episodes, leave = 4000, Fraction(1, 10)
    # Home and decision take a step each; the two waits must be over within the steps 1..LIMIT-1 in all.
    tries = LIMIT - 2
    success = 1 - (1 - leave) ** tries - tries * leave * (1 - leave) ** (tries - 1)

    result = evaluate(impatient, [ONE, task(wait_prob=0.9)], num_episodes, seed=12)

    wins = (result["outcome"] == OUTCOME_GOAL).flatten(1).sum(dim=1).tolist()
    assert wins[0] == num_episodes
    spread = math.sqrt(num_episodes * success * (1 - success))
    assert abs(wins[1] - num_episodes * success) < 5 * spread  # 1e-6
    assert result["step_count"][1].max() == LIMIT + 2


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_measurement_that_is_not_finite_stops_the_run_and_names_block_frames_and_loss(value):
    agent = Scripted()
    learnt = agent.learn
    agent.learn = lambda batch: learnt(batch) | ({"loss_value": value} if len(agent.batches) == 3 else {})

    with pytest.raises(FloatingPointError, match=f"loss_value is {value} in block 2 after 36 frames"):
        learn_curriculum(curriculum(Block(ONE, 24), Block(TWO, 24)), agent)

    assert agent.events[-2:] == ["start", ("learn", 4, 3)]


def test_recurrent_state_is_carried_through_batches_and_starts_anew_at_blocks():
    agent = Scripted(counting, num_steps=3)
    agent.initial_state = lambda num_envs: TensorDict({"memory": torch.full((num_envs, 1), -5)}, [num_envs])

    learn_curriculum(curriculum(Block(ONE, 24), Block(TWO, 12)), agent)

    first, second = torch.cat(agent.batches[:2], dim=1), agent.batches[2]
    assert first["memory"][..., 0].tolist() == [[-5, 1, 2, 3, -5, 1]] * 4
    assert first["next", "memory"][..., 0].tolist() == [[1, 2, 3, 4, 1, 2]] * 4
    assert second["memory"][..., 0].tolist() == [[-5, 1, 2]] * 4


def test_recurrent_state_is_carried_in_evaluation():
    """Only one who remembers finds (1, 2) where all decision states look the same."""

    def policy(data):
        decisions = data["memory"].masked_fill(data["is_init"], 0) + data["observation"][..., DECISION_ID, None]
        return decide(decisions[..., 0])(data).set(("next", "memory"), decisions)

    def initial_state(num_envs):
        return TensorDict({"memory": torch.zeros(num_envs, 1, dtype=torch.int64)}, [num_envs])

    result = evaluate(policy, [task((1, 2))], 3, initial_state=initial_state)

    assert result["outcome"].flatten().tolist() == [OUTCOME_GOAL] * 3


def test_progress_is_told_after_every_batch():
    told = []

    class Progress:
        def update(self, block, frames, episode_return):
            told.append((block, frames, episode_return))

    learn_curriculum(curriculum(Block(ONE, 16), Block(TWO, 16)), Scripted(num_steps=4), progress=Progress())

    assert told == [(1, 16, 1.0), (2, 32, 0.0)]


@pytest.mark.parametrize("kind", ["training", "evaluation"])
def test_the_same_seed_gives_the_same_measurements_and_another_seed_others(kind):
    waiting = curriculum(Block(task(wait_prob=0.5), 80))

    def measured(seed: int) -> list[dict]:
        torch.manual_seed(0)
        log = learn_curriculum(waiting, Scripted(decide(random_decision)), seed=seed)
        return [{**m, "seconds": 0} for m in log.measurements if m["kind"] == kind]

    first, again, other = measured(1), measured(1), measured(2)

    assert first == again
    assert first != other


def test_every_evaluation_of_a_run_has_a_seed_of_its_own(monkeypatch):
    seeds = []

    def evaluated(policy, tasks, num_episodes, *, seed, **how):
        seeds.append(seed)
        return finished_episodes(len(tasks))

    monkeypatch.setattr(evaluation, "evaluate", evaluated)
    for run_seed in (0, 1):
        learn_curriculum(curriculum(Block(ONE, 12), Block(ONE, 12)), Scripted(), seed=run_seed)

    assert len(set(seeds) - {0, 1}) == 6
    assert all(0 <= seed < 2**63 for seed in seeds)


def test_a_policy_sees_no_hidden_state_in_the_data():
    keys = set()
    agent = Scripted(policy=lambda data: (keys.update(data.keys()), decide(1)(data))[1])

    learn_curriculum(curriculum(Block(ONE, 12)), agent)

    allowed = {"observation", "is_init", "step_count", "episode_reward", "outcome", "leaf"}
    assert keys <= allowed | {"done", "terminated", "truncated", "action"}


def test_a_bar_shows_progress_where_it_is_asked_for(capsys):
    learn_curriculum(curriculum(Block(ONE, 16), Block(TWO, 16)), Scripted(num_steps=4), progress=True)
    shown = capsys.readouterr().err
    learn_curriculum(curriculum(Block(ONE, 16), Block(TWO, 16)), Scripted(num_steps=4), progress=False)

    assert shown.startswith("block 2/2  32/32 frames  ")
    assert capsys.readouterr().err == ""
