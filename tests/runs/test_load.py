"""A run's trained agent, given back from its directory, whoever wrote that."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from helpers.kill_runs import equal
from helpers.learning import train
from helpers.scripted import ONE, TWO
from helpers.small_agents import TINY, others_slow
from helpers.stopped_runs import LEARNED, OWN, SETTINGS, bombs, learn_into, make_agent, stopped_run
from helpers.sweeping import command_line
from hydra.utils import instantiate
from omegaconf import OmegaConf

from baselines.a2c import A2C
from baselines.cells.frames import Frames
from baselines.methods.l2 import L2
from ctgraph_rl import Block, Curriculum, Evaluation, Protocol, evaluate, learn_curriculum
from ctgraph_rl.packages import conf_dir
from ctgraph_rl.runs.checkpoints import Checkpoints
from ctgraph_rl.runs.load import load
from ctgraph_rl.runs.read import read_run
from ctgraph_rl.runs.train import new_agent, with_method

METHODS = sorted(path.stem for path in Path(conf_dir(), "method").glob("*.yaml"))


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> Path:
    """A folder with a ``finished`` run and a ``stopped`` one."""
    folder = tmp_path_factory.mktemp("runs")
    learn_into(folder / "finished")
    stopped_run(folder / "stopped")
    return folder


@pytest.fixture
def copy(runs, tmp_path):
    """A run that a test may change."""
    return Path(shutil.copytree(runs / "finished", tmp_path / "copy"))


def rewrite(run_dir: Path, **changes) -> None:
    """Change the first line of a log."""
    first, *others = (run_dir / "run.jsonl").read_text().splitlines()
    line = {key: value for key, value in {**json.loads(first), **changes}.items() if value is not ...}
    (run_dir / "run.jsonl").write_text("\n".join([json.dumps(line), *others]) + "\n")


def test_a_finished_run_gives_its_agent_that_plays_as_its_log_says_and_learns_on(runs):
    trained = load(runs / "finished")

    agent, log = trained.agent, trained.log
    result = evaluate(agent.policy, trained.curriculum.tasks, 4, initial_state=agent.initial_state)
    assert (type(agent), trained.curriculum, trained.seed, trained.frames) == (A2C, LEARNED, 3, 160)
    assert result["episode_reward"].mean(dim=(1, 2)).tolist() == log.performance()[-1].tolist()
    assert len(learn_curriculum(LEARNED, agent).of_kind("training")) == 5


def test_a_stopped_run_gives_its_agent_as_it_was_saved(runs):
    trained = load(runs / "stopped")

    saved = Checkpoints(runs / "stopped" / "checkpoints").newest()
    assert trained.frames == 64
    assert equal(trained.agent.state_dict(), saved["agent"])


def test_loading_leaves_the_callers_random_state_and_the_directory(runs):
    before, files = torch.get_rng_state(), sorted((path, path.stat().st_mtime_ns) for path in runs.rglob("*"))

    load(runs / "stopped")

    assert torch.equal(torch.get_rng_state(), before)
    assert sorted((path, path.stat().st_mtime_ns) for path in runs.rglob("*")) == files


def learn_with(method: dict, run_dir: Path):
    """An agent as a run left it that wears a method and sees task ids."""
    told = instantiate(method).prepare(replace(LEARNED, protocol=Protocol("one_hot")))
    agent = new_agent(told, with_method(make_agent, lambda: instantiate(method), told), 3)
    train(told, agent, run_dir, 3, config={"agent": SETTINGS, "method": method, "seed": 3})
    return agent


def test_an_agent_that_reads_task_ids_is_refused_where_none_are_shown():
    agent = new_agent(replace(LEARNED, protocol=Protocol("one_hot")), make_agent, 0)

    with pytest.raises(ValueError, match=f"A2C reads task ids, which {LEARNED.name} does not show; give it"):
        learn_curriculum(LEARNED, agent)


def learned_again(agent, curriculum: Curriculum) -> list[dict]:
    """What an agent's log says that learns a curriculum, without the time."""
    torch.manual_seed(5)
    return [{**m, "seconds": 0} for m in learn_curriculum(curriculum, agent).measurements]


