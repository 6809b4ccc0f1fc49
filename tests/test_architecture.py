"""The rules of the house, over the source of all packages: who may import whom, and what a name may stand for."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import is_dataclass
from importlib import import_module
from pkgutil import iter_modules

import pytest
from helpers import architecture
from helpers.architecture import modules_of_packages, modules_of_results, modules_of_tests
from helpers.paths import CHECKOUT

import ctgraph_rl
from ctgraph_rl import metrics
from ctgraph_rl.core import rewards

FLOORS = (
    ("ctgraph_rl", "checks", "metrics", "parsers"),
    ("disk", "packages"),
    ("strict",),
    ("core", "portable"),
    ("tasks",),
    ("batch", "agent", "curricula"),
    ("log",),
    ("draw",),
    ("env", "gym"),
    ("policies", "sb3"),
    ("learn",),
    ("runs", "baselines"),
    ("play", "hydra_plugins"),
    ("report",),
    ("collective", "board", "profile"),
    ("cli", "describe", "compare", "testing", "runner"),
    ("run",),
    ("benchmarks",),
)
"""Wings, lower ones first: each imports what is below, and itself; those of one floor do not import each other."""

TOP = {
    "curricula.__main__": "a command of cli.py",
    "baselines.__main__": "a command of cli.py",
    "baselines.methods.__main__": "a command of cli.py",
    "ctgraph_rl.profile.__main__": "a command that starts a sweep",
}
"""Modules that stand above all floors, and why."""

NEVER = {
    "ctgraph_rl": ("baselines", "curricula", "conf", "hydra_plugins"),
    "ctgraph_rl.core": ("torchrl", "tensordict"),
    "ctgraph_rl.metrics": ("torchrl", "tensordict"),
    "ctgraph_rl.tasks": ("torchrl", "tensordict"),
    "curricula": ("baselines", "conf", "torchrl", "tensordict"),
    "baselines": ("curricula", "conf", "hydra", "omegaconf"),
    "hydra_plugins": ("baselines", "curricula", "conf", "torch"),
}
"""What a package must never import, however low it stands."""

KNOW_HYDRA = (
    "ctgraph_rl.board.relearn",
    "ctgraph_rl.run",
    "ctgraph_rl.runner",
    "ctgraph_rl.runs.config",
    "ctgraph_rl.runs.explain",
    "ctgraph_rl.runs.job",
    "ctgraph_rl.runs.on_dask",
    "ctgraph_rl.runs.sweep",
    "hydra_plugins.ctgraph_rl_dask",
    "hydra_plugins.ctgraph_rl_sweeper",
)

DOORS = {
    "ctgraph_rl": "its names are imported when they are first used",
    "ctgraph_rl.cli": "the module of a command",
    "ctgraph_rl.log.named_curricula": "the curricula that are published",
    "ctgraph_rl.log.provenance": "the fingerprints of those",
    "ctgraph_rl.packages": "classes by the names that runs stored, and wrappers of others",
    "ctgraph_rl.profile.properties": "a table that learns a model of an agent's data",
    "ctgraph_rl.profile.scoring": "the properties of the profile's curricula",
    "ctgraph_rl.runs.session": "the batches of seeds, which know the agents",
    "ctgraph_rl.board.relearn": "learners of others, in a process of their own",
    "ctgraph_rl.log.sources": "looks for modules of the user, and imports none",
    "ctgraph_rl.metrics": "all of its own modules, so that no metric is left out",
    "ctgraph_rl.report.style": "packages of an extra",
    "ctgraph_rl.runs.trackers": "packages of an extra",
    "curricula": "its names are imported when they are first used",
}
"""Modules that import by name, and why."""

CLASSES_OF_ONE_NAME = {"Trained": "a loaded run, which ctgraph_rl exports, and blocks of tasks, which metrics export"}
"""Names of several public classes, and why."""

MODULES_OF_ONE_NAME = {
    "adaptation": "a setting of evaluations: its metrics, its figure, and named sequences that need it",
    "environments": "speed of the environments, and the tests that theirs inherit; both are said after a folder",
    "gym": "the environment that users import, and sequences of Gymnasium's tasks",
    "job": "of a run, and of a collective",
    "labels": "that learners give: in a log, as metrics, and as a figure",
    "masks": "of weights, and the sequences of the papers on them",
    "memory": "bytes of images, and sequences that need a memory",
    "style": "of figures: of reports in print, and of pictures of tasks",
}
"""Names of several modules, each said after its folder, and why."""

ANY_NUMBER = ("require", "groups", "by_name")
"""Functions whose arguments are alike, and as many as there are."""

NOT_IN_KERNEL: dict[str, str] = {}
"""Rewards of ours that the C kernel does not know, and why."""


def test_no_import_goes_up():
    assert architecture.upward(modules_of_packages(), FLOORS, TOP) == []


def test_no_module_imports_what_its_package_must_not_know():
    assert architecture.forbidden(modules_of_packages(), NEVER) == []


def test_only_the_configuration_the_entry_point_and_the_sweeper_know_hydra():
    known = {module.name for module in modules_of_packages()}

    assert architecture.users_of(modules_of_packages(), "hydra", "omegaconf") == sorted(known & {*KNOW_HYDRA})


def test_there_is_no_circle_at_run_time():
    assert architecture.circles_at_run_time(modules_of_packages()) == []
    assert architecture.circles_at_run_time(modules_of_results()) == []


def test_circles_of_annotations_stay_within_a_wing():
    assert architecture.circles_between_wings(modules_of_packages()) == []


def test_our_packages_are_imported_by_name_in_one_module_alone():
    assert architecture.imported_by_name(modules_of_packages(), DOORS) == []


def test_keywords_stand_at_the_call_and_not_in_a_dict_made_for_it():
    assert architecture.starred_dicts([*modules_of_packages(), *modules_of_results()]) == []


def test_a_public_class_name_exists_once():
    assert set(architecture.classes_defined_twice(modules_of_packages())) == set(CLASSES_OF_ONE_NAME)


def test_a_module_name_exists_once():
    assert set(architecture.modules_of_one_name(modules_of_packages())) == set(MODULES_OF_ONE_NAME)


def test_a_call_has_at_most_five_positional_arguments():
    assert architecture.long_calls([*modules_of_packages(), *modules_of_results()], 5, ANY_NUMBER) == []


def test_no_private_name_is_used_by_another_module():
    assert architecture.private_names([*modules_of_packages(), *modules_of_results()]) == []


def test_our_own_imports_inside_functions_are_few_and_say_why():
    found = architecture.imports_in_functions(modules_of_packages())

    assert len(found) <= 10
    assert sorted({name for name, one in found if not one.reasoned}) == []


def test_every_folder_says_in_two_or_three_sentences_what_belongs_there():
    assert architecture.unexplained_folders([*modules_of_packages(), *modules_of_results()]) == []


def test_no_test_imports_a_test():
    assert architecture.tests_that_import_tests(modules_of_tests()) == []


def test_every_defined_metric_is_among_the_definitions():
    modules = [import_module(f"{metrics.__name__}.{found.name}") for found in iter_modules(metrics.__path__)]
    defined = {name for module in modules for name, item in vars(module).items() if hasattr(item, "definition")}

    assert defined == set(metrics.definitions())


def test_the_kernel_knows_every_reward_of_ours():
    ours = [item for item in vars(rewards).values() if is_dataclass(item) and item.__module__ == rewards.__name__]

    assert {kind.__name__ for kind in set(ours) - set(rewards.KERNEL_REWARDS)} == set(NOT_IN_KERNEL)


@pytest.mark.parametrize(
    "statements",
    [
        {
            "import ctgraph_rl": ["torch", "torchrl", "tensordict", "hydra", "numpy"],
            "import ctgraph_rl.run": ["torch", "torchrl"],
            "import hydra_plugins.ctgraph_rl_sweeper": ["torch", "torchrl"],
        },
        pytest.param(
            {"import baselines.dqn, baselines.lstm_ppo": ["hydra", "omegaconf", "curricula"]}, marks=pytest.mark.slow
        ),
    ],
    ids=["without torch", "with torch"],
)
def test_an_import_does_not_load_what_costs_seconds(statements, tmp_path):
    """Statements of one case run one after the other in one process; tests/curricula has that of the curricula."""
    code = "import sys\n" + "".join(
        f"{statement}\nprint([name for name in {packages} if name in sys.modules])\n"
        for statement, packages in statements.items()
    )
    env = {**os.environ, "PYTHONPATH": str(CHECKOUT)}

    result = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=env, capture_output=True, text=True)

    assert (result.stderr, result.stdout) == ("", "[]\n" * len(statements))


def test_every_public_name_resolves():
    values = {name: getattr(ctgraph_rl, name) for name in ctgraph_rl.__all__}

    assert all(value is not None for value in values.values())
    assert set(ctgraph_rl.__all__) <= set(dir(ctgraph_rl))
    named = {name for name, value in values.items() if hasattr(value, "__name__") and name != "metrics"}
    assert all(values[name].__name__ == name for name in named)


def test_an_unknown_public_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'ctgraph_rl' has no attribute 'CTGraf'"):
        _ = ctgraph_rl.CTGraf
