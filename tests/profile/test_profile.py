"""Scores over seeds: which runs count, which are refused and why, intervals, and the page."""

from __future__ import annotations

import csv
import json
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.paths import CHECKOUT
from helpers.profiles import LATE, life

import curricula
from ctgraph_rl import Recorder
from ctgraph_rl.metrics import Undefined
from ctgraph_rl.profile.profile_page import write_profile
from ctgraph_rl.profile.properties import Measured, measure
from ctgraph_rl.profile.scoring import profile_scores, rest_of_gain, score_of
from ctgraph_rl.runs.read import find_runs
from curricula.profile import NAMED, PROPERTIES, TARGETS

LIVES = ("profile_fresh", "profile_unrelated", "profile_similarity", "profile_dissimilar", "profile_hierarchy")


def waits(images):
    return torch.zeros(len(images), dtype=torch.int64)


def record(folder, name, moments=None, seed=0, **changes):
    """A run of a Recorder, evaluated at all moments of its curriculum or at others."""
    curriculum = curricula.load(name, **changes)
    with Recorder(curriculum, folder, seed=seed, about={"agent": "Mine"}) as recorder:
        for frames in curriculum.moments if moments is None else moments:
            recorder.evaluate(waits, frames)
    return curriculum


def test_a_score_is_a_ratio_of_means_over_all_seeds():
    results = [Measured(value, (0.2,), 1.0) for value in (0.2, 0.6, 1.0)]

    score = score_of(results)

    assert (score.value, score.n) == (pytest.approx(0.5), 3)
    assert (score.measured, score.floor, score.optimum) == (pytest.approx(0.6), pytest.approx(0.2), 1)
    assert score.low < 0.5 < score.high


def test_the_floor_is_the_control_with_the_best_mean():
    results = [Measured(0.9, (0.2, 0.5), 1.0, exact=False), Measured(0.7, (0.6, 0.5), 1.0, exact=False)]

    score = score_of(results, ("one", "another"))

    assert (score.controls, score.floor) == ("one 0.40, another 0.50", 0.5)
    assert score.value == pytest.approx((0.8 - 0.5) / 0.5)


def test_equal_seeds_with_an_exact_floor_have_the_wide_exact_interval():
    score = score_of([Measured(1.0, (0.25,), 1.0)] * 5)

    assert (score.value, score.high) == (1.0, 1.0)
    assert score.low == pytest.approx(-1 / 3 + 4 / 3 * 0.025 ** (1 / 5))


def test_one_seed_has_no_interval():
    assert score_of([Measured(1.0, (0.25,), 1.0)]).low is None


def test_a_score_below_its_floor_is_0_and_its_interval_has_it():
    score = score_of([Measured(0.1, (0.5, 0.4), 1.0, exact=False)] * 5, ("one", "another"))

    assert (score.value, score.low) == (0.0, 0.0)
    assert 0 < score.high < 1


MEANS = ((0.9, 0.5, 0.3), (0.5, 0.5, 0.5), (0.95, 0.9, 0.2), (0.6, 0.2, 0.2))


def drawn(rng, law, mean, size):
    if law == "solve or fail":
        return (rng.random(size) < mean).astype(float)
    strength = 2.0 if law == "wide" else 20.0
    return rng.beta(strength * mean, strength * (1 - mean), size)


@pytest.mark.slow
@pytest.mark.parametrize("law", ["solve or fail", "wide", "narrow"])
@pytest.mark.parametrize("means", MEANS)
def test_the_interval_of_a_gain_covers_in_94_of_100_samples_of_five_seeds(law, means):
    """A score lies above the lower end if one control allows it, and below the upper end if all do."""
    rng = np.random.default_rng(0)
    true = max(0.0, (means[0] - max(means[1:])) / (1 - max(means[1:])))
    samples = 2000
    covered = 0
    for _ in range(samples):
        own, *controls = (drawn(rng, law, mean, 5) for mean in means)
        ends = [rest_of_gain(list(zip(own, control, strict=True)), true) for control in controls]
        above = true == 0 or min(low for low, _ in ends) <= 0
        covered += above and min(high for _, high in ends) >= 0

    assert covered / samples >= 0.94


