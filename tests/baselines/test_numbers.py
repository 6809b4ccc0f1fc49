"""The numbers version of the package stands for the bits of every agent with every method."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys

import pytest
import torch
from helpers.paths import CHECKOUT, DATA

from ctgraph_rl.log.provenance import NUMBERS

FILE = DATA / f"numbers_{NUMBERS}.json"
HOW = "if that is meant, raise NUMBERS in ctgraph_rl/log/provenance.py and run python -m tests.baselines.pinned"


@pytest.mark.slow
@pytest.mark.skipif(platform.machine() != "x86_64", reason="portable runs are for x86-64")
def test_tiny_portable_runs_of_every_agent_with_every_method_have_the_bits_of_the_numbers_version():
    assert FILE.exists(), f"there are no digests of numbers version {NUMBERS}: {HOW}"
    stored = json.loads(FILE.read_text(encoding="utf-8"))
    if stored["torch"] != torch.__version__:
        pytest.skip(f"the digests are of torch {stored['torch']}, whose bits another version need not have")

    environment = {**os.environ, "PYTHONPATH": str(CHECKOUT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "tests.baselines.pinned", "--print"]
    done = subprocess.run(command, cwd=CHECKOUT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    present = json.loads(done.stdout.splitlines()[-1])["digests"]

    changed = sorted(
        name for name in {*present, *stored["digests"]} if present.get(name) != stored["digests"].get(name)
    )
    assert not changed, f"weights or measurements changed of {', '.join(changed)}: {HOW}"


def test_the_file_of_a_numbers_version_names_it_and_every_agent_learns_there():
    stored = json.loads(FILE.read_text(encoding="utf-8"))

    assert stored["numbers"] == NUMBERS
    agents = [path.stem for path in (CHECKOUT / "conf" / "agent").glob("*.yaml")]
    assert agents and not [name for name in agents if len(stored["digests"][f"{name} finetune"]) != 16]
