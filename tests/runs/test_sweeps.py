"""Sweeps: what is launched, what a failing or busy cell does, and what is said while they run and at the end."""

from __future__ import annotations

import io
import itertools
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from helpers.made_runs import make_run
from helpers.sweeping import UNLUCKY, sweep
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from hydra.errors import MissingConfigException
from omegaconf import OmegaConf
from rich.console import Console

from ctgraph_rl.log.files import locked
from ctgraph_rl.log.sums import write_metrics
from ctgraph_rl.run import MOST_IN_TABLE, show_sweep
from ctgraph_rl.runs import job
from ctgraph_rl.runs.explain import explain
from ctgraph_rl.runs.status import SHOWN, RunOutcome, Status, SweepProgress, lock_holder, report, status_of
from ctgraph_rl.runs.sweep import shortened, sigterm_exits, why

SHORT = ("curriculum.num_frames=512", "agent.num_envs=64", "agent.num_steps=8", "agent.hidden_size=8")
ALL_DONE = "sweep of {0} cells: {0} done, 0 failed, 0 in use, 0 missing\n"


def plugin(name: str) -> Any:
    """One of Hydra's plugins as it uses it: it imports their modules a second time."""
    return Plugins.instance().class_name_to_class[name]


def test_a_second_start_does_only_what_is_missing(learned, monkeypatch, capsys):
    first = sweep(monkeypatch, "seed=0,1")
    before = list(learned)

    second = sweep(monkeypatch, "seed=range(3)", "agent=lstm_ppo,dqn")

    assert (first, second) == (0, 0)
    assert len(before) == 2 and len(learned) == len(set(learned)) == 6
    lines = capsys.readouterr().out.splitlines(keepends=True)
    said = [line for line in lines if line.startswith("sweep of")]
    assert said == [ALL_DONE.format(2), ALL_DONE.format(6)] and said[0] == lines[0]
    assert lines[-1] == "ctgraph-rl report runs/su_b1_4tasks makes a page of figures and tables\n"
    assert sorted(path.name for path in Path("runs").iterdir()) == ["multirun.yaml", "su_b1_4tasks"]


def test_a_sweep_of_tuning_runs_ends_with_the_command_that_shows_them(learned, monkeypatch, capsys):
    assert sweep(monkeypatch, "seed=0,1", "objective=online_return", "objective_until=0.5") == 0

    last = capsys.readouterr().out.splitlines()[-1]
    assert last == "ctgraph-rl report --tuning runs/su_b1_4tasks makes a page of figures and tables"


def test_a_sweep_that_is_done_ends_with_its_table_and_what_to_do_next(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    folders = [make_run(tmp_path, seed) for seed in (0, 1)]

    show_sweep(folders)
    lines = capsys.readouterr().out.splitlines()
    show_sweep(folders * MOST_IN_TABLE)
    too_long = capsys.readouterr().out
    show_sweep(folders * MOST_IN_TABLE, tuning=True)
    tuned = capsys.readouterr().out
    monkeypatch.setitem(sys.modules, "scipy", None)
    show_sweep(folders)
    without_scipy = capsys.readouterr().out

    assert any(line.split()[:2] == ["average", "performance"] for line in lines)
    assert lines[-1] == "ctgraph-rl report . makes a page of figures and tables"
    assert too_long == "ctgraph-rl results . prints a table\n"
    assert tuned == "ctgraph-rl results --tuning . prints a table\n"
    means = "for means, pip install 'ctgraph_rl[stats]'"
    assert without_scipy == f"ctgraph-rl results --per-seed . prints the runs; {means}\n"


def test_a_failing_cell_stops_no_other_and_is_tried_again(learned, monkeypatch, capsys):
    codes = [sweep(monkeypatch, f"seed=0,{UNLUCKY},2") for _ in range(2)]

    shown, errors = capsys.readouterr()
    assert codes == [1, 1] and errors == ""
    assert [path.name.split("-")[1] for path in learned] == ["seed0", f"seed{UNLUCKY}", "seed2", f"seed{UNLUCKY}"]
    lines = shown.splitlines()
    assert lines[:2] == [
        "sweep of 3 cells: 2 done, 1 failed, 0 in use, 0 missing",
        f"  failed   seed={UNLUCKY}  FloatingPointError: the loss is NaN",
    ]
    assert lines[2].startswith("the same command runs what is not done")


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (["seed=0,x"], "seed must be an integer in [0, 2**63), got 'x'"),
        (["seed=0,-1"], "seed must be an integer in [0, 2**63), got -1"),
        (["seed=0,1", "resume=warn,never"], "resume must be one of warn, strict, got 'never'"),
        (["seed=0,1", "objective=???"], "objective=??? has no value: ??? stands for one that must be given"),
        (
            ["seed=0,1", "agent.gamma=${oc.env:NOT_SET}"],
            "agent.gamma=${oc.env:NOT_SET}: Environment variable 'NOT_SET'",
        ),
    ],
)
def test_a_value_that_no_run_can_have_is_refused_before_any_cell_is_trained(
    learned, monkeypatch, capsys, settings, said
):
    assert sweep(monkeypatch, *settings) == 1

    assert capsys.readouterr().err.startswith(f"error: {said}")
    assert learned == [] and not Path("runs").exists()


