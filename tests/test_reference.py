"""The authors' implementation: its image sets, its configuration files, and its recorded behaviour."""

import copy
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from oracles import act

from ctgraph_rl import (
    CTGraph,
    CTGraphEnv,
    Gradient,
    Needle,
    Observations,
    OneHot,
    PaperImages,
    ReferenceImages,
    ReferenceLinear,
    ReferenceOneHot,
    Task,
    count_repeats,
)
from ctgraph_rl.rotation import rotate

DATA = Path(__file__).parent / "data"
RECORDED = np.load(DATA / "reference_images.npz")
TRACES = json.loads((DATA / "reference_traces.json").read_text(encoding="utf-8"))

MOHQA_2019 = {
    "general_seed": 2,
    "graph_shape": {"depth": 2, "branching_factor": 2, "delay_prob": 0.9},
    "reward": {
        "high_reward_value": 1.0,
        "crash_reward_value": 0.0,
        "stochastic_sampling": False,
        "reward_std": 0.1,
        "min_static_reward_episodes": 30,
        "max_static_reward_episodes": 70,
        "reward_distribution": "needle_in_haystack",
    },
    "observations": {
        "MDP_decisions": True,
        "MDP_delays": True,
        "delay_states": [3, 67],
        "decision_points": [68, 75],
        "graph_ends": [76, 80],
    },
    "image_dataset": {
        "seed": 1,
        "1D": False,
        "nr_of_images": 81,
        "noise_on_images_on_read": 0,
        "small_rotation_on_read": 1,
    },
}

L2D2C_2021 = {
    "general_seed": 3,
    "graph_shape": {"depth": 2, "branching_factor": 2, "wait_prob": 0.5},
    "reward": {
        "high_reward_value": 1.0,
        "crash_reward_value": 0.0,
        "stochastic_sampling": False,
        "reward_std": 0.1,
        "min_static_reward_episodes": 5000,
        "max_static_reward_episodes": 5001,
        "reward_distribution": "needle_in_haystack",
    },
    "observations": {
        "MDP_decision_s": True,
        "MDP_wait_s": True,
        "wait_states": [2, 8],
        "decision_states": [9, 11],
        "graph_ends": [12, 15],
    },
    "image_dataset": {
        "seed": 3,
        "1D": False,
        "nr_of_images": 16,
        "noise_on_images_on_read": 0,
        "small_rotation_on_read": 1,
    },
}

SHIPPED_2023 = {
    "general_seed": 3,
    "graph_shape": {"d": 2, "b": 2, "p": 0.0},
    "reward": {
        "high_r": 1.0,
        "fail_r": 0.0,
        "std_r": 0.0,
        "min_static_reward_episodes": -1,
        "max_static_reward_episodes": -1,
        "reward_distribution": "needle_in_haystack",
    },
    "observations": {"MDP_D": False, "MDP_W": False, "W_IDs": [2, 2], "D_IDs": [3, 3], "graph_ends": [4, 4]},
    "image_dataset": {"seed": 2, "1D": False, "nr_of_images": 40, "noise_on_read": 0.05, "rotation_on_read": 10},
}

FILES = {"2019": MOHQA_2019, "2021": L2D2C_2021, "2023": SHIPPED_2023}
DELETED = object()

every_file = pytest.mark.parametrize("year", list(FILES))


def changed(content, **changes):
    """A copy of a file with values of ``section__key`` replaced, added or deleted."""
    content = copy.deepcopy(content)
    for name, value in changes.items():
        section, key = name.split("__")
        if value is DELETED:
            del content[section][key]
        else:
            content[section][key] = value
    return content


def shown_as_there(**ids_and_flags):
    """Observations with the switches that every file of the authors' implementation stands for."""
    return Observations(**ids_and_flags, reward_cue=True, cue_wraps=True, legacy_index=True, noise_before_rotation=True)


def one_hot_file(**changes):
    return changed(SHIPPED_2023, image_dataset__1D=True, image_dataset__rotation_on_read=1, **changes)


