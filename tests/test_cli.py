"""``python -m curricula``, ``ctgraph-rl`` with a command, and the page that lists all curricula."""

import gc
import io
import json
import os
import re
import subprocess
import sys
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from pathlib import Path

import pytest

import curricula
from ctgraph_rl import cli, packages
from ctgraph_rl.cli import first_imports
from ctgraph_rl.describe import FRAMES_PER_SECOND, listing, to_markdown
from ctgraph_rl.tasks.curriculum import Curriculum
from curricula.__main__ import main as curricula_main

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGE = DOCS / "reference" / "curricula.md"
OWN = DOCS / "how-to" / "own_curriculum.md"


@pytest.fixture
def call(monkeypatch, capsys):
    """Calls a command line; gives its exit code, what it printed and its errors."""

    def call_(main, *words: str) -> tuple[int | str, str, str]:
        monkeypatch.setattr(sys, "argv", ["program", *words])
        code = 0
        try:
            main()
        except SystemExit as end:
            code = end.code
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return call_


@pytest.mark.parametrize("words", [(), ("list",)])
def test_without_a_word_all_curricula_are_listed(call, words):
    code, out, err = call(curricula_main, *words)

    su_b1 = curricula.load("su_b1_4tasks")
    assert (code, err) == (0, "")
    assert all(name in out for name in curricula.names())
    assert re.search(rf"su_b1_4tasks +│ +1 │ +4 │ +819,200 │ {su_b1.fingerprint} │ 2 ", out)
    assert "\n2: Soltoggio et al. 2023" in out


@pytest.mark.parametrize("form", ["text", "markdown", "latex"])
def test_one_is_described_by_name(call, form):
    code, out, err = call(curricula_main, "describe", "su_b1_4tasks", "--format", form)

    assert (code, err) == (0, "")
    for word in (curricula.load("su_b1_4tasks").fingerprint, "651", "20 seconds", "goal2.1"):
        assert word in out
    assert {"text": "┃ block ", "markdown": "| block |", "latex": r"\toprule"}[form] in out


def test_one_is_written_and_described_from_its_file(call, tmp_path):
    path = tmp_path / "mine.json"

    code, by_name, _ = call(curricula_main, "describe", "su_b1_4tasks", "--json", str(path))
    assert code == 0
    assert Curriculum.from_json(path) == curricula.load("su_b1_4tasks")
    assert call(curricula_main, "describe", str(path)) == (0, by_name, "")


def test_figures_are_written(call, tmp_path):
    files = [tmp_path / "graphs.pdf", tmp_path / "tasks.svg"]

    code, *_ = call(
        curricula_main, "describe", "su_b1_4tasks", "--figure", str(files[0]), "--similarity", str(files[1])
    )

    assert code == 0
    assert files[0].read_bytes().startswith(b"%PDF") and b"<svg" in files[1].read_bytes()


def test_the_estimate_of_time_follows_the_rate_and_names_the_agent_of_its_own(call):
    assert FRAMES_PER_SECOND == 41_000
    _, own, _ = call(curricula_main, "describe", "su_b1_4tasks", "--format", "markdown")
    assert "20 seconds at 41,000 frames/s, the rate of agent=lstm_ppo on one core (--frames-per-second)" in own
    _, out, _ = call(curricula_main, "describe", "su_b1_4tasks", "--frames-per-second", "1000")
    assert "13.7 minutes at 1,000 frames/s; 0.306 seconds for evaluations, estimated" in out


@pytest.mark.parametrize("words", [(), ("describe", "ct8"), ("describe", "co_hard")])
def test_tables_fit_100_characters_where_no_terminal_says_how_many_there_are(call, words):
    _, out, _ = call(curricula_main, *words)

    assert max(map(len, out.splitlines())) <= 100
    assert "…" not in out


def test_names_numbers_and_headings_are_whole_where_they_need_more_characters(call):
    _, out, _ = call(curricula_main, "describe", "ct8_md")

    assert max(map(len, out.splitlines())) > 100
    assert "…" not in out and "│ goal1.1.1.1.1-d5 │    128 │   32 │ 5.645e-06 │ 0.0001806 │" in out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["describe", "su_b1_4task"], "unknown curriculum 'su_b1_4task'; did you mean 'su_b1_4tasks'?"),
        (["describe", "none.json"], "none.json cannot be opened: no such file or directory; check the path"),
        (["describe", "su_b1_4tasks", "--frames-per-second", "0"], "frames_per_second must be a number > 0, got 0.0"),
        (["describe", "su_b1_4tasks", "--figure", "a.xyz"], "Format 'xyz' is not supported"),
        (["describe", "su_b1_4tasks", "--json", "."], ". exists: choose another path, nothing is overwritten"),
        (["--format", "yaml"], "invalid choice: 'yaml'"),
        (["ct8"], "invalid choice: 'ct8'"),
    ],
)
def test_an_error_is_one_message(call, words, message):
    code, _, err = call(curricula_main, *words)

    assert code == 2
    assert message in err
    assert err.count("\n") == 1


