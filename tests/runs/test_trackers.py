"""Trackers: what they are sent, where they write, and that no fault of theirs reaches the run."""

from __future__ import annotations

import re
import shutil
import sys
import warnings
from pathlib import Path

import pytest
from torchrl.record.loggers.common import Logger

from ctgraph_rl import Recorder
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.run import run
from ctgraph_rl.runs.config import plain, run_name
from ctgraph_rl.runs.read import flat
from ctgraph_rl.runs.trackers import FOLDER, Tracker, csv_logger, scalars
from curricula import su_b1_4tasks

SHORT = ("agent=dqn", "curriculum.num_frames=256", "agent.num_envs=16", "agent.num_steps=8", "agent.hidden_size=8")
PACKAGES = ("tensorboard", "wandb", "mlflow", "trackio")
TRAINING = {"kind": "training", "block": 2, "frames": 512, "episodes": 0, "return_mean": None, "loss_value": 0.25}


class Memory(Logger):
    """Keeps what it is sent; raises ``error`` instead in the calls of one method, from a number on."""

    def __init__(self, method: str = "", error: type[BaseException] = OSError, after: int = 0) -> None:
        self.fails, self.error, self.left = method, error, after
        self.sent: list[tuple] = []
        super().__init__(exp_name="memory", log_dir="")

    def _take(self, method, *values):
        if method == self.fails and self.left == 0:
            raise self.error("the server is down")
        self.left -= method == self.fails
        self.sent.append((method, *values))

    def log_hparams(self, cfg):
        self._take("log_hparams", cfg)

    def log_metrics(self, metrics, step=None, *, keys_sep="/"):
        self._take("log_metrics", metrics, step)

    def close(self, timeout=None):
        self._take("close")

    def _create_experiment(self): ...

    def log_scalar(self, name, value, step=None): ...

    def log_video(self, name, video, step=None, **kwargs): ...

    def log_histogram(self, name, data, **kwargs): ...

    def __repr__(self):
        return "Memory()"


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> dict[str, Path]:
    """Directories of the same short run, without a tracker and with CSV files."""
    from hydra import compose, initialize_config_dir

    from ctgraph_rl.packages import conf_dir

    folders = {name: tmp_path_factory.mktemp(name) for name in ("none", "csv")}
    with initialize_config_dir(conf_dir(), version_base="1.3"):
        for name, folder in folders.items():
            run(compose("config", [*SHORT, "logger=csv"] if name == "csv" else [*SHORT]), folder)
    return folders


def measured(run_dir: Path) -> list[dict]:
    return [{**m, "seconds": 0} for m in RunLog.read(run_dir / "run.jsonl").measurements]


def test_a_run_is_the_same_with_and_without_a_tracker(runs):
    assert measured(runs["csv"]) == measured(runs["none"])
    assert not (runs["none"] / FOLDER).exists()


def test_every_number_of_training_and_evaluation_arrives_at_its_frame(runs):
    expected: dict[str, list[list[float]]] = {}
    for m in RunLog.read(runs["csv"] / "run.jsonl").measurements:
        for name, value in scalars(m).items():
            expected.setdefault(f"{name}.csv", []).append([m["frames"], value])

    folder = runs["csv"] / FOLDER / "scalars"
    found = {
        str(path.relative_to(folder)): [[float(cell) for cell in line.split(",")] for line in path.open()]
        for path in folder.rglob("*.csv")
    }

    assert found == expected
    assert {"train/loss_value.csv", "train/exploration.csv", "train/grad_norm.csv"} < set(found)
    assert [frames for frames, _ in found["train/block.csv"]] == [128 * i for i in range(1, 9)]
    assert [frames for frames, _ in found["eval/goal2_1/success_rate.csv"]] == [0, 256, 512, 768, 1024]


def test_what_a_method_adds_to_the_losses_is_sent_too(compose, tmp_path):
    run(compose(*SHORT, "agent.batch_size=32", "method=l2", "logger=csv"), tmp_path)

    added = (tmp_path / FOLDER / "scalars" / "train" / "loss_method.csv").read_text().splitlines()

    values = [float(each.split(",")[1]) for each in added]
    assert values[:2] == [0.0, 0.0]  # nothing is held in the first block of two batches
    assert all(value > 0 for value in values[2:])


def test_a_tracker_is_told_the_configuration_by_dotted_names(runs, compose):
    config = dict(flat(plain(compose(*SHORT))))

    (file,) = (runs["csv"] / FOLDER / "texts").iterdir()

    assert file.read_text() == "\n".join(f"{name}: {config[name]}" for name in sorted(config))
    assert config["agent.num_envs"] == 16


@pytest.mark.parametrize("name", PACKAGES)
def test_the_choice_of_a_tracker_is_no_part_of_what_the_run_is(name, compose):
    without, chosen = (compose(*SHORT, *tracker, return_hydra_config=True) for tracker in ([], [f"logger={name}"]))

    assert plain(chosen) == plain(without)
    assert run_name(_root_=chosen) == run_name(_root_=without)


def test_the_numbers_of_training_are_named_train():
    measurement = {**TRAINING, "success_rate": 0.5, "seconds": 1.5}

    named = {"block": 2, "episodes": 0, "loss_value": 0.25, "success_rate": 0.5, "seconds": 1.5}
    assert scalars(measurement) == {f"train/{name}": value for name, value in named.items()}


def test_the_numbers_of_an_evaluation_have_the_task_in_their_name_and_no_sign_that_a_tracker_refuses():
    where = {"kind": "evaluation", "block": 1, "frames": 512, "task": 3, "label": "goal1.2-img1#2", "held_out": True}

    assert scalars({**where, "moment": "after", "return_mean": 1.0, "end_rate": None}) == {
        "eval/goal1_2-img1_2/block": 1,
        "eval/goal1_2-img1_2/return_mean": 1.0,
    }


