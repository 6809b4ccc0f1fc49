"""That the rules of the house can be broken: each finds what breaks it in made-up sources, and nothing else."""

from __future__ import annotations

import pytest
from helpers import architecture
from helpers.architecture import Import, read

FLOORS = (("core",), ("tasks",), ("env", "log"), ("run",))
ROOT = {"ctgraph_rl.__init__": ""}


def modules(**sources: str) -> list[architecture.Module]:
    """Modules of ``ctgraph_rl``, whose names have ``__`` for a dot, and its empty root."""
    return read(ROOT | {f"ctgraph_rl.{name.replace('__', '.')}": text for name, text in sources.items()})


def imports(text: str, **others: str) -> tuple[Import, ...]:
    return modules(here=text, **others)[1].imports


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("import torch.nn as nn", Import("torch.nn")),
        ("from torch import nn", Import("torch", "nn")),
        ("from ctgraph_rl.core import graph", Import("ctgraph_rl.core.graph")),
        ("from ctgraph_rl.core.graph import CTGraph", Import("ctgraph_rl.core.graph", "CTGraph")),
        ("def f():\n    import torch", Import("torch", in_function=True)),
        ("async def f():\n    import torch  # slow", Import("torch", in_function=True, reasoned=True)),
        ("def f():\n    from torch import (\n        nn,\n    )  # slow", Import("torch", "nn", True, False, True)),
        ("class A:\n    def f(self):\n        if True:\n            import torch", Import("torch", in_function=True)),
        ("if TYPE_CHECKING:\n    import torch", Import("torch", typing=True)),
        ("if typing.TYPE_CHECKING:\n    pass\nelse:\n    import torch", Import("torch")),
    ],
)
def test_an_import_is_read_with_where_it_stands(text, expected):
    assert imports(text, core__graph="CTGraph = 1") == (expected,)


def test_a_name_that_a_folder_exports_lazily_is_imported_from_where_it_is():
    root = "if TYPE_CHECKING:\n    from ctgraph_rl.core.graph import CTGraph as CTGraph"
    user = "from ctgraph_rl import CTGraph, __version__"

    found = read({"ctgraph_rl.__init__": root, "ctgraph_rl.core.graph": "", "curricula.mine": user})

    assert [one.full for one in found[2].imports] == ["ctgraph_rl.core.graph.CTGraph", "ctgraph_rl.__version__"]


def test_a_relative_import_is_refused():
    with pytest.raises(AssertionError, match=r"relative import: from \. import graph"):
        imports("from . import graph")


@pytest.mark.parametrize(
    "text",
    [
        "from ctgraph_rl.log.tables import write",
        "import ctgraph_rl.log.tables",
        "def f():\n    from ctgraph_rl.log import tables",
        "if TYPE_CHECKING:\n    from ctgraph_rl.log import tables",
    ],
)
def test_an_import_that_goes_up_is_found_wherever_it_stands(text):
    found = modules(tasks__task=text, log__tables="from ctgraph_rl.tasks.task import Task")

    assert architecture.upward(found[1:], FLOORS, {}) == ["ctgraph_rl.tasks.task -> ctgraph_rl.log.tables"]


def test_wings_of_one_floor_do_not_import_each_other_and_none_is_left_out():
    found = modules(
        env="import ctgraph_rl.log.tables", log__tables="import ctgraph_rl.log.files", log__files="", new=""
    )

    assert architecture.upward(found[1:], FLOORS, {}) == [
        "ctgraph_rl.env -> ctgraph_rl.log.tables",
        "ctgraph_rl.new is on no floor",
    ]


def test_a_module_at_the_top_imports_all_and_nobody_imports_it():
    found = modules(log__page="import ctgraph_rl.run", log__files="import ctgraph_rl.log.page", run="")

    top = {"ctgraph_rl.log.page": "a command"}
    assert architecture.upward(found[1:], FLOORS, top) == ["ctgraph_rl.log.files -> ctgraph_rl.log.page"]


def test_what_a_package_must_not_know_is_found_but_for_annotations():
    found = modules(core__a="import torch\nimport torchrl.data", core__b="if TYPE_CHECKING:\n    import torchrl")

    assert architecture.forbidden(found, {"ctgraph_rl.core": ("torchrl", "tor")}) == [
        "ctgraph_rl.core.a -> torchrl.data"
    ]
    assert architecture.users_of(found, "torchrl") == ["ctgraph_rl.core.a", "ctgraph_rl.core.b"]


def test_a_circle_is_found_also_through_functions_and_names_all_of_it():
    a, b, c = (f"from ctgraph_rl.core import {name}" for name in "bca")
    found = modules(core__a=a, core__b=b, core__c=f"def f():\n    {c}", core__d=a)

    assert architecture.circles_at_run_time(found) == ["ctgraph_rl.core.a <-> ctgraph_rl.core.b <-> ctgraph_rl.core.c"]


