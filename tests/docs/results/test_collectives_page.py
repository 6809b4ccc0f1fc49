"""docs/results/collectives.md: made from the raw results beside it, and what it says of them holds."""

from __future__ import annotations

import csv
import math
import re
import statistics
from collections import defaultdict

import pytest
from helpers.paths import CHECKOUT

FOLDER = CHECKOUT / "docs" / "results"
LINES = (FOLDER / "collectives.md").read_text(encoding="utf-8").splitlines()
PAGE = " ".join(" ".join(LINES).split())
CELL = ("curriculum", "frames_of_block", "exchange", "num_members", "num_epochs")


@pytest.fixture(scope="module")
def made():
    from studies.collectives import page

    return page


def read(name: str, *keys: str) -> dict[tuple[str, ...], list[dict[str, str]]]:
    """Raw lines with equal values under some keys."""
    found = defaultdict(list)
    with open(FOLDER / f"{name}.csv", newline="", encoding="utf-8") as file:
        for line in csv.DictReader(file):
            found[tuple(line[key] for key in keys)].append(line)
    return found


def mean(values) -> float:
    values = list(values)
    return math.fsum(values) / len(values)


RUNS, BLOCKS = read("collectives", *CELL, "seed"), read("collective_blocks", *CELL, "seed")
OF_CELL = read("collectives", *CELL)


def l2d2c(num_members: int, epochs: int = 1, frames: int = 12_800, column: str = "learning_time") -> list[float]:
    lines = OF_CELL["l2d2c_16x16", str(frames), "l2d2c", str(num_members), str(epochs)]
    return [float(line[column]) for line in lines]


