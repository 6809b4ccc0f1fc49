"""CT-graphs as batched TorchRL environments, with lifelong-learning curricula and metrics.

Names are imported when they are first used: torch and torchrl cost seconds.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ctgraph_rl import metrics as metrics
    from ctgraph_rl.agent import Agent as Agent
    from ctgraph_rl.batch.rollout import Steps as Steps
    from ctgraph_rl.batch.rollout import rollout as rollout
    from ctgraph_rl.batch.rows import Rows as Rows
    from ctgraph_rl.core.graph import CTGraph as CTGraph
    from ctgraph_rl.core.graph import StateType as StateType
    from ctgraph_rl.core.rewards import Gradient as Gradient
    from ctgraph_rl.core.rewards import Needle as Needle
    from ctgraph_rl.core.rewards import ReferenceLinear as ReferenceLinear
    from ctgraph_rl.env import CTGraphEnv as CTGraphEnv
    from ctgraph_rl.learn.evaluate import evaluate as evaluate
    from ctgraph_rl.learn.lifelong import learn_curriculum as learn_curriculum
    from ctgraph_rl.log.run_log import RunLog as RunLog
    from ctgraph_rl.runs.load import Trained as Trained
    from ctgraph_rl.runs.load import load as load
    from ctgraph_rl.runs.recorder import Recorder as Recorder
    from ctgraph_rl.tasks.curriculum import Curriculum as Curriculum
    from ctgraph_rl.tasks.images import GroupedImages as GroupedImages
    from ctgraph_rl.tasks.images import ImageFile as ImageFile
    from ctgraph_rl.tasks.images import OneHot as OneHot
    from ctgraph_rl.tasks.images import PaperImages as PaperImages
    from ctgraph_rl.tasks.images import ReferenceImages as ReferenceImages
    from ctgraph_rl.tasks.images import ReferenceOneHot as ReferenceOneHot
    from ctgraph_rl.tasks.images import count_repeats as count_repeats
    from ctgraph_rl.tasks.images import distances as distances
    from ctgraph_rl.tasks.observations import Observations as Observations
    from ctgraph_rl.tasks.protocol import Block as Block
    from ctgraph_rl.tasks.protocol import Evaluation as Evaluation
    from ctgraph_rl.tasks.protocol import Protocol as Protocol
    from ctgraph_rl.tasks.task import Task as Task

__version__ = "0.1.0"

_HOMES = {
    "Agent": "agent",
    "Block": "tasks.protocol",
    "CTGraph": "core.graph",
    "CTGraphEnv": "env",
    "Curriculum": "tasks.curriculum",
    "Evaluation": "tasks.protocol",
    "GroupedImages": "tasks.images",
    "ImageFile": "tasks.images",
    "Gradient": "core.rewards",
    "Needle": "core.rewards",
    "Recorder": "runs.recorder",
    "ReferenceImages": "tasks.images",
    "ReferenceLinear": "core.rewards",
    "ReferenceOneHot": "tasks.images",
    "Observations": "tasks.observations",
    "OneHot": "tasks.images",
    "PaperImages": "tasks.images",
    "Protocol": "tasks.protocol",
    "Rows": "batch.rows",
    "RunLog": "log.run_log",
    "StateType": "core.graph",
    "Steps": "batch.rollout",
    "Task": "tasks.task",
    "Trained": "runs.load",
    "count_repeats": "tasks.images",
    "distances": "tasks.images",
    "evaluate": "learn.evaluate",
    "learn_curriculum": "learn.lifelong",
    "load": "runs.load",
    "rollout": "batch.rollout",
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
