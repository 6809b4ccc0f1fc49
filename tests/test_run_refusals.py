"""What a run refuses and what stops it: one message, an exit code, and no half results."""

from __future__ import annotations

import errno
import os
import re
import warnings
from pathlib import Path

import pytest
from helpers.sweeping import command_line, files_in

from ctgraph_rl import Block, Curriculum
from ctgraph_rl.log.files import locked
from ctgraph_rl.run import run
from ctgraph_rl.runs.config import composed, target
from curricula.paper import ct_su_b1

SHORT = ("curriculum.num_frames=1024", "agent.num_envs=64", "agent.num_steps=8", "agent.hidden_size=8")


REFUSED = [
    (
        ["curriculum=su_b2"],
        ["error: unknown curriculum 'su_b2': ctgraph-rl curricula lists those with names, and axes and graph make"],
    ),
    (
        ["agent=sarsa"],
        ["error: unknown agent 'sarsa': choices: a2c, cavia, dqn, drqn, lstm_ppo, maml, mohqa, pearl, "],
    ),
    (["cell=gr"], ["error: unknown cell 'gr': did you mean 'gru'?\n"]),
    (["cell=gru", "agent=dqn"], ["agent has no cell: it has no memory; use agent=lstm_ppo, rl2, drqn or qrdqn_lstm"]),
    (["cell=gru", "agent.cell.reads_acton=true"], ["unknown setting 'agent.cell.reads_acton'", "reads_action"]),
    (["cell=frames", "agent.cell.num_frames=1"], ["num_frames must be an integer >= 2, got 1: one frame is cell=none"]),
    (["cell=amrl_max", "agent.hidden_size=5"], ["agent.hidden_size must be even", "got 5: use 6"]),
    (["cell=lstm", "agent=rl2", "agent.cell.reads_action=true"], ["RL2 reads its last action and reward itself"]),
    (["agent.hidden=8"], ["error: unknown setting 'agent.hidden': did you mean 'agent.hidden_size'?\n"]),
    (["+agent.foo=1"], ["agent has no foo", "choices: ", "hidden_size"]),
    (["+curriculum.foo=1"], ["curriculum has no foo: choices: curriculum.num_frames, curriculum.image_seed"]),
    (["seed=-1"], ["seed must be an integer in [0, 2**63), got -1"]),
    (["seed=abc"], ["seed must be an integer in [0, 2**63), got 'abc'"]),
    (["device=bogus"], ["device must be one of cpu", "got 'bogus'"]),
    (["num_threads=0"], ["num_threads must be in 1.."]),
    (["log_units=3"], ["error: log_units must be true, false, batch or null, got 3\n"]),
    (["overwrite=1"], ["overwrite must be true, false or stale, got 1"]),
    (
        ["curriculum.num_frames=1000"],
        ["curriculum.num_frames=1000 of block 1, 2, 3, 4 must be a multiple of agent.num_envs=64", "960 or 1024"],
    ),
    (["curriculum.num_frames=0"], ["error: curriculum.num_frames must be an integer >= 1, got 0\n"]),
    (["agent.gamma=2"], ["error: agent.gamma must be in [0, 1], got 2\n"]),
    (["agent._target_=torch.nn.Module"], ["agent has no"]),
    (["experts_dir=null"], ["experts_dir must be the path of a folder, got None"]),
    (["evaluation=null"], ["evaluation must have keys, such as evaluation.every=5120, got None"]),
    (
        ["evaluation.exact=true", "evaluation.num_episodes=5"],
        ["error: evaluation.exact=true plays no episodes, got evaluation.num_episodes=5: leave it out\n"],
    ),
    (
        ["protocol.task_id=shown"],
        ["error: protocol.task_id must be one of hidden, one_hot, at_boundaries, got 'shown'\n"],
    ),
    (["agent.hidden_size=wide"], ["error: agent.hidden_size must be an integer >= 1, got 'wide'\n"]),
    (["curriculum=axes", "curriculum.depth=0"], ["error: curriculum.depth must be an integer"]),
    (["hydra/launcher=joblib"], ["error: hydra/launcher=joblib runs the cells of a sweep: add -m, or leave it out\n"]),
    (["objective=average_performanse"], ["objective must be a metric, got", "did you mean 'average_performance'?"]),
    (["objective=[forgetting]"], ["objective must be a metric, got ['forgetting']: "]),
    (["objective=xyz"], ["objective must be a metric, got 'xyz': choices: ", ", average_performance, "]),
    (["objective=forward_transfer_from_experts"], ["compares with single-task experts: add experts=true"]),
    (
        ["objective=online_return", "objective_until=1.5"],
        ["error: objective_until must be a share of the frames in (0, 1], such as 0.1, got 1.5\n"],
    ),
    (
        ["protocol.episodes=hidden", "agent=mohqa"],
        ["error: MOHQA needs the ends of episodes, which are hidden: set protocol.episodes=shown\n"],
    ),
    (
        ["curriculum=stream", "protocol.boundaries=hidden", "detector=swoks", "method=mask_ri"],
        ["error: SWOKS labels all tasks of a curriculum, which a stream draws one by one: take Stream.first(n), or "],
    ),
    (["protocol.episodes=none"], ["error: protocol.episodes must be one of shown, hidden, got 'none'\n"]),
    (["freeze_after=0"], ["error: freeze_after must be a share of the frames in (0, 1], such as 0.1, got 0\n"]),
    (["freeze_after=true"], ["freeze_after must be a share of the frames in (0, 1], such as 0.1, got True\n"]),
    (["objective_until=0.5"], ["error: objective_until=0.5 needs a metric, such as objective=online_return\n"]),
    (
        ["objective=forgetting", "objective_until=0.5"],
        ["objective=forgetting must be a metric of training with objective_until=0.5: ", "online_return"],
    ),
    (
        ["objective=online_return", "objective_until=0.5", "experts=true"],
        ["objective_until=0.5 compares with no experts: set experts=false\n"],
    ),
    (["exchange=l2d2c", "freeze_after=0.5"], ["freeze_after=0.5 is of a learner by itself: leave out freeze_after"]),
    (["seed=range(2)"], ["error: seed has several values: add -m to run each\n"]),
    (["agent=glob(dq*)"], ["error: agent has several values: add -m to run each\n"]),
    (
        ["~curriculum.num_frames", "~curriculum.image_seed", "curriculum._target_=os.remove", "+curriculum.path=a"],
        ["error: Target 'os.remove'"],
    ),
    (
        ["seed=${oc.env:NOT_SET}"],
        [
            "error: seed=${oc.env:NOT_SET}: Environment variable 'NOT_SET' not found; set it",
            "${oc.env:NOT_SET,VALUE}\n",
        ],
    ),
    (
        ["agent=${oc.env:NOT_SET}"],
        ["error: agent=${oc.env:NOT_SET}: Environment variable 'NOT_SET' not found; set it, or write what"],
    ),
    (["together=${nope:1}"], ["error: together=${nope:1}: there is no resolver nope; write the value itself\n"]),
    (["agent.gamma=${nokey}"], ["error: agent.gamma=${nokey}: Interpolation key 'nokey' not found; write the value"]),
    (["seed=???"], ["error: seed=??? has no value: ??? stands for one that must be given; give it, or leave seed out"]),
    (["agent.gamma=???"], ["error: agent.gamma=??? has no value"]),
    (["hydra.run.dir=???"], ["error: hydra.run.dir=??? has no value"]),
    (["hydra.run.dir=${nope:1}"], ["error: hydra.run.dir=${nope:1}: there is no resolver nope"]),
    (["agent=???"], ["error: agent=??? names no file: name one, such as agent=NAME, or leave agent out\n"]),
    (["~seed"], ["error: ~seed removes seed, which every run needs: leave ~seed out\n"]),
    (["~method"], ["error: ~method removes method, which every run needs: leave ~method out\n"]),
    (["~agent"], ["error: ~agent removes agent, which every run needs: leave ~agent out\n"]),
    (["~seed=1"], ["error: ~seed=1 removes seed only where it is 1, and it is 0: leave ~seed=1 out\n"]),
    (["~objective"], ["error: ~objective removes ", ": leave ~objective out\n"]),  # Hydra 1.3 and 1.4 differ on null
    (["~agent=1"], ["error: ~agent=1 removes a group by a value that no file of it has: leave ~agent=1 out\n"]),
    (["seed="], ["seed must be an integer in [0, 2**63), got ''"]),
]


