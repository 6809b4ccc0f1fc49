"""CT-graphs as batched TorchRL environments, with lifelong-learning curricula and metrics.

Names are imported when they are first used: torch and torchrl cost seconds.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from ctgraph_rl.packages import warn_of_shadows

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
    from ctgraph_rl.learn.exact import exact_success as exact_success
    from ctgraph_rl.learn.exact import exact_value as exact_value
    from ctgraph_rl.learn.lifelong import learn_curriculum as learn_curriculum
    from ctgraph_rl.log.run_log import RunLog as RunLog
    from ctgraph_rl.log.scores import scores as scores
    from ctgraph_rl.report.frame import results as results
    from ctgraph_rl.runs.job import make_agent as make_agent
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
    from ctgraph_rl.tasks.kinds.gym_task import GymTask as GymTask
    from ctgraph_rl.tasks.kinds.task_like import TaskLike as TaskLike
    from ctgraph_rl.tasks.observations import Observations as Observations
    from ctgraph_rl.tasks.protocol import Block as Block
    from ctgraph_rl.tasks.protocol import Evaluation as Evaluation
    from ctgraph_rl.tasks.protocol import Protocol as Protocol
    from ctgraph_rl.tasks.task import Task as Task

__version__ = "0.1.0"

_EXPORTS = {
    "agent": ("Agent",),
    "batch.rollout": ("Steps", "rollout"),
    "batch.rows": ("Rows",),
    "core.graph": ("CTGraph", "StateType"),
    "core.rewards": ("Gradient", "Needle", "ReferenceLinear"),
    "env": ("CTGraphEnv",),
    "learn.evaluate": ("evaluate",),
    "learn.exact": ("exact_success", "exact_value"),
    "learn.lifelong": ("learn_curriculum",),
    "log.run_log": ("RunLog",),
    "log.scores": ("scores",),
    "report.frame": ("results",),
    "runs.job": ("make_agent",),
    "runs.load": ("Trained", "load"),
    "runs.recorder": ("Recorder",),
    "tasks.curriculum": ("Curriculum",),
    "tasks.images": ("GroupedImages", "ImageFile", "OneHot", "PaperImages", "ReferenceImages", "ReferenceOneHot"),
    "tasks.kinds.gym_task": ("GymTask",),
    "tasks.kinds.task_like": ("TaskLike",),
    "tasks.observations": ("Observations",),
    "tasks.protocol": ("Block", "Evaluation", "Protocol"),
    "tasks.task": ("Task",),
}
_HOMES = {name: module for module, names in _EXPORTS.items() for name in names}

__all__ = [*_HOMES, "metrics"]


def __getattr__(name: str) -> object:
    if name == "metrics":
        return import_module("ctgraph_rl.metrics")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"ctgraph_rl.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])


warn_of_shadows()
