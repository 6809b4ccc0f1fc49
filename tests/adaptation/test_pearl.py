"""PEARL: posteriors and losses by hand and against TorchRL's, what a row remembers, and that goals are found."""

from __future__ import annotations

import math
from copy import deepcopy
from dataclasses import replace
from functools import partial

import pytest
import torch
from helpers.scripted import ONE, TWO
from helpers.small_agents import GREEDY, SAMPLED, saved_and_loaded
from helpers.stopped_runs import logs_of_equal_ends
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs.utils import set_exploration_type
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import DiscreteSACLoss
from torchrl.objectives.utils import ValueEstimators

from baselines.pearl import CONTEXT, PEARL, PRECISION, WEIGHTED, gaussian, kl_to_prior
from ctgraph_rl import Block, CTGraphEnv, Curriculum, Evaluation, learn_curriculum
from ctgraph_rl.learn.collect import collect
from ctgraph_rl.runs.train import new_agent
from curricula.axes import all_goals
from curricula.published import full_mdp

CURRICULUM = Curriculum("goals", 1, "here", (Block((ONE, TWO), 960),), Evaluation(8, greedy=False, episodes_per_row=4))

SETTINGS = {
    "num_envs": 12,
    "num_steps": 20,
    "hidden_size": 8,
    "num_layers": 1,
    "num_context": 2,
    "trial_episodes": 4,
    "learning_rate": 0.01,
    "gamma": 0.9,
    "entropy_coeff": 0.1,
    "reward_scale": 5.0,
    "kl_coeff": 0.1,
    "buffer_size": 360,
    "num_trials": 6,
    "context_size": 8,
    "batch_size": 7,
    "num_updates": 3,
    "target_rate": 0.2,
    "max_grad_norm": 10.0,
    "gate": "none",
    "gate_size": 4,
}


def made(seed: int = 0, **changes) -> PEARL:
    return new_agent(CURRICULUM, partial(PEARL, **{**SETTINGS, **changes}), seed)


def played(agent, steps: int = 20, seed: int = 0):
    """A batch of an agent, in tasks in which failing costs, so that steps have different rewards."""
    env = CTGraphEnv([replace(each, fail_reward=-0.5) for each in (ONE, TWO)] * 6, seed=seed)
    torch.manual_seed(seed)
    return next(collect(env, agent.policy, 12 * steps, steps, agent.initial_state))


def minibatch(agent):
    return next(agent.minibatches(played(agent)))


class ByHand(nn.Module):
    """Of a step with reward r: mu_i = (r, 2 r) and s_i = 1 + r."""

    def forward(self, observation, action, reward):
        raw = (1 + reward).expm1().log().expand(*reward.shape[:-1], 2)
        return torch.cat([reward, 2 * reward, raw], dim=-1)


@pytest.mark.parametrize(
    ("rewards", "mean", "variance"),
    [([1.0], [1, 2], 2), ([0.0, 1.0], [1 / 3, 2 / 3], 2 / 3), ([1.0, 1.0], [1, 2], 1)],
)
def test_a_posterior_of_one_and_of_two_steps_is_that_by_hand(rewards, mean, variance):
    agent = made()
    agent.policy.encoder = ByHand()
    number = len(rewards)
    context = {
        "observation": torch.zeros(1, number, 5),
        "action": torch.zeros(1, number, dtype=torch.int64),
        ("next", "reward"): torch.tensor(rewards).view(1, number, 1),
    }

    found = agent.posterior({("context", key): value for key, value in context.items()})

    torch.testing.assert_close(found[0], torch.tensor([mean], dtype=torch.float32))
    torch.testing.assert_close(found[1], torch.full((1, 2), float(variance)))


def test_without_a_step_the_posterior_is_the_prior():
    mean, variance = gaussian(torch.zeros(3), torch.zeros(3))

    assert mean.tolist() == [0, 0, 0] and variance.tolist() == [1, 1, 1]


def test_the_divergence_from_the_prior_is_that_by_hand():
    mean = torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])
    variance = torch.tensor([[1.0, 1.0], [1.0, math.e], [0.5, 1.0]])

    found = kl_to_prior(mean, variance)

    last = (0.5 + 4 - 1 + math.log(2)) / 2
    torch.testing.assert_close(found, torch.tensor([0.0, 0.5 + (math.e - 2) / 2, last]))


def test_a_row_adds_up_the_steps_of_its_trial_and_nothing_earlier():
    agent = made()
    batch = played(agent)
    begins = batch["is_init"].squeeze(-1) & (batch["next", "trial"].squeeze(-1) == 1)
    trial = begins.cumsum(dim=1)
    assert trial.max() >= 3 and batch["next", "trial"].max() == 4

    seen = (batch["observation"],)
    with torch.no_grad():
        evidence = agent.policy.evidence(seen, batch["action"], batch["next", "reward"])

    its = (trial == trial[:, -1:]).unsqueeze(-1)
    its[:, -1] = False  # the last step's reward comes after it
    for key, each in zip((PRECISION, WEIGHTED), evidence, strict=True):
        torch.testing.assert_close(batch["next", key][:, -1], (each * its).sum(dim=1), rtol=1e-4, atol=1e-5)


