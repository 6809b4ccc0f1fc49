"""Runs and sweeps in the process of a test; the fixture `learned` of conftest.py learns their cells."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from hydra._internal.hydra import Hydra

from ctgraph_rl import run as run_module

UNLUCKY = 13
"""A seed that fails."""


def command_line(monkeypatch, *arguments: str) -> int:
    """The exit code of ``ctgraph-rl ARGUMENTS`` in this process."""
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    monkeypatch.setattr(sys, "argv", ["ctgraph-rl", *arguments])
    monkeypatch.setattr(Hydra, "get_mode", lambda *_, **__: None)  # composes for hydra.mode alone, which no test sets
    try:
        run_module.main()
    except SystemExit as end:
        return int(end.code or 0)
    return 0


def sweep(monkeypatch, *settings: str) -> int:
    """The exit code of ``ctgraph-rl -m SETTINGS`` in this process."""
    return command_line(monkeypatch, "-m", *settings)


def configs(runs: list[Path]) -> list[dict[str, Any]]:
    """What was run."""
    return [json.loads((path / "run.jsonl").read_text())["config"] for path in runs]


def files_in(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
