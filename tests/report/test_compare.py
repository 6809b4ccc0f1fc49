"""``ctgraph-rl compare``: what it says of two runs, and its exit code."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest
import torch
from helpers.made_runs import write_run

from ctgraph_rl import cli
from ctgraph_rl.log.files import AGENT, LOG
from ctgraph_rl.log.provenance import NUMBERS

DOUBLED_LIST: list = []
for _ in range(60):
    DOUBLED_LIST = [DOUBLED_LIST, DOUBLED_LIST]


@pytest.fixture
def pair(tmp_path) -> tuple[Path, Path]:
    """Two equal runs with agents."""
    runs = tmp_path / "A", tmp_path / "B"
    for run in runs:
        write_run(run)
        torch.save({"weight": torch.tensor([1.0, -0.0]), "steps": 3}, run / AGENT)
    return runs


@pytest.fixture
def said(monkeypatch, capsys):
    """Calls the command: its exit code, its lines and its error."""

    def call(*words: object) -> tuple[int, list[str], str]:
        monkeypatch.setattr(sys, "argv", ["ctgraph-rl", "compare", *map(str, words)])
        with pytest.raises(SystemExit) as end:
            cli.main()
        out, err = capsys.readouterr()
        return end.value.code, out.splitlines(), err

    return call


def change(run: Path, number: int, **values: object) -> None:
    """Change fields of a line of a run's log, counted from 0."""
    lines = [json.loads(line) for line in (run / LOG).read_text().splitlines()]
    lines[number].update(values)
    (run / LOG).write_text("".join(json.dumps(line) + "\n" for line in lines))


def test_equal_runs_are_equal_whatever_time_they_took(pair, said):
    change(pair[1], 5, seconds=99.0)

    code, lines, _ = said(*pair)

    assert code == 0
    assert lines == [
        "equal: all 10 measurements, bit for bit",
        "weights: equal, bit for bit",
        *(f"{part}: equal" for part in ("settings", "curriculum", "machine", "code")),
    ]


def test_rounding_is_told_from_a_difference_by_the_bound_and_the_first_divergence_is_named(pair, said):
    change(pair[1], 4, return_mean=1.00005)
    change(pair[1], 6, return_mean=0.00005)
    where = "training in block 1 after 1,000 frames: return_mean 1.0 and 1.00005"

    code, [verdict, *_], _ = said(*pair)
    assert code == 3
    assert verdict == (
        f"equal up to rounding: all measurements agree within 0.0001 of their field's largest value; "
        f"they diverge at {where}"
    )

    code, [verdict, *_], _ = said(*pair, "--bound", "4e-5")
    assert (code, verdict) == (1, f"different since {where}")


def test_a_difference_after_rounding_is_named_too(pair, said):
    change(pair[1], 4, return_mean=1.00005)
    change(pair[1], 6, return_mean=0.5)

    code, [verdict, *_], _ = said(*pair)

    assert code == 1
    assert verdict == (
        "different since training in block 1 after 1,000 frames: return_mean 1.0 and 1.00005; "
        "beyond rounding (0.0001) at evaluation of goal2 in block 1 after 1,000 frames"
    )


def test_counts_are_never_rounded(pair, said):
    change(pair[0], 3, episodes=1_000_000)
    change(pair[1], 3, episodes=1_000_001)

    assert said(*pair)[0] == 1


@pytest.mark.parametrize("weight", [[1.0, 0.0], [1.0], [1.0, 2.0]])
def test_weights_are_compared_bit_by_bit(pair, said, weight):
    torch.save({"weight": torch.tensor(weight), "steps": 3}, pair[1] / AGENT)

    code, lines, _ = said(*pair)

    assert code == 1
    assert lines[:2] == [
        "different: all measurements are equal, the agents' weights are not",
        "weights: different in 1 of 2 parts: weight",
    ]


def test_a_run_that_ends_earlier_is_different(pair, said):
    log = pair[1] / LOG
    log.write_text("".join(log.read_text().splitlines(keepends=True)[:-2]))

    code, [verdict, *_], _ = said(*pair)

    assert (code, verdict) == (1, "different: equal as far as both go, 8 of 10 and 8 lines")


