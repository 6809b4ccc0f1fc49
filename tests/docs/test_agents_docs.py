"""The page about agents: it has all members, and its example runs as an outsider would run it."""

from __future__ import annotations

import re
import shlex
import sys

import pytest
import torch
from helpers.paths import CHECKOUT
from helpers.small_agents import KINDS
from helpers.sweeping import command_line

from baselines.parts.catalogue import catalogue
from ctgraph_rl import RunLog, agent
from curricula.paper import ct_su_b1

TEXT = (CHECKOUT / "docs" / "reference" / "agents.md").read_text(encoding="utf-8")
OWN = (CHECKOUT / "docs" / "how-to" / "own_agent.md").read_text(encoding="utf-8")


def blocks(language: str, page: str = OWN) -> list[str]:
    """The code blocks of a page in a language."""
    return re.findall(rf"```{language}\n(.*?)```", page, re.DOTALL)


def test_every_agent_with_a_yaml_is_listed_under_its_name(compose):
    listed = {agent.name: agent.kind for agent in catalogue("agent")}

    assert sorted(listed) == sorted(KINDS)
    for name, kind in listed.items():
        assert compose(f"agent={name}").agent._target_ == f"baselines.{name}.{kind.__name__}"


@pytest.mark.parametrize("name", KINDS)
def test_every_hyperparameter_has_a_comment_in_its_yaml(name):
    first, *lines = (CHECKOUT / "conf" / "agent" / f"{name}.yaml").read_text(encoding="utf-8").splitlines()

    assert first.startswith("# ")
    assert [line for line in lines[1:] if not re.fullmatch(r"\w+: \S+ +# \S.*", line)] == []


@pytest.mark.parametrize("name", KINDS)
def test_an_agent_has_all_members_of_the_protocol(build_agent, name):
    built = build_agent(name, [ct_su_b1()])
    members = {key for key in vars(agent.Agent) if not key.startswith("_")} | set(agent.Agent.__annotations__)

    assert {"policy", "learn", "start_task", "num_envs"} <= members
    assert [key for key in members if not hasattr(built, key)] == []


def test_the_page_has_every_member_of_the_protocol():
    members = {key for key in vars(agent.Agent) if not key.startswith("_")} | set(agent.Agent.__annotations__)

    assert [key for key in members if f"`{key}" not in TEXT] == []


def test_an_outsiders_agent_is_one_file_and_one_yaml(tmp_path, monkeypatch):
    (tmp_path / "my_conf" / "agent").mkdir(parents=True)
    (tmp_path / "my_agent.py").write_text(blocks("python")[0])
    (tmp_path / "my_conf" / "agent" / "mine.yaml").write_text(blocks("yaml")[0])
    start, *settings = blocks("bash")[0].split("ctgraph_rl.run ")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])

    code = command_line(monkeypatch, *shlex.split(settings[0]), "hydra.run.dir=out")
    del sys.modules["my_agent"]

    assert (code, start) == (0, "python -m ")
    training = RunLog.read(tmp_path / "out" / "run.jsonl").of_kind("training")
    assert training[-1]["frames"] == 4 * 4096
    assert all(abs(m["loss_policy"]) < 10 for m in training)
    assert "_extra_state" in torch.load(tmp_path / "out" / "agent.pt", weights_only=True)
