"""CONTRIBUTING's table of what to add where: its files exist, and a toy of ten changes needs no other ones."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import pytest
import torch
from helpers.paths import CHECKOUT
from helpers.scripted import ONE, TWO, Scripted, of
from helpers.small_agents import MINIBATCHES, TINY

import curricula
from baselines.cells.cell import Cell, linear_layer
from ctgraph_rl import Block, CTGraphEnv, Evaluation, learn_curriculum, metrics
from ctgraph_rl.core import rewards
from ctgraph_rl.learn.loop import run_loop
from ctgraph_rl.log.scores import scores
from ctgraph_rl.metrics.record import METRICS, defined
from ctgraph_rl.report import formats
from ctgraph_rl.report.results import Row
from ctgraph_rl.report.statistics import Estimate
from ctgraph_rl.runs import config
from ctgraph_rl.runs.explain import LAUNCHERS, explain
from ctgraph_rl.runs.job import with_changes
from ctgraph_rl.runs.train import new_agent
from ctgraph_rl.tasks import protocol

ROWS = dict(re.findall(r"^\| (an? [\w ]+) \| (.*) \|$", (CHECKOUT / "CONTRIBUTING.md").read_text(), re.MULTILINE))
TWO_BLOCKS = of(Block(ONE, 24), Block(TWO, 24), evaluation=Evaluation(2))


@pytest.mark.parametrize("what", ROWS)
def test_the_files_that_a_row_names_exist(what):
    named = re.findall(r"`((?:[\w.-]+/)+[\w.-]*|pyproject\.toml)`", ROWS[what])
    dotted = re.findall(r"`((?:ctgraph_rl|baselines)\.[\w.]+)`", ROWS[what])

    places = [CHECKOUT / re.sub(r"NAME.*", "", name) for name in named]
    places += [CHECKOUT / name.rpartition(".")[0].replace(".", "/") for name in dotted]
    missing = [place for place in places if not (place.exists() or place.with_suffix(".py").exists())]
    assert (named or dotted) and missing == []


class Latch(Cell):
    state_keys = ("latch",)
    holds = "the largest of each number that it has read"

    def __init__(self, *sizes: int, **reads: bool) -> None:
        super().__init__(*sizes, **reads)
        self.linear = linear_layer(self.num_inputs, self.num_outputs)

    def step(self, inputs, state):
        after = torch.maximum(state[0], self.linear(inputs))
        return after, (after,)


def test_a_cell_is_a_class(compose):
    make = config.target(compose("agent=lstm_ppo", *TINY, *MINIBATCHES), "agent")
    agent = new_agent(TWO_BLOCKS, lambda *specs: make(*specs, cell=Latch), 0)

    log = learn_curriculum(TWO_BLOCKS, agent)

    assert len(log.of_kind("training")) == 2 and "latch" in agent.initial_state(1)


def test_a_metric_is_a_defined_function(monkeypatch):
    monkeypatch.setitem(METRICS, "best_at_the_end", METRICS["average_performance"])
    del METRICS["best_at_the_end"]  # again after the test

    @defined("test/toy", "max_j R[last,j]", "test")
    def best_at_the_end(performance):
        return performance[-1].amax()

    log = learn_curriculum(TWO_BLOCKS, Scripted(num_envs=4, num_steps=3))

    assert "best_at_the_end" in metrics.definitions()
    assert scores(log, TWO_BLOCKS)["best_at_the_end"].value == 1.0


def widest(values: list[float]) -> Estimate:
    return Estimate(max(values), len(values), 0, "largest, with the range", low=min(values), high=max(values))


@pytest.mark.parametrize("form", formats.FORMATS)
def test_a_statistic_is_a_function_and_every_format_shows_it(form):
    row = Row("two", "Mine", "average_performance", widest([0.25, 0.75]), "test/toy", "")

    shown = formats.FORMATS[form]([row], {}, "largest [range]")

    assert all(number in shown for number in ("0.75", "0.25"))


def test_a_format_is_a_function(monkeypatch):
    monkeypatch.setitem(formats.FORMATS, "names", lambda rows, modified, legend: " ".join(row.agent for row in rows))
    row = Row("two", "Mine", "average_performance", widest([0.5]), "test/toy", "")

    assert formats.FORMATS["names"]([row, row], {}, "") == "Mine Mine"
    assert tuple(formats.FORMATS)[:-1] == formats.TABLE_FORMATS and {*formats.SENTENCES} == {*formats.TABLE_FORMATS}


@dataclass(frozen=True)
class Half:
    def __call__(self, arrival):
        return torch.full_like(arrival.leaf, 0.5, dtype=torch.float32)


def test_a_reward_is_a_class(monkeypatch):
    monkeypatch.setitem(rewards.REWARD_FNS, "half", Half)

    curriculum = curricula.from_axes("fo_b1", reward_fn="half", num_frames=24)
    log = learn_curriculum(replace(curriculum, blocks=curriculum.blocks[:1]), Navigator())

    assert {m["return_mean"] for m in log.of_kind("evaluation")} == {0.5}


class Navigator(Scripted):
    """Waits where it must, and takes the first branch."""

    def __init__(self) -> None:
        super().__init__(self.act)

    def act(self, data):
        steps = data["step_count"].squeeze(-1)
        return data.set("action", (steps % 2 == 0).logical_and(steps > 0).long())


class Turns:
    """Two members, of which each learns from every second batch."""

    returns = (0.5,)
    block = 1
    is_at_block_end = can_resume = True

    def __init__(self) -> None:
        self.frames = 0
        self.learned: list[int] = []

    def advance(self) -> bool:
        if self.frames == 4 * 8:
            return False
        self.learned.append(self.frames // 8 % 2)
        self.frames += 8
        return True

    def state(self) -> Any:
        return list(self.learned)


def test_a_coupling_is_a_class():
    members = Turns()
    offered = []

    run_loop(members, None, lambda state, at_end: offered.append(state()))

    assert members.learned == [0, 1, 0, 1] and offered[-1] == [0, 1, 0, 1]


def test_a_launcher_is_named_with_its_extra(compose, monkeypatch):
    monkeypatch.setitem(LAUNCHERS, "hydra/launcher/grid", "grid")

    with pytest.raises(Exception) as refused:
        compose("hydra/launcher=grid", return_hydra_config=True)

    assert "pip install 'ctgraph_rl[grid]'" in explain(refused.value)


def test_a_boundary_is_a_name_and_a_property(monkeypatch):
    monkeypatch.setattr(protocol, "BOUNDARIES", (*protocol.BOUNDARIES, "whispered"))
    monkeypatch.setattr(protocol.Protocol, "announces", property(lambda how: how.boundaries != "hidden"))
    agents = {name: Scripted() for name in protocol.BOUNDARIES}

    for name, agent in agents.items():
        learn_curriculum(replace(TWO_BLOCKS, protocol=protocol.Protocol(boundaries=name)), agent)

    assert agents["whispered"].events == agents["announced"].events != agents["hidden"].events


@dataclass(frozen=True)
class Louder(Evaluation):
    loud: bool = field(default=False, metadata={"added": True})


def test_an_option_of_evaluations_is_a_field(compose):
    curriculum = replace(TWO_BLOCKS, evaluation=Louder(2))

    changed = with_changes(curriculum, compose("+evaluation.loud=true"))

    assert changed.evaluation == Louder(2, loud=True) and changed.fingerprint != curriculum.fingerprint


class CorridorEnv(CTGraphEnv):
    def set_tasks(self, tasks, at_episode_end=False):
        super().set_tasks([ONE] * len(tasks), at_episode_end)


@dataclass(frozen=True)
class Corridor:
    """A kind of tasks whose environment has the dynamics of another."""

    label: str = "corridor"
    observation_shape: ClassVar[tuple[int, ...]] = ONE.observation_shape
    num_actions: ClassVar[int] = 3

    @property
    def label_parts(self):
        return {"corridor": self.label}

    @classmethod
    def make_env(cls, tasks, seed=0, **settings):
        return CorridorEnv([ONE] * len(tasks), seed)


def test_a_kind_of_tasks_is_a_class():
    curriculum = of(Block(Corridor(), 24), evaluation=Evaluation(2))

    log = learn_curriculum(curriculum, Scripted())

    assert [m["return_mean"] for m in log.of_kind("evaluation")] == [1.0, 1.0]
