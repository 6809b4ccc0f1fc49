"""docs/results/no_labels.md: made from the raw results beside it, and what it says of them holds."""

from __future__ import annotations

import re
from itertools import pairwise
from math import exp

import pytest
import torch
from helpers.paths import CHECKOUT

from ctgraph_rl.metrics.labels import PER, Labelling, adjusted_rand_index, detection_delay

FOLDER = CHECKOUT / "docs" / "results"
PAGE, README = (
    " ".join(path.read_text(encoding="utf-8").split()) for path in (FOLDER / "no_labels.md", CHECKOUT / "README.md")
)

RUN = ("curriculum", "stay", "detector", "method", "num_fresh", "boundaries", "seed")


@pytest.fixture(scope="module")
def made():
    from studies.no_labels import page

    return page


def labelling(spans, num_tasks):
    """Return the labels of a run by its spans, cut where the task changes."""
    rows = []
    for span in spans:
        start, end, stay = (int(span[key]) for key in ("start", "end", "stay"))
        cuts = [start, *(cut for cut in range(stay, end, stay) if cut > start), end]
        for first, last in pairwise(cuts):
            alarm = span["alarm"] == "True" and last == end
            rows.append(
                (int(span["label"]), first // stay % num_tasks, last - first, span["learned"] == "True", alarm, 0)
            )
    return Labelling(*map(torch.tensor, zip(*rows, strict=True)), oracle=spans[0]["detector"] == "oracle")


@pytest.mark.slow
def test_the_page_is_what_its_raw_results_make(made):
    assert made.page() == (FOLDER / "no_labels.md").read_text(encoding="utf-8")


def test_each_run_is_one_line_and_its_metrics_are_those_of_its_spans(made):
    lines = made.read(made.NAME)
    spans = made.groups(made.read(made.SPANS), *RUN)

    assert len({tuple(line[key] for key in RUN) for line in lines}) == len(lines)
    assert set(spans) == {tuple(line[key] for key in RUN) for line in lines if line["detector"]}
    for line in (line for line in lines if line["detector"]):
        run = labelling(spans[tuple(line[key] for key in RUN)], 2 if line["curriculum"] == "dick2020_pair" else 4)
        delays, frames, tasks = detection_delay(run).terms, int(run.frames.sum()), len(run.task.unique())
        found = sum(delay is not None for delay in delays)

        assert frames == int(line["frames"])
        assert line["delays"] == " ".join("-" if delay is None else f"{delay:.0f}" for delay in delays)
        assert float(line["false_alarms"]) == pytest.approx(PER * (int(run.alarm.sum()) - found) / frames, abs=1e-6)
        assert float(line["label_agreement"]) == pytest.approx(adjusted_rand_index(*run[:3]), abs=1e-6)
        assert float(line["labels_per_task"]) == len(run.acted[run.learned].unique()) / tasks
        assert float(line["frames_not_learned"]) == int(run.frames[~run.learned].sum())


def value(lines, name):
    """Return the mean of a metric over seeds as the page shows it."""
    return f"{sum(map(float, (line[name] for line in lines))) / len(lines):.2f}"


@pytest.fixture(scope="module")
def masks(made):
    """The runs on four goals that come twice, by learner."""
    return made.finished()[made.MASKS, "384000"]


def test_what_masks_end_with_and_what_labels_cost_is_computed_from_the_raw_results(made, masks):
    end = {name: value(lines, "average_performance") for name, lines in masks.items()}
    online = {name: value(lines, "online_return") for name, lines in masks.items()}
    not_learned, undone = (
        sum(float(line[key]) for line in masks["adwin"]) / sum(float(line["frames"]) for line in masks["adwin"])
        for key in ("frames_not_learned", "frames_rolled_back")
    )

    assert {line["final_returns"] for name in ("adwin", "announced") for line in masks[name]} == {"1 1 1 1"}
    assert "with a return of 1 on all goals in all five seeds. Masks with announced tasks end with the same." in PAGE
    assert end["swoks"] == end["swoks, fresh"]
    assert f"With SWOKS they end at {end['swoks']}, and fine-tuning at {end['none']}." in PAGE
    assert f"ADWIN's online return is {online['adwin']}, that with announced tasks {online['announced']}." in PAGE
    assert (round(not_learned, 1), f"{undone:.0%}") == (0.2, "14%")
    assert "A fifth of the frames is not learned from, and the learning of 14 % is undone." in PAGE
    assert [line["final_returns"] for line in masks["oracle"]] == ["1 1 1 1"] * 3 + ["1 1 -0.1 1"] + ["1 1 1 1"]
    assert "In seed 3 this changed the greedy policy of goal 1.2 from a return of 1 to one of -0.1" in PAGE


def test_found_changes_and_other_alarms_are_counted_from_the_spans(made, masks):
    adwin = masks["adwin"]
    others = {name: [float(span["return_before"]) for span in made.alarms(masks[name])] for name in masks}
    high = {name: sum(each >= 0.9 for each in returns) for name, returns in others.items()}

    found = [delay for delay in made.delays(adwin) if delay == delay]
    spans = made.groups(made.read(made.SPANS), *RUN)
    missed = [
        (line, 384_000 * place)
        for line in adwin
        for place, delay in enumerate(line["delays"].split(), 1)
        if delay == "-"
    ]
    for line, change in missed:
        [within] = [s for s in spans[tuple(line[k] for k in RUN)] if int(s["start"]) < change < int(s["end"])]
        assert within["learned"] == "False"

    assert (len(found), len(missed), max(found)) == (31, 4, 9216)
    assert "ADWIN has an alarm within 9,216 frames of 31 of the 35 changes. The other four came while labels" in PAGE
    false = {
        name: round(sum(float(line["false_alarms"]) * int(line["frames"]) / PER for line in masks[name]))
        for name in ("adwin", "swoks", "swoks, fresh")
    }
    assert high["adwin"] == false["adwin"] == len(others["adwin"]) == 16
    assert "All its 16 other alarms are false, and came while the return was at least 0.9" in PAGE
    assert sorted(line["labels_per_task"] for line in adwin) == ["1.0"] * 4 + ["1.25"]
    soon = " or ".join(str(made.soon(masks[name])) for name in ("swoks", "swoks, fresh"))
    chance = [1 - exp(-len(others[name]) / (5 * 8 * 384_000) * 65_536) for name in ("swoks", "swoks, fresh")]
    said = " or ".join(f"{100 * each:.0f} %" for each in chance)
    assert (
        f"SWOKS finds {soon} of 35 changes within 65,536 frames; alarms at random times would find {said} of the"
        in PAGE
    )
    for name, share in zip(("swoks", "swoks, fresh"), chance, strict=True):
        assert made.soon(masks[name]) / 35 > 2 * share
        assert f"| {made.soon(masks[name])} of 35; {100 * share:.0f} % |" in PAGE
    number = {name: len(returns) for name, returns in others.items()}
    both = [of["swoks"] + of["swoks, fresh"] for of in (number, false)]
    said = f"Of its {both[0]} other alarms {both[1]} are false and {both[0] - both[1]} late."
    assert said in PAGE
    fresh, published = ([of[name] for of in (false, number, high)] for name in ("swoks, fresh", "swoks"))
    assert (
        f"SWOKS: with fresh trials {fresh[0]} of its {fresh[1]} other alarms are false, and {fresh[2]} came while"
        in PAGE
    )
    assert f"With published ones they are {published[0]} and {published[2]} of {published[1]}." in PAGE
    assert soon == "17 or 18" and "it finds half of the changes that images do not show" in PAGE  # of 35

    ends = {name: [float(line["average_performance"]) for line in masks[name]] for name in ("adwin", "swoks")}
    assert len(ends["adwin"]) == 5
    announced = [float(line["average_performance"]) for line in masks["announced"]]
    adwin = f"ends at a mean return of {min(ends['adwin']):.2f} with the detector ADWIN"
    in_table = f"{sum(ends['swoks']) / 5:.2f} [0.21, 0.79]"
    assert f"| SWOKS, published trials | {in_table} |" in PAGE
    swoks = f"{in_table} with the detector SWOKS (5 seeds)"
    assert f"{adwin}, {min(announced):.2f} with announced tasks, and {swoks}" in README


def test_amd_finds_the_changed_transition_and_forgets_nothing(made):
    pair = made.finished()["dick2020_pair", "51200"]

    assert [
        (line["delays"], line["false_alarms"], line["labels_per_task"], line["final_returns"]) for line in pair["amd"]
    ] == [("14336", "0.0", "1.0", "1 1")] * 5
    for name in ("swoks", "adwin"):
        assert {line["delays"] for line in pair[name]} == {"6144"}  # to the end of the batch, at 57,344
        assert {(line["frames_rolled_back"], line["final_returns"]) for line in pair[name]} == {("49152.0", "0 0")}
    assert "one alarm in each of five seeds, 14,336 frames after the change" in PAGE
    assert "which undoes all 49,152 frames that were learned from" in PAGE


def test_with_longer_stays_all_detectors_keep_both_graphs_at_their_price(made):
    long = made.finished()["dick2020_pair", "204800"]

    assert {line["final_returns"] for name in ("amd", "swoks, fresh", "adwin") for line in long[name]} == {"1 1"}
    assert (
        "With stays of 204,800 frames SWOKS and ADWIN, too, end with a return of 1 on both tasks in all seeds" in PAGE
    )
    for name in ("swoks, fresh", "adwin"):
        for key in ("frames_not_learned", "frames_rolled_back"):
            assert {round(float(line[key]) / float(line["frames"]), 2) for line in long[name]} == {0.1}
    assert "A tenth of the frames is not learned from, and a tenth undone" in PAGE
    free = {(line["frames_not_learned"], line["frames_rolled_back"], line["delays"]) for line in long["amd"]}
    assert free == {("0.0", "0.0", "16384")} and "pays with its delay of two batches only" in PAGE


def test_what_is_said_of_ewc_on_new_images_is_what_the_pairs_show(made):
    from studies.lifelong.pairs import of_pairs

    from ctgraph_rl.report.statistics import holm

    ends = {
        (name, place, line["seed"]): float(line["average_performance"])
        for place in made.IMAGES
        for name, lines in made.finished()[place, "204800"].items()
        for line in lines
    }
    names = {name for name, *_ in ends}
    pairs = {pair: of_pairs(ends, *pair) for pair in made.COMPARED if {*pair} <= names}
    clear = dict(zip(pairs, holm([each.p_value for each in pairs.values()]), strict=True))

    assert {pair for pair, p in clear.items() if p <= 0.05} == {("oracle", "none")}
    assert pairs["oracle", "none"].difference.value > 0
    assert (
        "With the oracle's boundaries EWC ends higher than fine-tuning. With those of SWOKS or ADWIN 20 pairs" in PAGE
    )
    less = pairs["announced", "oracle"].difference.value
    assert clear["announced", "oracle"] > 0.05
    assert re.search(
        rf"20 pairs cannot say whether the difference at the end, {less:.2f} \[.*\] \(\d+ pairs would do\), is chance",
        PAGE,
    )
    runs = {name: made.on_images(name) for name in ("swoks, fresh", "adwin", "oracle")}
    shares = [
        float(value(runs[name], "frames_not_learned")) / float(value(runs[name], "frames"))
        for name in ("swoks, fresh", "adwin")
    ]
    assert all(0.22 < share < 0.28 for share in shares) and "About a quarter of the frames is not learned" in PAGE
    found = [made.soon(lines) for lines in runs.values()]
    assert f"SWOKS finds {found[0]} of 60 soon, ADWIN {found[1]}." in PAGE and found[2] == 60
    chance = [1 - exp(-len(made.alarms(runs[name])) / (20 * 819_200) * 65_536) for name in ("swoks, fresh", "adwin")]
    said = " and ".join(f"{100 * each:.0f} %" for each in chance)
    assert f"By chance their other alarms would find {said}." in PAGE
    assert all(number / 60 > 2 * share for number, share in zip(found, chance, strict=False))
    swoks, adwin, oracle = (value(lines, "online_return") for lines in runs.values())
    assert f"the online return is {swoks} (SWOKS) and {adwin} (ADWIN), with the oracle {oracle}." in PAGE
    assert {line["label_agreement"] for line in runs["oracle"]} == {"1.0"}