def test_a_broken_file_is_named_with_its_key(call, tmp_path):
    content = curricula.load("su_b1_4tasks").to_json()
    content["tasks"][1]["graph"]["depth"] = 10**9
    (tmp_path / "broken.json").write_text(json.dumps(content))

    code, _, err = call(curricula_main, "describe", str(tmp_path / "broken.json"))

    assert code == 2
    assert "broken.json: tasks[1]: graph: depth=1000000000" in err


def test_the_console_script_knows_the_same_command(call):
    words = ("describe", "su_b1_4tasks", "--format", "markdown")

    assert call(cli.main, "curricula", *words) == call(curricula_main, *words)
    code, out, _ = call(cli.main, "curricula", "--help")
    assert (code, out[:32]) == (0, "usage: ctgraph-rl curricula [-h]")


@pytest.mark.parametrize("command", ["report", "export"])
def test_the_console_script_passes_what_follows_a_command(call, command, tmp_path):
    code, _, err = call(cli.main, command, str(tmp_path), *(["--out", "out"] if command == "export" else []))

    assert code == 2
    assert f"ctgraph-rl {command}" in err and str(tmp_path) in err


def test_garbage_collection_is_paused_during_the_first_import_of_torch_alone(monkeypatch):
    freezes, rarer = [], []
    monkeypatch.setattr(gc, "freeze", lambda: freezes.append(gc.isenabled()))
    monkeypatch.setattr(gc, "set_threshold", lambda *counts: rarer.append(counts))

    with first_imports():  # torch is there
        assert gc.isenabled()
    monkeypatch.delitem(sys.modules, "torch")
    with pytest.raises(ImportError), first_imports():
        assert not gc.isenabled()
        raise ImportError

    assert gc.isenabled()
    assert freezes == [False] and rarer == [(*gc.get_threshold()[:2], 100)]


def in_a_folder_that_shadows(checkout, tmp_path, path, code):
    """The process of a script beside a file that shadows one of our packages."""
    (tmp_path / path).parent.mkdir(exist_ok=True)
    (tmp_path / path).write_text("")
    (tmp_path / "script.py").write_text(code)
    env = {**os.environ, "PYTHONPATH": str(checkout)}
    return subprocess.run([sys.executable, "script.py"], cwd=tmp_path, env=env, capture_output=True, text=True)


def test_what_shadows_ours_is_refused_by_the_commands(checkout, tmp_path):
    code = "import sys; sys.argv = ['x', 'curricula']; from ctgraph_rl.cli import main; main()"

    result = in_a_folder_that_shadows(checkout, tmp_path, "curricula/__init__.py", code)

    assert result.returncode == 1
    error = result.stderr[result.stderr.index("error: ") :]
    assert f"error: package 'curricula' was found in {tmp_path / 'curricula'} instead of" in error
    assert "curricula; rename or move the folder found" in error and "Traceback" not in result.stderr


def shadowed(monkeypatch, name: str, path) -> None:
    """Let Python find a package of ours elsewhere."""
    found = ModuleSpec(name, None, origin=str(path))
    monkeypatch.setattr(packages, "find_spec", lambda asked: found if asked == name else find_spec(asked))


def test_a_file_that_shadows_ours_is_called_a_file(monkeypatch, tmp_path):
    shadowed(monkeypatch, "curricula", tmp_path / "curricula.py")

    with pytest.raises(ValueError, match=r"'curricula' was found in .*curricula\.py instead of .*; .* the file found"):
        packages.check_packages()


def test_a_trained_agent_is_refused_where_a_folder_is_named_baselines(monkeypatch, tmp_path):
    shadowed(monkeypatch, "baselines", tmp_path / "baselines" / "__init__.py")

    with pytest.raises(ValueError, match=r"'baselines' was found in .*/baselines instead of .*; .* the folder found"):
        packages.class_named("baselines.dqn", "DQN")


@pytest.mark.parametrize(
    "code",
    [
        "import ctgraph_rl, curricula; curricula.load('ct8')",
        pytest.param("import curricula; from ctgraph_rl import Task; curricula.load('ct8')", marks=pytest.mark.slow),
    ],
)
def test_what_shadows_ours_is_named_where_python_imports_it(checkout, tmp_path, code):
    result = in_a_folder_that_shadows(checkout, tmp_path, "curricula/__init__.py", code)

    first, *_ = result.stderr.splitlines()
    assert f"script.py:1: UserWarning: package 'curricula' was found in {tmp_path / 'curricula'} instead of" in first
    assert first.endswith("; rename or move the folder found")
    assert "has no attribute 'load'" in result.stderr


