"""The page on searches for hyperparameters: its commands run, find the best trial and resume."""

from __future__ import annotations

import shlex
import subprocess
import sys

import pytest
import yaml

SHORT = ("curriculum.num_frames=512", "agent.num_envs=64", "agent.num_steps=8", "agent.hidden_size=8")


def test_the_search_of_the_page_finds_the_best_trial_and_goes_on(checkout, console_script, tmp_path):
    pytest.importorskip("optuna.storages.journal")
    code = (checkout / "docs/how-to/search.md").read_text().split("<!-- search -->\n```python\n")[1].split("```")[0]
    short = ", ".join(f'"{setting}"' for setting in SHORT)
    for old, new in {"30, 3": "1, 1", '"curriculum=su_b1_4tasks"': short}.items():
        assert old in code
        code = code.replace(old, new)

    shown = []
    for text in (code, code, code.replace("1, 1", "2, 1")):
        result = subprocess.run([sys.executable, "-c", text], cwd=tmp_path, capture_output=True, text=True)
        assert result.returncode == 0, result.stderr
        shown.append(result.stdout)

    best = [text.splitlines()[-1] for text in shown]
    assert best[0] == best[1] and best[0].startswith("trial 0 is best, 0.")
    assert [text.count("sweep of 1 cells: 1 done") for text in shown] == [1, 0, 1]
    assert len(list(tmp_path.glob("search/1/*/*/metrics.json"))) == 1


@pytest.mark.parametrize(
    ("changes", "best"), [([], True), (["objective=frames_to_first_reward", "agent.num_steps=1"], False)]
)
def test_hydras_sweeper_searches_by_the_objective(changes, best, checkout, console_script, tmp_path):
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper")
    page = (checkout / "docs/how-to/search.md").read_text()
    words = shlex.split(page.split("<!-- optuna -->\n```shell\n")[1].split("```")[0].replace("\\\n", ""))
    assert {"hydra.sweeper.n_trials=30", "+seeds=[100,101,102]"} <= {*words}

    short = (*SHORT, "hydra.sweeper.n_trials=2", "+seeds=[100,101]", *changes)
    result = subprocess.run([*words, *short], cwd=tmp_path, capture_output=True, text=True)

    assert (result.returncode == 0) == best, result.stderr
    if best:
        trials = {path.parent.name.split("-")[1] for path in tmp_path.glob("search/*/*/metrics.json")}
        found = yaml.safe_load((tmp_path / "search/optimization_results.yaml").read_text())
        assert trials == {"seed100", "seed101"} and 0 <= found["best_value"] <= 1
        assert {"agent.learning_rate", "agent.entropy_coeff"} <= found["best_params"].keys()
    else:
        last = result.stderr.splitlines()[-1]
        assert last.startswith("error: ValueError: objective=frames_to_first_reward has no value in ")
