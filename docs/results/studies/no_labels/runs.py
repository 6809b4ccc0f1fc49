"""Raw results of detectors of task changes, from the runs of the experiments ``no_labels`` and ``no_labels_*``."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from studies.raw import grow, lost, machine_of, merged

NAME, SPANS = "no_labels", "no_labels_spans"

FOUND = ("detector", "method", "num_fresh", "boundaries")
"""The columns that tell the learners of a curriculum apart."""

KEY = ("curriculum", "stay", *FOUND, "seed")
"""The columns that tell runs apart."""

MASKS, PAIR = "swoks_2x4", "dick2020_pair"
IMAGES = ("fo_b1_4images", "su_b1_4images", "co_b1_4images", "posr_b1_4images")

PLANNED = {
    (MASKS, "384000"): ("announced", "oracle", "swoks", "swoks, fresh", "adwin", "none"),
    (PAIR, "51200"): ("announced", "oracle", "amd", "swoks", "adwin", "none"),
    (PAIR, "204800"): ("announced", "oracle", "amd", "swoks, fresh", "adwin", "none"),
    **{(name, "204800"): ("announced", "oracle", "swoks, fresh", "adwin", "none") for name in IMAGES},
}
"""Curricula, frames of a stay, and learners of the experiments."""

PLAIN = (
    "average_performance",
    "online_return",
    "false_alarms",
    "labels_per_task",
    "label_agreement",
    "frames_not_learned",
    "frames_rolled_back",
)
"""Metrics of one value."""


def measured(run: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the line of a finished run, and a line for each span of its labels.

    The span that ends with an alarm has the mean return of training in the interval before the alarm's.
    """
    from ctgraph_rl.learn.labels import label_spans
    from ctgraph_rl.log.files import LOG
    from ctgraph_rl.log.run_log import RunLog
    from ctgraph_rl.report.bounds_of_runs import bounds_of_curriculum
    from ctgraph_rl.tasks.curriculum import Curriculum

    log, curriculum = RunLog.read(run / LOG), Curriculum.from_json(run / "curriculum.json")
    about, metrics = log.of_kind("run")[0], json.loads((run / "metrics.json").read_text(encoding="utf-8"))
    config, delay = about["config"], metrics["detection_delay"]
    bounds = bounds_of_curriculum(curriculum).known
    which = _settings(curriculum, config)
    undefined = delay["undefined"] is not None and not delay["n_undefined"]
    training = log.of_kind("training")
    before = {int(line["frames"]): last["return_mean"] for last, line in pairwise(training)}
    line = {
        **which,
        "frames": curriculum.num_frames,
        **{name: _value(metrics[name]) for name in PLAIN},
        "final_returns": " ".join(f"{each:.6g}" for each in metrics["average_performance"]["terms"]),
        "detection_delay": _value(delay),
        "delays": "" if undefined else " ".join("-" if each is None else f"{each:.0f}" for each in delay["terms"]),
        "lowest_return": bounds.low,
        "highest_return": bounds.high,
        "fingerprint": about["fingerprint"],
        "numbers": about["numbers"],
        **{name: about["versions"][name] for name in ("ctgraph_rl", "torch")},
        **machine_of(about),
    }
    return line, [{**which, **_span(span, before)} for span in label_spans(log)]


def _settings(curriculum: Any, config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the cells that tell what was run."""
    detector = config.get("detector") or {}
    return {
        "curriculum": curriculum.name.removesuffix(" (modified)"),
        "stay": curriculum.blocks[0].num_frames,
        "agent": _module(config["agent"]),
        "method": _module(config.get("method") or {}) or "finetune",
        "detector": _module(detector),
        "stable_phase": detector.get("stable_phase", ""),
        "num_fresh": detector.get("num_fresh", ""),
        "boundaries": curriculum.protocol.boundaries,
        "task_id": curriculum.protocol.task_id,
        "seed": config["seed"],
    }


def _span(span: Any, before: Mapping[int, float]) -> dict[str, Any]:
    """Return the cells of a span, with the mean return before its alarm."""
    return {
        "start": int(span.start),
        "end": int(span.end),
        "label": span.label,
        "learned": span.learned,
        "alarm": span.alarm,
        "return_before": round(before[int(span.end)], 6) if span.alarm else "",
    }


def _module(part: dict[str, Any]) -> str:
    """Return the module of what a configuration builds, such as ``swoks``."""
    return part["_target_"].split(".")[-2] if part else ""


def _value(metric: dict[str, Any]) -> float | str:
    """Return the value of a metric; nothing where it is undefined."""
    return "" if metric["value"] is None else round(metric["value"], 6)


def collect(name: str, folders: Sequence[Path], add: bool = False) -> None:
    """Add the finished runs under some folders to tables that grow until they have all runs of the stored ones.

    The table has a line for each run, and that of spans a line for each span of frames in which one label acted. Of
    equal runs, the last one counts.

    Args:
        name: of the first table.
        folders: with run directories.
        add: whether runs that are not under the folders stay as the stored tables have them.
    """
    curricula = {curriculum for curriculum, _ in PLANNED}
    found: dict[tuple[str, ...], tuple[dict[str, Any], list[dict[str, Any]]]] = {}
    for path in (path for folder in folders for path in sorted(folder.rglob("metrics.json"))):
        if "experts" not in path.parts and path.parent.parent.name in curricula:
            line, spans = measured(path.parent)
            found[_key(line)] = line, spans
    lines = merged(name, [line for line, _ in found.values()], KEY, add)
    all_spans = merged(SPANS, [span for _, spans in found.values() for span in spans], KEY, add)
    grow({name: sorted(lines, key=_key), SPANS: sorted(all_spans, key=_key)}, lost(name, lines, KEY))


def _key(line: Mapping[str, Any]) -> tuple[str, ...]:
    """Return what tells a run apart; spans of a run stay in their order."""
    return tuple(str(line[column]) for column in KEY)