def test_status_runs_nothing_and_knows_why_cells_failed(learned, monkeypatch, capsys):
    sweep(monkeypatch, f"seed=0,{UNLUCKY}")
    capsys.readouterr()
    del learned[:]

    code = sweep(monkeypatch, f"seed=0,{UNLUCKY},14", "hydra.sweeper.status=true")

    assert (code, learned) == (1, [])
    assert capsys.readouterr().out.splitlines()[:3] == [
        "sweep of 3 cells: 1 done, 1 failed, 0 in use, 1 missing",
        f"  failed   seed={UNLUCKY}  FloatingPointError: the loss is NaN",
        "  missing  seed=14  not begun",
    ]


def test_status_names_every_cell_and_the_end_of_a_sweep_each_failure_once(learned, monkeypatch, capsys):
    cells = (f"seed={UNLUCKY}", "agent.gamma=0.1,0.2,0.3,0.4")
    said = [sweep(monkeypatch, *cells, f"hydra.sweeper.status={status}") for status in ("true", "false")]

    lines = capsys.readouterr().out.splitlines()
    assert said == [1, 1]
    assert [sum(line.startswith(f"  {state}") for line in lines) for state in ("missing", "failed")] == [4, 1]


def test_a_cell_that_another_process_runs_is_left_to_it(learned, monkeypatch, capsys):
    sweep(monkeypatch, "seed=1")
    (learned[0] / "metrics.json").unlink()

    with locked(learned[0]):
        code = sweep(monkeypatch, "seed=0,1,2")

    assert code == 75
    assert [path.name.split("-")[1] for path in learned] == ["seed1", "seed0", "seed2"]
    numbers, busy, _ = capsys.readouterr().out.splitlines()[-3:]
    assert numbers == "sweep of 3 cells: 2 done, 0 failed, 1 in use, 0 missing"
    assert busy.startswith(f"  in use   seed=1  by process {os.getpid()} on {socket.gethostname()} since ")


def test_equal_cells_are_run_once(learned, monkeypatch, capsys):
    code = sweep(monkeypatch, "seed=0,0,1")

    assert code == 0 and len(learned) == 2
    assert "sweep of 2 cells (1 more are the same as others): 2 done" in capsys.readouterr().out


def test_overwrite_runs_what_is_done_again(learned, monkeypatch):
    sweep(monkeypatch, "seed=0,1")

    code = sweep(monkeypatch, "seed=0,1", "overwrite=true")

    assert code == 0 and len(learned) == 4