# Image sets


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_the_image_sets_equal_the_recorded_ones_pixel_by_pixel(seed):
    recorded = RECORDED[f"seed{seed}"]

    images = ReferenceImages(40, seed).images

    assert images.dtype == torch.uint8
    assert np.array_equal(images, recorded)


def test_noise_on_read_lowers_the_levels_of_the_image_set_as_recorded():
    recorded = RECORDED["seed1_noise10"]

    images = ReferenceImages(40, 1, noise=10)

    assert np.array_equal(images.images, recorded)
    assert images.white == 244 == recorded.max()


def test_the_shipped_noise_takes_one_level_off_although_it_adds_nothing():
    images = ReferenceImages(40, 2, noise=0.05)

    plain = ReferenceImages(40, 2).images

    assert (images.white, int(images.images.max()), int(plain.max())) == (253.95, 253, 254)
    assert int((plain.long() - images.images).max()) == 1


def test_the_first_images_of_a_longer_set_are_those_of_the_shorter_one():
    longer = ReferenceImages(100, seed=3).images

    shorter = ReferenceImages(7, seed=3).images

    assert torch.equal(shorter, longer[:7])


def test_an_image_without_black_cells_keeps_to_its_levels_unless_a_pixel_is_fully_outside():
    sets = ReferenceImages(28, seed=5).images, ReferenceImages(539, seed=2).images

    darkest = [int(images[-1].min()) for images in sets]

    assert darkest == [127, 0]  # rotated by 350 and by 61 degrees; as scikit-image 0.26.0 does


def test_a_reference_set_has_one_image_per_id_and_a_bank_of_rotations():
    images = ReferenceImages(5)

    bank = images.bank(2)

    assert (images.num_images, images.num_variants, images.shape, images.size) == (5, 1, (1, 12, 12), 12)
    assert bank.shape == (15, 1, 12, 12)
    assert torch.equal(bank[::3, 0], images.images)


def test_reference_sets_are_equal_and_hashable_by_value():
    sets = {ReferenceImages(5), ReferenceImages(5, 1, 0), ReferenceImages(5, 1, 0.05), ReferenceImages(5, 2)}

    assert len(sets) == 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_images": 0}, "num_images must be an integer >= 1, got 0"),
        ({"seed": 2**32}, r"image seed must be in \[0, 2\*\*32\), got 4294967296"),
        ({"seed": -1}, r"image seed must be in \[0, 2\*\*32\), got -1"),
        ({"noise": 254.5}, r"noise must be a number in \[0, 254\], got 254.5"),
        ({"noise": -1}, r"noise must be a number in \[0, 254\], got -1"),
        ({"noise": "0"}, r"noise must be a number in \[0, 254\], got '0'"),
    ],
)
def test_values_out_of_range_of_a_reference_set_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        ReferenceImages(**{"num_images": 5, **arguments})


def test_the_largest_seed_and_noise_are_accepted():
    images = ReferenceImages(2, seed=2**32 - 1, noise=254)

    assert images.white == 0
    assert int(images.images.max()) == 0


def test_repeats_are_the_images_that_equal_an_earlier_one():
    images = torch.tensor([1, 2, 1, 3, 2, 1], dtype=torch.uint8).view(6, 1, 1).expand(6, 4, 4)

    repeats = count_repeats(images)

    assert repeats == 3


def test_reference_sets_keep_their_repeats_and_the_paper_sets_have_none():
    sets = ReferenceImages(5, noise=254), ReferenceImages(40), PaperImages(40)

    repeats = [count_repeats(images.images) for images in sets]

    assert repeats == [4, 0, 0]


@pytest.mark.parametrize("images", [torch.zeros(2, 3, 3), torch.zeros(3, 3, dtype=torch.uint8)])
def test_repeats_are_counted_among_images_only(images):
    with pytest.raises(ValueError, match=r"images must be uint8 \[n, r, r\] with n >= 1, got"):
        count_repeats(images)