@pytest.mark.slow
def test_the_page_is_what_its_raw_results_make(made):
    assert made.page() == (FOLDER / "collectives.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("key", BLOCKS, ids="-".join)
def test_each_collective_is_one_line_and_its_numbers_are_those_of_its_blocks(key):
    [line], blocks = RUNS[key], BLOCKS[key]
    members, frames = int(line["num_members"]), int(line["frames_of_block"])
    per_member = len(blocks) // members
    places = {(int(block["member"]), int(block["block"])) for block in blocks}

    assert places == {(member, block) for member in range(members) for block in range(1, per_member + 1)}
    times = [int(block["frames_to_learn"] or frames) for block in blocks]
    assert float(line["learning_time"]) == pytest.approx(mean(times))
    solved = [int(block["frames_to_solve"]) for block in blocks if block["frames_to_solve"]]
    assert all(time % int(line["evaluated_every"]) == 0 and 0 < time <= frames for time in solved)
    assert float(line["share_learned"]) == pytest.approx(mean(block["frames_to_learn"] != "" for block in blocks))
    assert float(line["final_return"]) == pytest.approx(mean(float(b["final_return"]) for b in blocks), abs=1e-6)
    batch = {"l2d2c_16x16": 1280, "ct28_mosaic_skips_d5": 512}[key[0]]
    assert all(time % batch == 0 and batch <= time <= frames for time in times if time < frames)


def test_all_collectives_are_of_one_version_of_the_numbers():
    assert {line["numbers"] for [line] in RUNS.values()} == {"1"} and set(RUNS) == set(BLOCKS)


def test_members_of_l2d2c_learn_each_task_once_each_one_place_behind_the_one_before_it():
    for (curriculum, _, _, members, *_), blocks in BLOCKS.items():
        if curriculum != "l2d2c_16x16":
            continue
        of = defaultdict(dict)
        for block in blocks:
            of[int(block["member"])][int(block["block"])] = block["task"]
        for member in range(int(members)):
            order = [of[member][block] for block in range(1, 17)]
            assert len(set(order)) == 16
            assert order == [*list(of[0].values())[16 - member :], *list(of[0].values())[: 16 - member]]


def test_learners_alone_send_nothing_and_others_take_masks_over():
    for (_, _, exchange, members, *_), [line] in RUNS.items():
        shares = members != "1" and exchange != "isolated"
        assert (float(line["messages"]) > 0) == (float(line["helps"]) > 0) == (float(line["bytes"]) > 0) == shares


def solving_times(members: int, frames: int = 12_800) -> list[float]:
    """The mean frames until a task is solved for each seed, of collectives that were evaluated after each batch."""
    cell = ("l2d2c_16x16", str(frames), "l2d2c", str(members), "1")
    keys = [key for key, [line] in RUNS.items() if key[:5] == cell and line["evaluated_every"] == "1280"]
    return [mean(float(block["frames_to_solve"] or frames) for block in BLOCKS[key]) for key in keys]


def rows_of_l2d2c() -> dict[str, list[str]]:
    """Cells of the table of L2D2-C by members."""
    lines = LINES[LINES.index("## L2D2-C on 16 tasks") : LINES.index("## MOSAIC on nested goals")]
    rows = [line.strip("| ").split(" | ") for line in lines if line.startswith("| ")]
    return {row[0]: row[1:] for row in rows}


def test_a_row_has_the_means_over_its_seeds():
    rows, cells = rows_of_l2d2c(), [cell for cell in OF_CELL if cell[0] == "l2d2c_16x16" and cell[4] == "1"]
    assert len(rows) == len(cells) + 1  # the head

    for cell in cells:
        frames, members = int(cell[1]), int(cell[3])
        name = f"{members}" if frames == 12_800 else f"{members}, blocks of {frames:,} frames"
        row = rows[name]
        names = ("learning_time", "final_return", "helps", "bytes")
        times, final, helps, sent = (mean(l2d2c(members, 1, frames, column)) for column in names)
        blocks = [each for key, found in BLOCKS.items() if key[:5] == cell for each in found]

        assert int(row[0]) == len(l2d2c(members, 1, frames))
        assert row[1] == f"{sum(block['frames_to_solve'] != '' for block in blocks):,} of {len(blocks):,}"
        assert row[2].split(" [")[0] == f"{mean(solving_times(members, frames)):,.0f}"
        assert row[3].split(" [")[0] == f"{times:,.0f}"
        assert row[4].split(" [")[0] == f"{final:.2f}"
        assert row[5:] == [f"{helps / members:.1f}", f"{sent / members / 1e6:.1f}"]


def test_what_the_text_says_of_sharing_holds():
    alone, *shared = (mean(solving_times(members)) for members in (1, 4, 16))
    returns = [l2d2c(members, column="final_return") for members in (1, 4, 16)]

    assert f"a task takes {alone:,.0f} frames on average, {alone / shared[0]:.2f} [" in PAGE
    assert f"with 4 members and {alone / shared[1]:.2f} [" in PAGE
    assert f"More than {alone / 1280:.1f} times is not possible" in PAGE
    assert 3_000 < alone < 3_700 and l2d2c(1) == [12_800] * 5  # about a quarter of the frames, and none at all
    assert (
        "mean return of {:.2f} with one learner, {:.2f} with 4 members and {:.2f} with 16".format(*map(mean, returns))
        in PAGE
    )
    assert max(returns[0]) < min(returns[1]) and max(returns[1]) < min(returns[2])
    shares = [f"{mean(l2d2c(members, column='share_learned')):.0%}".replace("%", " %") for members in (4, 16)]
    assert f"one does in {shares[0]} of blocks, after {mean(l2d2c(4)):,.0f} frames on average" in PAGE
    assert f"with 16 in {shares[1]}, after {mean(l2d2c(16)):,.0f} frames" in PAGE
    assert f"in each block, after {mean(l2d2c(1, frames=25_600)):,.0f} frames." in PAGE
    assert set(l2d2c(1, frames=25_600, column="share_learned")) == {1}


def test_what_the_text_says_of_tasks_that_others_had_holds():
    new, known = [], []
    for members in (4, 16):
        of_kind = {True: [], False: []}
        for key, blocks in BLOCKS.items():
            for block in blocks if key[:5] == ("l2d2c_16x16", "12800", "l2d2c", str(members), "1") else ():
                earlier = [each for each in blocks if int(each["block"]) < int(block["block"])]
                of_kind[block["task"] in {each["task"] for each in earlier}].append(block)
        for kind, found in ((False, new), (True, known)):
            learned = sum(each["frames_to_learn"] != "" for each in of_kind[kind])
            assert learned == kind * len(of_kind[kind])
            final = mean(float(each["final_return"]) for each in of_kind[kind])
            found += [f"{final:.2f}", f"{learned} of {len(of_kind[kind])} blocks"]
        assert members == 4 or {each["block"] for each in of_kind[False]} == {"1"}

    first, second, third, fourth = new
    assert (second, fourth) == ("0 of 80 blocks", "0 of 80 blocks")
    assert f"4 members have a final return of {first} and 16 members of {third}, and no batch of 80 blocks each" in PAGE
    first, second, third, fourth = known
    assert f"other blocks they have {first} and {third}, and such a batch in {second} and {fourth}" in PAGE


def test_what_the_text_says_of_eight_epochs_holds():
    of_block = defaultdict(list)
    for key, blocks in BLOCKS.items():
        for block in blocks if key[2:5] == ("l2d2c", "16", "8") else ():
            of_block[int(block["block"])].append(float(block["final_return"]))
    final = [f"{mean(l2d2c(members, 8, column='final_return')):.2f}" for members in (1, 4, 16)]

    seeds = [str(len(l2d2c(members, 8))) for members in (1, 4, 16)]

    assert "With 8 epochs ({}, {} and {} seeds) the final".format(*seeds) in PAGE
    assert "return is {} with one learner, {} with 4 members and {} with 16".format(*final) in PAGE
    assert f"from {mean(of_block[2]):.2f} in the second block to {mean(of_block[16]):.2f} in the last" in PAGE


def of_mosaic(exchange: str, num_members: int, num_epochs: int = 1) -> list[dict[str, str]]:
    """The blocks of members that learn one task each."""
    cell = ("ct28_mosaic_skips_d5", "102400", exchange, str(num_members), str(num_epochs))
    return [block for key, blocks in BLOCKS.items() if key[:5] == cell for block in blocks]


def at(depth: int, blocks: list[dict[str, str]]) -> list[dict[str, str]]:
    return [block for block in blocks if len(block["task"].split(".")) == depth]


COLUMNS = [("isolated", 14), ("mosaic", 28), ("mosaic_no_similarity", 28)]


@pytest.mark.parametrize("depth", range(2, 10))
def test_a_depth_of_mosaic_has_the_means_of_its_members(depth):
    lines = LINES[LINES.index("## MOSAIC on nested goals") :]
    [row] = (line.strip("| ").split(" | ")[1:] for line in lines if line.startswith(f"| {depth} |"))

    for shown, column in zip(row, COLUMNS, strict=True):
        returns = [float(block["final_return"]) for block in at(depth, of_mosaic(*column))]
        assert shown.split("; ")[-1].split(" [")[0] == f"{mean(returns):.2f}"


PUBLISHED = {"isolated": (9.5, 1.0), "MOSAIC": (25.7, 0.8), "MOSAIC without similarity": (19.9, 0.0)}


def test_a_sum_of_returns_is_that_of_all_members_and_differs_from_the_published_one_as_stated():
    start = LINES.index("| members | exchange | seeds | sum of final returns | published | difference |") + 2
    rows = [line.strip("| ").split(" | ") for line in LINES[start : LINES.index("", start)]]
    assert len(rows) >= 5

    for members, name, seeds, shown, _, *difference in rows:
        exchange = name.lower().replace(" without ", "_no_")
        halves = exchange == "isolated" and members == "28"
        sums = defaultdict(list)
        for block in of_mosaic(exchange, 14 if halves else int(members)):
            sums[int(block["seed"]) % 14_000].append(float(block["final_return"]))
        first_half = exchange == "isolated" and members == "14"
        found = [math.fsum(each[:14] if first_half else each) for each in sums.values()]
        found = [each for each, of in zip(found, sums.values(), strict=True) if first_half or len(of) == int(members)]
        assert (seeds, shown.split(" [")[0]) == (str(len(found)), f"{mean(found):.2f}")
        if members == "28" and len(found) == 5:
            value, half = PUBLISHED[name]
            ours, theirs = statistics.variance(found) / 5, (half / 2.7764) ** 2
            freedom = (ours + theirs) ** 2 / ((ours**2 + theirs**2) / 4)
            quantile = {4: 2.7764, 5: 2.5706, 6: 2.4469, 7: 2.3646, 8: 2.3060}
            low, high = quantile[min(8, math.floor(freedom) + 1)], quantile[math.floor(freedom)]
            [error] = [(top - bottom) / 2 for bottom, top in [map(float, difference[0].split("[")[1][:-1].split(", "))]]
            assert float(difference[0].split(" [")[0]) == pytest.approx(mean(found) - value, abs=0.06)
            assert low * math.sqrt(ours + theirs) - 0.06 <= error <= high * math.sqrt(ours + theirs) + 0.06


def test_the_first_verdicts_on_mosaic_are_those_of_its_intervals():
    rows = re.findall(r"^\| 28 \| ([^|]+) \| 5 \|.*\[([+-][\d.]+), ([+-][\d.]+)\] \|$", "\n".join(LINES), re.MULTILINE)
    found = {name: float(low) <= 0 <= float(high) for name, low, high in rows}

    assert found == {"isolated": True, "MOSAIC": False, "MOSAIC without similarity": False}
    assert "those of MOSAIC, with and without similarity, differ." in PAGE


def test_goals_that_are_learned_in_no_seed_are_named():
    for exchange, before in (("mosaic", "with MOSAIC, "), ("mosaic_no_similarity", "and without similarity ")):
        best = defaultdict(float)
        for block in of_mosaic(exchange, 28):
            best[int(block["member"])] = max(best[int(block["member"])], float(block["final_return"]))
        tasks = {int(block["member"]): block["task"] for block in of_mosaic(exchange, 28)}
        named = ", ".join(f"`{tasks[member].removeprefix('goal')}`" for member in sorted(best) if best[member] < 0.5)
        assert before + named in PAGE


def test_the_depth_at_which_sums_differ_most_is_named():
    published = (1.0, 0.99, 0.98, 0.95, 0.97, 0.91, 0.74, 0.58)
    apart = {}
    for depth in range(2, 10):
        returns = defaultdict(list)
        for block in at(depth, of_mosaic("mosaic", 28)):
            returns[block["seed"]].append(float(block["final_return"]) - published[depth - 2])
        apart[depth] = mean(map(sum, returns.values()))
    most = max(apart, key=lambda depth: abs(apart[depth]))

    assert f"published one at depth {most}, by {apart[most]:+.1f}." in PAGE


def test_what_the_text_says_of_epochs_holds():
    for num_epochs in (8, 1):
        blocks = of_mosaic("isolated", 14, num_epochs)
        shares = [float(block["share_below"]) for block in blocks if block["share_below"]]
        members = f"{mean(shares):.2f}"
        assert members in PAGE and f"{len(shares)} members)" in PAGE
    alone = [
        [float(each["share_below"]) for each in of_mosaic("isolated", 14, n) if each["share_below"]] for n in (1, 8)
    ]
    assert mean(alone[0]) < mean(alone[1]) / 2