def test_overwrite_counts_what_a_machine_with_another_clock_has_run(learned, monkeypatch, capsys):
    sweep(monkeypatch, "seed=0,1")
    capsys.readouterr()
    learn = job.learn

    def elsewhere(session, cells, *given):
        [(cfg, run_dir)] = cells
        failed = learn(session, cells, *given)
        there = time.time() + (3600 if cfg.seed == 0 else -3600)
        os.utime(run_dir / "metrics.json", (there, there))
        return failed

    monkeypatch.setattr(job, "learn", elsewhere)
    code = sweep(monkeypatch, "seed=0,1", "overwrite=true")

    assert code == 0 and ALL_DONE.format(2) in capsys.readouterr().out


def test_overwrite_counts_no_outcome_of_before(learned, monkeypatch, capsys):
    sweep(monkeypatch, f"seed=0,{UNLUCKY}")
    capsys.readouterr()

    code = sweep(monkeypatch, f"seed=0,{UNLUCKY}", "overwrite=true", "hydra.sweeper.status=true")

    assert code == 1
    assert "sweep of 2 cells: 0 done, 0 failed, 0 in use, 2 missing" in capsys.readouterr().out


def test_a_sweep_that_is_interrupted_says_where_it_stands(learned, monkeypatch, capsys):
    def stop(*_):
        raise SystemExit(130)

    monkeypatch.setattr(job, "learn", stop)

    code = sweep(monkeypatch, "seed=0,1")

    assert code == 130
    assert capsys.readouterr().out.startswith("sweep of 2 cells: 0 done, 0 failed, 0 in use, 2 missing\n")


def test_only_what_is_not_done_is_launched_in_batches_one_after_the_other(learned, monkeypatch):
    launcher, sizes = plugin("hydra._internal.core_plugins.basic_launcher.BasicLauncher"), []
    launch = launcher.launch

    def noted(self, cells, initial_job_idx):
        sizes.append(len(cells))
        return launch(self, cells, initial_job_idx)

    monkeypatch.setattr(launcher, "launch", noted)

    codes = [sweep(monkeypatch, f"seed=range({end})", "hydra.sweeper.max_batch_size=2") for end in (1, 4, 4)]

    assert (codes, sizes, len(learned)) == ([0, 0, 0], [1, 2, 1], 4)


def test_a_launcher_that_gives_up_is_reported(learned, monkeypatch, capsys):
    def give_up(self, cells, initial_job_idx):
        raise RuntimeError("a worker was killed")

    monkeypatch.setattr(plugin("hydra._internal.core_plugins.basic_launcher.BasicLauncher"), "launch", give_up)

    code = sweep(monkeypatch, "seed=0,1")

    shown, errors = capsys.readouterr()
    assert (code, errors) == (1, "the launcher stopped: RuntimeError: a worker was killed\n")
    assert shown.startswith("sweep of 2 cells: 0 done, 0 failed, 0 in use, 2 missing\n")


def test_sigterm_ends_a_sweep_between_cells_unless_it_is_ignored(default_sigterm):
    with pytest.raises(SystemExit) as end, sigterm_exits():
        os.kill(os.getpid(), signal.SIGTERM)
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        with sigterm_exits():
            os.kill(os.getpid(), signal.SIGTERM)
        ignored = signal.getsignal(signal.SIGTERM)
    finally:
        signal.signal(signal.SIGTERM, before)

    assert end.value.code == 143
    assert (before, ignored) == (signal.SIG_DFL, signal.SIG_IGN)


def test_what_cannot_be_composed_is_refused_before_anything_runs(learned, monkeypatch, capsys):
    codes = [sweep(monkeypatch, *wrong) for wrong in (["agent=dqn,dqm"], ["agent.foo=1,2"], ["seed=0", "sed=1,2"])]

    errors = capsys.readouterr().err
    assert codes == [1, 1, 1] and learned == []
    assert "unknown agent 'dqm': did you mean 'dqn'?" in errors and "'agent.foo'" in errors and "'sed'" in errors


