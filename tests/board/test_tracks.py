"""Tracks: each is what its file says, runs of it are named as if written by hand, and their seeds are apart."""

from __future__ import annotations

import pytest
from helpers.sweeping import command_line

import curricula
from ctgraph_rl.board.tracks import HELD_OUT_SEEDS, TUNING_SEEDS, held_out_seeds, track, tracks
from ctgraph_rl.metrics import METRICS
from ctgraph_rl.runs.config import composed, plain
from ctgraph_rl.runs.settings import digest

TRACKS = {each.name: each for each in tracks()}

every_track = pytest.mark.parametrize("name", TRACKS)


def test_there_are_these_tracks_and_the_small_one_is_the_first():
    others = ["adaptation", "exploration", "forgetting", "growing_depth", "memory", "sharing"]

    assert list(TRACKS) == ["small", *others]


@every_track
def test_a_track_has_seeds_for_submissions_for_tuning_and_for_verifiers_apart_from_each_other(name):
    found = TRACKS[name]

    drawn = held_out_seeds(f"{found.id} 0a1b 7", count=5)

    assert len({*found.seeds, *TUNING_SEEDS, *drawn}) == len(found.seeds) + len(TUNING_SEEDS) + 5
    assert all(seed in HELD_OUT_SEEDS for seed in drawn)
    assert found.score in METRICS


@pytest.mark.parametrize("name", ["small", "growing_depth", "exploration"])
def test_the_variants_of_a_track_are_different_curricula_each_found_by_its_own(name):
    found = TRACKS[name]

    assert len({each.curriculum.fingerprint for each in found.variants}) == len(found.variants)
    assert len({(each.rung, each.given) for each in found.variants}) == len(found.variants)
    assert len(found.variants) == len(found.rungs) * (1 + len(found.less_given))
    assert all(found.by_fingerprint[each.curriculum.fingerprint] is each for each in found.variants)


def test_another_curriculum_is_no_variant():
    assert curricula.load("fo_b1_4tasks").fingerprint not in TRACKS["small"].by_fingerprint
    ct8 = curricula.load("ct8").fingerprint
    assert TRACKS["forgetting"].by_fingerprint[ct8] is TRACKS["forgetting"].variants[0]


def test_the_small_track_is_four_goals_given_with_ids_or_with_less():
    found = TRACKS["small"]

    assert (found.id, found.seeds, found.score) == ("small-v1", tuple(range(20)), "normalised_performance")
    assert [each.given for each in found.variants] == [
        "task ids, boundaries",
        "task ids at boundaries",
        "boundaries",
        "nothing",
    ]
    assert found.curriculum.fingerprint == "84e7ff519e265d9b" and found.curriculum.num_frames == 409_600


def test_ladders_go_down_to_a_reward_in_a_billion_episodes_and_up_to_300_steps():
    deepest, longest = TRACKS["exploration"].variants[-1], TRACKS["memory"].variants[-1]

    assert deepest.rung == "depth 9" and deepest.curriculum.tasks[0].graph.reward_prob_random < 1e-9
    assert longest.rung == "depth 4, expected length 300"
    assert longest.curriculum.tasks[0].graph.expected_episode_length == pytest.approx(300)
    assert (TRACKS["memory"].variants[0].given, longest.given) == ("first rewards", "nothing")


def test_a_run_of_a_track_has_the_name_that_it_has_without():
    by_hand = ["curriculum=fo_b1_4tasks", "curriculum.num_frames=102400", "evaluation.before=false"]
    learner = ["agent=ppo", "method=mask_ri", "seed=0"]

    of_track, others = (
        plain(composed([*some, *learner])) for some in (["track=small"], [*by_hand, "protocol.task_id=one_hot"])
    )

    assert digest(of_track) == digest(others) and of_track == others


def test_a_track_without_seed_is_a_sweep_over_its_seeds(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)

    assert command_line(monkeypatch, "track=small", "agent=ppo") == 1
    assert "this configuration is a sweep, seed=range(20): add -m to run it" in capsys.readouterr().err


def test_held_out_seeds_follow_from_a_text():
    assert held_out_seeds("small-v1 ab 1", 3) == (1368827940, 586872641, 317709782)
    assert held_out_seeds("small-v1 ab 1", 2) == (1368827940, 586872641)
    others = (held_out_seeds("small-v1 ac 1", 3), held_out_seeds("small-v1 ab 2", 3))
    assert not {*held_out_seeds("small-v1 ab 1", 3)} & {*others[0], *others[1]}


def test_an_unknown_track_is_refused_with_the_one_that_was_meant():
    with pytest.raises(ValueError, match="unknown track 'forgeting': did you mean 'forgetting'"):
        track("forgeting")


def test_a_track_of_a_user_needs_all_parts(tmp_path):
    file = tmp_path / "track" / "mine.yaml"
    file.parent.mkdir()
    file.write_text("# @package _global_\ntrack: {version: 1, title: Mine, score: happiness}\n")

    with pytest.raises(ValueError, match=r"must say track.measures, track.breakthrough, track.less_given"):
        track("mine", tmp_path)

    full = "track: {version: 3, title: M, measures: m, breakthrough: b, score: average_performance, less_given: []}"
    text = f"# @package _global_\n{full}\nhydra: {{sweeper: {{params: {{seed: '5,6'}}}}}}\n"
    file.write_text(text.replace("average_performance", "forgetting"))
    with pytest.raises(ValueError, match=r"track\.score must be one of adapted_return, .* got 'forgetting'"):
        track("mine", tmp_path)
    file.write_text(text)
    own = track("mine", tmp_path)
    assert (own.id, own.seeds, own.curriculum.name) == ("mine-v3", (5, 6), "su_b1_4tasks")
