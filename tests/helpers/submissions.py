"""Submissions that are edited, as one who makes something up would."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any


def edit(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change what ``submission.json`` says."""
    path = folder / "submission.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def edit_run(folder: Path, number: int = 0, **values: Any) -> None:
    """Change values of a run."""
    edit(folder, lambda content: content["runs"][number].update(values))


def make_nested(folder: Path) -> None:
    """Make folders within each other, more than Python's own functions can walk."""
    where = os.open(folder, os.O_RDONLY)
    for _ in range(1100):
        os.mkdir("x", dir_fd=where)
        inner = os.open("x", os.O_RDONLY, dir_fd=where)
        os.close(where)
        where = inner
    os.close(where)
