"""What holds for every baseline agent, and what is particular to each."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ctgraph_rl import Block, CTGraph, CTGraphEnv, Curriculum, Observations, OneHot, Task, evaluate, learn_curriculum
from ctgraph_rl.dynamics import OUTCOME_GOAL
from ctgraph_rl.lifelong import collect
from ctgraph_rl.run import conf_dir
from curricula.paper import ct_su_b1

AGENTS = sorted(path.stem for path in Path(conf_dir(), "agent").glob("*.yaml"))
OBSERVATIONS = Observations(decision_ids=(2, 2), wait_ids=(3, 3), end_ids=(4, 4))
ONE_HOT_TASK = Task(CTGraph(3, 1), (3,), OBSERVATIONS, OneHot(5))
GREEDY, SAMPLED = ExplorationType.DETERMINISTIC, ExplorationType.RANDOM

every_agent = pytest.mark.parametrize("name", AGENTS)


def batches(agent, task: Task, count: int, seed: int = 0) -> list:
    """Batches that an agent collects, as `learn_curriculum` gives them."""
    env = CTGraphEnv([task] * agent.num_envs, seed=seed)
    frames = count * agent.num_envs * agent.num_steps
    return list(collect(env, agent.policy, frames, agent.num_steps, agent.initial_state))


def learnt_from(agent, batch) -> list:
    """The batches of which the agent minimises the loss when it learns from a batch."""
    seen, loss = [], agent.loss
    agent.loss = lambda minibatch: (seen.append(minibatch.clone()), loss(minibatch))[1]
    agent.learn(batch)
    agent.loss = loss
    return seen


def reading(agent, batch):
    """Only what the agent's policy reads of a batch."""
    return batch.select(*agent.policy.in_keys)


def saved_and_loaded(state: dict) -> dict:
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


def parameters_equal(one, other) -> bool:
    return all(torch.equal(*pair) for pair in zip(one.parameters(), other.parameters(), strict=True))


def test_the_agents_are_those_with_a_yaml():
    assert AGENTS == ["dqn", "lstm_ppo"]


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

    state = {("next", key) for key in agent.initial_state(1).keys()}  # noqa: SIM118
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
def test_learning_changes_every_parameter_of_the_policy_and_reports_finite_numbers(small_agent, name):
    agent = small_agent(name, [ct_su_b1()])
    before = [parameter.clone() for parameter in agent.policy.parameters()]

    measurements = agent.learn(batches(agent, ct_su_b1(), 1)[0])

    assert all(not torch.equal(*pair) for pair in zip(before, agent.policy.parameters(), strict=True))
    assert all(type(value) is float and abs(value) < float("inf") for value in measurements.values())
    assert {"grad_norm"} < set(measurements) and any(key.startswith("loss_") for key in measurements)


@every_agent
def test_learning_leaves_the_batch_as_it_was(small_agent, name):
    agent = small_agent(name, [ct_su_b1()])
    batch = batches(agent, ct_su_b1(), 1)[0]
    before = batch.clone()

    agent.learn(batch)

    assert set(batch.keys(True)) == set(before.keys(True))
    assert (batch == before).all()


@every_agent
def test_a_saved_agent_acts_the_same_after_loading(small_agent, name):
    agent, other = small_agent(name, [ct_su_b1()]), small_agent(name, [ct_su_b1()], "seed=1")
    data = batches(agent, ct_su_b1(), 1)[0]
    agent.learn(data)

    other.load_state_dict(saved_and_loaded(agent.state_dict()))

    for exploration in (GREEDY, SAMPLED):
        with set_exploration_type(exploration), torch.no_grad():
            torch.manual_seed(3)
            expected = agent.policy(reading(agent, data[:, 0]))
            torch.manual_seed(3)
            found = other.policy(reading(agent, data[:, 0]))
        assert (expected == found).all()


@every_agent
def test_a_saved_agent_goes_on_as_if_never_stopped(small_agent, name):
    short = ["agent.target_update_interval=5"] if name == "dqn" else []
    agent, other = small_agent(name, [ct_su_b1()], *short), small_agent(name, [ct_su_b1()], "seed=1", *short)
    first, second, third = batches(agent, ct_su_b1(), 3)
    agent.learn(first)
    agent.learn(second)

    other.load_state_dict(saved_and_loaded(agent.state_dict()))
    torch.manual_seed(4)
    expected = agent.learn(third)
    torch.manual_seed(4)
    found = other.learn(third)

    assert found == expected
    assert parameters_equal(agent, other)