@pytest.mark.slow
def test_a_folder_named_baselines_leaves_the_environment_usable_and_trained_agents_not(checkout, tmp_path):
    code = (
        "from ctgraph_rl.tasks.configurations import ct_su_b1; from ctgraph_rl import packages; print(ct_su_b1().goal)"
    )
    code += "; packages.class_named('baselines.dqn', 'DQN')"

    result = in_a_folder_that_shadows(checkout, tmp_path, "baselines/__init__.py", code)

    assert result.stdout == "(1, 1)\n"
    assert "ValueError: package 'baselines' was found in" in result.stderr


OWN_CURRICULUM = """
from ctgraph_rl import Block, Curriculum
from ctgraph_rl.tasks.configurations import ct_su_b1

def make(num_frames):
    return Curriculum("mine", 1, "me", [Block(ct_su_b1(goal), num_frames) for goal in ((1, 1), (2, 2))])

def nothing():
    return {}
"""


@pytest.fixture
def my_conf(tmp_path, monkeypatch):
    """A directory as of ``ctgraph-rl --config-dir my_conf curriculum=my-own``, below the working directory."""
    (tmp_path / "my_conf" / "curriculum").mkdir(parents=True)
    (tmp_path / "my_conf" / "curriculum" / "my-own.yaml").write_text("_target_: my_own_tasks.make\nnum_frames: 1024\n")
    (tmp_path / "my_own_tasks.py").write_text(OWN_CURRICULUM)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(sys, "stdin", io.StringIO("q"))
    return tmp_path / "my_conf"


@pytest.mark.parametrize(
    ("words", "shown"),
    [
        ("curricula --config-dir my_conf", "mine"),
        ("curricula --config-dir my_conf describe my-own --format markdown", "goal2.2"),
        ("curricula describe my-own --config-dir my_conf", "goal2.2"),
        ("curricula describe ct8 --config-dir my_conf", "ct8"),
        ("draw my-own --task 2 --config-dir my_conf --dot task.dot", ""),
        ("play my-own --config-dir my_conf", "You see what an agent sees"),
    ],
)
def test_a_curriculum_of_a_configuration_directory_is_known_to_the_commands(call, my_conf, words, shown):
    code, out, err = call(cli.main, *words.split())

    said = "written: task.dot\n" if "--dot" in words else ""
    assert (code, err) == (0, said) and shown in out
    if "--dot" in words:
        assert "mine, task 2: goal2.2" in (my_conf.parent / "task.dot").read_text()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            "curricula describe mien --config-dir my_conf",
            "unknown curriculum 'mien'.*; in my_conf: broken, my-own, plain",
        ),
        ("draw my-own --config-dir there --dot task.dot", "--config-dir must be a directory, got there"),
        ("draw my-own --config-dir my_conf --depth 3 --dot task.dot", "my-own takes no depth"),
        ("curricula describe broken --config-dir my_conf", "curriculum has no frames: did you mean 'num_frames'?"),
        (
            "curricula describe plain --config-dir my_conf",
            "my_own_tasks.nothing must make a Curriculum, it made a dict",
        ),
    ],
)
def test_what_is_wrong_with_a_configuration_directory_is_one_message(call, my_conf, words, message):
    (my_conf / "curriculum" / "broken.yaml").write_text("_target_: my_own_tasks.make\nframes: 1024\n")
    (my_conf / "curriculum" / "plain.yaml").write_text("_target_: my_own_tasks.nothing\n")

    code, out, err = call(cli.main, *words.split())

    assert (code, out) == (2, "") and re.search(message, err)


def test_the_command_prints_the_listing_of_all_curricula(checkout):
    command = [sys.executable, "-m", "curricula", "--format", "markdown"]

    result = subprocess.run(command, cwd=checkout, capture_output=True, text=True, check=True)

    assert result.stdout == to_markdown(listing(map(curricula.load, curricula.names())))


def test_the_python_of_the_pages_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = PAGE.read_text(encoding="utf-8") + OWN.read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    names = {}

    for code in blocks:
        exec(compile(code, str(PAGE), "exec"), names)

    assert len(blocks) >= 3
    assert {path.suffix for path in tmp_path.iterdir()} == {".json", ".npy", ".pdf"}
    assert names["back"] == names["mine"]


@pytest.mark.parametrize("command", ["agents", "methods"])
@pytest.mark.parametrize(
    ("word", "code", "said"), [("--help", 0, "usage: "), ("ewc", 2, "unrecognized arguments: ewc")]
)
def test_lists_take_no_arguments_but_help(call, command, word, code, said):
    found, out, err = call(cli.main, command, word)

    assert found == code
    assert said in (out if code == 0 else err) and "ctgraph-rl " + command in out + err
