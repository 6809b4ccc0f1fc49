"""What holds for every baseline agent."""

from __future__ import annotations

import pytest
import torch
from helpers.paths import CHECKOUT
from helpers.small_agents import (
    ADAPTING,
    AGENTS,
    EVOLVING,
    GREEDY,
    YAML,
    agent_of,
    batches,
    learnt_from,
    others_slow,
)
from torchrl.data import Bounded, Unbounded
from torchrl.envs.utils import set_exploration_type

from baselines.parts.gates import GatedNetwork
from baselines.parts.networks import Encoder
from ctgraph_rl import Block, CTGraphEnv, Curriculum, Evaluation, learn_curriculum
from ctgraph_rl.learn.collect import collect
from curricula.paper import ct_su_b1

every_agent = pytest.mark.parametrize("name", AGENTS)

an_agent_of_each_family = pytest.mark.parametrize(
    "name", others_slow(AGENTS, "a2c", "dqn", "lstm_ppo", "mohqa", "qrdqn_lstm")
)


def reading(agent, batch):
    """Only what the agent's policy reads of a batch."""
    return batch.select(*agent.policy.in_keys)


def test_the_agents_are_those_with_a_yaml():
    files = (CHECKOUT / "baselines").glob("*.py")

    found = sorted(path.stem for path in files if "\n    solves = " in path.read_text(encoding="utf-8"))
    assert found == sorted([*AGENTS, *ADAPTING, *EVOLVING])
    assert "ppo_published" in YAML.keys() - set(AGENTS)


@every_agent
def test_a_policy_reads_observation_and_is_init_and_its_own_state_and_nothing_else(small_agent, name):
    agent = small_agent(name, [ct_su_b1()])
    batch = batches(agent, ct_su_b1(), 1)[0][:, 3]
    scrambled = batch.clone()
    for key in ("step_count", "episode_reward", "outcome", "leaf"):
        scrambled[key] = scrambled[key] + 1

    with set_exploration_type(GREEDY), torch.no_grad():
        chosen, other, least = (agent.policy(data.clone()) for data in (batch, scrambled, reading(agent, batch)))

    assert set(agent.policy.in_keys) <= {"observation", "is_init", *agent.initial_state(1).keys()}
    assert torch.equal(chosen["action"], other["action"])
    assert torch.equal(chosen["action"], least["action"])


@every_agent
def test_a_policy_writes_nothing_but_actions_what_learning_needs_and_its_state(small_agent, name):
    agent = small_agent(name, [ct_su_b1()])
    data = CTGraphEnv([ct_su_b1()] * 3).reset().update(agent.initial_state(3))

    with torch.no_grad():
        written = agent.policy(data.clone())

    state = {("next", key) for key in agent.initial_state(1).keys()} - {("next", "reward")}  # noqa: SIM118
    new = set(written.keys(True, True)) - set(data.keys(True, True))
    assert {"action"} | state <= new <= {"action", "action_log_prob", "state_value"} | state
    assert (written["action"].dtype, written["action"].shape) == (torch.int64, (3,))


@every_agent
def test_losses_are_scalars_and_their_gradients_reach_every_parameter_of_the_policy(small_agent, name):
    agent = small_agent(name, [ct_su_b1()])
    minibatch = learnt_from(agent, batches(agent, ct_su_b1(), 1)[0])[0]

    losses = agent.loss(minibatch)
    agent.zero_grad()
    total = {key: value for key, value in losses.items() if key.startswith("loss_")}
    sum(total.values()).backward()

    assert total and all(value.shape == () for value in total.values())
    silent = [key for key, p in agent.policy.named_parameters() if p.grad is None or not p.grad.any()]
    assert silent == []


@every_agent
def test_learning_changes_every_parameter_of_the_policy_but_not_the_batch_and_reports_finite_numbers(small_agent, name):
    agent = small_agent(name, [ct_su_b1()])
    before = [parameter.clone() for parameter in agent.policy.parameters()]
    batch = batches(agent, ct_su_b1(), 1)[0]
    given = batch.clone()

    measurements = agent.learn(batch)

    assert set(batch.keys(True)) == set(given.keys(True))
    assert (batch == given).all()
    assert all(not torch.equal(*pair) for pair in zip(before, agent.policy.parameters(), strict=True))
    assert all(type(value) is float and abs(value) < float("inf") for value in measurements.values())
    assert {"grad_norm"} < set(measurements) and any(key.startswith("loss_") for key in measurements)


