"""Detectors of task changes: raw results, and no_labels.md and its figures, which are made of them.

``python docs/results/no_labels.py collect RUNS...`` writes no_labels.csv, a line for each finished run of the
experiments ``no_labels``, ``no_labels_ewc`` and ``no_labels_pair`` under some folders, and no_labels_spans.csv, a line
for each span of frames in which one label acted. Where a run is under several folders, that of the last one counts.
``python docs/results/no_labels.py`` makes the page, which has numbers of a learner on a curriculum once all its seeds
are there.
"""

from __future__ import annotations

import argparse
import json
from functools import cache
from itertools import pairwise
from pathlib import Path
from statistics import mean
from string import Template
from typing import Any

from raw import HERE, Raw, groups, machine_of, machines, mean_of, read, table, write

NAME, SPANS = "no_labels", "no_labels_spans"
SEEDS = 5

SOON = 65_536
"""Frames after a change within which an alarm is counted as one of that change on the page: eight batches."""

HIGH = 0.9
"""The return of the batch before an alarm from which on little was left to learn."""

FOUND = ("detector", "method", "num_fresh", "boundaries")
"""The columns that tell the learners of a curriculum apart."""

MASKS, PAIR = "swoks_2x4", "dick2020_pair"
IMAGES = ("fo_b1_4images", "su_b1_4images", "co_b1_4images", "posr_b1_4images")

