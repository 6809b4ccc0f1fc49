"""``exchange=NAME``: a collective of one command; its members are runs like any other, and it reports on itself."""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import pytest
import torch
from helpers.kill_runs import equal
from helpers.sweeping import command_line, sweep

import curricula
from ctgraph_rl import RunLog
from ctgraph_rl.collective import job
from ctgraph_rl.collective import report as collectives
from ctgraph_rl.collective.report import find_collectives
from ctgraph_rl.collective.summary import metrics, read_collective
from ctgraph_rl.log.sums import metrics_of
from ctgraph_rl.runs.checkpoints import Checkpoints
from ctgraph_rl.runs.load import load
from ctgraph_rl.runs.read import find_runs

TINY = (
    *("curriculum=l2d2c_2x2", "curriculum.num_frames=128", "curriculum.agent=1", "evaluation.num_episodes=2"),
    *("agent=ppo", "agent.hidden_size=4", "agent.num_envs=8", "agent.num_steps=8", "agent.num_epochs=1"),
    *("method=mask_ri", "method.backbone_seed=9157"),
)
"""The last two give the method."""

SHARING = (*TINY, "exchange=l2d2c", "exchange.every=1", "exchange.num_members=2")


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def content(run_dir: Path) -> tuple:
    """All measurements but their times and what names the collective, and the weights."""
    lines = [{**line, "seconds": 0} for line in RunLog.read(run_dir / "run.jsonl").measurements]
    lines[0]["config"].pop("exchange", None)
    return lines, torch.load(run_dir / "agent.pt", weights_only=True)


def same(one: Path, other: Path) -> bool:
    (lines, weights), (its_lines, its_weights) = content(one), content(other)
    return lines == its_lines and equal(weights, its_weights)


def the_collective(folder: str = "runs") -> Path:
    [log] = Path(folder).rglob("collective.jsonl")
    return log.parent


def stop_at_save(monkeypatch, count: int) -> None:
    """Stop the process after so many checkpoints."""
    calls = []
    save = Checkpoints.save

    def stopped(*given, **settings):
        save(*given, **settings)
        calls.append(given)
        if len(calls) == count:
            raise KeyboardInterrupt

    monkeypatch.setattr(Checkpoints, "save", stopped)


@pytest.mark.slow
def test_members_of_an_isolated_collective_are_the_runs_that_their_settings_name(monkeypatch, capsys):
    assert command_line(monkeypatch, *TINY, "exchange=isolated", "exchange.num_members=2") == 0
    assert "2 members, Isolated, l2d2c_2x2: learned" in capsys.readouterr().out
    found = the_collective()
    assert found.name.startswith("ppo-mask_ri-isolated-seed0-")

    for number, settings in enumerate((["curriculum.agent=1", "seed=0"], ["curriculum.agent=2", "seed=1000"])):
        alone = f"hydra.run.dir=alone/{number}"
        assert command_line(monkeypatch, *TINY[:2], *TINY[3:], *settings, alone) == 0
        member = found / f"member_{number:03d}"
        assert same(member, Path(f"alone/{number}"))
        files = [
            {str(path.relative_to(each)) for path in each.rglob("*")} for each in (member, Path(f"alone/{number}"))
        ]
        assert files[0] == files[1]
        assert load(member).seed == 1000 * number
    assert len(find_runs([found])[0]) == 2


@pytest.mark.slow
def test_a_stopped_collective_is_resumed_bit_by_bit_and_a_finished_one_is_left(monkeypatch, capsys):
    assert sweep(monkeypatch, *SHARING, "hydra.sweep.dir=whole") == 0
    whole = the_collective("whole")
    with monkeypatch.context() as patch:
        stop_at_save(patch, 3)
        assert sweep(patch, *SHARING, "checkpoint_seconds=1e-9") == 130
    capsys.readouterr()
    assert sweep(monkeypatch, *SHARING, "hydra.sweeper.status=true") == 1
    assert "stopped; the next start resumes it" in capsys.readouterr().out

    assert sweep(monkeypatch, *SHARING) == 0

    found = the_collective()
    for number in range(2):
        assert same(*(each / f"member_{number:03d}" for each in (found, whole)))
        assert (found / f"member_{number:03d}" / "restarts.jsonl").exists()
    for name in ("members.csv", "messages.csv", "helps.csv"):
        assert (found / name).read_bytes() == (whole / name).read_bytes()
    ours, theirs = (metrics_of((each / "metrics.json").read_bytes()) for each in (found, whole))
    assert ours == theirs
    assert not (found / "checkpoints").exists()
    before = (found / "collective.jsonl").read_bytes()
    capsys.readouterr()
    assert sweep(monkeypatch, *SHARING) == 0
    assert "1 done" in capsys.readouterr().out
    assert command_line(monkeypatch, *SHARING) == 0
    assert "was run before" in capsys.readouterr().out
    assert (found / "collective.jsonl").read_bytes() == before
    assert command_line(monkeypatch, *SHARING, "overwrite=true") == 0
    assert same(found / "member_001", whole / "member_001")