def test_a_guess_is_drawn_from_the_posterior_before_each_episode_and_lasts_for_it():
    agent = made()
    state = agent.initial_state(2000)
    agent.policy.encoder = ByHand()
    state["trial"][:] = 1
    state[PRECISION][:], state[WEIGHTED][:] = 0.5, 0.5  # of a step with reward 1; another one follows
    state["reward"][:] = 1
    state["observation"] = torch.zeros(2000, 5, dtype=torch.uint8)
    torch.manual_seed(0)

    def guesses(begins: bool):
        return agent.policy(state.clone().set("is_init", torch.full((2000, 1), begins)))["next", CONTEXT]

    with torch.no_grad():
        drawn = guesses(True)
        assert torch.equal(guesses(False), state[CONTEXT])

    torch.testing.assert_close(drawn[:, 0].mean().item(), 1.0, atol=0.1, rtol=0)  # 4 deviations of a mean
    torch.testing.assert_close(drawn[:, 1].mean().item(), 1.5, atol=0.1, rtol=0)
    torch.testing.assert_close(drawn.var(dim=0), torch.ones(2), atol=0.13, rtol=0)


# Learning


def numbered(agent, steps: int = 20, seed: int = 0):
    """A batch in which the reward is the number of the step's trial, different in all rows."""
    batch = played(agent, steps, seed)
    begins = batch["is_init"] & (batch["next", "trial"] == 1)
    row = torch.arange(12).view(-1, 1, 1)
    batch["next", "reward"] = (100.0 * row + begins.cumsum(dim=1)).float() + 0.5 * seed
    return batch


def test_a_context_and_the_steps_beside_it_are_of_one_trial_and_all_trials_are_drawn():
    agent = made(num_updates=200)
    batch = numbered(agent)

    drawn = list(agent.minibatches(batch))

    for each in drawn:
        rewards = torch.cat([each["next", "reward"], each["context", ("next", "reward")]], dim=1)
        assert rewards.shape == (6, 15, 1)
        assert (rewards == rewards[:, :1]).all()
    found = torch.cat([each["next", "reward"][:, 0, 0] for each in drawn])
    assert set(found.tolist()) == set(batch["next", "reward"].flatten().tolist())


def test_replay_keeps_the_last_steps_of_all_rows():
    agent = made()

    batches = [numbered(agent, seed=seed) for seed in range(2)]
    for batch in batches:
        next(agent.minibatches(batch))

    both = torch.cat([batch["next", "reward"] for batch in batches], dim=1)
    assert torch.equal(agent.replay["next", "reward"], both[:, -30:])


def test_the_losses_are_those_of_torchrl():
    agent = made()
    for critic in (*agent.targets, *agent.critics):
        nn.init.normal_(critic.output.weight)
    batch = minibatch(agent)
    mean, variance = agent.posterior(batch)
    context = (mean + variance.sqrt() * batch["noise"]).detach().unsqueeze(1).expand(-1, 7, -1)
    actor = TensorDictModule(deepcopy(agent.policy.actor), ["observation", "context"], ["logits"])
    actor = ProbabilisticActor(actor, ["logits"], distribution_class=torch.distributions.Categorical)
    critic = TensorDictModule(deepcopy(agent.critics[0]), ["observation", "context"], ["action_value"])
    theirs = DiscreteSACLoss(
        actor,
        critic,
        action_space="categorical",
        num_actions=3,
        loss_function="l2",
        alpha_init=0.1,
        fixed_alpha=True,
    )
    theirs.make_value_estimator(ValueEstimators.TD0, gamma=0.9)
    for ours, params in (
        (agent.critics, theirs.qvalue_network_params),
        (agent.targets, theirs.target_qvalue_network_params),
    ):
        for name, value in ours[0].named_parameters():
            place = ("module", *name.split("."))
            params.data[place].copy_(torch.stack([value, dict(ours[1].named_parameters())[name]]).detach())
    data = {key: value for key, value in batch.items() if key == "action" or key[0] == "next" or key == "observation"}
    data[("next", "reward")] = 5 * batch["next", "reward"]
    data |= {("next", "done"): batch["next", "terminated"], "context": context, ("next", "context"): context}
    expected = theirs(TensorDict(data, batch_size=[6, 7]))

    found = agent.loss(batch)

    torch.testing.assert_close(found["loss_value"], expected["loss_qvalue"])
    torch.testing.assert_close(found["loss_policy"], expected["loss_actor"])
    torch.testing.assert_close(found["entropy"], expected["entropy"])
    torch.testing.assert_close(found["loss_context"], 0.1 * kl_to_prior(mean, variance).mean())


