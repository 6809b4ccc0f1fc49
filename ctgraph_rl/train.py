"""A run in a directory: an agent learns a curriculum, and its measurements, metrics and weights are files."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torchrl.data import Composite, TensorSpec

from ctgraph_rl.agent import Agent
from ctgraph_rl.checks import require
from ctgraph_rl.curriculum import Curriculum
from ctgraph_rl.experts import Expert
from ctgraph_rl.lifelong import check_rows, learn_curriculum, make_env
from ctgraph_rl.log import RunLog, write_metrics, write_performance
from ctgraph_rl.progress import ProgressBar
from ctgraph_rl.provenance import provenance
from ctgraph_rl.scores import scores
from ctgraph_rl.tables import write_tables

MakeAgent = Callable[[Composite, TensorSpec], Agent]
"""Builds an agent for an environment's unbatched observation and action specs."""

MEMBERS = (
    "num_envs",
    "num_steps",
    "policy",
    "initial_state",
    "start_task",
    "end_task",
    "learn",
    "to",
    "state_dict",
)
"""What a run needs of an agent."""

RESULTS = ("run.jsonl", "evaluations.csv", "training.csv", "performance.csv", "metrics.json", "agent.pt")
"""What a run writes into its directory; ``metrics.json`` is there when the run is complete."""


def new_agent(curriculum: Curriculum, make_agent: MakeAgent, seed: int, device: torch.device | str = "cpu") -> Agent:
    """An agent whose weights come from the seed, which sets torch's global generator.

    Raises:
        ValueError: if it cannot learn the curriculum.
    """
    torch.manual_seed(seed)
    env = make_env(curriculum, curriculum.tasks, seed)
    agent: Agent = make_agent(env.observation_spec_unbatched, env.action_spec_unbatched)
    missing = [name for name in MEMBERS if not hasattr(agent, name)]
    require(
        (not missing, f"{type(agent).__name__} is no agent, it lacks {', '.join(missing)}: see ctgraph_rl.agent.Agent")
    )
    agent = agent.to(device)
    check_rows(curriculum, agent.num_envs)
    return agent


def train(
    curriculum: Curriculum,
    make_agent: MakeAgent,
    run_dir: Path,
    seed: int,
    device: torch.device | str = "cpu",
    config: Mapping[str, Any] | None = None,
    experts: Sequence[Expert] | None = None,
) -> None:
    """Let a new agent learn a curriculum, with a progress bar, and write `RESULTS` to a directory that has none.

    Args:
        curriculum: what is learned.
        make_agent: builds the agent.
        run_dir: an existing directory.
        seed: decides the run, in [0, 2**63).
        device: where environment and agent live.
        config: what else the first line of the log should hold.
        experts: for each task, who learned it alone; they are named in the log.
    """
    agent = new_agent(curriculum, make_agent, seed, device)
    log = RunLog(run_dir / "run.jsonl")
    log.append("run", **provenance(curriculum), config=config)
    if experts is not None:
        log.append("experts", experts=[expert.about for expert in experts])
    with ProgressBar(len(curriculum.blocks), curriculum.num_frames) as progress:
        learn_curriculum(curriculum, agent, seed, log, progress, device)
    log.close()
    torch.save(agent.state_dict(), run_dir / "agent.pt")
    write_tables(log, run_dir, parquet=False)
    write_performance(run_dir / "performance.csv", log, curriculum.labels)
    logs = None if experts is None else [expert.log for expert in experts]
    write_metrics(run_dir / "metrics.json", scores(log, curriculum, logs))
