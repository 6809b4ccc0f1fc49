"""The named curricula: the table of fingerprints, loading by name, yaml, and the ways of the paper."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise, product
from pathlib import Path

import hydra
import pytest
from helpers.conf_files import UNNAMED, conf_file
from omegaconf import OmegaConf

import curricula
from ctgraph_rl import CTGraph, Gradient, Needle
from ctgraph_rl.packages import conf_dir
from ctgraph_rl.tasks.configurations import ct_co_b1, ct_fo_b1, ct_fo_b2, ct_posr_b1, ct_su_b1
from ctgraph_rl.tasks.images import PaperImages
from ctgraph_rl.tasks.protocol import Evaluation, Protocol
from curricula.gym import NEEDS
from curricula.paper import KINDS, configured

NAMES, FOLDER = curricula.names(), Path(conf_dir(), "curriculum")
TABLE = json.loads(Path(curricula.__file__).with_name("fingerprints.json").read_text(encoding="utf-8"))
"""A curriculum whose fingerprint changes gets a new version, and its line in the file is changed with it."""

BY_CONFIGURATION = pytest.mark.parametrize("configuration", KINDS)


def test_no_curriculum_has_changed_without_a_new_version_and_all_are_in_the_table():
    def facts(c):
        sizes = {"tasks": len(c.tasks), "frames": c.num_frames}
        return {"version": c.version, "fingerprint": c.fingerprint, **sizes, "source": c.source}

    found = {name: facts(curricula.load(name)) for name in NAMES}

    assert found == TABLE


def test_no_fingerprint_of_a_named_curriculum_reads_as_a_number():
    for name, line in TABLE.items():
        with pytest.raises(ValueError):
            float(line["fingerprint"])
            raise AssertionError(f"{name}: {line['fingerprint']}")


def test_the_oldest_fingerprint_is_what_it_was_when_published():
    oldest = TABLE["su_b1_4tasks"]

    assert (oldest["version"], oldest["fingerprint"]) == (1, "a78b6121f1224f71")


def test_no_two_names_are_the_same_curriculum():
    fingerprints = [entry["fingerprint"] for entry in TABLE.values()]

    assert len(set(fingerprints)) == len(fingerprints) == len(NAMES)


ELSEWHERE = """
import sys, curricula
print([name for name in sys.modules if name.startswith(("curricula.", "torch"))])
print(*(curricula.load(name).fingerprint for name in ("su_b1_4tasks", "ct29_recovery")))
print([name for name in ("torchrl", "tensordict", "hydra") if name in sys.modules])
"""


@pytest.fixture(scope="module")
def elsewhere(checkout) -> list[str]:
    """What another process prints, which imports the package, and then has fingerprints of two curricula."""
    env = {**os.environ, "PYTHONHASHSEED": "123", "PYTHONPATH": str(checkout)}
    result = subprocess.run([sys.executable, "-c", ELSEWHERE], env=env, capture_output=True, text=True, check=True)
    return result.stdout.splitlines()


def test_importing_the_package_loads_none_of_its_curricula(elsewhere):
    assert elsewhere[0] == "[]"


def test_a_fingerprint_is_the_same_in_another_process(elsewhere):
    assert elsewhere[1].split() == [TABLE[name]["fingerprint"] for name in ("su_b1_4tasks", "ct29_recovery")]


def test_a_fingerprint_needs_nothing_that_takes_seconds_to_import(elsewhere):
    assert elsewhere[2] == "[]"


def test_a_yaml_builds_the_curriculum_of_its_name():
    for name in NAMES:
        built = hydra.utils.instantiate(OmegaConf.load(FOLDER / f"{name}.yaml"))

        assert built == curricula.load(name), name
        assert built.name == name
        assert built.source, name


def test_every_yaml_is_a_named_curriculum_or_one_of_settings():
    files = {path.stem for path in FOLDER.glob("*.yaml")}

    assert files == {*NAMES, *NEEDS, *UNNAMED}


@pytest.mark.parametrize("name", [*NAMES, *UNNAMED])
def test_a_yaml_is_written_from_the_signature_and_the_docstring_of_its_function(name):
    written = (FOLDER / f"{name}.yaml").read_text(encoding="utf-8")

    assert written == conf_file(name), "run python -m tests.helpers.conf_files"


def test_every_name_has_a_sentence_about_it():
    assert [name for name in NAMES if not curricula.summary(name).endswith((".", "?"))] == []


def test_every_budget_can_be_made_short():
    for name in NAMES:
        short = curricula.load(name, num_frames=512)

        assert max(block.num_frames for block in short.blocks) == 512, name
        assert [*short.tasks] == [*curricula.load(name).tasks], name


def test_a_budget_of_no_frames_is_refused():
    def refusal(name: str) -> str:
        with pytest.raises(ValueError) as refused:
            curricula.load(name, num_frames=0)
        return str(refused.value)

    refusals = {name: refusal(name) for name in NAMES}

    assert {name for name in NAMES if "num_frames must be an integer >= 1, got 0" not in refusals[name]} == set()


def test_an_unknown_curriculum_is_refused_with_what_may_be_meant_or_where_all_are_listed():
    with pytest.raises(ValueError, match=r"unknown curriculum 'su_b1_4task'.*did you mean 'su_b1_4tasks'"):
        curricula.load("su_b1_4task")
    with pytest.raises(ValueError, match=r"unknown curriculum 'xyz'; ctgraph-rl curricula lists all"):
        curricula.load("xyz")
    with pytest.raises(ValueError, match=r"unknown curriculum 'axes'; it is made from settings: curricula.from_axes"):
        curricula.load("axes", goals=["1.2"])
    with pytest.raises(ValueError, match="unknown curriculum 'xyz'"):
        curricula.summary("xyz")


def test_an_unknown_argument_is_refused_with_the_choices():
    with pytest.raises(ValueError, match=r"su_b1_4tasks has no seed. Choices: num_frames, image_seed"):
        curricula.load("su_b1_4tasks", seed=3)


def test_an_unknown_attribute_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'curricula' has no attribute 'ct9'"):
        _ = curricula.ct9
    assert {"ct8", "load", "from_axes"} <= set(dir(curricula))


def test_a_loaded_curriculum_takes_arguments():
    loaded = curricula.load("su_b1_4tasks", num_frames=64, image_seed=7)

    assert loaded.num_frames == 256
    assert {task.image_seed for task in loaded.tasks} == {7}


@pytest.mark.parametrize(
    ("name", "task"),
    [
        ("fo_b1_4tasks", ct_fo_b1()),
        ("fo_b2_8tasks", ct_fo_b2()),
        ("su_b1_4tasks", ct_su_b1()),
        ("co_b1_4tasks", ct_co_b1()),
        ("posr_b1_4tasks", ct_posr_b1()),
    ],
)
def test_goal_location_goes_through_all_goals_of_a_configuration_in_order(name, task):
    curriculum = curricula.load(name)

    depth, goals = task.graph.depth, [task.goal for task in curriculum.tasks]
    assert goals == sorted(goals)
    assert len(goals) == 2**depth
    assert {replace(other, goal=task.goal) for other in curriculum.tasks} == {task}
    assert (curriculum.num_frames, curriculum.version) == (204_800 * 2**depth, 2 if name == "posr_b1_4tasks" else 1)
    assert (curriculum.protocol, curriculum.evaluation) == (Protocol(), Evaluation())


@BY_CONFIGURATION
def test_depth_grows_with_nested_goals_and_the_images_of_the_deepest_graph(configuration):
    tasks = curricula.load(f"{configuration}_depth2to5").tasks

    assert [task.graph.depth for task in tasks] == [2, 3, 4, 5]
    assert [task.goal for task in tasks] == [(1, 2), (1, 2, 1), (1, 2, 1, 2), (1, 2, 1, 2, 2)]
    assert len({(task.observations, task.images, task.graph.wait_prob, task.reward_std) for task in tasks}) == 1
    assert tasks[0].observations.unique_decisions == configuration.startswith("fo")
    assert tasks[0].graph.wait_prob == configured(configuration).graph.wait_prob


def test_the_deepest_fully_observable_graph_has_an_image_for_each_state():
    tasks = curricula.load("fo_b1_depth2to5").tasks

    x = tasks[0].observations
    assert (x.wait_ids, x.decision_ids, x.end_ids) == ((2, 64), (65, 95), (96, 127))
    assert tasks[0].images == PaperImages(128)


@BY_CONFIGURATION
def test_input_variation_changes_nothing_but_the_images(configuration):
    tasks = curricula.load(f"{configuration}_4images", image_seed=5).tasks

    assert [task.image_seed for task in tasks] == [5, 6, 7, 8]
    assert len({replace(task, images=tasks[0].images) for task in tasks}) == 1


@BY_CONFIGURATION
@pytest.mark.parametrize("way", ["4images", "new_decisions", "new_waits"])
def test_one_goal_needs_memory_where_all_decision_states_look_alike(configuration, way):
    curriculum = curricula.load(f"{configuration}_{way}")
    ceilings = {task.memoryless_ceiling(deterministic=True) for task in curriculum.tasks}

    assert (ceilings, curriculum.version) == (({1.0}, 1) if configuration.startswith("fo") else ({0.0}, 2))


@BY_CONFIGURATION
def test_instances_are_the_goals_of_a_configuration_with_noise_and_rotation_on_read(configuration):
    number = 8 if configuration == "fo_b2" else 4
    tasks, constant = (curricula.load(f"{configuration}_{way}").tasks for way in ("instances", f"{number}tasks"))

    assert {(task.observations.read_noise, task.observations.read_rotation) for task in tasks} == {(10, 5)}
    still = [replace(task, observations=replace(task.observations, read_noise=0, read_rotation=0)) for task in tasks]
    assert tuple(still) == constant
    [other, *_] = curricula.load(f"{configuration}_instances", read_noise=3, read_rotation=0).tasks
    assert (other.observations.read_noise, other.observations.read_rotation) == (3, 0)


@BY_CONFIGURATION
def test_dissimilar_tasks_share_neither_shape_nor_goal_nor_images(configuration):
    tasks = curricula.load(f"{configuration}_dissimilar").tasks

    assert [(task.graph.branching_factor, task.graph.depth) for task in tasks] == [(2, 2), (3, 2), (2, 3), (3, 3)]
    assert [task.goal for task in tasks] == [(1, 2), (3, 1), (2, 1, 2), (2, 3, 1)]
    assert [task.image_seed for task in tasks] == [1, 2, 3, 4]
    assert {task.graph.wait_prob for task in tasks} == {configured(configuration).graph.wait_prob}
    assert {task.observations.unique_decisions for task in tasks} == {configuration.startswith("fo")}


def test_similar_goals_share_their_first_decisions():
    shallow, deep = (curricula.load(name).tasks for name in ("su_b1_similar_goals", "su_b1_d4_similar_goals"))

    assert [task.goal for task in shallow] == [(1, 1), (1, 2)]
    assert [task.goal for task in deep] == [(1, 2, 1, 1), (1, 2, 1, 2), (1, 2, 2, 1), (1, 2, 2, 2)]
    assert {replace(task, goal=(1, 1)) for task in shallow} == {ct_su_b1()}


def test_random_graphs_differ_in_shape_and_share_what_images_mean():
    tasks = curricula.load("random_graphs").tasks

    shapes = {(task.graph.branching_factor, task.graph.depth, task.graph.wait_prob) for task in tasks}
    assert len(tasks) == len(set(tasks)) == 100
    assert shapes == set(product((2, 3), (2, 3, 4), (0.0, 0.5)))
    assert len({(task.images, task.observations) for task in tasks}) == 1


def test_held_out_graphs_come_alone_after_all_others():
    whole = curricula.load("random_graphs", num_frames=100, num_tasks=5)
    split = curricula.load("random_graphs", num_frames=100, num_tasks=5, held_out=2)

    assert [set(block.tasks) for block in split.blocks] == [set(whole.tasks[:3]), {whole.tasks[3]}, {whole.tasks[4]}]
    assert [block.num_frames for block in split.blocks] == [300, 100, 100]
    with pytest.raises(ValueError, match="held_out must be an integer from 0 to 4, got 5"):
        curricula.load("random_graphs", num_tasks=5, held_out=5)


@BY_CONFIGURATION
def test_uncorrelated_tasks_share_neither_goal_nor_images(configuration):
    tasks = curricula.load(f"{configuration}_uncorrelated").tasks

    assert [task.image_seed for task in tasks] == [1, 2, 3, 4]
    assert len({task.goal for task in tasks}) == 4
    assert len({(task.graph, task.observations) for task in tasks}) == 1


def test_the_goals_of_uncorrelated_tasks_are_what_the_seed_drew_when_published():
    goals = [task.goal for task in curricula.load("fo_b2_uncorrelated").tasks]

    assert goals == [(1, 2, 2), (1, 1, 1), (2, 2, 1), (1, 2, 1)]


@BY_CONFIGURATION
@pytest.mark.parametrize(("way", "moved"), [("new_decisions", "decision_ids"), ("new_waits", "wait_ids")])
def test_variant_features_are_never_seen_before_and_invariant_ones_stay(configuration, way, moved):
    tasks = curricula.load(f"{configuration}_{way}").tasks

    shown = [getattr(task.observations, moved) for task in tasks]
    own = getattr(configured(configuration).observations, moved)
    assert shown[0] == own
    assert shown == sorted(shown)
    assert all(earlier[1] < later[0] for earlier, later in pairwise(shown))
    assert len({(task.images, replace(task.observations, **{moved: shown[3]})) for task in tasks}) == 1


def test_fo_b2_gradient_pays_by_the_distance_from_the_goal():
    tasks = curricula.load("fo_b2_gradient").tasks

    assert {task.reward_fn for task in tasks} == {Gradient()}
    assert {replace(task, reward_fn=Needle()) for task in tasks} == set(curricula.load("fo_b2_8tasks").tasks)


def test_fo_b1_noisy_has_a_noise_that_can_be_set():
    tasks = curricula.load("fo_b1_noisy").tasks

    assert {task.reward_std for task in tasks} == {0.5}
    assert {task.reward_std for task in curricula.load("fo_b1_noisy", reward_std=0.25).tasks} == {0.25}
    assert {replace(task, reward_std=0) for task in tasks} == set(curricula.load("fo_b1_4tasks").tasks)


def test_stochastic_rewards_are_normal_around_the_gradient_reward():
    tasks = curricula.load("fo_b1_stochastic_rewards").tasks

    assert {(task.reward_fn, task.reward_std, task.reward_noise) for task in tasks} == {(Gradient(), 0.1, "additive")}
    constant = {replace(task, reward_fn=Needle(), reward_std=0) for task in tasks}
    assert constant == set(curricula.load("fo_b1_4tasks").tasks)


def test_all_states_of_the_stochastic_graph_draw_from_groups_of_images():
    tasks = curricula.load("stochastic_grouped").tasks

    x, images = tasks[0].observations, tasks[0].images
    assert (x.home_ids, x.fail_ids, x.decision_ids) == ((0, 9), (10, 19), (20, 29))
    assert (x.wait_ids, x.end_ids) == ((30, 39), (40, 49))
    assert (images.groups, images.within, images.between) == ((10,) * 5, 0.1, 0.3)
    assert [task.goal for task in tasks] == [(1, 1), (1, 2), (2, 1), (2, 2)]


def test_co_hard_has_500_wait_images_and_waits_nine_times_in_ten():
    tasks = curricula.load("co_hard_4tasks").tasks

    x = tasks[0].observations
    assert {task.graph for task in tasks} == {CTGraph(2, 2, 0.9)}
    assert (x.decision_ids, x.wait_ids, x.end_ids) == ((2, 2), (3, 502), (503, 503))
    assert tasks[0].images == PaperImages(504)
    assert tasks[0].graph.expected_episode_length == pytest.approx(33)


def test_an_unknown_configuration_is_refused_with_the_choices():
    with pytest.raises(ValueError, match="unknown configuration 'b1': choices: fo_b1, fo_b2, su_b1, co_b1, posr_b1"):
        curricula.from_axes("b1")