def test_the_reference_one_hot_is_254_at_the_id_and_has_a_last_element_for_the_cue():
    images = ReferenceOneHot(3)

    bank = images.bank(5)

    assert bank.dtype == torch.uint8
    assert bank.tolist() == [[254, 0, 0, 0], [0, 254, 0, 0], [0, 0, 254, 0]]
    assert (images.shape, images.num_variants, images.cue_element, images.white) == ((4,), 1, True, 254)


def test_a_reference_one_hot_without_images_is_refused():
    with pytest.raises(ValueError, match="num_images must be an integer >= 1, got 0"):
        ReferenceOneHot(0)


# Reading


def test_the_file_of_2019_has_a_goal_that_stays_and_rewards_without_noise():
    task = Task.from_json(MOHQA_2019, goal=(1, 2))

    assert task == Task(
        CTGraph(2, 2, 0.9),
        (1, 2),
        shown_as_there(
            wait_ids=(3, 67), decision_ids=(68, 75), end_ids=(76, 80), unique_waits=True, unique_decisions=True
        ),
        ReferenceImages(81, seed=1),
        reward_noise="multiplicative",
        extra_end_step=True,
    )


def test_the_file_of_2021_changes_the_goal_every_5000_episodes():
    task = Task.from_json(L2D2C_2021, goal=(2, 2))

    assert task == Task(
        CTGraph(2, 2, 0.5),
        (2, 2),
        shown_as_there(
            wait_ids=(2, 8), decision_ids=(9, 11), end_ids=(12, 15), unique_waits=True, unique_decisions=True
        ),
        ReferenceImages(16, seed=3),
        reward_noise="multiplicative",
        goal_change=(5000, 5000),
        extra_end_step=True,
        legacy_goal_change=True,
    )


def test_the_older_switch_of_reward_noise_is_read_over_where_there_is_none():
    plain = Task.from_json(changed(SHIPPED_2023, reward__std_r=0), goal=(1, 1))

    for switch in (False, True):
        file = changed(SHIPPED_2023, reward__std_r=0, reward__stochastic_sampling=switch)
        assert Task.from_json(file, goal=(1, 1)) == plain


def test_the_shipped_file_of_2023_has_rotations_below_ten_degrees_and_no_noise():
    task = Task.from_json(SHIPPED_2023, goal=[1, 1])

    assert task == Task(
        CTGraph(2, 2),
        (1, 1),
        shown_as_there(wait_ids=(2, 2), decision_ids=(3, 3), end_ids=(4, 4), read_rotation=9),
        ReferenceImages(40, seed=2, noise=0.05),
        reward_noise="multiplicative",
        extra_end_step=True,
    )
    assert task.observations.unique_ends is False


def test_every_value_of_a_file_arrives_where_it_belongs():
    content = changed(
        SHIPPED_2023,
        graph_shape__d=1,
        graph_shape__b=4,
        graph_shape__p=0.25,
        reward__high_r=2.0,
        reward__fail_r=-0.5,
        reward__std_r=0.3,
        reward__reward_distribution="linear",
        reward__min_static_reward_episodes=3,
        reward__max_static_reward_episodes=9,
        observations__MDP_W=True,
        observations__W_IDs=[2, 6],
        observations__D_IDs=[7, 8],
        observations__graph_ends=[9, 12],
        image_dataset__noise_on_read=7.9,
    )

    task = Task.from_json(content, goal=(4,))

    x = task.observations
    assert (task.graph, task.reward_fn) == (CTGraph(4, 1, 0.25), ReferenceLinear())
    assert (task.goal_reward, task.fail_reward, task.reward_std) == (2.0, -0.5, 0.3)
    assert (task.goal_change, task.legacy_goal_change) == ((3, 8), True)
    assert (x.unique_waits, x.unique_decisions, x.unique_ends) == (True, False, True)
    assert (x.wait_ids, x.decision_ids, x.end_ids) == ((2, 6), (7, 8), (9, 12))
    assert (x.read_noise, x.read_rotation, task.images) == (7, 9, ReferenceImages(40, 2, 7.9))


