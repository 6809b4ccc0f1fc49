"""Configuration files for the authors' implementation, as they are written."""

import json
from dataclasses import replace

import pytest
from helpers.reference_files import FILES, L2D2C_2021, MOHQA_2019, SHIPPED_2023, TRACES, changed, one_hot_file

from ctgraph_rl import (
    CTGraph,
    Gradient,
    Needle,
    Observations,
    OneHot,
    PaperImages,
    Task,
)


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


@pytest.mark.parametrize("general_seed", [-1, 2**32, 1.5, None])
def test_a_general_seed_out_of_range_is_refused(general_seed):
    with pytest.raises(ValueError, match=r"general_seed must be in \[0, 2\*\*32\), got"):
        Task.from_json(SHIPPED_2023, goal=(1, 1)).to_json(general_seed=general_seed)


NOISY = changed(SHIPPED_2023, image_dataset__noise_on_read=2)


@pytest.mark.parametrize(
    ("content", "changes", "what"),
    [
        (SHIPPED_2023, {"images": PaperImages(40)}, "images=PaperImages(num_images=40, seed=1, size=12): use Ref"),
        (SHIPPED_2023, {"reward_fn": Gradient()}, "reward_fn=Gradient(): use Needle()"),
        (SHIPPED_2023, {"step_reward": -0.01}, "step_reward=-0.01: use 0"),
        (SHIPPED_2023, {"reward_std": 0.1, "reward_noise": "additive"}, "reward_noise='additive': use 'multipl"),
        (SHIPPED_2023, {"extra_end_step": False}, "extra_end_step=False: use True"),
        (SHIPPED_2023, {"goal_change": (2, 3)}, "legacy_goal_change=False: use True"),
        (SHIPPED_2023, {"home_ids": (5, 5)}, "home_ids=(5, 5): use (0, 0)"),
        (SHIPPED_2023, {"fail_ids": (5, 6)}, "fail_ids=(5, 6): use (1, 1)"),
        (L2D2C_2021, {"unique_ends": False}, "unique_ends=False: use True"),
        (SHIPPED_2023, {"unique_ends": True, "end_ids": (4, 7)}, "unique_ends=True: use False"),
        (SHIPPED_2023, {"reward_cue": False}, "reward_cue=False: use True"),
        (SHIPPED_2023, {"cue_wraps": False}, "cue_wraps=False: use True"),
        (L2D2C_2021, {"legacy_index": False}, "legacy_index=False: use True"),
        (NOISY, {"noise_before_rotation": False}, "noise_before_rotation=False: use True"),
        (SHIPPED_2023, {"read_noise": 1}, "read_noise=1: use 0"),
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