@pytest.mark.parametrize("name", ['"ctgraph_rl.core.a"', 'f"ctgraph_rl.core.{name}"'])
def test_a_circle_through_an_import_by_name_is_found(name):
    found = modules(core__a="from ctgraph_rl.log import b", log__b=f"def f():\n    import_module({name})")

    assert architecture.circles_at_run_time(found) == ["ctgraph_rl.core.a <-> ctgraph_rl.log.b"]


def test_a_circle_of_annotations_counts_only_between_wings():
    typing = "if TYPE_CHECKING:\n    from ctgraph_rl"
    within = modules(core__a=f"{typing}.core import b", core__b="from ctgraph_rl.core import a")
    between = modules(core__a=f"{typing}.tasks import b", tasks__b="from ctgraph_rl.core import a")

    assert [architecture.circles_at_run_time(found) for found in (within, between)] == [[], []]
    assert architecture.circles_between_wings(within) == []
    assert architecture.circles_between_wings(between) == ["ctgraph_rl.core.a <-> ctgraph_rl.tasks.b"]


def test_our_packages_by_name_and_names_that_are_not_written_down_are_found():
    text = """
find_spec("torch")
import_module("curricula")
importlib.import_module(f"baselines.{name}")
importlib.util.find_spec(name)
"""
    found = modules(here=text, door=text)

    assert architecture.imported_by_name(found, ["ctgraph_rl.door"]) == [
        "ctgraph_rl.here: ?",
        "ctgraph_rl.here: baselines.",
        "ctgraph_rl.here: curricula",
    ]


def test_a_call_with_too_many_positional_arguments_is_found():
    found = modules(here="f(1, 2, 3)\ng.h(1, 2, *rest)\nf(1, 2, c=3)\nrequire(1, 2, 3)")

    assert architecture.long_calls(found, 2, ["require"]) == ["ctgraph_rl.here: f", "ctgraph_rl.here: g.h"]


def test_a_private_name_of_another_module_is_found():
    text = """
from ctgraph_rl.core import graph, tree as trees
from ctgraph_rl.core.graph import _first, __version__
from torch import _C
import ctgraph_rl.core.tree
graph._second, trees._third, ctgraph_rl.core.tree._fourth, self._mine, graph.__doc__
"""
    found = modules(here=text, core__graph="_own = 1", core__tree="")

    assert architecture.private_names(found) == [
        "ctgraph_rl.here: ctgraph_rl.core.graph._first",
        "ctgraph_rl.here: ctgraph_rl.core.graph._second",
        "ctgraph_rl.here: ctgraph_rl.core.tree._fourth",
        "ctgraph_rl.here: ctgraph_rl.core.tree._third",
    ]


def test_our_imports_inside_functions_are_found():
    found = modules(a="def f():\n    import torch\n    import ctgraph_rl.b  # slow", b="import ctgraph_rl.a")

    assert architecture.imports_in_functions(found) == [
        ("ctgraph_rl.a", Import("ctgraph_rl.b", in_function=True, reasoned=True))
    ]


@pytest.mark.parametrize(
    ("lines", "is_found"),
    [
        (["how = {'a': 1}", "g(**how)"], True),
        (["how: dict = {'a': 1}", "g(0, **how)"], True),
        (["how = {'a': 1}", "how['b'] = 2", "g(**how)"], False),
        (["how = {name: 1}", "g(**how)"], False),
        (["g(**how)"], False),
    ],
)
def test_a_dict_of_literal_keys_that_is_made_to_be_starred_is_found(lines, is_found):
    found = modules(a="\n    ".join(["def f(how):", *lines]))

    assert architecture.starred_dicts(found) == (["ctgraph_rl.a.f"] if is_found else [])


def test_names_of_two_classes_or_modules_are_found():
    found = modules(log__a="class Run: ...\nclass _Own: ...", board__a="Run = dict\nRUN = 1\nclass _Own: ...")

    assert architecture.classes_defined_twice(found) == {"Run": ["ctgraph_rl.log.a", "ctgraph_rl.board.a"]}
    assert architecture.modules_of_one_name(found) == {"a": ["ctgraph_rl.log.a", "ctgraph_rl.board.a"]}


@pytest.mark.parametrize(("sentences", "fine"), [(1, False), (2, True), (3, True), (4, False)])
def test_a_folder_needs_two_or_three_sentences(sentences, fine):
    text = f'"""{" ".join(["It has `a.b`."] * sentences)}"""'

    found = read({"ctgraph_rl.core.__init__": text, "ctgraph_rl.core.graph": ""})

    assert architecture.unexplained_folders(found) == ([] if fine else ["ctgraph_rl.core"])


@pytest.mark.parametrize(
    "text",
    [
        "from test_load import LEARNED",
        "import test_load",
        "from tests.runs.test_load import x",
        "from tests.runs import test_load",
        "def f():\n    from conftest import x",
    ],
)
def test_a_test_that_imports_a_test_is_found(text):
    found = read({"tests.test_a": text, "tests.test_b": "import pytest\nfrom helpers import oracles", "conftest": ""})

    assert [finding.partition(":")[0] for finding in architecture.tests_that_import_tests(found)] == ["tests.test_a"]
