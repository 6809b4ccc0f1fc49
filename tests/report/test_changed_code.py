"""Code that changes between runs of one configuration: it is refused, run again where asked for, and never averaged."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from helpers.learning import train
from helpers.made_runs import all_runs, sum_again
from helpers.small_agents import SMALL_AGENT
from helpers.sweeping import command_line, sweep
from rich.console import Console

from ctgraph_rl import Recorder, RunLog, metrics
from ctgraph_rl.log import provenance
from ctgraph_rl.log.provenance import NUMBERS
from ctgraph_rl.log.sums import write_metrics
from ctgraph_rl.report import page, results
from ctgraph_rl.report.terminal import code_notes, mixed_code
from ctgraph_rl.runs import config, job
from ctgraph_rl.runs.read import grouped
from ctgraph_rl.runs.train import new_agent

AGENT = """
from baselines.reinforce import Reinforce
import my_network

class MyAgent(Reinforce):
    size = my_network.SIZE
"""

CURRICULUM = """
from curricula import load

def make(num_frames):
    return load("fo_b1_4tasks", num_frames=num_frames, image_seed={seed})
"""

AGENT_YAML = """
defaults: [reinforce]
_target_: my_agent.MyAgent
num_envs: 16
num_steps: 8
hidden_size: 8
"""

MINE = ("--config-dir=conf", "agent=mine", "curriculum.num_frames=256", "curriculum=mine")


class Files:
    """The files of a user, who edits them between two starts of the command line."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def write(self, name: str, text: str) -> None:
        (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
        (self.folder / name).write_text(text)
        for module in ("my_agent", "my_network", "my_curriculum", "my_reward"):
            sys.modules.pop(module, None)


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """An agent, with a module that it imports, and a curriculum of a user."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    files = Files(tmp_path)
    files.write("my_agent.py", AGENT)
    files.write("my_network.py", "SIZE = 1\n")
    files.write("my_curriculum.py", CURRICULUM.format(seed=1))
    files.write("conf/agent/mine.yaml", AGENT_YAML)
    files.write("conf/curriculum/mine.yaml", "_target_: my_curriculum.make\nnum_frames: 256\n")
    yield files
    files.write("my_network.py", "")


@pytest.fixture
def ran(mine, monkeypatch) -> list[int]:
    """The seeds of the cells that were run, with results that are made up."""
    seeds: list[int] = []

    def learn(session, cells, *_):
        [(cfg, run_dir)] = cells
        seeds.append(cfg.seed)
        for path in (run_dir / "run.jsonl", run_dir / "metrics.json"):
            path.unlink(missing_ok=True)
        log = RunLog(run_dir / "run.jsonl")
        about = {"schema": 1, "curriculum": "mine", "trained": [[1]], **job.code_of(cfg, {})}
        log.append("run", **about, config=config.plain(cfg))
        for block, value in enumerate((0.0, cfg.seed / 100)):
            where = {"moment": "after" if block else "before", "block": block, "frames": 256 * block, "task": 1}
            log.append("evaluation", **where, label="goal", held_out=False, return_mean=value, success_rate=value)
        log.close()
        write_metrics(run_dir / "metrics.json", metrics.summary(log.performance(), [(0,)]))
        return {}

    monkeypatch.setattr(job, "learn", learn)
    return seeds


def printed(capsys) -> str:
    return "".join(capsys.readouterr())


def run_results(monkeypatch, command=results.main, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["results", *(arguments or ["runs"])])
    try:
        command()
    except SystemExit as end:
        return int(end.code or 0)
    return 0


CHANGES = {
    "a module of the agent": ("my_network.py", "SIZE = 2\n", "my_network changed"),
    "the agent": ("my_agent.py", AGENT + "    more = 1\n", "my_agent changed"),
    "the curriculum": ("my_curriculum.py", CURRICULUM.format(seed=2), "the curriculum (fingerprint "),
    "what builds it": ("my_curriculum.py", "def make(num_frames):\n    raise OSError('no file')\n", "no file"),
}


def test_a_sweep_refuses_to_go_on_with_other_code_and_lists_what_is_stale(mine, ran, monkeypatch, capsys):
    assert sweep(monkeypatch, *MINE, "seed=20") == 0
    for file, text, said in CHANGES.values():
        before = (mine.folder / file).read_text()
        mine.write(file, text)
        capsys.readouterr()

        assert sweep(monkeypatch, *MINE, "seed=20,22") == 1

        first, stale, *rest = printed(capsys).splitlines()
        assert first == "sweep of 2 cells: 0 done, 1 stale, 0 failed, 0 in use, 1 missing"
        assert stale.startswith("  stale    seed=20") and said in stale
        assert rest == [
            "  missing  seed=22  not begun",
            "stale: the code has changed since; overwrite=stale runs what is stale again, overwrite=true all",
        ]
        mine.write(file, before)
    mine.write(file, text)
    assert sweep(monkeypatch, *MINE, "seed=20,22", "hydra.sweeper.status=true") == 1
    assert printed(capsys).splitlines() == [first, stale, *rest] and ran == [20]


def test_overwrite_stale_runs_what_is_stale_again_and_nothing_else(mine, ran, monkeypatch, capsys):
    sweep(monkeypatch, *MINE, "seed=20")
    mine.write("my_network.py", "SIZE = 2\n")
    sweep(monkeypatch, *MINE, "seed=21")
    capsys.readouterr()

    codes = [sweep(monkeypatch, *MINE, "seed=20,21,22", "overwrite=stale") for _ in range(2)]

    assert codes == [0, 0] and ran == [20, 21, 20, 22]
    assert printed(capsys).count("sweep of 3 cells: 3 done, 0 failed, 0 in use, 0 missing\n") == 2
    assert mixed_code(all_runs(["runs"])) == []


def test_a_comment_a_docstring_or_another_curriculum_in_the_file_is_no_change(mine, ran, monkeypatch):
    sweep(monkeypatch, *MINE, "seed=20")
    mine.write("my_network.py", '"""What is large."""\n\nSIZE = 1  # the smallest\n')
    mine.write("my_curriculum.py", CURRICULUM.format(seed=1) + "def other():\n    return load('ct8')\n")

    assert sweep(monkeypatch, *MINE, "seed=20") == 0
    assert ran == [20]


def test_modules_that_an_agent_finds_only_once_it_is_imported_are_no_change(mine, ran, monkeypatch):
    mine.write("lib/my_part.py", "x = 1\n")
    mine.write("my_network.py", "import sys\nsys.path.insert(0, 'lib')\nimport my_part\nSIZE = my_part.x\n")
    sweep(monkeypatch, *MINE, "seed=20")
    log = next(mine.folder.rglob("run.jsonl"))
    assert list(json.loads(log.read_text().splitlines()[0])["sources"]) == ["my_agent", "my_network", "my_part"]


def test_another_numbers_version_of_the_package_makes_its_own_runs_stale(ran, monkeypatch, capsys):
    sweep(monkeypatch, "seed=20")
    monkeypatch.setattr(provenance, "NUMBERS", NUMBERS + 1)
    capsys.readouterr()

    assert sweep(monkeypatch, "seed=20") == 1
    said = f"ctgraph_rl (numbers version {NUMBERS} before, {NUMBERS + 1} now) changed"
    assert f"  stale    seed=20  {said}" in printed(capsys)


def test_a_finished_run_of_other_code_is_refused_and_not_shown(mine, ran, monkeypatch, capsys):
    command = [*MINE, "seed=20", "hydra.run.dir=out"]
    command_line(monkeypatch, *command)
    for file, text, said in (CHANGES["a module of the agent"], CHANGES["what builds it"]):
        before = (mine.folder / file).read_text()
        mine.write(file, text)
        capsys.readouterr()

        assert command_line(monkeypatch, *command) == 1

        shown = printed(capsys)
        assert said in shown and "average performance" not in shown and ran == [20]
        advice = "overwrite=stale runs it again from the beginning, as overwrite=true does with any run\n"
        refused = "out holds a run of other code: " in shown and shown.endswith(advice)
        assert shown.startswith("error: ") and refused is (said != "no file")
        mine.write(file, before)


def test_overwrite_stale_shows_a_run_whose_code_has_not_changed(mine, monkeypatch, capsys):
    command = [*MINE, "seed=20", "hydra.run.dir=out", "overwrite=stale"]
    codes = [command_line(monkeypatch, *command) for _ in range(2)]
    first = printed(capsys)
    before = Path("out/run.jsonl").read_bytes()

    mine.write("my_network.py", "SIZE = 2\n")
    codes.append(command_line(monkeypatch, *command))

    assert codes == [0, 0, 0]
    assert first.count("this configuration was run before") == 1 and "run before" not in printed(capsys)
    assert Path("out/run.jsonl").read_bytes() != before
    (about,) = RunLog.read("out/run.jsonl").of_kind("run")
    assert sorted(about["sources"]) == ["my_agent", "my_network"]


def test_a_stopped_run_is_not_resumed_with_other_code(mine, ran, monkeypatch, capsys):
    command = [*MINE, "seed=20", "hydra.run.dir=out"]
    command_line(monkeypatch, *command)
    Path("out/metrics.json").unlink()
    Path("out/checkpoints").mkdir()
    Path("out/checkpoints/000000000064.pt").touch()
    mine.write("my_network.py", "SIZE = 2\n")

    assert command_line(monkeypatch, *command) == 1
    assert "out holds a run of other code: my_network changed; overwrite=stale" in printed(capsys)
    Path("out/checkpoints/000000000064.pt").unlink()  # it was stopped before it had any
    assert command_line(monkeypatch, *command) == 0
    assert ran == [20, 20]


@pytest.mark.parametrize("value", ["Stale", "1"])
def test_overwrite_is_true_false_or_stale(ran, monkeypatch, capsys, value):
    codes = [command_line(monkeypatch, *more, f"overwrite={value}") for more in ([], ["-m"])]

    assert codes == [1, 1] and ran == []
    assert printed(capsys).count("error: overwrite must be true, false or stale, got ") == 2


def test_results_and_reports_show_runs_of_different_code_apart(mine, ran, monkeypatch, capsys):
    sweep(monkeypatch, *MINE, "seed=20,21")
    mine.write("my_network.py", "SIZE = 2\n")
    sweep(monkeypatch, *MINE, "seed=22")
    runs = all_runs(["runs"])
    old, new = (runs[i].code["my_network"] for i in (0, 2))
    capsys.readouterr()

    code = run_results(monkeypatch)

    shown, errors = capsys.readouterr()
    names = [f"MyAgent (my_network {digest})" for digest in (old, new)]
    assert code == 1 and old != new
    assert [agent for _, agent in grouped(runs)] == names and all(name in shown for name in names)
    assert {row.estimate.n for row in results.table(runs) if row.measure == "average_performance"} == {1, 2}
    sentence = (
        f"MyAgent on mine was run with different code, shown apart: seeds 20, 21 (my_network {old}); "
        f"seed 22 (my_network {new}); overwrite=stale runs what is stale again"
    )
    assert errors == f"code: {sentence}\n"
    monkeypatch.setattr(page, "OF_SECTION", ())
    monkeypatch.setattr(page, "OF_AGENT", ())
    report = page.write_report(["runs"])
    pages = [(report.page.parent / f"report.{kind}").read_text().replace("\\", "") for kind in ("html", "md")]
    assert all(sentence in text for text in pages)


def test_runs_of_one_configuration_whose_curriculum_changed_are_named(mine, ran, monkeypatch):
    sweep(monkeypatch, *MINE, "seed=20")
    mine.write("my_curriculum.py", CURRICULUM.format(seed=2))
    sweep(monkeypatch, *MINE, "seed=21")
    runs = all_runs(["runs"])

    (sentence,) = mixed_code(runs)

    fingerprints = [run.group[1] for run in runs]
    assert [curriculum for curriculum, _ in grouped(runs)] == [f"mine {each}" for each in fingerprints]
    assert all(
        f"seed {seed} (fingerprint {each})" in sentence for seed, each in zip((20, 21), fingerprints, strict=True)
    )


def test_runs_of_an_older_numbers_version_are_named(ran, monkeypatch, capsys):
    sweep(monkeypatch, "seed=20,21")
    monkeypatch.setattr("ctgraph_rl.log.provenance.NUMBERS", NUMBERS + 1)
    capsys.readouterr()

    assert run_results(monkeypatch) == 0
    said = f"2 of 2 runs are of numbers version {NUMBERS}, this package is of {NUMBERS + 1}: it may give other numbers"
    assert capsys.readouterr().err == f"code: {said}\n"
    sweep(monkeypatch, "seed=22")
    versions = [f"LSTMPPO (numbers version {number})" for number in (NUMBERS, NUMBERS + 1)]
    assert [agent for _, agent in grouped(all_runs(["runs"]))] == versions
    assert run_results(monkeypatch) == 1


def without(path: Path, *names: str) -> None:
    """Remove what earlier versions did not store."""
    first, *rest = path.read_text().splitlines(keepends=True)
    about = {name: value for name, value in json.loads(first).items() if name not in names}
    path.write_text(json.dumps(about) + "\n" + "".join(rest))
    sum_again(path.parent)


def test_a_run_that_does_not_say_its_code_is_of_version_1_and_of_unknown_source(mine, ran, monkeypatch, capsys):
    monkeypatch.setattr(provenance, "NUMBERS", 1)
    sweep(monkeypatch, "seed=20")
    sweep(monkeypatch, *MINE, "seed=20")
    for log in Path("runs").rglob("run.jsonl"):
        without(log, "numbers", "sources")
    mine.write("my_network.py", "SIZE = 2\n")
    capsys.readouterr()

    codes = [sweep(monkeypatch, "seed=20"), sweep(monkeypatch, *MINE, "seed=20"), run_results(monkeypatch)]

    shown, errors = capsys.readouterr()
    assert codes == [0, 0, 0] and len(ran) == 2
    assert "note: 1 cells do not say of which source they are, so it may have changed since\n" in shown
    said = "1 of 2 runs are of unknown code: they do not say of which source they are"
    assert errors == f"code: {said}\n" and code_notes(all_runs(["runs"])) == [said]
    sweep(monkeypatch, *MINE, "seed=21")
    assert len(mixed_code(all_runs(["runs"]))) == 1 and run_results(monkeypatch) == 1


REWARD = """
from dataclasses import dataclass

import torch

@dataclass(frozen=True)
class MyReward:
    scale: float = 1.0

    def __call__(self, *arguments):
        return {value}
"""


def test_a_users_class_in_a_curriculum_counts(mine, ran, monkeypatch):
    mine.write("my_reward.py", REWARD.format(value=1))
    mine.write(
        "my_curriculum.py",
        "from dataclasses import replace\nfrom curricula import load\nfrom my_reward import MyReward\n\n"
        "def make(num_frames):\n    found = load('fo_b1_4tasks', num_frames=num_frames)\n"
        "    own = [replace(b, tasks=tuple(replace(t, reward_fn=MyReward()) for t in b.tasks)) for b in found.blocks]\n"
        "    return replace(found, blocks=tuple(own))\n",
    )
    command = ["--config-dir=conf", "curriculum=mine", "agent=reinforce", "seed=20"]
    assert sweep(monkeypatch, *command) == 0
    (about,) = RunLog.read(next(Path("runs").rglob("run.jsonl"))).of_kind("run")

    mine.write("my_reward.py", REWARD.format(value=2))

    assert list(about["sources"]) == ["my_reward"]
    assert sweep(monkeypatch, *command) == 1 and ran == [20]


def test_an_own_agent_that_changed_gets_new_experts_and_ours_keeps_its_own(mine, compose, monkeypatch):
    monkeypatch.setattr(provenance, "NUMBERS", 1)
    keys = []

    def find(*arguments, **_):
        keys.extend(arguments[3].values())
        raise KeyboardInterrupt

    monkeypatch.setattr(job, "find_or_train", find)

    def key(target: str) -> dict:
        cfg = compose("agent=reinforce", "curriculum=fo_b1_4tasks", "experts=true", f"agent._target_={target}")
        with pytest.raises(KeyboardInterrupt):
            job.run_job(cfg, mine.folder)
        return keys[-1]

    ours, first = key("baselines.reinforce.Reinforce"), key("my_agent.MyAgent")
    mine.write("my_network.py", "SIZE = 2\n")
    second = key("my_agent.MyAgent")

    assert "sources" not in ours and "numbers" not in ours
    assert {**first, "sources": 0} == {**second, "sources": 0} and first != second
    monkeypatch.setattr(provenance, "NUMBERS", 2)
    assert {**key("baselines.reinforce.Reinforce")} == {**ours, "numbers": 2}


def test_runs_from_python_store_the_source_of_what_they_are_given(mine, compose):
    import my_agent  # type: ignore[import-not-found]

    from curricula import load

    curriculum, cfg = load("fo_b1_4tasks", num_frames=128), compose("agent=reinforce", *SMALL_AGENT["reinforce"])
    cfg.agent["_target_"] = "my_agent.MyAgent"
    agent = new_agent(curriculum, config.target(cfg, "agent"), 0)
    Path("trained").mkdir()
    train(curriculum, agent, Path("trained"), 0, console=Console(quiet=True))
    for name, code in (("said", [my_agent.MyAgent]), ("unsaid", None)):
        Recorder(curriculum, name, code=code).log.close()

    found = [RunLog.read(Path(name, "run.jsonl")).measurements[0]["sources"] for name in ("trained", "said", "unsaid")]

    assert sorted(found[0]) == ["my_agent", "my_network"] and found[1:] == [found[0], None]
    with pytest.raises(ValueError, match=r"code must be a list of classes and functions, such as \[MyAgent\], got 3"):
        Recorder(curriculum, code=3)