@pytest.mark.parametrize(("year", "std_key"), [("2019", "reward_std"), ("2021", "reward_std"), ("2023", "std_r")])
def test_the_standard_deviation_of_rewards_counts_where_sampling_is_stochastic(year, std_key):
    gate = {} if year == "2023" else {"reward__stochastic_sampling": True}
    content = changed(FILES[year], **{f"reward__{std_key}": 0.25}, **gate)

    task = Task.from_json(content, goal=(1, 1))

    assert (task.reward_std, task.reward_noise) == (0.25, "multiplicative")


def test_one_dimensional_observations_have_neither_noise_nor_rotation():
    task = Task.from_json(one_hot_file(), goal=(1, 1))

    assert task.images == ReferenceOneHot(40)
    assert (task.observations.read_noise, task.observations.read_rotation) == (0, 0)


@every_file
def test_the_general_seed_is_not_of_the_task(year):
    content = {name: section for name, section in FILES[year].items() if name != "general_seed"}

    task = Task.from_json(content, goal=(1, 1))

    assert task == Task.from_json(FILES[year], goal=(1, 1))


@every_file
def test_a_file_and_its_content_give_the_same_task(tmp_path, year):
    path = tmp_path / "graph.json"
    path.write_text(json.dumps(FILES[year]), encoding="utf-8")

    tasks = [Task.from_json(source, goal=(2, 1)) for source in (path, str(path), FILES[year])]

    assert tasks[0] == tasks[1] == tasks[2]


# Refusals of reading


def test_a_file_without_a_goal_is_refused_with_what_the_goal_is_there():
    message = "goal is not in the file and must be given: .* at random .*set_high_reward_path, counting from 0; add 1"

    with pytest.raises(ValueError, match=message):
        Task.from_json(SHIPPED_2023)


def test_a_path_counted_from_0_is_refused():
    with pytest.raises(ValueError, match=r"goal must be 2 decisions in 1\.\.2, such as \(1, 1\), got \(0, 1\)"):
        Task.from_json(SHIPPED_2023, goal=(0, 1))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "graph.json must be JSON: "),
        ("", "graph.json must be JSON: "),
        ("[1]", "graph.json must hold a JSON object, got list"),
    ],
)
def test_a_file_that_holds_no_object_is_refused_by_name(tmp_path, text, message):
    path = tmp_path / "graph.json"
    path.write_text(text, encoding="utf-8")

    with pytest.raises(ValueError, match=message):
        Task.from_json(path, goal=(1, 1))


def test_bytes_that_are_no_text_are_refused_by_name(tmp_path):
    path = tmp_path / "graph.json"
    path.write_bytes(b"\xff\xfe\x00")

    with pytest.raises(ValueError, match=r"graph\.json must be JSON: "):
        Task.from_json(path, goal=(1, 1))


def test_a_missing_file_is_refused_by_name(tmp_path):
    with pytest.raises(ValueError, match=r"missing\.json must be a JSON file that can be read"):
        Task.from_json(tmp_path / "missing.json", goal=(1, 1))


def test_what_is_neither_a_path_nor_a_dict_is_refused():
    with pytest.raises(ValueError, match=r"from_json needs the path of a JSON file or a dict, got 3"):
        Task.from_json(3, goal=(1, 1))


def test_a_fault_in_a_file_is_told_with_its_name(tmp_path):
    path = tmp_path / "graph.json"
    path.write_text(json.dumps(changed(SHIPPED_2023, graph_shape__d=DELETED)), encoding="utf-8")

    with pytest.raises(ValueError, match=r"graph\.json: graph_shape\.d is missing"):
        Task.from_json(path, goal=(1, 1))


