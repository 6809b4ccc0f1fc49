"""The arrows between packages, as import statements, and what an import costs."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

import ctgraph_rl

CHECKOUT = Path(__file__).resolve().parents[1]
PACKAGES = ("ctgraph_rl", "curricula", "baselines", "hydra_plugins")
FILES = sorted(path for package in PACKAGES for path in (CHECKOUT / package).rglob("*.py"))
NAMES = [str(path.relative_to(CHECKOUT)) for path in FILES]

every_file = pytest.mark.parametrize("path", FILES, ids=NAMES)


def imported(path: Path) -> set[str]:
    """Full names of all that the import statements of a file ask for; without those for type checkers only."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            node.body = []
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def uses(path: Path, *packages: str) -> set[str]:
    """The imports of a file that belong to packages."""
    return {name for name in imported(path) if any(f"{name}.".startswith(f"{package}.") for package in packages)}


def test_import_statements_are_found():
    names = imported(CHECKOUT / "baselines" / "policy_gradient.py")

    assert {"torch", "torch.Tensor", "baselines.learner.Learner", "ctgraph_rl.checks.require"} <= names
    assert len(FILES) >= 20


@every_file
def test_every_import_follows_the_arrows(path):
    package = path.relative_to(CHECKOUT).parts[0]
    never = {
        "ctgraph_rl": ("baselines", "curricula", "conf", "hydra_plugins"),
        "hydra_plugins": ("baselines", "curricula", "conf", "torch"),
        "curricula": ("baselines", "conf", "torchrl", "ctgraph_rl.env", "ctgraph_rl.CTGraphEnv"),
        "baselines": ("curricula", "conf", "hydra", "omegaconf"),
    }

    assert uses(path, *never[package]) == set()


@every_file
def test_only_the_entry_point_and_the_sweeper_know_hydra(path):
    found = uses(path, "hydra", "omegaconf")

    sweeper = CHECKOUT / "hydra_plugins" / "ctgraph_rl_sweeper" / "__init__.py"
    assert bool(found) == (path in (CHECKOUT / "ctgraph_rl" / "run.py", sweeper))


@pytest.mark.parametrize(
    "name", ["core/graph", "tasks/task", "tasks/curriculum", "core/dynamics", "tasks/observations", "core/rewards"]
)
def test_the_core_does_not_know_torchrl(name):
    path = CHECKOUT / "ctgraph_rl" / f"{name}.py"

    assert uses(path, "torchrl", "tensordict", "ctgraph_rl.env", "ctgraph_rl.learn") == set()


@pytest.mark.parametrize("path", sorted((CHECKOUT / "ctgraph_rl" / "metrics").glob("*.py")), ids=lambda path: path.name)
def test_metrics_import_nothing_of_ours_but_each_other(path):
    ours = uses(path, "ctgraph_rl", "baselines", "curricula")

    assert {name for name in ours if not name.startswith("ctgraph_rl.metrics.")} == set()


@pytest.mark.parametrize(
    ("statement", "packages"),
    [
        ("import ctgraph_rl", ["torch", "torchrl", "tensordict", "hydra", "numpy"]),
        (
            "import curricula; curricula.load('su_b1_4tasks').fingerprint",
            ["torchrl", "tensordict", "hydra"],
        ),
        ("import ctgraph_rl.run", ["torch", "torchrl"]),
        ("import baselines.dqn, baselines.lstm_ppo", ["hydra", "omegaconf", "curricula"]),
    ],
)
def test_an_import_does_not_load_what_costs_seconds(statement, packages, tmp_path):
    code = f"{statement}\nimport sys\nprint([name for name in {packages} if name in sys.modules])"
    env = {**os.environ, "PYTHONPATH": str(CHECKOUT)}

    result = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=env, capture_output=True, text=True)

    assert (result.stderr, result.stdout) == ("", "[]\n")


@every_file
def test_no_file_needs_a_second_noun(path):
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 500


def test_every_public_name_resolves():
    values = {name: getattr(ctgraph_rl, name) for name in ctgraph_rl.__all__}

    assert all(value is not None for value in values.values())
    assert set(ctgraph_rl.__all__) <= set(dir(ctgraph_rl))
    named = {name for name, value in values.items() if hasattr(value, "__name__") and name != "metrics"}
    assert all(values[name].__name__ == name for name in named)


def test_an_unknown_public_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'ctgraph_rl' has no attribute 'CTGraf'"):
        _ = ctgraph_rl.CTGraf
