"""Settings of runs: one that is added later loses no earlier run."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from helpers.sweeping import command_line

from ctgraph_rl import load, run
from ctgraph_rl.log import provenance
from ctgraph_rl.log.files import AGENT, CHECKPOINTS
from ctgraph_rl.runs import job, read, settings
from ctgraph_rl.runs.checkpoints import Checkpoints
from ctgraph_rl.runs.config import run_name

SHORT = ("curriculum=fo_b1_4tasks", "curriculum.num_frames=64", "evaluation.num_episodes=2")
YAML = """
defaults:
  - a2c
  - _self_
num_envs: 8
num_steps: 4
hidden_size: 4
_target_: added_later.Agent
"""
CODE = """
from baselines.a2c import A2C

class Agent(A2C):
    def __init__(self, *specs, {argument}**settings):
        super().__init__(*specs, **settings)
"""


class Stopped(BaseException):
    """As if the process had been killed."""


@pytest.fixture
def command(tmp_path, monkeypatch):
    """Runs ``ctgraph-rl`` with an own agent, whose yaml and class may have one setting more; the run's directory."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))  # to which a run adds the working directory
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    (tmp_path / "conf" / "agent").mkdir(parents=True)

    def start(*overrides: str, added: str | None = None) -> Path:
        more = "" if added is None else f"cell: {added}\n"
        (tmp_path / "conf" / "agent" / "mine.yaml").write_text(YAML + more)
        (tmp_path / "added_later.py").write_text(CODE.format(argument="cell, " if more else ""))
        sys.modules.pop("added_later", None)
        monkeypatch.setattr(provenance, "OURS", (*provenance.OURS, "added_later"))  # as a module of ours
        monkeypatch.setattr(settings, "ADDED", {} if added is None else {"added_later.Agent": {"cell": "lstm"}})
        monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
        monkeypatch.setattr(sys, "argv", ["ctgraph-rl", "--config-dir", "conf", *SHORT, "agent=mine", *overrides])
        run.main()
        return max((tmp_path / "runs").glob("*/*"), key=lambda folder: folder.stat().st_mtime)

    return start


def test_a_setting_that_is_added_with_the_value_for_as_before_is_the_same_run(command, capsys):
    before = command()

    assert command(added="lstm") == before
    assert "this configuration was run before" in capsys.readouterr().out
    assert command("agent.cell=gru", added="lstm") != before


def stop_after_a_block(monkeypatch, start, *overrides: str) -> None:
    """Start a run that ends with its first block as if it had been killed."""
    offer = Checkpoints.offer

    def stop(self, state, at_block_end):
        offer(self, state, at_block_end)
        if at_block_end:
            raise Stopped

    with monkeypatch.context() as patch, pytest.raises(Stopped):
        patch.setattr(Checkpoints, "offer", stop)
        start(*overrides)


@pytest.mark.slow
def test_a_stopped_run_is_resumed_after_a_setting_was_added(command, monkeypatch):
    whole = (command() / AGENT).read_bytes()
    stop_after_a_block(monkeypatch, command, "overwrite=true")
    (stopped,) = Path("runs").glob("*/*")
    assert len(list((stopped / CHECKPOINTS).iterdir())) > 0

    resumed = command(added="lstm")

    assert (resumed / AGENT).read_bytes() == whole
    assert (resumed / "restarts.jsonl").exists()


MINE = {"_target_": "mine.Agent", "gamma": 0.9}
LSTM, GRU = {**MINE, "cell": "lstm"}, {**MINE, "cell": "gru"}


def test_without_added_settings_all_count():
    stored, given = {"agent": {"a": 1}, "seed": 0}, {"agent": {"a": 2}, "seed": 0}

    assert settings.differences(stored, given) == ["agent.a=1 instead of 2"]
    assert settings.as_before({"agent": LSTM, "seed": 0}) == {"agent": LSTM, "seed": 0}


def test_settings_that_were_added_have_their_value_in_runs_without_them(monkeypatch):
    added = {"mine.Agent": {"cell": "lstm"}, "run": {"meta.enabled": False, "device": "cpu"}}
    monkeypatch.setattr(settings, "ADDED", added)
    stored, same = {"agent": MINE, "seed": 0}, {"agent": LSTM, "seed": 0, "device": "cpu", "meta": {"enabled": False}}

    assert settings.differences(stored, same) == settings.differences(same, stored) == []
    assert settings.digest(stored) == settings.digest(same)
    assert settings.as_before(same) == stored
    assert settings.with_added(MINE) == LSTM
    assert settings.with_added(GRU) == GRU


