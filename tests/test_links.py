"""Nothing that the package writes follows a link: one module writes, and links in a directory lead nowhere."""

from __future__ import annotations

import ast
import os
import shutil
import sys
from pathlib import Path

import pytest
from helpers.architecture import PACKAGES, find_sources
from helpers.made_runs import write_run
from helpers.reference_files import SHIPPED_2023
from helpers.stopped_runs import learn_into, stopped_run

import curricula
from ctgraph_rl import RunLog, Task
from ctgraph_rl.disk import open_own, read_regular, write_named, write_whole
from ctgraph_rl.log import export
from ctgraph_rl.log.files import locked
from ctgraph_rl.report import page, results
from ctgraph_rl.report.page import write_report
from ctgraph_rl.runs.config import write_configuration
from ctgraph_rl.runs.experts import find_or_train
from ctgraph_rl.runs.load import load
from ctgraph_rl.runs.session import mark_failure
from ctgraph_rl.runs.trackers import Tracker, csv_logger

WRITING = {
    *("write_text", "write_bytes", "savefig", "save", "to_csv", "to_parquet", "write_table", "dump", "tofile", "savez"),
    *("touch", "truncate", "mkdir", "makedirs", "mkstemp", "mkdtemp", "NamedTemporaryFile", "TemporaryDirectory"),
    *("copy2", "copyfile", "copytree", "move", "symlink_to", "hardlink_to", "symlink", "link"),
}
"""Functions and methods that write files or make folders, unless what they write into is in memory."""

ALLOWED = {
    ("benchmarks.host", "TemporaryDirectory"): "a folder of this process",
    ("benchmarks.host", "run_dir.mkdir"): "in it",
    ("ctgraph_rl.board.isolate", "group.mkdir"): "a cgroup",
    ("ctgraph_rl.board.isolate", "path.open"): "a file of a cgroup",
    ("ctgraph_rl.board.relearn", "run_dir.mkdir"): "in the folder of a process",
    ("ctgraph_rl.core.kernel", "folder.mkdir"): "the user's own cache, which no other can write to",
    ("ctgraph_rl.core.kernel", "tempfile.TemporaryDirectory"): "as above",
    ("ctgraph_rl.log.export", "arguments.out.mkdir"): "named by the user",
    ("ctgraph_rl.log.export", "where.mkdir"): "in a folder that was empty",
    ("ctgraph_rl.log.files", "file.truncate"): "a file that open_own opened",
    ("ctgraph_rl.cli", "os.open"): "the null device, in place of a broken pipe",
    ("ctgraph_rl.log.run_log", "file.truncate"): "as above",
    ("ctgraph_rl.report.page", "folder.mkdir"): "named by the user",
    ("ctgraph_rl.runs.checkpoints", "each.save"): "a method of Checkpoints, which writes through ctgraph_rl.disk",
    ("ctgraph_rl.runs.on_dask", "Path(sys.argv[1]).write_bytes"): "in a folder of this process",
    ("ctgraph_rl.runs.on_dask", "tempfile.TemporaryDirectory"): "as above",
    ("ctgraph_rl.runs.sweep", "folder.mkdir"): "named by the user",
    ("ctgraph_rl.runs.trackers", "folder.mkdir"): "after a link is refused",
}
"""Calls outside of `ctgraph_rl.disk`, and why they follow no link of a stranger."""


def writing_calls(source: str) -> list[str]:
    """The calls of a module that write."""
    tree = ast.parse(source)
    nodes = list(ast.walk(tree))
    made = [node for node in nodes if isinstance(node, ast.Assign) and "IO(" in ast.unparse(node.value)]
    in_memory = {ast.unparse(target) for node in made for target in node.targets}
    calls = [node for node in nodes if isinstance(node, ast.Call)]
    return [
        ast.unparse(call.func)
        for call in calls
        if writes(call) and not in_memory & {ast.unparse(argument) for argument in call.args}
    ]


def writes(call: ast.Call) -> bool:
    name = ast.unparse(call.func)
    if name == "os.open":
        return True
    if name.rpartition(".")[2] == "open":
        modes = [*call.args[name == "open" :], *(each.value for each in call.keywords if each.arg == "mode")]
        return any(not isinstance(mode, ast.Constant) or set("wax+") & set(str(mode.value)) for mode in modes[:1])
    return name.rpartition(".")[2] in WRITING and not name.startswith("self.")


def test_files_are_written_in_one_module():
    sources = find_sources(*PACKAGES)
    found = {(name, call) for name, source in sources.items() for call in writing_calls(source)}

    assert {each for each in found if each[0] != "ctgraph_rl.disk"} == set(ALLOWED)


