"""Curricula as JSON: nothing is lost, nothing else is let in."""

import copy
import json
from dataclasses import dataclass, field, is_dataclass, replace
from functools import partial
from importlib import import_module
from pkgutil import iter_modules
from types import ModuleType

import numpy as np
import pytest
from helpers.oracles import confounding, one_hot, surjective
from hypothesis import given, settings
from hypothesis import strategies as st

import curricula
from ctgraph_rl.core import rewards
from ctgraph_rl.core.graph import CTGraph
from ctgraph_rl.core.rewards import Gradient, Needle, ReferenceLinear
from ctgraph_rl.tasks import curriculum_json, images, switch
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.images import GroupedImages, ImageFile, OneHot, ReferenceImages
from ctgraph_rl.tasks.memory import bank_bytes
from ctgraph_rl.tasks.protocol import Block, Evaluation, Protocol
from ctgraph_rl.tasks.switch import AtRandom, ByEpisode, Drift

A, B, C = (surjective(goal=goal) for goal in ((1, 1), (1, 2), (2, 1)))


def full() -> Curriculum:
    """Every part that a curriculum can have, and a task several times."""
    changing = replace(B, reward_fn=Gradient(), goal_change=(2, 5), reward_std=0.1)
    blocks = (Block(A, 64), Block((A, changing, A), 192, Drift(100)), Block((changing, A), 64))
    evaluation = Evaluation(10, False, 5, every=64, tasks="seen", held_out=(C,))
    return Curriculum("full", 2, "tests", blocks, evaluation, Protocol("one_hot", "hidden", 4, (3, 0)))


@pytest.fixture
def content() -> dict:
    return full().to_json()


def through_text(curriculum: Curriculum) -> Curriculum:
    return Curriculum.from_json(json.loads(json.dumps(curriculum.to_json(), allow_nan=False)))


def changed(content: dict, place: str, value: object) -> dict:
    """A copy with another value at a place such as ``tasks/0/goal``; a class deletes it."""
    result = copy.deepcopy(content)
    *way, last = [int(key) if key.isdigit() else key for key in place.split("/")]
    parent = result
    for key in way:
        parent = parent[key]
    if isinstance(value, type):
        del parent[last]
    else:
        parent[last] = value
    return result


@pytest.mark.parametrize("name", curricula.names())
def test_every_named_curriculum_comes_back_from_json(name):
    curriculum = curricula.load(name)

    back = through_text(curriculum)

    assert back == curriculum
    assert back.fingerprint == curriculum.fingerprint


def test_every_part_comes_back_from_json(content):
    back = Curriculum.from_json(content)

    assert back == full()
    assert back.blocks[1].switch == Drift(100)
    assert back.evaluation.held_out == (C,)


def test_a_file_comes_back_and_is_never_overwritten(tmp_path):
    path = tmp_path / "full.json"

    content = full().to_json(path)

    assert json.loads(path.read_text()) == content
    assert Curriculum.from_json(str(path)) == full()
    with pytest.raises(ValueError, match=r"full\.json exists: choose another path"):
        full().to_json(path)


def test_tasks_are_listed_once_and_named_by_position(content):
    assert len(content["tasks"]) == 3
    assert [block["tasks"] for block in content["blocks"]] == [[0], [0, 1, 0], [1, 0]]
    assert content["evaluation"]["held_out"] == [2]


def test_every_field_is_written_with_its_default_too(content):
    assert content["tasks"][0] == {
        "graph": {"branching_factor": 2, "depth": 2, "wait_prob": 0.0},
        "goal": "1.1",
        "observations": {
            **{"wait_ids": [2, 2], "decision_ids": [3, 3], "end_ids": [4, 4], "home_ids": [0, 0], "fail_ids": [1, 1]},
            **{"unique_waits": False, "unique_decisions": False, "unique_ends": False},
            **{"read_noise": 0, "read_rotation": 0, "reward_cue": False},
            **{"legacy_index": False, "noise_before_rotation": False, "cue_wraps": False},
        },
        "images": {"type": "PaperImages", "num_images": 5, "seed": 1, "size": 12},
        "reward_fn": {"type": "Needle"},
        **{"goal_reward": 1.0, "fail_reward": 0.0, "step_reward": 0.0, "reward_std": 0.0, "reward_noise": "additive"},
        **{"goal_change": None, "extra_end_step": False, "legacy_goal_change": False, "swapped_branches": None},
    }
    assert content["blocks"][1]["switch"] == {"type": "Drift", "episodes": 100, "together": False}


