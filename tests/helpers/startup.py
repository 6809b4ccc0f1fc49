"""The processor time of a run until its first step, beside that of the bare imports."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from baselines.ppo import PPO
from helpers.paths import CHECKOUT

BARE = ("-c", "import os, torch, torchrl; os._exit(0)")
RUN = ("-m", "ctgraph_rl.run", "agent=ppo", "curriculum=ct2_interfering", f"agent._target_={__name__}.UntilFirstStep")


class UntilFirstStep(PPO):
    """An agent that ends the process when it is asked for its first actions."""

    def __init__(self, *specs: Any, **settings: Any) -> None:
        super().__init__(*specs, **settings)
        self.policy.register_forward_pre_hook(lambda *_: os._exit(0))


def seconds(arguments: Sequence[str]) -> float:
    """Return the processor time of a Python process with these arguments, in an empty directory."""
    before = _processor_time()
    with TemporaryDirectory() as folder:
        path = os.pathsep.join([str(CHECKOUT), str(Path(__file__).parents[1])])
        subprocess.run([sys.executable, *arguments], cwd=folder, check=True, env={**os.environ, "PYTHONPATH": path})
    return _processor_time() - before


def _processor_time() -> float:
    """Return the seconds of all processes that this one has waited for."""
    times = os.times()
    return times.children_user + times.children_system