@pytest.mark.parametrize(
    "source",
    [
        *('open(path, "w")', 'path.open("ab")', "open(path, mode)", 'open(path, mode="r+")', "path.write_text(text)"),
        *("figure.savefig(path)", "torch.save(state, path)", "OmegaConf.save(cfg, path)", "shutil.copy2(a, b)"),
    ],
)
def test_the_search_finds_what_writes(source):
    assert len(writing_calls(source)) == 1


@pytest.mark.parametrize("source", ['open(path, "rb")', "path.open()", "b = io.BytesIO()\ntorch.save(state, b)"])
def test_the_search_leaves_what_does_not(source):
    assert writing_calls(source) == []


class Victims:
    """Files and folders outside of a directory, and links to them in it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir()
        (folder / "000000000001.pt").write_text("mine")
        (folder / "a.part").write_text("mine")
        (folder / "run.jsonl").write_text("mine")
        self.before = self.content()

    def content(self) -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in self.folder.rglob("*") if path.is_file()}

    def plant(self, path: Path) -> None:
        """Put links to a victim in place of a file and of the file that is written beside it."""
        path.parent.mkdir(parents=True, exist_ok=True)
        for place in (path, path.with_name(path.name + ".part")):
            place.unlink(missing_ok=True)
            place.symlink_to(self.folder / "run.jsonl")

    def are_untouched(self) -> bool:
        return self.content() == self.before


@pytest.fixture
def victims(tmp_path) -> Victims:
    return Victims(tmp_path / "mine")


def files_in(folder: Path) -> list[Path]:
    return sorted(path.relative_to(folder) for path in folder.rglob("*") if not path.is_dir())


def test_a_run_and_its_report_replace_links_to_every_file_they_write(compose, tmp_path, victims, monkeypatch):
    monkeypatch.setattr(page, "OF_SECTION", page.OF_SECTION[:1])
    monkeypatch.setattr(page, "OF_AGENT", ())

    def make(run_dir):
        learn_into(run_dir)
        write_configuration(compose(), run_dir / ".hydra")
        write_report([run_dir])

    plain, planted = tmp_path / "plain", tmp_path / "planted"
    make(plain)
    written = files_in(plain)
    assert len(written) > 7
    for path in (*written, Path("restarts.jsonl")):
        victims.plant(planted / path)

    make(planted)

    assert victims.are_untouched()
    left = [path for path in files_in(planted) if (planted / path).is_symlink()]
    assert [path for path in left if path.suffix != ".part"] == []
    assert set(written) <= set(files_in(planted))


def a_run(folder: Path) -> Path:
    """A run that was stopped, so that it has files of all kinds."""
    return stopped_run(folder / "run")


def new_tracker(run_dir: Path) -> None:
    Tracker(csv_logger, run_dir, {})


def experts_of(run_dir: Path) -> None:
    find_or_train(curricula.load("ct2_interfering"), lambda *_: {}, run_dir.parent, {0: {}}, print)


def expert_dir(folder: Path) -> str:
    """The name that an expert's directory has."""
    made: list[Path] = []
    learn = lambda _, run_dirs, session: made.extend(run_dirs.values()) or {}  # noqa: E731
    find_or_train(curricula.load("ct2_interfering"), learn, folder / "x", {0: {}}, print)
    return f"../{made[0].name}"


def lock(run_dir: Path) -> None:
    with locked(run_dir):
        pass


LINKED = {
    "a checkpoint's folder, resumed": ("checkpoints", learn_into),
    "a checkpoint's folder, loaded": ("checkpoints", load),
    "the log, resumed": ("run.jsonl", learn_into),
    "the list of restarts": ("restarts.jsonl", learn_into),
    "the lock": (".lock", lock),
    "a tracker's folder": ("tracker", new_tracker),
    "a report's folder": ("report", lambda run_dir: write_report([run_dir])),
    "a report's figures": ("report/figures", lambda run_dir: write_report([run_dir])),
    "an expert's directory": (expert_dir, experts_of),
}


@pytest.mark.parametrize("case", LINKED)
def test_a_linked_folder_lock_or_log_is_refused_and_what_it_leads_to_untouched(tmp_path, victims, case):
    name, use = LINKED[case]
    run_dir = write_run(tmp_path / "run") if "report" in case else a_run(tmp_path)
    path = run_dir / (name(tmp_path) if callable(name) else name)
    path.parent.mkdir(exist_ok=True)
    if path.is_dir():
        for file in path.iterdir():
            file.rename(victims.folder / file.name)
        path.rmdir()
    elif path.exists():
        path.rename(victims.folder / "run.jsonl")
    victims.before = victims.content()
    path.symlink_to(victims.folder / "run.jsonl" if path.suffix or path.name == ".lock" else victims.folder)

    with pytest.raises(ValueError, match=r"is a symbolic link, and links within .* are not followed; remove it"):
        use(run_dir)

    assert victims.are_untouched()


