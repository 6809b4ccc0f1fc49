"""Tables in LaTeX are well formed, stay within the margins of ``article``, and align their decimal points."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest
from helpers.made_runs import write_run

from ctgraph_rl.report import formats, results
from ctgraph_rl.report.latex import LINE_WIDTH, Table, TableCell, document, latex, letters
from ctgraph_rl.runs.read import find_runs

pytest.importorskip("scipy")

DOCUMENT = r"""\documentclass{article}
\usepackage[T1]{fontenc}
\usepackage{booktabs,graphicx}
\begin{document}
\input{tables}
\end{document}
"""

HEADS = ("average performance", "forward transfer", "backward transfer", "forgetting", "solved rate", "regret")


def table(rows: int = 3, heads=HEADS, name: str = "LSTMPPO + EWC", notes=("seed 1: unfinished",)) -> Table:
    cells = [TableCell("-0.25", "[-0.82, -0.07]", 1), *[TableCell("0.17", "[-0.89, 0.79]")] * (len(heads) - 1)]
    return Table(
        "Some tasks: 95 % of x_1", "some", "agent", heads, [(f"{name} {i}", cells) for i in range(rows)], notes
    )


@pytest.fixture
def made(tmp_path) -> str:
    """The tables of two agents, one of which lacks a seed."""
    for number, agent in enumerate(("LSTMPPO", "QRDQN_LSTM")):
        for seed in range(2):
            write_run(tmp_path / f"{agent}{seed}", agent=agent, seed=seed, finished=number + seed < 2)
    return formats.latex(results.table(find_runs([tmp_path])[0]))


def rows_of(paper: str) -> list[list[str]]:
    """The cells of the rows of all tabulars, without the nested ones of headings."""
    plain = re.sub(r"\\begin\{tabular\}\[b\].*?\\end\{tabular\}", "head", paper)
    return [line.removesuffix(r" \\").split(" & ") for line in plain.splitlines() if line.endswith(r" \\")]


def columns_of(paper: str) -> list[int]:
    return [1 + len(right) for right in re.findall(r"\\begin\{tabular\}\{@\{\}l(r*)@\{\}\}", paper)]


def test_every_row_has_a_cell_for_each_column_and_every_group_is_closed(made):
    for paper in (made, latex(table()), latex(table(rows=30))):
        for part in paper.split(r"\sbox2{%")[1:]:
            body = part.split("\n}%")[0]
            (columns,) = columns_of(body)
            assert {len(row) for row in rows_of(body)} == {columns}
        assert paper.count("{") == paper.count("}")
        begun, ended = (sorted(re.findall(rf"\\{word}\{{(\w+)\}}", paper)) for word in ("begin", "end"))
        assert begun == ended
        assert paper.count(r"\ifdim") == paper.count(r"\fi") == paper.count(r"\else") == paper.count(r"\sbox2")


def test_a_table_has_rules_a_caption_before_it_and_a_label_of_its_own(made):
    for word in (r"\toprule", r"\midrule", r"\bottomrule"):
        assert made.count(word) == len(columns_of(made))
    floats = made.split(r"\begin{table}")[1:]
    labels = [re.search(r"\\caption\{.*\}\n\\label\{(tab:[a-z0-9-]+)\}", each)[1] for each in floats]
    assert len(set(labels)) == len(labels) > 0
    tables = [Table("c", label, "agent", [], []) for label in ("a_b PPO + EWC", "x", "X", "x")]
    assert re.findall(r"label\{tab:(.*)\}", document(tables)) == ["a-b-ppo-ewc", "x", "x-v2", "x-v3"]


def test_a_row_of_letters_as_tex_sets_them_is_no_wider_than_a_line():
    """Measured with the digits and letters of Computer Modern, which matplotlib brings along."""
    font_manager = pytest.importorskip("matplotlib.font_manager")
    from matplotlib import get_data_path
    from matplotlib.textpath import TextPath

    font = font_manager.FontProperties(fname=str(Path(get_data_path(), "fonts", "ttf", "cmr10.ttf")))

    def width(text: str, size: float) -> float:
        advance = TextPath((0, 0), f"{text}|", size=size, prop=font).get_extents()
        return advance.x1

    for name in ("PPO", "LSTMPPO + EWC", "LSTMPPO + MaskLC coeff=0.5"):
        made = table(name=name)
        (columns,) = {*columns_of(latex(made))[:1]}
        number = max(width("[-0.82, -0.07]", 7) + 2 * 3.1, *(width(line, 8.5) for line in ("performance", "0.17")))
        assert width(f"{name} 9", 8.5) + (columns - 1) * (number + 8) <= LINE_WIDTH
    assert columns_of(latex(table(name="x" * 60)))[0] == 3  # scaled down to the line


def test_decimal_points_stand_below_each_other_and_notes_are_letters(made):
    values = [cell for row in rows_of(latex(table())) for cell in row[1:] if re.match(r"(\$-\$)?\d", cell)]

    assert {len(re.sub(r"\\rlap\{.*\}", "", value).rpartition(".")[2]) for value in values} == {2}
    assert {"r"} == set(re.search(r"\{@\{\}l(r*)@\{\}\}", latex(table()))[1])
    assert rows_of(latex(table()))[1][1] == r"$-$0.25\rlap{\textsuperscript{a}}"
    assert r"\textsuperscript{a} seed 1: unfinished" in latex(table())
    assert "^" not in made and re.search(r"textsuperscript\{\d", made) is None
    assert [letters(number) for number in (1, 26, 27, 703)] == ["a", "z", "aa", "aaa"]


def test_a_long_table_is_several_that_fit_on_a_page():
    papers = latex(table(rows=30)).split(r"\begin{table}")[1:]

    assert sum(paper.count("LSTMPPO") for paper in papers) == 30 * len(columns_of(papers[0]))
    assert max(sum(line.endswith(r" \\") for line in paper.splitlines()) for paper in papers) <= 48
    assert r"\label{tab:some-2}" in papers[1] and "(part 2)" in papers[1]


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="no LaTeX")
def test_latex_compiles_the_tables_within_the_margins(tmp_path, made):
    (tmp_path / "paper.tex").write_text(DOCUMENT)
    (tmp_path / "tables.tex").write_text("\n\n".join([made, *(latex(table(name=name)) for name in ("A", "B" * 70))]))

    done = subprocess.run(
        ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "paper.tex"], cwd=tmp_path, capture_output=True
    )

    assert done.returncode == 0, done.stdout[-2000:]
    assert b"Overfull \\hbox" not in done.stdout and b"Float too large" not in done.stdout
