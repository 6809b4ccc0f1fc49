"""All metrics of a run, from its curriculum and log."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import pytest

import curricula
from ctgraph_rl import Block, Curriculum, Evaluation, Gradient, RunLog, metrics
from ctgraph_rl.log.scores import evaluation_noise, inputs_of, optimal_values, scores
from ctgraph_rl.tasks.configurations import ct_co_b1, ct_fo_b1, ct_su_b1
from ctgraph_rl.tasks.observability import state_entropy
from ctgraph_rl.tasks.task import Task
from ctgraph_rl.tasks.values import open_loop_ceiling, random_frames_to_goal

OF_THE_TASKS = (
    *("open_loop_ceiling", "memoryless_ceiling", "optimal_performance"),
    *("state_entropy_random", "state_entropy_navigation", "state_entropy_optimal"),
)
"""Metrics that say what the tasks allow, whatever was learned."""

COUNTING = (
    *("instant_cumulative_return", "total_performance_over_time", "relative_forgetting", "stage_reached", "regret"),
    *("tasks_learned", "frames_to_mastery", "online_return", "frames_to_first_reward", "adapted_return"),
)
"""Metrics that some evaluations, or some training, would be enough for."""

OF_CURVES = ("continual_world_performance", *COUNTING[:3], *COUNTING[5:7])

TASKS = ct_su_b1((1, 1)), ct_su_b1((1, 2))
CURRICULUM = Curriculum("two", 1, "here", (Block(TASKS[0], 200), Block(TASKS[1], 200)), Evaluation(every=100))


def evaluate(log: RunLog, moment: str, block: int, frames: int, *returns: float, **more: float) -> None:
    for task, (label, value) in enumerate(zip(CURRICULUM.labels, returns, strict=False), 1):
        where = {"block": block, "frames": frames, "task": task, "label": label, "held_out": False}
        log.append("evaluation", moment=moment, **where, return_mean=value, success_rate=value, **more)


def train(log: RunLog, block: int, frames: int, episodes: int, successes: int) -> None:
    rate = successes / episodes if episodes else math.nan
    log.append("training", block=block, frames=frames, episodes=episodes, return_mean=rate, success_rate=rate)


@pytest.fixture
def log() -> RunLog:
    log = RunLog()
    evaluate(log, "before", 0, 0, 0.0, 0.0)
    train(log, 1, 100, 10, 1)
    evaluate(log, "during", 1, 100, 0.5, 0.25)
    train(log, 1, 200, 10, 10)
    evaluate(log, "after", 1, 200, 1.0, 0.5)
    train(log, 2, 300, 0, 0)
    evaluate(log, "during", 2, 300, 0.5, 0.5)
    train(log, 2, 400, 10, 5)
    evaluate(log, "after", 2, 400, 0.25, 1.0, end_rate=1.0)
    return log


def expert(*returns: float) -> RunLog:
    log = RunLog()
    for i, value in enumerate(returns, 1):
        train(log, 1, 100 * i, 4, round(4 * value))
        evaluate(log, "after" if i == len(returns) else "during", 1, 100 * i, value)
    return log


def test_the_scores_hold_every_definition_once_with_the_summary_first(log):
    found = scores(log, CURRICULUM)

    assert set(found) == set(metrics.definitions())
    assert list(found)[:4] == list(metrics.summary(log.performance(), CURRICULUM.trained))
    assert all(
        metric == found[name] for name, metric in metrics.of_matrix(log.performance(), CURRICULUM.trained).items()
    )


def test_what_is_known_in_closed_form_is_taken_from_the_tasks(log):
    found = scores(log, CURRICULUM)

    assert optimal_values(TASKS).tolist() == [1.0, 1.0]
    assert found["normalised_performance"].terms == (0.25, 1.0)
    assert found["stage_reached"].terms == (1.0, 2.0)
    assert found["regret"].terms == (9.0, 0.0, 0.0, 5.0)
    random_frames = random_frames_to_goal(TASKS[0])
    places = 100 * (11 / 2) / 10, 100 + 100 * (11 / 6) / 10
    assert found["frames_to_first_reward"].terms == pytest.approx(
        [place / random_frames for place in places], rel=1e-12
    )
    assert found["search_efficiency"].terms == pytest.approx([2.5 / (11 / 2), 2.5 / (11 / 6)], rel=1e-12)


def test_tasks_are_learned_by_the_share_of_their_own_optimum():
    blocks = CURRICULUM.blocks[0], Block(replace(TASKS[1], goal_reward=2.0), 200)
    doubled = replace(CURRICULUM, blocks=blocks, evaluation=Evaluation())
    log = RunLog()
    for block, returns in ((0, (0.0, 0.0)), (1, (0.95, 0.0)), (2, (0.0, 1.5))):
        if block:
            train(log, block, 200 * block, 10, 5)
        evaluate(log, "after", block, 200 * block, *returns)

    assert scores(log, doubled)["tasks_learned"].terms == (1.0, 0.0)


@pytest.mark.parametrize(
    ("rewards", "threshold"),
    [
        ({"goal_reward": -2.0, "fail_reward": -12.0}, -1.2),  # any end but the goal pays 0
        ({"goal_reward": 0.0, "fail_reward": 0.0}, 0.0),
        ({"step_reward": -0.5}, -1.2),  # failing at once is best, -1, and 6 steps to an end without the goal worst, -3
        ({"step_reward": -0.5, "fail_reward": -9.0}, -3.0),  # 6 steps to the goal are best, -2, and failing last, -12
        ({"goal_reward": 2.0, "fail_reward": -1.0}, 1.8),  # 0.9 times a positive optimum, whatever the worst is
    ],
)
def test_the_optimal_policy_masters_a_task_whatever_the_sign_of_its_optimum(rewards, threshold):
    task = replace(ct_su_b1((1, 1)), **rewards)
    learned = Curriculum("one", 1, "here", (Block(task, 200),))
    log, best = RunLog(), task.optimal_value(1.0)
    evaluate(log, "before", 0, 0, best)
    evaluate(log, "after", 1, 200, best)

    found = inputs_of(log, learned, None)["mastery_thresholds"].item()

    assert found == pytest.approx(threshold, abs=1e-12)
    assert metrics.tasks_learned(log.curves(learned.trained), found).value == 1


def of_noisy(task: Task, returns: Sequence[float], shares: Sequence[float | None]) -> dict[str, metrics.Metric]:
    """The scores of a run on a task, with its returns and its shares of episodes at the goal."""
    learned = Curriculum("one", 1, "here", (Block(task, 200),), Evaluation(every=100, num_episodes=4))
    log = RunLog()
    moments = ("before", "during", "after")
    for number, (moment, value, share) in enumerate(zip(moments, returns, shares, strict=True)):
        evaluate(log, moment, min(number, 1), 100 * number, value)
        log.measurements[-1] |= {"success_rate": share, "end_rate": 1.0}
    return scores(log, learned)


def test_a_return_that_noise_takes_beyond_a_threshold_is_no_mastery():
    noisy = replace(ct_su_b1((1, 1)), reward_std=0.4)  # 4 standard deviations of a mean of 4 episodes are 0.8

    never = of_noisy(noisy, (0.7, 1.3, 0.95), (0.0, 0.25, 0.25))
    late = of_noisy(noisy, (0.0, 1.3, 0.85), (0.0, 0.75, 1.0))
    small = of_noisy(noisy, (0.0, 0.1, 0.7), (0.0, 0.1, 0.0))

    assert never["tasks_learned"].value == 0 and never["stage_reached"].value == 1
    assert (never["frames_to_mastery"].value, never["frames_to_mastery"].n_undefined) == (None, 1)
    assert late["tasks_learned"].value == 1 and late["frames_to_mastery"].value == 200
    assert late["relative_forgetting"].value == pytest.approx(0.45 / 1.3)
    assert small["relative_forgetting"].undefined.endswith("and the noise of its rewards")


def test_without_shares_or_a_goal_that_pays_mastery_under_noise_is_not_known():
    noisy = replace(ct_su_b1((1, 1)), reward_std=0.4)
    unpaid = replace(noisy, goal_reward=-1.0)

    for found in (of_noisy(noisy, (1.0,) * 3, (None,) * 3), of_noisy(unpaid, (1.0,) * 3, (1.0,) * 3)):
        assert found["tasks_learned"].value is None and "is not known" in found["tasks_learned"].undefined
        assert found["frames_to_mastery"].n_undefined == 0 and found["frames_to_mastery"].value is None


def test_exact_means_have_no_noise():
    noisy = replace(ct_su_b1((1, 1)), reward_std=0.4)

    assert evaluation_noise(noisy, Evaluation(num_episodes=4)) == 0.2
    assert evaluation_noise(noisy, Evaluation(exact=True)) == 0.0


def test_without_experts_what_needs_them_is_undefined(log):
    found = scores(log, CURRICULUM)

    names = {name for name, metric in found.items() if metric.undefined == "no experts were given"}
    assert names == {
        *("relative_performance", "sample_efficiency"),
        *("continual_world_forward_transfer", "forward_transfer_from_experts"),
    }


def test_experts_give_transfer_and_relative_performance(log):
    found = scores(log, CURRICULUM, [expert(0.5, 0.75), expert(0.0, 0.5)])

    assert found["continual_world_forward_transfer"].terms == pytest.approx(
        [(0.75 - 0.625) / (1 - 0.625), (0.75 - 0.25) / (1 - 0.25)], abs=1e-12
    )
    own, alone = (1 + 10) + (1 + 100), (1 + 50) + (1 + 75)
    assert found["relative_performance"].terms == pytest.approx([own / alone, (1 + 50) / (1 + 0)], abs=1e-12)


def test_the_lifelong_metrics_are_on_the_known_range(log):
    found = scores(log, CURRICULUM)

    assert found["maintenance_of_evaluation"].terms == (-75.0, None)
    assert found["forward_transfer_ratio"].value == 51.0


def test_experts_that_do_not_fit_are_refused(log):
    with pytest.raises(ValueError, match="experts must be one log for each of 2 tasks, got 1"):
        scores(log, CURRICULUM, [expert(0.5, 0.75)])


def test_the_log_of_another_curriculum_is_refused_by_its_fingerprint(log):
    shorter = replace(CURRICULUM, name="short", blocks=(CURRICULUM.blocks[0], Block(TASKS[1], 100)))
    log.measurements.insert(0, {"kind": "run", "curriculum": "two", "fingerprint": CURRICULUM.fingerprint})
    log.measurements[0]["trained"] = [[1], [2]]

    assert scores(log, CURRICULUM)["average_performance"].value == 0.625
    with pytest.raises(ValueError, match="give the curriculum that the run learned, with all its changes") as error:
        scores(log, shorter)
    both = f"of two (fingerprint {CURRICULUM.fingerprint}), not of short ({shorter.fingerprint})"
    assert both in str(error.value)


TRANSFER = ("continual_world_forward_transfer", "forward_transfer_from_experts")


def test_experts_with_other_evaluations_leave_transfer_undefined_after_a_whole_run(log):
    fewer, none, uneven = expert(0.5), expert(), RunLog()
    evaluate(none, "before", 0, 0, 0.5)
    for frames in (50, 150, 200):
        evaluate(uneven, "during", 1, frames, 0.5)

    for other, reason in (
        (fewer, "the expert of task 1 needs 2 evaluations as its block, got 1"),
        (none, "the definition needs evaluations at equal distances in block 1"),
        (uneven, "the definition needs evaluations at equal distances in block 1"),
    ):
        found = scores(log, CURRICULUM, [other, expert(0.5, 0.5)])
        assert [found[name].undefined for name in TRANSFER] == [reason] * 2
        assert found["average_performance"].value == 0.625


def test_a_task_trained_again_leaves_transfer_undefined_for_that_reason(log):
    again = replace(CURRICULUM, blocks=(*CURRICULUM.blocks, Block(TASKS[0], 200)))
    evaluate(log, "during", 3, 500, 0.5, 0.5)
    evaluate(log, "after", 3, 600, 0.5, 0.5)

    found = scores(log, again, [expert(0.5, 0.5), expert(0.5, 0.5)])

    reason = "the definition needs each task trained once, task 1 is in 2 blocks"
    assert [found[name].undefined for name in TRANSFER] == [reason] * 2


def test_one_evaluation_a_block_has_a_mean_and_no_trapezoid(log):
    log.measurements = [m for m in log.measurements if m.get("moment") != "during"]

    found = scores(log, replace(CURRICULUM, evaluation=Evaluation()), [expert(0.5), expert(0.5)])

    assert found[TRANSFER[0]].terms == (1.0, 1.0)
    assert found[TRANSFER[1]].undefined == "areas by trapezoids need 2 evaluations, task 1 has 1 in its block"


def test_an_expert_without_a_finished_episode_is_none(log):
    idle = expert(0.5, 0.5)
    idle.measurements = [m for m in idle.measurements if m["kind"] != "training"]

    assert scores(log, CURRICULUM, [idle, expert(0.0, 0.5)])["relative_performance"].terms == (None, 51.0)


def test_transfer_by_areas_below_1_is_undefined_where_the_optimum_is_another(log):
    doubled = replace(CURRICULUM, blocks=(CURRICULUM.blocks[0], Block(replace(TASKS[1], goal_reward=2.0), 200)))

    found = scores(log, doubled, [expert(0.5, 0.75), expert(0.0, 0.5)])

    assert {found[name].undefined for name in TRANSFER} == {"the definition needs tasks whose optimal value is 1"}


def test_an_end_step_more_is_in_the_frames_of_the_random_policy(log):
    slower = [replace(task, extra_end_step=True) for task in TASKS]
    reference = replace(CURRICULUM, blocks=tuple(Block(task, 200) for task in slower))

    assert scores(log, reference)["frames_to_first_reward"].terms == pytest.approx([55 / 654, (100 + 110 / 6) / 654])


@pytest.mark.parametrize("reached", [0, 100, 200, 300])
def test_a_run_that_is_not_finished_has_no_value_but_those_of_its_tasks(log, reached):
    log.measurements = [m for m in log.measurements if m["frames"] <= reached]

    found = scores(log, CURRICULUM)

    assert {name for name, metric in found.items() if metric.value is not None} == {*OF_THE_TASKS}
    reason = f"the run is not finished: its last evaluation is after {reached} of 400 frames"
    assert {found[name].undefined for name in COUNTING} == {reason}


def test_training_that_is_not_logged_to_the_end_has_no_sums(log):
    log.measurements = [m for m in log.measurements if m["kind"] != "training" or m["frames"] < 400]

    found = scores(log, CURRICULUM)

    reason = "training is logged up to 300 of 400 frames: log it to the end"
    assert {found[name].undefined for name in ("regret", "online_return", "search_efficiency")} == {reason}
    assert found["average_performance"].value == 0.625


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({300: None}, "evaluations are missing after 300 frames"),
        ({100: None, 0: None}, "evaluations are missing after 0, 100 frames"),
        ({100: 150}, "evaluations are missing after 100 frames"),
        ({100: (100, 120, 140)}, "the protocol has no evaluations after 120, 140 frames"),
    ],
)
def test_curves_that_were_not_measured_where_the_protocol_says_give_no_area_and_no_sum(log, changed, reason):
    measured = []
    for m in log.measurements:
        frames = m["frames"]
        moments = changed.get(frames, frames) if m["kind"] == "evaluation" else frames
        for moment in moments if isinstance(moments, tuple) else [moments]:
            if moment is not None:
                measured.append({**m, "frames": moment})
    log.measurements = sorted(measured, key=lambda m: m["frames"])

    found = scores(log, CURRICULUM, [expert(0.5, 0.5), expert(0.5, 0.5)])

    explained = f"{reason}: evaluate exactly where Curriculum.moments says"
    assert {found[name].undefined for name in (*OF_CURVES, *TRANSFER)} == {explained}
    assert found["average_performance"].value == 0.625


def test_frames_count_from_where_the_curriculum_says_that_a_block_starts(log):
    log.measurements = [m for m in log.measurements if m.get("frames") != 200]
    log.measurements[1]["success_rate"] = 0.0

    frames = scores(log, CURRICULUM)["frames_to_first_reward"].terms[1]

    assert frames * random_frames_to_goal(TASKS[0]) == pytest.approx(100 + 110 / 6)


def test_blocks_of_several_tasks_leave_the_lifelong_metrics_undefined(log):
    together = replace(CURRICULUM, blocks=(Block(TASKS, 200), Block(TASKS[1], 200)))

    found = scores(log, together)

    assert "block 1 trains several" in found["performance_recovery"].undefined
    assert found["search_efficiency"].undefined == "needs first blocks that train one task each"
    assert found["regret"].value == 14.0


def test_a_regret_against_different_optima_in_one_block_is_unknown(log):
    together = replace(CURRICULUM, blocks=(Block((TASKS[0], replace(TASKS[1], goal_reward=2.0)), 200),) * 2)

    assert scores(log, together)["regret"].value is None


def test_an_optimum_that_is_not_known_is_said(log, monkeypatch):
    monkeypatch.setattr("ctgraph_rl.tasks.values.MAX_ENUMERATED_STATES", 1)
    from ctgraph_rl import Gradient

    large = replace(TASKS[1], reward_fn=Gradient())

    found = scores(log, replace(CURRICULUM, blocks=(CURRICULUM.blocks[0], Block(large, 200))))

    assert (found["normalised_performance"].value, found["normalised_performance"].n_undefined) == (None, 1)
    assert found["mean_training_performance"].undefined == "a task's optimal value is not known: its graph is too large"


def test_no_score_is_infinite_or_nan(log):
    values = [metric.value for metric in scores(log, CURRICULUM, [expert(1.0, 1.0), expert(0.0, 0.0)]).values()]

    assert all(value is None or math.isfinite(value) for value in values)


def test_what_is_lost_and_what_is_nothing_are_of_the_task_of_each_block(log):
    worse = replace(TASKS[0], fail_reward=-1.0), replace(TASKS[1], goal_reward=2.0)
    others = replace(CURRICULUM, blocks=tuple(Block(task, 200) for task in worse))

    found = scores(log, others)

    assert found["regret"].terms == (9.0, 0.0, 0.0, 15.0)
    assert found["normalised_performance"].terms == (1.25 / 2, 0.5)
    assert found["mean_training_performance"].terms == pytest.approx([1 + 50 * (1.1 + 2.0) / 2, 1 + 50 * 0.5])


def test_first_rewards_are_of_the_first_block_of_a_task(log):
    again = replace(CURRICULUM, blocks=(*CURRICULUM.blocks, Block(TASKS[0], 200)))
    train(log, 3, 600, 1, 1)
    evaluate(log, "after", 3, 600, 1.0, 1.0)

    assert scores(log, again)["search_efficiency"].terms[0] == pytest.approx(2.5 / (11 / 2))


def test_each_transfer_has_its_own_area():
    alone = replace(CURRICULUM, blocks=(Block(TASKS[0], 300),), evaluation=Evaluation(every=100, before=False))
    uneven, flat = expert(0.0, 0.0, 0.75), expert(0.0, 0.0, 0.0)

    found = scores(uneven, alone, [flat])

    assert [found[name].value for name in TRANSFER] == [0.25, 0.1875]


def test_ceilings_and_entropies_are_those_of_the_tasks_and_the_gap_is_closed_by_what_memory_gains():
    tasks = [ct_su_b1((1, 1)), ct_su_b1((1, 2)), ct_co_b1((2, 1))]
    learned = Curriculum("three", 1, "test", [Block(task, 100) for task in tasks])
    log = RunLog()
    for task, mean in enumerate((1.0, 0.25, 0.625), 1):
        shares = {"return_mean": mean, "success_rate": mean, "end_rate": 1.0, "length_mean": 6.0}
        log.append(
            "evaluation", moment="after", block=3, frames=300, task=task, label=str(task), held_out=False, **shares
        )

    found = scores(log, learned)

    assert found["open_loop_ceiling"].terms == (1.0, 1.0, pytest.approx(open_loop_ceiling(tasks[2])))
    assert found["memoryless_ceiling"].terms == (1.0, 0.25, 0.25)
    assert found["optimal_performance"].value == 1.0
    gap = found["memory_gap_closed"]
    assert gap.terms == (None, 0.0, 0.5)
    assert (gap.value, gap.n_undefined) == (0.25, 1)
    for policy in ("random", "navigation", "optimal"):
        exact = tuple(state_entropy(task, policy) for task in tasks)
        assert found[f"state_entropy_{policy}"].terms == pytest.approx(exact) and exact[0] > 0


def test_ceilings_that_are_not_known_say_why_and_tasks_without_a_gap_close_none():
    plain, gradient = ct_fo_b1(), replace(ct_su_b1(), reward_fn=Gradient())
    log = RunLog()
    log.append("run", trained=[[1]])
    evaluate(log, "after", 1, 100, 1.0)
    found = [scores(log, Curriculum("one", 1, "test", [Block(task, 100)])) for task in (plain, gradient)]

    assert "memory gains nothing there" in (found[0]["memory_gap_closed"].undefined or "")
    for name in ("memoryless_ceiling", "memory_gap_closed"):
        reason = found[1][name].undefined or ""
        assert reason.startswith("the memoryless ceiling is exact only for the Needle reward")
    of_four = RunLog()
    of_four.append("run", trained=[[1, 2, 3, 4]])
    evaluate(of_four, "after", 1, 204_800, 1.0)
    changing = scores(of_four, curricula.load("su_b1_changing_goals"))
    for name in ("open_loop_ceiling", "memoryless_ceiling", "memory_gap_closed"):
        assert (changing[name].undefined or "").startswith("ceilings are exact only for goals that stay")
    assert found[1]["open_loop_ceiling"].value == found[1]["optimal_performance"].value == 1.0
    assert [each["state_entropy_random"].value for each in found] == [0.0, pytest.approx(state_entropy(gradient))]
