"""Settings of sweeps and their cells: which become choices, which are refused, and what a refusal leaves."""

from __future__ import annotations

import sys
from inspect import signature
from pathlib import Path

import pytest
import yaml
from helpers.sweeping import UNLUCKY, command_line, configs, sweep

from ctgraph_rl import run as run_module
from ctgraph_rl.learn import progress
from ctgraph_rl.packages import conf_dir
from ctgraph_rl.runs import session
from ctgraph_rl.runs.sweep import Sweeper, sweepable


@pytest.mark.parametrize("whole", ["method=l2,ewc method.coeff=3", "experiment=own"])
def test_a_setting_that_all_choices_of_a_swept_group_have_is_one_of_all_cells(whole, learned, monkeypatch, tmp_path):
    (tmp_path / "mine" / "experiment").mkdir(parents=True)
    own = "# @package _global_\nhydra:\n  sweeper:\n    params: {method: 'ewc,l2'}\n"
    (tmp_path / "mine" / "experiment" / "own.yaml").write_text(own)

    code = sweep(monkeypatch, "--config-dir", str(tmp_path / "mine"), "method.coeff=2.5", *whole.split(), "seed=0")

    coeffs = [config["method"]["coeff"] for config in configs(learned)]
    assert (code, coeffs) == (0, [3, 3] if "3" in whole else [2.5, 2.5])


def test_settings_of_a_variant_change_together(learned, monkeypatch, tmp_path, capsys):
    (tmp_path / "mine" / "experiment").mkdir(parents=True)
    variants = "[{agent.num_envs: 2, agent.num_steps: 3}, {agent.num_envs: 4, agent.num_steps: 1}, {agent.num_envs: 4}]"
    own = f"# @package _global_\nhydra:\n  sweeper:\n    params: {{seed: 'range(2)'}}\n    variants: {variants}\n"
    (tmp_path / "mine" / "experiment" / "own.yaml").write_text(own)
    chosen = ("--config-dir", str(tmp_path / "mine"), "experiment=own")

    code = sweep(monkeypatch, *chosen)

    found = [(each["agent"]["num_envs"], each["agent"]["num_steps"], each["seed"]) for each in configs(learned)]
    assert (code, found) == (0, [(2, 3, 0), (2, 3, 1), (4, 1, 0), (4, 1, 1), (4, 32, 0), (4, 32, 1)])
    assert command_line(monkeypatch, *chosen) == 1
    said = capsys.readouterr().err
    assert "is a sweep, seed=range(2) agent.num_envs=... agent.num_steps=...: add -m" in " ".join(said.split())


def test_many_cells_are_counted_while_they_are_composed(learned, monkeypatch, capsys):
    monkeypatch.setattr(progress, "QUICK", 0.0)
    monkeypatch.setattr(progress, "SECONDS_BETWEEN_LINES", 0.0)

    assert sweep(monkeypatch, "seed=range(2)") == 0

    assert "2/2 cells composed" in capsys.readouterr().err


def test_every_experiment_has_settings_that_the_sweeper_takes():
    taken = set(signature(Sweeper.__init__).parameters)

    given = {}
    for path in sorted(Path(conf_dir(), "experiment").glob("*.yaml")):
        settings = yaml.safe_load(path.read_text(encoding="utf-8"))
        given[path.stem] = set(settings.get("hydra", {}).get("sweeper", {}))

    assert len(given) > 20
    assert {name: keys - taken for name, keys in given.items() if keys - taken} == {}


def test_settings_of_groups_become_choices_of_one_where_that_reads_the_same():
    as_they_are = [
        "seed=3",
        "agent.gamma=null",
        "agent.optimiser='0.5'",
        "agent.optimiser='true'",
        r"agent.optimiser='it\'s (x)'",
        "agent.num_envs=range(1,3)",
        "agent.num_envs=1,2",
        "agent.num_envs=[1,",
        "other.num_envs=3",
    ]

    assert sweepable(["method.coeff=2.5", "method.heads='multi'", "agent.layers=[8, 8]", *as_they_are]) == [
        "method.coeff=choice(2.5)",
        "method.heads=choice('multi')",
        "agent.layers=choice([8, 8])",
        *as_they_are,
    ]


def test_a_setting_of_a_group_can_be_swept(learned, monkeypatch):
    code = sweep(monkeypatch, "agent.num_envs=range(1,3)", "seed=0")

    assert (code, [config["agent"]["num_envs"] for config in configs(learned)]) == (0, [1, 2])


def test_a_sweep_of_cells_needs_no_value_of_its_objective(learned, monkeypatch):
    code = sweep(monkeypatch, "seed=0", "objective=average_performance")  # which these cells lack

    assert (code, len(learned)) == (0, 1)


@pytest.mark.parametrize("seeds", ["[1,0]", "[0,0]", "[0,a]", "[]", "3"])
def test_a_list_of_seeds_begins_with_that_of_the_job(seeds, learned, monkeypatch, capsys):
    code = sweep(monkeypatch, "hydra/sweeper=basic", "seed=0", f"+seeds={seeds}")

    assert (code, learned) == (1, [])
    assert "seeds must be a list of different seeds that begins with seed=0, got " in capsys.readouterr().err