@pytest.mark.parametrize("name", others_slow(METHODS, "mask_blc"))
def test_an_agent_comes_back_with_its_method_to_play_every_task_and_to_learn_on(compose, tmp_path, name):
    method = OmegaConf.to_container(compose(f"method={name}").method)
    agent = learn_with(method | ({"heads": "multi"} if "heads" in method else {}), tmp_path)

    trained = load(tmp_path)

    ids = trained.curriculum.task_ids
    assert equal(trained.agent.state_dict(), agent.state_dict())
    for task, number in ids.items():
        assert equal(trained.policy_for(task).state_dict(), agent.policy_for(number).state_dict())
    assert learned_again(trained.agent, trained.curriculum) == learned_again(agent, trained.curriculum)


def test_what_a_method_keeps_for_a_task_acts_in_it(tmp_path):
    learn_with({"_target_": "baselines.methods.scratch.Scratch"}, tmp_path)

    trained = load(tmp_path)

    first, second = (trained.policy_for(task) for task in trained.curriculum.tasks)
    assert second is trained.agent.policy
    assert not equal(first.state_dict(), second.state_dict())
    assert trained.policy_for(replace(ONE, goal_reward=2.0)) is trained.agent.policy  # of no id


class Own(L2):
    """A method that is no baseline's."""


def test_an_agent_comes_back_with_its_cell_and_a_cell_of_someone_else_must_be_given(tmp_path, monkeypatch):
    own = ("cell=frames", "agent.cell.num_frames=3", "curriculum=co_hard", "curriculum.num_frames=64")
    assert command_line(monkeypatch, *own, *TINY, "agent.num_minibatches=1", f"hydra.run.dir={tmp_path / 'run'}") == 0

    trained = load(tmp_path / "run")

    cell = trained.agent.trunk.cell
    assert (type(cell), cell.num_frames, read_run(tmp_path / "run").agent) == (Frames, 3, "LSTMPPO + Frames")
    config = trained.log.of_kind("run")[0]["config"]
    config["agent"]["cell"]["_target_"] = "os.system"
    rewrite(tmp_path / "run", config=config)
    with pytest.raises(ValueError, match=r"is of the cell os.system, no baseline: give load\(..., make_agent=\)"):
        load(tmp_path / "run")


def test_a_method_of_someone_else_must_be_given(tmp_path):
    settings = {"coeff": 0.5, "heads": "single"}
    learn_with({"_target_": f"{__name__}.Own", **settings}, tmp_path)

    with pytest.raises(ValueError, match=r"is of the method .*, no baseline: give load\(\.\.\., make_method=\)"):
        load(tmp_path)

    assert type(load(tmp_path, make_method=partial(Own, **settings)).agent.unwrapped.method) is Own


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("baselines.a2c.A2C", "no baseline: give load"),
        ("baselines.\x1b[2J", r"the method baselines\.\\x1b\[2J, no baseline"),
        ("baselines.methods.ewc.EWC.x", "no baseline: give load"),
        ("baselines.methods.sarsa.SARSA", "and there is no such class"),
        ("baselines.methods.ewc.SampledImportance", "and there is no such class"),
        ("baselines.methods.weights.Weights", "and there is no such class"),
    ],
)
def test_a_method_that_does_not_exist_is_refused(copy, name, message):
    rewrite(copy, config={"agent": SETTINGS, "method": {"_target_": name}, "seed": 3})

    with pytest.raises(ValueError, match=message):
        load(copy)


class Outsiders(A2C):
    """An agent that is no baseline."""


@pytest.mark.parametrize(
    "name", ["os.system", f"{__name__}.Outsiders", "baselines.a2c.A2C.x", "baselines..a2c", "builtins.eval", "x" * 500]
)
def test_an_agent_that_is_no_baseline_must_be_given(copy, name):
    rewrite(copy, config={"agent": {**SETTINGS, "_target_": name}, "seed": 3})

    with pytest.raises(ValueError, match=r"is of the agent .*, no baseline: give load\(\.\.\., make_agent=\)"):
        load(copy)

    assert type(load(copy, partial(Outsiders, **OWN)).agent) is Outsiders


def test_a_class_that_is_given_is_built_with_the_settings_that_the_run_stored(copy):
    rewrite(copy, config={"agent": {**SETTINGS, "_target_": "mine.Outsiders", "unknown": 1}, "seed": 3})

    agent = load(copy, Outsiders).agent

    assert type(agent) is Outsiders
    assert (agent.num_envs, agent.num_steps) == (SETTINGS["num_envs"], SETTINGS["num_steps"])


