"""Evaluations before which rows adapt: what is measured of them, and an agent with an inner loop in the usual run."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.kill_runs import equal
from helpers.scripted import ONE, TWO, Scripted, curriculum, decide
from helpers.sweeping import command_line
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.nn.functional import one_hot
from torchrl.envs.utils import ExplorationType, exploration_type

import curricula
from ctgraph_rl import Block, Evaluation, RunLog, learn_curriculum
from ctgraph_rl.learn.collect import agent_specs
from ctgraph_rl.learn.refusals import check_adaptation
from ctgraph_rl.log.scores import scores
from ctgraph_rl.log.sums import metrics_of
from ctgraph_rl.runs.checkpoints import Checkpoints
from ctgraph_rl.runs.read import read_run
from ctgraph_rl.tasks.kinds.gym_task import GymTask


class Searcher(Scripted):
    """Takes decision 1 in the first episode of a row, and the other one after an episode without a reward."""

    def __init__(self) -> None:
        super().__init__(self.act)

    def initial_state(self, num_envs: int) -> TensorDict:
        state = {"trial": torch.ones(num_envs, 1, dtype=torch.int64), "reward": torch.ones(num_envs, 1)}
        return TensorDict(state, batch_size=[num_envs])

    def act(self, data):
        fails = data["is_init"] & (data["reward"] == 0)
        chosen = torch.where(fails, 3 - data["trial"], data["trial"])
        data["next", "trial"] = chosen
        return decide(lambda _: chosen.squeeze(-1))(data)


SEARCHED = replace(curriculum(Block((ONE, TWO), 48)), evaluation=Evaluation(4, before=False, adapt_episodes=2))


def learned(agent, how=SEARCHED) -> RunLog:
    return learn_curriculum(how, agent)


def test_returns_are_logged_by_task_and_episode_of_a_row_and_the_best_search_has_no_regret():
    log = learned(Searcher())

    steps = [(m["task"], m["step"], m["return_mean"], m["found_rate"]) for m in log.of_kind("adaptation")]
    first = [(1, 1, 1.0, 1.0), (1, 2, 1.0, 1.0), (1, 3, 1.0, 1.0)]
    second = [(2, 1, 0.0, 0.0), (2, 2, 1.0, 1.0), (2, 3, 1.0, 1.0)]
    found = scores(log, SEARCHED)
    assert steps == first + second
    assert [m["exact_rate"] for m in log.of_kind("adaptation")] == [0.5, 1, 1] * 2
    assert [m["return_mean"] for m in log.of_kind("evaluation")] == [1, 1]
    assert found["search_regret"].value == 0 and found["search_regret"].terms == (-0.5, 0.5)
    assert found["first_success"].value == 1 and found["first_success"].terms == (2 / 3, 4 / 3)
    assert found["adapted_return"].value == 1


def test_a_policy_that_does_not_search_misses_goals_and_its_first_success_is_not_defined():
    found = scores(learned(Scripted(decide(1))), SEARCHED)

    assert found["search_regret"].terms == (-0.5, 2.5)
    assert found["adapted_return"].value == 0.5
    assert found["first_success"].undefined == "1 of 2 terms have no value: a row never reached the goal"


def test_a_row_that_leaves_the_goal_has_found_it():
    agent = Searcher()
    agent.policy = decide(lambda data: 1 + (data["trial"].squeeze(-1) % 2 == 0))
    count = lambda data: data.set(("next", "trial"), data["trial"] + data["is_init"])  # noqa: E731
    act = agent.policy
    agent.policy = lambda data: act(count(data))

    first = [m for m in learned(agent).of_kind("adaptation") if m["task"] == 1]

    assert (
        sorted(m["success_rate"] for m in first[:2]) == [0, 1] and first[0]["success_rate"] != first[1]["success_rate"]
    )
    assert [m["found_rate"] for m in first][1:] == [1, 1]


def test_episodes_before_an_evaluation_do_not_count_in_its_means():
    how = replace(SEARCHED.evaluation, num_episodes=6, episodes_per_row=3, adapt_episodes=1)

    log = learned(Searcher(), replace(SEARCHED, evaluation=how))

    assert [(m["episodes"], m["return_mean"]) for m in log.of_kind("evaluation")] == [(6, 1.0)] * 2
    assert [m["episodes"] for m in log.of_kind("adaptation")] == [2] * 8


def test_held_out_tasks_are_measured_apart():
    evaluation = replace(SEARCHED.evaluation, held_out=(TWO,))
    how = replace(SEARCHED, blocks=(Block(ONE, 48),), evaluation=evaluation)

    found = scores(learned(Scripted(decide(1)), how), how)

    assert (found["search_regret"].value, found["held_out_search_regret"].value) == (-0.5, 2.5)
    assert (found["adapted_return"].value, found["held_out_adapted_return"].value) == (1, 0)


def test_without_adaptation_a_log_has_what_it_had_and_metrics_of_it_say_why_they_are_undefined():
    how = replace(SEARCHED, evaluation=replace(SEARCHED.evaluation, adapt_episodes=0))
    log = learned(Searcher(), how)

    found = scores(log, how)

    assert {m["kind"] for m in log.measurements} == {"training", "evaluation"}
    assert found["search_regret"].undefined == "no trained task was evaluated with evaluation.adapt_episodes > 0"
    assert how.fingerprint != SEARCHED.fingerprint
    assert replace(how, evaluation=Evaluation(4, before=False)).fingerprint == how.fingerprint


def test_tasks_of_other_kinds_have_returns_and_no_rates():
    lake = GymTask("FrozenLake-v1", {"is_slippery": False}, max_episode_steps=4)
    how = replace(SEARCHED, blocks=(Block(lake, 48),))

    log = learned(Scripted(lambda data: data.set("action", torch.ones(data.batch_size, dtype=torch.int64))), how)

    assert [(m["step"], m["return_mean"], m["exact_rate"]) for m in log.of_kind("adaptation")] == [
        (step, 0.0, None) for step in (1, 2, 3)
    ]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"adapt_episodes": -1}, "adapt_episodes must be an integer >= 0, got -1"),
        ({"adapt_episodes": 40}, r"adapt_episodes=40 \+ episodes_per_row=40 must be at most 40, after which the goal"),
    ],
)
def test_too_many_episodes_before_an_evaluation_are_refused(change, message):
    uniform = curricula.load("nm_uniform_goals")

    with pytest.raises(ValueError, match=message):
        learned(Scripted(num_envs=4), replace(uniform, evaluation=replace(uniform.evaluation, **change)))


def test_an_agent_that_adapts_needs_tasks_to_adapt_to_and_enough_episodes():
    agent = Searcher()
    agent.adapt_episodes = 3

    with pytest.raises(ValueError, match=r"rows of an evaluation have 3 episodes, and Searcher adapts after 3: set ev"):
        check_adaptation(SEARCHED, agent)
    with pytest.raises(ValueError, match=r"Searcher learns to adapt to tasks that are drawn, and block 2 has one task"):
        check_adaptation(replace(SEARCHED, blocks=(*SEARCHED.blocks, Block(ONE, 48))), agent)


# The toy

FAST, TRACE = "unstored_fast", "unstored_trace"


class Reptile(nn.Module):
    """Reptile (Nichol et al. 2018, arXiv 1803.02999) on a table of logits, with REINFORCE as its inner loop.

    Args:
        observation_spec: the environment's; its observations are one-hot.
        action_spec: the environment's.
        num_envs: rows.
        num_steps: steps in a batch.
        trial_episodes: episodes after which a row forgets.
        inner_rate: of the inner loop.
        outer_rate: of the weights that rows start with.
    """

    adapt_episodes = 1

    def __init__(
        self,
        observation_spec: Any,
        action_spec: Any,
        num_envs: int,
        num_steps: int,
        trial_episodes: int,
        inner_rate: float,
        outer_rate: float,
    ) -> None:
        super().__init__()
        self.num_envs, self.num_steps, self.trial_episodes = num_envs, num_steps, trial_episodes
        self.inner_rate, self.outer_rate = inner_rate, outer_rate
        shape = observation_spec["observation"].shape.numel(), action_spec.n
        self.start = nn.Parameter(torch.zeros(shape), requires_grad=False)

    def initial_state(self, num_envs: int) -> TensorDict:
        """The state lasts over episodes, as it has a key ``trial``."""
        state = {"trial": torch.zeros(num_envs, 1, dtype=torch.int64), "reward": torch.zeros(num_envs, 1)}
        state |= {FAST: self.start.expand(num_envs, -1, -1).clone(), TRACE: torch.zeros(num_envs, *self.start.shape)}
        return TensorDict(state, batch_size=[num_envs])

    def policy(self, data: TensorDictBase) -> TensorDictBase:
        """Act by each row's weights, which adapt where an episode begins."""
        begins = data["is_init"].unsqueeze(-1)
        episode = data["trial"] + data["is_init"]
        forgets = begins & (episode > self.trial_episodes).unsqueeze(-1)
        fast = torch.where(
            begins, data[FAST] + self.inner_rate * data["reward"].unsqueeze(-1) * data[TRACE], data[FAST]
        )
        fast = torch.where(forgets, self.start, fast)
        seen = data["observation"].float()
        chances = torch.einsum("nk,nka->na", seen, fast).softmax(dim=-1)
        greedy = exploration_type() == ExplorationType.DETERMINISTIC
        action = chances.argmax(dim=-1) if greedy else torch.multinomial(chances, 1).squeeze(-1)
        gradient = one_hot(action, chances.shape[-1]) - chances
        trace = torch.where(begins, 0.0, data[TRACE]) + seen.unsqueeze(-1) * gradient.unsqueeze(-2)
        data["action"] = action
        data["next", "trial"] = torch.where(forgets.squeeze(-1), 1, episode)
        data["next", FAST], data["next", TRACE] = fast, trace
        return data

    def policy_for(self, task: int) -> Any:
        return self.policy

    def start_task(self, task: int | None = None) -> None:
        """Do nothing."""

    def end_task(self) -> None:
        """Do nothing."""

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Move the start towards what rows have adapted to."""
        change: Tensor = batch["next", FAST][:, -1].mean(dim=0) - self.start
        self.start += self.outer_rate * change
        return {"change": change.norm().item()}


MINE = f"""
_target_: {__name__}.Reptile
num_envs: 16
num_steps: 24
trial_episodes: 4
inner_rate: 9
outer_rate: 0.3
"""


class Stops(Exception):
    """Stands for a kill."""


@pytest.mark.slow
def test_an_agent_with_an_inner_loop_runs_from_the_command_line_resumes_and_has_a_report(tmp_path, monkeypatch):
    (tmp_path / "my_conf" / "agent").mkdir(parents=True)
    (tmp_path / "my_conf" / "agent" / "mine.yaml").write_text(MINE)
    monkeypatch.chdir(tmp_path)
    how = ["evaluation.num_episodes=12", "evaluation.episodes_per_row=1", "evaluation.adapt_episodes=3"]
    asked = ["--config-dir=my_conf", "agent=mine", "curriculum=nm_uniform_goals", "curriculum.num_frames=2304", *how]
    offer = Checkpoints.offer

    def stop(self, state, at_block_end):
        offer(replace_seconds(self), state, at_block_end)
        if state()["frames"] == 1152:
            raise Stops

    assert command_line(monkeypatch, *asked, "hydra.run.dir=whole", "report=true") == 0
    with monkeypatch.context() as patch, pytest.raises(Stops):
        patch.setattr(Checkpoints, "offer", stop)
        command_line(monkeypatch, *asked, "hydra.run.dir=stopped")
    assert command_line(monkeypatch, *asked, "hydra.run.dir=stopped") == 0

    whole, resumed = (torch.load(Path(name, "agent.pt")) for name in ("whole", "stopped"))
    assert equal(whole, resumed)
    assert Path("stopped", "restarts.jsonl").exists()
    metrics = metrics_of(Path("whole", "metrics.json").read_bytes())
    assert metrics_of(Path("stopped", "metrics.json").read_bytes()) == metrics
    assert metrics["search_regret"]["value"] is not None
    assert read_run(tmp_path / "whole").history.adaptation["trained"].success.shape == (4, 4)
    assert list(Path("whole", "report", "figures").glob("*adaptation.png"))


def replace_seconds(checkpoints: Checkpoints) -> Checkpoints:
    """Checkpoints that are saved whenever they are offered."""
    checkpoints.seconds = 0
    return checkpoints


def test_evaluation_with_adaptation_leaves_training_untouched():
    make = partial(Reptile, num_envs=16, num_steps=24, trial_episodes=4, inner_rate=9.0, outer_rate=0.3)
    uniform = curricula.load("nm_uniform_goals", num_frames=2304)
    often = Evaluation(8, greedy=False, adapt_episodes=3, every=384)
    ends = []

    for how in (often, Evaluation(8, before=False, episodes_per_row=4)):
        torch.manual_seed(0)
        given = replace(uniform, evaluation=how)
        agent = make(*agent_specs(given))
        learn_curriculum(given, agent, 1)
        ends.append((agent.start, torch.get_rng_state()))

    assert torch.equal(ends[0][0], ends[1][0]) and ends[0][0].abs().max() > 0
    assert torch.equal(ends[0][1], ends[1][1])


def test_goals_and_images_of_a_search_are_held_out():
    search = curricula.load("goal_search", depth=2, num_image_sets=3)

    trained, held_out = search.tasks, search.evaluation.held_out
    assert [task.goal for task in trained] == [(1, 1), (2, 2)] * 3
    assert [task.goal for task in held_out[:6]] == [(1, 2), (2, 1)] * 3
    assert [task.goal for task in held_out[6:]] == [(1, 1), (1, 2), (2, 1), (2, 2)]
    assert {task.images for task in held_out[:6]} == {task.images for task in trained}
    assert len({task.images for task in trained}) == 3 and held_out[6].images not in {task.images for task in trained}
    check_adaptation(search, Scripted())