@every_agent
def test_an_agent_learns_one_hot_observations_of_three_branches(build_agent, name):
    """A probe: depth 1, where every state shows its kind, is solved exactly."""
    agent = build_agent(name, [ONE_HOT_TASK], "agent.num_envs=64", *(["agent.num_updates=2"] if name == "dqn" else []))
    seen, learn = set(), agent.learn
    agent.learn = lambda batch: (seen.update(batch["action"].flatten().tolist()), learn(batch))[1]
    probe = Curriculum("probe", 1, "here", [Block(ONE_HOT_TASK, 40_960)])

    performance = learn_curriculum(probe, agent).performance()

    assert performance[-1].tolist() == [1.0]
    assert seen == {0, 1, 2, 3}


def test_the_agents_work_where_batches_are_shortened(small_agent):
    curriculum = Curriculum("short", 1, "here", [Block(ct_su_b1(), 16 * 9), Block(ct_su_b1((2, 2)), 16)])

    logs = {name: learn_curriculum(curriculum, small_agent(name, curriculum.tasks)) for name in AGENTS}

    assert {name: [m["frames"] for m in log.of_kind("training")] for name, log in logs.items()} == {
        name: [128, 144, 160] for name in AGENTS
    }


BAD_VALUES = [
    ("num_envs=0", "num_envs must be an integer >= 1, got 0"),
    ("num_steps=1.5", "num_steps must be an integer >= 1, got 1.5"),
    ("hidden_size=0", "hidden_size must be an integer >= 1, got 0"),
    ("learning_rate=0", "learning_rate must be a number > 0, got 0"),
    ("learning_rate=fast", "learning_rate must be a number > 0, got 'fast'"),
    ("gamma=1.5", r"gamma must be in \[0, 1\], got 1.5"),
    ("max_grad_norm=-1", "max_grad_norm must be a number > 0, got -1"),
]
BAD_VALUES_OF = {
    "lstm_ppo": [
        ("gae_lambda=-0.1", r"gae_lambda must be in \[0, 1\], got -0.1"),
        ("clip_epsilon=0", "clip_epsilon must be a number > 0, got 0"),
        ("entropy_coeff=-1", "entropy_coeff must be a number >= 0, got -1"),
        ("critic_coeff=null", "critic_coeff must be a number >= 0, got None"),
        ("num_epochs=0", "num_epochs must be an integer >= 1, got 0"),
        ("num_minibatches=3", "num_envs=256 must be a multiple of num_minibatches=3"),
    ],
    "dqn": [
        ("gamma=0", "gamma must be a number > 0, got 0"),
        ("n_steps=0", "n_steps must be an integer >= 1, got 0"),
        ("buffer_size=0", "buffer_size must be an integer >= 1, got 0"),
        ("batch_size=0", "batch_size must be an integer >= 1, got 0"),
        ("num_updates=0", "num_updates must be an integer >= 1, got 0"),
        ("target_update_interval=0", "target_update_interval must be an integer >= 1, got 0"),
        ("annealing_num_steps=0", "annealing_num_steps must be an integer >= 1, got 0"),
        ("eps_init=2", r"eps_init must be in \[0, 1\], got 2"),
        ("eps_init=0.01", "eps_end must be <= eps_init=0.01, got 0.05"),
        ("replay_on_task_change=drop", "replay_on_task_change must be one of clear, keep, got 'drop'"),
    ],
}


@pytest.mark.parametrize(
    ("name", "override", "message"),
    [(name, *bad) for name in AGENTS for bad in BAD_VALUES + BAD_VALUES_OF[name]],
)
def test_a_hyperparameter_out_of_range_is_refused_by_name(build_agent, name, override, message):
    with pytest.raises(ValueError, match=message):
        build_agent(name, [ct_su_b1()], f"agent.{override}")


# LSTM-PPO


def values_in_loss(agent, batch):
    """The critic's values while the loss of a batch is computed: the trunk runs over whole sequences."""
    keys = (*agent.policy.in_keys, "action", "action_log_prob")
    zeros = torch.zeros(*batch.batch_size, 1)
    values = []
    hook = agent.critic.module.register_forward_hook(lambda module, given, value: values.append(value.detach()))
    agent.loss(batch.select(*keys).clone().set("advantage", zeros).set("value_target", zeros))
    hook.remove()
    return values[-1]


def test_lstm_ppo_remembers_the_same_step_by_step_and_over_whole_sequences(small_agent):
    agent = small_agent("lstm_ppo", [ct_su_b1()])

    for batch in batches(agent, ct_su_b1(), 2):
        over_sequences = values_in_loss(agent, batch)

        assert batch["is_init"][:, 1:].any()
        torch.testing.assert_close(over_sequences, batch["state_value"], atol=1e-6, rtol=0)


