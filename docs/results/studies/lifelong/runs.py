"""Raw results of runs with methods.

A line holds one evaluation: who learned what, by which method and seed, the block and the frames learned so far, and
the mean return on each task in the order of the curriculum. The single-task experts of a seed are one ``expert``: its
line after so many frames has what each of them gets on its own task after as many.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from ctgraph_rl.log.run_log import RunLog
from studies.lifelong.experiments import curricula_of, lacking
from studies.raw import Raw, groups, grow, machine_of, merged

EXPERT = "expert"
CELL = ("curriculum", "agent", "method", "seed")
"""What tells runs apart."""


def collect(name: str, folders: Sequence[Path], add: bool = False) -> None:
    """Add what the finished runs under some folders say to a table that grows until it has all cells.

    Args:
        name: of the table, as its experiment's.
        folders: with run directories.
        add: whether cells that are not under the folders stay as the stored table has them.

    Raises:
        ValueError: for two runs of one cell or two sets of experts of one seed, which differ in what is not in the raw
            results, another curriculum, and folders without finished runs.
    """
    kept = groups(merged(name, [], CELL, add), *CELL)
    found: dict[tuple[str, ...], Raw] = {}
    own = curricula_of(name)
    where = ", ".join(map(str, folders))
    for run_dir in sorted(path.parent for folder in folders for path in folder.rglob("metrics.json")):
        for cell, lines in groups(evaluations(run_dir), *CELL).items():
            before = found.get(cell, lines)
            if before != lines:
                raise ValueError(f"{where} has two runs of {' '.join(cell)}: collect from a folder with one of them")
            if cell in kept and kept[cell][0]["fingerprint"] != lines[0]["fingerprint"]:
                raise ValueError(f"{run_dir} learned another curriculum than {name}.csv has of {' '.join(cell)}")
            if cell[0] not in own:
                raise ValueError(f"{run_dir} learned {cell[0]}, and {name} is of {', '.join(own)}")
            found[cell] = lines
    if not found:
        raise ValueError(f"{where} holds no finished run of {name}: give the folder of its runs")
    ordered = [line for _, lines in sorted({**kept, **found}.items()) for line in lines]
    width = max(sum(key.isdigit() for key in line) for line in ordered)
    lines = [{**line, **{str(j): line.get(str(j), "") for j in range(1, width + 1)}} for line in ordered]
    grow({name: lines}, [" ".join(cell) for cell in lacking(name, lines)])


def evaluations(run_dir: Path) -> Raw:
    """The lines of a run, and of the experts that it was compared with; none for an expert's own directory."""
    if run_dir.parent.name == "experts":
        return []
    log = RunLog.read(run_dir / "run.jsonl")
    about = log.of_kind("run")[0]
    agent, method = run_dir.name.split("-seed")[0], "finetune"
    if "-" in agent:
        agent, method = agent.split("-")
    who = {"curriculum": run_dir.parent.name, "fingerprint": about["fingerprint"], "agent": agent}
    cell = {**who, "method": method, "seed": str(about["config"]["seed"]), **machine_of(about)}
    lines = _lines(cell, log.of_kind("evaluation"))
    experts = [expert for line in log.of_kind("experts") for expert in line["experts"]]
    own = []
    for expert in experts:
        alone = RunLog.read(run_dir.parent.parent / "experts" / Path(expert["run"]).name / "run.jsonl")
        own += [{**line, "task": expert["task"]} for line in alone.of_kind("evaluation")]
        cell |= machine_of(alone.of_kind("run")[0])
    return lines + _lines({**cell, "method": EXPERT}, own)


def _lines(cell: dict[str, Any], evaluated: Iterable[dict[str, Any]]) -> Raw:
    """A line for each number of frames."""
    by_frames: dict[int, dict[str, Any]] = {}
    for each in evaluated:
        line = by_frames.setdefault(each["frames"], {**cell, "block": each["block"], "frames": str(each["frames"])})
        line[str(each["task"])] = round(each["return_mean"], 6)
    return [{key: str(value) for key, value in by_frames[frames].items()} for frames in sorted(by_frames)]
