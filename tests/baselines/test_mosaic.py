"""MOSAIC: who offers a mask to whom, and what becomes of it, by hand."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from helpers.kill_runs import equal
from helpers.scripted import ONE, TWO, of
from helpers.small_agents import MINIBATCHES, TINY, saved_and_loaded
from omegaconf import OmegaConf
from tensordict import TensorDict

from baselines.exchanges.mosaic import Mosaic
from ctgraph_rl import Block
from ctgraph_rl.learn.collective import Member, learn_collective
from ctgraph_rl.packages import conf_dir
from ctgraph_rl.runs.config import target
from ctgraph_rl.runs.train import new_agent, with_method

CURRICULA = [of(Block(task, 160), task_id="at_boundaries", num_task_ids=4) for task in (ONE, ONE, TWO)]

SMALL = {"every": 1, "num_members": 2, "top_n": 2, "num_samples": 6, "buffer_size": 8, "num_references": 3}


def mosaic(**settings: Any) -> Mosaic:
    stored = OmegaConf.to_container(OmegaConf.load(f"{conf_dir()}/exchange/mosaic.yaml"))
    del stored["_target_"]
    return Mosaic(**{**stored, **SMALL, **settings})


@pytest.fixture
def make(compose):
    """Makes members whose first task has begun."""

    def make(count=2, *overrides, start=True) -> list[Member]:
        settings = ["method=mask_shared", "method.backbone_seed=9157", "method.max_received=3", *overrides]
        cfg = compose("agent=ppo", *TINY, *MINIBATCHES, *settings)
        members = []
        for seed, curriculum in enumerate(CURRICULA[:count]):
            make_agent = with_method(target(cfg, "agent"), target(cfg, "method"), curriculum)
            members.append(Member(curriculum, new_agent(curriculum, make_agent, seed), seed))
            if start:
                members[-1].agent.start_task(0)
        return members

    return make


def connected(members: list[Member], **settings: Any) -> tuple[Mosaic, list[Any]]:
    """An exchange, and the methods of its members, whose scores are drawn again."""
    exchange = mosaic(num_members=len(members), **settings)
    exchange.connect([member.agent for member in members])
    methods = [member.agent.method for member in members]
    for method in methods:
        method.take_scores(torch.cat(method.initial_scores()))
    return exchange, methods


def batch(reward: float, seed: int = 0, scale: float = 1.0) -> TensorDict:
    """Eight transitions of one row; their images depend on the seed."""
    generator = torch.Generator().manual_seed(seed)
    given = {
        "observation": scale * torch.rand(1, 8, 5, generator=generator),
        "action": torch.zeros(1, 8, dtype=torch.int64),
        ("next", "reward"): torch.full((1, 8, 1), reward),
    }
    return TensorDict(given, [1, 8])


def scores(method) -> torch.Tensor:
    return torch.cat(list(method.current_scores())).detach().clone()


def exchanged(exchange: Mosaic) -> list[Any]:
    members = range(exchange.num_members)
    received = {number: [] for number in members}
    for kind in exchange.kinds:
        sent = [message for number in members for message in exchange.send(kind, number, received[number])]
        received = {number: [each for each in sent if each.receiver == number] for number in members}
    return [help for number in members for help in exchange.receive(number, received[number])]


def test_half_of_the_scores_of_a_member_without_a_return_are_those_of_its_only_peer(make):
    exchange, (own, peer) = connected(make(), num_samples=8)
    mine, its = scores(own), scores(peer)
    exchange.observe(0, batch(0.0), 0.0)
    exchange.observe(1, batch(0.0), 0.25)

    [given] = exchanged(exchange)

    assert (given.sender, given.receiver) == (1, 0)
    assert given.values == {
        **{"task_id": 0, "return_before": 0.0, "own_share": 0.5, "return_of_sender": 0.25},
        "similarity": pytest.approx(1, abs=1e-5),
    }
    torch.testing.assert_close(scores(own), (mine + its) / 2)
    masked = torch.where(mine + its >= 0, own.constant, 0.0)
    torch.testing.assert_close(own.weights.vector(), masked)
    assert torch.equal(scores(peer), its)


def test_a_member_that_nearly_solves_its_task_keeps_its_mask(make):
    exchange, (own, peer) = connected(make())
    mine = scores(own)
    own.take_scores(torch.where(mine >= 0, 0.2, -0.2))  # a share of 0.00005 of the peer's changes no sign
    before = own.weights.vector().clone()
    exchange.observe(0, batch(0.0), 0.99999)
    exchange.observe(1, batch(0.0), 1.0)

    [given] = exchanged(exchange)

    assert given.values["own_share"] == pytest.approx(0.99995)
    assert torch.equal(own.weights.vector(), before)
    assert not torch.equal(own.received[0], torch.zeros_like(mine))
    assert torch.equal(own.received[0], scores(peer))


def test_what_is_received_replaces_what_was_before_of_which_own_scores_keep_their_share(make):
    _, (own, *_) = connected(make())
    first, second, third = (torch.randn(len(own.weights)) for _ in range(3))
    mine = scores(own)

    own.receive(first[None], 0.75)
    own.receive(torch.stack([second, third]), 0.6)

    torch.testing.assert_close(scores(own), 0.6 * (0.75 * mine + 0.25 * first) + 0.2 * second + 0.2 * third)
    combination = scores(own)
    own.end_task()
    torch.testing.assert_close(scores(own), combination)
    torch.testing.assert_close(own.scores[0], combination)


def test_for_a_compiled_step_zeros_without_a_share_fill_up_what_was_received(make):
    plain, filled = (connected(make(2, f"agent.compile={flag}"))[1][0] for flag in ("false", "true"))
    received, mine = torch.randn(3, len(plain.weights)), torch.randn(len(plain.weights))
    gradients = [torch.randn(parameter.shape) for parameter in plain.weights.parameters]

    for method in (plain, filled):
        method.take_scores(mine)
        method.receive(received, 0.4)

    assert (len(plain.received), len(filled.received)) == (3, 4)
    torch.testing.assert_close(scores(filled), 0.4 * mine + 0.2 * received.sum(dim=0))
    torch.testing.assert_close(scores(filled), scores(plain))
    torch.testing.assert_close(*(method.transform_gradients(gradients, []) for method in (filled, plain)))
    assert torch.equal(filled.get_extra_state()["received"], received)


@pytest.mark.parametrize(
    ("change", "settings", "comes"),
    [
        ({}, {}, True),
        ({"reward": 0.5}, {}, False),
        ({"reward": 0.5}, {"use_return": False}, True),
        ({"seed": 1}, {"threshold": 0.999}, False),
        ({"seed": 1}, {"threshold": 0.999, "use_similarity": False}, True),
        ({}, {"num_samples": 9}, False),
    ],
    ids=["similar", "no better", "any return", "another task", "any task", "more samples than are kept"],
)
def test_a_mask_is_offered_by_who_does_better_in_a_similar_task(make, change, settings, comes):
    exchange, _ = connected(make(), **settings)
    exchange.observe(0, batch(0.0), 0.5)
    exchange.observe(1, batch(0.0, seed=change.get("seed", 0)), change.get("reward", 0.75))

    assert [(each.sender, each.receiver) for each in exchanged(exchange) if each.receiver == 0] == [(1, 0)] * comes


def test_the_embedding_moves_halfway_to_that_of_each_batch_and_begins_again_with_a_task(make):
    members = make()
    exchange, _ = connected(members, num_samples=8)
    exchange.observe(0, batch(0.0), 0.5)
    first = exchange.known[0].embedding
    exchange.observe(0, batch(0.0, seed=1), 0.5)
    second = exchange.known[0].embedding

    fresh, _ = connected(members, num_samples=8)
    fresh.observe(0, batch(0.0, seed=1), 0.5)
    alone = fresh.known[0].embedding
    torch.testing.assert_close(second, first / 2 + alone, rtol=1e-4, atol=1e-5)
    assert first.shape == (3 * (5 + 3 + 1),)


def test_the_most_similar_are_taken_and_a_restored_exchange_does_the_same(make):
    members = make(3)
    exchange, _ = connected(members, top_n=1)
    for number, seed in enumerate((0, 1, 0)):
        exchange.observe(number, batch(0.0, seed), 0.2 * number)
    other, _ = connected(members, top_n=1, seed=8)
    other.load_state_dict(saved_and_loaded(exchange.state_dict()))
    assert other.kinds == exchange.kinds
    for each in (exchange, other):
        for number in range(3):
            each.observe(number, batch(0.0, number), 0.2 * number)
    assert equal(exchange.state_dict(), other.state_dict())

    messages = exchange.send("query", 0, [])
    offers = [each for query in messages for each in exchange.send("offer", query.receiver, [query])]
    best = max(offers, key=lambda each: each.content["similarity"])
    assert [each.receiver for each in exchange.send("request", 0, offers)] == [best.sender]


@pytest.mark.parametrize(("num_samples", "are_sent"), [(128, True), (256, False)])
def test_the_published_default_of_256_samples_of_150_never_sends_a_message(make, num_samples, are_sent):
    exchange = mosaic(num_samples=num_samples, buffer_size=150, num_references=2)

    log = learn_collective(make(2, "agent.num_steps=20", start=False), exchange)  # one batch of 160 frames

    assert bool(log.of_kind("exchange")) == are_sent


def test_what_does_not_fit_is_refused(make):
    with pytest.raises(ValueError, match=r"top_n must be at most method.max_received=3, got 4"):
        connected(make(), top_n=4)
    with pytest.raises(
        ValueError, match=r"threshold must be in \[-1, 1\], got 2; own_share must be a number in \(0, 1\)"
    ):
        mosaic(threshold=2, own_share=1.0)
