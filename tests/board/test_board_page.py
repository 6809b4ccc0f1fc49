"""docs/results/board.md: its tables and sentences are those of the submissions, and its command verifies one."""

from __future__ import annotations

import json
import re
import shutil
import sys
from statistics import fmean

import pytest
from helpers.paths import CHECKOUT

from ctgraph_rl import cli
from ctgraph_rl.board.standings.board_tables import BoardTable, tables
from ctgraph_rl.board.standings.entries import read_entries
from ctgraph_rl.board.submission import VERIFICATION, read_submission
from ctgraph_rl.log.provenance import machine
from ctgraph_rl.portable import cpu_model

for package in ("scipy", "jinja2"):
    pytest.importorskip(package)

pytestmark = pytest.mark.slow

RESULTS = CHECKOUT / "docs" / "results"
SUBMISSIONS = RESULTS / "board"
MOST_BYTES = 10 * 2**20
"""Of all submissions together; their logs are compressed, and git compresses the rest."""


@pytest.fixture(scope="module")
def made() -> list[BoardTable]:
    """The tables of the submissions."""
    entries, problems = read_entries([SUBMISSIONS])
    assert problems == []
    return tables(entries)


def test_the_page_is_that_of_the_submissions(made):
    from studies import board

    assert (RESULTS / "board.md").read_text(encoding="utf-8") == board.page(made)


def verifications() -> list[dict]:
    """What the verification of each submission found."""
    return [json.loads(path.read_text(encoding="utf-8")) for path in sorted(SUBMISSIONS.glob(f"*/{VERIFICATION}"))]


def test_the_page_names_the_tracks_without_a_line(made):
    sentence = re.search(r"No line yet: (.*)\.", (RESULTS / "board.md").read_text(encoding="utf-8"))
    without = re.findall(r"`(\w+)`", sentence[1]) if sentence else []
    there = {table.track.name for table in made}

    assert sorted([*there, *without]) == sorted(path.stem for path in (CHECKOUT / "conf" / "track").glob("*.yaml"))


def test_what_the_page_says_of_single_lines_holds(made):
    page = (RESULTS / "board.md").read_text(encoding="utf-8")
    alone = {(table.track.name, table.variant.rung): table for table in made if len(table.standings) == 1}
    deep = [alone["exploration", f"depth {depth}"] for depth in (5, 6, 7, 8)]
    reached = (
        "ten seeds of ten reach the goals of depth 5 and 6 after 102,400 frames, four that of depth 7 and none that"
    )
    assert f"{reached} of depth 8" in page
    assert [table.standings[0].entry.scores.count(1.0) for table in deep] == [10, 10, 4, 0]
    assert [table.standings[0].entry.scores.count(0.0) for table in deep] == [0, 0, 6, 10]
    assert {table.variant.curriculum.num_frames for table in deep} == {102_400}
    needed = f"{deep[1].ceilings['frames to the first reward of a random policy, on the hardest task']:,.0f}"
    assert f"A random policy needs {needed} for its first reward at depth 6" in page

    kept = alone["forgetting", ""].standings[0].entry
    assert "learns 76 of 80 tasks, all eight in seven of ten seeds, and forgets none" in page
    assert (8 * sum(kept.scores), kept.scores.count(1.0), set(kept.values["forgetting"])) == (76, 7, {0.0})

    growing = alone["growing_depth", "ct8_md"]
    assert "Mask LC learns all eight tasks, up to depth 5, in every seed, and forgets none" in page
    assert max(task.graph.depth for task in growing.variant.curriculum.tasks) == 5
    assert set(growing.standings[0].entry.scores) == {1.0}
    assert set(growing.standings[0].entry.values["forgetting"]) == {0.0}

    longer = alone["memory", "depth 2, expected length 30"].standings[0].entry
    returns = sorted(longer.values["average_performance"])
    assert "eight of ten seeds have the optimum with 30 steps, and the others 0.85 and 0.91" in page
    assert (returns[2:], [f"{value:.2f}" for value in returns[:2]]) == ([1.0] * 8, ["0.85", "0.91"])

    adapted = [f"{score:.2f}" for score in sorted(alone["adaptation", "depth 2"].standings[0].entry.scores)]
    assert "seven of ten seeds are at the best search, at 0.61 to 0.64, and three at 0.24 to 0.39" in page
    assert (adapted[0], adapted[2], adapted[3], adapted[-1]) == ("0.24", "0.39", "0.61", "0.64")
    assert f"{alone['adaptation', 'depth 2'].ceilings['best search for a goal that is not known']:.3f}" == "0.625"

    shared = alone["sharing", ""].standings[0].entry.scores
    assert "20 of 28 tasks in eight of ten seeds, 21 in two" in page
    assert sorted(round(28 * score, 6) for score in shared) == [20] * 8 + [21] * 2


def test_every_submission_is_verified_at_rerun_and_small(made):
    lines = [line for table in made for line in table.standings]

    assert len(lines) >= 20 and {line.entry.level for line in lines} == {"rerun"}
    assert {len(set(found["cells"])) for found in verifications()} <= {1, 2}
    assert sum(path.stat().st_size for path in SUBMISSIONS.rglob("*") if path.is_file()) < MOST_BYTES


def test_the_table_says_what_the_page_says_of_it(made):
    ranks = [(line.name, line.rank) for line in made[0].standings]

    assert {rank for _, rank in ranks[:10]} == {"1 to 10"}
    assert ranks[10:13] == [("PPO + MaskSC", "11 to 12"), ("PPO + CLEAR", "11 to 12"), ("PPO + CKA-RL", "13 to 18")]
    assert {(name, rank) for name, rank in ranks[13:]} == {
        (name, "13 to 18") for name in ("LSTM-PPO", "PPO with a count-based bonus", "REINFORCE", "A2C", "PPO")
    }
    assert max(fmean(line.entry.values["forgetting"]) for line in made[0].standings[:10]) < 0.05
    [mask_sc] = [line.entry for line in made[0].standings if line.name == "PPO + MaskSC"]
    assert set(mask_sc.values["forgetting"]) == {0.0} and fmean(mask_sc.scores) < 0.95
    page = " ".join((RESULTS / "board.md").read_text(encoding="utf-8").split())
    assert len(made[0].track.seeds) == 20 and "Ten keep nearly everything. 20 seeds cannot order them:" in page
    assert "CLEAR are behind them, then CKA-RL and agents without a method." in page
    assert "MaskSC forgets nothing, but does not learn every task." in page


def test_the_command_of_the_page_verifies_a_submission(tmp_path, monkeypatch):
    copy = shutil.copytree(SUBMISSIONS / "ppo", tmp_path / "ppo")
    (copy / VERIFICATION).unlink(missing_ok=True)
    run = read_submission(copy).runs[0]
    if (machine()["machine"], cpu_model()) != (run.machine, run.cpu):
        pytest.skip("other bits are possible on another kind of machine")
    words = ["verify", str(copy), "--cells", "1", "--number", "7", "--yes", "--folder", str(tmp_path / "reruns")]
    monkeypatch.setattr(sys, "argv", ["ctgraph-rl", *words])

    cli.main()

    found = json.loads((copy / VERIFICATION).read_text())
    assert (found["level"], len(found["cells"])) == ("rerun", 1)
