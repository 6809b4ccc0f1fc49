"""Baseline agents, one in each file; `parts` has what they share, `update` the gradient step and its executors.

They import `ctgraph_rl` and neither `curricula` nor Hydra; runs build them by the ``_target_`` of ``conf/agent``.
Modules that moved are also imported by their former names, see `MOVED`.
"""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec, spec_from_loader
from types import CodeType, ModuleType
from typing import Any

from ctgraph_rl.packages import speed_suite

MOVED = {
    "baselines.benchmark": "benchmarks.agents",
    "baselines.catalogue": "baselines.parts.catalogue",
    "baselines.distinct": "baselines.parts.distinct",
    "baselines.embedding": "baselines.parts.embedding",
    "baselines.hooks": "baselines.parts.hooks",
    "baselines.learner": "baselines.parts.learner",
    "baselines.methods.heads": "baselines.methods.parts.heads",
    "baselines.methods.importance": "baselines.methods.parts.importance",
    "baselines.methods.masks": "baselines.methods.parts.masks",
    "baselines.methods.selection": "baselines.methods.parts.selection",
    "baselines.methods.self_labelled": "baselines.methods.parts.self_labelled",
    "baselines.methods.weights": "baselines.methods.parts.weights",
    "baselines.networks": "baselines.parts.networks",
    "baselines.optimisers": "baselines.update.update",
    "baselines.policy_gradient": "baselines.parts.policy_gradient",
    "baselines.prioritized": "baselines.parts.prioritized",
    "baselines.q_learning": "baselines.parts.q_learning",
    "baselines.recurrent_q": "baselines.parts.recurrent_q",
    "baselines.stack": "baselines.update.stack",
    "baselines.together": "baselines.update.seeds",
    "baselines.transport": "baselines.parts.transport",
    "baselines.update.optimiser": "baselines.update.update",
}
"""Former names of modules, and where these are now."""


class FormerNames(MetaPathFinder, Loader):
    """Imports a module that moved by its former name: the same module, so that its classes are the same, too."""

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """Return a spec for a former name, and None for any other."""
        return spec_from_loader(fullname, self) if fullname in MOVED else None

    def exec_module(self, module: ModuleType) -> None:
        """Put the module that moved in the place of the empty one of its former name."""
        sys.modules[module.__name__] = _moved(module.__name__)

    def get_code(self, fullname: str) -> CodeType | None:
        """Return the code that ``python -m`` runs."""
        loader: Any = getattr(find_spec(_moved(fullname).__name__), "loader", None)
        return loader.get_code(MOVED[fullname])


def _moved(name: str) -> ModuleType:
    """Import a module by its former name."""
    package, _, module = MOVED[name].partition(".")
    return speed_suite(module) if package == "benchmarks" else import_module(MOVED[name])


sys.meta_path.append(FormerNames())
