"""Runs that end, or learn no more, after a share of their frames: tuning runs and frozen controls."""

from __future__ import annotations

import pytest
import torch
from helpers.kill_runs import equal
from helpers.scripted import ONE, THREE, TWO, Told, decide, lines, of, random_decision
from helpers.small_agents import REPLAY, TINY, made
from helpers.sweeping import command_line

from ctgraph_rl import Block, RunLog, learn_curriculum
from ctgraph_rl.learn.loop import Alone, Lockstep, run_loop
from ctgraph_rl.log.sums import metrics_of
from ctgraph_rl.report.objective import objective_of
from ctgraph_rl.report.results import main as results_main
from ctgraph_rl.runs.read import find_runs
from ctgraph_rl.runs.train import new_agent, with_method

LIFE = of(Block(ONE, 96), Block(TWO, 96), Block(THREE, 128), task_id="at_boundaries")
"""320 frames; a batch of the agents here is 32, but the last one of a block may be shorter."""

SHORT = ("curriculum.num_frames=128", "agent=ppo", *TINY, "evaluation.num_episodes=2")


class TellsPolicies(Told):
    """A scripted agent that keeps for which tasks it was asked, and then acts by another policy."""

    def policy_for(self, task: int):
        self.events.append(("asked", task))
        return decide(2)

    def state_dict(self):
        return {"told": len(self.events)}

    def load_state_dict(self, state):
        self.events.append(("restored", state["told"]))


def at_random() -> TellsPolicies:
    return TellsPolicies(decide(random_decision), num_envs=8, num_steps=4)


def learned(agent, saved=None, **shares) -> tuple[Lockstep, RunLog, list]:
    """The loop at its end, its log, and its state after each batch."""
    log = RunLog()
    states: list = []
    members = Lockstep(LIFE, Alone(agent), [0], [log], device=torch.device("cpu"), saved=saved, **shares)
    run_loop(members, None, lambda state, at_end: states.append(state()))
    return members, log, states


def built(compose, agent: str, method: str = "finetune", *settings: str):
    make_method = made(compose, "method", method)
    make_agent = made(compose, "agent", agent, *TINY, *settings)
    return new_agent(LIFE, with_method(make_agent, make_method, LIFE), 0)


def test_a_tuning_run_is_the_beginning_of_the_whole_run_up_to_the_first_batch_that_reaches_the_share():
    torch.manual_seed(0)
    whole = lines(learn_curriculum(LIFE, at_random()))

    torch.manual_seed(0)
    inside = lines(learned(at_random(), until=0.35)[1])
    torch.manual_seed(0)
    at_an_end = lines(learned(at_random(), until=0.3)[1])

    assert max(line["frames"] for line in inside) == 128  # the first batch end from 112 frames on
    assert inside == [line for line in whole if line["frames"] <= 128]
    assert at_an_end == [line for line in whole if line["frames"] <= 96] and at_an_end[-1]["moment"] == "after"


def test_a_tuning_run_that_was_stopped_at_its_last_batch_collects_nothing_more():
    _, _, states = learned(TellsPolicies(num_envs=8, num_steps=4), until=0.4)
    agent = TellsPolicies(num_envs=8, num_steps=4)

    members, resumed, _ = learned(agent, saved=states[-1], until=0.4)

    assert members.frames == 128 and resumed.of_kind("training") == []
    assert [event[0] for event in agent.events] == ["restored"]


def test_frozen_agents_neither_learn_nor_explore_less_nor_are_told_of_tasks_while_the_log_goes_on(compose):
    free = built(compose, "dqn", "scratch", *REPLAY)
    log_of_free = learn_curriculum(LIFE, free)
    frozen = built(compose, "dqn", "scratch", *REPLAY)

    _, log, states = learned(frozen, freeze_after=0.4)

    before, *after = [state[0]["agent"] for state in states if state[0]["frames"] >= 128]
    assert len(after) == 6 and all(equal(state, before) for state in after)
    assert not equal(states[0][0]["agent"], before)
    assert not equal(free.state_dict(), before)
    first = [line for line in lines(log) if line["frames"] < 160]
    assert first == [line for line in lines(log_of_free) if line["frames"] < 160]
    assert [line["frames"] for line in lines(log)] == [line["frames"] for line in lines(log_of_free)]


def test_no_batch_that_ends_after_the_share_is_learned_from():
    agent = TellsPolicies(num_envs=8, num_steps=4)

    learned(agent, freeze_after=0.39)  # 124.8 frames; the fourth batch ends after 128

    assert [event for event in agent.events if event[0] != "asked"] == [
        *[("start", 0), *[("learn", 8, 4)] * 3],
        *["end", ("start", 1)],
    ]


