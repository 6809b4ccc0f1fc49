"""The page about methods: its list and hooks are the present ones, and its example runs as an outsider would run it."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from dataclasses import replace
from functools import partial
from inspect import isfunction
from pathlib import Path

import pytest
from helpers.paths import CHECKOUT
from omegaconf import OmegaConf

import curricula
from baselines.methods.__main__ import main, methods
from baselines.methods.method import Method
from ctgraph_rl import Protocol, RunLog, cli, load
from ctgraph_rl.run import conf_dir, target
from ctgraph_rl.runs.train import new_agent

TEXT = (CHECKOUT / "docs" / "methods.md").read_text(encoding="utf-8")
YAML = {path.stem: path for path in sorted(Path(conf_dir(), "method").glob("*.yaml"))}


def blocks(language: str) -> list[str]:
    """The code blocks of the page in a language."""
    fenced = re.findall(r"^```(\w*)\n(.*?)^```$", TEXT, re.DOTALL | re.MULTILINE)
    return [content for marked, content in fenced if marked == language]


def test_the_page_shows_the_list_of_methods_as_it_is_printed(capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["baselines.methods"])
    main()
    printed = capsys.readouterr().out
    monkeypatch.setattr(sys, "argv", ["ctgraph-rl", "methods"])
    cli.main()

    assert printed == capsys.readouterr().out == blocks("")[0]


@pytest.mark.parametrize("name", YAML)
def test_every_yaml_builds_a_method_of_ours(compose, name):
    cfg = compose(f"method={name}")

    built = target(cfg, "method")()

    assert isinstance(built, Method)
    assert type(built).__module__.startswith("baselines.methods.")


def test_every_method_is_listed_but_those_that_only_change_values_of_another():
    listed = [name for name, *_ in methods()]

    assert sorted(YAML.keys() - set(listed)) == ["ewc_published"]
    assert [name for name in YAML if f"`{name}`" not in TEXT and f"method={name}`" not in TEXT] == []


@pytest.mark.parametrize("name", YAML)
def test_a_method_is_named_after_what_it_is_and_its_settings_have_comments(name):
    first, *lines = YAML[name].read_text(encoding="utf-8").splitlines()
    own = lines[1:] if "_target_" in OmegaConf.load(YAML[name]) else []

    assert re.fullmatch(r"# .*\.", first)
    assert [line for line in own if not re.fullmatch(r"\w+: \S+ +# \S.*", line)] == []


@pytest.mark.parametrize(("name", "kind", "ids", "words"), list(methods()), ids=[name for name, *_ in methods()])
def test_a_method_refuses_what_the_list_says_that_it_needs(compose, name, kind, ids, words):
    def refuses(protocol: Protocol, *overrides: str) -> bool:
        method = target(compose(f"method={name}", *overrides), "method")()
        try:
            method.prepare(replace(curricula.load("su_b1_4tasks"), protocol=protocol))
        except ValueError:
            return True
        return False

    assert not refuses(Protocol("one_hot"))
    assert refuses(Protocol("hidden")) == (ids == "yes")
    assert refuses(Protocol("one_hot", "hidden")) == kind.needs_boundaries
    if ids == "heads=multi":
        assert refuses(Protocol("hidden"), "method.heads=multi")


def counted(cell: str, sizes: dict[str, int]) -> int:
    """Bytes as the page has them, such as ``4 P + 4 T``."""
    return sum(int(factor) * sizes[size] for factor, size in re.findall(r"(\d+) ([PHT])", cell))


@pytest.mark.parametrize(
    "name", [name for name in YAML if name not in ("clear", "ewc_published", "finetune", "multitask")]
)
def test_a_method_stores_the_bytes_that_the_page_says(compose, name):
    (row,) = (line for line in TEXT.splitlines() if re.match(rf"\|[^|]*`{name}`[^|]*\|", line) and line.count("|") == 5)
    single = ["method.heads=single"] if "heads" in compose(f"method={name}").method else []
    cfg = compose("curriculum=ct8", "agent=a2c", f"method={name}", *single)
    make_method = target(cfg, "method")
    curriculum = make_method().prepare(target(cfg, "curriculum")())
    agent = new_agent(curriculum, lambda *specs: make_method().attach(target(cfg, "agent")(*specs), curriculum), 0)

    method = agent.agent.method
    stored = sum(each.numel() * each.element_size() for each in (*method.buffers(), *method.parameters()))

    weights, (*_, at_all, by_task, _) = method.weights, row.split("|")
    sizes = {"P": len(weights), "H": int(weights.in_heads.sum()), "T": len(weights.parameters)}
    assert stored == counted(at_all, sizes) + len(curriculum.tasks) * counted(by_task, sizes)


def test_the_page_has_every_hook():
    hooks = {name for name, value in vars(Method).items() if isfunction(value) and not name.startswith("_")}

    assert {"prepare", "loss", "settle"} <= hooks
    assert [hook for hook in hooks - {"attach"} if f"`{hook}(" not in TEXT] == []


def test_an_outsiders_method_is_one_file_and_one_yaml_and_its_agent_comes_back(tmp_path):
    (tmp_path / "my_conf" / "method").mkdir(parents=True)
    (tmp_path / "my_method.py").write_text(blocks("python")[0])
    (tmp_path / "my_conf" / "method" / "l2_init.yaml").write_text(blocks("yaml")[0])
    command = shlex.split(blocks("bash")[1])
    env = {**os.environ, "PYTHONPATH": str(CHECKOUT)}

    result = subprocess.run(
        [sys.executable, *command[1:], "hydra.run.dir=out"], cwd=tmp_path, env=env, capture_output=True, text=True
    )

    assert result.returncode == 0, result.stderr
    training = RunLog.read(tmp_path / "out" / "run.jsonl").of_kind("training")
    assert [m["frames"] for m in training] == [8192 * i for i in range(1, 5)]
    assert all(m["loss_method"] > 0 for m in training)
    names = {}
    exec(compile(blocks("python")[0], "my_method.py", "exec"), names)
    trained = load(tmp_path / "out", make_method=partial(names["L2Init"], coeff=0.001))
    gap = trained.agent.agent.method.weights.vector() - trained.agent.agent.method.first
    assert gap.abs().max() > 0
