"""Tests of every agent, lifelong-learning method and plasticity, by `ctgraph_rl.agent`."""

from __future__ import annotations

import io
import math
from dataclasses import replace
from typing import Any

import torch

from ctgraph_rl.agent import Agent, MethodLike, PlasticityLike
from ctgraph_rl.learn.collect import agent_specs, make_env
from ctgraph_rl.learn.lifelong import learn_curriculum
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.log.saved import sum_of_state
from ctgraph_rl.runs.train import new_agent, with_method
from ctgraph_rl.tasks.configurations import ct_graph
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.protocol import Block, Evaluation, Protocol


class AgentContract:
    """Tests of an agent. Override `make_agent` with small networks and few environments.

    Example:
        >>> class TestMyAgent(AgentContract):
        ...     def make_agent(self, observation_spec, action_spec):
        ...         return MyAgent(observation_spec, action_spec, num_envs=4, num_steps=8)
    """

    def make_agent(self, observation_spec: Any, action_spec: Any) -> Agent:
        """Return a new agent for unbatched specs."""
        raise NotImplementedError

    def protocol(self) -> Protocol:
        """Return the protocol of the agent's runs."""
        return Protocol()

    def curriculum(self) -> Curriculum:
        """Return two blocks of three batches: a small task each, or both for an agent that adapts.

        Failing costs, so that every batch has rewards.
        """
        first = replace(ct_graph(depth=1, fully_observable=False), fail_reward=-1.0)
        tasks = (first, replace(first, goal=(2,)))
        shortest = tuple(Block((task,), num_frames=1) for task in tasks)
        curriculum = Curriculum("contract", 1, "a test", shortest, protocol=self.protocol())
        agent = self.make_agent(*agent_specs(curriculum))
        frames = 3 * agent.num_envs * agent.num_steps
        adapt_episodes = getattr(agent, "adapt_episodes", 0)
        blocks = tuple(Block(tasks if adapt_episodes else (task,), frames) for task in tasks)
        evaluation = Evaluation(num_episodes=2, before=False, adapt_episodes=adapt_episodes)
        return replace(curriculum, blocks=blocks, evaluation=evaluation)

    def build(self, curriculum: Curriculum, seed: int = 0) -> Agent:
        """Return a new agent for a curriculum."""
        return new_agent(curriculum, self.make_agent, seed)

    def learnt(self, curriculum: Curriculum, built_with: int = 0, **how: Any) -> tuple[Agent, RunLog]:
        """Return an agent that learned a curriculum, and its log."""
        agent = self.build(curriculum, built_with)
        return agent, learn_curriculum(curriculum, agent, **how)

    def test_a_policy_writes_an_action_for_each_row(self) -> None:
        """Of the specs' type and range."""
        curriculum = self.curriculum()
        agent = self.build(curriculum)
        env = make_env(curriculum, [curriculum.tasks[0]] * 3, 0)
        data = env.reset().update(agent.initial_state(3))

        with torch.no_grad():
            written = agent.policy(data)

        assert env.action_spec.is_in(written["action"])

    def test_it_learns_two_blocks_and_measures_finite_numbers(self) -> None:
        """A line of the log per batch; the agent's state changes."""
        curriculum = self.curriculum()
        agent, log = self.learnt(curriculum)
        lines = log.of_kind("training")

        assert sum_of_state(agent.state_dict()) != sum_of_state(self.build(curriculum).state_dict())
        assert len(lines) == 6
        values = [value for line in lines for value in line.values() if isinstance(value, float)]
        assert all(map(math.isfinite, values))

    def test_equal_seeds_give_equal_runs(self) -> None:
        """Weights and measurements."""
        curriculum = self.curriculum()
        one, log = self.learnt(curriculum)
        other, again = self.learnt(curriculum)

        assert _without_times(log) == _without_times(again)
        assert sum_of_state(one.state_dict()) == sum_of_state(other.state_dict())

    def test_a_run_resumes_from_a_saved_state_with_the_same_bits(self) -> None:
        """Saved by PyTorch within each block, loaded without code in an agent of another seed."""
        curriculum = self.curriculum()
        states = []
        whole, log = self.learnt(curriculum, checkpoint=lambda state, ends: states.append(_bytes(state())))
        for state in (states[1], states[-2]):
            saved = torch.load(io.BytesIO(state), weights_only=True)
            resumed, again = self.learnt(curriculum, built_with=1, saved=saved)
            rest = _without_times(log)[-len(again.measurements) :]

            assert _without_times(again) == rest
            assert sum_of_state(whole.state_dict()) == sum_of_state(resumed.state_dict())


class MethodContract(AgentContract):
    """Tests of a lifelong-learning method on an agent. Override `make_agent` and `make_method`."""

    def make_method(self) -> MethodLike:
        """Return a new method."""
        raise NotImplementedError

    def curriculum(self) -> Curriculum:
        """Return the method's curriculum of the two small tasks."""
        return self.make_method().prepare(super().curriculum())

    def build(self, curriculum: Curriculum, seed: int = 0) -> Agent:
        """Return a new agent with the method."""
        return new_agent(curriculum, with_method(self.make_agent, self.make_method, curriculum), seed)


class PlasticityContract(MethodContract):
    """Tests of a plasticity on an agent. Override `make_agent`, `make_method`, such as ``Finetune``, and
    `make_plasticity`.
    """

    def make_plasticity(self) -> PlasticityLike:
        """Return a new plasticity."""
        raise NotImplementedError

    def build(self, curriculum: Curriculum, seed: int = 0) -> Agent:
        """Return a new agent with the plasticity, and the method."""
        make = with_method(self.make_agent, self.make_method, curriculum, self.make_plasticity)
        return new_agent(curriculum, make, seed)

    def test_it_leaves_all_other_draws(self) -> None:
        """Of torch's global generator, after building and after learning."""
        curriculum = self.curriculum()
        plain = new_agent(curriculum, with_method(self.make_agent, self.make_method, curriculum), 0)
        states = [torch.get_rng_state()]
        learn_curriculum(curriculum, plain)
        states.append(torch.get_rng_state())
        agent = self.build(curriculum)

        assert torch.equal(torch.get_rng_state(), states[0])
        learn_curriculum(curriculum, agent)
        assert torch.equal(torch.get_rng_state(), states[1])

    def test_hidden_task_changes_are_refused_by_name_or_learned(self) -> None:
        """By the plasticity, before any work."""
        hidden = replace(self.curriculum(), protocol=Protocol(boundaries="hidden"))
        if not self.make_plasticity().needs_boundaries:
            learn_curriculum(hidden, self.build(hidden))
            return
        try:
            self.build(hidden)
        except ValueError as error:
            assert type(self.make_plasticity()).__name__ in str(error)
        else:
            raise AssertionError("it was built without announced task changes")


def _bytes(state: Any) -> bytes:
    buffer = io.BytesIO()
    torch.save(state, buffer)
    return buffer.getvalue()


def _without_times(log: RunLog) -> list[dict[str, Any]]:
    return [{key: value for key, value in line.items() if key != "seconds"} for line in log.measurements]
