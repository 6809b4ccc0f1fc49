"""MOHQA: the Hebbian weights by hand, the published loss and its correction."""

from __future__ import annotations

import math
from copy import deepcopy
from types import SimpleNamespace

import pytest
import torch
from helpers.small_agents import GREEDY, batches, learnt_from
from torch.nn.functional import linear, one_hot
from torchrl.envs.utils import set_exploration_type

from baselines.mohqa import HebbianHead
from ctgraph_rl import CTGraphEnv, evaluate
from ctgraph_rl.learn.guide import GUIDED_ACTION
from curricula.paper import ct_fo_b1, ct_su_b1

DECAY = math.exp(-1 / 48)

Y = torch.tensor([[0.5, -0.9, 0.1, 0.8, -0.2, 0.3], [0.2, 0.1, -0.5, 0.0, 0.4, 0.0]])
"""Six features that are not zero, and four."""

THETA = [[0.0, -0.3, 0.0, 0.3, 0.0, 0.0], [0.0, 0.0, -0.3, 0.0, 0.3, 0.0]]


def head(num_actions: int = 3, num_features: int = 6) -> HebbianHead:
    settings = SimpleNamespace(
        num_features=num_features,
        eligibility_steps=48,
        hebbian_share=0.13,
        hebbian_change=0.3,
        hebbian_decay=0.005,
        reward_baseline=0.001,
    )
    return HebbianHead(settings, num_actions)


def theta(action: int, row: list[float]) -> torch.Tensor:
    """The change of eligibility by an action: features with no change of their own fall by 0.005."""
    change = torch.zeros(3, 6)
    change[action] = torch.tensor([each or -0.005 for each in row])
    return change


def test_eligibility_is_the_decayed_sum_of_the_changes_by_hand():
    hebbian, eligibility = head(), torch.zeros(2, 3, 6)

    for actions in ([0, 2], [1, 2], [0, 1]):
        eligibility = hebbian.eligibility(eligibility, Y, torch.tensor(actions))

    first = theta(0, THETA[0]) * (DECAY**2 + 1) + theta(1, THETA[0]) * DECAY
    second = theta(2, THETA[1]) * (DECAY**2 + DECAY) + theta(1, THETA[1])
    torch.testing.assert_close(eligibility, torch.stack([first, second]))


@pytest.mark.parametrize("features, raised", [(16, 3), (7, 1), (8, 2)])
def test_thirteen_percent_of_the_features_rise_and_as_many_fall(features, raised):
    y = torch.randn(1, features, generator=torch.Generator().manual_seed(0))

    (row,) = head(1, features).eligibility(torch.zeros(1, 1, features), y, torch.tensor([0]))[0]

    assert torch.equal(row > 0, y[0] >= y[0].topk(raised).values.min())
    assert torch.equal(row == -0.3, y[0] <= -(-y[0]).topk(raised).values.min())
    assert (row == -0.005).sum() == features - 2 * raised


def test_weights_change_by_the_sign_of_the_reward_times_eligibility_and_stay_within_one():
    hebbian, eligibility = head(), 0.5 * torch.ones(1, 3, 3, 6)
    given = [[5.0], [0.0], [-0.1]]

    for number, after in enumerate([0.999 * 0.5, 0.998 * 0.5, 0.998 * 0.5 - 1.001 * 0.5]):
        hebbian.modulate(eligibility[:, :1], torch.tensor([[given[number]]]))
        torch.testing.assert_close(hebbian.weights, torch.full((3, 6), after))
    hebbian.modulate(eligibility, torch.ones(1, 3, 1))

    assert torch.equal(hebbian.weights, torch.ones(3, 6))


def test_many_environments_change_the_weights_by_their_sum_and_a_batch_in_the_order_of_time():
    torch.manual_seed(0)
    one, other = head(), head()
    eligibility, reward = torch.randn(2, 4, 3, 6), torch.randn(2, 4, 1)

    one.modulate(eligibility, reward)
    for step in range(4):
        change = sum((reward[row, step].sign() - 0.001) * eligibility[row, step] for row in range(2))
        other.weights.copy_((other.weights + change).clamp(-1, 1))

    torch.testing.assert_close(one.weights, other.weights)