def test_what_follows_from_the_rest_is_not_read(content):
    assert content["about"]["num_frames"] == 320
    assert content["about"]["tasks"][1]["num_states"] == 16

    assert Curriculum.from_json(changed(content, "about", {"note": 10**30})) == full()
    assert Curriculum.from_json(changed(content, "about", int)) == full()


def test_all_our_image_sets_rewards_and_switches_can_be_exchanged():
    def classes(*modules: ModuleType) -> set[type]:
        local = [item for module in modules for item in vars(module).values() if isinstance(item, type)]
        names = [module.__name__ for module in modules]
        return {item for item in local if is_dataclass(item) and item.__module__ in names}

    of_images = [import_module(f"{images.__name__}.{found.name}") for found in iter_modules(images.__path__)]

    assert set(images.IMAGE_SETS) == classes(*of_images) and len(of_images) >= 5
    assert set(rewards.REWARD_FNS.values()) == classes(rewards)
    assert set(switch.SWITCHES) == classes(switch)


def test_files_without_a_field_that_was_added_later_are_read():
    @dataclass(frozen=True)
    class Part:
        old: int
        new: int = field(default=3, metadata={"added": True})
        also_old: int = 1

    build = partial(curriculum_json._built, Part)

    assert build({"old": 1, "also_old": 2}) == Part(1, 3, 2)
    assert build({"old": 1, "also_old": 2, "new": 4}) == Part(1, 4, 2)
    with pytest.raises(ValueError, match="missing keys: also_old"):
        build({"old": 1})


def test_a_user_s_images_come_back_with_their_hash(tmp_path):
    np.save(tmp_path / "mine.npy", np.zeros((5, 2, 12, 12), np.uint8))
    task = replace(A, images=ImageFile.of(tmp_path / "mine.npy"))
    content = Curriculum("mine", 1, "", (Block(task, 1),)).to_json()

    back = Curriculum.from_json(content)

    assert back.tasks == (task,)
    with pytest.raises(ValueError, match=r"tasks\[0\]: images: sha256 of .*mine.npy must be 'abc'"):
        Curriculum.from_json(changed(content, "tasks/0/images/sha256", "abc"))


def test_numbers_that_need_more_than_64_bits_are_not_written():
    most = Curriculum("long", 1, "", (Block(A, 2**62), Block(B, 2**62 - 1)))

    assert through_text(most) == most
    with pytest.raises(ValueError, match=r"num_frames must be an integer < 2\*\*63, got 9223372036854775808"):
        Block(A, 2**63)
    with pytest.raises(ValueError, match="long: version: must fit 64 bits, got a larger integer"):
        replace(most, version=2**63).to_json()


@dataclass(frozen=True)
class Mine(Needle):
    """A user's reward."""


def test_a_user_s_own_types_are_refused_when_written_and_when_read(content):
    with pytest.raises(ValueError, match=r"JSON holds only types of this package, got Mine\(\)"):
        Curriculum("mine", 1, "", (Block(replace(A, reward_fn=Mine()), 1),)).to_json()
    with pytest.raises(ValueError, match=r"reward_fn: type must be one of Needle, Gradient, .*, got 'os\.s"):
        Curriculum.from_json(changed(content, "tasks/0/reward_fn/type", "os.system"))