@every_file
def test_every_missing_key_is_named_with_its_section(year):
    places = [(section, key) for section, keys in FILES[year].items() if section != "general_seed" for key in keys]

    for section, key in places:
        content = changed(FILES[year], **{f"{section}__{key}": DELETED})
        with pytest.raises(ValueError, match=rf"^configuration: {section}\.{key} is missing$"):
            Task.from_json(content, goal=(1, 1))

    assert len(places) == {"2019": 20, "2021": 20, "2023": 19}[year]


@pytest.mark.parametrize(
    ("year", "changes", "message"),
    [
        (
            "2023",
            {"graph_shape__delay_prob": 0.0},
            r"graph_shape\.delay_prob is of the 2019 dialect, the other keys of the 2023 one: use 'p'",
        ),
        (
            "2021",
            {"observations__W_IDs": [2, 8]},
            r"observations\.W_IDs is of the 2023 dialect, the other keys of the 2021 one: use 'wait_states'",
        ),
        (
            "2019",
            {"graph_shape__wait_prob": 0.9, "graph_shape__delay_prob": DELETED},
            r"graph_shape\.wait_prob is of the 2021 dialect, .* 2019 one: use 'delay_prob'; .*delay_prob is missing",
        ),
        (
            "2023",
            {"reward__stochastic_sampling": False, "reward__std_r": 0.1},
            r"reward\.stochastic_sampling is of the 2019 dialect, the other keys of the 2023 one: leave it out",
        ),
        (
            "2023",
            {"reward__step_reward": 0.0},
            r"unknown key reward\.step_reward; .*fail_r",
        ),
        (
            "2023",
            {"observations__graph_end": [4, 4]},
            r"unknown key observations\.graph_end; did you mean 'graph_ends'\?",
        ),
    ],
)
def test_a_key_that_is_unknown_or_of_another_dialect_is_refused_with_a_suggestion(year, changes, message):
    content = changed(FILES[year], **changes)

    with pytest.raises(ValueError, match=message):
        Task.from_json(content, goal=(1, 1))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rewards": {}}, "unknown section 'rewards'; did you mean 'reward'?"),
        ({"reward": None}, "section 'reward' must be an object"),
        ({"reward": DELETED}, "section 'reward' is missing"),
    ],
)
def test_a_section_that_is_unknown_missing_or_no_object_is_refused(change, message):
    content = {name: section for name, section in {**SHIPPED_2023, **change}.items() if section is not DELETED}

    with pytest.raises(ValueError) as refusal:
        Task.from_json(content, goal=(1, 1))

    assert str(refusal.value) == f"configuration: {message}"


