"""Names, labels, sources, settings and reasons of strangers are text in every output."""

from __future__ import annotations

import csv
import io
import json
import math
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from helpers.made_runs import write_run
from hypothesis import given, settings
from hypothesis import strategies as st
from markdown_it import MarkdownIt
from rich.console import Console

import curricula
from ctgraph_rl import RunLog, describe
from ctgraph_rl.draw.curriculum_figure import draw_graphs
from ctgraph_rl.draw.dot import to_dot
from ctgraph_rl.log import escape
from ctgraph_rl.log.tables import write_tables
from ctgraph_rl.report import formats, results
from ctgraph_rl.report.figures.gallery import Gallery
from ctgraph_rl.report.page import write_report
from ctgraph_rl.report.style import short
from ctgraph_rl.report.terminal import print_summary
from ctgraph_rl.runs.read import find_runs
from ctgraph_rl.runs.status import FAILED, Status, report

PARTS = [
    *("\\input{/etc/passwd}", "\n\\write18{id}", "$x$", "%", "^^M", "&", "{", "}", "~", "#", '"', "\\\\", "* [2cm]"),
    *("![t](http://evil.example/x)", "[a](javascript:alert(1))", "<img src=x>", "<!--", "]]>", "&lt;", "|", "`", "**"),
    *("http://evil.example", "www.evil.example", "me@evil.example", "__a__", "~~~", "[a]: http://b", "# ", "- ", "1. "),
    *('=HYPERLINK("http://evil.example")', "+1", "-1", "@SUM(1)", "\t", "\r", "'", "\0", "\n", ","),
    *(
        "\x1b[2J",
        "\x1b]0;t\x07",
        "\x9b2J",
        "\x7f",
        "\u202e",
        "\u2066",
        "\ufeff",
        "\u2028",
        "\ud800",
        "\udfff",
        "é",
        "🙂",
    ),
    *("a", "B", "_", "0", " ", "/", "../", "{{ 1 }}", "{% x %}", "</title>", "$\\frac{$", "[red]", "=", "---"),
]
"""What means something somewhere."""

NAMES = st.one_of(
    st.lists(st.sampled_from(PARTS), min_size=1, max_size=6).map("".join), st.text(min_size=1, max_size=30)
)

CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
"""What a terminal obeys, but for the end of a line and a tab; and what no file in UTF-8 holds."""

MARKDOWN = MarkdownIt("commonmark").enable("table").enable("strikethrough")


@settings(deadline=None)
@given(NAMES)
def test_a_terminal_gets_one_line_without_controls(name):
    line = escape.terminal_text(name)

    assert line.isprintable() and line.encode() is not None
    assert escape.terminal_text(line) == line
    assert not CONTROL.search(escape.terminal_lines(name))


@given(NAMES)
@settings(max_examples=50, deadline=None)
def test_markdown_shows_a_name_as_text(name):
    shown = escape.markdown_text(name)

    tokens = MARKDOWN.parse(shown)
    inline = [child for token in tokens for child in token.children or ()]
    assert {token.type for token in tokens} <= {"paragraph_open", "inline", "paragraph_close"}
    assert {child.type for child in inline} <= {"text"}
    assert "".join(child.content for child in inline) == escape.terminal_text(name)


@given(NAMES, NAMES)
@settings(max_examples=50, deadline=None)
def test_a_cell_of_a_markdown_table_is_one_cell(name, other):
    row = f"| {escape.markdown_text(name)} | {escape.markdown_text(other)} |"

    tokens = MARKDOWN.parse(f"| a | b |\n|---|---|\n{row}\n")

    cells = [tokens[i + 1] for i, token in enumerate(tokens) if token.type == "td_open"]
    texts = ["".join(child.content for child in cell.children or ()) for cell in cells]
    assert texts == [escape.terminal_text(name), escape.terminal_text(other)]


KNOWN_TO_LATEX = re.compile(
    r"\\[&%$#_{}]|\\text(backslash|asciitilde|asciicircum|less|greater|bar|quotedbl)\{\}|\{\[\}|\{\*\}|\$\\pm\$"
)


