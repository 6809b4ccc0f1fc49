"""What a newcomer types that is almost right, and what is answered: one line."""

from __future__ import annotations

import pytest
from helpers.sweeping import command_line, configs, sweep

from ctgraph_rl.runs.settings import as_typed, in_digits


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("agent=PPO", "unknown agent 'PPO': did you mean 'ppo'?"),
        ("method=Ewc", "unknown method 'Ewc': did you mean 'ewc'?"),
        ("curriculum=su-b1-4tasks", "unknown curriculum 'su-b1-4tasks': did you mean 'su_b1_4tasks'?"),
        ("hydra/launcher=jobli", "unknown hydra/launcher 'jobli': did you mean 'joblib'?"),
        ("agnt=ppo", "unknown setting 'agnt': did you mean 'agent'?"),
        ("loger=csv", "unknown setting 'loger': did you mean 'logger'?"),
        ("agent.lr=1", "unknown setting 'agent.lr': did you mean 'agent.learning_rate'?"),
        ("lr=1", "unknown setting 'lr': did you mean 'agent.learning_rate'?"),
        ("num_frames=1000", "unknown setting 'num_frames': did you mean 'curriculum.num_frames'?"),
        (
            "curriculum.xyz=1",
            "unknown setting 'curriculum.xyz': choices: curriculum.num_frames, curriculum.image_seed",
        ),
        (
            "agent=ppo,dqn",
            "agent=ppo,dqn has several values: add -m to run each; a list is written in brackets, a text in quotes",
        ),
        ("+agent=ppo", "agent has a value: write agent=ppo"),
        ("agent=[a", "cannot read 'agent=[a': quote a value with brackets, commas or spaces"),
        ("seed=1 report", "cannot read 'report': settings are written as in seed=1"),
        (
            "-m method=finetune,ewc method.coeff=1,2",
            "with method=finetune: unknown setting 'method.coeff': choices: method.trunk",
        ),
    ],
)
def test_a_typo_is_answered_in_one_line(monkeypatch, capsys, tmp_path, words, said):
    monkeypatch.chdir(tmp_path)

    code = command_line(monkeypatch, *words.split())

    assert (code, *capsys.readouterr()) == (1, "", f"error: {said}\n")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("words", [["--seed=3"], ["--seed", "3"], ["agent=ppo", "--learning-rate", "1"]])
def test_a_setting_with_dashes_is_answered_with_how_it_is_written(monkeypatch, capsys, words):
    code = command_line(monkeypatch, *words)

    (said,) = capsys.readouterr().err.splitlines()
    name = "seed" if "seed" in words[0] else "learning_rate"
    assert code == 2
    assert said.endswith(f": a setting is written without dashes, {name}=VALUE; ctgraph-rl --help names the options")


def test_a_file_where_a_run_needs_a_folder_is_named(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "graph.json").touch()

    code = command_line(monkeypatch, "agent=ppo", "hydra.run.dir=graph.json")

    said = "error: graph.json is a file, and a run needs a folder: give another hydra.run.dir\n"
    assert (code, capsys.readouterr().err) == (1, said)


def test_folders_that_hold_something_or_are_elsewhere_stay(monkeypatch, tmp_path):
    (tmp_path / "here" / "runs").mkdir(parents=True)
    (tmp_path / "here" / "runs" / "note.txt").touch()
    (tmp_path / "there").mkdir()
    monkeypatch.chdir(tmp_path / "here")

    assert command_line(monkeypatch, "seed=-1") == 1
    assert command_line(monkeypatch, "seed=-1", f"hydra.run.dir={tmp_path / 'there' / 'run'}") == 1

    left = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")}
    assert left == {"here", "here/runs", "here/runs/note.txt", "there"}


@pytest.mark.parametrize(
    ("given", "written"),
    [
        ("curriculum.num_frames=1e5", "curriculum.num_frames=100000"),
        ("curriculum.num_frames=1.5E+3,2e3", "curriculum.num_frames=1500,2000"),
        ("evaluation.every=1e4", "evaluation.every=10000"),
        ("agent.buffer_size=choice(1e4,2e4)", "agent.buffer_size=choice(10000,20000)"),
        ("checkpoint_seconds=1e3", "checkpoint_seconds=1000"),
        *(
            (same, same)
            for same in ("agent.learning_rate=1e0", "curriculum.num_frames=1.23e1", "agent.own=1e3", "seed=1")
        ),
        *((same, same) for same in ("method.coeff=1e3", "hydra.run.dir=1e3", "curriculum.num_frames=1e-1")),
    ],
)
def test_whole_numbers_are_written_in_digits_where_a_setting_has_no_fractions(given, written):
    assert in_digits([given]) == [written]


def test_a_run_takes_frames_with_an_exponent(monkeypatch, learned):
    assert sweep(monkeypatch, "curriculum.num_frames=1e3,2.048e3") == 0

    assert [config["curriculum"]["num_frames"] for config in configs(learned)] == [1000, 2048]


SETTINGS = {
    "seed": 0,
    "curriculum": {"depth": 2, "seed": 0, "num_frames": 8, "one_hot": True},
    "agent": {"num_envs": 4, "gamma": 0.9, "sizes": 1},
    "evaluation": {"tasks": None},
}


@pytest.mark.parametrize(
    ("message", "typed", "said"),
    [
        ("depth must be >= 1", [], "curriculum.depth must be >= 1"),
        ("a; gamma must be in [0, 1]", [], "a; agent.gamma must be in [0, 1]"),
        (
            "num_frames=7 must be a multiple of num_envs=4",
            [],
            "curriculum.num_frames=7 must be a multiple of agent.num_envs=4",
        ),
        ("seed must be an integer", [], "seed must be an integer"),
        ("seed must be an integer", ["curriculum.seed"], "curriculum.seed must be an integer"),
        ("seed must be an integer", ["curriculum.seed", "seed"], "seed must be an integer"),
        ("all tasks must differ in depth", [], "all tasks must differ in depth"),
        ("set task_id=one_hot or hidden", [], "set task_id=one_hot or hidden"),
        ("make(num_envs=4) and curriculum.num_frames", [], "make(num_envs=4) and curriculum.num_frames"),
    ],
)
def test_a_message_names_settings_as_they_are_typed(message, typed, said):
    assert as_typed(message, SETTINGS, typed) == said