def test_the_ends_of_the_interval_of_a_gain_are_the_last_scores_that_no_control_contradicts():
    own = (1.0, 0.9, 1.0, 0.95, 1.0, 1.0, 1.0)
    other = (0.1, 0.2, 0.0, 0.1, 0.0, 0.0, 0.1)
    pairs = list(zip(own, other, strict=True))

    score = score_of([Measured(a, (c,), 1.0, exact=False) for a, c in pairs], ("one",))

    assert rest_of_gain(pairs, score.low)[0] == pytest.approx(0, abs=1e-4)
    assert rest_of_gain(pairs, score.high)[1] == pytest.approx(0, abs=1e-4)
    assert 0 < score.low < score.value < score.high < 1


@pytest.mark.parametrize(("seeds", "shows"), [(5, False), (6, True)])
def test_a_gain_is_above_0_from_six_seeds_on(seeds, shows):
    score = score_of([Measured(1.0, (0.0,), 1.0, exact=False)] * seeds, ("one",))

    assert (score.low > 0) == shows


def test_the_last_blocks_of_the_lives_are_the_same_and_their_histories_equally_long():
    loaded = [curricula.load(name) for name in (*LIVES, "profile_innate", "profile_roles")]

    assert {life.blocks[-1] for life in loaded} == {loaded[0].blocks[-1]}
    assert {sum(block.num_frames for block in life.blocks[:-1]) for life in loaded[1:]} == {49_152}
    assert loaded[0].blocks[0].tasks == TARGETS
    assert all(len(life.moments) * 8192 == life.num_frames for life in loaded)


def shared(first, second):
    """How many of their first decisions two goals share."""
    return next((place for place, (a, b) in enumerate(zip(first, second, strict=False)) if a != b), len(first))


@pytest.mark.parametrize(("name", "expected"), [("profile_similarity", 1), ("profile_dissimilar", 0)])
def test_goals_before_share_the_first_decision_or_none(name, expected):
    before, last = (block.tasks for block in curricula.load(name).blocks)

    assert [shared(a.goal, b.goal) for a, b in zip(before, last, strict=True)] == [expected] * 2
    assert [a.images for a in before] == [b.images for b in last]


def test_in_other_roles_no_image_of_a_state_keeps_its_role():
    known = curricula.load("profile_innate").blocks[0].tasks
    others = curricula.load("profile_roles").blocks[0].tasks

    for one, other in zip(known, others, strict=True):
        kinds = ("wait_ids", "decision_ids", "end_ids")
        roles = [{*range(ids[0], ids[1] + 1)} for ids in (getattr(one.observations, kind) for kind in kinds)]
        now = [{*range(ids[0], ids[1] + 1)} for ids in (getattr(other.observations, kind) for kind in kinds)]
        assert [a & b for a, b in zip(roles, now, strict=True)] == [set()] * 3
        assert set.union(*roles) == set.union(*now)


@pytest.mark.parametrize("name", ["profile_sparsity", "profile_adaptation", "profile_memory", "profile_fresh"])
def test_goals_of_a_depth_take_each_branch_equally_often_at_each_place(name):
    goals = {}
    for task in curricula.load(name).tasks:
        goals.setdefault(task.graph.depth, []).append(task.goal)

    for of_depth in goals.values():
        for place in zip(*of_depth, strict=True):
            assert place.count(1) == place.count(2) > 0


def test_a_recorded_run_is_scored_and_what_was_not_run_is_a_gap(tmp_path):
    record(tmp_path / "mine", "profile_attention")

    scores = profile_scores(*find_runs([tmp_path]))["Mine"]

    assert (scores["attention"].value, scores["attention"].measured, scores["attention"].floor) == (0, 0, 0.25)
    assert (scores["memory"].value, scores["memory"].reason) == (None, "there is no run")


@pytest.mark.parametrize("order", [1, -1])
def test_a_modified_curriculum_counts_where_the_published_one_has_no_score(tmp_path, order):
    record(tmp_path / "modified", "profile_attention", num_frames=1024)
    record(tmp_path / "begun", "profile_attention", moments=())
    record(tmp_path / "published", "profile_attention", seed=1)

    reasons = []
    for other in ("begun", "published"):
        folders = [tmp_path / "modified", tmp_path / other]
        reasons.append(profile_scores(*find_runs(folders[::order]))["Mine"]["attention"].reason)
    assert reasons == ["of profile_attention (modified)", ""]