@pytest.mark.parametrize(("overrides", "said"), REFUSED, ids=[" ".join(overrides) for overrides, _ in REFUSED])
def test_a_wrong_value_is_one_message_and_exit_code_1_and_leaves_no_file_and_no_folder(
    monkeypatch, capsys, tmp_path, overrides, said
):
    monkeypatch.chdir(tmp_path)

    code = command_line(monkeypatch, *SHORT, *overrides)

    error = capsys.readouterr().err
    assert code == 1
    assert all(part in error for part in said), error
    assert "Traceback" not in error and "Error executing job" not in error
    assert error.count("\n") <= 5
    assert list(tmp_path.iterdir()) == []


def test_an_argument_that_is_missing_is_one_message(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)

    code = command_line(monkeypatch, *SHORT, "~agent.gamma")

    error = capsys.readouterr().err
    assert code == 1
    assert "gamma" in error and "Traceback" not in error


def test_hydra_warns_of_nothing_where_a_group_is_built(compose):
    cfg = compose(*SHORT)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        built = [target(composed(SHORT), "agent"), target(cfg, "curriculum")()]

    assert built[1].name == "su_b1_4tasks"


def three_tasks_at_once() -> Curriculum:
    return Curriculum("own", 1, "here", [Block((ct_su_b1((1, 1)), ct_su_b1((2, 2)), ct_su_b1((1, 2))), 1024)])


