"""A navigating policy acts in an agent's place in a share of the first episodes, and the agent learns from it."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import pytest
import torch

import curricula
from ctgraph_rl import CTGraphEnv, RunLog, learn_curriculum
from ctgraph_rl.learn.collect import collect
from ctgraph_rl.learn.guide import Guide, guided_share
from ctgraph_rl.learn.refusals import why_not_together
from ctgraph_rl.policies import RandomPolicy
from ctgraph_rl.tasks.protocol import Protocol
from curricula.paper import ct_su_b1

FAIL = 1
"""The ``outcome`` of an episode that ended in the fail state."""


def short_curriculum(guide_frames: int):
    given = curricula.load("co_hard", num_frames=512)
    evaluation = replace(given.evaluation, num_episodes=2, before=False)
    return replace(given, evaluation=evaluation, protocol=Protocol(guide_frames=guide_frames))


def test_the_share_of_guided_episodes_falls_from_1_to_0():
    assert [guided_share(frames, 400) for frames in (0, 100, 400, 500)] == [1.0, 0.75, 0.0, 0.0]
    assert guided_share(0, 0) == 0.0


@pytest.mark.parametrize("name", ["drqn", "lstm_ppo", "ppo", "dqn"])
def test_an_agent_takes_the_guides_actions_and_writes_what_they_are_to_its_own_policy(name, small_agent):
    agent = small_agent(name, [ct_su_b1()])
    env = CTGraphEnv([ct_su_b1()] * agent.num_envs)
    guide = Guide(agent.policy, env, 10**9)

    batch = next(collect(env, guide, 8 * agent.num_envs, 8, agent.initial_state))

    assert batch["next", "done"].any() and not (batch["next", "outcome"] == FAIL).any()
    assert "guided_action" not in batch.keys()  # noqa: SIM118
    if "action_log_prob" in batch.keys():  # noqa: SIM118
        log_probs = agent.outputs(batch)["log_probs"].gather(-1, batch["action"].unsqueeze(-1)).squeeze(-1)
        torch.testing.assert_close(batch["action_log_prob"], log_probs, atol=1e-5, rtol=0)


def test_a_guide_acts_through_its_share_of_the_episodes():
    env = CTGraphEnv([ct_su_b1()] * 4000)
    guide = Guide(lambda data: data.set("action", data.get("guided_action")), env, 100)
    guide.frames = 75

    with pytest.raises(ValueError, match=r"method does not take .*: set protocol.guide_frames=0"):
        Guide(RandomPolicy(env).__call__, env, 100)(env.reset())
    first = guide(env.reset())
    guided = first["action"] >= 0
    second = guide(first.clone().set("is_init", torch.tensor([[True], [False]]).repeat(2000, 1)))

    assert 0.22 < guided.double().mean() < 0.28
    assert torch.equal((second["action"] >= 0)[1::2], guided[1::2])
    assert not torch.equal((second["action"] >= 0)[::2], guided[::2])


def test_a_guided_run_logs_the_share_and_is_resumed_bit_by_bit(small_agent):
    curriculum = short_curriculum(guide_frames=384)
    agents = [small_agent("lstm_ppo", curriculum.tasks, "agent.num_minibatches=2") for _ in range(2)]
    logs, states = (RunLog(), RunLog()), []

    def checkpoint(state, at_end):
        states.append(deepcopy(state()))

    torch.manual_seed(1)
    learn_curriculum(curriculum, agents[0], 7, logs[0], checkpoint=checkpoint)
    for line in logs[0].measurements[:1]:
        logs[1].append(**line)
    learn_curriculum(curriculum, agents[1], 7, logs[1], saved=states[0])

    trained = logs[0].of_kind("training")
    assert [line["guided_share"] for line in trained] == pytest.approx([1, 2 / 3, 1 / 3, 0])
    assert [one["return_mean"] for one in logs[1].of_kind("training")][-1] == trained[-1]["return_mean"]
    assert all(torch.equal(*pair) for pair in zip(*(agent.parameters() for agent in agents), strict=True))


def test_a_guided_curriculum_is_another_one_and_its_seeds_learn_one_after_the_other():
    plain, guided = (short_curriculum(frames) for frames in (0, 384))

    assert plain.fingerprint != guided.fingerprint
    assert why_not_together(plain) is None
    assert "guide" in why_not_together(guided)
    with pytest.raises(ValueError, match="guide_frames must be an integer >= 0, got -1"):
        Protocol(guide_frames=-1)