POPULATION = """
import torch
from baselines.exchanges.exchange import Exchange
from ctgraph_rl.learn.collective import Help
from ctgraph_rl.learn.messages import to_all


class Population(Exchange):
    def __init__(self, num_members, every, drop_prob, delay_prob, key, values):
        super().__init__(num_members, every, drop_prob, delay_prob)
        self.key, self.values, self.returns = key, values, {}

    def settings_of(self, member):
        return {self.key: self.values[member]}

    def connect(self, agents):
        self.policies = [agent.policy for agent in agents]
        self.kinds = ["weights"]

    def observe(self, member, batch, episode_return):
        self.returns[member] = episode_return

    def send(self, kind, member, received):
        weights = torch.nn.utils.parameters_to_vector(self.policies[member].parameters()).detach()
        return to_all(kind, member, self.num_members, {"reward": self.returns[member], "weights": weights})

    def receive(self, member, received):
        better = [each for each in received if each.content["reward"] >= self.returns[member]]
        for each in better[:1]:
            torch.nn.utils.vector_to_parameters(each.content["weights"], self.policies[member].parameters())
        return [Help(each.sender, member, {"reward": each.content["reward"]}) for each in better[:1]]

    def state_dict(self):
        return {"returns": dict(self.returns)}

    def load_state_dict(self, state):
        self.returns = dict(state["returns"])
"""
"""A user's population: each member has another learning rate, and copies the weights of one with no lower return."""

GROWN = (
    *("curriculum=su_b1_4tasks", "curriculum.num_frames=128", "evaluation.num_episodes=2", *TINY[4:-2]),
    *("+exchange._target_=population.Population", "+exchange.num_members=2", "+exchange.every=1"),
    *("+exchange.drop_prob=0.0", "+exchange.delay_prob=0.0"),
    *("+exchange.key=agent.learning_rate", "+exchange.values=[0.001,0.1]"),
)


@pytest.fixture
def population(monkeypatch):
    Path("population.py").write_text(POPULATION)
    yield
    sys.modules.pop("population", None)


def test_a_population_has_settings_of_its_own_for_each_member_and_resumes(monkeypatch, capsys, population):
    assert command_line(monkeypatch, *GROWN, "hydra.run.dir=whole") == 0
    whole = the_collective("whole")
    with monkeypatch.context() as patch:
        stop_at_save(patch, 2)
        assert command_line(patch, *GROWN, "checkpoint_seconds=1e-9", "hydra.run.dir=stopped") == 130
    assert command_line(monkeypatch, *GROWN, "hydra.run.dir=stopped") == 0
    stopped = the_collective("stopped")

    rates = [content(whole / f"member_{number:03d}")[0][0]["config"]["agent"]["learning_rate"] for number in range(2)]
    assert rates == [0.001, 0.1]
    assert len(RunLog.read(whole / "collective.jsonl").of_kind("help")) > 0
    for number in range(2):
        assert same(whole / f"member_{number:03d}", stopped / f"member_{number:03d}")
    assert (whole / "members.csv").read_bytes() == (stopped / "members.csv").read_bytes()


def test_a_setting_of_a_member_that_there_is_not_is_refused(monkeypatch, capsys, population):
    assert command_line(monkeypatch, *GROWN[:-2], "+exchange.key=agent.speed", GROWN[-1]) == 1

    assert (
        "the exchange gives member 0 agent.speed=0.001, and there is no setting agent.speed" in capsys.readouterr().err
    )


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (("exchange.num_members=0",), "exchange.num_members must be an integer >= 1, got 0"),
        (("exchange.drop_prob=2",), "exchange.drop_prob must be in [0, 1], got 2"),
        (("exchange.num_members=3",), "member 2 (curriculum.agent=3, seed=2000): agent must be in 0..2, got 3"),
        (("method=ewc",), "L2D2C needs masks, which 2 of 2 members lack; member 0 has EWC: take method=mask_ri"),
        (("method=mask_ri",), "1 of 2 members have another than member 0: set method.backbone_seed"),
        (("method.backbone_seed=-1",), "method.backbone_seed must be an integer in [0, 2**63) or null, got -1"),
        (("detector=oracle",), "do not name the same tasks for all: leave out detector or exchange"),
        (("together=true",), "together=true trains seeds as one batch, members of a collective learn in turn: leave"),
    ],
)
def test_a_collective_that_cannot_be_is_refused_in_one_line_and_leaves_nothing(monkeypatch, capsys, settings, message):
    given = [each for each in SHARING if not (settings[0].startswith("method=") and each.startswith("method"))]

    assert command_line(monkeypatch, *given, *settings) == 1

    assert message in capsys.readouterr().err
    assert not Path("runs").exists()


