"""The page on searches for hyperparameters: what it shows runs, finds the best trial and goes on."""

from __future__ import annotations

import subprocess
import sys

import pytest

SHORT = ("curriculum.num_frames=512", "agent.num_envs=64", "agent.num_steps=8", "agent.hidden_size=8")


def test_the_search_of_the_page_finds_the_best_trial_and_goes_on(checkout, console_script, tmp_path):
    pytest.importorskip("optuna")
    code = (checkout / "docs/how-to/sweeps.md").read_text().split("<!-- search -->\n```python\n")[1].split("```")[0]
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