@settings(deadline=None)
@given(NAMES)
def test_latex_gets_no_command_and_no_special_character(name):
    left = KNOWN_TO_LATEX.sub("", escape.latex_text(name))

    assert not re.search(r'[\\&%$#_{}~^<>|"\[*\n]', left)


@settings(deadline=None)
@given(
    st.lists(st.lists(st.one_of(NAMES, st.sampled_from([0.5, -1.0]), st.none()), min_size=2, max_size=4), min_size=1)
)
def test_csv_starts_no_formula_and_is_read_back(rows):
    plain = [[escape.utf8_text(value) for value in row] for row in rows]

    read = list(csv.reader(io.StringIO(escape.csv_text(plain), newline="")))

    for row, cells in zip(plain, read, strict=True):
        for value, cell in zip(row, cells, strict=True):
            if isinstance(value, str):
                assert not cell.startswith(("=", "+", "-", "@", "\t", "\r"))
                assert cell.removeprefix(escape.MARK) == value
            else:
                assert cell == ("" if value is None else repr(value))


def test_a_number_in_csv_is_a_number_and_a_text_that_looks_like_one_is_guarded():
    numbers = [-1e-05, -0.0, -3, -0.05, float("-inf"), np.float64(-2.5)]

    (read,) = csv.reader(io.StringIO(escape.csv_text([[*numbers, "-3", "-1e-05"]]), newline=""))

    assert list(map(float, read[:6])) == numbers and math.copysign(1, float(read[1])) == -1
    assert read[6:] == ["'-3", "'-1e-05"]


@given(NAMES)
@settings(max_examples=15, deadline=None)
def test_a_figure_draws_any_name(name):
    from matplotlib.figure import Figure

    figure = Figure(figsize=(1, 1))
    drawn = [figure.text(0, 0, text(name)) for text in (escape.figure_text, short)]
    figure.canvas.draw()
    figure.savefig(io.BytesIO(), format="svg")

    assert not any(one.get_parse_math() and one._preprocess_math(one.get_text())[1] == True for one in drawn)  # noqa: E712


WORST = "".join(PARTS).replace("\ud800\udfff", "\ud800x\udfff")
HEADS = ("=x", "\x1b[31m", "\ud800", "![t](http://evil.example/x)", "\n\\input{x}", "<script>alert(1)</script>")


