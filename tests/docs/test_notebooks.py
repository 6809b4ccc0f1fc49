"""The notebooks run from top to bottom, and say what is so.

What they store is made by ``jupyter nbconvert --to notebook --execute --inplace`` with
``--ExecutePreprocessor.record_timing=False --ExecutePreprocessor.coalesce_streams=True``.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.paths import CHECKOUT

FOLDER = CHECKOUT / "docs" / "tutorials"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
LARGEST = 300_000
PATHS = re.compile(r"/(?:home|root|tmp|usr|work|opt|mnt|Users|var|content)/|[A-Z]:\\")


def cells(path: Path) -> list[dict[str, Any]]:
    return json.loads(path.read_text(encoding="utf-8"))["cells"]


def sources(path: Path, kind: str) -> list[str]:
    return ["".join(cell["source"]) for cell in cells(path) if cell["cell_type"] == kind]


def outputs(path: Path) -> Iterator[dict[str, Any]]:
    for cell in cells(path):
        yield from cell.get("outputs", [])


def run(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[dict[str, Any], str]:
    """What the code of a notebook leaves, and its prose on one line."""
    pyplot = pytest.importorskip("matplotlib.pyplot")
    pyplot.switch_backend("Agg")
    monkeypatch.chdir(folder)
    path, names = FOLDER / name, {"__name__": "__main__"}
    for number, code in enumerate(sources(path, "code"), 1):
        exec(compile(code, f"{name}, code cell {number}", "exec"), names)
    pyplot.close("all")
    assert list(folder.iterdir()) == []
    return names, " ".join(" ".join(sources(path, "markdown")).split())


def says(prose: str, *claims: str) -> None:
    assert [claim for claim in claims if claim not in prose] == []


@pytest.mark.slow
def test_the_environment_is_what_its_notebook_says(tmp_path, monkeypatch):
    names, prose = run("environment.ipynb", tmp_path, monkeypatch)

    says(prose, "goal 1.2", "Every interval holds P_R", "34 billion frames", "1.7 quadrillion", "toss a coin: 0.25")
    for task, (low, high) in zip(names["shapes"], names["intervals"], strict=True):
        assert low < task.graph.reward_prob_random < high
    assert names["low"] < 1 / 243 < names["high"]
    assert [float(f"{names['deep'][d]:.2g}") for d in (8, 12)] == [34e9, 1.7e15]
    assert names["walk"]["next", "reward"].sum(1).flatten().tolist() == [1, 1, 1]
    assert (names["images"][1:, 2] == names["images"][1:, 4]).all()  # the decision states of the lower rows look alike
    assert names["surjective"].memoryless_ceiling() == 0.25
    low, high = names["wilson"](names["coin"], 20_000)
    assert low < 0.25 < high
    assert names["before"] == [0, 1, 0, 0]
    assert names["played"]["episode_reward"].unique().tolist() == [1]


@pytest.mark.slow
def test_a_learner_of_ones_own_learns_forgets_and_transfers_as_its_notebook_says(tmp_path, monkeypatch):
    names, prose = run("own_learner.ipynb", tmp_path, monkeypatch)

    says(prose, "need 651 frames", "(0.8 + 0.2 / 3)^5 = 49 %", "it is 1.25", "Forward transfer is 0")
    says(prose, "medians of 0.50, 0.35 and 0.24", "In 21 of 30 cases")
    assert round(names["random_frames"]) == 651
    np.testing.assert_array_equal(names["matrix"], [[0] * 4, *np.eye(4)])
    assert all(recorder.metrics["stage_reached"].value == 1.25 for recorder in names["recorders"])
    assert names["metrics"]["forward_transfer"].value == 0
    assert names["medians"].round(2).tolist() == [0.92, 0.50, 0.35, 0.24]
    assert names["sooner"][1:].sum() == 21
    first, _, third, _ = np.mean(names["shares"], axis=0).reshape(4, -1)[:, :5].mean(1)
    assert third < first / 2
    settled = np.mean([share[-5:].mean() for share in names["shares"]])
    assert abs(settled - (0.8 + 0.2 / 3) ** 5) < 0.05


def forgets_and_keeps(names: dict[str, Any]) -> None:
    """Fine-tuned PPO knows the task of the last block alone, and PPO with EWC all so far."""
    assert names["matrix"].tolist() == [[0] * 4, *np.eye(4).tolist()]
    assert names["kept"].tolist() == np.tri(5, 4, -1).tolist()
    assert names["by_hand"] == names["metrics"]["forgetting"].value == 1


@pytest.mark.slow
def test_the_notebook_on_forgetting_finds_what_it_says_with_pictures(tmp_path, monkeypatch):
    names, prose = run("forgetting.ipynb", tmp_path, monkeypatch)

    says(prose, "task 1 is at 0: it forgot", "With EWC each column stays at 1 once its task is learned")
    forgets_and_keeps(names)


@pytest.mark.slow
def test_the_notebook_on_forgetting_runs_without_matplotlib_and_its_solution_is_the_ceiling(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    path, names = FOLDER / "forgetting.ipynb", {"__name__": "__main__"}
    [solution] = re.findall(r"```python\n(.*?)```", "".join(sources(path, "markdown")), re.DOTALL)

    exec("\n\n".join([*sources(path, "code"), solution]), names)

    assert names["plt"] is None
    forgets_and_keeps(names)
    tasks = names["curriculum"].tasks
    assert sum(task.memoryless_ceiling(deterministic=True) for task in tasks) / len(tasks) == 0.5
    assert names["log"].performance()[-1].tolist() == [1, 0, 0, 1]
    assert capsys.readouterr().out.endswith("average performance: 0.5\n")


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_what_a_notebook_stores_is_whole_small_and_of_no_machine(path):
    notebook = json.loads(path.read_text(encoding="utf-8"))
    stored = list(outputs(path))

    texts = ["".join(out.get("text", out.get("data", {}).get("text/plain", ""))) for out in stored]
    assert path.stat().st_size < LARGEST
    assert set(notebook["metadata"]) == {"kernelspec", "language_info"}
    assert notebook["metadata"]["kernelspec"]["name"] == "python3"
    assert all(cell["metadata"].keys() <= {"mystnb"} for cell in notebook["cells"])
    assert {out["output_type"] for out in stored} <= {"stream", "display_data", "execute_result"}
    assert not [out for out in stored if out.get("name") == "stderr"]
    assert [text for text in texts if PATHS.search(text) or " at 0x" in text or "\x1b" in text] == []
    counts = [cell["execution_count"] for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert counts == list(range(1, len(counts) + 1))


def test_there_are_three_notebooks_and_each_ends_with_what_to_read_next():
    links = {path.name: re.findall(r"\]\(([^)#]+)\)", sources(path, "markdown")[-1]) for path in NOTEBOOKS}

    assert list(links) == ["environment.ipynb", "forgetting.ipynb", "own_learner.ipynb"]
    for found in links.values():
        assert found
        assert [link for link in found if not (FOLDER / link).is_file()] == []
