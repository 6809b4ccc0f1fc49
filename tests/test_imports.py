"""Importing a module changes nothing of its program: not Hydra, torch, NumPy, Gymnasium, warnings or the rest."""

from __future__ import annotations

import subprocess
import sys

import pytest

DEPENDENCIES = (
    *(
        "gymnasium",
        "hydra._internal.core_plugins.basic_sweeper",
        "matplotlib.pyplot",
        "numpy",
        "rich.console",
        "scipy.stats",
    ),
    *("stable_baselines3", "tensordict", "torch", "torchrl.collectors", "torchrl.data", "torchrl.envs"),
    *("torchrl.modules", "torchrl.objectives", "torchrl.record"),
)
"""What our modules import, or some of it: what an import of these changes is theirs."""

PROGRAM = """
import importlib
import logging
import os
import pkgutil
import random
import signal
import sys
import warnings

for name in sys.argv[1:]:
    importlib.import_module(name)

import gymnasium
import numpy
import torch
from torch import multiprocessing as processes
from hydra.core.singleton import Singleton
from omegaconf.basecontainer import BaseContainer


def state():
    singletons = Singleton._instances.items()
    registered = {name: repr(spec) for name, spec in gymnasium.registry.items() if name not in ours}
    switches = (torch.are_deterministic_algorithms_enabled(), torch.is_grad_enabled(), torch.is_anomaly_enabled())
    backends = (torch.backends.cudnn.benchmark, torch.backends.cudnn.deterministic, torch.backends.mkldnn.enabled)
    return {
        "Hydra's objects": {kind: repr(vars(each)) for kind, each in singletons if kind.__name__ != "Plugins"},
        "Hydra's resolvers": dict(BaseContainer._resolvers),
        "torch's switches": (switches, backends, torch.get_float32_matmul_precision()),
        "torch's threads": (torch.get_num_threads(), torch.get_num_interop_threads()),
        "torch's processes": (processes.get_sharing_strategy(), processes.get_start_method(allow_none=True)),
        "torch's dtype": (torch.get_default_dtype(), repr(torch._tensor_str.PRINT_OPTS)),
        "torch's random numbers": torch.get_rng_state().tolist(),
        "NumPy's": (numpy.geterr(), numpy.get_printoptions(), repr(numpy.random.get_state())),
        "Gymnasium's": (registered, gymnasium.logger.min_level),
        "warnings'": (list(warnings.filters), warnings.showwarning, warnings.formatwarning),
        "Python's": (sys.path[:], sys.excepthook, sys.getrecursionlimit(), random.getstate(), dict(os.environ)),
        "signals'": [signal.getsignal(number) for number in signal.valid_signals()],
        "logging's": (logging.root.level, logging.root.handlers[:], logging.root.manager.disable),
    }


names = []
ours = set()
before = state()
for package in ("ctgraph_rl", "baselines", "curricula", "benchmarks", "hydra_plugins.ctgraph_rl_sweeper"):
    names.append(package)
    path = importlib.util.find_spec(package).submodule_search_locations
    names += [module.name for module in pkgutil.walk_packages(path, f"{package}.")]
for name in names:
    needs_jax = name == "benchmarks.jax_ppo"
    if name.endswith("__main__") or (needs_jax and importlib.util.find_spec("jax") is None):
        continue
    known = set(gymnasium.registry)
    importlib.import_module(name)
    ours |= set(gymnasium.registry) - known if name in ("ctgraph_rl.gym", "curricula.gym") else set()
    now = state()
    for kind, value in now.items():
        if value != before[kind]:
            print(f"importing {name} changes {kind} state")
    before = now
print(len(names), "modules")
"""


@pytest.mark.slow
def test_importing_a_module_changes_nothing_of_hydra_torch_numpy_gymnasium_and_warnings():
    command = [sys.executable, "-c", PROGRAM, *DEPENDENCIES]
    done = subprocess.run(command, capture_output=True, text=True)

    assert done.returncode == 0, done.stderr
    *changes, last = done.stdout.splitlines()
    assert changes == []
    assert int(last.split()[0]) > 250


FILES = """
import os
import runpy
import sys

import torch.optim.adam as steps

import baselines
import ctgraph_rl

ROOTS = tuple(os.path.dirname(package.__file__) for package in (ctgraph_rl, baselines))
ROOTS = (*ROOTS, os.path.join(os.path.dirname(ROOTS[1]), "curricula"))
found = set()


def count(frame, event, argument):
    code = frame.f_code
    is_function = code.co_flags & 1 and not code.co_name.endswith("comp>") and code.co_name != "<genexpr>"
    if event == "call" and is_function and code.co_filename.startswith(ROOTS):
        found.add(code.co_filename)


def stop(*arguments, **settings):
    sys.setprofile(None)
    print("files:", len(found), *sorted(found), flush=True)
    os._exit(0)


steps.adam = stop
sys.argv[0] = "run"
sys.setprofile(count)
runpy.run_module("ctgraph_rl.run", run_name="__main__", alter_sys=True)
"""
"""Prints the files in which a function runs before the first gradient step."""

MOST_FILES = 75


@pytest.mark.slow
def test_a_run_reaches_its_first_gradient_step_through_few_files(tmp_path):
    settings = ["curriculum=su_b1_4tasks", "curriculum.num_frames=2048", f"hydra.run.dir={tmp_path / 'run'}"]
    done = subprocess.run([sys.executable, "-c", FILES, *settings], capture_output=True, text=True, cwd=tmp_path)
    line = next((line for line in done.stdout.splitlines() if line.startswith("files:")), done.stderr)
    assert int(line.split()[1]) <= MOST_FILES, line