def test_other_settings_code_and_machines_are_named(pair, said):
    about = json.loads((pair[1] / LOG).read_text().splitlines()[0])
    settings = {**about["config"], "seed": 1, "portable": True}
    change(pair[1], 0, config=settings, machine="arm", num_threads=2, fingerprint="g", numbers=7, source="x")
    (pair[1] / AGENT).unlink()

    code, lines, _ = said(*pair)

    assert code == 0
    assert lines[1:] == [
        f"weights: not compared, {pair[1]} has no agent.pt",
        "settings: different, portable False and True, seed 0 and 1",
        "curriculum: different, fingerprint 'f' and 'g', source 'a test' and 'x'",
        "machine: different, machine 'x86_64' and 'arm', num_threads 1 and 2",
        f"code: different, numbers {NUMBERS} and 7",
    ]


def test_what_is_no_run_is_an_error(pair, said, tmp_path):
    code, _, error = said(pair[0], tmp_path / "none")

    assert code == 2 and f"{tmp_path / 'none'} holds no run: there is no such directory; name a run directory" in error
    assert said(*pair, "--bound", "0")[0] == 2


ODD_WEIGHTS = {
    "no state": (torch.ones(2), "holds no state of an agent: restore it"),
    "torn": (b"xx", "or is torn: restore it"),
    "a list in many places": ({"a": DOUBLED_LIST}, "has more parts than its"),
    "a tensor of strides 0": ({"a": torch.ones(1).expand(2**40)}, "has tensors of 4,398,046,511,104 bytes, the limit"),
}


@pytest.mark.parametrize("case", ODD_WEIGHTS)
def test_weights_that_no_agent_saved_are_one_message(pair, said, case):
    weights, message = ODD_WEIGHTS[case]
    for run in pair:
        (run / AGENT).write_bytes(weights) if isinstance(weights, bytes) else torch.save(weights, run / AGENT)

    code, _, error = said(*pair)

    assert code == 2 and str(pair[0] / AGENT) in error and message in error


def test_weights_are_read_from_a_regular_file(pair, said):
    (pair[0] / AGENT).unlink()
    os.mkfifo(pair[0] / AGENT)

    assert "agent.pt must be a regular file" in said(*pair)[2]


def test_parts_of_other_types_are_different(pair, said):
    torch.save({"weight": 1.0, "steps": torch.ones(2)}, pair[0] / AGENT)

    assert said(*pair)[1][1] == "weights: different in 2 of 2 parts: weight, steps"


def test_seeds_that_experts_were_trained_with_are_named_and_are_no_measurement(pair, said):
    change(pair[0], 1, kind="experts", experts=[{"task": 1, "run": "x", "together": [0, 1]}])
    change(pair[1], 1, kind="experts", experts=[{"task": 1, "run": "x"}])

    code, lines, _ = said(*pair)

    assert code == 0 and lines[-1] == "seeds of experts trained together: different, task 1 [0, 1] and None"


def test_an_odd_list_of_experts_is_refused_with_its_line(pair, said):
    change(pair[0], 1, experts=[1])

    code, lines, error = said(*pair)

    assert (code, lines) == (2, [])
    assert "run.jsonl: line 2: experts must be a list of objects with a task" in error


def test_no_path_is_obeyed_by_a_terminal(pair, said, tmp_path):
    run = pair[0].rename(tmp_path / "\x1b[2J")
    (run / AGENT).unlink()

    assert "\x1b" not in "\n".join(said(run, pair[1])[1])
    assert "\x1b" not in said(run / "no", pair[1])[2]


def test_a_torn_last_line_is_told(pair, said):
    with (pair[1] / LOG).open("a") as file:
        file.write('{"kind": "trai')

    code, lines, _ = said(*pair)

    assert code == 0
    assert lines[-1] == f"note: the last line of {pair[1] / LOG} is torn and not compared"
