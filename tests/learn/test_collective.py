"""Learners that share: each alone where nothing arrives, resumed bit by bit; messages that are lost, late or bad."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.kill_runs import equal
from helpers.scripted import ONE, THREE, TWO, of
from helpers.small_agents import MINIBATCHES, TINY, saved_and_loaded

from baselines.exchanges.exchange import Exchange
from baselines.exchanges.isolated import Isolated
from baselines.exchanges.l2d2c import L2D2C
from ctgraph_rl import Block, RunLog, evaluate, learn_curriculum
from ctgraph_rl.learn.collective import Help, Member, learn_collective
from ctgraph_rl.learn.messages import Mail, Message, to_all
from ctgraph_rl.runs.config import target
from ctgraph_rl.runs.train import new_agent, with_method

SEEDS = (4, 7, 9)

CURRICULA = (
    of(Block(ONE, 96), Block(THREE, 32), task_id="at_boundaries", num_task_ids=4),
    of(Block(ONE, 64), Block(TWO, 32), task_id="at_boundaries", num_task_ids=4),
    of(Block(ONE, 48), task_id="at_boundaries", num_task_ids=4),
)
"""Of different lengths; batches have 32 frames."""


@pytest.fixture
def make(compose):
    """Makes the members of a collective, or the first of them."""

    def make(count=3, method="mask_ri", *overrides, curricula=CURRICULA, seeds=SEEDS, logs=None) -> list[Member]:
        backbone = ["method.backbone_seed=9157"] if method.startswith("mask") else []
        cfg = compose("agent=ppo", f"method={method}", *TINY, *MINIBATCHES, *backbone, *overrides)
        members = []
        for number, (curriculum, seed) in enumerate(zip(curricula[:count], seeds, strict=False)):
            make_agent = with_method(target(cfg, "agent"), target(cfg, "method"), curriculum)
            agent = new_agent(curriculum, make_agent, seed)
            members.append(Member(curriculum, agent, seed, RunLog() if logs is None else logs[number]))
        return members

    return make


def lines(log: RunLog) -> list[dict]:
    return [{key: value for key, value in line.items() if key != "seconds"} for line in log.measurements]


def results(members) -> list:
    return [(lines(each.log), saved_and_loaded(each.agent.state_dict())) for each in members]


class Gossip(Exchange):
    """Every member sends random tensors of its own, which change nobody, and takes note of those that arrive."""

    def connect(self, agents) -> None:
        self.kinds = ["word"]
        self.random = torch.Generator().manual_seed(1)

    def send(self, kind, member, received):
        return to_all(kind, member, self.num_members, {"task": member, "noise": torch.rand(3, generator=self.random)})

    def receive(self, member, received):
        return [Help(each.sender, member, {"noise": each.content["noise"].sum().item()}) for each in received]

    def state_dict(self):
        return {"random": self.random.get_state()}

    def load_state_dict(self, state) -> None:
        self.random.set_state(state["random"])


@pytest.mark.parametrize(
    "exchange",
    [
        pytest.param(Isolated(3, 1, 0.0, 0.0), id="isolated", marks=pytest.mark.slow),
        pytest.param(L2D2C(3, 1, 1.0, 0.0), id="all messages lost"),
    ],
)
def test_members_to_whom_nothing_comes_have_the_bits_of_runs_alone(make, exchange):
    members = make()
    torch.manual_seed(1234)
    before = torch.get_rng_state()

    log = learn_collective(members, exchange)

    assert torch.equal(torch.get_rng_state(), before)
    for number, member in enumerate(members):
        alone = make(count=3)[number]
        torch.set_rng_state(alone.random)
        learn_curriculum(alone.curriculum, alone.agent, alone.seed, alone.log)
        assert equal(results([member]), results([alone]))
    assert not log.of_kind("help")
    assert all(line["dropped"] == line["sent"] > line["delivered"] == 0 for line in log.of_kind("exchange"))


class Unequal(L2D2C):
    """Members with a higher number always have the higher return."""

    def observe(self, member, batch, episode_return) -> None:
        super().observe(member, batch, 0.3 * (member + 1))


def test_a_member_at_the_end_of_its_curriculum_is_what_its_log_has_evaluated(make):
    members = make(curricula=CURRICULA[::-1])  # of which the shortest has the lowest return
    kept = []

    def keep(state, end):
        ended = state()["members"][0]
        if ended["done"]:
            kept.append((saved_and_loaded(ended["agent"]), len(members[0].log.of_kind("help"))))

    learn_collective(members, Unequal(3, 1, 0.0, 0.0), 5, RunLog(), checkpoint=keep)

    assert len(kept) > 1 and kept[0][1] > 0
    assert all(equal(each, kept[0]) for each in kept)


@pytest.mark.slow
def test_a_collective_is_resumed_from_any_state_as_if_it_had_never_stopped(make, tmp_path):
    def opened(folder) -> list[RunLog]:
        folder.mkdir()
        return [RunLog(folder / f"{number}.jsonl") for number in range(4)]

    kept, (*logs, log) = [], opened(tmp_path / "whole")
    members = make(logs=logs)
    keep = lambda state, end: kept.append((saved_and_loaded(state()), end))  # noqa: E731
    learn_collective(members, Unequal(3, 1, 0.05, 0.25), 5, log, checkpoint=keep)

    assert [end for _, end in kept] == [False, True, True, True]
    assert len(log.of_kind("help")) > 0
    assert any(state["mail"]["late"] for state, _ in kept)
    for place, (state, _) in enumerate(kept):
        folder = tmp_path / str(place)
        folder.mkdir()
        positions = [*(each["log"] for each in state["members"]), state["log"]]
        for number in range(4):
            (folder / f"{number}.jsonl").write_bytes((tmp_path / "whole" / f"{number}.jsonl").read_bytes())
        *resumed_logs, resumed_log = [RunLog.resume(folder / f"{n}.jsonl", at) for n, at in enumerate(positions)]
        resumed = make(logs=resumed_logs)
        learn_collective(resumed, Unequal(3, 1, 0.05, 0.25), 5, resumed_log, saved=state)
        assert equal(results(resumed), results(members))
        assert lines(resumed_log) == lines(log)


def draw_mask(member: Member, task, wanted: float) -> None:
    """Draw scores for the first task until the greedy policy has a return on it."""
    method = member.agent.method
    method.start_task(0)
    for _ in range(500):
        method.take_scores(torch.cat(method.initial_scores()))
        if returns(member, task) == wanted:
            return
    raise AssertionError(f"no mask of 500 has a return of {wanted}")


def returns(member: Member, task) -> float:
    return evaluate(member.agent.policy, [task], 2).get("episode_reward").mean().item()


def exchanged(exchange, members) -> list[Help]:
    """One exchange by hand, without a loop."""
    received = {number: [] for number in range(len(members))}
    for kind in exchange.kinds:
        sent = [message for number, each in received.items() for message in exchange.send(kind, number, each)]
        received = {number: [each for each in sent if each.receiver == number] for number in received}
    return [help for number, each in received.items() for help in exchange.receive(number, each)]


@pytest.mark.parametrize(("reward", "own", "comes"), [(1.0, 0.0, True), (1.0, 0.9, False), (1.0, 0.8999, True)])
def test_a_learner_that_comes_later_has_the_return_of_the_first_at_its_first_query(make, reward, own, comes):
    first, second = members = make(count=2, curricula=(CURRICULA[0],) * 2)
    exchange = L2D2C(2, 1, 0.0, 0.0)
    exchange.connect([first.agent, second.agent])
    assert torch.equal(first.agent.method.constant, second.agent.method.constant)
    draw_mask(first, ONE, 1.0)
    draw_mask(second, ONE, 0.0)
    before = saved_and_loaded(second.agent.state_dict())
    exchange.observe(0, None, reward)
    exchange.observe(1, None, own)

    helps = exchanged(exchange, members)

    assert len(helps) == comes
    assert (returns(second, ONE) == 1.0) == comes
    assert equal(saved_and_loaded(second.agent.state_dict()), before) != comes
    mine, its = (member.agent.method for member in members)
    assert torch.equal(mine.scores_of(0), its.scores_of(0)) == comes


def test_the_best_of_several_peers_is_taken_and_a_mask_of_another_task_is_not(make):
    members = make(curricula=(CURRICULA[0],) * 3)
    exchange = L2D2C(3, 1, 0.0, 0.0)
    exchange.connect([member.agent for member in members])
    for member in members:
        member.agent.start_task(0)
        member.agent.method.take_scores(torch.cat(member.agent.method.initial_scores()))
    for number, reward in enumerate((0.0, 0.5, 0.75)):
        exchange.observe(number, None, reward)

    helps = exchanged(exchange, members)

    assert [(each.sender, each.receiver) for each in helps] == [(2, 0), (2, 1)]
    assert torch.equal(members[0].agent.method.scores_of(0), members[2].agent.method.scores_of(0))
    late = Message(
        "mask", 2, 0, {"task": 1, "reward": 1.0, "scores": torch.zeros(len(members[0].agent.method.weights))}
    )
    assert exchange.receive(0, [late]) == []


def test_members_with_one_backbone_begin_each_task_with_equal_scores_and_others_do_not(make):
    alike, other = make(count=2, curricula=(CURRICULA[0],) * 2), make(1, "mask_ri", "method.backbone_seed=3")

    for task in (0, 1):
        for member in (*alike, *other):
            member.agent.start_task(task)
        one, same, different = (member.agent.method for member in (*alike, *other))
        assert torch.equal(one.scores_of(task), same.scores_of(task))
        assert not torch.equal(one.scores_of(task), different.scores_of(task))
    assert not torch.equal(one.scores_of(0), one.scores_of(1))
    assert not torch.equal(alike[0].random, alike[1].random)


GOOD = {"task": 2, "reward": 0.5, "scores": torch.ones(3)}


class Wrong(Gossip):
    """Messages that no member can take."""

    def send(self, kind, member, received):
        return [Message(self.sent_kind, member, self.receiver, {})]


@pytest.mark.parametrize(
    ("kind", "receiver", "message"),
    [
        ("word", 0, "a word goes from learner 0 to 0, which is no other member"),
        ("word", 3, "a word goes from learner 0 to 3, which is no other member"),
        ("virus", 1, "a virus is sent in place of a word"),
    ],
)
def test_a_message_to_nobody_or_of_another_kind_is_an_error(make, kind, receiver, message):
    exchange = Wrong(3, every=100, drop_prob=0.0, delay_prob=0.0)
    exchange.sent_kind = kind
    exchange.receiver = receiver

    with pytest.raises(ValueError, match=message):
        learn_collective(make(), exchange)


def test_messages_are_lost_and_late_as_often_as_stated_and_the_late_ones_come_next_time():
    mail, same, other = Mail(0.3, 0.5, seed=2), Mail(0.3, 0.5, seed=2), Mail(0.0, 0.0, seed=2)
    messages = [Message("mask", 0, 1, {**GOOD, "task": number}) for number in range(1000)]

    for each in messages:
        mail.post(each)
        same.post(each)
        other.post(each)
    now = mail.take(1, "mask")
    mail.begin()
    then = mail.take(1, "mask")

    assert 1000 - len(now) - len(then) == pytest.approx(300, abs=60)  # four standard deviations
    assert len(then) == pytest.approx(350, abs=60)
    assert not {each.content["task"] for each in now} & {each.content["task"] for each in then}
    assert [now, then] == [same.take(1, "mask"), same.late]
    assert torch.equal(mail.generator.get_state(), other.generator.get_state())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda members: members[:2], "num_members must be the number of members, 2, got 3"),
        (lambda members: [members[0]] * 3, "members must have an agent each, some share one"),
        (lambda members: [*members[:2], 5], "members must be a list with at least one Member, got Member, int"),
        (
            lambda members: [*members[:2], replace(members[2], curriculum=of(Block(TWO, 33)))],
            "member 2: num_frames=33 of block 1 must be a multiple of num_envs=8",
        ),
    ],
)
def test_members_that_cannot_be_a_collective_are_refused_before_any_work(make, change, message):
    members = change(make())

    with pytest.raises(ValueError, match=message.replace("(", r"\(")):
        learn_collective(members, L2D2C(3, 1, 0.0, 0.0))

    assert all(not member.log.measurements for member in members if isinstance(member, Member))


@pytest.mark.parametrize(
    ("method", "overrides", "message"),
    [
        ("ewc", (), "L2D2C needs masks, which 2 of 2 members lack; member 0 has EWC: take method=mask_ri"),
        ("mask_lc", (), "L2D2C needs masks, which 2 of 2 members lack; member 0 has MaskLC: take method=mask_ri"),
        (
            "mask_ri",
            ("method.backbone_seed=null",),
            "one network behind all masks, and 1 of 2 members have another than member 0: set method.backbone_seed",
        ),
    ],
)
def test_what_has_no_masks_to_exchange_is_refused(make, method, overrides, message):
    with pytest.raises(ValueError, match=message):
        learn_collective(make(2, method, *overrides), L2D2C(2, 1, 0.0, 0.0))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ((0, 1, 0.0, 0.0), "num_members must be an integer >= 1, got 0"),
        ((2, 0, 0.0, 0.0), "every must be an integer >= 1, got 0"),
        ((2, 1, 1.5, -0.1), r"drop_prob must be in \[0, 1\], got 1.5; delay_prob must be in \[0, 1\], got -0.1"),
    ],
)
def test_settings_of_an_exchange_are_checked(settings, message):
    with pytest.raises(ValueError, match=message):
        Isolated(*settings)


def test_a_member_whose_loss_is_not_finite_is_named(make):
    members = make()
    members[1].agent.learn = lambda batch: {"loss_objective": float("nan")}

    with pytest.raises(FloatingPointError, match=r"member 1: loss_objective is nan in block 1 after 32 frames"):
        learn_collective(members, Isolated(3, 1, 0.0, 0.0))
