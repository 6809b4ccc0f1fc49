"""Tables of several measures, and what is left out of them."""

from __future__ import annotations

import json
import sys
from dataclasses import replace

import pytest
from helpers.made_runs import all_runs, line, make_run

from ctgraph_rl.report import formats, results
from ctgraph_rl.report.results import selected, table
from ctgraph_rl.runs.read import grouped

pytest.importorskip("scipy")


def test_one_fingerprint_is_one_curriculum_though_one_name_says_modified(tmp_path):
    make_run(tmp_path, 0)
    make_run(tmp_path, 1, curriculum="two (modified)")

    row = line(table(all_runs([tmp_path])), "average_performance")

    assert (row.curriculum, row.estimate.n) == ("two", 2)


def test_five_measures_are_shown_and_of_the_gap_of_memory_and_against_experts_those_that_have_a_value(tmp_path):
    path = make_run(tmp_path, 0)
    always = ["average_performance", "forward_transfer", "backward_transfer", "forgetting"]
    at_the_end = ["solved_rate"]
    first = [row.measure for row in selected(table(all_runs([path])))]
    scores = json.loads((path / "metrics.json").read_text())
    for name, value in (
        ("memory_gap_closed", 0.5),
        ("relative_performance", 1.5),
        ("sample_efficiency", None),
        ("regret", 2.0),
    ):
        scores[name] = {"value": value, "definition": name, "undefined": None if value else "no experts were given"}
    (path / "metrics.json").write_text(json.dumps(scores))

    make_run(tmp_path, 0, curriculum="other")

    rows = table(all_runs([path]))
    both = selected(table(all_runs([tmp_path])))

    assert first == [*always, *at_the_end]
    assert [row.measure for row in selected(rows)] == [
        *always,
        "memory_gap_closed",
        "relative_performance",
        *at_the_end,
    ]
    assert [row.measure for row in both if row.curriculum == "other"] == [*always, *at_the_end]
    assert [row.measure for row in selected(rows, ["solved", "regret"])] == ["regret", "solved goal1", "solved goal2"]


def test_an_unknown_measure_names_a_near_one_and_how_to_have_one_of_ones_own(tmp_path):
    make_run(tmp_path, 0)
    rows = table(all_runs([tmp_path]))
    own = (
        "to have one of your own, import its module in your agent's module or training script, and run again "
        "(docs/how-to/own_metric.md)"
    )

    with pytest.raises(ValueError) as unknown:
        selected(rows, ["accuracy", "forgetting"])
    with pytest.raises(ValueError) as misspelt:
        selected(rows, ["forgeting"])

    few = ", ".join(dict.fromkeys(row.kind for row in rows[:2]))
    count = len({row.kind for row in rows})
    assert (
        str(unknown.value)
        == f"no run has a measure 'accuracy': there are {count}, such as {few}; --all shows them; {own}"
    )
    assert str(misspelt.value) == f"no run has a measure 'forgeting': did you mean forgetting?; {own}"


def test_tables_for_papers_have_a_line_for_each_measure(tmp_path):
    for seed in range(2):
        make_run(tmp_path, seed, (seed / 2, 1.0), curriculum="a_b", name="ppo|x")
    rows = selected(table(all_runs([tmp_path])), ["backward_transfer", "forward_transfer"])

    page = formats.markdown(rows).splitlines()
    paper = formats.latex(rows).splitlines()

    assert page[0] == "### a_b" and page[4] == "| agent | measure | over seeds | n | note |"
    assert page[6:] == [
        "| PPO | forward transfer | 0.00 | 2 | 1 |",
        "| PPO | backward transfer | -0.75 [-3.93, 2.43] | 2 |  |",
        *("", "1. all seeds are equal: no spread to estimate"),
    ]
    assert [line for line in paper if line.startswith(("PPO", " & ", r"\caption"))] == [
        r"\caption{a\_b: mean {[}95 \% CI]; about 95 or more of 100 such intervals (CI) hold the true mean; "
        r"intervals of solved seeds and of median times are exact; "
        r"n: seeds with a value / seeds expected.}",
        r"PPO & 2 & 0.00\rlap{\textsuperscript{a}} & $-$0.75 \\",
        r" &  &  & {\scriptsize [$-$3.93, 2.43]} \\",
    ]
    assert r"\textsuperscript{a} all seeds are equal: no spread to estimate" in "\n".join(paper)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--difference", "0.1"], "give both"),
        (["--compare", "regret", "--difference", "0"], "difference must be a number > 0"),
    ],
)
def test_a_difference_that_means_nothing_is_refused_before_the_table(tmp_path, monkeypatch, capsys, arguments, message):
    make_run(tmp_path, 0)
    monkeypatch.setattr(sys, "argv", ["results", str(tmp_path), *arguments])

    with pytest.raises(SystemExit):
        results.main()

    said = capsys.readouterr()
    assert message in said.err
    assert said.out == ""


def test_what_is_left_out_is_named_after_the_table_with_exit_code_1(tmp_path, monkeypatch, capsys):
    make_run(tmp_path, 0)
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "run.jsonl").write_text("step,reward\n")
    monkeypatch.setattr(sys, "argv", ["results", str(tmp_path)])

    with pytest.raises(SystemExit) as end:
        results.main()

    said = capsys.readouterr()
    assert end.value.code == 1
    assert "average performance  0.75  n = 1" in said.out
    assert said.err.startswith(f"left out: {tmp_path / 'foreign' / 'run.jsonl'} does not say what was run")


def test_html_and_pipes_of_a_name_are_text_in_a_markdown_table(tmp_path):
    path = make_run(tmp_path, 0, curriculum="<b>x|y")

    page = formats.markdown(table(all_runs([path])))

    assert page.startswith("### &lt;b&gt;x\\|y\n")
    assert "<b>" not in page


def calls_of(function, *arguments) -> int:
    """How many functions are called, in Python and in C."""
    calls = 0

    def count(frame, event, argument):
        nonlocal calls
        calls += event in ("call", "c_call")

    sys.setprofile(count)
    try:
        function(*arguments)
    finally:
        sys.setprofile(None)
    return calls


def test_many_configurations_are_named_in_work_that_grows_with_their_number(tmp_path):
    first = all_runs([make_run(tmp_path, 0, gamma=0)])[0]
    runs = [replace(first, settings={**first.settings, "agent.gamma": number}) for number in range(400)]

    few, many = calls_of(grouped, runs[:100]), calls_of(grouped, runs)

    assert many < 5 * few
    assert list(grouped(runs))[399] == ("two", "PPO gamma=399")


def test_the_table_on_a_terminal_has_80_columns_with_every_measure_and_long_notes(tmp_path):
    for seed, performance in enumerate(((0.25, 1.0), (1.0, 0.5))):
        path = make_run(tmp_path, seed, performance)
        scores = json.loads((path / "metrics.json").read_text())
        scores["continual_world_forward_transfer"] = {"value": -seed, "definition": "x", "undefined": None}
        (path / "metrics.json").write_text(json.dumps(scores))
    make_run(tmp_path, 2, finished=False)

    lines = formats.text(table(all_runs([tmp_path]))).splitlines()

    assert max(map(len, lines)) <= 80
    assert any(line.startswith("    continual world forward transfer") for line in lines)