@pytest.mark.parametrize(
    "name", ["baselines.sarsa.SARSA", "baselines.a2c.SARSA", "baselines.a2c.torch", "baselines.a2c.PolicyGradient"]
)
def test_a_baseline_that_does_not_exist_is_refused(copy, name):
    rewrite(copy, config={"agent": {**SETTINGS, "_target_": name}, "seed": 3})

    with pytest.raises(ValueError, match="and there is no such class"):
        load(copy)


HOSTILE = {
    "no config": {"config": None},
    "a config that is a list": {"config": [1]},
    "an agent that is a text": {"config": {"agent": "a2c", "seed": 3}},
    "no seed": {"config": {"agent": {"_target_": "baselines.a2c.A2C"}, "seed": "3"}},
    "settings that are missing": {"config": {"agent": {"_target_": "baselines.a2c.A2C"}, "seed": 3}},
    "a method that is a text": {"config": {"agent": SETTINGS, "method": "ewc", "seed": 3}},
    "a method without settings": {
        "config": {"agent": SETTINGS, "method": {"_target_": "baselines.methods.ewc.EWC"}, "seed": 3}
    },
    "a method that the weights are not of": {
        "config": {"agent": SETTINGS, "method": {"_target_": "baselines.methods.scratch.Scratch"}, "seed": 3}
    },
    "no fingerprint": {"fingerprint": ...},
    "a kind that is a list": {"kind": []},
    "nested deeply": {"config": json.loads("[" * 400 + "]" * 400)},
}


@pytest.mark.parametrize("changes", HOSTILE.values(), ids=HOSTILE)
def test_a_hostile_first_line_is_a_value_error(copy, changes):
    rewrite(copy, **changes)

    with pytest.raises(ValueError, match=str(copy)):
        load(copy)


def test_another_curriculum_than_the_runs_is_refused(runs):
    other = Curriculum("loaded", 1, "here", (Block(ONE, 96), Block(TWO, 96)), Evaluation(4))

    with pytest.raises(ValueError, match=f"learned a curriculum with fingerprint {LEARNED.fingerprint}, this one has"):
        load(runs / "finished", curriculum=other)


def test_a_curriculum_of_other_classes_must_be_given(copy):
    (copy / "curriculum.json").unlink()

    with pytest.raises(ValueError, match=r"has no curriculum\.json.*give load\(\.\.\., curriculum=\)"):
        load(copy)

    assert load(copy, curriculum=LEARNED).curriculum == LEARNED


def test_a_directory_without_a_run_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"holds no run: no run\.jsonl in it; name a run directory"):
        load(tmp_path)


def test_a_run_that_was_stopped_before_its_first_checkpoint_has_no_agent(runs, tmp_path):
    folder = Path(shutil.copytree(runs / "stopped", tmp_path / "early"))
    shutil.rmtree(folder / "checkpoints")

    with pytest.raises(FileNotFoundError, match=r"neither agent\.pt nor a checkpoint"):
        load(folder)


def test_weights_of_another_agent_are_refused(copy):
    torch.save({"w": torch.zeros(3)}, copy / "agent.pt")

    with pytest.raises(ValueError, match="holds weights that are not of the agent that was built"):
        load(copy)


def test_a_flipped_bit_in_the_weights_is_named(copy):
    content = bytearray((copy / "agent.pt").read_bytes())
    weights = load(copy).agent.state_dict()
    weight = next(w for w in weights.values() if isinstance(w, torch.Tensor) and w.numel() >= 20)
    place = content.index(weight.numpy().tobytes())
    content[place + 5] ^= 4
    (copy / "agent.pt").write_bytes(content)

    with pytest.raises(ValueError, match=r"agent\.pt cannot be read: .* is not what was written; restore it, or run"):
        load(copy)


def test_weights_with_code_in_them_are_refused_and_the_code_never_runs(copy, tmp_path):
    canary = tmp_path / "canary"

    for content in bombs(canary).values():
        (copy / "agent.pt").write_bytes(content)
        with pytest.raises(ValueError, match=r"agent\.pt cannot be read"):
            load(copy)

    assert not canary.exists()
