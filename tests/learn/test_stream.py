"""The loop over a stream: what rows see, what is evaluated and logged, regret, and resuming."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import partial
from statistics import fmean
from unittest.mock import patch

import pytest
import torch
from helpers.learning import train
from helpers.scripted import Scripted
from helpers.stopped_runs import logs_of_equal_ends, make_agent
from rich.console import Console

import curricula
from baselines.methods.cka_rl import CKARL
from baselines.methods.ewc import EWC
from baselines.methods.finetune import Finetune
from baselines.methods.mask_lc import MaskLC
from baselines.methods.mask_sc import MaskSC
from baselines.methods.packnet import PackNet
from baselines.methods.scratch import Scratch
from ctgraph_rl import Recorder, RunLog, learn_curriculum
from ctgraph_rl.learn.refusals import notes, why_not_together
from ctgraph_rl.log.life_curves import by_windows
from ctgraph_rl.log.scores import scores
from ctgraph_rl.report.terminal import print_summary
from ctgraph_rl.runs.config import composed
from ctgraph_rl.runs.job import build, curriculum_of
from ctgraph_rl.runs.read import read_run
from ctgraph_rl.runs.train import new_agent
from ctgraph_rl.tasks.gain import optimal_gain, reached_by_policies
from ctgraph_rl.tasks.life import Life

EMBEDS = ("every", "num_samples", "buffer_size", "num_references", "num_directions", "num_quantiles")

SAMPLED = {"exact": False, "num_episodes": 4, "every": 0}


def stream(evaluation=None, protocol=None, **changes):
    life = curricula.load("stream", **{"num_tasks": 5, "num_frames": 64, "seed": 2, **changes})
    return replace(
        life,
        evaluation=replace(life.evaluation, **(evaluation or {})),
        protocol=replace(life.protocol, **(protocol or {})),
    )


def at_random(data):
    return data.set("action", torch.randint(0, 3, data.batch_size))


def images(task):
    return {image.tobytes() for image in task.images.images.numpy()}


def learner(life):
    return new_agent(life, make_agent, 3)


@pytest.mark.parametrize("boundaries", ["announced", "hidden"])
def test_rows_see_the_images_of_their_blocks_task(boundaries):
    life = stream(SAMPLED, {"boundaries": boundaries}, wait_prob=0.5)
    agent = Scripted(at_random, num_envs=4, num_steps=16)

    learn_curriculum(life, agent)

    for number, batch in enumerate(agent.batches):
        own = images(life.tasks[number])
        before = images(life.tasks[max(number - 1, 0)])
        for row in batch["observation"].numpy():
            of_task = [image.tobytes() in own for image in row]
            changed = of_task.index(True)
            assert all(of_task[changed:])
            assert boundaries == "hidden" or changed == 0
            assert all(image.tobytes() in before for image in row[:changed])


def test_regret_in_frames_is_of_every_reward_and_in_episodes_of_finished_ones():
    life = stream(SAMPLED, step_reward=-0.25, fail_reward=-2.0)
    agent = Scripted(at_random, num_envs=4, num_steps=16)

    found = scores(learn_curriculum(life, agent), life)

    paid = sum(batch["next", "reward"].double().sum().item() for batch in agent.batches)
    ends = torch.cat([batch["next"][batch["next", "done"].squeeze(-1)]["episode_reward"] for batch in agent.batches])
    assert found["frame_regret"].value == pytest.approx(5 * 64 * optimal_gain(life.tasks[0]) - paid, abs=1e-5)
    best = life.tasks[0].optimal_value(1.0)
    assert found["regret"].value == pytest.approx((best - ends.double()).sum().item(), abs=1e-5)


def test_a_block_has_its_tasks_evaluations_and_at_its_end_those_of_others():
    life = stream()

    log = learn_curriculum(life, learner(life))

    by_frames: dict[int, list[int]] = {}
    for m in log.of_kind("evaluation"):
        by_frames.setdefault(m["frames"], []).append(m["task"])
    within = {frames: [1 + frames // 64] for frames in range(8, 320, 8) if frames % 64}
    assert by_frames == {0: [1], **within, 64: [1, 2], 128: [2, 3, 1], 192: [3, 4, 2], 256: [4, 5, 3], 320: [5, 4]}
    untrained = [m["task"] for m in log.of_kind("evaluation") if "untrained_return" in m]
    assert untrained == [2, 3, 4, 5]
    assert "trained" not in log.measurements[0]


def test_an_agent_that_does_not_learn_has_no_jump_start_and_equal_returns():
    life = stream({"greedy": False})
    agent = learner(life)
    agent.learn = lambda batch: {}

    log = learn_curriculum(life, agent)
    found = scores(log, life)

    assert found["jump_start"].value == 0.0
    assert found["never_adapted"].value == 1.0
    assert found["retention_1"].value == pytest.approx(1.0)
    assert found["average_performance"].undefined == (
        "a stream has too many tasks for a matrix: its metrics are those of windows"
    )


@pytest.mark.parametrize("boundaries", [pytest.param("announced", marks=pytest.mark.slow), "hidden"])
def test_a_resumed_life_ends_with_the_same_weights(boundaries, tmp_path):
    life = stream({"every": 0}, {"boundaries": boundaries}, num_tasks=3, num_frames=80)

    logs = logs_of_equal_ends(life, lambda: learner(life), tmp_path)

    without = [[json.dumps({**m, "seconds": 0}) for m in log.measurements] for log in logs]
    assert without[1] == without[0]
    assert without[2] == without[0]


def test_an_unfinished_life_and_noisy_episodes_have_no_windows():
    life = stream(SAMPLED, reward_std=1.0)
    log = learn_curriculum(life, Scripted(at_random, num_steps=16))
    cut = RunLog()
    cut.measurements = [m for m in log.measurements if m["frames"] < 200]

    assert "set evaluation.exact=true" in scores(log, life)["window_return"].undefined
    assert scores(cut, life)["window_return"].undefined == "the run is not finished: it ended block 3 of 5"


@pytest.mark.parametrize(("settings", "seed"), [(["seed=7"], 7), (["seed=7", "curriculum.seed=9"], 9)])
def test_a_runs_seed_draws_its_tasks_unless_the_curriculum_has_one(settings, seed):
    life = curriculum_of(composed(["curriculum=stream", *settings]), Finetune())

    assert life.tasks[:3] == curricula.load("stream", seed=seed).tasks[:3]


def test_a_run_starts_with_few_tasks_made():
    def stop(make_state, at_block_end):
        raise StopIteration

    with patch.object(Life, "_draw_task", autospec=True, side_effect=Life._draw_task) as drawn:
        life = stream(num_tasks=10_000, protocol={"task_id": "at_boundaries"})
        agent = Scratch().attach(learner(life), life)
        Recorder(life)
        with pytest.raises(StopIteration):
            learn_curriculum(life, agent, checkpoint=stop)

    assert 0 < drawn.call_count < 10


def test_experts_of_a_stream_are_refused(tmp_path):
    with pytest.raises(ValueError, match="experts=true trains one for each task"):
        build(composed(["curriculum=stream", "agent=ppo", "experts=true"]), tmp_path)


def test_seeds_with_lives_of_their_own_are_not_trained_as_one_batch():
    assert why_not_together(stream()) is None
    assert "give curriculum.seed=0" in why_not_together(stream(seed=None))


def test_ids_of_a_stream_are_those_of_first_blocks():
    life = stream(order="returning", share=1.0, lag=2, protocol={"task_id": "one_hot"})
    agent = Scripted(at_random, num_envs=4, num_steps=16)
    agent.policy_for = lambda task: agent.policy

    learn_curriculum(replace(life, evaluation=replace(life.evaluation, **SAMPLED)), agent)

    shown = [batch["task_id"].long().argmax(-1).unique().tolist() for batch in agent.batches]
    assert shown == [[0], [1], [0], [1], [0]]


@pytest.mark.parametrize(
    "method",
    [
        Scratch,
        MaskLC,
        partial(PackNet, 0.25),
        partial(CKARL, "actor_head", 3, 1.0, True, 1.0),
        partial(EWC, 1.0, False, 0.5, "policy", num_samples=8, heads="multi"),
        partial(MaskSC, "none", 0.5, 1, **dict.fromkeys(EMBEDS, 1), embedding="lwe"),
    ],
)
def test_a_method_tells_what_it_keeps_for_each_task_and_is_refused_beyond_memory(method):
    def attached(num_tasks):
        life = stream(num_tasks=num_tasks, protocol={"task_id": "at_boundaries"})
        return method().attach(learner(life), life)

    def num_bytes(agent):
        return sum(each.nbytes for each in (*agent.method.buffers(), *agent.method.parameters()))

    life = stream(num_tasks=30, protocol={"task_id": "at_boundaries"})
    agent = attached(30)
    each = (num_bytes(agent) - num_bytes(attached(20))) // 10

    (note,) = notes(life, agent)

    name = type(agent.method).__name__
    assert note == f"{name} keeps {each:,} bytes for each task, {30 * each:,} in all, and in each checkpoint"
    another = learner(life)
    with (
        patch("ctgraph_rl.checks.memory_bytes", lambda: 90 * each),
        pytest.raises(ValueError, match=f"need {90 * each:,} bytes, this machine has {90 * each:,}; use fewer tasks"),
    ):
        method().attach(another, life)


def test_similarities_of_masks_keep_an_embedding_for_each_task():
    life = stream(protocol={"task_id": "at_boundaries"})
    settings = dict.fromkeys(EMBEDS, 2) | {"embedding": "lwe"}

    kept = [
        MaskSC(selection, 0.5, 1, **settings).attach(learner(life), life).method.bytes_per_task
        for selection in ("none", "similarity")
    ]

    assert kept[1] - kept[0] == 4 * 2 * (12 * 12 + 3 + 1)


@patch("baselines.methods.method.MOST_COPIES", 3)
def test_an_agent_keeps_copies_of_its_policy_for_few_tasks():
    life = stream(num_tasks=8, num_frames=64, protocol={"task_id": "at_boundaries"})
    agent = Scratch().attach(learner(life), life)
    for task in range(8):
        agent.start_task(task)

    policies = [agent.policy_for(task) for task in range(7)]

    assert len({id(policy) for policy in policies}) == 7
    assert len(agent._copies) == 3


@pytest.fixture(scope="module")
def run_of_twelve(tmp_path_factory):
    folder = tmp_path_factory.mktemp("life")
    life = stream({"every": 0, "greedy": False}, num_tasks=12)
    train(life, learner(life), folder, 0, config={"agent": {"_target_": "baselines.a2c.A2C"}, "seed": 0})
    return read_run(folder)


def test_tables_of_a_life_have_windows_in_place_of_tasks(run_of_twelve):
    run = run_of_twelve

    log = RunLog.read(run.path / "run.jsonl")
    at_end = {}
    for m in log.of_kind("evaluation"):
        if m["moment"] == "after":
            at_end.setdefault(m["block"], m["return_mean"])
    assert run.history.labels[:4] == ("tasks 1-2", "tasks 3-4", "task 5", "task 6")
    assert run.history.evaluations["tasks 3-4"] == [(4 * 64, pytest.approx(fmean((at_end[3], at_end[4]))))]
    assert run.windows("window_return")[1] == pytest.approx(fmean((at_end[3], at_end[4])))
    assert all(math.isnan(value) for value in run.windows("retention_100"))
    assert [curve[-1][0] for curve in run.history.training.values()][:3] == [2 * 64, 4 * 64, 5 * 64]
    assert [len(curve) for curve in run.history.training.values()] == [2, 2, *[1] * 8]
    assert run.metrics["never_adapted"]["value"] == 1.0
    console = Console(width=80, record=True)
    print_summary(run.path, console)
    printed = console.export_text()
    assert "…" not in printed
    assert ">= 64.00" in printed and ">= 0.00" not in printed
    assert "adaptation frames: at least; 100% of tasks never reach 0.9" in printed


def test_windows_of_a_tuning_run_are_of_the_blocks_that_it_learned(run_of_twelve):
    whole = RunLog.read(run_of_twelve.path / "run.jsonl")
    tuning = RunLog()
    tuning.measurements = [m for m in whole.measurements if m.get("block", 0) <= 3]
    about = tuning.measurements[0]
    tuning.measurements[0] = {**about, "config": {**about["config"], "objective_until": 0.25}}

    found = by_windows(tuning)

    assert found.labels(3) == ("task 1", "task 2", "task 3")
    assert found.ends() == [0, 64, 128, 192]


def test_a_windows_training_is_the_mean_over_episodes():
    batches = [{"frames": 32, "episodes": 1, "return_mean": 0.0}, {"frames": 64, "episodes": 3, "return_mean": 1.0}]
    log = RunLog()
    log.measurements = [{"kind": "run", "life": 1}, *({"kind": "training", "block": 1, **each} for each in batches)]

    [window] = by_windows(log).of_kind("training")

    assert (window["frames"], window["episodes"], window["return_mean"]) == (64, 4, 0.75)


def test_figures_of_a_life_have_the_lines_of_policies_that_do_not_learn(run_of_twelve):
    pytest.importorskip("matplotlib")
    from ctgraph_rl.report.figures.heatmaps import transfer_maps
    from ctgraph_rl.report.figures.life_windows import life_windows
    from ctgraph_rl.report.sections import sections

    [section] = sections([run_of_twelve])

    returns, _, lost, _ = life_windows(section).figure.axes
    tasks, mean_returns = returns.lines[1].get_data()

    reached = reached_by_policies(stream().tasks[0], 64)
    assert tasks.tolist() == [2, 4, 5, 6, 7, 8, 9, 10, 11, 12]
    assert mean_returns.tolist() == run_of_twelve.windows("window_return")
    grey = [{round(line.get_ydata()[0], 9) for line in axes.lines[2:]} for axes in (returns, lost)]
    assert grey[0] == {round(each.at_end, 9) for each in reached.values()}
    assert grey[1] == {round(each.in_frames / 64, 9) for each in reached.values()}
    assert transfer_maps(section, section.results[0], None) is None