@pytest.mark.parametrize(
    ("change", "difference"),
    [
        ({"agent": GRU}, "agent.cell='lstm' instead of 'gru'"),
        ({"meta": {"enabled": 0}}, None),  # equal in Python, and yet another name
        ({"meta": {"enabled": True}}, "meta.enabled=False instead of True"),
        ({"agent": {**LSTM, "_target_": "theirs.Agent"}}, "agent._target_='mine.Agent' instead of 'theirs.Agent'"),
    ],
)
def test_settings_of_another_value_or_target_are_another_run(monkeypatch, change, difference):
    monkeypatch.setattr(settings, "ADDED", {"mine.Agent": {"cell": "lstm"}, "run": {"meta.enabled": False}})
    stored = {"agent": MINE, "seed": 0}

    assert settings.digest({**stored, **change}) != settings.digest(stored)
    assert difference is None or difference in settings.differences(stored, {**stored, **change})


def test_an_added_setting_may_be_a_group(monkeypatch):
    monkeypatch.setattr(settings, "ADDED", {"mine.Agent": {"options": {"a": 1, "b": None}}})
    more = {"agent": {**MINE, "options": {"b": None, "a": 1}}}

    assert settings.digest(more) == settings.digest({"agent": MINE})
    assert settings.differences(more, {"agent": MINE}) == []


def test_runs_from_before_and_after_a_setting_was_added_are_one_group(tmp_path, monkeypatch):
    monkeypatch.setattr(settings, "ADDED", {"mine.Agent": {"cell": "lstm"}})
    first = {"kind": "run", "curriculum": "c", "fingerprint": "f"}
    for name, more in (("old", {}), ("new", {"cell": "lstm"}), ("other", {"cell": "gru"})):
        (tmp_path / name).mkdir()
        config = {"agent": {"_target_": "mine.Agent", **more}, "seed": 0}
        (tmp_path / name / "run.jsonl").write_text(json.dumps({**first, "config": config}) + "\n")

    old, new, other = (read.read_run(tmp_path / name).configuration for name in ("old", "new", "other"))

    assert old == new != other


def test_a_stored_agent_without_a_setting_that_was_added_is_loaded(tmp_path, monkeypatch, compose):
    from baselines import a2c

    small = ("agent.num_envs=8", "agent.num_steps=4", "agent.hidden_size=4")
    job.run_job(compose(*SHORT, "agent=a2c", *small), tmp_path)
    original = a2c.A2C.__init__

    class Later(a2c.A2C):
        def __init__(self, *specs, cell, **arguments):
            assert cell == "lstm"
            original(self, *specs, **arguments)

    Later.__module__ = "baselines.a2c"
    monkeypatch.setattr(a2c, "A2C", Later)
    with pytest.raises(ValueError, match="cell"):
        load(tmp_path)

    monkeypatch.setattr(settings, "ADDED", {"baselines.a2c.A2C": {"cell": "lstm"}})

    assert load(tmp_path).frames == 256


EARLIER = ("agent=reinforce", "agent.num_envs=256", "agent.num_steps=8")
"""REINFORCE with the default that it had before its batches held whole episodes."""

OF_EARLIER = "su_b1_4tasks/reinforce-seed0-582d911d9d30"
"""What ``agent=reinforce`` without more named such a run then."""


SHORT_TASK = ("curriculum=su_b1_4tasks", "curriculum.num_frames=2048", "evaluation.num_episodes=2")


def test_a_changed_default_is_another_run_and_earlier_runs_keep_their_names(compose):
    cells = ((*SHORT_TASK, *EARLIER), (*SHORT_TASK, "agent=reinforce"))

    earlier, now = (run_name(_root_=compose(*cell, return_hydra_config=True)) for cell in cells)

    assert earlier == OF_EARLIER
    assert now != earlier


@pytest.mark.slow
def test_a_run_of_an_earlier_default_is_found_loaded_and_resumed(tmp_path, monkeypatch):
    def start(*overrides: str) -> int:
        return command_line(monkeypatch, *SHORT_TASK, *EARLIER, *overrides)

    monkeypatch.chdir(tmp_path)
    run_dir = tmp_path / "runs" / OF_EARLIER
    start()
    whole = (run_dir / AGENT).read_bytes()
    stop_after_a_block(monkeypatch, start, "overwrite=true")

    assert load(run_dir).agent.num_envs == 256
    assert start() == 0
    assert (run_dir / AGENT).read_bytes() == whole and (run_dir / "restarts.jsonl").exists()