def test_tasks_that_cannot_share_the_rows_leave_no_results(compose, tmp_path):
    cfg = compose(*SHORT, "~curriculum.num_frames", "~curriculum.image_seed")
    cfg.curriculum._target_ = f"{__name__}.three_tasks_at_once"

    with pytest.raises(ValueError, match="num_envs=64 must be a multiple of the block's 3 tasks"):
        run(cfg, tmp_path)

    assert files_in(tmp_path) == set()


def test_a_directory_that_another_process_writes_exits_with_75(monkeypatch, capsys, tmp_path):
    with locked(tmp_path):
        code = command_line(monkeypatch, *SHORT, f"hydra.run.dir={tmp_path}")

    assert code == 75
    assert f"error: {tmp_path} is in use by process {os.getpid()} on " in capsys.readouterr().err


def test_a_loss_that_is_not_finite_stops_the_run_and_names_block_and_loss(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)

    code = command_line(monkeypatch, *SHORT, "agent.learning_rate=1e38")

    error = capsys.readouterr().err
    assert code == 1
    (said,) = re.findall(r"error: (\w+ is nan in block 1 after 512 frames; the run stops here)", error)
    (mark,) = tmp_path.rglob("failed.txt")
    assert mark.read_text() == f"FloatingPointError: {said}\n" and "Traceback" not in error


def test_a_full_disk_is_one_message_with_sizes_after_the_first_update(monkeypatch, capsys, tmp_path):
    def full(number):
        if os.readlink(f"/proc/self/fd/{number}").endswith("run.jsonl"):
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.chdir(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr("ctgraph_rl.disk.os.fsync", full)
        code = command_line(monkeypatch, *SHORT, "hydra.run.dir=out")

    error = capsys.readouterr().err
    assert code == 1
    assert re.search(
        r"No space left on device: cannot write 0\.0 MB to .*(curriculum\.json|run\.jsonl), [\d.]+ MB are free\n", error
    )
    assert "No space left on device: cannot write" in Path("out/failed.txt").read_text()
