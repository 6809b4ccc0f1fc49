"""The command line: what it writes, what it refuses, and that a seed decides a run."""

from __future__ import annotations

import re
import shutil
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.kill_runs import equal
from helpers.sweeping import command_line, files_in

import curricula
from baselines.lstm_ppo import LSTMPPO
from ctgraph_rl import Block, CTGraphEnv, Curriculum, Protocol, RunLog, evaluate, learn_curriculum, packages
from ctgraph_rl.log.provenance import NUMBERS, name_in_logs
from ctgraph_rl.log.saved import without_moments
from ctgraph_rl.log.sums import RESULTS, metrics_of
from ctgraph_rl.metrics import definitions
from ctgraph_rl.run import run
from ctgraph_rl.runs import job
from ctgraph_rl.runs.config import target
from ctgraph_rl.runs.job import with_changes
from ctgraph_rl.runs.load import load
from curricula.paper import ct_su_b1

SHORT = ("curriculum.num_frames=1024", "agent.num_envs=128", "agent.num_steps=8", "agent.hidden_size=8")


def measured(run_dir: Path) -> list[dict]:
    """The lines of a run's log without what may differ."""
    return [{**m, "seconds": 0} for m in RunLog.read(run_dir / "run.jsonl").measurements]


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """The folder in which a short run was made; its only run directory is ``finished.run_dir``."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        folder = tmp_path_factory.mktemp("finished")
        monkeypatch.chdir(folder)
        assert command_line(monkeypatch, *SHORT, "hydra.run.dir=out") == 0
    return folder


@pytest.fixture
def copy_of(finished, tmp_path) -> Path:
    """A finished run directory that a test may change."""
    return Path(shutil.copytree(finished / "out", tmp_path / "out"))


def test_a_run_writes_its_results_and_nothing_else(finished):
    hydra_files = {".hydra/config.yaml", ".hydra/hydra.yaml", ".hydra/overrides.yaml"}

    assert set(RESULTS) == {"run.jsonl", "metrics.json", "agent.pt", "curriculum.json"}
    assert files_in(finished) == {f"out/{name}" for name in {*hydra_files, *RESULTS}}


def test_the_first_line_of_the_log_holds_all_that_the_numbers_depend_on(finished):
    first = RunLog.read(finished / "out" / "run.jsonl").measurements[0]

    published = curricula.load("su_b1_4tasks")
    assert first["kind"] == "run"
    assert (first["curriculum"], first["version"]) == ("su_b1_4tasks (modified)", published.version)
    assert first["fingerprint"] == curricula.su_b1_4tasks(num_frames=1024).fingerprint != published.fingerprint
    assert set(first["config"]) == {
        "curriculum",
        "agent",
        "method",
        "seed",
        "device",
        "num_threads",
        "portable",
        "evaluation",
        "protocol",
        "experts",
        "save_optimiser",
        "objective_until",
        "freeze_after",
        "log_units",
    }
    assert first["config"]["curriculum"]["num_frames"] == 1024
    assert set(first["versions"]) == {"ctgraph_rl", "torch", "torchrl", "tensordict", "python"}
    assert (first["num_threads"], first["schema"], first["numbers"]) == (1, 1, NUMBERS)


def test_the_files_of_a_run_agree_with_its_log(finished):
    log = RunLog.read(finished / "out" / "run.jsonl")

    metrics = metrics_of((finished / "out" / "metrics.json").read_bytes())

    assert list(metrics)[:4] == ["average_performance", "forward_transfer", "backward_transfer", "forgetting"]
    assert set(metrics) == set(definitions())
    assert metrics["average_performance"]["value"] == pytest.approx(log.performance()[-1].mean().item(), abs=1e-12)
    assert {m["episodes"] for m in log.of_kind("evaluation")} == {100}


def test_an_agent_saved_without_its_optimiser_has_the_same_weights_and_learns_on(finished, compose, tmp_path):
    run(compose("save_optimiser=false", *SHORT), tmp_path)

    whole, alone = (torch.load(folder / "agent.pt", weights_only=True) for folder in (finished / "out", tmp_path))
    assert equal(alone, without_moments(whole))
    assert not equal(alone, whole)
    agent = load(tmp_path).agent
    learn_curriculum(curricula.su_b1_4tasks(num_frames=1024), agent)
    assert agent.optimiser.state_dict()["state"]


def test_the_saved_agent_performs_as_the_log_says(finished, compose):
    log = RunLog.read(finished / "out" / "run.jsonl")
    tasks = curricula.load("su_b1_4tasks").tasks
    env = CTGraphEnv(tasks)
    agent = target(compose(*SHORT), "agent")(env.observation_spec_unbatched, env.action_spec_unbatched)

    agent.load_state_dict(torch.load(finished / "out" / "agent.pt", weights_only=True))
    result = evaluate(agent.policy, tasks, 20, initial_state=agent.initial_state)

    assert result["episode_reward"].mean(dim=(1, 2)).tolist() == log.performance()[-1].tolist()


def test_the_same_seed_gives_the_same_log(finished, compose, tmp_path):
    run(compose(*SHORT), tmp_path)

    assert measured(tmp_path) == measured(finished / "out")


def test_the_seed_decides_environment_and_evaluation_too(compose, monkeypatch, tmp_path):
    seeds = []

    class Stopped(Exception):
        pass

    def stop(curriculum, group, its_seeds, logs, **_):
        seeds.extend(its_seeds)
        raise Stopped

    monkeypatch.setattr("ctgraph_rl.runs.session.Lockstep", stop)

    with pytest.raises(Stopped):
        run(compose("seed=7"), tmp_path)

    assert seeds == [7]


def test_a_run_builds_one_agent_and_one_training_environment(compose, monkeypatch, tmp_path):
    built = []

    def counted(kind, name):
        original = kind.__init__

        def init(self, *arguments, **settings):
            built.append(name(arguments[0]))
            original(self, *arguments, **settings)

        monkeypatch.setattr(kind, "__init__", init)

    counted(LSTMPPO, lambda specs: "agent")
    counted(CTGraphEnv, lambda tasks: len(tasks))
    cfg = compose(*SHORT, "agent.num_envs=16", "evaluation.before=false", "evaluation.num_episodes=2")
    cfg.curriculum.num_frames = 128

    run(cfg, tmp_path)

    assert sorted(built, key=str) == [16, *[8] * 4, "agent"]  # an evaluation of 4 tasks after each of 4 blocks


def test_a_run_builds_its_curriculum_once_and_writes_it_once(compose, monkeypatch, tmp_path):
    built = []
    written = []
    prove = Curriculum.__post_init__
    monkeypatch.setattr(Curriculum, "__post_init__", lambda self: built.append(self.name) or prove(self))
    to_json = Curriculum.to_json
    monkeypatch.setattr(Curriculum, "to_json", lambda self, path=None: written.append(self.name) or to_json(self, path))

    job.run_job(compose(*SHORT), tmp_path)

    assert (built, written) == (["su_b1_4tasks"], ["su_b1_4tasks"])


def test_a_finished_run_is_shown_and_not_run_again(copy_of, compose, capsys, monkeypatch):
    monkeypatch.setattr(job, "learn", lambda *args: pytest.fail("ran again"))
    before = {name: (copy_of / name).read_bytes() for name in RESULTS}

    run(compose(*SHORT), copy_of)

    shown = capsys.readouterr().out
    assert "this configuration was run before; overwrite=true runs it again" in shown
    assert "average performance" in shown and f"results: {copy_of}" in shown
    assert {name: (copy_of / name).read_bytes() for name in RESULTS} == before


@pytest.mark.parametrize(
    ("override", "difference", "finished_too"),
    [
        ("seed=1", "seed=0 instead of 1;", True),
        ("seed=1", "seed=0 instead of 1;", False),
        ("curriculum.image_seed=2", "curriculum.image_seed=1 instead of 2;", True),
        (
            "agent=dqn",
            "agent._target_='baselines.lstm_ppo.LSTMPPO' instead of 'baselines.dqn.DQN', agent.annealing_num_steps=",
            True,
        ),
    ],
)
def test_another_configuration_is_refused_in_the_directory_of_a_run_and_the_difference_shown(
    copy_of, compose, override, difference, finished_too
):
    if not finished_too:
        (copy_of / "metrics.json").unlink()
    before = {path: path.read_bytes() for path in copy_of.rglob("*") if path.is_file()}

    with pytest.raises(FileExistsError, match=f"holds a run with {re.escape(difference)}") as error:
        run(compose(override, *SHORT), copy_of)

    assert str(error.value).count(" instead of ") <= 5
    assert str(error.value).endswith("; choose another hydra.run.dir, or overwrite=true to replace it")
    assert {path: path.read_bytes() for path in copy_of.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("override", ["resume=strict", "checkpoint_seconds=7", "experts_dir=elsewhere"])
def test_settings_that_change_no_results_are_no_other_configuration(copy_of, compose, override, capsys):
    run(compose(override, *SHORT), copy_of)

    assert "this configuration was run before" in capsys.readouterr().out


def test_a_run_that_was_stopped_before_its_first_checkpoint_starts_anew(copy_of, compose, finished):
    (copy_of / "metrics.json").unlink()
    (copy_of / "run.jsonl").write_bytes((copy_of / "run.jsonl").read_bytes()[:-40])
    for name in ("restarts.jsonl", "failed.txt"):
        (copy_of / name).write_text("{}")

    run(compose(*SHORT), copy_of)

    assert measured(copy_of) == measured(finished / "out")
    assert not (copy_of / "restarts.jsonl").exists() and not (copy_of / "failed.txt").exists()


@pytest.mark.parametrize("name", ["agent.pt", "curriculum.json", "run.jsonl"])
def test_files_of_no_run_are_not_replaced(compose, tmp_path, name):
    (tmp_path / name).write_text('{"kind": "mine"}\n')

    with pytest.raises(FileExistsError, match=f"holds {name}, which are of no run; .* overwrite=true to replace them"):
        run(compose(*SHORT), tmp_path)

    assert (tmp_path / name).read_text() == '{"kind": "mine"}\n'


def test_what_a_kill_at_the_very_end_left_is_removed(copy_of, compose):
    (copy_of / "checkpoints").mkdir()
    (copy_of / "checkpoints" / "000000004096.pt").write_bytes(b"half removed")

    run(compose(*SHORT), copy_of)

    assert not (copy_of / "checkpoints").exists()


def test_overwrite_replaces_a_run_and_another_seed_gives_another_log(copy_of, compose):
    before = RunLog.read(copy_of / "run.jsonl").of_kind("training")

    run(compose(*SHORT, "seed=1", "overwrite=true"), copy_of)

    after = RunLog.read(copy_of / "run.jsonl").of_kind("training")
    assert [m["return_mean"] for m in after] != [m["return_mean"] for m in before]
    assert [m["config"]["seed"] for m in RunLog.read(copy_of / "run.jsonl").of_kind("run")] == [1]
    assert files_in(copy_of) == files_in(copy_of) | set(RESULTS)


def test_a_refused_run_that_may_overwrite_leaves_the_old_results(copy_of, compose):
    with pytest.raises(ValueError, match="hidden_size"):
        run(compose(*SHORT, "agent.hidden_size=0", "overwrite=true"), copy_of)

    assert set(RESULTS) <= files_in(copy_of)


def test_hiding_the_task_id_takes_its_ids_along_and_leaves_boundaries(compose):
    told = Protocol("one_hot", "hidden", num_task_ids=9, task_ids=(4,))
    shown = Curriculum("shown", 1, "here", (Block(ct_su_b1((1, 1)), 256),), protocol=told)

    assert with_changes(shown, compose("protocol.task_id=hidden")).protocol == Protocol(boundaries="hidden")
    assert with_changes(shown, compose()) == shown


def test_only_a_changed_curriculum_is_named_modified(compose):
    published = target(compose(), "curriculum")()
    changed = target(compose("curriculum.image_seed=2"), "curriculum")()
    own = Curriculum("mine", 1, "here", published.blocks)

    assert name_in_logs(published) == "su_b1_4tasks"
    assert name_in_logs(changed) == "su_b1_4tasks (modified)"
    assert name_in_logs(own) == "mine"


def test_a_refused_configuration_does_not_change_what_is_recorded_of_a_run(finished, monkeypatch, tmp_path):
    monkeypatch.chdir(shutil.copytree(finished, tmp_path / "copy"))
    before = Path("out/.hydra/config.yaml").read_text()

    code = command_line(monkeypatch, *SHORT, "hydra.run.dir=out", "seed=1")

    assert code == 1
    assert Path("out/.hydra/config.yaml").read_text() == before


def test_a_multirun_makes_a_directory_for_every_agent(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)

    code = command_line(monkeypatch, "-m", "agent=reinforce,a2c", "evaluation.num_episodes=2", *SHORT)

    run_dirs = sorted(path.parent for path in tmp_path.rglob("metrics.json"))
    assert code == 0
    assert [path.name.split("-seed0-")[0] for path in run_dirs] == ["a2c", "reinforce"]
    assert {path.parent for path in run_dirs} == {tmp_path / "runs" / "su_b1_4tasks"}
    assert all({*RESULTS} <= files_in(path) for path in run_dirs)
    assert {Path(path).parts[0] for path in files_in(tmp_path)} == {"runs"}


def test_the_name_of_a_run_holds_curriculum_agent_seed_and_what_else_changes_results(compose):
    def directory(*overrides: str) -> str:
        return compose("seed=3", *overrides, return_hydra_config=True).hydra.run.dir

    plain, other, same = directory(), directory("agent.gamma=0.5"), directory("overwrite=true")
    worn = directory("method=l2")

    assert re.fullmatch(r"runs/su_b1_4tasks/lstm_ppo-seed3-[0-9a-f]{12}", plain)
    assert re.fullmatch(r"runs/su_b1_4tasks/lstm_ppo-seed3-[0-9a-f]{12}", other)
    assert re.fullmatch(r"runs/su_b1_4tasks/lstm_ppo-l2-seed3-[0-9a-f]{12}", worn)
    assert re.fullmatch(r"runs/su_b1_4tasks/lstm_ppo-gru-l2-seed3-[0-9a-f]{12}", directory("cell=gru", "method=l2"))
    assert other != plain
    assert same == directory("cell=lstm") == plain
    assert directory("cell=lstm", "agent.cell.reads_action=true") != plain
    axes = ("curriculum=axes", "curriculum.configuration=fo_b1")
    written = {directory(*axes, f"curriculum.goals={goals}") for goals in ("[1.2]", '["1.2"]', "[[1,2]]")}
    assert len(written) == 1 and directory(*axes, "curriculum.goals=[1.1]") not in written


def test_a_folder_that_shadows_our_curricula_is_refused_with_its_path(monkeypatch, capsys, tmp_path):
    (tmp_path / "curricula").mkdir()
    (tmp_path / "curricula" / "__init__.py").write_text("")
    monkeypatch.chdir(tmp_path)
    found = ModuleSpec("curricula", None, origin=str(tmp_path / "curricula" / "__init__.py"))
    monkeypatch.setattr(packages, "find_spec", lambda name: found if name == "curricula" else find_spec(name))

    assert command_line(monkeypatch, *SHORT) == 1

    out, err = capsys.readouterr()
    assert f"'curricula' was found in {tmp_path / 'curricula'}" in err
    assert "Traceback" not in err and out == ""
    assert not any(path.endswith("run.jsonl") for path in files_in(tmp_path))


OWN_IMAGES = """
from dataclasses import replace