@every_agent
def test_an_agent_reads_the_task_id_where_the_environment_shows_it(compose, name):
    tasks = [ct_su_b1((1, 2)), ct_su_b1((2, 1))]
    env = CTGraphEnv(tasks * 8, task_ids={task: i for i, task in enumerate(tasks)}, num_task_ids=3)
    agent = agent_of(compose, name, env)
    batch = next(collect(env, agent.policy, 128, 8, agent.initial_state))
    features = next(module for module in agent.modules() if isinstance(module, Encoder))
    before = features.linear.weight.clone()

    agent.learn(batch)

    assert batch["task_id"][:2, 0].tolist() == [[1, 0, 0], [0, 1, 0]]
    assert "task_number" in agent.policy.in_keys
    changed = (features.linear.weight != before).any(dim=0)[144:147].tolist()
    assert changed == [True, True, False]


GATED = {"hidden_size": 8, "num_layers": 2, "gate": "soft", "gate_size": 4}


def seen_with(num_ids: int):
    """What a network sees that reads so many ids."""
    number = {"task_number": Bounded(-1, num_ids - 1, [1], dtype=torch.int64)} if num_ids else {}
    return {"observation": Unbounded([12]), **number}


NETWORKS = {
    "encoder": lambda num_ids, num_extra: Encoder(torch.Size([12]), 1.0, 8, num_extra=num_extra, num_ids=num_ids),
    "gated": lambda num_ids, num_extra: GatedNetwork(seen_with(num_ids), num_extra, 3, **GATED),
}


@pytest.mark.parametrize("make", NETWORKS.values(), ids=NETWORKS)
def test_a_network_reads_the_number_of_a_task_as_the_one_hot_vector_and_none_as_zeros(make):
    torch.manual_seed(0)
    by_number = make(5, 2).double()
    by_vector = make(0, 7).double()
    by_vector.load_state_dict(by_number.state_dict())
    seen, extra = torch.rand(3, 6, 12, dtype=torch.float64), torch.rand(3, 6, 2, dtype=torch.float64)
    number = torch.randint(5, (3, 6, 1))
    number[1, 2] = -1
    vector = (number == torch.arange(5)).byte()

    ways = by_number(seen, number, extra), by_vector(seen, vector, extra)

    by = torch.randn_like(ways[0])
    gradients = [
        torch.autograd.grad(way, list(net.parameters()), by)
        for way, net in zip(ways, (by_number, by_vector), strict=True)
    ]
    torch.testing.assert_close((ways[0], gradients[0]), (ways[1], gradients[1]), atol=1e-12, rtol=1e-12)


def test_task_ids_are_shown_as_vectors_and_numbers_which_a_batch_holds_once():
    tasks = [ct_su_b1((1, 2)), ct_su_b1((2, 1)), ct_su_b1((1, 1))]
    env = CTGraphEnv(tasks, task_ids={task: i for i, task in enumerate(tasks[:2])}, num_task_ids=1000)

    _, batch = collect(env, lambda data: data.set("action", env.action_spec.rand()), 48, 8)

    for shown in (batch, batch["next"]):
        assert shown["task_number"].squeeze(-1).unique(dim=1).tolist() == [[0], [1], [-1]]
        assert torch.equal(shown["task_id"], (shown["task_number"] == torch.arange(1000)).byte())
        assert shown["task_id"].stride(1) == 0


@every_agent
def test_an_agent_takes_the_task_that_starts_or_none(small_agent, name):
    agent = small_agent(name, [ct_su_b1()])

    agent.start_task(1)
    agent.start_task(None)
    agent.start_task()

    assert agent.policy_for(1) is agent.policy


@an_agent_of_each_family
def test_a_loss_that_is_not_a_number_stops_learning_and_is_named(small_agent, name):
    agent = small_agent(name, [ct_su_b1()])
    batch = batches(agent, ct_su_b1(), 1)[0]
    batch["next", "reward"][3, 2] = float("nan")

    with pytest.raises(FloatingPointError, match=r"^loss_\w+ is nan$"):
        for _ in range(20):  # until the replay gives the reward
            agent.learn(batch)


@an_agent_of_each_family
def test_an_agent_works_where_batches_are_shortened(small_agent, name):
    blocks = [Block(ct_su_b1(), 16 * 9), Block(ct_su_b1((2, 2)), 16)]
    curriculum = Curriculum("short", 1, "here", blocks, Evaluation(2, before=False))

    log = learn_curriculum(curriculum, small_agent(name, curriculum.tasks))

    assert [measured["frames"] for measured in log.of_kind("training")] == [128, 144, 160]