def test_directories_that_are_not_named_after_the_configuration_are_refused(learned, monkeypatch, capsys):
    code = sweep(monkeypatch, "seed=0,1", "hydra.sweep.subdir=${hydra.job.num}")

    assert code == 1 and learned == []
    assert "hydra.sweep.subdir must be ${run_name:}, got ${hydra.job.num}; change" in capsys.readouterr().err


def test_sixty_cells_are_named_as_they_would_be_run_from_few_compositions(learned, monkeypatch, capsys):
    original, compositions = ConfigLoaderImpl.load_sweep_config, []

    def counted(self, master, overrides):
        compositions.append(overrides)
        return original(self, master, overrides)

    swept = ("agent=lstm_ppo,dqn", "agent.learning_rate=0.1,0.01,1e-3", "seed=range(10)", "protocol.task_id=one_hot")
    monkeypatch.setattr(ConfigLoaderImpl, "load_sweep_config", counted)

    sweep(monkeypatch, *swept, "hydra.sweeper.status=true")
    few = len(compositions)
    chosen = ("agent=dqn", "agent.learning_rate=0.01,1e-3", "seed=9", "protocol.task_id=one_hot")
    code = sweep(monkeypatch, *chosen)  # each is composed again, whole, where it is run
    sweep(monkeypatch, *swept, "hydra.sweeper.status=true")

    assert (few, code) == (2, 0)
    assert "sweep of 60 cells: 2 done, 0 failed, 0 in use, 58 missing" in capsys.readouterr().out


def test_lists_and_dictionaries_can_be_swept(learned, monkeypatch):
    axes = ("curriculum=axes", "curriculum.goals=[[1,1]],[[1,2],[2,1]]", "evaluation={every:512},{greedy:true}")

    code = sweep(monkeypatch, *axes)

    settings = [json.loads((path / "run.jsonl").read_text())["config"] for path in learned]
    assert code == 0
    found = [(cfg["curriculum"]["goals"], cfg["evaluation"]["every"], cfg["evaluation"]["greedy"]) for cfg in settings]
    two = [(goals, *evaluation) for goals in (["1.1"], ["1.2", "2.1"]) for evaluation in ((512, None), (None, True))]
    assert found == two


@pytest.mark.slow
def test_a_sweep_on_processes_runs_every_cell_and_shows_no_bars(checkout, tmp_path):
    pytest.importorskip("joblib")
    command = [
        sys.executable,
        "-m",
        "ctgraph_rl.run",
        "-m",
        "hydra/launcher=joblib",
        *SHORT,
        "seed=0,1",
        "agent.gamma=0.9,2",
    ]
    env = {**os.environ, "PYTHONPATH": str(checkout)}
    result = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True)

    assert (result.returncode, result.stderr) == (1, "")
    assert result.stdout.splitlines()[:2] == [
        "sweep of 4 cells: 2 done, 2 failed, 0 in use, 0 missing",
        "  failed   seed=0 agent.gamma=2 and 1 more  ValueError: agent.gamma must be in [0, 1], got 2",
    ]
    assert len(list(tmp_path.glob("runs/*/*/agent.pt"))) == 2


@pytest.mark.parametrize(("num_threads", "n_jobs", "expected"), [(1, -1, 8), (3, -1, 2), (16, -1, 1), (3, 5, 5)])
def test_processes_and_threads_together_use_no_more_than_the_cores(num_threads, n_jobs, expected, monkeypatch):
    launcher = {"_target_": "hydra._internal.core_plugins.basic_launcher.BasicLauncher", "n_jobs": n_jobs}
    cfg = OmegaConf.create({"num_threads": num_threads, "hydra": {"launcher": launcher}})
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(8)), raising=False)
    made_of = []

    def launcher_of(plugins, *, config, **context):
        made_of.append(config)
        return SimpleNamespace(setup=lambda *, config, **context: made_of.append(config))

    monkeypatch.setattr("hydra.core.plugins.Plugins.instantiate_launcher", launcher_of)

    sweeper = plugin("hydra_plugins.ctgraph_rl_sweeper.CellSweeper")(None, None, False)

    sweeper.setup(hydra_context=None, task_function=None, config=cfg)

    assert [each.hydra.launcher.n_jobs for each in (*made_of, sweeper.config)] == [expected, n_jobs, n_jobs]
    assert sweeper._num_processes == expected


