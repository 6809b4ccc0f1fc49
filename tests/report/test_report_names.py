"""What tables and figures call curricula and agents, and that intervals know of a curriculum that is published."""

from __future__ import annotations

import io
import sys
from dataclasses import replace

import pytest
from helpers.made_runs import write_run
from rich.console import Console

import curricula
from ctgraph_rl.log.provenance import name_in_logs
from ctgraph_rl.report import formats, results
from ctgraph_rl.report.figures.gallery import Gallery
from ctgraph_rl.report.names import displayed, modifications
from ctgraph_rl.report.page import write_report
from ctgraph_rl.report.sections import sections
from ctgraph_rl.report.terminal import print_summary
from ctgraph_rl.runs.read import find_runs, grouped
from ctgraph_rl.tasks.curriculum import Evaluation, Protocol

pytest.importorskip("scipy")

PUBLISHED = curricula.load("su_b1_4tasks")


def run_of(folder, curriculum, *, has_file=True, seed=0, **more):
    """A finished run of a curriculum, with its file or without."""
    labels = curriculum.labels
    performance = [[float(task < block) for task in range(len(labels))] for block in range(len(labels) + 1)]
    about = (name_in_logs(curriculum), curriculum.fingerprint)
    write_run(folder, curriculum=about, labels=labels, performance=performance, seed=seed, **more)
    if has_file:
        curriculum.to_json(folder / "curriculum.json")
    return folder


def agents_of(runs) -> list[str]:
    return [agent for _, agent in grouped(runs)]


def test_the_runs_seed_that_draws_a_stream_is_no_modification(tmp_path):
    life = curricula.load("stream", num_tasks=5, num_frames=64).for_seed(3)
    run = run_of(tmp_path / "run", life, seed=3)

    said = modifications(find_runs([run])[0])

    changes = (
        "blocks.num_tasks=5 instead of 100, blocks.num_frames=64 instead of 24576, evaluation.every=8 instead of 3072"
    )
    assert said == {"stream (modified)": changes}


def test_a_modified_curriculum_says_what_was_modified_in_every_output(tmp_path):
    changed = replace(curricula.load("su_b1_4tasks", num_frames=8192), evaluation=Evaluation(every=2048))
    run = run_of(tmp_path / "run", replace(changed, protocol=Protocol("one_hot")))
    frames = PUBLISHED.blocks[0].num_frames
    said = f"blocks.num_frames=8192 instead of {frames}, evaluation.every=2048 instead of 0, protocol.task_id=one_hot"
    (runs, _), console = find_runs([run]), Console(file=io.StringIO(), width=200)

    print_summary(run, console)
    rows, modified = results.table(runs), modifications(runs)

    assert modified["su_b1_4tasks (modified)"].startswith(said)
    for form in (formats.text, formats.markdown, formats.latex):
        shown = " ".join(form(rows, modified).split()).replace("\\", "")
        assert said in shown
    assert said in " ".join(console.file.getvalue().split())
    assert sections(runs)[0].modified.startswith(said)


def test_a_curriculum_that_is_published_or_unknown_has_no_modification(tmp_path):
    run_of(tmp_path / "a", PUBLISHED)
    run_of(tmp_path / "b", replace(PUBLISHED, name="mine", version=9))
    run_of(tmp_path / "c", replace(PUBLISHED, version=9), has_file=False)

    assert modifications(find_runs([tmp_path])[0]) == {}


def test_intervals_stay_within_what_is_possible_where_only_the_name_says_the_curriculum(tmp_path):
    for seed, value in enumerate((0.0, 0.0, 1.0)):
        folder = tmp_path / f"{seed}"
        about = (PUBLISHED.name, PUBLISHED.fingerprint)
        write_run(folder, curriculum=about, labels=PUBLISHED.labels, performance=[[value] * 4] * 5, seed=seed)

    rows = results.table(find_runs([tmp_path])[0])

    (average,) = (row.estimate for row in rows if row.measure == "average_performance")
    assert average.method.startswith("mean, Gaffke")
    assert 0 <= average.low < average.value < average.high <= 1


@pytest.fixture
def runs(tmp_path):
    """Runs of three agents, one of them with two settings."""
    for agent in ("PPO", "DQN", "A2C"):
        write_run(tmp_path / agent, agent=agent)
    text = (tmp_path / "A2C" / "run.jsonl").read_text()
    other = write_run(tmp_path / "A2C_slow", agent="A2C")
    (other / "run.jsonl").write_text(text.replace('"gamma": 0.9', '"gamma": 0.5'))
    return find_runs([tmp_path])[0]


def test_agents_have_the_order_and_the_names_that_are_given_and_others_follow(runs):
    before = agents_of(runs)

    shown = displayed(runs, ["PPO=PPO (ours)", "A2C gamma=0.5=Short-sighted", "A2C gamma=0.9"])

    assert before == ["A2C gamma=0.5", "A2C gamma=0.9", "DQN", "PPO"]
    assert agents_of(shown) == ["PPO (ours)", "Short-sighted", "A2C gamma=0.9", "DQN"]
    assert [result.agent for result in sections(shown)[0].results] == agents_of(shown)
    assert agents_of(displayed(runs)) == before


@pytest.mark.parametrize(
    ("agents", "message"),
    [
        (["PPP"], "there is no agent 'PPP': did you mean 'PPO'?"),
        (["ppo=x"], "there is no agent 'ppo': did you mean 'PPO'?"),
        (["A2C=x"], "there is no agent 'A2C': choices: A2C gamma=0.5, A2C gamma=0.9"),
        (["PPO="], "--agent 'PPO=' must have a name after the sign"),
        (["PPO", "PPO=x"], "--agent names an agent twice; give each once"),
        (["PPO=x", "DQN=x"], "--agent gives the name x to two agents; choose different ones"),
        (["PPO=DQN"], "--agent gives the name DQN to two agents; choose different ones"),
    ],
)
def test_a_name_that_could_not_be_told_from_others_is_refused(runs, agents, message):
    with pytest.raises(ValueError) as refused:
        displayed(runs, agents)

    assert message in str(refused.value)


def test_one_option_names_agents_in_tables_and_in_the_report(runs, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(Gallery, "write", lambda self, names, figures: [])
    monkeypatch.setattr(sys, "argv", ["results", str(tmp_path), "--agent", "PPO=Ours", "--agent", "DQN"])

    results.main()
    page = write_report([tmp_path], tmp_path / "out", ["PPO=Ours"]).page.read_text()

    said = capsys.readouterr().out
    assert [line.strip() for line in said.splitlines() if line.startswith("  ") and line[2] != " "][:2] == [
        "Ours",
        "DQN",
    ]
    assert page.index('<th scope="row">Ours</th>') < page.index('<th scope="row">A2C gamma=0.5</th>')