LEARNERS = {
    "announced": "announced",
    "oracle": "oracle",
    "amd": "AMD",
    "swoks": "SWOKS, published trials",
    "swoks, fresh": "SWOKS, fresh trials",
    "adwin": "ADWIN",
    "none": "fine-tuning",
}
"""Names of learners in the order of the page."""

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
    from ctgraph_rl.report.bounds import bounds_of_curriculum
    from ctgraph_rl.tasks.curriculum import Curriculum

    log, curriculum = RunLog.read(run / LOG), Curriculum.from_json(run / "curriculum.json")
    about, metrics = log.of_kind("run")[0], json.loads((run / "metrics.json").read_text(encoding="utf-8"))
    config, delay = about["config"], metrics["detection_delay"]
    detector = config.get("detector") or {}
    bounds = bounds_of_curriculum(curriculum).known
    which = {
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
    spans = [
        {
            **which,
            **{"start": int(s.start), "end": int(s.end), "label": s.label, "learned": s.learned, "alarm": s.alarm},
            "return_before": round(before[int(s.end)], 6) if s.alarm else "",
        }
        for s in label_spans(log)
    ]
    return line, spans


def _module(part: dict[str, Any]) -> str:
    """Return the module of what a configuration builds, such as ``swoks``."""
    return part["_target_"].split(".")[-2] if part else ""


def _value(metric: dict[str, Any]) -> float | str:
    """Return the value of a metric; nothing where it is undefined."""
    return "" if metric["value"] is None else round(metric["value"], 6)


def collect(folders: list[Path]) -> None:
    """Write the raw results of the finished runs under some folders."""
    names = {name for name, _ in PLANNED}
    found: dict[tuple[Any, ...], tuple[dict[str, Any], list[dict[str, Any]]]] = {}
    for path in (path for folder in folders for path in sorted(folder.rglob("metrics.json"))):
        if "experts" not in path.parts and path.parent.parent.name in names:
            line, spans = measured(path.parent)
            found[tuple(str(line[key]) for key in ("curriculum", "stay", *FOUND, "seed"))] = line, spans
    in_order = [found[key] for key in sorted(found)]
    write(NAME, [line for line, _ in in_order])
    write(SPANS, [span for _, spans in in_order for span in spans])


def learner(line: dict[str, str]) -> str:
    """Return the name of a line's learner, a key of `LEARNERS`."""
    if line["detector"]:
        return "swoks, fresh" if line["detector"] == "swoks" and line["num_fresh"] != "0" else line["detector"]
    return "announced" if line["boundaries"] == "announced" else "none"


@cache
def finished() -> dict[tuple[str, str], dict[str, Raw]]:
    """Return the lines of each curriculum and learner with all seeds, in the order of the page."""
    found = groups(read(NAME), "curriculum", "stay")
    of = {
        place: {name: [line for line in found.get(place, []) if learner(line) == name] for name in names}
        for place, names in PLANNED.items()
    }
    whole = {
        place: {name: lines for name, lines in each.items() if len({line["seed"] for line in lines}) >= SEEDS}
        for place, each in of.items()
    }
    return {place: each for place, each in whole.items() if each}


def values(lines: Raw, name: str) -> list[float]:
    """Return a metric of each seed."""
    return [float(line[name]) for line in lines]


def delays(lines: Raw) -> list[float]:
    """Return the frames from each change to the first alarm before the next one; NaN where there is none."""
    return [float(each) if each != "-" else float("nan") for line in lines for each in line["delays"].split()]


def soon(lines: Raw) -> int:
    """Return the number of changes with an alarm within `SOON` frames."""
    return sum(each <= SOON for each in delays(lines))


def alarms(lines: Raw) -> Raw:
    """Return the spans of some runs that end with an alarm which is not the first one soon after a change."""
    own = {tuple(line[key] for key in ("curriculum", "stay", *FOUND, "seed")) for line in lines}
    found = []
    for run, spans in groups(read(SPANS), "curriculum", "stay", *FOUND, "seed").items():
        seen = set()
        for span in spans if run in own else ():
            change, after = divmod(int(span["end"]), int(span["stay"]))
            first = change > 0 and change not in seen
            if span["alarm"] == "True":
                seen.add(change)
                if not (first and after <= SOON):
                    found.append(span)
    return found


def other_alarms(lines: Raw) -> str:
    """Return the alarms of `alarms` per 100,000 frames, and how many of them came at a high return."""
    found = alarms(lines)
    rate = 100_000 * len(found) / sum(values(lines, "frames"))
    high = sum(float(span["return_before"]) >= HIGH for span in found)
    return f"{rate:.2f}; {high} of {len(found)}" if found else "0"


def span_of(numbers: list[float], form: str) -> str:
    """Return the mean over seeds, and the lowest and the highest of them where they differ."""
    middle, low, high = (format(each, form) for each in (mean(numbers), min(numbers), max(numbers)))
    return middle if low == high else f"{middle} ({low} to {high})"


def returns(lines: Raw, name: str) -> str:
    """Return the mean over seeds of a metric that has the bounds of returns, with its interval."""
    low, high = (float(lines[0][f"{end}_return"]) for end in ("lowest", "highest"))
    return mean_of(values(lines, name), (low, high))


def row(name: str, lines: Raw) -> list[str]:
    """Return the cells of a learner."""
    cells = [LEARNERS[name], returns(lines, "average_performance"), returns(lines, "online_return")]
    if not lines[0]["detector"]:
        return [*cells, *[""] * 5]
    shares = [
        [each / frames for each, frames in zip(values(lines, key), values(lines, "frames"), strict=True)]
        for key in ("frames_not_learned", "frames_rolled_back")
    ]
    return [
        *cells,
        mean_of(values(lines, "label_agreement"), (-0.5, 1)),
        f"{soon(lines)} of {len(delays(lines))}",
        other_alarms(lines),
        span_of(values(lines, "labels_per_task"), ".2f"),
        "; ".join(f"{100 * mean(each):.0f} %" for each in shares),
    ]


HEAD = (
    "",
    "average performance",
    "online return",
    "adjusted Rand index",
    "changes found soon",
    "other alarms; at a return of 0.9",
    "labels per task",
    "not learned from; undone",
)


def results(curriculum: str, stay: str) -> str:
    """Return the table of a curriculum."""
    of = finished().get((curriculum, stay), {})
    if not of:
        return "No learner has all its seeds yet."
    return table(HEAD, [row(name, lines) for name, lines in of.items()])


def images() -> str:
    """Return the table of the image sets of all configurations: average performance."""
    of = {name: finished().get((name, "204800"), {}) for name in IMAGES}
    rows = [
        [LEARNERS[name], *(returns(each[name], "average_performance") if name in each else "" for each in of.values())]
        for name in PLANNED[IMAGES[0], "204800"]
    ]
    return table(["", *(f"`{name}`" for name in IMAGES)], [cells for cells in rows if any(cells[1:])])


def on_images(name: str) -> Raw:
    """Return the lines of a learner on the image sets of all configurations that have all its seeds."""
    return [line for place in IMAGES for line in finished().get((place, "204800"), {}).get(name, [])]


def image_labels() -> str:
    """Return the table of the labels on the image sets, of all configurations together."""
    rows = []
    for name in PLANNED[IMAGES[0], "204800"]:
        lines = on_images(name)
        if lines and lines[0]["detector"]:
            cells = row(name, lines)[4:]
            shown = [span_of(values(lines, key), ".2f") for key in ("online_return", "label_agreement")]
            rows.append([LEARNERS[name], str(len(lines)), *shown, *cells])
    return table(["", "runs", *HEAD[2:]], rows)


def compared() -> str:
    """Return the table of comparisons on the image sets, whose pairs are those of all configurations together."""
    from pairs import of_pairs, rows

    measured = {
        (name, place, line["seed"]): float(line["average_performance"])
        for (place, _), each in finished().items()
        if place in IMAGES
        for name, lines in each.items()
        for line in lines
    }
    names = {name for name, *_ in measured}
    wanted = [(a, b) for a, b in COMPARED if {a, b} <= names]
    if not wanted:
        return "No two learners have all their seeds yet."
    return rows({f"{LEARNERS[a]} - {LEARNERS[b]}": of_pairs(measured, a, b) for a, b in wanted})


COMPARED = (
    ("oracle", "none"),
    ("swoks, fresh", "none"),
    ("adwin", "none"),
    ("announced", "oracle"),
    ("oracle", "swoks, fresh"),
    ("oracle", "adwin"),
)


def not_run() -> str:
    """Return a list of what the page has no number of."""
    of = finished()
    missing = {place: [LEARNERS[n] for n in names if n not in of.get(place, {})] for place, names in PLANNED.items()}
    lines = [
        f"- `{name}` with stays of {int(stay):,} frames: {'; '.join(each) if (name, stay) in of else 'all'}."
        for (name, stay), each in missing.items()
        if each
    ]
    return "\n".join(["No number is on this page of:", "", *lines]) if lines else "Everything that was planned has run."


def numbers() -> dict[str, str]:
    """Return the numbers within the text of the page that follow from several tables."""
    names = {"swoks_online": "swoks, fresh", "adwin_online": "adwin", "oracle_online": "oracle"}
    online = {key: f"{mean(values(on_images(name), 'online_return')):.2f}" for key, name in names.items()}
    found = {key.replace("online", "found"): str(soon(on_images(name))) for key, name in names.items()}
    ends = {name: mean(values(on_images(name), "average_performance")) for name in ("announced", "oracle")}
    return {**online, **found, "announced_less": f"{ends['announced'] - ends['oracle']:.2f}"}


def page() -> str:
    """Return the page: the template with its tables and numbers."""
    template = Template((HERE / "no_labels_template.md").read_text(encoding="utf-8"))
    tables = {
        "masks": results(MASKS, "384000"),
        "pair": results(PAIR, "51200"),
        "long_pair": results(PAIR, "204800"),
        "images": images(),
        "image_labels": image_labels(),
        "compared": compared(),
        "not_run": not_run(),
    }
    return template.substitute(tables, machines=machines(NAME), **numbers())


COLOURS = ("#3b528b", "#5ec962", "#21918c", "#fde725")
"""Of the tasks, in the order in which they come; they also differ in grey."""

NOT_LEARNED = 0.35
"""Opacity of frames that were not learned from."""


def draw_strips(path: Path) -> None:
    """Draw the labels of all runs with detectors on four goals that come twice, and what they can do at the end."""
    from ctgraph_rl.visualize.style import new_figure, save_figure

    stay, of = 384_000, finished()[MASKS, "384000"]
    shown = [(name, line) for name, lines in of.items() if lines[0]["detector"] for line in lines]
    spans = groups(read(SPANS), "curriculum", "stay", "detector", "num_fresh", "seed")
    figure = new_figure(7.2, 0.9 + 0.17 * (len(shown) + 1))
    axes, side = figure.subplots(1, 2, width_ratios=(5, 1), sharey=True)
    for block in range(8):
        axes.barh(0, stay, 0.8, left=block * stay, color=COLOURS[block % 4], linewidth=0)
        axes.text((block + 0.5) * stay, 0, str(block % 4 + 1), **_text(COLOURS[block % 4]))
        axes.axvline(block * stay, color="0", linewidth=0.6, linestyle=(0, (3, 2)))
    for place, (_, line) in enumerate(shown, 1):
        own = spans[MASKS, "384000", line["detector"], line["num_fresh"], line["seed"]]
        of_label = {label: _task(own, label, stay) for label in {span["label"] for span in own}}
        for span in own:
            _strip(axes, place, span, COLOURS[of_label[span["label"]]])
        value = float(line["average_performance"])
        side.barh(place, value, 0.7, color="0.35")
    firsts = {name: place for place, (name, _) in reversed(list(enumerate(shown, 1)))}
    names = {place: LEARNERS[name] for name, place in firsts.items()}
    axes.set_yticks([0, *(place + SEEDS / 2 - 0.5 for place in names)], ["true task", *names.values()], fontsize=7)
    for place in names:
        axes.axhline(place - 0.5, color="0", linewidth=0.5)
        side.axhline(place - 0.5, color="0", linewidth=0.5)
    axes.set(xlim=(0, 8 * stay), ylim=(len(shown) + 0.5, -0.5))
    axes.set_xticks(
        [block * stay for block in range(0, 9, 2)], [f"{block * stay / 1e6:.2f}" for block in range(0, 9, 2)]
    )
    axes.tick_params(axis="both", length=0, labelsize=7)
    axes.set_xlabel("million frames; each strip is a seed", fontsize=7)
    side.set(xlim=(0, 1))
    side.set_xticks([0, 0.5, 1], ["0", "0.5", "1"])
    side.tick_params(axis="both", length=0, labelsize=7)
    side.set_xlabel("average\nperformance", fontsize=7)
    save_figure(figure, path)


def _text(background: str) -> dict[str, Any]:
    """Return the look of a number on a colour."""
    light = sum(int(background[place : place + 2], 16) for place in (1, 3, 5)) > 380
    return {"ha": "center", "va": "center", "fontsize": 6, "color": "0" if light else "1"}


def _task(own: Raw, label: str, stay: int) -> int:
    """Return the task, 0 to 3, in most of whose frames a label learned, or acted if it never learned."""
    frames = [0.0] * 4
    for span in own:
        if span["label"] == label:
            weight = 1.0 if span["learned"] == "True" else 1e-6
            for block in range(8):
                shared = min(int(span["end"]), (block + 1) * stay) - max(int(span["start"]), block * stay)
                frames[block % 4] += weight * max(shared, 0)
    return frames.index(max(frames))


def _strip(axes: Any, place: int, span: dict[str, str], colour: str) -> None:
    """Draw a span of a label, with its number if it is wide enough, and its alarm."""
    start, end = int(span["start"]), int(span["end"])
    learned = span["learned"] == "True"
    axes.barh(place, end - start, 0.8, left=start, color=colour, alpha=1 if learned else NOT_LEARNED, linewidth=0)
    if end - start >= 100_000:
        axes.text((start + end) / 2, place, span["label"], **_text(colour))
    if span["alarm"] == "True":
        axes.plot([end, end], [place - 0.45, place + 0.45], color="tab:red", linewidth=1)


def draw_images(path: Path) -> None:
    """Draw the average performance of every seed on the image sets of each configuration."""
    from ctgraph_rl.visualize.style import new_figure, save_figure

    of = {name: finished().get((name, "204800"), {}) for name in IMAGES}
    names = [name for name in PLANNED[IMAGES[0], "204800"] if any(name in each for each in of.values())]
    figure = new_figure(7.2, 0.8 + 0.3 * len(names))
    panels = figure.subplots(1, len(of), sharey=True)
    for axes, (curriculum, each) in zip(panels, of.items(), strict=True):
        for place, name in enumerate(names):
            found = values(each.get(name, []), "average_performance")
            shifts = [place + 0.3 * (seed / (SEEDS - 1) - 0.5) for seed in range(len(found))]
            axes.plot(found, shifts, "o", color="0", markersize=3, alpha=0.6)
            if found:
                axes.plot(sum(found) / len(found), place, "|", color="tab:red", markersize=9, markeredgewidth=1.8)
        axes.set_title(curriculum, fontsize=8)
        axes.set(xlim=(-0.05, 1.05))
        axes.set_xticks([0, 0.5, 1], ["0", "0.5", "1"])
        axes.tick_params(labelsize=7)
        axes.set_xlabel("average performance", fontsize=7)
    panels[0].set_yticks(range(len(names)), [LEARNERS[name] for name in names], fontsize=7)
    panels[0].set(ylim=(len(names) - 0.5, -0.5))
    save_figure(figure, path)


def main() -> None:
    """See above."""
    parser = argparse.ArgumentParser(prog="python docs/results/no_labels.py", description=__doc__)
    commands = parser.add_subparsers(dest="command")
    collecting = commands.add_parser("collect", help="raw results from runs")
    collecting.add_argument("runs", type=Path, nargs="+", help="folders with runs")
    options = parser.parse_args()
    if options.command == "collect":
        collect(options.runs)
    else:
        (HERE / "no_labels.md").write_text(page(), encoding="utf-8")
        draw_strips(HERE / "no_labels.png")
        draw_images(HERE / "no_labels_ewc.png")


if __name__ == "__main__":
    main()
