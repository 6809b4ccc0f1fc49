"""Short guides: the container runs README's commands, and the numbers on GPUs were measured."""

from __future__ import annotations

import json
import re
import sys
from types import ModuleType

from helpers.paths import CHECKOUT

from ctgraph_rl.metrics.record import METRICS

GUIDES = CHECKOUT / "docs" / "how-to"


def test_the_container_runs_the_two_commands_of_readme():
    file = (CHECKOUT / "Dockerfile").read_text(encoding="utf-8")
    readme = (CHECKOUT / "README.md").read_text(encoding="utf-8")

    run, test = re.findall(r"<!-- (?:run|test)-command -->\n```bash\n(.*?)\n```", readme)
    assert f"\nRUN {run}\n" in file
    assert f"{{ {test}; }}\n" in file


def test_the_guide_on_gpus_has_the_rates_of_captured_steps():
    report = json.loads((CHECKOUT / "docs" / "results" / "gpu.json").read_text(encoding="utf-8"))
    rates = {(row["way"], row["rows"]): row["per_second"] / 1e6 for row in report["learning"]}
    page = (GUIDES / "gpu.md").read_text(encoding="utf-8")

    for rows in (256, 4096, 65536):
        ppo = rates["ppo, captured", rows]
        lstm = rates["lstm_ppo, captured", rows]
        assert f"| one H100, {rows:,} | {ppo:.2f} | {lstm:.2f} |" in page
    assert 1.15 < rates["ppo, compiled and captured", 4096] / rates["ppo, captured", 4096] < 1.25
    assert 1.3 < rates["ppo, compiled and captured", 256] / rates["ppo, captured", 256] < 1.5
    assert "`agent.compile=true` gains a fifth with PPO from 4,096 environments on, over a third at 256" in page


def test_the_metric_of_the_guide_is_computed_and_listed(monkeypatch, capsys):
    page = (GUIDES / "own_metric.md").read_text(encoding="utf-8")
    definition, use = re.findall(r"```py\n(.*?)```", page, re.DOTALL)
    module = ModuleType("my_metrics")
    monkeypatch.setitem(sys.modules, "my_metrics", module)
    before = dict(METRICS)

    try:
        exec(definition, module.__dict__)
        exec(use, {})
    finally:
        METRICS.clear()
        METRICS.update(before)

    assert f"```text\n{capsys.readouterr().out}```" in page