def test_an_empty_object_is_refused_with_all_that_is_missing():
    with pytest.raises(ValueError, match=r"'graph_shape' is missing; .*'reward' .*'observations' .*'image_dataset' "):
        Task.from_json({}, goal=(1, 1))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"image_dataset__rotation_on_read": 0},
            r"rotation_on_read must be an integer in 1\.\.360, got 0; .* 0 makes the authors' implementation crash",
        ),
        ({"image_dataset__rotation_on_read": 361}, r"rotation_on_read must be an integer in 1\.\.360, got 361"),
        ({"image_dataset__rotation_on_read": 1.5}, r"rotation_on_read must be an integer in 1\.\.360, got 1\.5"),
        (
            {"image_dataset__noise_on_read": "0"},
            r"image_dataset\.noise_on_read must be a number in \[0, 254\], got '0'",
        ),
        (
            {"image_dataset__noise_on_read": 255},
            r"image_dataset\.noise_on_read must be a number in \[0, 254\], got 255",
        ),
        ({"image_dataset__1D": 0}, r"image_dataset\.1D must be true or false, got 0"),
        ({"image_dataset__seed": -1}, r"image seed must be in \[0, 2\*\*32\), got -1"),
        ({"image_dataset__nr_of_images": 4}, r"num_images=4 is too few for id 4"),
        ({"observations__MDP_D": "true"}, r"observations\.MDP_D must be true or false, got 'true'"),
        ({"observations__W_IDs": 2}, r"wait_ids must be \(first, last\)"),
        ({"observations__D_IDs": [1, 3]}, r"decision_ids=\(1, 3\) overlaps fail_ids=\(1, 1\)"),
        ({"observations__MDP_W": True}, r"unique_waits needs 7 wait_ids, got 1 in \(2, 2\); use \(2, 8\)"),
        ({"graph_shape__p": 1.0}, r"wait_prob must be in \[0, 1\), got 1\.0"),
        ({"graph_shape__p": -0.1}, r"wait_prob must be in \[0, 1\), got -0\.1"),
        ({"graph_shape__d": 0}, r"depth must be an integer >= 1, got 0"),
        ({"graph_shape__b": 1}, r"branching_factor must be an integer >= 2, got 1"),
        ({"reward__std_r": -0.1}, r"reward_std must be >= 0, got -0\.1"),
        (
            {"reward__reward_distribution": "gradient"},
            r"reward\.reward_distribution must be 'needle_in_haystack' or 'linear', got 'gradient'",
        ),
        (
            {"reward__reward_distribution": ["linear"]},
            r"reward\.reward_distribution must be 'needle_in_haystack' or 'linear', got \['linear'\]",
        ),
    ],
)
def test_a_value_out_of_range_is_refused(changes, message):
    content = changed(SHIPPED_2023, **changes)

    with pytest.raises(ValueError, match=message):
        Task.from_json(content, goal=(1, 1))


@pytest.mark.parametrize(("first", "end"), [(5, 5), (5, 4), (0, 5), (5, -1), (1.5, 3), (None, None), (True, 3)])
def test_numbers_of_episodes_that_leave_none_to_draw_from_are_refused(first, end):
    content = changed(SHIPPED_2023, reward__min_static_reward_episodes=first, reward__max_static_reward_episodes=end)
    message = "reward.min_static_reward_episodes must be below max_static_reward_episodes, which is exclusive"

    with pytest.raises(ValueError, match=message):
        Task.from_json(content, goal=(1, 1))


@pytest.mark.parametrize("numbers", [(0, 0), (-1, -1), (-5, 0)])
def test_numbers_of_episodes_up_to_0_leave_the_goal_as_it_is(numbers):
    first, end = numbers
    content = changed(L2D2C_2021, reward__min_static_reward_episodes=first, reward__max_static_reward_episodes=end)

    task = Task.from_json(content, goal=(1, 1))

    assert (task.goal_change, task.legacy_goal_change) == (None, False)


@pytest.mark.parametrize("changes", [{"image_dataset__noise_on_read": 1}, {"image_dataset__rotation_on_read": 2}])
def test_one_dimensional_observations_with_noise_or_rotation_are_refused(changes):
    content = changed(one_hot_file(), **changes)

    with pytest.raises(ValueError, match=r"image_dataset\.1D needs noise_on_read below 1 and rotation_on_read 1, got"):
        Task.from_json(content, goal=(1, 1))


def test_every_bad_value_is_named_in_one_message():
    content = changed(SHIPPED_2023, image_dataset__rotation_on_read=0, reward__reward_distribution="x")

    with pytest.raises(ValueError, match=r"reward_distribution must be .*rotation_on_read must be "):
        Task.from_json(content, goal=(1, 1))


# Writing


@pytest.mark.parametrize(
    "content",
    [
        *FILES.values(),
        one_hot_file(),
        changed(SHIPPED_2023, image_dataset__noise_on_read=12.5, reward__std_r=0.1, reward__fail_r=-0.1),
        changed(MOHQA_2019, reward__stochastic_sampling=True, reward__reward_distribution="linear"),
        *(trace["config"] for trace in TRACES),
    ],
)
def test_a_task_that_was_read_is_the_same_after_writing_and_reading_again(content):
    b, d = (content["graph_shape"].get(key) for key in ("b", "d"))
    goal = (b or 2,) * (d or 2)
    task = Task.from_json(content, goal=goal)

    again = Task.from_json(task.to_json(), goal=task.goal)

    assert again == task