WRONG = [
    ("fingerprint", "0" * 16, r"curriculum: fingerprint is '0{16}', but the content has '[0-9a-f]{16}'"),
    ("blocks/0/num_frames", 128, r"fingerprint is '[0-9a-f]{16}', but the content has"),
    ("schema", 2, "schema 2 is newer than 1, the newest that is known here; update"),
    ("schema", "1", "schema must be 1, got '1'"),
    ("version", str, "missing keys: version"),
    ("extra", 1, "unknown keys: extra"),
    ("block", 1, r"unknown keys: block; did you mean 'blocks'\?"),
    ("tasks/0/goal", str, r"tasks\[0\]: missing keys: goal"),
    ("tasks/0/graph/depht", 3, r"tasks\[0\]: graph: unknown keys: depht; did you mean 'depth'\?"),
    ("tasks/0/graph/depth", 10**9, r"tasks\[0\]: graph: depth=1000000000 .* more than 2\*\*63 - 1 states"),
    ("tasks/0/graph/depth", 2.5, r"graph: depth must be an integer >= 1, got 2\.5"),
    ("tasks/0/graph/wait_prob", float("nan"), r"tasks: 0: graph: wait_prob: must be a finite number, got nan"),
    ("tasks/0/goal_reward", float("inf"), r"goal_reward: must be a finite number"),
    ("tasks/0/goal_reward", 10**30, r"goal_reward: must fit 64 bits"),
    ("tasks/0/goal", [1, 3], r"tasks\[0\]: goal must be 2 decisions in 1\.\.2"),
    ("tasks/0/goal", "11", r"tasks\[0\]: goal must be 2 decisions"),
    ("tasks/0/images/num_images", 10**12, r"tasks\[0\]: images: num_images must be in 1\.\.43046721"),
    ("tasks/0/images/num_images", 4, r"tasks\[0\]: num_images=4 is too few for id 4"),
    (
        "tasks/0/images",
        {"type": "OneHot", "num_images": 10**12},
        r"images need 10{24}|limit is 68,719,476,736; use few",
    ),
    ("tasks/0/images", {"type": "ReferenceImages", "num_images": 10**9, "seed": 1, "noise": 0}, r"limit is 68,719"),
    ("tasks/0/images", [], r"tasks\[0\]: images: must be an object with a type, got \[\]"),
    ("tasks/0/observations", None, r"tasks\[0\]: observations: must be an object with wait_ids, .*, got None"),
    ("tasks/0/reward_fn/type", ["Needle"], r"type must be one of Needle, .*, got \['Needle'\]"),
    ("tasks", {}, r"curriculum: tasks must be a list, got \{\}"),
    ("blocks", [], r"curriculum: a curriculum needs at least one Block"),
    ("blocks/0/tasks", [3], r"blocks\[0\]: tasks: must be positions in the list of 3 tasks, from 0, got \[3\]"),
    ("blocks/0/tasks", [-1], r"blocks\[0\]: tasks: must be positions"),
    ("blocks/0/tasks", [True], r"blocks\[0\]: tasks: must be positions"),
    ("blocks/0/tasks", [], r"blocks\[0\]: a block needs at least one Task"),
    ("blocks/0/num_frames", 0, r"blocks\[0\]: num_frames must be an integer >= 1, got 0"),
    ("blocks/1/switch/type", "Jump", r"switch: type must be one of ByEpisode, AtRandom, Drift, got 'Jump'"),
    ("blocks/1/switch/episodes", -1, r"blocks\[1\]: switch: episodes must be an integer in 1\.\.2\*\*31"),
    ("evaluation/num_episodes", "many", r"evaluation: num_episodes must be an integer >= 1"),
    ("evaluation/held_out", 2, r"evaluation: held_out: must be positions"),
    ("protocol/task_id", ["hidden"], r"protocol: task_id must be one of hidden"),
    ("name", "", "a curriculum needs a name"),
    ("name", {}, "a curriculum needs a name"),
    ("source", None, "source must be a text, got None"),
    ("version", True, "version must be an integer >= 1, got True"),
]


@pytest.mark.parametrize(("place", "value", "message"), WRONG)
def test_wrong_json_is_refused_with_the_key(content, place, value, message):
    with pytest.raises(ValueError, match=message) as error:
        Curriculum.from_json(changed(content, place, value))

    assert str(error.value).startswith("curriculum: ")
    assert "\n" not in str(error.value)


NO_JSON = [
    (b"", "must be JSON: Expecting value"),
    (b"\xff\xfe\x00", "must be JSON"),
    (b"\xef\xbb\xbf{}", "must be JSON: Unexpected UTF-8 BOM"),
    ("{}".encode("utf-16"), "must be JSON: 'utf-8' codec can't decode"),
    (b"[1]", "must hold a JSON object, got list"),
    (b'{"name": NaN}', "name: must be a finite number, got nan"),
    (b'{"name": -Infinity}', "name: must be a finite number, got -inf"),
    (b'{"name": 1e999}', "name: must be a finite number, got inf"),
    (b'{"version": 1' + b"0" * 5000 + b"}", "must be JSON: an integer has 5,001 digits"),
    (b'{"a": 1, "a": 2}', "key 'a' occurs twice"),
    (b'{"a": ' + b"[" * 20 + b"]" * 20 + b"}", "nested more than 16 deep"),
    (b'{"a": ' + b"[" * 200_000 + b"]" * 200_000 + b"}", "nested more than 16 deep"),
]


@pytest.mark.parametrize(("data", "message"), NO_JSON, ids=range(len(NO_JSON)))
def test_a_file_that_is_no_curriculum_is_refused_with_its_name(tmp_path, data, message):
    path = tmp_path / "wrong.json"
    path.write_bytes(data)

    with pytest.raises(ValueError, match=rf"wrong\.json.*{message}"):
        Curriculum.from_json(path)


