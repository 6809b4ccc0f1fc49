"""Curricula from the labs' meta-JSON: order, choice, labels, dialects, and everything that is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from helpers.lab_files import environment

import curricula
from ctgraph_rl import CTGraph, Task
from ctgraph_rl.tasks.protocol import Evaluation, Protocol
from curricula import meta_json
from curricula.meta_json import MOST_BYTES, place_of
from curricula.published import one_wait_image

OLD_KEYS = {
    "d": "depth",
    "b": "branching_factor",
    "p": "wait_prob",
    "high_r": "high_reward_value",
    "fail_r": "crash_reward_value",
    "std_r": "reward_std",
    "MDP_D": "MDP_decision_s",
    "MDP_W": "MDP_wait_s",
    "W_IDs": "wait_states",
    "D_IDs": "decision_states",
    "noise_on_read": "noise_on_images_on_read",
    "rotation_on_read": "small_rotation_on_read",
}
"""The keys of 2023 and those of 2021."""

ONE_WAIT_IMAGE = {
    1: ((2, 2), (3, 3), (4, 5)),
    2: ((2, 2), (3, 5), (6, 9)),
    3: ((2, 2), (3, 9), (10, 17)),
}
"""Ids of wait, decision and end states by depth."""


def config(depth: int, seed: int) -> dict[str, Any]:
    """An environment file with the keys of 2023."""
    return environment(depth, *ONE_WAIT_IMAGE[depth], seed, unique=(True, False))


def with_old_keys(content: dict[str, Any]) -> dict[str, Any]:
    """The same with the keys of 2021."""
    old = {name: {OLD_KEYS.get(key, key): value for key, value in part.items()} for name, part in content.items()}
    old["reward"]["stochastic_sampling"] = False
    return old


def write(folder: Path, meta: dict[str, Any] | str, **configs: dict[str, Any]) -> Path:
    """A meta-JSON file and its environment files, ``s1d2.json`` for image seed 1 and depth 2 among them."""
    (folder / "envs").mkdir(exist_ok=True)
    known = {f"s{seed}d{depth}": config(depth, seed) for seed in (1, 2) for depth in ONE_WAIT_IMAGE}
    for name, content in {**known, **configs}.items():
        (folder / "envs" / f"{name}.json").write_text(json.dumps(content))
    file = folder / "mine.json"
    file.write_text(meta if isinstance(meta, str) else json.dumps(meta))
    return file


def meta(*names: str, **changes: Any) -> dict[str, Any]:
    base = {"task_order": "default", "one_hot": True, "label_dim": 100}
    return {"config_paths": [f"envs/{name}.json" for name in names], **base, **changes}


def listing(curriculum) -> list[str]:
    tasks = [block.tasks[0] for block in curriculum.blocks]
    return [f"{task.image_seed}:{''.join(str(decision - 1) for decision in task.goal)}" for task in tasks]


@pytest.mark.parametrize(
    ("names", "changes", "expected", "ids"),
    [
        (["s1d1", "s2d1"], {}, "1:0 1:1 2:0 2:1", (0, 1, 2, 3)),
        (["s2d1", "s1d1"], {}, "2:0 2:1 1:0 1:1", (0, 1, 2, 3)),
        (["s1d1", "s1d2"], {"task_order": "interleaved"}, "1:0 1:00 1:1 1:01 1:10 1:11", (0, 1, 2, 3, 4, 5)),
        (["s1d2", "s1d1"], {"task_order": "interleaved"}, "1:00 1:0 1:01 1:1 1:10 1:11", (0, 1, 2, 3, 4, 5)),
        (["s1d3"], {"filter_tasks": [7, 0, 3]}, "1:111 1:000 1:011", (7, 0, 3)),
        (["s1d2", "s2d3"], {"filter_tasks": [4, 3, 11]}, "2:000 1:11 2:111", (4, 3, 11)),
        (["s1d3"], {"num_tasks": 3}, "1:000 1:001 1:010", (0, 1, 2)),
        (["s1d3"], {"filter_tasks": [5, 6, 7], "num_tasks": 2}, "1:101 1:110", (5, 6)),
        (["s1d1"], {"num_tasks": 16_368}, "1:0 1:1", (0, 1)),
        (["s1d2"], {"filter_tasks": [2, 1, 2]}, "1:10 1:01 1:10", (2, 1)),
        (
            ["s1d2"],
            {"filter_tasks": [2, 1], "task_label_mode": "curriculum_index"},
            "1:10 1:01",
            (0, 1),
        ),
        (["s1d2"], {"filter_tasks": [2, 1], "label_by_curriculum_index": True}, "1:10 1:01", (0, 1)),
        (["s1d2"], {"filter_tasks": [2, 1], "label_by_curriculum_index": False}, "1:10 1:01", (2, 1)),
        (["s1d2"], {"filter_tasks": [2, 1, 2], "task_label_ids": [9, 4, 9]}, "1:10 1:01 1:10", (9, 4)),
    ],
)
def test_tasks_and_labels_are_those_that_the_file_asks_for(tmp_path, names, changes, expected, ids):
    read = curricula.from_meta_json(write(tmp_path, meta(*names, **changes)), 512)

    assert listing(read) == expected.split()
    assert read.protocol == Protocol("one_hot", num_task_ids=100, task_ids=ids)


def test_the_rest_is_the_caller_s_or_a_default(tmp_path):
    file = write(tmp_path, meta("s1d1"))

    read = curricula.from_meta_json(file, [512, 1024], name="theirs")

    assert (read.name, read.version, read.source) == ("theirs", 1, "meta-JSON file mine.json")
    assert [block.num_frames for block in read.blocks] == [512, 1024]
    assert read.evaluation == Evaluation()
    assert curricula.from_meta_json(str(file), 512).name == "mine"


def test_environments_may_have_the_keys_of_2021_or_2023(tmp_path):
    old = with_old_keys(config(2, 7))

    read = curricula.from_meta_json(write(tmp_path, meta("old"), old=old), 512)

    assert read.tasks[3] == one_wait_image("11", 7)


def test_a_named_curriculum_equals_its_file(tmp_path):
    file = write(tmp_path, meta("s1d2", "s1d3", task_order="interleaved", label_dim=12, num_tasks=12))

    read, ct12 = curricula.from_meta_json(file, 102_400), curricula.load("ct12")

    assert (read.blocks, read.protocol) == (ct12.blocks, ct12.protocol)


def test_goals_of_wider_trees_count_in_their_own_base(tmp_path):
    wide = environment(2, (2, 20), (21, 40), (41, 60), 1)
    wide["graph_shape"]["b"] = 3

    read = curricula.from_meta_json(write(tmp_path, meta("wide"), wide=wide), 512)

    assert [task.goal for task in read.tasks] == [(i, j) for i in (1, 2, 3) for j in (1, 2, 3)]
    assert read.tasks[0].graph == CTGraph(3, 2)


def test_paths_are_relative_to_the_file(tmp_path):
    write(tmp_path, meta("s1d1"))
    file = tmp_path / "other.json"
    file.write_text(json.dumps({**meta(), "config_paths": ["envs/../envs/s2d1.json"]}))

    assert listing(curricula.from_meta_json(file, 512)) == ["2:0", "2:1"]


def test_a_yaml_of_one_s_own_can_name_the_file(tmp_path):
    from hydra.utils import instantiate

    file = write(tmp_path, meta("s1d1"))

    built = instantiate({"_target_": "curricula.from_meta_json", "path": str(file), "num_frames": 512})

    assert built == curricula.from_meta_json(file, 512)


@pytest.mark.parametrize("order", ["default", "interleaved"])
def test_a_number_is_found_without_listing_the_pool(order):
    sizes = (4, 8, 2, 4)

    lists = [[(config, goal) for goal in range(size)] for config, size in enumerate(sizes)]
    in_turns = [part[i] for i in range(8) for part in lists if i < len(part)]
    expected = in_turns if order == "interleaved" else [entry for part in lists for entry in part]
    assert [place_of(number, sizes, order) for number in range(sum(sizes))] == expected


def test_few_tasks_of_a_pool_beyond_counting_are_read_at_once(tmp_path):
    deep = environment(40, (2, 2), (3, 2**40 + 1), (2**40 + 2, 2**41 + 1), 1, unique=(True, False))
    file = write(tmp_path, meta("deep", filter_tasks=[2**40 - 1], task_label_ids=[0]), deep=deep)

    read = curricula.from_meta_json(file, 512)

    assert read.tasks[0].goal == (2,) * 40


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"filter_tasks": [0, 4]}, r"filter_tasks must be in 0..3, the goals of config_paths, got \[4\]"),
        ({"filter_tasks": [-1]}, r"filter_tasks must be a list of 1 to 10000 integers >= 0, got \[-1\]"),
        ({"filter_tasks": []}, r"filter_tasks must be a list of 1 to 10000 integers >= 0, got \[\]"),
        ({"filter_tasks": [True]}, r"filter_tasks must be a list .*, got \[True\]"),
        ({"filter_tasks": None}, r"filter_tasks must be a list .*, got None"),
        ({"filter_tasks": [0] * 10_001}, r"filter_tasks must be a list of 1 to 10000 .*got \[0, 0, 0"),
        ({"label_dim": 3}, r"label_dim must be at least 4, one more than a label, got 3"),
        ({"label_dim": 0}, r"label_dim must be an integer >= 1 and <= 1000000, got 0"),
        ({"label_dim": 10**9}, r"label_dim must be an integer >= 1 and <= 1000000, got 1000000000"),
        ({"num_tasks": 0}, r"num_tasks must be an integer >= 1, got 0"),
        ({"one_hot": False}, r"one_hot must be true, got False; other labels are random there"),
        ({"task_order": "random"}, r"task_order must be default or interleaved, got 'random'; .*cannot be reproduced"),
        ({"task_order": "sorted"}, r"task_order must be default or interleaved, got 'sorted'$"),
        ({"task_order": "interleaved"}, r"task_order interleaved needs at least two config_paths"),
        ({"config_paths": []}, r"config_paths must be a list of 1 to 1000 paths, got \[\]"),
        ({"config_paths": "envs"}, r"config_paths must be a list of 1 to 1000 paths, got 'envs'"),
        ({"config_paths": [1]}, r"config_paths must be a list of 1 to 1000 paths, got \[1\]"),
        (
            {"filter_task": [0]},
            r"unknown keys: filter_task; did you mean 'filter_tasks'\?",
        ),
        ({"task_label_mode": "own"}, r"task_label_mode must be one of global_task_id, .*, got 'own'"),
        ({"task_label_mode": "explicit"}, "task_label_mode explicit needs task_label_ids"),
        ({"task_label_ids": [0]}, r"task_label_ids must be one for each of 4 tasks, got 1"),
        ({"task_label_ids": [0, 1, 2, 100]}, r"label_dim must be at least 101, one more than a label, got 100"),
        ({"label_by_curriculum_index": 1}, "label_by_curriculum_index must be true or false, got 1"),
        (
            {"filter_tasks": [1, 1], "task_label_mode": "curriculum_index"},
            "a task has one id in a curriculum, but goal1.2 would have 0 and 1",
        ),
    ],
)
def test_what_cannot_be_is_refused_with_file_and_key(tmp_path, changes, message):
    file = write(tmp_path, {**meta("s1d2"), **changes})

    with pytest.raises(ValueError, match=message) as refused:
        curricula.from_meta_json(file, 512)

    assert str(refused.value).startswith(f"{file}: ")


@pytest.mark.parametrize("key", ["config_paths", "task_order", "label_dim", "one_hot"])
def test_a_missing_key_is_named(tmp_path, key):
    content = meta("s1d2")
    del content[key]

    with pytest.raises(ValueError, match=rf"mine.json: missing keys: {key}"):
        curricula.from_meta_json(write(tmp_path, content), 512)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"filter_tasks": [1, 2,]}', r"mine.json must be JSON: (Illegal trailing comma|Expecting value)"),
        ("[1, 2]", "mine.json must hold a JSON object, got list"),
        ("", "mine.json must be JSON: Expecting value"),
        ("[" * 200_000, "mine.json must be JSON: (nested more than 8 deep|Expecting value)"),
        ('{"config_paths": ' + "[" * 50 + "]" * 50 + "}", "mine.json must be JSON: nested more than 8 deep"),
        ('{"config_paths": ' + "[" * 100_000 + "]" * 100_000 + "}", "mine.json must be JSON: nested more than 8 deep"),
        (" " * (MOST_BYTES + 1), "mine.json has 4,194,305 bytes, the limit is 4,194,304"),
        ('{"label_dim": ' + "9" * 5000 + "}", "mine.json must be JSON: an integer has 5,000 digits"),
    ],
)
def test_text_that_is_no_such_file_is_refused(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        curricula.from_meta_json(write(tmp_path, text), 512)


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"none.json cannot be opened: no such file"):
        curricula.from_meta_json(tmp_path / "none.json", 512)
    with pytest.raises(ValueError, match=r"envs/none.json cannot be opened: no such file"):
        curricula.from_meta_json(write(tmp_path, meta("none")), 512)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c["graph_shape"].pop("d"), r"envs/bad.json: configuration: graph_shape.d is missing"),
        (lambda c: c["graph_shape"].update(d=0), r"envs/bad.json: depth must be an integer >= 1, got 0"),
        (lambda c: c["image_dataset"].update(nr_of_images=5), r"num_images=5 is too few for id 9 in observations"),
        (lambda c: c["observations"].update(D_IDs=[3, 4]), r"unique_decisions needs 3 decision_ids, got 2 in \(3, 4\)"),
        (lambda c: c.update(seed=1), r"envs/bad.json: configuration: unknown section 'seed'"),
    ],
)
def test_an_environment_that_cannot_be_is_refused(tmp_path, change, message):
    bad = config(2, 1)
    change(bad)

    with pytest.raises(ValueError, match=message):
        curricula.from_meta_json(write(tmp_path, meta("bad"), bad=bad), 512)


def test_a_pool_of_too_many_tasks_needs_a_filter(tmp_path):
    deep = environment(17, (2, 2), (3, 2**17 + 1), (2**17 + 2, 2**18 + 1), 1, unique=(True, False))

    with pytest.raises(ValueError, match="131072 tasks are too many, at most 10000: use filter_tasks or num_tasks"):
        curricula.from_meta_json(write(tmp_path, meta("deep"), deep=deep), 512)


def test_a_budget_of_no_frames_is_refused(tmp_path):
    with pytest.raises(ValueError, match="num_frames must be an integer >= 1, got 0"):
        curricula.from_meta_json(write(tmp_path, meta("s1d1")), 0)


def test_the_tasks_are_those_of_from_json(tmp_path):
    file = write(tmp_path, meta("s1d2"))

    read = curricula.from_meta_json(file, 512)

    (first, *_) = read.tasks
    assert first == Task.from_json(tmp_path / "envs" / "s1d2.json", (1, 1))
    assert read.tasks[2] == replace(first, goal=(2, 1))


def test_a_list_may_be_as_long_as_is_allowed_and_no_longer(tmp_path, monkeypatch):
    monkeypatch.setattr(meta_json, "MOST_TASKS", 3)

    assert [meta_json._ints_rule("filter_tasks", [*range(number)])[0] for number in range(5)] == [0, 1, 1, 1, 0]