def test_what_is_no_measurement_of_training_or_evaluation_is_not_sent(tmp_path):
    logger = Memory()

    with Tracker(lambda folder: logger, tmp_path, {}) as tracker:
        tracker({"kind": "run", "schema": 1, "num_threads": 1})
        tracker({"kind": "training", "frames": 8, "return_mean": None})

    assert logger.sent == [("log_hparams", {}), ("close",)]


def test_hyperparameters_are_numbers_truths_or_text(tmp_path):
    logger = Memory()

    Tracker(lambda folder: logger, tmp_path, {"a.b": 0.5, "c": True, "d": None, "e": [1, 2], "f": "adam"})

    assert logger.sent == [("log_hparams", {"a.b": 0.5, "c": True, "d": "None", "e": "[1, 2]", "f": "adam"})]


@pytest.mark.parametrize(("method", "num_sent"), [("log_hparams", 0), ("log_metrics", 2), ("close", 4)])
def test_a_tracker_that_fails_warns_once_gets_no_more_and_the_log_is_whole(method, num_sent, tmp_path):
    logger = Memory(method, after=int(method == "log_metrics"))
    log = RunLog(tmp_path / "run.jsonl")

    def memory(folder):
        return logger

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with Tracker(memory, tmp_path, {}) as tracker:
            log.listeners.append(tracker)
            for frames in (8, 16, 24):
                log.append("training", block=1, frames=frames, loss_value=0.5)
    log.close()

    assert [str(w.message) for w in caught] == ["memory failed, the run continues without it: the server is down"]
    everything = ["log_hparams", "log_metrics", "log_metrics", "log_metrics", "close"]
    assert [name for name, *_ in logger.sent] == everything[:num_sent]
    assert [m["frames"] for m in RunLog.read(tmp_path / "run.jsonl").measurements] == [8, 16, 24]


def test_a_tracker_that_cannot_start_is_a_warning_too(tmp_path):
    def unreachable(folder):
        raise ConnectionError("no route to host")

    with pytest.warns(UserWarning, match="unreachable failed, the run continues without it: no route to host"):
        tracker = Tracker(unreachable, tmp_path, {})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tracker(TRAINING)


def test_an_interrupt_within_a_tracker_stops_the_run(tmp_path):
    tracker = Tracker(lambda folder: Memory("log_metrics", KeyboardInterrupt), tmp_path, {})

    with pytest.raises(KeyboardInterrupt):
        tracker(TRAINING)


def test_a_resumed_run_sends_all_it_measured_to_a_folder_made_anew(tmp_path):
    log = RunLog(tmp_path / "run.jsonl")
    for frames in (8, 16, 24):
        log.append("training", block=1, frames=frames, loss_value=frames / 8)
        if frames == 16:
            position = log.position()
    log.close()
    (tmp_path / FOLDER).mkdir()
    (tmp_path / FOLDER / "old").touch()

    resumed = RunLog.resume(tmp_path / "run.jsonl", position)
    with Tracker(csv_logger, tmp_path, {}) as tracker:
        resumed.listeners.append(tracker)
        resumed.append("training", block=1, frames=24, loss_value=4.0)
        resumed.append("training", block=1, frames=32, loss_value=5.0)

    assert (tmp_path / FOLDER / "scalars/train/loss_value.csv").read_text() == "8,1.0\n16,2.0\n24,4.0\n32,5.0\n"
    assert not (tmp_path / FOLDER / "old").exists()


def test_a_run_that_replaces_another_leaves_no_files_of_its_tracker(runs, compose, tmp_path):
    shutil.copytree(runs["csv"], tmp_path, dirs_exist_ok=True)
    assert (tmp_path / FOLDER).exists()

    run(compose(*SHORT, "overwrite=true"), tmp_path)

    assert not (tmp_path / FOLDER).exists()
    assert measured(tmp_path) == measured(runs["none"])


@pytest.mark.parametrize("name", PACKAGES)
def test_a_missing_tracker_says_what_to_install_before_anything_is_written(name, compose, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, name, None)

    with pytest.raises(ModuleNotFoundError, match=rf"^logger={name} needs {name}: pip install 'ctgraph_rl\[{name}\]'$"):
        run(compose(*SHORT, f"logger={name}"), tmp_path)

    assert [path.name for path in tmp_path.iterdir()] == []


def test_a_mode_that_wandb_does_not_have_is_refused(compose, tmp_path):
    with pytest.raises(ValueError, match=r"^logger\.mode must be one of offline, online, got 'disabled'$"):
        run(compose(*SHORT, "logger=wandb", "logger.mode=disabled"), tmp_path)


def test_the_page_names_every_tracker_and_every_key(checkout):
    page = (checkout / "docs" / "how-to" / "loggers.md").read_text(encoding="utf-8")

    for path in (checkout / "conf" / "logger").iterdir():
        assert f"`logger={path.stem}`" in page
        keys = re.findall(r"^(\w+):.*  # ", path.read_text(encoding="utf-8"), re.MULTILINE)
        assert [key for key in keys if key != "_target_" and f"`logger.{key}" not in page] == []
    assert {path.stem for path in (checkout / "conf" / "logger").iterdir()} == {"csv", *PACKAGES}


def test_a_recorder_removes_what_was_tracked_of_a_run_and_no_folder_of_the_user(tmp_path):
    own = tmp_path / FOLDER / "mine.txt"
    own.parent.mkdir()
    own.touch()

    with Recorder(su_b1_4tasks(num_frames=256), tmp_path):
        assert own.exists()
    Recorder(su_b1_4tasks(num_frames=256), tmp_path, overwrite=True).close()

    assert not own.exists()
