"""``together=true``: seeds of a sweep that one job trains; each leaves a run like any other."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers.kill_runs import equal
from helpers.sweeping import command_line, sweep
from omegaconf import DictConfig

from baselines.update.seeds import SeedGroup
from ctgraph_rl import RunLog, disk
from ctgraph_rl.compare import ROUNDING, compare
from ctgraph_rl.log import run_log, sums, tables
from ctgraph_rl.log.files import EX_TEMPFAIL, locked
from ctgraph_rl.log.provenance import NUMBERS, NUMBERS_TOGETHER, code_changes
from ctgraph_rl.report.page import write_report
from ctgraph_rl.report.terminal import code_notes, group_size
from ctgraph_rl.runs import checkpoints, config, job, session
from ctgraph_rl.runs.job import run_as_one
from ctgraph_rl.runs.load import load
from ctgraph_rl.runs.read import find_runs, read_run

TINY = ("curriculum=ct2_interfering", "curriculum.num_frames=128", "evaluation.num_episodes=2", "agent.hidden_size=8")
PPO = (*TINY, "agent=ppo", "agent.num_envs=8", "agent.num_steps=8", "agent.num_epochs=1")
SEEDS = "seed=0,1,2"
EXPERTS = (
    *("curriculum=ct2_interfering", "curriculum.num_frames=192", "evaluation.num_episodes=2", "agent.hidden_size=8"),
    *(*PPO[len(TINY) :], "experts=true"),
)
"""Two tasks."""


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def runs(folder: str = "runs") -> list[Path]:
    return sorted(path.parent for path in Path(folder).rglob("run.jsonl") if "experts" not in path.parts)


def experts(folder: str) -> list[Path]:
    """By task and seed."""
    found = [path.parent for path in Path(folder).rglob("run.jsonl")]
    return sorted(found, key=lambda path: (first_line(path)["tasks"], first_line(path)["config"]["seed"]))


def content(run_dir: Path) -> tuple:
    """All measurements but their times, and the weights."""
    lines = [{**line, "seconds": 0} for line in RunLog.read(run_dir / "run.jsonl").measurements]
    return lines, torch.load(run_dir / "agent.pt", weights_only=True)


def first_line(run_dir: Path) -> dict:
    return json.loads((run_dir / "run.jsonl").read_text().splitlines()[0])


def same(one: Path, other: Path) -> bool:
    (lines, weights), (its_lines, its_weights) = content(one), content(other)
    return lines == its_lines and equal(weights, its_weights)


def stop_after(monkeypatch, count: int, module=session, name="offer_all") -> None:
    """Let the process be killed after some checkpoints of a group."""
    calls, original = [], getattr(module, name)

    def killed(*given, **how):
        original(*given, **how)
        calls.append(given)
        if len(calls) == count:
            raise KeyboardInterrupt

    monkeypatch.setattr(module, name, killed)


@pytest.fixture(scope="module")
def together(tmp_path_factory) -> Path:
    """A sweep whose three seeds learned as one batch, without a stop."""
    folder = tmp_path_factory.mktemp("together")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert sweep(patch, SEEDS, "together=true", *PPO) == 0
    return folder / "runs"


def test_each_seed_leaves_the_files_of_a_run_alone_and_says_which_seeds_were_beside_it(monkeypatch, together):
    assert sweep(monkeypatch, "seed=1", "hydra.sweep.dir=alone", *PPO) == 0

    [other] = runs("alone")
    assert [first_line(run)["together"] for run in runs(str(together))] == 3 * [[0, 1, 2]]
    one = together / other.relative_to("alone")
    files = [{str(path.relative_to(each)) for path in each.rglob("*")} for each in (one, other)]
    assert files[0] == files[1]
    assert first_line(one)["config"] == first_line(other)["config"]
    assert "together" not in first_line(other)
    assert (first_line(one)["numbers"], first_line(other)["numbers"]) == (NUMBERS_TOGETHER, NUMBERS)
    assert load(one).agent.state_dict().keys() == load(other).agent.state_dict().keys()
    assert "seed=1" in (one / ".hydra" / "overrides.yaml").read_text()
    assert "seeds:" not in (one / ".hydra" / "config.yaml").read_text()
    shown = compare(one, other).lines
    assert any("together" in line and "[0, 1, 2]" in line for line in shown), shown


def test_a_group_of_an_older_numbers_version_is_noticed_where_a_run_alone_has_not_changed():
    now = {"fingerprint": "0", "numbers": NUMBERS, "sources": {}}

    said = f"ctgraph_rl (numbers version {NUMBERS} before, {NUMBERS_TOGETHER} now)"
    assert code_changes({"numbers": NUMBERS}, now) == []
    assert code_changes({"numbers": NUMBERS, "together": [0, 1]}, now) == [said]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "finished", "others"),
    [("finetune", [1], []), ("ewc", [1, 2], [3, 4])],
)
def test_a_stopped_group_is_resumed_as_a_group_bit_by_bit_and_not_otherwise(
    monkeypatch, capsys, together, method, finished, others
):
    """It is stopped between batches, between saves of its seeds, and between results of its seeds."""
    settings = ("together=true", f"method={method}", *PPO)
    if method != "finetune":
        assert sweep(monkeypatch, SEEDS, *settings, "hydra.sweep.dir=whole") == 0
    whole = runs("whole" if method != "finetune" else str(together))
    between_saves = (4, checkpoints.Checkpoints, "save")
    between_results = (1, session.RunMember, "finish")

    with monkeypatch.context() as patch:
        stop_after(patch, 3)
        assert sweep(patch, SEEDS, *settings) == 130
    capsys.readouterr()
    assert sweep(monkeypatch, "seed=1", *settings[1:]) == 1
    assert "was begun with the seeds [0, 1, 2] together: resume it with together=true and" in capsys.readouterr().out
    stops = [(between_saves, 0), *((between_results, number) for number in finished)]
    for place, number_finished in stops:
        with monkeypatch.context() as patch:
            stop_after(patch, *place)
            assert sweep(patch, SEEDS, *settings) == 130
        assert [(run / "metrics.json").exists() for run in runs()] == [seed < number_finished for seed in range(3)]
    assert sweep(monkeypatch, ",".join([SEEDS, *map(str, others)]), *settings) == 0

    assert [first_line(run)["together"] for run in runs()] == 3 * [[0, 1, 2]] + len(others) * [others]
    assert all(same(one, other) for one, other in zip(runs()[:3], whole, strict=True))
    assert all((run / "restarts.jsonl").exists() for run in runs()[:3])


@pytest.mark.parametrize("is_full", [False, True])
def test_a_group_that_is_stopped_in_its_first_checkpoints_begins_again_and_says_so(
    monkeypatch, capsys, together, is_full
):
    settings = (SEEDS, "together=true", *PPO)
    save = checkpoints.Checkpoints.save
    calls: list[int] = []

    def stopped(saved, state, **how):
        calls.append(1)
        if len(calls) == 2:
            raise OSError(errno.ENOSPC, "No space left on device") if is_full else KeyboardInterrupt
        save(saved, state, **how)

    with monkeypatch.context() as patch:
        patch.setattr(checkpoints.Checkpoints, "save", stopped)
        assert sweep(patch, *settings) == (1 if is_full else 130)
    assert [bool(checkpoints.Checkpoints(run / "checkpoints").files()) for run in runs()] == [True, False, False]
    capsys.readouterr()

    assert sweep(monkeypatch, *settings) == 0

    assert "seed0-984641b8a2ea begins again: it was stopped in its group's first check" in capsys.readouterr().err
    assert all(same(run, together / run.relative_to("runs")) for run in runs())


def test_a_group_of_which_one_lost_its_checkpoints_is_not_begun_again_where_the_others_have_learned_more(
    monkeypatch, capsys
):
    settings = ("seed=0,1", "together=true", *PPO)
    with monkeypatch.context() as patch:
        stop_after(patch, 2)
        assert sweep(patch, *settings) == 130
    shutil.rmtree(runs()[1] / "checkpoints")
    before = [path.read_bytes() for path in runs()[0].rglob("*.pt")]
    capsys.readouterr()

    assert sweep(monkeypatch, *settings) == 1

    assert "seed1-548973f7123c has lost its checkpoints, and learns as one batch with" in capsys.readouterr().out
    assert [path.read_bytes() for path in runs()[0].rglob("*.pt")] == before != []


@pytest.mark.slow
def test_a_group_that_meets_a_full_disk_at_a_file_of_its_results_is_resumed_bit_by_bit(monkeypatch):
    settings = ("seed=0,1", *PPO)
    assert sweep(monkeypatch, *settings, "together=true", "hydra.sweep.dir=whole") == 0
    written: list[Path] = []

    def write(path, content, synced=True):
        written.append(path)
        if len(written) == full_at:
            raise OSError(errno.ENOSPC, "No space left on device")
        disk.write_whole(path, content, synced)

    finish = session.RunMember.finish
    for full_at, again in ((1, "together=true"), (6, "together=true"), (7, "together=false"), (12, "together=true")):
        written.clear()
        with monkeypatch.context() as patch:

            def finish_on_a_full_disk(member, patch=patch):
                for module in (session, run_log, tables, sums):
                    patch.setattr(module, "write_whole", write)
                finish(member)

            patch.setattr(session.RunMember, "finish", finish_on_a_full_disk)
            assert sweep(patch, *settings, "together=true", f"hydra.sweep.dir=full{full_at}") == 1

        assert sweep(monkeypatch, *settings, again, f"hydra.sweep.dir=full{full_at}") == 0, written
        assert all(same(one, other) for one, other in zip(runs(f"full{full_at}"), runs("whole"), strict=True))


def test_what_is_done_is_left_as_it_is_and_one_seed_is_trained_alone(monkeypatch, together, capsys):
    shutil.copytree(together, "runs")
    before = [content(run)[0] for run in runs()]

    assert sweep(monkeypatch, "seed=0,1,2,3", "together=true", *PPO) == 0

    assert "4 done" in capsys.readouterr().out
    assert [content(run)[0] for run in runs()[:3]] == before
    assert "together" not in first_line(runs()[3])
    said = "3 of 4 runs are of seeds trained together, 3 at a time; they differ from others by rounding"
    assert code_notes(find_runs(["runs"])[0]) == [said]
    assert [group_size(run) for run in find_runs(["runs"])[0]] == [3, 3, 3, 1]


@pytest.mark.slow
def test_a_report_says_which_runs_were_trained_together(monkeypatch, together):
    shutil.copytree(together, "runs")
    sweep(monkeypatch, "seed=0,1,2,3", "together=true", *PPO)

    write_report(["runs"], Path("report"))

    said = "3 of 4 runs are of seeds trained together, 3 at a time; they differ from others by rounding"
    page = Path("report", "report.html").read_text()
    assert said in page and "1 run: " in page and "; trained in a group of 3 seeds" in page


def test_seeds_that_cannot_be_one_batch_are_run_as_alone_one_after_the_other(monkeypatch, capsys):
    ran = []

    def run_job(cfg, run_dir, built=None):
        ran.append((cfg.seed, run_dir.name.split("-")[1]))
        if cfg.seed == 0:
            raise FloatingPointError("the loss is NaN")

    monkeypatch.setattr(job, "run_job", run_job)
    code = sweep(monkeypatch, "seed=0,1", *TINY, "agent=drqn", "agent.num_envs=8", "together=true")

    said = capsys.readouterr()
    assert (code, ran) == (1, [(0, "seed0"), (1, "seed1")])
    assert "note: seeds are trained one after the other, as DRQN cannot be" in said.err
    assert "seed 0: FloatingPointError: the loss is NaN" in said.out


@pytest.mark.slow
def test_seeds_that_cannot_be_one_batch_are_trained_as_alone(monkeypatch):
    settings = ("seed=0,1", *TINY, "agent=drqn", "agent.num_envs=8", "agent.num_steps=8")

    assert sweep(monkeypatch, *settings, "together=true") == 0
    sweep(monkeypatch, *settings, "hydra.sweep.dir=alone")

    assert all(same(one, other) for one, other in zip(runs(), runs("alone"), strict=True))


def test_a_seed_that_fails_is_marked_alone_and_tried_again_by_the_next_start(monkeypatch, capsys, together):
    settings = (SEEDS, "together=true", *PPO)
    start = SeedGroup.start_task

    def spoiled(group, task=None):
        start(group, task)
        group.learners[0].weights[0].data.fill_(torch.nan)

    with monkeypatch.context() as patch:
        patch.setattr(SeedGroup, "start_task", spoiled)
        assert sweep(patch, *settings) == 1
    shown = capsys.readouterr().out
    assert "2 done, 1 failed" in shown and "FloatingPointError: seed 0: loss_objective is nan in block 1" in shown

    done, failed = [runs()[number] for number in (1, 2)], runs()[0]
    assert all(same(run, together / run.relative_to("runs")) for run in done)
    assert [name for name in ("metrics.json", "agent.pt", "checkpoints", "failed.txt") if (failed / name).exists()] == [
        "failed.txt"
    ]
    assert not any((run / "failed.txt").exists() for run in done)
    assert sweep(monkeypatch, *settings) == 0
    assert "together" not in first_line(failed) and not (failed / "failed.txt").exists()


@pytest.mark.slow
@pytest.mark.parametrize("finished", [1, 2])
def test_a_seed_that_failed_has_failed_also_where_its_group_was_stopped_before_it_said_so(
    monkeypatch, capsys, finished
):
    settings = (SEEDS, "together=true", *PPO)
    assert sweep(monkeypatch, *settings, "hydra.sweep.dir=whole") == 0
    start = SeedGroup.start_task

    def spoiled(group, task=None):
        start(group, task)
        group.learners[0].weights[0].data.fill_(torch.nan)

    with monkeypatch.context() as patch:
        patch.setattr(SeedGroup, "start_task", spoiled)
        stop_after(patch, finished, session.RunMember, "finish")
        assert sweep(patch, *settings) == 130
    capsys.readouterr()

    assert sweep(monkeypatch, *settings) == 1
    shown = capsys.readouterr().out
    assert "2 done, 1 failed" in shown and "FloatingPointError: seed 0: loss_objective is nan in block 1" in shown
    assert not (runs()[0] / "metrics.json").exists()
    assert all(same(one, other) for one, other in list(zip(runs(), runs("whole"), strict=True))[1:])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ("seed=1", "together=true"),
            "as one batch: add -m and several seeds, such as seed=range(20), or together=false for one run",
        ),
        (("-m", "seed=0,1", "together=[0,1]"), "together must be true or false, got [0, 1]"),
        (("-m", "+seeds=[0,1]"), "a sweep's seeds are given as seed=0,1 or seed=range(2), got +seeds=[0,1]"),
        (("-m", "+seeds=0,1"), "a sweep's seeds are given as seed=0,1 or seed=range(2), got +seeds=0,1"),
        (("-m", "seeds=0,1"), "a sweep's seeds are given as seed=0,1 or seed=range(2), got seeds=0,1"),
        (("seeds=0,1",), "seeds=0,1 is no setting: give -m seed=0,1"),
        (("+seeds=[0,1]",), "a sweep's seeds are given as seed=0,1 or seed=range(2), with -m, got seeds"),
    ],
)
def test_other_uses_are_refused(monkeypatch, capsys, arguments, message):
    assert command_line(monkeypatch, *arguments, *PPO) == 1

    assert message in capsys.readouterr().err
    assert not runs()


@pytest.mark.parametrize("settings", [["together=true"], ["together=true", "agent=lstm_ppo"]], ids=["one", "in turn"])
def test_as_many_jobs_are_built_as_there_are_seeds(monkeypatch, settings):
    built = []

    def stop_before_learning(*_):
        raise RuntimeError("enough")

    monkeypatch.setattr(job, "prepare", stop_before_learning)
    build = job.build
    monkeypatch.setattr(job, "build", lambda *given: built.append(given[0].seed) or build(*given))

    assert sweep(monkeypatch, SEEDS, *PPO, *settings) == 1

    assert built == [0, 1, 2]


def test_cells_of_a_group_do_not_copy_its_list_of_seeds(monkeypatch):
    copied = []

    def stop_before_work(cfg, *_):
        copied.append("seeds" in cfg)
        raise RuntimeError("enough")

    monkeypatch.setattr(config, "of_seed", stop_before_work)

    assert sweep(monkeypatch, SEEDS, *PPO, "together=true") == 1
    assert copied == [False]


def test_a_group_that_is_refused_leaves_no_folder(monkeypatch, capsys):
    monkeypatch.setattr(job, "WEIGHTS_KEPT", 10**12)

    assert sweep(monkeypatch, SEEDS, *PPO, "together=true") == 1

    said = " ".join("".join(capsys.readouterr()).split())
    assert "weights and a batch of 3 seeds need " in said and "use fewer seeds at a time" in said, said
    assert [path.name for path in Path("runs").rglob("*")] == ["multirun.yaml"]


def test_a_group_with_a_seed_in_use_leaves_no_folder_of_the_others(monkeypatch, together):
    held = Path("runs") / runs(str(together))[2].relative_to(together)
    held.mkdir(parents=True)

    with locked(held):
        assert sweep(monkeypatch, SEEDS, *PPO, "together=true") == EX_TEMPFAIL

    assert [*held.parent.iterdir()] == [held]


def learn_experts(given: list[DictConfig], task: int) -> None:
    """Find or train the experts of one task, from 1, as one batch."""
    job.prepare_torch(given[0])
    curriculum = job.curriculum_of(given[0], job.method_of(given[0])())
    one = slice(task - 1, task)
    ids = curriculum.protocol.task_ids
    protocol = replace(curriculum.protocol, task_ids=ids[one])
    alone = replace(curriculum, blocks=curriculum.blocks[one], protocol=protocol)
    with job.Interrupt() as interrupt:
        job.train_experts(given, alone, interrupt)


def configs(*seeds: int, folder: str = "experts") -> list[DictConfig]:
    """Runs of two tasks, whose experts are trained in turn."""
    return [config.composed([*EXPERTS, f"seed={seed}", f"experts_dir={folder}"]) for seed in seeds]


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> list[Path]:
    """The experts of the first task, trained as a group without a stop."""
    folder = tmp_path_factory.mktemp("whole")
    learn_experts(configs(0, 1, 2, folder=str(folder)), 1)
    return experts(str(folder))


def groups(folder: str = "experts") -> list[list[int] | None]:
    return [first_line(expert).get("together") for expert in experts(folder)]


@pytest.mark.slow
def test_experts_of_a_group_are_trained_as_a_group_like_those_alone_up_to_rounding(monkeypatch):
    assert sweep(monkeypatch, "seed=0,1", "together=true", *EXPERTS) == 0
    for task in (1, 2):
        learn_experts(configs(0), task)

    assert groups("runs/experts") == 4 * [[0, 1]] and groups() == [None, None]
    for one, other in zip(experts("runs/experts")[::2], experts("experts"), strict=True):
        assert one.name == other.name
        assert {path.name for path in one.iterdir()} == {path.name for path in other.iterdir()}
        assert first_line(one)["config"] == first_line(other)["config"]
        assert compare(one, other).code == ROUNDING
    [said] = RunLog.read(runs()[0] / "run.jsonl").of_kind("experts")
    assert [expert["together"] for expert in said["experts"]] == [[0, 1], [0, 1]]
    shutil.copytree(runs()[0], "other")
    log = Path("other", "run.jsonl")
    log.write_text(log.read_text().replace(', "together": [0, 1]}', "}"))
    note = "1 of 2 runs are compared with experts of seeds trained together; those differ from others by rounding"
    assert note in code_notes([read_run(runs()[0]), read_run(Path("other"))]) and not code_notes([read_run(runs()[0])])


@pytest.mark.slow
def test_stopped_experts_of_a_group_are_resumed_as_a_group_bit_by_bit(monkeypatch, whole):
    finish = (session.RunMember, "finish", 1)
    places = ((session, "offer_all", 2), (checkpoints.Checkpoints, "save", 2), finish, finish)

    for module, name, count in places:
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            stop_after(patch, count, module, name)
            learn_experts(configs(0, 1, 2), 1)
    assert [(expert / "metrics.json").exists() for expert in experts("experts")] == [True, True, False]
    learn_experts(configs(0, 1, 2), 1)

    assert all((expert / "restarts.jsonl").exists() for expert in experts("experts"))
    assert all(same(one, other) for one, other in zip(experts("experts"), whole, strict=True))


@pytest.mark.slow
def test_experts_of_a_stopped_group_begin_again_where_one_is_needed_alone(monkeypatch):
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        stop_after(patch, 1)
        learn_experts(configs(0, 1, 2), 1)
    learn_experts(configs(1), 1)

    assert groups() == [[0, 1, 2], None, [0, 1, 2]]
    learn_experts(configs(0, 1, 2), 1)
    assert groups() == [[0, 2], None, [0, 2]]


@pytest.mark.slow
def test_an_expert_that_fails_fails_alone_and_its_run_does_not_begin(monkeypatch, whole):
    start, begun = SeedGroup.start_task, []

    def spoiled(group, task=None):
        start(group, task)
        begun.append(len(group.agents))
        if len(begun) == 1:
            group.learners[1].weights[0].data.fill_(torch.nan)

    def run() -> None:
        made = [(cfg, Path(f"seed{cfg.seed}")) for cfg in configs(0, 1, 2)]
        for _, folder in made:
            folder.mkdir(exist_ok=True)
        run_as_one(made)

    with monkeypatch.context() as patch:
        patch.setattr(SeedGroup, "start_task", spoiled)
        with pytest.raises(
            RuntimeError, match=r"^FloatingPointError: expert 1 of 2, .*: seed 1: loss_objective is nan"
        ):
            run()

    assert begun[:3] == [3, 2, 2]
    assert groups() == [*3 * [[0, 1, 2]], *2 * [[0, 2]]]
    assert all(same(experts("experts")[number], whole[number]) for number in (0, 2))
    assert [(Path(f"seed{seed}") / "metrics.json").exists() for seed in (0, 1, 2)] == [True, False, True]
    assert not list(Path("seed1").glob("run.jsonl"))
    run()
    assert groups() == [[0, 1, 2], None, [0, 1, 2], [0, 2], None, [0, 2]]


def test_seeds_that_have_failed_are_an_error_of_the_group(tmp_path, monkeypatch):
    failed = {0: FloatingPointError("the loss is NaN"), 1: OSError("no disk")}
    monkeypatch.setattr(job, "is_finished", lambda cfg, run_dir: False)
    monkeypatch.setattr(job, "learn", lambda *_, **__: failed)

    with pytest.raises(RuntimeError, match=r"^FloatingPointError: the loss is NaN; OSError: no disk$"):
        run_as_one([(config.composed([]), tmp_path)])


@pytest.mark.slow
def test_a_group_of_any_size_holds_as_many_files_open(tmp_path, checkout):
    settings = " ".join(["-m", "'seed=range(90)'", "together=true", *PPO])
    command = f"ulimit -n 150; exec {sys.executable} -m ctgraph_rl.run {settings}"

    done = subprocess.run(["bash", "-c", command], env={**os.environ, "PYTHONPATH": str(checkout)}, cwd=tmp_path)

    assert done.returncode == 0
    assert len(runs()) == len(list(Path("runs").rglob("metrics.json"))) == 90