def test_the_shipped_file_comes_out_as_it_went_in():
    task = Task.from_json(SHIPPED_2023, goal=(1, 2))

    content = task.to_json(general_seed=3)

    assert content == SHIPPED_2023
    assert list(content) == list(SHIPPED_2023)


def test_a_file_of_2019_comes_out_with_the_keys_of_2023_and_without_its_ineffective_values():
    task = Task.from_json(MOHQA_2019, goal=(1, 2))

    content = task.to_json()

    assert content == {
        "general_seed": 1,
        "graph_shape": {"d": 2, "b": 2, "p": 0.9},
        "reward": {
            "high_r": 1.0,
            "fail_r": 0.0,
            "std_r": 0.0,
            "min_static_reward_episodes": -1,
            "max_static_reward_episodes": -1,
            "reward_distribution": "needle_in_haystack",
        },
        "observations": {"MDP_D": True, "MDP_W": True, "W_IDs": [3, 67], "D_IDs": [68, 75], "graph_ends": [76, 80]},
        "image_dataset": {"seed": 1, "1D": False, "nr_of_images": 81, "noise_on_read": 0.0, "rotation_on_read": 1},
    }


def test_a_goal_that_changes_comes_out_with_an_exclusive_end():
    reward = Task.from_json(L2D2C_2021, goal=(1, 1)).to_json()["reward"]

    assert (reward["min_static_reward_episodes"], reward["max_static_reward_episodes"]) == (5000, 5001)


def test_the_written_file_holds_the_content_and_can_be_read(tmp_path):
    task, path = Task.from_json(L2D2C_2021, goal=(2, 1)), tmp_path / "graph.json"

    content = task.to_json(path, general_seed=9)

    text = path.read_text(encoding="utf-8")
    assert json.loads(text) == content
    assert text.startswith('{\n  "general_seed": 9,\n  "graph_shape": {\n    "d": 2,')
    assert Task.from_json(path, goal=(2, 1)) == task


@pytest.mark.parametrize("general_seed", [-1, 2**32, 1.0, None])
def test_a_general_seed_out_of_range_is_refused(general_seed):
    with pytest.raises(ValueError, match=r"general_seed must be in \[0, 2\*\*32\), got"):
        Task.from_json(SHIPPED_2023, goal=(1, 1)).to_json(general_seed=general_seed)


NOISY = changed(SHIPPED_2023, image_dataset__noise_on_read=2)


@pytest.mark.parametrize(
    ("content", "changes", "what"),
    [
        (SHIPPED_2023, {"images": PaperImages(40)}, "images=PaperImages(num_images=40, seed=1, size=12): use Ref"),
        (SHIPPED_2023, {"reward_fn": Gradient()}, "reward_fn=Gradient(): use Needle or ReferenceLinear"),
        (SHIPPED_2023, {"step_reward": -0.01}, "step_reward=-0.01: use 0"),
        (SHIPPED_2023, {"reward_std": 0.1, "reward_noise": "additive"}, "reward_noise='additive': use 'multipl"),
        (SHIPPED_2023, {"extra_end_step": False}, "extra_end_step=False: use True"),
        (SHIPPED_2023, {"goal_change": (2, 3)}, "legacy_goal_change=False with a goal_change: use True"),
        (SHIPPED_2023, {"home_ids": (5, 5)}, "home_ids=(5, 5): use (0, 0)"),
        (SHIPPED_2023, {"fail_ids": (5, 6)}, "fail_ids=(5, 6): use (1, 1)"),
        (L2D2C_2021, {"unique_ends": False}, "unique_ends=False: end states are unique when waits or decisions are"),
        (SHIPPED_2023, {"unique_ends": True, "end_ids": (4, 7)}, "unique_ends=True: end states are unique when"),
        (SHIPPED_2023, {"reward_cue": False}, "reward_cue=False: use True"),
        (SHIPPED_2023, {"cue_wraps": False}, "cue_wraps=False: use True"),
        (L2D2C_2021, {"legacy_index": False}, "legacy_index=False with unique ids: use True"),
        (NOISY, {"noise_before_rotation": False}, "noise_before_rotation=False with noise and rotation: use True"),
        (SHIPPED_2023, {"read_noise": 1}, "read_noise=1 with ReferenceImages(num_images=40, seed=2, noise=0.05)"),
    ],
)
def test_what_the_file_cannot_express_is_refused(content, changes, what):
    task = vary(Task.from_json(content, goal=(1, 1)), **changes)

    with pytest.raises(ValueError) as refusal:
        task.to_json()

    assert f"the file cannot express {what}" in str(refusal.value)
    assert str(refusal.value).count("the file cannot express") == 1