class Elements(HTMLParser):
    """The elements and attributes of a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[tuple[str, ...]] = []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, *(key for key, _ in attrs)))


def hostile_run(path: Path, *, name: str, agent: str, labels: tuple[str, str], source: str) -> Path:
    run = write_run(path, curriculum=(name, "f"), agent="PPO", labels=labels)
    first, *others = (run / "run.jsonl").read_text().splitlines()
    about = json.loads(first)
    about["source"], about["machine"] = source, source
    about["config"] |= {"agent": {"_target_": f"x.{agent.replace('.', '')}", source: source}}
    about["versions"] = {source: source}
    (run / "run.jsonl").write_text("\n".join([json.dumps(about), *others]) + "\n")
    return run


def outputs(folder: Path, run: Path) -> dict[str, str]:
    """What every command makes of a run, by kind."""
    folder.mkdir()
    found, _ = find_runs([run])
    rows = results.table(found)
    results.write_csv(folder / "results.csv", rows)
    write_report([run], folder / "report")
    console = Console(file=io.StringIO(), width=500, force_terminal=False)
    print_summary(run, console)
    return {
        "html": (folder / "report" / "report.html").read_text(),
        "markdown": (folder / "report" / "report.md").read_text() + "\n\n" + formats.markdown(rows),
        "latex": (folder / "report" / "tables.tex").read_text() + formats.latex(rows),
        "csv": (folder / "results.csv").read_bytes().decode(),
        "terminal": formats.text(rows) + console.file.getvalue(),
    }


@pytest.fixture
def no_figures(monkeypatch):
    monkeypatch.setattr(Gallery, "write", lambda self, names, figures: [])


def check(made: dict[str, str], plain: dict[str, str]) -> None:
    """Compare what was made of names with what is made of plain ones."""
    assert Elements(made["html"]).found == Elements(plain["html"]).found
    kinds = [{token.type for token in MARKDOWN.parse(each["markdown"])} for each in (made, plain)]
    inline = [
        {child.type for token in MARKDOWN.parse(each["markdown"]) for child in token.children or ()}
        for each in (made, plain)
    ]
    assert (kinds[0], inline[0]) == (kinds[1], inline[1])
    commands = [set(re.findall(r"\\[a-zA-Z]+", each["latex"])) for each in (made, plain)]
    assert commands[0] <= commands[1] | set(re.findall(r"\\text[a-z]+", made["latex"]))
    assert all(
        not cell.startswith(("=", "+", "@", "\t")) for row in csv.reader(io.StringIO(made["csv"])) for cell in row
    )
    for each in ("html", "markdown", "latex", "terminal"):
        assert not CONTROL.search(made[each]), each


def test_no_output_obeys_a_name_of_a_run(tmp_path, no_figures):
    names = {"name": "two", "agent": "A", "labels": ("goal1", "goal2"), "source": "x"}
    plain = outputs(tmp_path / "plain", hostile_run(tmp_path / "a", **names))

    for which in names:
        hostile = (WORST, "=1" + WORST) if which == "labels" else WORST
        made = outputs(tmp_path / which, hostile_run(tmp_path / f"of {which}", **{**names, which: hostile}))

        check(made, plain)


def test_figures_and_tables_are_made_of_hostile_names(tmp_path):
    labels = tuple(f"{head}{i}" for i, head in enumerate(HEADS[:2]))
    run = hostile_run(tmp_path / "run", name=WORST, agent=WORST, labels=labels, source=WORST)

    write_report([run], tmp_path / "report")
    write_tables(RunLog.read(run / "run.jsonl"), tmp_path)

    assert all(re.fullmatch(r"[\w.=-]+", path.name) for path in (tmp_path / "report" / "figures").iterdir())
    labels_read = {row["label"] for row in csv.DictReader((tmp_path / "evaluations.csv").open(newline=""))}
    assert {label.removeprefix(escape.MARK) for label in labels_read} == set(labels)


def test_a_curriculum_is_described_and_drawn_whatever_its_name(tmp_path):
    plain = curricula.load("ct2_interfering")
    curriculum = replace(plain, name=WORST, source=WORST)

    sheets = describe.describe(curriculum)
    page, paper = ("\n".join(map(form, sheets)) for form in (describe.to_markdown, describe.to_latex))
    tokens = [child for token in MARKDOWN.parse(page) for child in token.children or ()]
    draw_graphs(curriculum, tmp_path / "graphs.svg")
    curriculum.to_json(tmp_path / "file.json")

    assert not CONTROL.search(page + paper)
    assert {token.type for token in tokens} == {"text"}
    assert "\\input" not in "\n".join(line for line in paper.splitlines() if not line.startswith("%"))
    assert type(curriculum).from_json(tmp_path / "file.json") == curriculum
    assert not CONTROL.search((tmp_path / "graphs.svg").read_text().replace("\r", ""))


def test_dot_and_the_status_of_a_sweep_have_no_controls():
    task = curricula.load("ct2_interfering").tasks[0]

    for text in (to_dot(task, WORST), report({"cell": Status(FAILED, WORST)})):
        assert not CONTROL.search(text)
    assert len(report({"cell": Status(FAILED, "a\nb")}).splitlines()) == 3


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="no LaTeX")
def test_latex_sets_a_name(tmp_path):
    emoji = r"\DeclareUnicodeCharacter{1F642}{:-)}"  # which the fonts of LaTeX lack
    preamble = rf"\documentclass{{article}}\usepackage[T1]{{fontenc}}{emoji}\begin{{document}}"
    (tmp_path / "a.tex").write_text(preamble + escape.latex_text(WORST) + r"\end{document}")
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "a.tex"]

    done = subprocess.run(command, cwd=tmp_path, capture_output=True)

    assert done.returncode == 0, done.stdout[-2000:]
