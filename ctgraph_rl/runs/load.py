"""A run's trained agent, from its directory; no code of the directory is run."""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase

from ctgraph_rl.agent import Agent, MethodLike
from ctgraph_rl.checks import NamedValues, ReadOnlyValues, as_path, is_int, require
from ctgraph_rl.core.device import checked_device
from ctgraph_rl.learn.evaluate import task_policies
from ctgraph_rl.log.escape import terminal_text
from ctgraph_rl.log.files import AGENT, CHECKPOINTS, CURRICULUM, LOG, no_run
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.log.saved import read_content, read_plain, require_records
from ctgraph_rl.packages import class_named
from ctgraph_rl.runs.checkpoints import Checkpoints
from ctgraph_rl.runs.settings import parameters_of, with_added
from ctgraph_rl.runs.train import MakeAgent, new_agent, with_method
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.kinds.task_like import TaskLike

PACKAGES = {
    "agent": "baselines",
    "method": "baselines.methods",
    "plasticity": "baselines.plasticity",
    "cell": "baselines.cells",
    "detector": "baselines.detectors",
}
"""Of agents and their parts that a directory may name."""


@dataclass(frozen=True)
class Trained:
    """The agent that a run trained, and what it learned.

    ``evaluate(trained.policy_for(task), [task], initial_state=trained.agent.initial_state,
    curriculum=trained.curriculum)`` plays a task, ``learn_curriculum(another, trained.agent)`` learns on.
    """

    agent: Agent
    curriculum: Curriculum
    seed: int
    frames: int  # that it has learned from
    log: RunLog

    def policy_for(self, task: TaskLike) -> TensorDictModuleBase:
        """Return the policy for a task: by its id, where the curriculum has and shows one.

        For an agent that labels tasks itself, by the task's most frequent label.
        """
        return task_policies(self.agent, self.curriculum, self.log, [task])[0]