def test_a_file_that_is_too_large_or_missing_is_refused_with_its_name(tmp_path, monkeypatch):
    path = tmp_path / "long.json"
    full().to_json(path)
    size = path.stat().st_size

    monkeypatch.setattr(curriculum_json, "MAX_BYTES", size)
    assert Curriculum.from_json(path) == full()
    monkeypatch.setattr(curriculum_json, "MAX_BYTES", size - 1)
    with pytest.raises(ValueError, match=rf"long\.json has {size:,} bytes, the limit is {size - 1:,}"):
        Curriculum.from_json(path)
    missing = {tmp_path / "none.json": "no such file or directory; check", tmp_path: "is a dir"}
    for other, reason in missing.items():
        with pytest.raises(ValueError, match=rf"^{other}(?: cannot be opened)?: {reason}"):
            Curriculum.from_json(other)
    with pytest.raises(ValueError, match="path must have no null character"):
        Curriculum.from_json("\0")
    with pytest.raises(ValueError, match="needs the path of a JSON file or a dict, got 3"):
        Curriculum.from_json(3)


def test_a_bank_holds_each_set_once_and_pads_vectors():
    rotated = replace(A, observations=replace(A.observations, read_rotation=2))

    assert bank_bytes([A, B, replace(A, images=ReferenceImages(7))]) == (5 + 7) * 144
    assert bank_bytes([A, rotated]) == (5 + 5 * 3) * 144
    assert bank_bytes([one_hot(), one_hot(images=OneHot(9))]) == (5 + 9) * 9


TASKS = st.sampled_from(
    [
        A,
        B,
        C,
        confounding(),
        confounding(3, 3, 0.25, (3, 1, 2), read_noise=3, read_rotation=5),
        surjective(3, 1, 0.9, image_seed=2**62),
        replace(A, images=ReferenceImages(9, 3, 0.1), reward_fn=ReferenceLinear(), step_reward=-1e-3),
        replace(C, images=GroupedImages((1, 1, 3), 0.1, 0.2, 4), goal_change=(1, 2**31), goal_reward=-0.1),
        replace(B, graph=CTGraph(2, 11, 1 / 3), goal=(1, 2) * 5 + (1,), extra_end_step=True),
    ]
)
SWITCHES = st.one_of(
    st.builds(ByEpisode, st.integers(1, 2**31), st.booleans()),
    st.builds(AtRandom, st.one_of(st.just(1), st.floats(2**-40, 1)), st.booleans()),
    st.builds(Drift, st.integers(1, 2**31), st.booleans()),
)
MIXED = st.builds(Block, st.lists(TASKS, min_size=2, max_size=4), st.integers(1, 2**62), st.none() | SWITCHES)
BLOCKS = st.lists(st.one_of(st.builds(Block, TASKS, st.integers(1, 10**6)), MIXED), min_size=1, max_size=5)
EVALUATIONS = st.builds(
    Evaluation,
    st.sampled_from([1, 50]).map(lambda n: 4 * n),
    st.booleans(),
    st.sampled_from([1, 2, 4]),
    st.just(True),
    st.just(0) | st.integers(2**32, 2**40),
    st.booleans(),
    st.sampled_from(["all", "seen"]),
).filter(lambda how: how.at_block_ends or how.tasks == "all")  # else nothing may ever be evaluated


@settings(max_examples=10, deadline=None)
@given(st.text(min_size=1), st.integers(1, 99), st.text(), BLOCKS, EVALUATIONS)
def test_random_curricula_come_back_from_json(name, version, source, blocks, evaluation):
    curriculum = Curriculum(name, version, source, blocks, evaluation)

    assert through_text(curriculum) == curriculum


def places(value: object, prefix: str = "") -> list[str]:
    """All places of a JSON value, in the form that ``changed`` takes."""
    pairs = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [place for key, item in pairs for place in (f"{prefix}{key}", *places(item, f"{prefix}{key}/"))]


ANY_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_subnormal=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)


@settings(max_examples=30, deadline=None)
@given(st.sampled_from([place for place in places(full().to_json()) if not place.startswith("about")]), ANY_JSON)
def test_any_json_at_any_place_is_refused_or_means_the_same_content(place, value):
    wrong = changed(full().to_json(), place, value)

    try:
        back = Curriculum.from_json(wrong)
    except ValueError as error:
        assert str(error).startswith("curriculum: ")
    else:
        assert back.fingerprint == full().fingerprint