def vary(task, **changes):
    """A task with fields of its own or of its observations replaced."""
    shown = {name: value for name, value in changes.items() if hasattr(task.observations, name)}
    own = {name: value for name, value in changes.items() if name not in shown}
    return replace(task, observations=replace(task.observations, **shown), **own)


@pytest.mark.parametrize(
    ("content", "changes"),
    [
        (SHIPPED_2023, {"reward_noise": "additive"}),
        (SHIPPED_2023, {"legacy_index": False}),
        (SHIPPED_2023, {"noise_before_rotation": False}),
        (SHIPPED_2023, {"legacy_goal_change": True}),
    ],
)
def test_a_switch_without_effect_does_not_keep_a_task_from_being_written(content, changes):
    task = Task.from_json(content, goal=(1, 1))

    written = vary(task, **changes).to_json()

    assert written == task.to_json()


def test_everything_that_the_file_cannot_express_is_in_one_message(tmp_path):
    x = Observations(wait_ids=(2, 2), decision_ids=(3, 3), end_ids=(4, 4))
    task, path = Task(CTGraph(2, 2), (1, 1), x, OneHot(5), Needle()), tmp_path / "graph.json"

    with pytest.raises(ValueError, match=r"images=OneHot.*extra_end_step=.*reward_cue=.*cue_wraps=") as refusal:
        task.to_json(path)

    assert str(refusal.value).count("the file cannot express") == 4
    assert not path.exists()


# Recorded behaviour


@pytest.mark.parametrize("trace", TRACES, ids=[trace["name"] for trace in TRACES])
def test_a_recorded_trace_is_reproduced_exactly(trace):
    goal = tuple(entry + 1 for entry in trace["goal_path_0_based"])
    env = CTGraphEnv([Task.from_json(trace["config"], goal=goal)])

    for first, *steps in trace["episodes"]:
        data = env.reset()
        assert (env.state_type.item(), env.observation_id.item()) == (first["state"], first["id"])
        for number, step in enumerate(steps):
            data = act(env, [step["action"]], data)
            found = data["reward"].item(), data["done"].item(), env.state_type.item(), env.observation_id.item()
            assert found == (float(np.float32(step["reward"])), step["done"], step["state"], step["id"]), number


def test_images_are_rotated_on_read_as_they_were_made():
    images = ReferenceImages(40, seed=3)
    bank = images.bank(9).view(40, 10, 12, 12)

    assert torch.equal(bank[:, 0], images.images)
    for angle in (1, 5, 9):
        ours = rotate(images.images, angle)
        assert (bank[:, angle].int() - ours.int()).abs().max() <= 1  # truncated instead of rounded
        assert not torch.equal(bank[:, angle], ours)


def test_an_image_without_a_black_pixel_is_as_bright_as_its_darkest_level_outside():
    image = ReferenceImages(60, seed=5)

    turned = image.bank(5).view(60, 6, 12, 12)[27, 5]

    assert image.images[27].min() > 0
    assert turned.min() == image.images[27].min()
    assert rotate(image.images[27:28], 5).min() < turned.min()
