"""Write the raw results from lines of runs: ``python -m studies.plasticity.collect FOLDER``."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from ctgraph_rl.portable import cpu_model
from studies.plasticity.page import COLUMNS, MATCHED, NAME, TRIALS
from studies.raw import MACHINE, write

OF_A_RUN = (
    "curriculum",
    "condition",
    "settings",
    "seed",
    "block",
    "area",
    "reached",
    "end",
    "seconds",
    "machine",
    "cpu",
)


def lines_in(*paths: Path) -> list[dict[str, Any]]:
    """Return the lines of files, with numbers of four digits."""
    found = []
    for path in paths:
        for line in map(json.loads, path.read_text(encoding="utf-8").splitlines()):
            found.append({key: _short(value) for key, value in line.items()} | {"cpu": cpu_model()})
    return found


def _short(value: Any) -> Any:
    return float(f"{value:.4g}") if isinstance(value, float) else value


def main() -> None:
    """Write the tables."""
    folder = Path(sys.argv[1])
    runs = lines_in(*sorted(folder.glob("conflict*.jsonl")), *sorted(folder.glob("stream*.jsonl")))
    columns = (*OF_A_RUN, *MACHINE, *COLUMNS)
    write(NAME, [{key: line.get(key, "") for key in columns} for line in runs])
    write(
        TRIALS,
        [{key: line.get(key, "") for key in (*OF_A_RUN, *MACHINE)} for line in lines_in(folder / "trials.jsonl")],
    )
    write(MATCHED, lines_in(folder / "matched.jsonl"))


if __name__ == "__main__":
    main()
