"""Choose settings by the first three blocks: ``python -m studies.plasticity.choose TRIALS CHOSEN``."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from statistics import fmean


def main() -> None:
    """Write the settings of each condition with the largest mean area over the blocks after a change."""
    trials, chosen = map(Path, sys.argv[1:])
    areas: dict[str, dict[str, list[float]]] = {}
    for line in map(json.loads, trials.read_text(encoding="utf-8").splitlines()):
        of = areas.setdefault(line["condition"], {}).setdefault(line["settings"], [])
        if line.get("block", 0) > 1:
            of.append(line["area"])
    best = {}
    for condition, tried in areas.items():
        means = {settings: fmean(values) for settings, values in tried.items() if values}
        best[condition] = json.loads(max(means, key=lambda settings: means[settings]))
        print(condition, {settings: round(mean, 3) for settings, mean in means.items()})
    best.pop("none", None)  # the default won
    chosen.write_text(json.dumps(best), encoding="utf-8")


if __name__ == "__main__":
    main()
