"""Probes: tasks so small that an agent solves them in seconds, to an exact value, or something is wrong with it."""

from __future__ import annotations

import pytest
import torch
from helpers.small_agents import AGENTS, GREEDY, ONE_HOT_TASK, Q_LEARNERS, RECURRENT, agent_of
from tensordict import TensorDict
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.envs.utils import set_exploration_type

from ctgraph_rl import Block, Curriculum, learn_curriculum
from ctgraph_rl.learn.collect import collect

every_agent = pytest.mark.parametrize("name", AGENTS)

FAST = {
    "a2c": ["agent.learning_rate=0.02"],
    "reinforce": ["agent.learning_rate=0.02"],
    "dqn": ["agent.batch_size=64"],
    "drqn": ["agent.batch_size=16"],
    "qrdqn_lstm": ["agent.batch_size=16"],
    "lstm_ppo": ["agent.num_minibatches=2"],
    "rl2": ["agent.trial_episodes=1", "agent.num_minibatches=2"],
}


class Probe(EnvBase):
    """Episodes of ``length`` steps; the last action is right if it is ``answer`` of the cue, 0 or 1, of the start.

    It shows one-hot: 0 or 1 the cue, 2 a blank, 3 or 4 whether the first action was ``answer`` of the cue.

    Args:
        num_envs: rows.
        length: 1 or 2 steps.
        shows_cue: False shows the blank at the start, and the cue is 0.
        shows_first: the second observation tells whether the first action was right, which is then what is paid for.
    """

    batch_locked = True

    def __init__(self, num_envs: int, length: int = 1, shows_cue: bool = True, shows_first: bool = False) -> None:
        super().__init__(batch_size=[num_envs])
        self.length, self.shows_cue, self.shows_first = length, shows_cue, shows_first
        n = num_envs
        self.observation_spec = Composite(
            observation=Bounded(0, 1, shape=(n, 5), dtype=torch.uint8),
            is_init=Binary(1, shape=(n, 1), dtype=torch.bool),
            outcome=Bounded(0, 3, shape=(n, 1), dtype=torch.uint8),
            shape=(n,),
        )
        self.action_spec = Categorical(2, shape=(n,), dtype=torch.int64)
        self.reward_spec = Unbounded(shape=(n, 1))
        flag = Binary(1, shape=(n, 1), dtype=torch.bool)
        self.full_done_spec = Composite(done=flag, terminated=flag.clone(), shape=(n,))
        self.cue, self.first, self.steps = (torch.zeros(n, dtype=torch.int64) for _ in range(3))

    def _reset(self, tensordict=None, **kwargs):
        mask = torch.ones(self.batch_size, dtype=torch.bool)
        if tensordict is not None and "_reset" in tensordict:
            mask = tensordict["_reset"].view(-1)
        drawn = torch.randint(2, self.batch_size) if self.shows_cue else torch.zeros_like(self.cue)
        self.cue = torch.where(mask, drawn, self.cue)
        self.steps = torch.where(mask, 0, self.steps)
        shown = self.cue if self.shows_cue else torch.full_like(self.cue, 2)
        return self._data(shown, is_init=mask)

    def _step(self, tensordict):
        right = (tensordict["action"] == self.cue).long()
        self.first = torch.where(self.steps == 0, right, self.first)
        self.steps = self.steps + 1
        done = (self.steps == self.length).unsqueeze(-1)
        paid = self.first if self.shows_first else right
        shown = 3 + self.first if self.shows_first else torch.full_like(self.cue, 2)
        data = self._data(shown, is_init=torch.zeros(self.batch_size, dtype=torch.bool))
        return data.update({"reward": paid.unsqueeze(-1).float() * done, "done": done, "terminated": done.clone()})

    def _data(self, shown, is_init):
        flags = {"done": torch.zeros(*self.batch_size, 1, dtype=torch.bool)}
        flags["terminated"] = flags["done"].clone()
        shown = torch.nn.functional.one_hot(shown, 5).to(torch.uint8)
        outcome = torch.zeros(*self.batch_size, 1, dtype=torch.uint8)
        data = {"observation": shown, "is_init": is_init.unsqueeze(-1), "outcome": outcome, **flags}
        return TensorDict(data, batch_size=self.batch_size)

    def _set_seed(self, seed):
        pass


def greedy_return(agent, env: Probe) -> float:
    """The mean reward of 200 episodes of an agent that does not explore."""
    start = agent.initial_state(env.numel())
    data, rewards = env.reset().update(start), []
    with torch.no_grad(), set_exploration_type(GREEDY):
        for _ in range(200 // env.numel() * env.length):
            step, data = env.step_and_maybe_reset(agent.policy(data))
            state = step["next"].select(*start.keys())
            data.update(torch.where(data["is_init"].squeeze(-1), start, state) if start.keys() else {})
            rewards.append(step["next", "reward"])
    return torch.stack(rewards).mean().item() * env.length


def learn_probe(compose, name: str, num_batches: int, **probe) -> float:
    """The greedy return after learning a probe, as soon as it is 1 in two checks on end."""
    env, test = (Probe(num, **probe) for num in (16, 20))
    anneal = [f"agent.annealing_num_steps={num_batches * 64}"] if name in Q_LEARNERS else []
    agent = agent_of(compose, name, env, *FAST.get(name, []), *anneal, "agent.hidden_size=16")
    found = [0.0]
    for i, batch in enumerate(collect(env, agent.policy, num_batches * 128, 8, agent.initial_state)):
        agent.learn(batch)
        if i % 4 == 3:
            found.append(greedy_return(agent, test))
        if found[-2:] == [1.0] * 2:
            break
    return found[-1]


@pytest.mark.parametrize("name", ["a2c", "dqn", "lstm_ppo", "mohqa"])
def test_one_of_two_actions_pays(compose, name):
    assert learn_probe(compose, name, 200, shows_cue=False) == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a2c", "dqn", "lstm_ppo", "mohqa"])
def test_what_pays_depends_on_the_observation(compose, name):
    assert learn_probe(compose, name, 300) == 1.0


@pytest.mark.slow
@every_agent
def test_the_reward_comes_a_step_after_the_action_that_earned_it(compose, name):
    assert learn_probe(compose, name, 300, length=2, shows_first=True) == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("name", RECURRENT)
def test_what_pays_depends_on_the_observation_before(compose, name):
    assert learn_probe(compose, name, 400, length=2) == 1.0


@pytest.mark.parametrize("name", sorted(set(AGENTS) - set(RECURRENT)))
def test_an_agent_without_memory_cannot_know_the_observation_before(compose, name):
    env = Probe(200, length=2)
    agent = agent_of(compose, name, env)

    assert greedy_return(agent, env) == pytest.approx(0.5, abs=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["dqn", "lstm_ppo", "ppo", "qrdqn_lstm"])
def test_an_agent_learns_one_hot_observations_of_three_branches(build_agent, name):
    """A probe: depth 1, where every state shows its kind, is solved exactly."""
    fewer = ["agent.num_updates=4", "agent.annealing_num_steps=10000"] if name in Q_LEARNERS else FAST.get(name, [])
    agent = build_agent(name, [ONE_HOT_TASK], "agent.num_envs=64", "agent.num_steps=16", *fewer)
    seen, learn = set(), agent.learn
    agent.learn = lambda batch: (seen.update(batch["action"].flatten().tolist()), learn(batch))[1]
    probe = Curriculum("probe", 1, "here", [Block(ONE_HOT_TASK, 20_480)])

    performance = learn_curriculum(probe, agent).performance()

    assert performance[-1].tolist() == [1.0]
    assert seen == {0, 1, 2, 3}