def test_a_frozen_agent_acts_by_its_policy_for_the_announced_task_also_once_it_is_resumed():
    agent = TellsPolicies(num_envs=8, num_steps=4)
    _, log, states = learned(agent, freeze_after=0.3)
    successes = [line["success_rate"] for line in log.of_kind("training") if line["episodes"]]
    resumed = TellsPolicies(num_envs=8, num_steps=4)

    _, again, _ = learned(resumed, saved=states[4], freeze_after=0.3)

    assert successes[:3] == [1.0, 1.0, 1.0]  # decides 1, which is right in the first task
    assert successes[3:6] == [1.0, 1.0, 1.0]  # decides 2, which is right in the second
    assert resumed.events.index(("restored", states[4][0]["agent"]["told"])) < resumed.events.index(("asked", 1))
    assert lines(again) == [line for line in lines(log) if line["frames"] > 160]


def test_a_tuning_run_has_metrics_of_training_alone_and_tables_leave_it_out_unless_asked(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    tunes = ("objective=online_return", "objective_until=0.45")  # 231 frames, inside a batch that ends after 256

    assert command_line(monkeypatch, *SHORT, *tunes, "seed=100") == 0
    printed = capsys.readouterr().out
    assert command_line(monkeypatch, *SHORT, "seed=0", "freeze_after=0.5") == 0

    [run], [frozen] = (list(tmp_path.glob(f"runs/*/*-seed{seed}-*")) for seed in (100, 0))
    log = RunLog.read(run / "run.jsonl")
    assert log.training("frames")[-1] == 256
    losses = RunLog.read(frozen / "run.jsonl").training("loss_critic")
    assert losses.isnan().tolist() == [False] * 8 + [True] * 8
    played = [(line["episodes"], line["return_mean"]) for line in log.of_kind("training") if line["episodes"]]
    value = objective_of("online_return", [run])
    assert value == sum(number * mean for number, mean in played) / sum(number for number, _ in played)
    assert f"online_return after 256 frames (objective_until=0.45): {value:.4f}" in printed
    assert f"ctgraph-rl report --tuning {run.relative_to(tmp_path)} makes a page" in printed
    assert "online return" in printed and "undefined" not in printed
    metrics = metrics_of((run / "metrics.json").read_bytes())
    known = {name for name, metric in metrics.items() if metric["value"] is not None}
    assert known >= {"online_return", "regret", "open_loop_ceiling"}
    assert not known & {"average_performance", "frames_to_first_reward"}
    found = [find_runs([tmp_path / "runs"], tuning=tuning)[0] for tuning in (False, True)]
    assert [sorted(each.seed for each in some) for some in found] == [[0], [0, 100]]
    capsys.readouterr()
    monkeypatch.setattr("sys.argv", ["results", "runs"])
    results_main()
    said = capsys.readouterr()
    assert "n = 1" in said.out and "objective_until" not in said.out
    of_run = "1 tuning run of PPO on su_b1_4tasks: 1 trial, seeds 100, objective_until=0.45, ended after 256 frames"
    assert f"{of_run}; --tuning, in Python tuning=True, shows them" in said.err
    why = metrics["average_performance"]["undefined"]
    assert why == "a tuning run, which ended after 256 of 512 frames, has only metrics of training"
    monkeypatch.setattr("sys.argv", ["results", "runs", "--tuning"])
    results_main()
    shown = capsys.readouterr().out
    _, tuned, untuned = shown.split("objective_until=")
    assert tuned.split()[:4] == ["0.45", "online", "return", f"{value:.4f}"] and "n = 1 " in tuned
    assert "None\n    average performance" in untuned and "n = 1 " in untuned
    assert "n = 0" not in shown and "n = 1/2" not in shown


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        (
            ("objective=online_return", "objective_until=0.12"),
            "objective_until=0.12 is 62 of curriculum.num_frames=512, less than two batches of agent.num_envs=8 x",
        ),
        (
            ("objective=online_return", "objective_until=0.5", "freeze_after=0.5"),
            "freeze_after=0.5 freezes nothing before objective_until=0.5, where the run ends: set freeze_after below",
        ),
        (("agent=mohqa", "evaluation.exact=true", "evaluation.num_episodes=null"), "action_probs, which MOHQA has not"),
    ],
)
def test_a_run_that_would_say_nothing_leaves_no_directory(monkeypatch, tmp_path, capsys, settings, reason):
    monkeypatch.chdir(tmp_path)

    assert command_line(monkeypatch, *SHORT, *settings) == 1

    assert reason in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