@pytest.mark.parametrize("make", [os.link, lambda target, path: os.mkfifo(path)], ids=["hard link", "pipe"])
@pytest.mark.parametrize("name", [".lock", "restarts.jsonl"])
def test_a_file_changed_in_place_must_be_regular_and_have_one_name(tmp_path, victims, make, name):
    run_dir = a_run(tmp_path)
    make(victims.folder / "run.jsonl", run_dir / name)

    with pytest.raises(ValueError, match="must be a regular file without another name"):
        lock(run_dir) if name == ".lock" else learn_into(run_dir)

    assert victims.are_untouched()


def test_why_a_run_failed_replaces_a_link(tmp_path, victims):
    run_dir = a_run(tmp_path)
    victims.plant(run_dir / "failed.txt")

    with pytest.raises(ZeroDivisionError), mark_failure(run_dir):
        _ = 1 / 0

    assert victims.are_untouched()
    assert (run_dir / "failed.txt").read_text() == "ZeroDivisionError: division by zero\n"


def test_a_file_that_is_being_written_is_new(tmp_path, victims):
    victims.plant(tmp_path / "file")

    write_whole(tmp_path / "file", "text")

    assert victims.are_untouched()
    assert not (tmp_path / "file").is_symlink() and (tmp_path / "file").read_text() == "text"


def test_a_curriculum_or_task_is_not_written_through_a_link_that_leads_nowhere(tmp_path):
    (tmp_path / "file.json").symlink_to(tmp_path / "nowhere")
    task = Task.from_json(SHIPPED_2023, goal=(1, 1))

    for write in (curricula.load("su_b1_4tasks").to_json, task.to_json):
        with pytest.raises(ValueError, match=r"file\.json exists: choose another path, nothing is overwritten"):
            write(tmp_path / "file.json")

    assert not (tmp_path / "nowhere").exists()


def test_tables_and_exports_replace_links(tmp_path, victims, monkeypatch):
    run_dir = write_run(tmp_path / "run")
    for name in ("evaluations.csv", "training.csv", "evaluations.parquet", "training.parquet"):
        victims.plant(tmp_path / "out" / name)
    monkeypatch.setattr(sys, "argv", ["export", str(run_dir), "--format", "parquet", "--out", str(tmp_path / "out")])

    export.main()

    assert victims.are_untouched()
    assert (tmp_path / "out" / "evaluations.csv").read_text().startswith("curriculum,")


def test_what_the_user_names_is_written_through_a_link_or_pipe_of_theirs(tmp_path, monkeypatch):
    write_run(tmp_path / "run")
    (tmp_path / "table.csv").symlink_to(tmp_path / "elsewhere.csv")
    monkeypatch.setattr(sys, "argv", ["results", str(tmp_path / "run"), "--csv", str(tmp_path / "table.csv")])

    results.main()
    reader, writer = os.pipe()
    write_named(f"/dev/fd/{writer}", "text")

    assert (tmp_path / "table.csv").is_symlink()
    assert (tmp_path / "elsewhere.csv").read_text().startswith("curriculum,agent,")
    assert os.read(reader, 9) == b"text"


def test_a_log_is_new_or_refused(tmp_path, victims):
    victims.plant(tmp_path / "run.jsonl")

    with pytest.raises(ValueError, match="is a symbolic link"):
        RunLog(tmp_path / "run.jsonl")
    with pytest.raises(FileExistsError):
        RunLog(victims.folder / "run.jsonl")

    assert victims.are_untouched()


def test_only_regular_files_up_to_their_limit_are_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "file").write_bytes(b"1234")

    assert read_regular(tmp_path / "file", 4) == b"1234"
    for path in (tmp_path / "pipe", "/dev/zero", tmp_path):
        with pytest.raises((ValueError, IsADirectoryError), match=r"must be a regular file|Is a directory"):
            read_regular(path, 4)
    with pytest.raises(ValueError, match=r"file has 4 bytes, the limit is 3"):
        read_regular(tmp_path / "file", 3)
    with pytest.raises(ValueError, match="must be a regular file"):
        open_own(tmp_path / "pipe", "ab")


def test_a_stopped_run_is_not_resumed_into_the_checkpoints_of_another(tmp_path, victims):
    run_dir = a_run(tmp_path)
    other = Path(shutil.copytree(run_dir, tmp_path / "other"))
    before = {path: path.read_bytes() for path in other.rglob("*.pt")}
    shutil.rmtree(run_dir / "checkpoints")
    (run_dir / "checkpoints").symlink_to(other / "checkpoints")

    with pytest.raises(ValueError, match="checkpoints is a symbolic link"):
        learn_into(run_dir)

    assert {path: path.read_bytes() for path in other.rglob("*.pt")} == before