from ctgraph_rl import Block, Curriculum, ImageFile
from curricula import su_b1_4tasks

def make():
    curriculum = su_b1_4tasks(num_frames=64)
    tasks = [replace(task, images=ImageFile.of("images.npy")) for task in curriculum.tasks[:2]]
    return Curriculum("own", 1, "here", [Block(task, 64) for task in tasks])
"""


def test_relative_paths_are_of_the_directory_of_the_command_also_where_hydra_changes_it(monkeypatch, tmp_path, capsys):
    (tmp_path / "my_conf" / "curriculum").mkdir(parents=True)
    (tmp_path / "my_conf" / "curriculum" / "own.yaml").write_text("_target_: own_images.make\n")
    (tmp_path / "own_images.py").write_text(OWN_IMAGES)
    np.save(tmp_path / "images.npy", np.arange(12 * 12 * 12, dtype=np.uint8).reshape(12, 1, 12, 12))
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    tiny = ("agent=ppo", "agent.num_envs=16", "agent.num_steps=4", "agent.hidden_size=8", "evaluation.num_episodes=2")
    own = ("--config-dir=my_conf", "curriculum=own", "hydra.job.chdir=true", *tiny)

    code = command_line(monkeypatch, *own, "experts=true", "experts_dir=shared", "hydra.run.dir=out")

    assert code == 0
    assert len(list((tmp_path / "shared").iterdir())) == 2 and not (tmp_path / "out" / "shared").exists()
    assert "results: out\n" in capsys.readouterr().out
    assert Path.cwd() == tmp_path


def test_a_users_own_reward_plugs_in_through_yaml(monkeypatch, tmp_path, capsys):
    (tmp_path / "my_rewards.py").write_text(
        "from dataclasses import dataclass\n\n@dataclass(frozen=True)\nclass Flat:\n"
        "    def __call__(self, arrival):\n        return arrival.leaf.float() * 0 + 0.5\n"
    )
    (tmp_path / "my_conf" / "curriculum").mkdir(parents=True)
    (tmp_path / "my_conf" / "curriculum" / "mine.yaml").write_text(
        """
_target_: ctgraph_rl.Curriculum
name: mine
version: 1
source: here
blocks:
  - _target_: ctgraph_rl.Block
    num_frames: 1024
    tasks:
      _target_: ctgraph_rl.Task
      graph: {_target_: ctgraph_rl.CTGraph, branching_factor: 2, depth: 1}
      goal: [2]
      observations: {_target_: ctgraph_rl.Observations, wait_ids: [2, 2], decision_ids: [3, 3], end_ids: [4, 4]}
      images: {_target_: ctgraph_rl.PaperImages, num_images: 5}
      reward_fn: {_target_: my_rewards.Flat}
"""
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)

    code = command_line(monkeypatch, "--config-dir=my_conf", "curriculum=mine", *SHORT[1:], "hydra.run.dir=out")

    training = RunLog.read("out/run.jsonl").of_kind("training")
    assert code == 0
    assert all(m["return_mean"] <= 0.5 for m in training) and training[0]["return_mean"] > 0