def test_the_policy_acts_on_the_sum_of_both_networks_and_writes_its_state(small_agent):
    agent = small_agent("mohqa", [ct_su_b1()], "agent.average_decay=0.9")
    agent.hebbian.weights.normal_(0, 3, generator=torch.Generator().manual_seed(0))
    data = batches(agent, ct_su_b1(), 1)[0][:, 3]
    assert data["is_init"].any() and not data["is_init"].all() and data["average"].any()

    with set_exploration_type(GREEDY), torch.no_grad():
        written, features = agent.policy(data.clone()), agent.policy.features(data)
        y = (features - data["average"]).tanh()
        values = agent.policy.head(features) + linear(y, agent.hebbian.weights).sigmoid()

    assert torch.equal(written["action"], values.argmax(dim=-1))
    torch.testing.assert_close(written["next", "average"], 0.9 * data["average"] + 0.1 * features)
    before = torch.where(data["is_init"].unsqueeze(-1), 0.0, data["eligibility"])
    expected = agent.hebbian.eligibility(before, y, written["action"])
    torch.testing.assert_close(written["next", "eligibility"], expected)


def test_a_guided_action_is_taken_and_is_what_becomes_eligible(small_agent):
    agent = small_agent("mohqa", [ct_su_b1()])
    data = CTGraphEnv([ct_su_b1()] * 3).reset().update(agent.initial_state(3))

    with set_exploration_type(GREEDY), torch.no_grad():
        own = agent.policy(data.clone())["action"]
        given = torch.tensor([(own[0] + 1) % 3, -1, (own[2] + 2) % 3])
        written = agent.policy(data.set(GUIDED_ACTION, given))

    taken = torch.where(given < 0, own, given)
    assert torch.equal(written["action"], taken)
    assert torch.equal(written["next", "eligibility"].any(dim=-1), one_hot(taken, 3).bool())


@pytest.mark.parametrize("predict_sum", [False, True])
def test_the_target_is_the_sum_of_both_networks_and_the_prediction_only_where_corrected(small_agent, predict_sum):
    agent = small_agent("mohqa", [ct_su_b1()], f"agent.predict_sum={predict_sum}", "agent.gamma=0.6")
    for batch in batches(agent, ct_su_b1(), 2):
        minibatch = learnt_from(agent, batch)[0]
    agent.hebbian.weights.normal_(generator=torch.Generator().manual_seed(1))
    agent.target_weights.normal_(generator=torch.Generator().manual_seed(2))

    loss = agent.loss(minibatch)["loss_value"]

    def both(learner, data, average, weights):
        features = learner.policy.features(data)
        return learner.policy.head(features), linear((features - average).tanh(), weights).sigmoid()

    q, u = both(agent, minibatch, minibatch["average"], agent.hebbian.weights)
    later = deepcopy(agent)
    later.greedy.load_state_dict(agent.target.state_dict())
    after = {"observation": minibatch["next", "observation"]}
    target_q, target_u = both(later, after, minibatch["next", "average"], agent.target_weights)
    running = ~minibatch["next", "terminated"].squeeze(-1)
    target = minibatch["next", "reward"].squeeze(-1) + 0.6 * running * (target_q + target_u).amax(dim=-1)
    predicted = (q + u if predict_sum else q).gather(-1, minibatch["action"].unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(loss, (predicted - target.detach()).square().mean())
    gradients = torch.autograd.grad(loss, list(agent.policy.greedy.parameters()))
    of_q = torch.autograd.grad(
        (predicted - target).detach() @ (2 * q.gather(-1, minibatch["action"].unsqueeze(-1))).squeeze(-1) / len(q),
        list(agent.policy.greedy.parameters()),
    )
    torch.testing.assert_close(gradients, of_q)


def test_the_copy_of_the_hebbian_weights_is_as_old_as_the_target_network(small_agent):
    settings = ["agent.target_update_interval=3", "agent.num_updates=1", "agent.hebbian_decay=0.5"]
    agent = small_agent("mohqa", [ct_su_b1()], *settings)
    start = agent.hebbian.weights.clone()

    copies = []
    for batch in batches(agent, ct_su_b1(), 4):
        agent.learn(batch)
        online = [value.clone() for value in agent.policy.greedy.parameters()]
        copied = list(agent.target.parameters())
        copies.append((torch.equal(agent.target_weights, agent.hebbian.weights), all(map(torch.equal, copied, online))))

    assert [each[0] for each in copies] == [each[1] for each in copies] == [False, False, True, False]
    assert not torch.equal(agent.hebbian.weights, start)


def test_evaluation_changes_no_weight_and_starts_with_the_average_of_learning(small_agent):
    agent = small_agent("mohqa", [ct_fo_b1()])
    agent.learn(batches(agent, ct_fo_b1(), 1)[0])
    before = agent.hebbian.weights.clone()

    evaluate(agent.policy, [ct_fo_b1()], 4, initial_state=agent.initial_state, greedy=False)

    assert before.any() and torch.equal(agent.hebbian.weights, before)
    assert agent.average.any() and torch.equal(agent.initial_state(2)["average"], agent.average.expand(2, -1))
