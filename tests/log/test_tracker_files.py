"""What trackers hold of a run, read back from their files: the numbers of its log, and nothing from or to elsewhere.

CI installs them all for these tests. Where one is missing, its test is skipped.
"""

from __future__ import annotations

import json
import socket
import sqlite3
import struct
import zlib
from collections.abc import Iterator
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import torch

from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.run import run
from ctgraph_rl.runs.trackers import FOLDER, scalars

SHORT = ("agent=dqn", "curriculum.num_frames=256", "agent.num_envs=16", "agent.num_steps=8", "agent.hidden_size=8")

Numbers = dict[str, list[list[float]]]
"""Of each name its frames and values."""


def read_tensorboard(folder: Path) -> tuple[Numbers, dict[str, Any]]:
    """The numbers, which are float32, and the settings of event files."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
    from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

    numbers: Numbers = {}
    settings = {}
    for path in folder.rglob("events.*"):
        events = EventAccumulator(str(path), size_guidance={"scalars": 0}).Reload()
        for name in events.Tags()["scalars"]:
            numbers[name] = [[event.step, event.value] for event in events.Scalars(name)]
        if not events.Tags()["scalars"]:
            start = events.PluginTagToContent("hparams")["_hparams_/session_start_info"]
            sent = HParamsPluginData.FromString(start).session_start_info.hparams
            settings.update({name: sent[name].number_value or sent[name].string_value for name in sent})
    return numbers, settings


def read_wandb(folder: Path) -> tuple[Numbers, dict[str, Any]]:
    """The numbers, among which W&B keeps the frames of each group, and the settings of an offline run's file."""
    from wandb.proto.wandb_internal_pb2 import Record

    (path,) = folder.glob("wandb/offline-run-*/*.wandb")
    numbers: Numbers = {}
    settings = {}
    for data in _records(path.read_bytes()):
        record = Record.FromString(data)
        for item in [*record.run.config.update, *record.config.update]:
            settings[item.key or ".".join(item.nested_key)] = json.loads(item.value_json)
        row = {item.key or "/".join(item.nested_key): json.loads(item.value_json) for item in record.history.item}
        for name, value in row.items():
            group = name.rpartition("/")[0]
            if group and not name.endswith("/step"):
                numbers.setdefault(name, []).append([row[f"{group}/step"], value])
    return numbers, settings


def _records(file: bytes) -> Iterator[bytes]:
    """The records of a file of W&B, which no reader in its package opens: LevelDB's log format behind 7 bytes.

    A block has 32,768 bytes. A fragment is a checksum (4 bytes), its length (2), its type (1: whole, 2: first,
    3: middle, 4: last) and its data. Fewer than 7 bytes at the end of a block are padding.
    """
    assert file[:4] == b":W&B"
    block, place, record = 32_768, 7, b""
    while place < len(file):
        left = block - place % block
        if left < 7:
            place += left
            continue
        checksum, length, kind = struct.unpack_from("<IHB", file, place)
        data = file[place + 7 : place + 7 + length]
        assert checksum == zlib.crc32(bytes([kind]) + data)
        record += data
        place += 7 + length
        if kind in (1, 4):
            yield record
            record = b""


def read_mlflow(folder: Path) -> tuple[Numbers, dict[str, Any]]:
    """The numbers and the settings, which MLflow keeps as text, of its one run that has ended."""
    from mlflow import MlflowClient

    client = MlflowClient(f"sqlite:///{folder / 'mlflow.db'}")
    (sent,) = client.search_runs([client.get_experiment_by_name("ctgraph_rl").experiment_id])
    assert sent.info.status == "FINISHED"
    numbers = {}
    for name in sent.data.metrics:
        history = client.get_metric_history(sent.info.run_id, name)
        numbers[name] = [[metric.step, metric.value] for metric in history]
    return numbers, sent.data.params


def read_trackio(folder: Path) -> tuple[Numbers, dict[str, Any]]:
    """The numbers and the settings of Trackio's database."""
    numbers: Numbers = {}
    (path,) = folder.glob("*.db")
    with closing(sqlite3.connect(path)) as database:
        rows = database.execute("SELECT step, metrics FROM metrics ORDER BY id").fetchall()
        ((settings,),) = database.execute("SELECT config FROM configs").fetchall()
    for step, row in rows:
        for name, value in json.loads(row).items():
            numbers.setdefault(name, []).append([step, value])
    return numbers, json.loads(settings)


READERS = {"tensorboard": read_tensorboard, "wandb": read_wandb, "mlflow": read_mlflow, "trackio": read_trackio}


def held_by_the_log(run_dir: Path) -> Numbers:
    """What a tracker is to hold."""
    numbers: Numbers = {}
    for measurement in RunLog.read(run_dir / "run.jsonl").measurements:
        for name, value in scalars(measurement).items():
            numbers.setdefault(name, []).append([measurement["frames"], value])
    return numbers


def without_seconds(numbers: Numbers) -> Numbers:
    return {name: rows for name, rows in numbers.items() if not name.endswith("/seconds")}


@pytest.fixture(scope="module")
def untracked(tmp_path_factory) -> Numbers:
    """What the log of the same run holds without a tracker."""
    from hydra import compose, initialize_config_dir

    from ctgraph_rl.packages import conf_dir

    folder = tmp_path_factory.mktemp("untracked")
    with initialize_config_dir(conf_dir(), version_base="1.3"):
        run(compose("config", [*SHORT]), folder)
    return held_by_the_log(folder)


@pytest.fixture
def away(monkeypatch) -> list[Any]:
    """The addresses beyond this machine that Python looks up or connects to, each of which is refused."""
    asked = []
    connect, look_up = socket.socket.connect, socket.getaddrinfo

    def refuse(host: Any) -> None:
        if host not in (None, "", "localhost", "::1", "0.0.0.0") and not str(host).startswith("127."):
            asked.append(host)
            raise OSError(f"{host} is away")

    def connect_here(own, address):
        if isinstance(address, tuple):
            refuse(address[0])
        return connect(own, address)

    def look_up_here(host, *arguments, **more):
        refuse(host)
        return look_up(host, *arguments, **more)

    monkeypatch.setattr(socket.socket, "connect", connect_here)
    monkeypatch.setattr(socket, "getaddrinfo", look_up_here)
    return asked


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.skipif(find_spec(name) is None, reason=f"needs {name}")) for name in READERS],
)
def test_a_tracker_holds_what_the_log_holds_within_the_run_directory(
    name, untracked, compose, tmp_path, monkeypatch, away
):
    here = tmp_path / "here"
    run_dir = tmp_path / "run"
    for folder in (here, run_dir):
        folder.mkdir()
    monkeypatch.chdir(here)

    run(compose(*SHORT, f"logger={name}"), run_dir)

    expected = held_by_the_log(run_dir)
    assert without_seconds(expected) == without_seconds(untracked)
    if name == "tensorboard":
        expected = {key: torch.tensor(rows).tolist() for key, rows in expected.items()}
    numbers, settings = READERS[name](run_dir / FOLDER)
    assert numbers == expected
    assert [frames for frames, _ in numbers["train/block"]] == [128 * i for i in range(1, 9)]
    assert float(settings["agent.num_envs"]) == 16 and settings["agent._target_"] == "baselines.dqn.DQN"
    assert away == []
    assert list(here.iterdir()) == []