def test_the_policys_loss_trains_the_policy_alone_and_the_critics_the_encoder():
    agent = made()
    losses = agent.loss(minibatch(agent))

    def trained(loss: str) -> list[bool]:
        parts = (agent.policy.encoder, agent.policy.actor, agent.critics)
        found = [
            torch.autograd.grad(losses[loss], list(p.parameters()), allow_unused=True, retain_graph=True) for p in parts
        ]
        return [any(gradient is not None and bool(gradient.any()) for gradient in gradients) for gradients in found]

    assert trained("loss_value") == [True, False, True]
    assert trained("loss_policy") == [False, True, False]
    assert trained("loss_context") == [True, False, False]


def test_target_critics_follow_by_a_share_of_the_way():
    agent = made(num_updates=1)
    before = [value.clone() for value in agent.targets.parameters()]

    agent.learn(played(agent))

    for old, new, online in zip(before, agent.targets.parameters(), agent.critics.parameters(), strict=True):
        torch.testing.assert_close(new, old + 0.2 * (online.detach() - old))
        assert not torch.equal(new, old)


@pytest.mark.parametrize("gate", ["soft", "hard"])
def test_gates_modulate_the_policy_alone(gate):
    agent = made(gate=gate)
    before = {name: value.clone() for name, value in agent.named_parameters()}

    agent.learn(played(agent))

    modulators = [name for name in before if "modulator" in name]
    changed = [name for name, value in agent.named_parameters() if not torch.equal(value, before[name])]
    assert modulators and all(name.startswith("policy.actor.") for name in modulators)
    assert changed == [name for name in before if gate == "soft" or name not in modulators]


# As runs


def test_a_policy_reads_and_writes_its_state_and_nothing_else():
    agent = made()
    data = played(agent)[:, -1].select(*agent.policy.in_keys)

    with torch.no_grad():
        written = agent.policy(data.clone())

    state = {("next", key) for key in agent.initial_state(1).keys()} - {("next", "reward")}  # noqa: SIM118
    assert set(agent.policy.in_keys) == {"observation", "is_init", *agent.initial_state(1).keys()}
    assert set(written.keys(True, True)) - set(data.keys(True, True)) == {"action"} | state


def test_a_saved_agent_acts_the_same_after_loading():
    agent, other = made(), made(seed=1)
    agent.learn(played(agent))

    other.load_state_dict(saved_and_loaded(agent.state_dict()))

    for exploration in (GREEDY, SAMPLED):
        with set_exploration_type(exploration):
            assert torch.equal(played(agent)["action"], played(other)["action"])


def test_a_run_resumes_as_if_it_had_not_stopped(tmp_path):
    logs = logs_of_equal_ends(CURRICULUM, made, tmp_path)

    losses = [log.training("loss_value") for log in logs]
    assert losses[0].isfinite().all()
    assert all(torch.equal(other, losses[0]) for other in losses[1:])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gate": "hrad"}, "gate must be one of none, soft, hard, hard_straight_through, got 'hrad'"),
        ({"target_rate": 0}, "target_rate must be"),
        ({"buffer_size": 11}, "buffer_size must be at least a step of each of num_envs=12 rows, got 11"),
    ],
)
def test_settings_that_cannot_be_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        made(**changes)


def test_what_nothing_can_adapt_to_is_refused_before_any_work():
    alone = replace(CURRICULUM, blocks=(Block(ONE, 960),))
    short = replace(CURRICULUM, evaluation=Evaluation(8, greedy=False))

    with pytest.raises(ValueError, match="PEARL learns to adapt to tasks that are drawn, and block 1 has one task"):
        new_agent(alone, partial(PEARL, **SETTINGS), 0)
    with pytest.raises(
        ValueError, match=r"evaluation have 1 episodes, and PEARL adapts after 1: set evaluation\.adapt"
    ):
        new_agent(short, partial(PEARL, **SETTINGS), 0)


@pytest.mark.slow
def test_at_depth_1_it_searches_as_well_as_can_be():
    goals = all_goals(full_mdp("0", 1, one_hot=True))  # each end state has its own observation
    how = Evaluation(160, greedy=False, before=False, episodes_per_row=4, adapt_episodes=4)
    curriculum = replace(CURRICULUM, blocks=(Block(goals, 19_200),), evaluation=how)
    settings = {
        "num_envs": 20,
        "num_steps": 16,
        "hidden_size": 32,
        "num_layers": 2,
        "num_context": 5,
        "trial_episodes": 8,
        "learning_rate": 0.001,
        "gamma": 0.95,
        "buffer_size": 20_000,
        "num_trials": 16,
        "context_size": 16,
        "batch_size": 16,
        "num_updates": 16,
        "target_rate": 0.005,
    }
    agent = new_agent(curriculum, partial(PEARL, **{**SETTINGS, **settings}), 0)
    torch.manual_seed(0)

    log = learn_curriculum(curriculum, agent)

    returns = torch.tensor([line["return_mean"] for line in log.measurements if line["kind"] == "adaptation"])
    of_episodes = returns.view(2, 8).mean(dim=0)
    assert 0.3 < of_episodes[0] < 0.65  # of 80 rows: no one finds one of two goals more often than by chance
    assert of_episodes[1] > 0.85
    assert of_episodes[2:].min() >= 0.95
