"""The parameters of the paper's Table 3 as settings of ``curriculum=axes``, and the page that maps them."""

from __future__ import annotations

import re

import hydra
import pytest
import yaml
from helpers.paths import CHECKOUT

import curricula
from ctgraph_rl import Task
from ctgraph_rl.core.graph import CTGraph
from ctgraph_rl.core.rewards import Gradient
from ctgraph_rl.tasks.configurations import CONFIGURATIONS
from ctgraph_rl.tasks.images import OneHot, PaperImages
from ctgraph_rl.tasks.paper_json import SECTIONS

PAGE = (CHECKOUT / "docs" / "reference" / "table_3.md").read_text(encoding="utf-8")
SETTINGS = yaml.safe_load((CHECKOUT / "conf" / "curriculum" / "axes.yaml").read_text(encoding="utf-8"))


def settings_of_the_page() -> dict[tuple[str, str], str]:
    """Section and key of Table 3, and the setting that the page names for it."""
    rows = re.findall(r"^\| (\w*) ?\| (\w+) \| `(?:curriculum\.)?(\w+)` \| .* \|$", PAGE, flags=re.M)
    return {(section, key): setting for section, key, setting in rows}


def settings_of_configurations() -> dict[str, list[str]]:
    """The settings that the page names for each configuration."""
    rows = re.findall(r"^\| ([^|]+) \| `(curriculum\.[^`]+=[^`]+ [^`]+)` \|$", PAGE, flags=re.M)
    return {name: settings.split() for name, settings in rows}


CONFIGURED = settings_of_configurations()


def from_table(content: dict[str, dict[str, object]]) -> Task:
    """The first task of the axes with the settings that the page names for a file's parameters."""
    page = settings_of_the_page()
    arguments = {page[section, key]: value for section, keys in content.items() for key, value in keys.items()}
    return curricula.from_axes("su_b1", goals=[(1,) * arguments["depth"]], **arguments).tasks[0]


def test_the_page_has_every_parameter_of_the_table_and_names_settings_that_exist():
    page = settings_of_the_page()

    keys = {(section, key) for section, names in SECTIONS.items() for key in names}
    assert page.keys() == keys | {("", "Seed")}
    assert set(page.values()) - {"seed"} <= SETTINGS.keys()
    assert set(re.findall(r"`curriculum\.(\w+)", PAGE)) <= SETTINGS.keys()


@pytest.mark.parametrize(
    "content",
    [
        {"graph_shape": {"d": 3, "b": 3, "p": 0.5}, "observations": {"MDP_D": True, "MDP_W": True}},
        {"graph_shape": {"d": 2, "b": 2}, "reward": {"high_r": 2, "fail_r": -1, "std_r": 0.1}},
        {"graph_shape": {"d": 2, "b": 2}, "observations": {"MDP_D": True}, "image_set": {"seed": 3, "nr_images": 40}},
        {"graph_shape": {"d": 2, "b": 2}, "observations": {"MDP_W": True, "D_IDs": [4, 5]}},
        {"graph_shape": {"d": 2, "b": 2}, "observations": {"W_IDs": [5, 9], "D_IDs": [10, 12]}},
        {"graph_shape": {"d": 1, "b": 2}, "image_set": {"1D": True}},
        {"graph_shape": {"d": 2, "b": 2}, "image_set": {"noise_on_read": 9, "rotation_on_read": 5}},
    ],
)
def test_settings_make_the_task_of_a_file_with_the_same_parameters(content):
    goal = (1,) * content["graph_shape"]["d"]

    assert from_table(content) == Task.from_json(content, goal)


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_the_settings_of_a_configuration_make_its_task(compose, name):
    task = hydra.utils.instantiate(compose("curriculum=axes", *CONFIGURED[name]).curriculum).tasks[0]

    assert task == CONFIGURATIONS[name](goal=task.goal)


def test_the_other_settings_of_the_page_make_the_graphs_of_the_text(compose):
    others = [settings for name, settings in CONFIGURED.items() if name not in CONFIGURATIONS]

    made = [hydra.utils.instantiate(compose("curriculum=axes", *settings).curriculum).tasks[0] for settings in others]

    stochastic, masks, large = made
    assert (stochastic.observations.decision_ids, stochastic.observations.wait_ids) == ((2, 11), (12, 111))
    assert (masks.graph, masks.observations.wait_ids, masks.observations.decision_ids) == (
        CTGraph(2, 5),
        (2, 2),
        (3, 33),
    )
    assert (large.graph, large.reward_fn) == (CTGraph(3, 10, 0.9), Gradient())


def test_wait_states_that_draw_keep_their_ids_where_only_decisions_change():
    task = curricula.from_axes("co_b1", unique_decisions=True).tasks[0]

    x = task.observations
    assert (x.wait_ids, x.decision_ids, x.end_ids) == ((3, 102), (103, 105), (106, 109))
    assert task.images == PaperImages(110)


def test_rewards_and_sizes_of_images_are_those_of_every_task_of_random_graphs():
    drawn = {"random_graphs": 3, "depth": [1, 2], "reward_fn": "gradient", "step_reward": 0.25, "image_size": 16}

    tasks = curricula.from_axes("fo_b1", **drawn).tasks

    assert {(task.reward_fn, task.step_reward) for task in tasks} == {(Gradient(), 0.25)}
    assert {task.observation_shape for task in tasks} == {(1, 16, 16)}


def test_vectors_of_several_depths_have_one_length():
    assert {task.images for task in curricula.from_axes("fo_b1", depth=[1, 2], one_hot=True).tasks} == {OneHot(16)}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"reward_fn": "linear"}, "reward_fn must be one of needle, gradient, reference_linear, got 'linear'"),
        ({"one_hot": True, "image_seeds": [1, 2]}, "one_hot has no image_seeds and no image_size: leave them out"),
        ({"one_hot": True, "read_noise": 1}, "read_noise, read_rotation and reward_cue need images, not one-hot"),
        ({"image_size": 10}, "image_size must be a multiple of 4, got 10"),
        ({"num_images": 4}, "num_images=4 is too few for id 4 in observations: needs at least 5"),
        ({"wait_ids": [1, 3]}, r"wait_ids=\(1, 3\) overlaps|overlaps wait_ids=\(1, 3\)"),
        ({"wait_ids": [3]}, r"wait_ids must be \(first, last\)"),
        ({"unique_waits": True, "wait_ids": [2, 3]}, r"unique_waits needs 7 wait_ids, got 2 in \(2, 3\); use \(2, 8\)"),
        ({"reward_std": -1}, "reward_std"),
    ],
)
def test_settings_that_make_no_task_are_refused_with_the_rule(arguments, message):
    with pytest.raises(ValueError, match=message):
        curricula.from_axes(**arguments)
