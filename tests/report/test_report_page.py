"""The report of many runs: its files, its numbers, and what it says of runs that it cannot count."""

from __future__ import annotations

import json
import re
import sys
from types import SimpleNamespace

import pytest
from helpers.made_runs import write_run

import curricula
from ctgraph_rl import RunLog
from ctgraph_rl.play.visits import Visits
from ctgraph_rl.report import page
from ctgraph_rl.report import page as command
from ctgraph_rl.report.figures.gallery import Gallery
from ctgraph_rl.report.figures.trees import Trees, draw_trees, task_trees
from ctgraph_rl.report.page import write_report
from ctgraph_rl.report.sections import over_seeds, sections, training_curve
from ctgraph_rl.run import run
from ctgraph_rl.runner import show
from ctgraph_rl.runs.load import Trained
from ctgraph_rl.runs.read import find_runs, histories

for package in ("matplotlib", "jinja2", "scipy"):
    pytest.importorskip(package)

HTML = "<img src=x onerror=alert(1)>"


@pytest.fixture
def no_figures(monkeypatch):
    """Figures cost most of the time, and say nothing in a test of words."""
    monkeypatch.setattr(Gallery, "write", lambda self, names, figures: [])


def written(folder, *paths):
    """A report's text in HTML and Markdown, and its problems."""
    report = write_report(paths, folder)
    return report.page.read_text(), (folder / "report.md").read_text(), report.problems


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The report of two seeds, with its figures."""
    runs = tmp_path_factory.mktemp("whole") / "runs"
    for seed in range(2):
        write_run(runs / f"{seed}", seed=seed)
    return write_report([runs]).page


def test_a_report_is_four_kinds_of_files_within_the_one_folder_given(whole):
    folder = whole.parent

    assert (whole.name, folder.name, folder.parent.name) == ("report.html", "report", "runs")
    assert sorted(path.name for path in folder.iterdir()) == ["figures", "report.html", "report.md", "tables.tex"]
    kinds = ("two-PPO-transfer", "two-curves", "two-mean", "two-training")
    assert sorted(path.name for path in (folder / "figures").iterdir()) == [
        f"{kind}.{ending}" for kind in kinds for ending in ("pdf", "png")
    ]


def test_a_report_counts_runs_agents_and_figures(tmp_path, monkeypatch):
    steps = []
    write_run(tmp_path / "run")
    monkeypatch.setattr(page, "OF_SECTION", (lambda section: None, lambda section: None))
    monkeypatch.setattr(page, "OF_AGENT", (lambda section, result, trees: None,))

    write_report([tmp_path / "run"], tmp_path / "report", count=lambda *step: steps.append(step))

    figures = [("figures", done, 4) for done in (1, 2, 3, 4)]
    assert steps == [("runs read", 1, 1), ("agents", 1, 1), *figures]


def test_several_folders_have_their_report_in_the_working_directory(tmp_path, monkeypatch, no_figures):
    monkeypatch.chdir(tmp_path)

    report = write_report([write_run(tmp_path / "a"), write_run(tmp_path / "b", seed=1)])

    assert report.page.resolve() == tmp_path / "report" / "report.html"


def test_the_matrices_are_means_over_seeds_with_intervals_and_n(tmp_path):
    for seed, value in enumerate((0.25, 0.5, 0.75)):
        write_run(tmp_path / f"{seed}", seed=seed, performance=((0.0, 0.0), (1.0, 0.0), (value, 1.0)))
    (section,) = sections(find_runs([tmp_path])[0])
    (result,) = section.results

    performance, transfer = result.performance(), result.transfer()

    half = 0.25 / 3**0.5 * 0.95 * (2 / (1 - 0.95**2)) ** 0.5  # Student's quantile of two degrees of freedom
    assert [[cell.value for cell in row] for row in performance] == [[0.0, 0.0], [1.0, 0.0], [0.5, 1.0]]
    assert [[cell.value for cell in row] for row in transfer] == [[1.0, 0.0], [-0.5, 1.0]]
    assert (performance[2][0].low, performance[2][0].high) == pytest.approx((0.5 - half, 0.5 + half), abs=1e-12)
    assert (transfer[1][0].low, transfer[1][0].n) == (pytest.approx(-0.5 - half, abs=1e-12), 3)
    assert performance[1][0].low is None  # all equal


def test_a_seed_without_results_is_counted_and_named_and_never_averaged(tmp_path, monkeypatch):
    monkeypatch.setattr(page, "OF_SECTION", page.OF_SECTION[:1])
    monkeypatch.setattr(page, "OF_AGENT", ())
    write_run(tmp_path / "runs" / "0", performance=((0.0, 0.0), (0.5, 0.0), (0.25, 1.0)))
    stopped = write_run(tmp_path / "runs" / "1", seed=1, finished=False)
    (stopped / "failed.txt").write_text("FloatingPointError: block 2: loss_critic\nis nan")

    html, markdown, problems = written(tmp_path / "out", tmp_path / "runs")

    assert problems == []
    assert "(n = 1/2)" in html
    for text in (html, markdown):
        assert "2 runs, 1 with results" in text
        assert "Seed 1 has no results: failed: FloatingPointError: block 2: loss_critic is nan." in text
    assert "| 2 | 0.25 | 1.00 | " in markdown.splitlines()


def test_curricula_have_sections_of_their_own_even_under_one_name(tmp_path, no_figures):
    write_run(tmp_path / "runs" / "a", curriculum=("two", "f1"))
    write_run(tmp_path / "runs" / "b", curriculum=("two", "f2"), performance=((0.0, 0.0), (0.0, 0.0), (0.0, 0.0)))

    html, markdown, _ = written(tmp_path / "out", tmp_path / "runs")

    assert re.findall(r"<h2 id=.c\d+.>(.*?)</h2>", html) == ["two f1", "two f2"]
    assert "numbers of different curricula are not averaged" in html
    assert "| PPO | average performance | 0.75 | 1 | 1 | " in markdown.splitlines()
    assert "| PPO | average performance | 0.00 | 1 | 1 | " in markdown.splitlines()


def test_every_measure_on_the_page_has_its_definition(tmp_path, no_figures):
    html, _, _ = written(tmp_path / "out", write_run(tmp_path / "run"))

    table = html[html.index('id="definitions"') :]

    for identifier in ("lopez-paz2017/bwt", "ctgraph_rl/mean-return-at-end", "agarwal2021/iqm"):
        assert f"<td>{identifier}</td>" in table
    assert "<td>1/(T-1) sum_{j=1..T-1} (R[T,j] - R[j,j])</td>" in table


def test_the_page_says_what_was_run_and_where(tmp_path, no_figures):
    write_run(tmp_path / "runs" / "0")
    other = write_run(tmp_path / "runs" / "1", seed=1)
    log = (other / "run.jsonl").read_text()
    (other / "run.jsonl").write_text(log.replace('"machine": "x86_64"', '"machine": "arm64"', 1))

    html, _, _ = written(tmp_path / "out", tmp_path / "runs")

    assert '<tr><th scope="row">fingerprint</th><td>f</td></tr>' in html
    assert '<tr><th scope="row">agent.gamma</th><td>0.9</td></tr>' in html
    assert "1 run: ctgraph_rl 0.1.0; machine arm64, threads of torch 1, device cpu" in html
    assert "These runs are of 2 different versions or machines." in html


def test_html_in_names_is_text(tmp_path, no_figures):
    write_run(tmp_path / HTML / "0", agent=HTML, curriculum=(HTML, "f"), labels=(HTML, "$x_1$"))

    html, markdown, _ = written(tmp_path / "out", tmp_path / HTML)

    for text in (html, markdown):
        assert "<img src=x" not in text
        assert "&lt;img src=x onerror=alert(1)&gt;" in text


def test_the_page_needs_nothing_from_elsewhere(whole):
    html = whole.read_text()

    sources = re.findall(r"(?:src|href)=\"([^\"]*)\"", html)

    assert {source.partition(",")[0] for source in sources if not source.startswith("#")} == {"data:image/png;base64"}
    assert "<script" not in html and "url(" not in html and "@import" not in html


@pytest.mark.slow
def test_a_run_without_weights_says_so_and_trees_are_drawn_without_a_policy(tmp_path, monkeypatch):
    monkeypatch.setattr(page, "OF_SECTION", ())
    monkeypatch.setattr(page, "OF_AGENT", (task_trees,))
    path = write_run(tmp_path / "run")
    _, none, _ = written(tmp_path / "none", path)
    curricula.load("su_b1_4tasks").to_json(path / "curriculum.json")
    _, trees, _ = written(tmp_path / "trees", path)

    assert "Trees are missing: " in none
    assert not list((tmp_path / "none" / "figures").glob("*trees*"))
    assert f"The policy on the trees is missing: {path} has no agent.pt, the weights of its agent." in trees
    assert (tmp_path / "trees" / "figures" / "two-PPO-trees.png").exists()


def test_on_the_trees_each_task_is_played_with_what_acts_in_it(monkeypatch):
    learned, played = curricula.load("ct2_interfering"), []  # ids with every observation

    def play(task, policy, *_, **__):
        played.append((task, policy))
        return Visits({}, {})

    monkeypatch.setattr("ctgraph_rl.report.figures.trees.visits", play)
    agent = SimpleNamespace(policy="the present one", policy_for=lambda number: number, initial_state=None)
    draw_trees(Trees(learned, Trained(agent, learned, 0, 0, RunLog()), ""), 0)

    assert played == list(learned.task_ids.items())


def test_curves_are_means_where_every_seed_has_a_value(tmp_path):
    runs = [
        write_run(tmp_path / f"{seed}", seed=seed, performance=((0.0, 0.0), (value, 0.0), (value / 2, 1.0)))
        for seed, value in enumerate((0.5, 1.0))
    ]
    lines = (runs[0] / "run.jsonl").read_text().splitlines()
    kept = [line for line in lines if not ('"kind": "evaluation"' in line and '"block": 1' in line)]
    (runs[0] / "run.jsonl").write_text("\n".join(kept) + "\n")
    found = find_runs([tmp_path])[0]

    evaluations = over_seeds([history.evaluations["goal1"] for history in histories(found)])
    training = training_curve(found, block=1, start=0, end=1000, places=1)

    assert evaluations == [(0, 0.0, None, None, 2), (2000, 0.375, None, None, 2)]
    assert training == [(1000, 0.75, None, None, 2)]


def test_curves_have_bands_from_ten_seeds_on_within_what_is_possible():
    curve = over_seeds([[(0, 1.0), (1, float(seed > 0))] for seed in range(10)], bounds=(0, 1))

    assert [(point.high, point.n) for point in curve] == [(1.0, 10), (pytest.approx(0.99747, abs=5e-6), 10)]
    assert [point.low for point in curve] == pytest.approx([0.69150, 0.55498], abs=5e-6)


@pytest.mark.slow
def test_more_agents_than_colours_are_in_the_tables_and_it_is_said(tmp_path):
    for number in range(8):
        write_run(tmp_path / "runs" / f"{number}", agent=f"Agent{number}")

    html, markdown, _ = written(tmp_path / "out", tmp_path / "runs")

    assert "The first 6 of 8 agents are shown." in html
    assert "2 more agents, in the tables only" in html
    assert "| Agent7 | average performance |" in markdown
    assert len(list((tmp_path / "out" / "figures").glob("*.png"))) == 6 + 3


def run_of(path, tasks):
    """A run of so many tasks, of which one was not measured at first."""
    performance = [[float(task < block) for task in range(tasks)] for block in range(tasks + 1)]
    performance[0][0] = float("nan")
    return write_run(path, labels=[f"goal{task}" for task in range(tasks)], performance=performance)


@pytest.mark.slow
@pytest.mark.parametrize("tasks", [1, 12, 40])
def test_any_number_of_tasks_has_its_figures(tmp_path, tasks):
    html, _, _ = written(tmp_path / "out", run_of(tmp_path / "run", tasks))

    assert html.count("<figure>") == 4
    assert ("The first 32 of 40 tasks are shown." in html) == (tasks == 40)


@pytest.mark.parametrize("tasks", [10, 11])
def test_a_paper_has_the_matrix_of_up_to_ten_tasks(tmp_path, no_figures, tasks):
    written(tmp_path / "out", run_of(tmp_path / "run", tasks))

    paper = (tmp_path / "out" / "tables.tex").read_text()
    assert (": Mean return after each block;" in paper) == (tasks <= 10)


def test_a_missing_package_names_the_extra_before_any_work(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "jinja2", None)

    with pytest.raises(ModuleNotFoundError, match=r"the report needs jinja2: pip install 'ctgraph_rl\[report\]'"):
        write_report([tmp_path / "nothing"], tmp_path / "out")

    assert not (tmp_path / "out").exists()


def call(monkeypatch, capsys, *words) -> tuple[int, str, str]:
    monkeypatch.setattr(sys, "argv", ["report", *map(str, words)])
    code = 0
    try:
        command.main()
    except SystemExit as end:
        code = end.code
    said = capsys.readouterr()
    return code, said.out, said.err


def test_the_command_prints_the_tables_of_one_run_and_where_the_report_is(tmp_path, monkeypatch, capsys, no_figures):
    run = write_run(tmp_path / "run")

    code, out, err = call(monkeypatch, capsys, run)

    assert (code, err) == (0, "")
    assert "average performance" in out
    assert f"report of 1 run: {run / 'report' / 'report.html'}" in out


def test_what_is_left_out_has_exit_code_1_and_the_rest_is_reported(tmp_path, monkeypatch, capsys, no_figures):
    write_run(tmp_path / "runs" / "good")
    (tmp_path / "runs" / "foreign").mkdir()
    (tmp_path / "runs" / "foreign" / "run.jsonl").write_text("step,reward\n1,2\n")

    code, out, err = call(monkeypatch, capsys, tmp_path / "runs")

    file = tmp_path / "runs" / "foreign" / "run.jsonl"
    assert code == 1
    assert "report of 1 run" in out
    assert err == f"left out: {file} does not say what was run: its first line is missing, or it is no log of ours\n"
    assert str(file) in (tmp_path / "runs" / "report" / "report.html").read_text()


def test_a_folder_without_a_run_is_one_message(tmp_path, monkeypatch, capsys):
    code, _, err = call(monkeypatch, capsys, tmp_path)

    assert code == 2
    assert f"{tmp_path} holds no run: no run.jsonl in or below it; name a run directory" in err


@pytest.mark.parametrize("report", [False, True])
def test_a_run_ends_with_its_report_or_how_to_make_it(tmp_path, monkeypatch, capsys, no_figures, report):
    write_run(tmp_path / "my run")
    monkeypatch.chdir(tmp_path)

    show(tmp_path / "my run", report)

    last = capsys.readouterr().out.splitlines()[-1]
    assert (tmp_path / "my run" / "report" / "report.html").exists() == report
    command = "ctgraph-rl report 'my run' makes a page of figures and tables"
    assert last == ("report: my run/report/report.html" if report else command)


def test_a_run_ends_with_what_its_report_needs_where_that_is_missing(tmp_path, monkeypatch, capsys):
    write_run(tmp_path / "run")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "matplotlib", None)

    show(tmp_path / "run", report=False)

    assert capsys.readouterr().out.endswith("tables; first pip install 'ctgraph_rl[report]'\n")


def test_a_run_that_could_not_be_reported_is_refused_before_it_begins(compose, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "jinja2", None)

    with pytest.raises(ModuleNotFoundError, match=r"pip install 'ctgraph_rl\[report\]'"):
        run(compose("report=true"), tmp_path)

    assert list(tmp_path.iterdir()) == []


def middle(run):
    lines = (run / "run.jsonl").read_text().splitlines()
    lines[3] = lines[3][:20]
    (run / "run.jsonl").write_text("\n".join(lines) + "\n")


def torn(run):
    (run / "metrics.json").unlink()
    with open(run / "run.jsonl", "a") as file:
        file.write('{"kind": "eval')


FAULTS = [
    (middle, "run.jsonl: line 4 is no measurement"),
    (torn, "unfinished, with a torn last line"),
    (lambda run: (run / "metrics.json").write_text('{"a": 1'), "metrics.json cannot be read: "),
    (
        lambda run: (run / "metrics.json").write_text('{"a": 1}'),
        "metrics.json cannot be read: it does not hold metrics of ours",
    ),
    (
        lambda run: (run / "metrics.json").write_text("[]"),
        "metrics.json cannot be read: it does not hold metrics of ours",
    ),
]


@pytest.mark.parametrize(("spoil", "reason"), FAULTS, ids=range(len(FAULTS)))
def test_a_broken_file_of_a_known_run_is_a_seed_without_results(tmp_path, spoil, reason):
    write_run(tmp_path / "good")
    spoil(write_run(tmp_path / "bad", seed=1))

    runs, problems = find_runs([tmp_path])

    (section,) = sections(runs)
    assert problems == []
    assert [reason in (run.reason or "") for run in runs] == [True, False]
    assert section.results[0].n == "1/2"


@pytest.mark.parametrize(
    ("first", "message"),
    [
        ({"kind": "training"}, "does not say what was run"),
        ({"kind": "run", "curriculum": "c", "fingerprint": "f"}, "does not say its config"),
        ({"kind": "run", "curriculum": "c", "fingerprint": "f", "config": {"agent": "a"}}, "has no seed in its config"),
        (
            {"kind": "run", "schema": 99, "curriculum": "c", "fingerprint": "f", "config": {"seed": 0}},
            "has schema 99, this version reads 1: update ctgraph_rl",
        ),
    ],
)
def test_a_run_that_cannot_be_attributed_is_a_problem_that_names_the_file(tmp_path, first, message):
    (tmp_path / "run.jsonl").write_text(json.dumps(first) + "\n")

    runs, problems = find_runs([tmp_path])

    assert runs == []
    assert message in problems[0].reason and str(tmp_path / "run.jsonl") in problems[0].reason
