"""Users whose processes the tests start, and what an ordinary one may read."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers.paths import CHECKOUT

NOBODY = 65534


@pytest.fixture(scope="session")
def ordinary() -> dict[str, Any]:
    """Arguments of `subprocess.run` by which root starts a process of an ordinary user."""
    return {"user": NOBODY, "group": NOBODY, "extra_groups": []}


@pytest.fixture(scope="session")
def find_python() -> Callable[[dict[str, Any]], str]:
    """A function that returns an interpreter that may be run by the user of these arguments."""

    def find(user: dict[str, Any]) -> str:
        for path in (sys.executable, "/usr/bin/python3"):
            try:
                if subprocess.run([path, "-c", "import tomllib"], cwd="/", **user).returncode == 0:
                    return path
            except OSError:
                continue
        pytest.skip("no Python that an ordinary user may run")

    return find


@pytest.fixture(scope="session")
def package() -> Iterator[str]:
    """A folder with a copy of the package that every user may read; the checkout may be closed to others."""
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        Path(folder).chmod(0o755)
        shutil.copytree(CHECKOUT / "ctgraph_rl", f"{folder}/ctgraph_rl", ignore=shutil.ignore_patterns("__pycache__"))
        yield folder
