"""``ctgraph-rl`` itself: its usage, its versions, the words it knows, and what it does not import to answer."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from importlib.metadata import version

import pytest

import ctgraph_rl
from baselines.parts.catalogue import catalogue
from ctgraph_rl import cli, run


@pytest.fixture
def call(monkeypatch, capsys):
    """Calls ``ctgraph-rl WORDS``; gives its exit code, what it printed and its errors."""

    def call_(*words: str) -> tuple[int | str | None, str, str]:
        monkeypatch.setattr(sys, "argv", ["ctgraph-rl", *words])
        code = 0
        try:
            cli.main()
        except SystemExit as end:
            code = end.code
        return code, *capsys.readouterr()

    return call_


@pytest.mark.parametrize("word", ["=4", "curriculum.depth", "="])
def test_a_setting_to_choose_runs_by_has_a_name_and_a_value(call, word):
    code, _, said = call("submit", "runs", "--to", "made", "--only", word)

    assert code == 2
    assert f"settings are written as in curriculum.depth=4, got {word!r}" in said


@pytest.fixture
def runs(monkeypatch) -> list[list[str]]:
    """The settings of the runs that are started, which then do nothing."""
    started: list[list[str]] = []
    monkeypatch.setattr(run, "main", lambda: started.append(sys.argv[1:]))
    return started


def test_alone_it_shows_usage_each_command_with_a_line_and_six_settings(call, runs):
    code, out, err = call()

    assert (code, err, runs) == (0, "", [])
    assert out.startswith("usage: ctgraph-rl ")
    assert all(re.search(rf"^  {name} +\w.{{10}}", out, re.MULTILINE) for name in cli.COMMANDS)
    assert len(re.findall(r"^  [\w.]+=\S+ +\w.{10}", out, re.MULTILINE)) == 6
    assert max(map(len, out.splitlines())) <= 100
    assert call("--help") == call("-h") == (0, out, "")


def test_the_settings_that_it_shows_are_settings_of_a_run(compose):
    names = [setting.partition("=")[0] for setting in cli.SETTINGS]

    cfg = compose()

    assert all(name in cfg or name.split(".")[1] in cfg[name.split(".")[0]] for name in names)


@pytest.mark.parametrize(
    ("words", "settings"),
    [
        (["run"], []),
        (["run", "seed=1"], ["seed=1"]),
        (["run", "--help"], ["--help"]),
        *(
            ([*words], [*words])
            for words in (["seed=1"], ["-m", "seed=1,2"], ["~logger"], ["+new=1"], ["--hydra-help"])
        ),
    ],
)
def test_the_command_run_and_settings_alone_start_a_run(call, runs, words, settings):
    assert call(*words)[0] == 0
    assert runs == [settings]


def test_the_module_is_the_command():
    result = subprocess.run([sys.executable, "-m", "ctgraph_rl.cli", "--version"], capture_output=True, text=True)

    assert result.stdout == f"{cli.versions()}\n"


def test_the_version_is_its_own_with_those_of_what_it_is_built_on(call):
    code, out, err = call("--version")

    assert (code, err) == (0, "")
    others = ", ".join(f"{name} {version(name)}" for name in ("torch", "torchrl", "hydra-core"))
    assert out == f"ctgraph_rl {ctgraph_rl.__version__} ({others})\n"


@pytest.mark.parametrize(
    ("word", "meant"),
    [
        ("curiculum", "curricula"),
        ("Curricula", "curricula"),
        ("RUN", "run"),
        ("describe", "curricula describe"),
        ("help", "--help"),
        ("curriculum", "curriculum=NAME"),
        ("PPO", "agent=ppo"),
        ("train", "run"),
        ("plot", "report"),
        ("su-b1-4tasks", "curriculum=su_b1_4tasks"),
    ],
)
def test_an_unknown_word_is_refused_with_what_may_have_been_meant(call, runs, word, meant):
    code, out, err = call(word)

    assert (code, out, runs) == (2, "", [])
    first, second = err.splitlines()
    assert first == f"error: unknown command {word!r}; did you mean ctgraph-rl {meant}?"
    assert second.startswith("Commands: run, agents, board, collectives, compare, curricula, ")


LISTS = ("", "--version", "curiculum", "agents", "methods", "curricula", "curricula list --format markdown", "agent=pp")
MISSING = ("results nowhere", "report nowhere", "collectives nowhere")
HELPS = tuple(f"{name} --help" for name in cli.COMMANDS)

ONE_AFTER_THE_OTHER = """
import sys
from ctgraph_rl.cli import main
from contextlib import suppress
for words in sys.argv[1:]:
    sys.argv = ["ctgraph-rl", *words.split()]
    with suppress(SystemExit):
        main()
    print("ENDED", words, "torch" in sys.modules, flush=True)
"""


def test_what_only_lists_or_names_a_missing_folder_imports_no_torch(checkout, tmp_path):
    env = {**os.environ, "PYTHONPATH": str(checkout)}
    words = (*LISTS, *HELPS, *MISSING)
    command = [sys.executable, "-c", ONE_AFTER_THE_OTHER, *words]

    result = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True)

    ended = [line for line in result.stdout.splitlines() if line.startswith("ENDED")]
    assert ended == [f"ENDED {each} False" for each in words], result.stderr
    assert result.stderr.count("nowhere holds no run") == len(MISSING)


@pytest.mark.parametrize(
    ("group", "names"),
    [("agent", ("memory", "solves")), ("cell", ("memory", "holds")), ("method", ("needs_task_id", "needs_boundaries"))],
)
def test_the_facts_of_a_list_are_those_of_the_classes(group, names):
    entries = list(catalogue(group))

    assert len(entries) > 5
    for entry in entries:
        assert {name: entry.facts[name] for name in names} == {name: getattr(entry.kind, name) for name in names}


def test_lists_have_the_agents_and_methods_of_a_configuration_directory(call, tmp_path):
    for group, text in {"agent": "# Mine.\n_target_: my.Agent\n", "method": "_target_: my.Method\n"}.items():
        (tmp_path / group).mkdir()
        (tmp_path / group / "mine.yaml").write_text(text)

    _, agents, _ = call("agents", "--config-dir", str(tmp_path))
    _, methods, _ = call("methods", "--config-dir", str(tmp_path))
    code, _, refused = call("agents", "--config-dir", str(tmp_path / "none"))

    assert ["mine", "-", "Mine."] in [line.split() for line in agents.splitlines()]
    assert ["mine", "-", "-", "my.Method"] in [line.split() for line in methods.splitlines()]
    assert (code, "--config-dir must be a directory, got" in refused) == (2, True)