def test_a_seed_that_is_not_finished_leaves_a_gap_that_names_it_and_what_gives_it(tmp_path):
    record(tmp_path / "whole", "profile_adaptation")
    record(tmp_path / "half", "profile_adaptation", moments=(8192, 16384), seed=1)

    score = profile_scores(*find_runs([tmp_path]))["Mine"]["adaptation"]

    assert score.value is None
    assert f"{tmp_path / 'half'} has no results, unfinished" in score.reason
    assert "give Recorder(curricula.load('profile_adaptation'), ...) all evaluations of its moments" in score.reason


def test_blocks_that_were_evaluated_unequally_often_are_not_compared(tmp_path):
    curriculum = curricula.load("profile_adaptation")
    record(tmp_path / "uneven", "profile_adaptation", moments=(*curriculum.moments[:4], *curriculum.ends))

    score = profile_scores(*find_runs([tmp_path]))["Mine"]["adaptation"]

    assert score.value is None
    assert "uneven lacks the evaluation of task 1 after 49,152 frames" in score.reason


def test_an_evaluation_too_many_is_named_too(tmp_path):
    curriculum = curricula.load("profile_adaptation")
    record(tmp_path / "uneven", "profile_adaptation", moments=(2048, *curriculum.moments))

    score = profile_scores(*find_runs([tmp_path]))["Mine"]["adaptation"]

    assert score.value is None
    assert "has one evaluation too many of task 1 after 2,048 frames" in score.reason


def test_a_life_without_its_control_is_a_gap(tmp_path):
    for name in ("profile_fresh", "profile_dissimilar", "profile_similarity"):
        record(tmp_path / name, name)

    whole = profile_scores(*find_runs([tmp_path]))["Mine"]["similarity"]
    record(tmp_path / "more", "profile_similarity", seed=1)
    lacking = profile_scores(*find_runs([tmp_path]))["Mine"]["similarity"]

    assert (whole.value, whole.n) == (0, 1)
    assert whole.controls == "profile_fresh 0.00, profile_dissimilar 0.00"
    assert (lacking.value, lacking.n) == (None, 0)
    assert "more lacks its control profile_fresh" in lacking.reason


def test_a_run_of_an_earlier_version_is_not_scored(tmp_path):
    record(tmp_path / "old", "profile_attention")
    file = tmp_path / "old" / "curriculum.json"
    content = json.loads(file.read_text(encoding="utf-8"))
    old = curricula.load("profile_attention")
    log = tmp_path / "old" / "run.jsonl"
    first = replace(old, version=1)
    file.unlink()
    first.to_json(file)
    log.write_text(log.read_text(encoding="utf-8").replace(old.fingerprint, first.fingerprint), encoding="utf-8")

    reason = profile_scores(*find_runs([tmp_path]))["Mine"]["attention"].reason

    assert content["version"] == 2
    assert "learned version 1 of profile_attention, the profile has version 2" in reason


def test_lives_with_other_last_blocks_are_not_compared():
    run = life("profile_similarity", lambda *life: 1)
    other = life("profile_fresh", lambda *life: LATE)
    shorter = other._replace(curriculum=curricula.load("profile_fresh", num_frames=49_152))

    with pytest.raises(Undefined, match="ends with another block"):
        measure(run, [shorter, other], PROPERTIES["profile_similarity"])


def test_the_page_has_scores_and_what_was_measured_side_by_side(tmp_path):
    pytest.importorskip("matplotlib")
    record(tmp_path / "runs" / "mine", "profile_attention")

    write_profile(*find_runs([tmp_path / "runs"]), tmp_path / "out")

    page = (tmp_path / "out" / "profile.md").read_text(encoding="utf-8")
    assert "| attention | 0.00 |" in page
    assert "| attention | 0.00, floor 0.25, optimum 1.00 |" in page
    assert "Mine, model: there is no run" in page
    with open(tmp_path / "out" / "profile.csv", newline="", encoding="utf-8") as file:
        lines = {line["property"]: line for line in csv.DictReader(file)}
    assert (lines["attention"]["score"], lines["attention"]["floor"]) == ("0.0", "0.25")


