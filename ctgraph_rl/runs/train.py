"""A run in a directory: an agent learns a curriculum, and leaves measurements, metrics and weights."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from inspect import Signature, signature
from pathlib import Path

import torch
from rich.console import Console
from torchrl.data import Composite, TensorSpec

from ctgraph_rl.agent import Agent, MethodLike, PlasticityLike
from ctgraph_rl.batch.rows import seed_rule
from ctgraph_rl.checks import (
    NamedValues,
    ReadOnlyValues,
    Rule,
    as_path,
    is_json_object,
    require,
    require_memory,
    takes_numbers,
)
from ctgraph_rl.core.device import checked_device
from ctgraph_rl.learn.collect import agent_specs
from ctgraph_rl.learn.refusals import check_adaptation, check_episodes, check_exact, check_rows
from ctgraph_rl.log.files import CHECKPOINTS
from ctgraph_rl.log.provenance import learners
from ctgraph_rl.runs.checkpoints import Checkpoints
from ctgraph_rl.runs.experts import Expert
from ctgraph_rl.runs.session import OneBatch, RunMember, Session
from ctgraph_rl.runs.settings import parameters_of
from ctgraph_rl.tasks.curriculum import Curriculum

MakeAgent = Callable[[Composite, TensorSpec], Agent]
"""Builds an agent of unbatched observation and action specs."""

MakePlasticity = Callable[[], PlasticityLike]

MEMBERS = (
    *("num_envs", "num_steps", "policy", "policy_for", "initial_state"),
    *("start_task", "end_task", "learn", "to", "state_dict"),
)


def new_agent(curriculum: Curriculum, make_agent: MakeAgent, seed: int, device: torch.device | str = "cpu") -> Agent:
    """Build an agent with weights by the seed of torch's global generator.

    Raises:
        ValueError: if it cannot learn the curriculum.
    """
    example = "make_agent must be a function of two specs, such as partial(PPO, num_envs=8, ...)"
    require(_curriculum_rule(curriculum), seed_rule(seed), (callable(make_agent), f"{example}, got {make_agent!r:.80}"))
    device = checked_device(device)
    torch.manual_seed(seed)
    specs = agent_specs(curriculum)
    require(_takes_specs(make_agent))
    agent: Agent = make_agent(*specs)
    require(_agent_rule(agent))
    frames = agent.num_envs * agent.num_steps
    batch = f"batches of num_envs={agent.num_envs} x num_steps={agent.num_steps} frames"
    require_memory(batch, 2 * frames * specs.observation["observation"].shape.numel(), "of either")
    agent = agent.to(device)
    check_rows(curriculum, agent.num_envs)
    check_episodes(curriculum, agent)
    check_adaptation(curriculum, agent)
    check_exact(curriculum, agent)
    return agent


def _curriculum_rule(curriculum: object) -> Rule:
    return isinstance(curriculum, Curriculum), f"curriculum must be a Curriculum, got {curriculum!r:.80}"


def _agent_rule(agent: object) -> Rule:
    missing = [name for name in MEMBERS if not hasattr(agent, name)]
    built = not missing and not isinstance(agent, type)
    fix = "see ctgraph_rl.agent.Agent, and build it by new_agent(curriculum, make_agent, seed)"
    name = getattr(agent, "__name__", type(agent).__name__)
    return built, f"{name} is no agent, it lacks {', '.join(missing)}: {fix}"


def _takes_specs(make_agent: Callable[..., object]) -> Rule:
    try:
        signature(make_agent).bind(None, None)
        if isinstance(make_agent, type):
            parameters = sorted(parameters_of(make_agent).values(), key=lambda each: each.kind)
            Signature(parameters).bind(None, None)
    except TypeError as error:
        name = getattr(make_agent, "__name__", type(make_agent).__name__)
        return False, f"make_agent must take two specs and nothing else, {name}: {error}; bind the rest, by partial"
    except ValueError:  # what has no signature
        pass
    return True, ""


def with_method(
    make_agent: MakeAgent,
    make_method: Callable[[], MethodLike],
    curriculum: Curriculum,
    make_plasticity: MakePlasticity | None = None,
) -> MakeAgent:
    """Return a function that builds an agent with a new plasticity, if any, and a new method."""

    def make(observation_spec: Composite, action_spec: TensorSpec) -> Agent:
        agent = make_agent(observation_spec, action_spec)
        if make_plasticity is not None:
            agent = make_plasticity().attach(agent, curriculum)
        return make_method().attach(agent, curriculum)

    return make


@takes_numbers
def train(
    curriculum: Curriculum,
    agent: Agent,
    run_dir: Path,
    seed: int,
    device: torch.device | str = "cpu",
    *,
    config: ReadOnlyValues | None = None,
    experts: Sequence[Expert] | None = None,
    checkpoints: Checkpoints | None = None,
    listeners: Sequence[Callable[[NamedValues], object]] = (),
    console: Console | None = None,
    log_units: bool | str = False,
) -> None:
    """Let a new agent learn a curriculum, with a progress bar, and write `RESULTS`.

    A stopped run resumes from its last checkpoint, and ends as if it had never stopped.

    Args:
        agent: just built by `new_agent`, which decides torch's global generator.
        seed: in [0, 2**63).
        config: for the log's first line beside the seed, as JSON.
        experts: each task's single-task expert, named in the log.
        checkpoints: default: in the directory, every five minutes.
        listeners: called with every measurement.
        log_units: as for `learn_curriculum`.

    Raises:
        ValueError: before any work, for arguments out of range, an agent that cannot learn the curriculum, and a run
            that cannot be resumed.
        BlockingIOError: if another writer is in the directory.
    """
    run_dir = as_path("run_dir", run_dir)
    count = len(curriculum.tasks) if isinstance(curriculum, Curriculum) else 0
    is_list = isinstance(experts, Sequence) and all(isinstance(each, Expert) for each in experts)
    one_each = experts is None or (is_list and len(experts) == count)
    can_listen = isinstance(listeners, Sequence) and all(map(callable, listeners))
    is_console = console is None or isinstance(console, Console)
    kept = checkpoints is None or isinstance(checkpoints, Checkpoints)
    require(
        _curriculum_rule(curriculum),
        _agent_rule(agent),
        seed_rule(seed),
        (is_json_object(config), f"config must be plain JSON values by name, got {config!r:.80}"),
        (run_dir.is_dir(), f"run_dir must be an existing directory, got {str(run_dir)!r:.80}; make it"),
        (one_each, f"experts must be the Expert of each of {count} tasks, or None, got {experts!r:.80}"),
        (kept, f"checkpoints must be Checkpoints(folder), or None, got {checkpoints!r:.80}"),
        (can_listen, f"listeners must be a list of functions, such as [print], got {listeners!r:.80}"),
        (is_console, f"console must be a rich.console.Console, or None, got {console!r:.80}"),
    )
    checkpoints = Checkpoints(run_dir / CHECKPOINTS) if checkpoints is None else checkpoints
    device = checked_device(device)
    config = {"seed": seed, **(config or {})}
    member = RunMember(
        curriculum,
        agent,
        seed,
        run_dir=run_dir,
        config=config,
        checkpoints=checkpoints,
        sources=learners(config, agent),
        experts=experts,
        listeners=list(listeners),
        log_units=log_units,
    )
    with Session(console) as session:
        session.lock(run_dir)
        failed = session.learn([member], OneBatch(device))
    for error in failed.values():
        raise error
