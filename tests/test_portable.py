"""Portable runs: the command starts itself again, and its bits are those of any CPU with AVX2."""

from __future__ import annotations

import json
import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from helpers.kill_runs import equal, lines
from helpers.paths import CHECKOUT
from helpers.sweeping import command_line

from ctgraph_rl import portable, run
from ctgraph_rl.log.provenance import machine
from ctgraph_rl.portable import VARIABLES, Restart, become_portable
from ctgraph_rl.runs import config

pytestmark = pytest.mark.skipif(platform.machine() != "x86_64", reason="portable runs are for x86-64")

SHORT = ("curriculum.num_frames=512", "evaluation.num_episodes=4", "agent.num_envs=16", "agent.num_steps=8")

EMULATIONS = {
    "avx512": {"ATEN_CPU_CAPABILITY": "avx512", "MKL_ENABLE_INSTRUCTIONS": "AVX512", "ONEDNN_MAX_CPU_ISA": "ALL"},
    "avx2": {"ATEN_CPU_CAPABILITY": "avx2", "MKL_CBWR": "AVX2", "ONEDNN_MAX_CPU_ISA": "AVX2"},
    "old": {"ATEN_CPU_CAPABILITY": "default", "MKL_ENABLE_INSTRUCTIONS": "SSE4_2", "ONEDNN_MAX_CPU_ISA": "SSE41"},
    "no libm": {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX512F,-AVX512VL,-AVX512DQ"},
}
"""Variables by which a process takes the code of another CPU."""

del EMULATIONS["avx512" if torch.backends.cpu.get_cpu_capability() != "AVX512" else "avx2"]
"""AVX-512 is illegal on other CPUs, and with it AVX2 adds nothing: a portable run has its instructions."""

LEARNERS = [
    {"agent": "lstm_ppo"},
    {"agent": "dqn"},
    {"agent": "ppo_published", "agent.num_minibatches": 8},
    {"agent": "ppo", "method": "mask_lc", "protocol.task_id": "one_hot"},
]


@pytest.fixture
def prepared(monkeypatch):
    """Lets this process pass for a portable one."""
    for name, value in VARIABLES.items():
        monkeypatch.setenv(name, value)


def results(folder: Path, *arguments: str, **variables: str) -> tuple[dict, list[dict], dict]:
    """The first line of the log, all measurements and the weights of a run in a process with these variables."""
    folder.mkdir()
    command = [sys.executable, "-m", "ctgraph_rl.run", *SHORT, *arguments, "hydra.run.dir=out"]
    environment = {**os.environ, "PYTHONPATH": str(CHECKOUT), **variables}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    about, *measured = lines(folder / "out")
    return about, measured, torch.load(folder / "out" / "agent.pt", weights_only=True)


def test_a_portable_run_holds_torch_and_its_log_says_so(monkeypatch, tmp_path):
    held = []
    monkeypatch.setattr(portable, "_HELD", [])
    monkeypatch.setattr(portable, "_has_variables", lambda: True)
    monkeypatch.setattr(torch.backends.mkldnn, "set_flags", held.append)
    library = SimpleNamespace(impl=lambda name, *_: held.append(name))
    monkeypatch.setattr(torch.library, "Library", lambda *_: library)
    command = [*SHORT, "agent=reinforce", "curriculum=ct2_interfering", "portable=true"]

    assert command_line(monkeypatch, *command, f"hydra.run.dir={tmp_path}") == 0

    about = lines(tmp_path)[0]
    assert held == [False, "sqrt", "sqrt_"]
    assert about["machine"] == f"{platform.machine()} portable"
    assert about["config"]["portable"] is True and about["cpu"] == portable.cpu_model()


@pytest.mark.slow
def test_a_portable_run_says_so_whatever_variables_its_command_has(tmp_path):
    about, *_ = results(tmp_path / "run", "agent=a2c", "portable=true", **EMULATIONS["old"])

    assert about["machine"] == f"{platform.machine()} portable"
    assert about["config"]["portable"] is True and about["cpu"] == portable.cpu_model()


def results_of_all(folder: Path, setting: str, emulation: str, learners: list[dict]) -> dict[str, tuple]:
    """All measurements and the weights of each learner's run, by the run's name, from one process."""
    folder.mkdir()
    variants = json.dumps(learners).replace('"', "").replace(" ", "")
    command = [sys.executable, "-m", "ctgraph_rl.run", "-m", *SHORT, f"portable={setting}"]
    environment = {**os.environ, "PYTHONPATH": str(CHECKOUT), **EMULATIONS[emulation]}
    done = subprocess.run(
        [*command, f"hydra.sweeper.variants={variants}"], cwd=folder, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    found = {path.parent.name: path.parent for path in sorted(folder.rglob("agent.pt"))}
    assert len(found) == len(learners)
    return {name: (lines(run)[1:], torch.load(run / "agent.pt", weights_only=True)) for name, run in found.items()}


@pytest.mark.slow
def test_portable_runs_are_equal_under_the_instructions_of_other_cpus_and_ordinary_ones_are_not(tmp_path):
    def run_as(emulation, setting, learners=LEARNERS):
        return results_of_all(tmp_path / f"{emulation} {setting}", setting, emulation, learners)

    held = [run_as(emulation, "true") for emulation in EMULATIONS]
    ordinary = [run_as(emulation, "false", LEARNERS[:1]) for emulation in ("no libm", "old")]

    for name in held[0]:
        assert all(equal(each[name], held[0][name]) for each in held), name
    (one,), (other,) = (each.values() for each in ordinary)
    assert not equal(one, other)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("qemu-x86_64") is None, reason="QEMU emulates the CPU: Debian's package qemu-user")
@pytest.mark.parametrize("cpu", ["Haswell", "EPYC"])
def test_a_portable_run_is_equal_on_an_emulated_cpu(tmp_path, cpu):
    """The compiler sees this machine's CPU, so the kernel is left out, whose bits are those of the other engine."""
    arguments = ("agent=lstm_ppo", "portable=true", "curriculum.num_frames=128")
    _, here, weights = results(tmp_path / "here", *arguments, CC="none")
    command = [shutil.which("qemu-x86_64"), "-cpu", cpu, sys.executable, "-m", "ctgraph_rl.run", *SHORT, *arguments]
    environment = {**os.environ, **VARIABLES, "PYTHONPATH": str(CHECKOUT), "CC": "none"}

    subprocess.run([*command, f"hydra.run.dir={tmp_path}/there"], cwd=tmp_path, env=environment, check=True)

    assert lines(tmp_path / "there")[1:] == here
    assert equal(torch.load(tmp_path / "there" / "agent.pt", weights_only=True), weights)


@pytest.mark.slow
def test_processes_of_a_portable_sweep_are_portable(tmp_path, monkeypatch, console_script):
    sweep = ["ctgraph-rl", "-m", *SHORT, "agent=a2c", "seed=0,1", "portable=true", "hydra/launcher=joblib"]

    subprocess.run([*sweep, "hydra.launcher.n_jobs=2"], cwd=tmp_path, check=True, capture_output=True)

    firsts = [json.loads(path.read_text().splitlines()[0]) for path in tmp_path.rglob("run.jsonl")]
    assert [first["machine"] for first in firsts] == [f"{platform.machine()} portable"] * 2


def test_a_command_starts_again_as_it_was_given(monkeypatch):
    started = []
    monkeypatch.setattr(os, "execve", lambda *call: started.append(call))
    monkeypatch.setattr(sys, "argv", ["/bin/ctgraph-rl", "portable=true"])
    monkeypatch.setattr(sys, "orig_argv", ["python", "-X", "dev", *sys.argv])
    monkeypatch.setattr(run.hydra, "main", lambda **_: lambda job: become_portable)
    monkeypatch.delenv("HYDRA_FULL_ERROR")
    before = dict(os.environ)

    run.main()

    assert started == [
        (sys.executable, [sys.executable, "-X", "dev", "/bin/ctgraph-rl", "portable=true"], before | VARIABLES)
    ]


def test_a_portable_process_does_not_start_again(prepared, monkeypatch):
    become_portable()

    monkeypatch.setenv("MKL_CBWR", "AVX2")
    with pytest.raises(Restart):
        become_portable()


def test_in_a_process_of_another_command_a_portable_run_is_refused_with_the_variables(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)

    for sweep in ([], ["-m"]):
        assert command_line(monkeypatch, *sweep, *SHORT, "portable=true") == 1
        assert (
            "portable=true needs these variables before torch is imported: ATEN_CPU_CAPABILITY=avx2 MKL_CBWR=COMPA"
            in (capsys.readouterr().err)
        )
    assert not list(tmp_path.rglob("*.jsonl"))


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ["agent=ppo", "agent.compile=true"],
            "portable=true needs agent.compile=false: compiled code is",
        ),
        (["device=cuda"], "portable=true needs device=cpu, got cuda: bits depend on the kind of GPU"),
    ],
)
def test_what_has_bits_of_its_own_is_refused(compose, prepared, overrides, message):
    with pytest.raises(ValueError, match=message):
        config.check_values(compose("portable=true", *overrides))


def test_another_kind_of_cpu_is_refused(monkeypatch, prepared):
    monkeypatch.setattr(platform, "machine", lambda: "aarch64")

    assert machine()["machine"].startswith("aarch64 ") and "portable" not in machine()["machine"]
    with pytest.raises(ValueError, match=r"needs an x86-64 CPU with AVX2 and FMA, this one lacks avx2, fma"):
        become_portable()