OWN_MODEL = """
import torch
from tensordict import TensorDict


class Modeller:
    def __init__(self, observation_spec, action_spec, num_envs, num_steps):
        self.num_envs, self.num_steps = num_envs, num_steps

    def policy(self, data):
        return data.set("action", torch.randint(0, 3, data.batch_size))

    def policy_for(self, task):
        return self.policy

    def initial_state(self, num_envs):
        return TensorDict(batch_size=[num_envs])

    def start_task(self, task=None):
        pass

    def end_task(self):
        pass

    def loss(self, batch):
        return {"loss_none": torch.zeros(())}

    def learn(self, batch):
        return {}

    def to(self, device):
        return self

    def state_dict(self):
        return {}

    def load_state_dict(self, state):
        return self

    def predict_next(self, history, choices):
        return torch.full((len(history), len(choices)), -torch.tensor(float(len(choices))).log())
"""
"""An agent without a network or a state, whose policy is its method."""


def profile_command(folder, *words):
    start = "from ctgraph_rl.cli import main; main()"
    command = [sys.executable, "-P", "-c", start, "profile", *words]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True)  # where own modules are found


@pytest.mark.slow
def test_the_command_trains_agents_of_the_user_scores_and_draws(tmp_path):
    page = (CHECKOUT / "docs" / "how-to" / "own_agent.md").read_text(encoding="utf-8")
    [code] = re.findall(r"`my_agent.py`:\n\n```python\n(.*?)```", page, re.DOTALL)
    [config] = re.findall(r"```yaml\n(_target_: my_agent.MyAgent.*?)```", page, re.DOTALL)
    agents = tmp_path / "conf" / "agent"
    agents.mkdir(parents=True)
    (tmp_path / "my_agent.py").write_text(code, encoding="utf-8")
    (agents / "mine.yaml").write_text(config, encoding="utf-8")
    (tmp_path / "my_model.py").write_text(OWN_MODEL, encoding="utf-8")
    (agents / "model.yaml").write_text("_target_: my_model.Modeller\nnum_envs: 256\nnum_steps: 32\n", encoding="utf-8")

    settings = ("curriculum=profile_model,profile_attention", "curriculum.num_frames=15360", "seed=0")
    first = profile_command(tmp_path, "--config-dir", "conf", "agent=mine", *settings)
    done = profile_command(tmp_path, "--config-dir", "conf", "agent=model", *settings)
    (agents / "broken.yaml").write_text("- no agent", encoding="utf-8")
    scored = profile_command(tmp_path, "--config-dir", "conf", "runs/profile")

    assert first.returncode == done.returncode == scored.returncode == 0, first.stderr + done.stderr + scored.stderr
    assert scored.stdout.endswith(done.stdout[-200:])
    assert "left out: the agent of conf/agent/broken.yaml cannot be imported" in scored.stderr
    of_model = r"model +0\.00 +0\.00, floor 2\.44, optimum 2\.76  \(of profile_model \(modified\)\)"
    assert re.search(of_model, done.stdout)
    assert "has no model: its agent has no predict_next" in first.stdout
    assert (tmp_path / "runs" / "profile" / "profile" / "figures" / "profile.png").is_file()


@pytest.mark.slow
def test_the_command_runs_all_curricula_of_the_profile(tmp_path):
    done = profile_command(tmp_path, "agent=ppo", "seed=0", "curriculum.num_frames=15360")

    assert done.returncode == 0, done.stderr
    assert len(list((tmp_path / "runs" / "profile").glob("profile_*/*/metrics.json"))) == len(NAMED)
    assert len(re.findall(r"optimum", done.stdout)) == len(PROPERTIES) - 1


@pytest.mark.slow
def test_a_gap_of_a_killed_run_names_the_command_that_finishes_it(tmp_path):
    words = ("agent=ppo", "curriculum=profile_model", "curriculum.num_frames=15360", "seed=0")
    profile_command(tmp_path, *words)
    [run] = (tmp_path / "runs" / "profile").glob("profile_model/*")
    (run / "metrics.json").unlink()

    [command] = re.findall(r"has no results, .*?: ctgraph-rl profile (.*?)\)", profile_command(tmp_path, "runs").stdout)
    again = profile_command(tmp_path, *command.split())

    assert command.startswith("agent=ppo curriculum.num_frames=15360 curriculum=profile_model seed=0 hydra.sweep.dir=")
    assert again.returncode == 0, again.stderr
    assert (run / "metrics.json").exists()
