"""New agents for a curriculum, with method and plasticity."""

from __future__ import annotations

from collections.abc import Callable
from inspect import Signature, signature

import torch
from torchrl.data import Composite, TensorSpec

from ctgraph_rl.agent import Agent, MethodLike, PlasticityLike
from ctgraph_rl.batch.rows import seed_rule
from ctgraph_rl.checks import require, require_memory
from ctgraph_rl.core.device import checked_device
from ctgraph_rl.learn.collect import agent_specs
from ctgraph_rl.learn.refusals import check_learner
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
    require(
        (isinstance(curriculum, Curriculum), f"curriculum must be a Curriculum, got {curriculum!r:.80}"),
        seed_rule(seed),
        (callable(make_agent), f"{example}, got {make_agent!r:.80}"),
    )
    device = checked_device(device)
    torch.manual_seed(seed)
    specs = agent_specs(curriculum)
    try:
        signature(make_agent).bind(None, None)
        if isinstance(make_agent, type):
            parameters = sorted(parameters_of(make_agent).values(), key=lambda each: each.kind)
            Signature(parameters).bind(None, None)
    except TypeError as error:
        name = getattr(make_agent, "__name__", type(make_agent).__name__)
        two = f"make_agent must take two specs and nothing else, {name}: {error}; bind the rest, by partial"
        raise ValueError(two) from None
    except ValueError:  # what has no signature
        pass
    agent: Agent = make_agent(*specs)
    missing = [name for name in MEMBERS if not hasattr(agent, name)]
    name = getattr(agent, "__name__", type(agent).__name__)
    built = not missing and not isinstance(agent, type)
    fix = "see ctgraph_rl.agent.Agent, and build it by new_agent(curriculum, make_agent, seed)"
    require((built, f"{name} is no agent, it lacks {', '.join(missing)}: {fix}"))
    frames = agent.num_envs * agent.num_steps
    batch = f"batches of num_envs={agent.num_envs} x num_steps={agent.num_steps} frames"
    require_memory(batch, 2 * frames * specs.observation["observation"].shape.numel(), "of either")
    agent = agent.to(device)
    check_learner(curriculum, agent)
    return agent


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
