"""CT-graphs as batched TorchRL environments, with lifelong-learning curricula and metrics.

Names are imported when they are first used: torch and torchrl cost seconds.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ctgraph_rl import metrics as metrics
    from ctgraph_rl.agent import Agent as Agent
    from ctgraph_rl.curriculum import Block as Block
    from ctgraph_rl.curriculum import Curriculum as Curriculum
    from ctgraph_rl.curriculum import Evaluation as Evaluation
    from ctgraph_rl.curriculum import Protocol as Protocol
    from ctgraph_rl.env import CTGraphEnv as CTGraphEnv
    from ctgraph_rl.fast import Steps as Steps
    from ctgraph_rl.fast import rollout as rollout
    from ctgraph_rl.graph import CTGraph as CTGraph
    from ctgraph_rl.graph import StateType as StateType
    from ctgraph_rl.images import GroupedImages as GroupedImages
    from ctgraph_rl.images import ImageFile as ImageFile
    from ctgraph_rl.images import OneHot as OneHot
    from ctgraph_rl.images import PaperImages as PaperImages
    from ctgraph_rl.images import count_repeats as count_repeats
    from ctgraph_rl.images import distances as distances
    from ctgraph_rl.lifelong import evaluate as evaluate
    from ctgraph_rl.lifelong import learn_curriculum as learn_curriculum
    from ctgraph_rl.log import RunLog as RunLog
    from ctgraph_rl.observations import Observations as Observations
    from ctgraph_rl.recorder import Recorder as Recorder
    from ctgraph_rl.reference import ReferenceImages as ReferenceImages
    from ctgraph_rl.reference import ReferenceOneHot as ReferenceOneHot
    from ctgraph_rl.rewards import Gradient as Gradient
    from ctgraph_rl.rewards import Needle as Needle
    from ctgraph_rl.rewards import ReferenceLinear as ReferenceLinear
    from ctgraph_rl.rows import Rows as Rows
    from ctgraph_rl.task import Task as Task
    from ctgraph_rl.trained import Trained as Trained
    from ctgraph_rl.trained import load as load

__version__ = "0.1.0"

_HOMES = {
    "Agent": "agent",
    "Block": "curriculum",
    "CTGraph": "graph",
    "CTGraphEnv": "env",
    "Curriculum": "curriculum",
    "Evaluation": "curriculum",
    "GroupedImages": "images",
    "ImageFile": "images",
    "Gradient": "rewards",
    "Needle": "rewards",
    "Recorder": "recorder",
    "ReferenceImages": "reference",
    "ReferenceLinear": "rewards",
    "ReferenceOneHot": "reference",
    "Observations": "observations",
    "OneHot": "images",
    "PaperImages": "images",
    "Protocol": "curriculum",
    "Rows": "rows",
    "RunLog": "log",
    "StateType": "graph",
    "Steps": "fast",
    "Task": "task",
    "Trained": "trained",
    "count_repeats": "images",
    "distances": "images",
    "evaluate": "lifelong",
    "learn_curriculum": "lifelong",
    "load": "trained",
    "rollout": "fast",
}

__all__ = [*_HOMES, "metrics"]


def __getattr__(name: str) -> object:
    if name == "metrics":
        return import_module("ctgraph_rl.metrics")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"ctgraph_rl.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
