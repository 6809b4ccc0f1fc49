"""The profile: the policy of each floor scores 0 and that of each optimum 1, and the page shows gaps as gaps."""

from __future__ import annotations

import math
import re
import subprocess
import sys
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import pytest
import torch

import curricula
from baselines.models.table_model import taught_share
from ctgraph_rl import Recorder, RunLog
from ctgraph_rl.env import CTGraphEnv
from ctgraph_rl.learn.evaluate import Evaluator
from ctgraph_rl.metrics import Undefined
from ctgraph_rl.packages import conf_dir
from ctgraph_rl.policies import NavigationPolicy, OptimalPolicy, RandomPolicy, SearchPolicy
from ctgraph_rl.profile.properties import Evidence, Measured, measure
from ctgraph_rl.profile.scoring import profile_scores, score_of
from ctgraph_rl.tasks.configurations import ct_graph
from ctgraph_rl.tasks.values import random_frames_to_goal
from curricula.profile import PROPERTIES


class BestOpenLoop(RandomPolicy):
    """The actions to the goal 1.2 that leave each wait state at the first try, whatever is seen."""

    def action(self, tensordict):
        step = tensordict["step_count"].squeeze(-1)
        return torch.where(step == 2, 1, torch.where(step == 4, 2, 0))


class BestMemoryless(OptimalPolicy):
    """Decides for the first branch as often as an alternating goal does."""

    def decision(self, tensordict):
        depth = torch.tensor([task.graph.depth for task in self.env.tasks])
        return 2 - (torch.rand(depth.shape) < (depth + 1) // 2 / depth).long()


class LuckySearch(OptimalPolicy):
    """Keeps the goal in those rows in which random actions found it in 102,400 frames, and else fails."""

    def __init__(self, env):
        super().__init__(env)
        means = torch.tensor([random_frames_to_goal(task) for task in env.tasks])
        self.found = torch.rand(means.shape) < 1 - (-102_400 / means).exp()

    def action(self, tensordict):
        return torch.where(self.found, super().action(tensordict), 1)


class RandomAtNewImages(OptimalPolicy):
    """Acts at random at images beyond those that were trained."""

    def action(self, tensordict):
        new = self.env.observation_id > 105
        return torch.where(new, self._random_below(self.env.branching_factor + 1), super().action(tensordict))


class OnePath(OptimalPolicy):
    """Goes to the first end state in each episode."""

    def decision(self, tensordict):
        return self._towards(torch.zeros_like(self.env.goal_leaf))


FLOORS = {
    "profile_observability": BestOpenLoop,
    "profile_memory": BestMemoryless,
    "profile_sparsity": LuckySearch,
    "profile_attention": RandomAtNewImages,
    "profile_exploration": OnePath,
}


def ratio(measured: Measured) -> float:
    return (measured.value - measured.floor) / (measured.optimum - measured.floor)


def of_policy(name, policy, num_episodes=1500):
    curriculum = curricula.load(name)
    curriculum = replace(curriculum, evaluation=replace(curriculum.evaluation, num_episodes=num_episodes))
    log = RunLog()
    for frames in curriculum.ends:
        Evaluator(curriculum, 0, log).evaluate(policy, frames, "after")
    return ratio(measured(name, log, curriculum))


def measured(name, log, curriculum=None):
    run = Evidence(log, curriculum or curricula.load(name), Path("nowhere"))
    return measure(run, PROPERTIES[name])


RARE = pytest.param("profile_sparsity", marks=pytest.mark.slow)


@pytest.mark.parametrize("name", [RARE if name == "profile_sparsity" else name for name in FLOORS])
def test_the_policy_of_a_floor_scores_0(name):
    assert of_policy(name, FLOORS[name]) == pytest.approx(0, abs=0.02)


@pytest.mark.parametrize("name", FLOORS)
def test_the_policy_of_an_optimum_scores_1(name):
    searches = name == "profile_exploration"
    policy = SearchPolicy if searches else OptimalPolicy

    assert of_policy(name, policy, 1500 if searches else 10) == pytest.approx(1, abs=0.02)


def curves(name, solves):
    """A log of an agent that solves each task from the evaluation number ``solves(task)`` of its block on."""
    curriculum = curricula.load(name)
    log = RunLog()
    log.append("run", trained=[[1 + task for task in block] for block in curriculum.trained])
    every = curriculum.evaluation.every
    starts = (0, *curriculum.ends)
    for block, (start, end) in enumerate(zip(starts, curriculum.ends, strict=False), 1):
        for number, frames in enumerate(range(start + every, end + 1, every), 1):
            moment = "after" if frames == end else "during"
            for task in range(len(curriculum.tasks)):
                solved = float(task in curriculum.trained[block - 1] and number >= solves(task))
                log.append("evaluation", block=block, frames=frames, task=task + 1, return_mean=solved, moment=moment)
    return log


FASTER = [name for name, prop in PROPERTIES.items() if prop.measure == "faster"]


@pytest.mark.parametrize("name", FASTER)
def test_a_learner_to_which_all_tasks_are_new_scores_0(name):
    assert ratio(measured(name, curves(name, lambda task: 4))) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("name", FASTER)
def test_a_learner_that_knows_what_a_property_gives_scores_1(name):
    gives = PROPERTIES[name].arguments["on"]

    score = ratio(measured(name, curves(name, lambda task: 1 if task in gives else 4)))

    assert score == pytest.approx(1, abs=1e-9)


def test_a_learner_that_does_not_learn_the_first_task_has_no_speed_of_adaptation():
    log = curves("profile_adaptation", lambda task: 1 if task else math.inf)

    with pytest.raises(Undefined, match="task 1 was not learned"):
        measured("profile_adaptation", log)


def test_the_goals_of_the_similarity_share_two_decisions_or_none_with_the_one_before():
    goals = [task.goal for task in curricula.load("profile_similarity").tasks]
    shared = [next(i for i in range(4) if i == 3 or a[i] != b[i]) for a, b in pairwise(goals)]

    found = dict(enumerate(shared, 1))

    on, than = PROPERTIES["profile_similarity"].arguments.values()
    assert {found[task] for task in on} == {2}
    assert {found[task] for task in than} == {0}


def test_the_data_of_a_policy_that_goes_everywhere_teach_the_exact_model():
    [task] = curricula.load("profile_model").tasks

    assert taught_share(NavigationPolicy, task) == pytest.approx(1, abs=0.02)


@pytest.mark.slow
def test_random_search_finds_a_goal_in_time_with_the_probability_of_the_floor():
    task = ct_graph(2, 3)
    steps = 4000
    env = CTGraphEnv([task] * 500, 0)
    torch.manual_seed(0)
    rewarded = env.rollout(steps, RandomPolicy(env), break_when_any_done=False)["next", "reward"].amax(1) > 0

    expected = 1 - math.exp(-steps / random_frames_to_goal(task))

    assert 0.4 < expected < 0.8
    assert rewarded.double().mean().item() == pytest.approx(expected, abs=4 * math.sqrt(0.25 / 500))


def test_scores_over_seeds_are_a_ratio_of_means_whose_interval_has_the_spread_of_the_floor():
    results = [Measured(0.8, floor, 1.0, exact=False) for floor in (0.2, 0.4, 0.6)]

    score = score_of(results)

    assert score.value == pytest.approx(0.4 / 0.6)
    assert score.low < 0.4 / 0.6 < score.high


def test_equal_seeds_have_the_wide_exact_interval():
    score = score_of([Measured(1.0, 0.25, 1.0)] * 5)

    assert (score.value, score.high) == (1.0, 1.0)
    assert score.low == pytest.approx(-1 / 3 + 4 / 3 * 0.025 ** (1 / 5))


def test_a_recorded_run_is_scored_and_what_was_not_run_is_a_gap(tmp_path):
    curriculum = curricula.load("profile_attention", num_frames=1024)
    with Recorder(curriculum, tmp_path / "mine", about={"agent": "Mine"}) as recorder:
        recorder.evaluate(lambda images: torch.zeros(len(images), dtype=torch.int64), 1024)

    scores = profile_scores([tmp_path])["Mine"]

    assert (scores["attention"].value, scores["attention"].reason) == (0, "of profile_attention (modified)")
    assert (scores["memory"].value, scores["memory"].reason) == (None, "there is no run")


@pytest.mark.parametrize("order", [1, -1])
def test_a_modified_curriculum_counts_where_the_published_one_has_no_score(tmp_path, order):
    def record(name: str, finished: bool, **changes: int) -> Path:
        curriculum = curricula.load("profile_attention", **changes)
        with Recorder(curriculum, tmp_path / name, about={"agent": "Mine"}) as recorder:
            if finished:
                recorder.evaluate(lambda images: torch.zeros(len(images), dtype=torch.int64), curriculum.num_frames)
        return tmp_path / name

    modified = record("modified", True, num_frames=1024)
    begun = record("begun", False)
    published = record("published", True)

    reasons = []
    for other in (begun, published):
        reasons.append(profile_scores([modified, other][::order])["Mine"]["attention"].reason)
    assert reasons == ["of profile_attention (modified)", ""]


@pytest.mark.slow
def test_the_command_trains_an_agent_of_the_user_scores_and_draws(tmp_path):
    own = tmp_path / "conf" / "agent" / "mine.yaml"
    own.parent.mkdir(parents=True)
    (tmp_path / "mine.py").write_text("from baselines.ppo import PPO\nclass Mine(PPO):\n    pass\n")
    ours = Path(conf_dir(), "agent", "ppo.yaml").read_text(encoding="utf-8")
    own.write_text(ours.replace("baselines.ppo.PPO", "mine.Mine"), encoding="utf-8")
    words = ["profile", "--config-dir", "conf", "agent=mine", "seed=0", "curriculum.num_frames=2048"]
    start = "from ctgraph_rl.cli import main; main()"

    run = partial(subprocess.run, cwd=tmp_path, capture_output=True, text=True)  # where ``mine`` is found
    (own.parent / "broken.yaml").write_text("- no agent")
    done = run([sys.executable, "-P", "-c", start, *words])
    scored = run([sys.executable, "-P", "-c", start, "profile", "--config-dir", "conf", "runs/profile"])

    assert done.returncode == scored.returncode == 0, done.stderr + scored.stderr
    assert scored.stdout.endswith(done.stdout[-200:])
    assert "left out: the agent of conf/agent/broken.yaml cannot be imported" in scored.stderr
    assert re.search(r"model +0\.\d\d  \(of profile_model \(modified\)\)", done.stdout)
    assert (tmp_path / "runs" / "profile" / "profile" / "figures" / "profile.png").is_file()