def test_a_pattern_chooses_files_of_a_group(learned, monkeypatch):
    chosen = ("agent=glob(dq*)", "method=glob([ew*,l*],exclude=*_published)", "curriculum=glob(fo_b1_4t*)")

    code = sweep(monkeypatch, *chosen)

    assert (code, [path.name.split("-seed")[0] for path in learned]) == (0, ["dqn-ewc", "dqn-l2"])
    assert {path.parent.name for path in learned} == {"fo_b1_4tasks"}


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["cell=glob(zz*)"], "cell=glob(zz*) matches none of amrl_avg, amrl_max, attention, "),
        (["seed=glob(1*)"], "seed=glob(1*): glob chooses files of a group, such as agent or method; seed has values"),
        (["method=glob(l2*)", "method.coef=1"], "with method=l2: unknown setting 'method.coef': did you mean"),
        (["agent=glob(d*qn)", "seed=0", "agent.burn_in=2"], "with agent=dqn: unknown setting 'agent.burn_in'"),
    ],
)
def test_a_pattern_without_a_good_match_is_refused_first(settings, message, learned, monkeypatch, capsys):
    code = sweep(monkeypatch, *settings)

    assert (code, learned) == (1, [])
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    "words", ["seed=0,1 -m", "agent=dqn --multirun seed=0,1", "seed=0,1 --config-dir . -m agent=dqn"]
)
def test_options_may_follow_settings(words, learned, monkeypatch):
    code = command_line(monkeypatch, *words.split())

    assert (code, [config["seed"] for config in configs(learned)]) == (0, [0, 1])


def test_null_is_a_setting_of_a_swept_group(learned, monkeypatch):
    code = sweep(monkeypatch, "curriculum=ct20,ct28_mosaic_skips_d5", "++curriculum.agent=null", "seed=0")

    assert (code, [config["curriculum"]["agent"] for config in configs(learned)]) == (0, [None, None])


def test_a_setting_that_one_choice_of_a_swept_group_lacks_is_refused_before_anything_runs(learned, monkeypatch, capsys):
    code = sweep(monkeypatch, "method=ewc,finetune", "method.coeff=2.5")

    assert (code, learned) == (1, [])
    assert "method.coeff" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            ["experiment=masks_ct8"],
            ",mask_lc,ewc_published,mask_ri,mask_blc seed=range(10): add -m",
        ),
        (["experiment=masks_ct8", "method=ewc"], "is a sweep, seed=range(10): add -m"),
        (["hydra.sweeper.status=true"], "hydra.sweeper.status=true lists a sweep's cells: add -m"),
    ],
)
def test_a_sweep_without_m_is_refused(settings, message, learned, monkeypatch, capsys):
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    monkeypatch.setattr(sys, "argv", ["ctgraph-rl", *settings])

    with pytest.raises(SystemExit):
        run_module.main()

    assert message in capsys.readouterr().err
    assert learned == [] and not list(Path().rglob("run.jsonl"))


@pytest.mark.parametrize("prefix", ["", "++"])
def test_one_cell_of_an_experiment_needs_no_m(learned, monkeypatch, prefix):
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    words = ["ctgraph-rl", "experiment=masks_ct8", "method=ewc", f"{prefix}seed=3", "together=false"]
    monkeypatch.setattr(sys, "argv", words)
    monkeypatch.setattr("ctgraph_rl.runner.show", lambda *_: None)

    run_module.main()

    assert [path.name.split("-")[:3] for path in learned] == [["ppo_published", "ewc", "seed3"]]


BAD = ("resume=foo", "checkpoint_seconds=-1", "overwrite=0", "overwrite=maybe", "report=ye", "num_threads=0")


def test_a_bad_value_is_refused_by_a_run_that_is_finished_too(learned, monkeypatch, capsys):
    sweep(monkeypatch, "seed=0")
    (done,) = learned
    before = sorted(done.iterdir())

    for setting in BAD:
        assert command_line(monkeypatch, "seed=0", f"hydra.run.dir={done}", setting) == 1

        assert f"error: {setting.partition('=')[0]} must be " in capsys.readouterr().err
        assert sorted(done.iterdir()) == before


def test_a_bad_value_marks_no_run_of_a_sweep_and_no_run_alone(learned, monkeypatch):
    sweep(monkeypatch, "seed=0")
    codes = [sweep(monkeypatch, "seed=0", "overwrite=true", "resume=foo")]
    (cell,) = learned
    marks = [(cell / "failed.txt").exists()]
    (cell / "metrics.json").unlink()
    monkeypatch.setattr(sys, "argv", ["ctgraph-rl", "seed=0", f"hydra.run.dir={cell}", "resume=foo"])
    with pytest.raises(ValueError, match="resume must be"):
        run_module.main()
    marks.append((cell / "failed.txt").exists())
    codes.append(sweep(monkeypatch, "seed=0", "resume=foo"))
    marks.append((cell / "failed.txt").exists())

    assert codes == [1, 1] and marks == [False, False, False]


def test_a_cell_that_cannot_be_started_again_stays_failed(learned, monkeypatch, capsys):
    sweep(monkeypatch, f"seed={UNLUCKY}")
    (learned[0] / "run.jsonl").write_text("{broken\n{}\n")
    sweep(monkeypatch, f"seed={UNLUCKY}")
    capsys.readouterr()

    sweep(monkeypatch, f"seed={UNLUCKY}", "hydra.sweeper.status=true")

    assert "holds run.jsonl, which are of no run" in (learned[0] / "failed.txt").read_text()
    assert "sweep of 1 cells: 0 done, 1 failed, 0 in use, 0 missing" in capsys.readouterr().out


def test_a_mark_stays_where_a_run_alone_is_refused_again(monkeypatch, tmp_path):
    (tmp_path / "failed.txt").write_text("ValueError: before\n")

    with pytest.raises(ValueError), session.mark_failure(tmp_path):
        raise ValueError("again")
    assert (tmp_path / "failed.txt").read_text() == "ValueError: again\n"
    with session.mark_failure(tmp_path):
        pass

    assert not (tmp_path / "failed.txt").exists()
