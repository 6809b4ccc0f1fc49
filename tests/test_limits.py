"""What a stranger's file may cost: refused before the memory is spent, with the limit named."""

from __future__ import annotations

import io
import json
import os
import pickle
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import torch
from helpers.reference_files import SHIPPED_2023
from helpers.scripted import PEAK
from helpers.stopped_runs import with_header

import curricula
from ctgraph_rl import Curriculum, RunLog, Task, strict
from ctgraph_rl.log.saved import read_plain
from ctgraph_rl.log.sums import damaged, write_metrics
from ctgraph_rl.log.tables import write_tables
from ctgraph_rl.runs.checkpoints import BrokenCheckpoint, decoded
from ctgraph_rl.runs.read import find_runs
from ctgraph_rl.runs.status import FAILED, MISSING, lock_holder, status_of
from ctgraph_rl.tasks.images import GroupedImages, PaperImages, ReferenceImages

GIB = 2**30


def within(gib: float, code: str, *arguments: str) -> str:
    """Run code in a process that may have so much memory more than its imports; return what it prints."""
    imports = "import resource, sys, torch\nfrom pathlib import Path\nimport ctgraph_rl.runs.load\n"
    limit = (
        "used = 4096 * int(Path('/proc/self/statm').read_text().split()[0])\n"
        f"resource.setrlimit(resource.RLIMIT_AS, (used + int({gib} * 2**30),) * 2)\n"
    )
    command = [sys.executable, "-c", imports + limit + code, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return done.stdout


def saved(value: object) -> bytes:
    buffer = io.BytesIO()
    torch.save(value, buffer)
    return buffer.getvalue()


def archive(records: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as written:
        for name, content in records.items():
            written.writestr(name, content, compresslevel=1)
    return buffer.getvalue()


def with_one_compressed(records: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as written:
        for number, (name, content) in enumerate(records.items()):
            written.writestr(name, content, zipfile.ZIP_STORED if number else zipfile.ZIP_DEFLATED)
    return buffer.getvalue()


def records_of(content: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(content)) as read:
        return {record.filename: read.read(record) for record in read.infolist()}


def of_pickle(pickled: bytes) -> bytes:
    return archive({"archive/data.pkl": pickled, "archive/byteorder": b"little", "archive/version": b"3\n"})


ENCODE, LIST = b"c_codecs\nencode\nq\x01", b"ccollections\nOrderedDict\n"
DOUBLED = b"\x80\x02" + ENCODE + b"h\x01" * 30 + b"X\x01\x00\x00\x00a" + b"X\x03\x00\x00\x00hex\x86R" * 31 + b"."

BOMBS = {
    "compressed records": (
        archive(records_of(saved(torch.zeros(10**7))), zipfile.ZIP_DEFLATED),
        "has compressed records",
    ),
    "one compressed record": (with_one_compressed(records_of(saved(torch.zeros(1000)))), "has compressed records"),
    "an array of zeros by its length": (
        of_pickle(b"\x80\x02c__builtin__\nbytearray\nJ\xff\xff\xff\x7f\x85R."),
        "bytearray",
    ),
    "a text that is doubled again and again": (of_pickle(DOUBLED), "_codecs encode"),
    "a dictionary that is copied": (of_pickle(b"\x80\x02" + LIST + b"]\x85R."), "collections OrderedDict"),
    "a dictionary that is copied by its name from the memo": (
        of_pickle(b"\x80\x02" + LIST + b"q\x01)Rh\x01]\x85R\x86."),
        "collections OrderedDict",
    ),
    "two lists of records": (saved(1) + saved(2), "begin at its start and are listed at its end"),
    "something behind the records": (saved(1) + bytes(4), "more than tensors and plain values|listed at its end"),
    "the old form, which says its sizes itself": (
        b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19.",
        "more than tensors and plain",
    ),
    "a newer pickle": (of_pickle(pickle.dumps({"a": 1}, protocol=4)), "more than tensors and plain values"),
}


@pytest.mark.parametrize("bomb", BOMBS)
def test_an_archive_that_takes_more_than_its_size_is_refused(bomb):
    content, message = BOMBS[bomb]

    with pytest.raises(ValueError, match=message):
        read_plain(content)


def test_what_agents_save_is_read_as_it_was():
    values = {
        **{"tensor": torch.arange(4.0), "shared": [torch.ones(2)] * 2, "half": torch.ones(1, dtype=torch.bfloat16)},
        **{"plain": (1, 2.5, None, True, "text", b"bytes", b"bytes"), "set": {1}, "size": torch.Size([1, 2])},
        **{"parameter": torch.nn.Parameter(torch.ones(1)), "random": torch.get_rng_state(), "type": torch.float32},
    }

    read = read_plain(saved(values))

    assert {key: str(value) for key, value in read.items()} == {key: str(value) for key, value in values.items()}


READ_BOTH = """
from ctgraph_rl.log.saved import read_content, read_plain
from ctgraph_rl.runs.checkpoints import decoded
for read, name in ((lambda path: read_plain(read_content(path)), "agent.pt"), (decoded, "64.pt")):
    try:
        read(Path(sys.argv[1]) / name)
    except ValueError as error:
        print(error)
"""


@pytest.mark.slow
def test_zip_bombs_are_refused_in_less_memory_than_they_ask_for(tmp_path):
    large = torch.zeros(2**26)  # 256 MiB
    bomb = archive(records_of(saved({"frames": 64, "agent": {}, "x": large})), zipfile.ZIP_DEFLATED)
    assert len(bomb) < 2**21
    (tmp_path / "agent.pt").write_bytes(bomb)
    (tmp_path / "64.pt").write_bytes(with_header(bomb))

    lines = within(0.15, READ_BOTH, str(tmp_path)).splitlines()

    assert [("has compressed records, which torch.save does not write" in line) for line in lines] == [True, True]


def test_weights_larger_than_the_machine_are_refused_before_they_are_read(tmp_path):
    path = tmp_path / "000000000064.pt"
    with path.open("wb") as file:
        file.truncate(2**40)  # on the disk it has no bytes

    with pytest.raises(BrokenCheckpoint, match=r"has 1,099,511,627,776 bytes, the limit is [\d,]+; delete it"):
        decoded(path)


ABOUT = {"kind": "run", "schema": 1, "curriculum": "a", "fingerprint": "b", "config": {"seed": 0}}
LINE = {"kind": "evaluation", "moment": "after", "block": 1, "frames": 64, "task": 1, "label": "a", "return_mean": 0.5}


def log_of(folder: Path, *lines: dict) -> Path:
    folder.mkdir()
    (folder / "run.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    (folder / "metrics.json").write_text('{"m": {"value": 1, "definition": "d", "undefined": null}}')
    return folder / "run.jsonl"


SMALL_LOGS = {
    "a task": [ABOUT, *({**LINE, "block": block, "task": 10**6} for block in range(10))],
    "a block": [ABOUT, {**LINE, "block": 10**6}],
    "a trained task": [{**ABOUT, "trained": [[10**6]]}, LINE],
    "a block and a task": [ABOUT, {**LINE, "block": 1000, "task": 1000}],
}


@pytest.mark.parametrize("case", SMALL_LOGS)
def test_a_small_log_makes_no_large_table(tmp_path, case):
    path = log_of(tmp_path / "run", *SMALL_LOGS[case])
    rule = r"beyond what a file of its size can measure, 1,\d{3}: restore the file|is no run's: restore the log"

    with pytest.raises(ValueError, match=rule):
        RunLog.read(path).performance()

    (found,), problems = find_runs([tmp_path])
    assert problems == [] and found.history is None and found.reason is not None


def test_as_many_blocks_and_tasks_as_a_log_has_lines_are_read(tmp_path):
    trained = [[task] for task in range(1, 1201)]
    lines = [{**LINE, "block": block, "task": block, "frames": block} for block in range(1, 1201)]

    performance = RunLog.read(log_of(tmp_path / "run", {**ABOUT, "trained": trained}, *lines)).performance()

    assert performance.shape == (1201, 1200)


def test_a_log_of_many_fields_makes_no_wide_table(tmp_path):
    lines = [{"kind": "training", "block": 1, "frames": 1, f"field{i}": 1} for i in range(300)]

    with pytest.raises(ValueError, match="a table of 303 columns, the limit is 256"):
        write_tables(RunLog.read(log_of(tmp_path / "run", ABOUT, *lines)), tmp_path)


SPECIAL = {"/dev/zero": lambda path: path.symlink_to("/dev/zero"), "a pipe": os.mkfifo}


@pytest.mark.parametrize("make", SPECIAL.values(), ids=SPECIAL)
def test_no_reader_opens_a_pipe_or_a_device(tmp_path, make):
    path = tmp_path / "file.json"
    make(path)
    log_of(tmp_path / "run", ABOUT, LINE)
    for name in ("failed.txt", ".lock", "metrics.json", "run.jsonl"):
        (tmp_path / "run" / name).unlink(missing_ok=True)
        make(tmp_path / "run" / name)

    for read in (Curriculum.from_json, lambda path: Task.from_json(path, (1, 1)), RunLog.read, decoded):
        with pytest.raises(ValueError, match="must be a regular file"):
            read(path)
    with pytest.raises(ValueError, match="must be a regular file"):
        curricula.from_meta_json(path, 512)
    assert [problem.reason for problem in find_runs([tmp_path])[1]] != []
    assert lock_holder(tmp_path / "run") is None
    assert status_of(tmp_path / "run").state in ("done", FAILED)


@pytest.mark.parametrize("make", SPECIAL.values(), ids=SPECIAL)
@pytest.mark.parametrize("name", ["curriculum.json", "agent.pt", "metrics.json"])
def test_no_pipe_or_device_is_opened_to_see_whether_a_run_is_whole(tmp_path, make, name):
    log_of(tmp_path / "run", ABOUT, LINE)
    for each in ("curriculum.json", "agent.pt"):
        (tmp_path / "run" / each).write_bytes(b"")
    write_metrics(tmp_path / "run" / "metrics.json", {})
    (tmp_path / "run" / name).unlink()
    make(tmp_path / "run" / name)

    assert damaged(tmp_path / "run") == [name]
    assert status_of(tmp_path / "run").state in ("done", MISSING)


@pytest.mark.parametrize("make", SPECIAL.values(), ids=SPECIAL)
def test_a_log_that_is_a_pipe_or_a_device_is_not_blank(tmp_path, make):
    make(tmp_path / "run.jsonl")

    assert not RunLog.is_blank(tmp_path / "run.jsonl")


@pytest.mark.parametrize("name", ["run.jsonl", "metrics.json"])
def test_a_file_of_another_length_is_not_read_for_its_sum(tmp_path, name):
    log_of(tmp_path / "run", ABOUT, LINE)
    write_metrics(tmp_path / "run" / "metrics.json", {})
    with (tmp_path / "run" / name).open("wb") as file:
        file.truncate(2**40)  # on the disk it has no bytes

    assert damaged(tmp_path / "run") == [name]


@pytest.mark.parametrize("text", ["process x on HOST", "process -9999999999999999999999 on HOST"])
def test_a_lock_that_names_no_process_is_one_of_another(tmp_path, text):
    (tmp_path / ".lock").write_text(text.replace("HOST", os.uname().nodename))

    assert lock_holder(tmp_path) == text.replace("HOST", os.uname().nodename)


def test_files_of_settings_have_a_limit(tmp_path):
    for read, limit in ((lambda path: Task.from_json(path, (1, 1)), 2**20), (Curriculum.from_json, 2**26)):
        with (tmp_path / "file.json").open("wb") as file:
            file.truncate(limit + 1)

        with pytest.raises(ValueError, match=f"bytes, the limit is {limit:,}"):
            read(tmp_path / "file.json")


@pytest.mark.parametrize("name", ["../secret.json", "/etc/hosts", "envs/../../secret.json", "envs/link.json", "a\0b"])
def test_a_file_names_no_other_outside_of_its_folder(tmp_path, name):
    (tmp_path / "secret.json").write_text(json.dumps(SHIPPED_2023))
    folder = tmp_path / "mine"
    (folder / "envs").mkdir(parents=True)
    (folder / "envs" / "link.json").symlink_to(tmp_path / "secret.json")
    meta = {"config_paths": [name], "task_order": "default", "label_dim": 4, "one_hot": True}
    (folder / "meta.json").write_text(json.dumps(meta))

    with pytest.raises(ValueError, match="config_paths must be in the folder of the file"):
        curricula.from_meta_json(folder / "meta.json", 512)


class Counted(str):
    """A key that counts how often it is compared."""

    compared = 0
    __hash__ = str.__hash__

    def __eq__(self, other: object) -> bool:
        Counted.compared += 1
        return str.__eq__(self, other)


def test_repeated_keys_are_found_in_linear_time():
    pairs = [(Counted(f"key{number}"), None) for number in range(2000)] + [(Counted("key7"), None)]
    Counted.compared = 0

    with pytest.raises(ValueError, match="key 'key7' occurs twice"):
        strict._unique(pairs)

    assert Counted.compared < 5 * len(pairs)


MANY = {
    "PaperImages": PaperImages(3**16),
    "GroupedImages": GroupedImages((10**6,) * 4, 0.3, 0.33, cells=180, size=180),
    "ReferenceImages": ReferenceImages(10**8),
}


@pytest.mark.parametrize("images", MANY.values(), ids=MANY)
def test_images_that_no_machine_can_make_are_refused_before_they_are_made(monkeypatch, images):
    monkeypatch.setattr("ctgraph_rl.checks.memory_bytes", lambda: 64 * GIB)

    with pytest.raises(
        ValueError, match=r"images while they are made need [\d,]+ bytes, this machine has 68,719,476,736"
    ):
        _ = images.images


MADE = {
    "GroupedImages((3000,) * 2, 0.3, 0.33, cells=12, size=12)": 100,
    "ReferenceImages(10_000)": 20,
    "ReferenceImages(1_000).bank(30)": 8,
    "PaperImages(20_000, size=24)": 40,
}
"""The most bytes for a byte of images, small ones first: what they leave free, large ones use without growth."""


@pytest.mark.slow
def test_making_images_takes_a_limited_multiple_of_their_size():
    code = f"from ctgraph_rl.tasks.images import *\n{PEAK}" + "".join(
        f"Path('/proc/self/clear_refs').write_text('5')\nbefore = peak()\n"
        f"made = {kind}\nmade = getattr(made, 'images', made)\nprint((peak() - before) / made.numel())\n"
        for kind in MADE
    )

    found = [float(line) for line in within(4, code).split()]

    assert [multiple < most for multiple, most in zip(found, MADE.values(), strict=True)] == [True] * len(MADE), found