@pytest.mark.parametrize(
    ("num_processes", "begun", "expected"),
    [(1, None, ["0123456"]), (2, None, ["0246", "135"]), (9, None, ["036", "14", "25"]), (2, range(7), ["0123456"])],
)
def test_seeds_together_are_a_group_for_each_process_of_two_seeds_or_more(num_processes, begun, expected):
    sweeper = plugin("hydra_plugins.ctgraph_rl_sweeper.CellSweeper")(None, None, False)
    sweeper.config = OmegaConf.create({"together": True})
    sweeper._num_processes = num_processes
    cells = {Path(str(seed)): ("agent=ppo", f"seed={seed}") for seed in range(7)}
    sweeper._begun = dict.fromkeys(cells, tuple(begun)) if begun else {}

    jobs = sweeper._jobs(cells)

    assert ["".join(map(str, folders)) for folders in jobs.values()] == expected
    assert [settings[1:] for settings in jobs] == [
        (f"seed={group[0]}", "together=true", f"+seeds=[{','.join(group)}]") for group in expected
    ]


@pytest.mark.parametrize(("num_processes", "sizes"), [(1, [4, 4]), (3, [4, 4]), (4, [2, 2, 2, 2])])
def test_groups_of_several_agents_share_the_processes(num_processes, sizes):
    sweeper = plugin("hydra_plugins.ctgraph_rl_sweeper.CellSweeper")(None, None, False)
    sweeper.config = OmegaConf.create({"together": True})
    sweeper._num_processes = num_processes
    agents = ("agent=ppo", "agent=a2c")
    cells = {Path(agent, str(seed)): (agent, f"seed={seed}") for agent in agents for seed in range(4)}

    assert [len(folders) for folders in sweeper._jobs(cells).values()] == sizes


def test_a_launcher_that_is_not_installed_names_the_extra():
    error = MissingConfigException("Could not find it", missing_cfg_file="hydra/launcher/submitit_slurm")

    assert explain(error) == "this launcher is another package: pip install 'ctgraph_rl[slurm]'"


def test_a_failed_job_says_why_and_hydra_prints_nothing(capsys):
    job = JobReturn(status=JobStatus.FAILED)
    job.return_value = RuntimeError("ValueError: no")

    assert why(job) == "ValueError: no"
    assert capsys.readouterr() == ("", "")


def test_the_status_of_a_cell_is_read_from_its_directory(tmp_path):
    found = [status_of(tmp_path / "none")]
    (tmp_path / "run.jsonl").touch()
    found.append(status_of(tmp_path))
    (tmp_path / "failed.txt").write_text("ValueError: no\n")
    found.append(status_of(tmp_path))
    with locked(tmp_path):
        found.append(status_of(tmp_path))
    (tmp_path / "run.jsonl").write_text("{}\n")
    write_metrics(tmp_path / "metrics.json", {})
    found.append(status_of(tmp_path))

    assert [state for state, _ in found] == ["missing", "missing", "failed", "in use", "done"]
    reasons = ["not begun", "stopped; the next start resumes it", "ValueError: no\n"]
    assert [reason for _, reason in found[:3]] == reasons
    assert status_of(tmp_path, before=RunOutcome.of(tmp_path)).state == "missing"


def test_the_lock_of_a_killed_process_is_nobodys(tmp_path):
    gone = subprocess.Popen(["true"])
    gone.wait()
    texts = [f"process {gone.pid} on {host} since now" for host in (socket.gethostname(), "elsewhere")] + [""]

    found = []
    for text in texts:
        (tmp_path / ".lock").write_text(text)
        found.append(lock_holder(tmp_path))

    assert found == [None, texts[1], "another process"]