def made(folder: Path, exchange: str, returns, helps=(), **measured: float) -> None:
    """Write the directory of a collective by hand: for each member the mean returns of batches of 100 frames."""
    config = {
        part: {"_target_": f"a.{name}"} for part, name in (("agent", "A"), ("method", "M"), ("exchange", exchange))
    }
    members = [{"seed": 1000 * number, "curriculum": "c", "labels": ["x", "y"]} for number in range(len(returns))]
    for number, blocks in enumerate(returns):
        run_dir = folder / f"member_{number:03d}"
        run_dir.mkdir(parents=True)
        log, frames = RunLog(run_dir / "run.jsonl"), 0
        log.append("run", trained=[[1], [2]])
        for block, values in enumerate(blocks, 1):
            for value in values:
                frames += 100
                log.append("training", block=block, frames=frames, return_mean=value, **measured)
        log.close()
    log = RunLog(folder / "collective.jsonl")
    log.append("collective", config={**config, "seed": 3}, members=members)
    counts = {"sent": 6, "delivered": 3, "dropped": 1, "delayed": 2, "bytes": 96}
    log.append("exchange", round=0, frames=200, message="query", **counts)
    for sender, receiver in helps:
        log.append("help", round=0, block=1, frames=100, receiver=receiver, sender=sender, task_id=5)
    log.close()
    (folder / "metrics.json").write_text("{}")


NEVER = [0.0, 0.5, float("nan"), 0.3]


def test_a_batch_whose_return_is_large_by_noise_is_not_learned(tmp_path):
    made(tmp_path / "one", "E", [([1.5], [0.95])], success_rate=0.25)

    assert read_collective(tmp_path / "one").share_learned == 0


def test_learning_time_and_helpers_are_those_of_the_logs(tmp_path):
    made(tmp_path / "one", "E", [([0.0, 0.95, 1.0], NEVER), (NEVER, [0.9])], helps=[(0, 1), (0, 1), (1, 0)])

    found = read_collective(tmp_path / "one")

    assert [each.frames_to_learn for each in found.learned] == [200, None, None, 100]
    assert found.learning_time == (200 + 400 + 400 + 100) / 4
    assert found.share_learned == 0.5
    final = [1.95 / 3, 0.8 / 3, 0.8 / 3, 0.9]
    assert [each.final_return for each in found.learned] == pytest.approx(final)
    assert found.final_return == pytest.approx(sum(final) / 2)
    helps = [(row["sender"], row["receiver"]) for row in found.helps]
    assert sorted(helps) == [(0, 1), (0, 1), (1, 0)]
    assert {name: each.value for name, each in metrics(found).items() if name in ("messages", "bytes", "helps")} == {
        "messages": 6,
        "bytes": 96,
        "helps": 3,
    }


def table(name: str) -> list[dict[str, str]]:
    return list(csv.DictReader(Path(f"collectives/{name}.csv").read_text().splitlines()))


def test_the_page_on_collectives_has_a_row_and_a_map_for_each_and_tidy_tables(tmp_path, monkeypatch, capsys):
    made(tmp_path / "runs/one", "E", [([1.0], [1.0])])
    made(tmp_path / "runs/two", "E", [([1.0], [1.0]), ([1.0], NEVER)], helps=[(0, 1)])
    monkeypatch.setattr(sys, "argv", ["collectives", "runs"])

    collectives.main()

    assert capsys.readouterr().out == "report: collectives/collectives.md\n"
    page = Path("collectives/collectives.md").read_text()
    assert "| c | A | M | E | 2 | 3 | 175 | 0.75 |" in page
    assert "(figures/learning_time.png)" in page and "(figures/helps.png)" in page
    rows = table("collectives")
    assert [(row["num_members"], float(row["learning_time"]), row["helps"]) for row in rows] == [
        ("1", 100.0, "0"),
        ("2", 175.0, "1"),
    ]
    assert [(row["sender"], row["receiver"], row["task_id"]) for row in table("helps")] == [("0", "1", "5")]
    assert len(table("members")) == 2 + 4


def test_an_unfinished_collective_is_left_out_by_name(tmp_path, capsys):
    for name in ("one", "two"):
        made(tmp_path / name, "E", [([1.0], [1.0])])
    (tmp_path / "two" / "metrics.json").unlink()

    assert [each.path.name for each in find_collectives([tmp_path])] == ["one"]
    assert capsys.readouterr().err == f"left out: {tmp_path}/two is unfinished; the same command resumes it\n"
    with pytest.raises(ValueError, match=r"no collective in or below .*two is finished: run it to its end"):
        find_collectives([tmp_path / "two"])


def test_a_folder_without_collectives_is_refused(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["collectives", "."])

    with pytest.raises(SystemExit) as end:
        collectives.main()

    assert end.value.code == 2
    assert "no collective.jsonl in or below .: run one with exchange=l2d2c" in capsys.readouterr().err


def test_long_task_ids_are_warned_of_before_members_learn(capsys):
    learned = [curricula.load(name) for name in ("ct2_interfering", "ct28")]

    job._warn_of_long_ids(learned[:1])
    first = capsys.readouterr().err
    job._warn_of_long_ids(learned)

    assert first == ""
    assert "each observation of ct28 has a task id of 16,368 numbers" in capsys.readouterr().err