def test_lstm_ppo_forgets_where_an_episode_starts_in_a_sequence(small_agent):
    agent = small_agent("lstm_ppo", [ct_su_b1()])
    batch = batches(agent, ct_su_b1(), 1)[0]
    row, step = (batch["is_init"][:, 1:-1, 0].nonzero()[0] + torch.tensor([0, 1])).tolist()
    fresh = batch[row : row + 1, step:].clone()
    for key in agent.initial_state(1).keys():  # noqa: SIM118
        fresh[key] = torch.zeros_like(fresh[key])

    after_reset = values_in_loss(agent, batch)[row, step:]

    torch.testing.assert_close(after_reset, values_in_loss(agent, fresh)[0], atol=1e-6, rtol=0)


def test_lstm_ppo_forgets_where_an_episode_starts_while_acting(small_agent):
    agent = small_agent("lstm_ppo", [ct_su_b1()])
    data = CTGraphEnv([ct_su_b1()] * 3).reset().update(agent.initial_state(3))
    stale = data.clone().update({key: data[key] + 1 for key in agent.initial_state(3).keys()})  # noqa: SIM118
    running = stale.clone().update({"is_init": torch.zeros(3, 1, dtype=torch.bool)})

    with torch.no_grad(), set_exploration_type(GREEDY):
        expected, reset, kept = (agent.policy(start)["state_value"] for start in (data, stale, running))

    assert torch.equal(reset, expected)
    assert not torch.equal(kept, expected)


def test_lstm_ppo_remembers_within_an_episode(small_agent):
    agent = small_agent("lstm_ppo", [ct_su_b1()])
    batch = batches(agent, ct_su_b1(), 1)[0]
    changed = batch.clone()
    changed["observation"][:, 0] = 255 - changed["observation"][:, 0]

    difference = (values_in_loss(agent, batch) - values_in_loss(agent, changed)).abs()[..., 0]

    same_episode = batch["is_init"][..., 0].cumsum(dim=1) == 1
    assert (difference[same_episode] > 0).all()
    assert (difference[~same_episode] == 0).all()


def test_lstm_ppo_advantages_equal_the_generalised_estimate_by_hand(small_agent):
    sizes = ["agent.num_envs=3", "agent.num_steps=2", "agent.num_minibatches=1", "agent.num_epochs=1"]
    agent = small_agent("lstm_ppo", [ct_su_b1()], *sizes, "agent.gamma=0.5", "agent.gae_lambda=0.25")
    batch = batches(agent, ct_su_b1(), 1)[0]
    ended = torch.tensor([[False, False], [True, False], [False, True]]).unsqueeze(-1)
    batch["state_value"] = torch.tensor([1.0, 2.0]).expand(3, 2).unsqueeze(-1).clone()
    batch["next", "reward"] = torch.tensor([0.0, 1.0]).expand(3, 2).unsqueeze(-1).clone()
    batch["next", "done"], batch["next", "terminated"] = ended, ended.clone()
    batch["row"] = torch.arange(3).unsqueeze(-1).expand(3, 2)
    head = agent.critic.module
    torch.nn.init.zeros_(head.weight)
    torch.nn.init.constant_(head.bias, 4.0)  # the value after the last step

    agent._minibatches = lambda batch: (torch.arange(3),)
    learnt = learnt_from(agent, batch)[0]

    # Running on: 1 + 0.5 * 4 - 2 = 1, and (0 + 0.5 * 2 - 1) + 0.125 * 1 = 0.125.
    # Ended by the first step: 0 - 1 = -1, then as above. Ended by the last: 1 - 2 = -1, and 0 + 0.125 * -1 = -0.125.
    expected = torch.tensor([[0.125, 1.0], [-1.0, 1.0], [-0.125, -1.0]]).unsqueeze(-1)
    torch.testing.assert_close(learnt["advantage"], expected, atol=1e-6, rtol=0)
    torch.testing.assert_close(learnt["value_target"], expected + batch["state_value"], atol=1e-6, rtol=0)


def test_lstm_ppo_learns_from_every_row_once_in_every_epoch(small_agent):
    agent = small_agent("lstm_ppo", [ct_su_b1()], "agent.num_epochs=3", "agent.num_minibatches=4")
    batch = batches(agent, ct_su_b1(), 1)[0]
    logged = batch["action_log_prob"].sum().item()

    seen = learnt_from(agent, batch)

    assert [tuple(minibatch.batch_size) for minibatch in seen] == [(4, 8)] * 12
    epochs = [sum(m["action_log_prob"].sum().item() for m in seen[i : i + 4]) for i in (0, 4, 8)]
    assert epochs == pytest.approx([logged] * 3, rel=1e-5)


