"""How commands end: where nobody reads them, and with the help of each."""

from __future__ import annotations

import subprocess
import sys

import pytest
from helpers.made_runs import write_run
from helpers.sweeping import command_line

from ctgraph_rl import cli, run
from ctgraph_rl.cli import command


def test_a_pipe_that_breaks_elsewhere_is_an_error(monkeypatch):
    def breaks() -> None:
        raise BrokenPipeError("another pipe")

    monkeypatch.setattr(cli, "_call", breaks)

    with pytest.raises(BrokenPipeError, match="another pipe"):
        cli.main()


@pytest.mark.parametrize(
    "words",
    [
        "agents",
        *(pytest.param(words, marks=pytest.mark.slow) for words in ("", "curricula", "results RUNS", "run --help")),
    ],
)
def test_a_reader_that_goes_away_ends_a_command_quietly(checkout, tmp_path, words):
    write_run(tmp_path / "run")
    call = [
        sys.executable,
        "-c",
        "from ctgraph_rl.cli import main; main()",
        *words.replace("RUNS", str(tmp_path)).split(),
    ]
    command = subprocess.Popen(call, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=checkout)

    command.stdout.close()

    assert command.stderr.read() == ""
    assert command.wait() == 1


def test_a_run_whose_output_nobody_reads_ends_quietly(checkout, tmp_path):
    code = "import sys; sys.path.insert(0, sys.argv.pop(1)); import ctgraph_rl.run as job"
    code += "; job.run = lambda cfg, run_dir: print('a result' * 9999); job.main()"
    command = [sys.executable, "-c", code, str(checkout), "seed=1"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path)

    process.stdout.close()

    assert process.stderr.read() == ""
    assert process.wait() == 1


def test_another_pipe_that_breaks_in_a_run_is_one_message(monkeypatch, capsys, tmp_path):
    def breaks(cfg, run_dir):
        raise BrokenPipeError("a tracker is gone")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(run, "run", breaks)

    assert command_line(monkeypatch, "seed=1") == 1
    assert capsys.readouterr().err == "error: a tracker is gone\n"


@pytest.mark.parametrize("name", [name for name in cli.COMMANDS if name != "run"])
def test_the_help_of_each_command_names_ctgraph_rl(monkeypatch, capsys, name):
    monkeypatch.setattr(sys, "argv", ["__main__.py", "--help"])

    with pytest.raises(SystemExit):
        command(cli.COMMANDS[name].module)()

    assert capsys.readouterr().out.startswith(f"usage: ctgraph-rl {name} ")