def test_a_report_names_the_first_cells_that_are_not_done():
    cells = {f"seed={seed}": Status("missing", "not\nbegun") for seed in range(SHOWN + 5)}

    lines = report({"seed=-1": Status("done"), **cells}).splitlines()

    assert lines[0] == f"sweep of {SHOWN + 6} cells: 1 done, 0 failed, 0 in use, {SHOWN + 5} missing"
    assert lines[1] == "  missing  seed=0  not begun"
    assert lines[SHOWN + 1] == "  and 5 more" and len(lines) == SHOWN + 3


def test_cells_that_failed_alike_have_one_line_but_in_a_list_of_all():
    cells = {f"seed={seed}": Status("failed", "too much" if seed < 30 else "NaN") for seed in range(31)}

    assert report(cells).splitlines()[1:-1] == ["  failed   seed=0 and 29 more  too much", "  failed   seed=30  NaN"]
    assert len(report(cells, most=None).splitlines()) == 1 + len(cells) + 1


def test_cells_are_named_by_what_differs():
    assert shortened([("a=1", "b=1"), ("a=1", "b=2")]) == ["b=1", "b=2"]
    assert shortened([("a=1", "b=1")]) == ["a=1 b=1"]


def test_progress_counts_cells_and_tells_the_time_left(tmp_path):
    cells = [tmp_path / str(number) for number in range(300)]
    for cell in cells[:10]:
        cell.mkdir()
        write_metrics(cell / ("failed.txt" if cell == cells[3] else "metrics.json"), {})
    progress = SweepProgress(dict.fromkeys(cells, RunOutcome()), console=Console(file=io.StringIO()))

    done, failed, running = progress.look()

    assert (done, failed, running) == (9, 1, 0)
    line = progress.describe(done, failed, running, ended=5, seconds=600)
    assert line == "9/300 cells done  1 failed  0 running  0.5/min  9:40:00 left"
    assert progress.describe(9, 1, 0, ended=0, seconds=1).endswith("? left")


@pytest.mark.parametrize(("seconds", "pause"), [(0.01, 1.0), (0.5, 10.0)])
def test_directories_are_looked_at_every_second_or_for_a_twentieth_of_the_time(tmp_path, monkeypatch, seconds, pause):
    progress = SweepProgress({tmp_path: RunOutcome()}, console=Console(file=io.StringIO()))
    pauses: list[float] = []
    clock = itertools.count(0, seconds)
    monkeypatch.setattr("ctgraph_rl.runs.status.time", SimpleNamespace(perf_counter=lambda: next(clock)))
    monkeypatch.setattr(progress._stop, "wait", lambda pause: pauses.append(pause) or len(pauses) == 3)

    progress._watch()

    assert pauses == pytest.approx([1.0, pause, pause])


def test_progress_on_a_terminal_ends_with_the_cells_that_were_done_last(tmp_path):
    shown = io.StringIO()
    console = Console(file=shown, force_terminal=True, width=120)

    with SweepProgress(dict.fromkeys([tmp_path / "a", tmp_path / "b"], RunOutcome()), console):
        for name in "ab":
            (tmp_path / name).mkdir()
            write_metrics(tmp_path / name / "metrics.json", {})

    assert "2/2 cells done" in shown.getvalue()


def test_progress_without_a_terminal_is_a_line_a_minute(tmp_path, monkeypatch):
    is_shown = threading.Event()

    class Shown(io.StringIO):
        def write(self, text):
            is_shown.set()
            return super().write(text)

    shown = Shown()
    monkeypatch.setattr("ctgraph_rl.runs.status.SECONDS_BETWEEN_LINES", 0.0)

    write_metrics(tmp_path / "metrics.json", {})  # done before, so it tells nothing of the rate
    cells = dict.fromkeys([tmp_path, tmp_path / "b"], RunOutcome())
    with SweepProgress(cells, console=Console(file=shown)):
        assert is_shown.wait(60)

    assert set(shown.getvalue().splitlines()) == {"1/2 cells done  0 failed  0 running  0/min  ? left"}