# DQN


def test_dqn_does_not_explore_when_greedy(small_agent):
    agent = small_agent("dqn", [ct_su_b1()], "agent.eps_init=1")
    data = CTGraphEnv([ct_su_b1()] * 200).reset()

    with set_exploration_type(GREEDY):
        greedy = agent.policy(data.clone())["action"]
    with set_exploration_type(SAMPLED):
        sampled = agent.policy(data.clone())["action"]

    best = agent.greedy(data.clone())["action_value"].argmax(dim=-1)
    assert torch.equal(greedy, best)
    assert set(sampled.tolist()) == {0, 1, 2}


def test_dqn_evaluated_greedily_plays_every_episode_alike_where_nothing_is_random(small_agent):
    agent = small_agent("dqn", [ct_su_b1()], "agent.eps_init=1")

    greedy, sampled = (evaluate(agent.policy, [ct_su_b1()], 500, greedy=choice) for choice in (True, False))

    assert greedy["step_count"].unique().numel() == 1
    assert sampled["step_count"].unique().numel() > 1
    assert not (greedy["outcome"] == OUTCOME_GOAL).all()


@pytest.mark.parametrize(("setting", "kept"), [("clear", 0), ("keep", 128)])
def test_dqn_clears_or_keeps_its_replay_at_a_task_change(small_agent, setting, kept):
    agent = small_agent("dqn", [ct_su_b1()], f"agent.replay_on_task_change={setting}")
    agent.start_task()
    agent.learn(batches(agent, ct_su_b1(), 1)[0])
    stored = len(agent.replay)

    agent.end_task()
    agent.start_task()

    assert (stored, len(agent.replay)) == (128, kept)


def test_dqn_explores_less_with_every_batch_and_anew_in_every_task(small_agent):
    agent = small_agent("dqn", [ct_su_b1()], "agent.annealing_num_steps=512", "agent.eps_end=0.2")
    agent.start_task()

    explored = [agent.learn(batch)["exploration"] for batch in batches(agent, ct_su_b1(), 6)]
    agent.start_task()

    assert explored == pytest.approx([0.8, 0.6, 0.4, 0.2, 0.2, 0.2])
    assert agent.exploration.eps.item() == 1.0


def test_dqn_copies_to_its_target_network_once_in_every_interval_of_gradient_steps(small_agent):
    agent = small_agent("dqn", [ct_su_b1()], "agent.target_update_interval=4", "agent.num_updates=12")
    step, targets = agent.gradient_step, []

    def target_network():
        return agent.dqn.target_value_network_params.clone()

    agent.gradient_step = lambda batch: (targets.append(target_network()), step(batch))[1]
    agent.learn(batches(agent, ct_su_b1(), 1)[0])
    targets.append(target_network())

    changed = [i for i in range(1, 13) if not (targets[i] == targets[i - 1]).all()]
    assert changed == [4, 8, 12]


def test_dqn_targets_near_the_end_of_an_episode_are_its_rewards_and_nothing_after_it(small_agent):
    """From two steps before a terminal state, a target of six steps is the discounted reward; no value is added."""
    agent = small_agent("dqn", [ONE_HOT_TASK], "agent.num_steps=4", "agent.gamma=0.5", "agent.n_steps=6")
    env = CTGraphEnv([ONE_HOT_TASK] * 16)

    def solve(data):
        return data.set("action", 3 * data["observation"][..., 2].long())

    agent.learn(next(collect(env, solve, 64, 4)))

    stored = agent.replay[:].view(16, 4)[0]
    assert stored["next", "reward"].flatten().tolist() == [0.125, 0.25, 0.5, 1.0]
    assert stored["steps_to_next_obs"].flatten().tolist() == [4, 3, 2, 1]
    assert stored["next", "terminated"].flatten().tolist() == [True] * 4


def test_dqn_targets_of_one_step_are_the_transitions_themselves(small_agent):
    agent = small_agent("dqn", [ct_su_b1()], "agent.n_steps=1")
    batch = batches(agent, ct_su_b1(), 1)[0]

    agent.learn(batch)

    stored, flat = agent.replay[:], batch.reshape(-1)
    for key in ("observation", "action", ("next", "observation"), ("next", "reward"), ("next", "terminated")):
        assert torch.equal(stored[key], flat[key])
