"""Configuration files of the authors' implementation, as they are read."""

import json

import pytest
from helpers.reference_files import DELETED, FILES, L2D2C_2021, MOHQA_2019, SHIPPED_2023, changed, one_hot_file

from ctgraph_rl import (
    CTGraph,
    Observations,
    ReferenceImages,
    ReferenceLinear,
    ReferenceOneHot,
    Task,
)

every_file = pytest.mark.parametrize("year", list(FILES))


def shown_as_there(**ids_and_flags):
    """Observations with the switches that every file of the authors' implementation stands for."""
    return Observations(**ids_and_flags, reward_cue=True, cue_wraps=True, legacy_index=True, noise_before_rotation=True)


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
    with pytest.raises(ValueError, match=r"goal must be 2 decisions in 1\.\.2, such as 1\.1, got \(0, 1\)"):
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
    with pytest.raises(ValueError, match=r"missing\.json cannot be opened: no such file or directory; check the path"):
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
