"""The wheel: what is in it, and that it runs from an empty directory."""

from __future__ import annotations

import configparser
import importlib.util
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

import ctgraph_rl
from ctgraph_rl.log.sums import RESULTS

BADGE = "https://img.shields.io/badge/python-"
TINY = ["curriculum.num_frames=1024", "agent.num_envs=64", "agent.num_steps=8", "agent.hidden_size=8"]


@pytest.fixture(scope="module")
def wheel(checkout, tmp_path_factory) -> Path:
    if importlib.util.find_spec("build") is None:
        pytest.skip("needs the package build")
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), str(checkout)]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    (built,) = folder.glob("*.whl")
    return built


def test_the_wheel_holds_the_packages_and_the_configuration_and_nothing_else(wheel, checkout):
    found = set(zipfile.ZipFile(wheel).namelist())

    code = {
        str(path.relative_to(checkout))
        for package in ("ctgraph_rl", "curricula", "baselines", "hydra_plugins")
        for path in (checkout / package).rglob("*.py")
    }
    conf = {f"ctgraph_rl/{path.relative_to(checkout)}" for path in (checkout / "conf").rglob("*.yaml")}
    assert "ctgraph_rl/conf/config.yaml" in conf
    assert code | conf | {"ctgraph_rl/py.typed"} <= found
    rest = {name for name in found - code - conf if ".dist-info/" not in name}
    typed = {f"{package}/py.typed" for package in ("ctgraph_rl", "curricula", "baselines")}
    report = {f"ctgraph_rl/report/{name}" for name in ("report.html.j2", "report.md.j2", "style.mplstyle")}
    report |= {f"ctgraph_rl/board/standings/{name}" for name in ("board.html.j2", "board.js")}
    assert report <= rest <= {*typed, *report, "curricula/fingerprints.json", "ctgraph_rl/core/kernel.c"}


def test_the_wheel_declares_version_licence_and_console_script(wheel):
    files = zipfile.ZipFile(wheel)
    info = next(name.split("/")[0] for name in files.namelist() if ".dist-info/" in name)

    metadata = Parser().parsestr(files.read(f"{info}/METADATA").decode())
    scripts = configparser.ConfigParser()
    scripts.read_string(files.read(f"{info}/entry_points.txt").decode())

    assert (metadata["Name"], metadata["Version"]) == ("ctgraph_rl", ctgraph_rl.__version__)
    assert metadata["License-Expression"] == "Apache-2.0"
    assert not re.search(r"\]\((?!https?:|#)", metadata.get_payload()), "a package index resolves no relative link"
    assert metadata.get_payload().startswith("# ctgraph_rl\n")
    assert dict(scripts["console_scripts"]) == {"ctgraph-rl": "ctgraph_rl.cli:main"}


def test_the_wheel_finds_its_agents_from_an_empty_directory(wheel, tmp_path):
    zipfile.ZipFile(wheel).extractall(tmp_path / "site")
    (tmp_path / "empty").mkdir()
    env = {**os.environ, "PYTHONPATH": str(tmp_path / "site"), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-c", "from ctgraph_rl.cli import main; main()", "agents"]

    result = subprocess.run(command, cwd=tmp_path / "empty", env=env, capture_output=True, text=True)

    assert (result.returncode, result.stderr) == (0, "")
    assert "lstm_ppo" in result.stdout


@pytest.mark.slow
def test_the_wheel_runs_from_an_empty_directory_and_writes_only_under_runs(wheel, tmp_path):
    zipfile.ZipFile(wheel).extractall(tmp_path / "site")
    (tmp_path / "empty").mkdir()
    env = {**os.environ, "PYTHONPATH": str(tmp_path / "site"), "PYTHONDONTWRITEBYTECODE": "1"}

    result = subprocess.run(
        [sys.executable, "-m", "ctgraph_rl.run", *TINY], cwd=tmp_path / "empty", env=env, capture_output=True, text=True
    )

    assert result.returncode == 0, result.stderr
    assert "average performance" in result.stdout and "results: " in result.stdout
    (run_dir,) = (tmp_path / "empty" / "runs" / "su_b1_4tasks").iterdir()
    assert run_dir.name.startswith("lstm_ppo-seed0-")
    written = {path.name for path in run_dir.iterdir()}
    assert written == {".hydra", *RESULTS}
    assert [path.name for path in (tmp_path / "empty").iterdir()] == ["runs"]


def test_readme_names_the_versions_of_python_of_the_package(checkout):
    """CI reads them from pyproject.toml, too."""
    project = tomllib.loads((checkout / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    readme = (checkout / "README.md").read_text(encoding="utf-8")

    versions = [each.split(" :: ")[-1] for each in project["classifiers"] if ":: Python :: 3." in each]

    assert f"With Python {versions[0]} to {versions[-1]}, this installs" in readme
    assert f"![Python {versions[0]} to {versions[-1]}]({BADGE}{'%20%7C%20'.join(versions)}-blue)" in readme
    assert project["requires-python"] == f">={versions[0]}"
