"""README shows only what runs: CI executes its two commands, this test its Python."""

import csv
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest
from helpers.paths import CHECKOUT

import curricula
from baselines.methods.finetune import Finetune
from ctgraph_rl import metrics
from ctgraph_rl.core.goal import read_goal
from ctgraph_rl.runs.job import curriculum_of
from ctgraph_rl.tasks.configurations import CONFIGURATIONS
from curricula.axes import all_goals

README = CHECKOUT / "README.md"


@pytest.mark.slow
def test_the_python_in_readme_runs_in_its_order_and_prints_what_it_says(capsys):
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    names: dict[str, Any] = {}

    for code in blocks:
        exec(compile(code, str(README), "exec"), names)

    odds, ceiling, performance = capsys.readouterr().out.splitlines()
    assert [odds, ceiling] == re.findall(r"  # (goal1\.2 243|0\.25)", "".join(blocks))
    assert 0 < float(performance) <= 0.5
    assert names["recorder"].metrics["average_performance"].value is not None


def number_of_classes(group: str, without: str = "") -> int:
    """The different classes that the yaml files of a group build, without one that stands for nothing."""
    files = [path for path in (CHECKOUT / "conf" / group).glob("*.yaml") if path.stem != without]
    targets = {line for path in files for line in path.read_text("utf-8").splitlines() if line.startswith("_target_")}
    return len(targets)


def test_readme_is_short_and_counts_what_there_is():
    text = README.read_text(encoding="utf-8")
    agents = number_of_classes("agent")
    cells = len(list((CHECKOUT / "conf" / "cell").glob("*.yaml"))) - 1  # "none" is no memory
    methods = number_of_classes("method", without="finetune")

    assert len(text.splitlines()) <= 100
    assert f"{len(curricula.names())} named, versioned curricula" in text
    assert f"{agents} agents, {cells} kinds of memory, {methods} lifelong-learning methods" in text
    assert f"{len(metrics.definitions())} metrics, and runs" in text


def test_the_table_that_readme_links_has_the_exact_numbers_of_every_goal_of_each_configuration():
    page = (CHECKOUT / "docs" / "explanation" / "ct_graph_in_pictures.md").read_text(encoding="utf-8")
    assert "ct_graph_in_pictures.md#the-numbers-of-each-configuration" in README.read_text(encoding="utf-8")
    rows = re.findall(r"^\| (CT-.*?) \| (.*?) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \|$", page, re.MULTILINE)
    shown = {}
    for names, goals, *numbers in rows:
        for name in names.split(", "):
            every = [task.goal for task in all_goals(CONFIGURATIONS[name]())]
            for goal in every if goals == "all" else map(read_goal, goals.split(", ")):
                shown[name, goal] = list(map(float, numbers))

    exact = {}
    greedy = set()
    for name, make in CONFIGURATIONS.items():
        for task in all_goals(make()):
            odds, ceiling = task.graph.reward_prob_random, task.memoryless_ceiling()
            exact[name, task.goal] = [float(f"{odds:.2g}"), ceiling, task.optimal_value(1.0)]
            greedy.add((ceiling, task.memoryless_ceiling(deterministic=True)))
    assert shown == exact
    assert greedy == {(1.0, 1.0), (0.25, 0.0)} and "Greedy policies without memory have 0 in place of 0.25" in page


def stored_by(commit: str, path: Path) -> bytes | None:
    """The content of a file at a commit; None where the history is not at hand."""
    name = path.relative_to(CHECKOUT).as_posix()
    try:
        shown = subprocess.run(["git", "show", f"{commit}:{name}"], cwd=CHECKOUT, capture_output=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return shown.stdout


def test_the_page_on_how_numbers_were_made_has_the_file_of_each_result_of_readme():
    folder = CHECKOUT / "docs" / "results"
    page = (folder / "how_made.md").read_text(encoding="utf-8")
    table = page.split("| in README |")[1].split("\n\n")[0]
    rows = [line.strip("| ").split(" | ") for line in table.splitlines()[2:]]

    text = " ".join(README.read_text(encoding="utf-8").replace("**", "").split())
    results = text.split("## Results")[1].split("## More")[0]
    for *_, commit, numbers in rows:
        assert re.fullmatch(r"[0-9a-f]{8}", commit)
        assert [each for each in numbers.split("; ") if each not in results and each != "the first figure"] == []
    said = {number for *_, numbers in rows for number in re.findall(r"\d+ of \d+", numbers)}
    assert {*re.findall(r"\d+ of \d+", results)} == said


def test_a_file_of_results_is_what_a_commit_beside_it_stored():
    folder = CHECKOUT / "docs" / "results"
    page = (folder / "how_made.md").read_text(encoding="utf-8")
    lines = [line for line in page.splitlines() if re.match(r"\|.*\]\([\w./]+\.(csv|json)\)", line)]
    with_commits = [line for line in lines if re.search(r"\b[0-9a-f]{8}\b", line)]

    assert len(with_commits) > 25 and len(lines) == len(with_commits)
    for line in with_commits:
        commits = re.findall(r"\b[0-9a-f]{8}\b", line)
        for file in re.findall(r"\]\(([\w./]+\.(?:csv|json))\)", line):
            path = (folder / file).resolve()
            stored = {stored_by(commit, path) for commit in commits} - {None}
            assert not stored or path.read_bytes() in stored, f"none of {commits} has this {path.name}"


@pytest.mark.parametrize("experiment", ["task_free", "no_labels", "methods"])
def test_a_modified_curriculum_of_an_experiment_has_the_stored_fingerprint(compose, experiment):
    with (CHECKOUT / "docs" / "results" / f"{experiment}.csv").open(encoding="utf-8") as lines:
        rows = list(csv.DictReader(lines))
    choices = [] if experiment != "methods" else ["curriculum=fo_b1_4tasks"]
    made = curriculum_of(compose(f"experiment={experiment}", *choices), Finetune())

    stored = {row["fingerprint"] for row in rows if row["curriculum"] == made.name}
    assert made.fingerprint in stored
    assert curricula.load(made.name).fingerprint not in stored


def test_every_example_with_stable_baselines3_sets_one_thread():
    """With all threads of a busy machine the same steps take ten times as long."""
    pages = [README, *(CHECKOUT / "docs").rglob("*.md")]
    blocks = [code for page in pages for code in re.findall(r"```python\n(.*?)```", page.read_text("utf-8"), re.DOTALL)]
    with_sb3 = [code for code in blocks if "from stable_baselines3 import" in code]

    assert len(with_sb3) >= 2
    assert all(code.index("torch.set_num_threads(1)") < code.index("PPO(") for code in with_sb3)


@pytest.mark.parametrize("name", ["run-command", "test-command"])
def test_each_of_the_two_commands_is_one_line_behind_its_marker(name):
    text = README.read_text(encoding="utf-8")

    blocks = re.findall(rf"<!-- {name} -->\n```bash\n(.*?)```", text, re.DOTALL)

    assert len(blocks) == 1
    assert len(blocks[0].splitlines()) == 1