def load(
    run_dir: Path | str,
    make_agent: MakeAgent | None = None,
    curriculum: Curriculum | None = None,
    device: torch.device | str = "cpu",
    make_method: Callable[[], MethodLike] | None = None,
) -> Trained:
    """Load the trained agent of a run, finished or not, with its method, to play or learn on.

    After ``save_optimiser=false`` it learns on with new moments of its optimiser.

    Args:
        make_agent: for a class outside ``baselines``: the class, built with the stored settings, or a function of the
            environment's unbatched observation and action specs, such as ``partial(MyAgent, **settings)``.
        curriculum: for one with parts of other classes than this package's.
        make_method: for a method outside ``baselines``, likewise. With such a detector it builds both, such as
            ``lambda: MyDetector(...).labelling(MaskRI())``.

    Raises:
        FileNotFoundError: without a saved run.
        ValueError: for a missing agent, method or curriculum, and files that do not belong together.
    """
    run_dir = as_path("run_dir", run_dir)
    device = checked_device(device)
    if not (run_dir / LOG).exists():
        raise FileNotFoundError(no_run(run_dir, below=False))
    log = RunLog.read(run_dir / LOG)
    require((bool(log.about), f"{run_dir / LOG} has no first line of a run; it was stopped before it began"))
    learned = _curriculum(run_dir, curriculum, log.about.get("fingerprint"))
    config = log.about.get("config") or {}
    seed = config.get("seed", 0)
    require((is_int(seed, 0, 2**63 - 1), f"{run_dir / LOG} has no seed: seed must be in [0, 2**63), got {seed!r:.80}"))
    build = _builder(run_dir, config, make_agent, make_method, learned)
    weights, frames = _weights(run_dir, log)
    try:
        with torch.random.fork_rng():
            agent = new_agent(learned, build, seed, device)
        agent.load_state_dict(weights)
    except (RuntimeError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(f"{run_dir} holds weights that are not of the agent that was built: {error}") from error
    return Trained(agent, learned, seed, frames, log)


def _curriculum(run_dir: Path, given: Curriculum | None, fingerprint: Any) -> Curriculum:
    path = run_dir / CURRICULUM
    there = given is not None or path.exists()
    require((there, f"{run_dir} has no {CURRICULUM}, as of classes that are not ours: give load(..., curriculum=)"))
    found = Curriculum.from_json(path) if given is None else given
    same = found.fingerprint == fingerprint
    require((same, f"{run_dir} learned a curriculum with fingerprint {fingerprint}, this one has {found.fingerprint}"))
    return found


def _builder(
    run_dir: Path,
    config: ReadOnlyValues,
    make_agent: MakeAgent | None,
    make_method: Callable[[], MethodLike] | None,
    curriculum: Curriculum,
) -> MakeAgent:
    stored = {part: config.get(part) for part in PACKAGES}
    named = make_agent is None
    alone = _ours(run_dir, "agent", stored["agent"]) if named else _with(run_dir, make_agent, stored["agent"])
    if make_method is not None:
        make_method = _with(run_dir, make_method, stored["method"])
    elif stored["method"] is not None:
        make_method = _ours(run_dir, "method", stored["method"])
    else:
        return alone
    plasticity = stored["plasticity"]
    make_plasticity = None if plasticity is None else _ours(run_dir, "plasticity", plasticity)
    labelled = partial(_labelled, run_dir, make_method, stored["detector"])
    return with_method(alone, labelled, curriculum, make_plasticity)


def _labelled(run_dir: Path, make_method: Callable[[], MethodLike], detector: Any) -> MethodLike:
    method = make_method()
    if detector is None or hasattr(method, "labelling"):
        return method
    labelled: MethodLike = _ours(run_dir, "detector", detector)().labelling(method)
    return labelled


def _with(run_dir: Path, make: Any, stored: Any) -> Callable[..., Any]:
    if not (isinstance(make, type) and isinstance(stored, Mapping)):
        return make
    takes = parameters_of(make)
    return partial(
        make, **{key: value for key, value in _settings(run_dir, with_added(stored)).items() if key in takes}
    )


def match_class(part: str, name: str) -> re.Match[str] | None:
    """Match the module and the class of an agent or a part of it that this package defines."""
    return re.fullmatch(rf"({re.escape(PACKAGES[part])}\.\w+)\.(\w+)", name)


def _ours(run_dir: Path, part: str, settings: Any) -> Callable[..., Any]:
    settings = settings if isinstance(settings, Mapping) else {}
    name = str(settings.get("_target_"))
    ours = match_class(part, name)
    maker = "make_method" if part in ("method", "detector") else "make_agent"
    if ours is None:
        name = terminal_text(name[:80])
        raise ValueError(f"{run_dir} is of the {part} {name}, no baseline: give load(..., {maker}=), in Python")
    kind: Any = class_named(ours[1], ours[2])
    defined = kind is not None and (issubclass(kind, torch.nn.Module) or hasattr(kind, "labelling"))
    require((defined, f"{run_dir} names the {part} {name}, and there is no such class; give load(..., {maker}=)"))
    return partial(kind, **_settings(run_dir, with_added(settings)))


def _settings(run_dir: Path, stored: ReadOnlyValues) -> NamedValues:
    given = {key: value for key, value in stored.items() if key not in ("_target_", "_partial_")}
    has_cell = isinstance(given.get("cell"), Mapping)
    return given | ({"cell": _ours(run_dir, "cell", given["cell"])} if has_cell else {})


def _weights(run_dir: Path, log: RunLog) -> tuple[ReadOnlyValues, int]:
    if (run_dir / AGENT).exists():
        return _checked(run_dir / AGENT), log.ends()[-1]
    saved = Checkpoints(run_dir / CHECKPOINTS).newest()
    if saved is None:
        raise FileNotFoundError(f"{run_dir} has neither {AGENT} nor a checkpoint: the run was stopped before its first")
    require(("agent" in saved, f"{run_dir / CHECKPOINTS} holds a checkpoint without an agent"))
    return saved["agent"], saved["frames"]


def _checked(path: Path) -> Any:
    try:
        content = read_content(path)
        require_records(content)
        with zipfile.ZipFile(io.BytesIO(content)) as records:
            changed = records.testzip()
        require((changed is None, f"{changed} in it is not what was written"))
        return read_plain(content)
    except (ValueError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} cannot be read: {error}; restore it, or run again with overwrite=true") from error
