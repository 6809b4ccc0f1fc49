"""Seeds as one batch on a GPU, by the same code on a CPU: each learns as alone, and is resumed bit by bit."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.kill_runs import equal
from helpers.learning import learn_together
from helpers.scripted import ONE, THREE, lines, of
from helpers.small_agents import TINY, others_slow, saved_and_loaded
from helpers.sweeping import sweep

from baselines.update.captured import CapturedGroup, Draws
from baselines.update.update import losses_of, total_loss
from ctgraph_rl import Block, Evaluation, RunLog
from ctgraph_rl.core import philox
from ctgraph_rl.learn import collect, exact
from ctgraph_rl.learn.evaluate import Evaluator
from ctgraph_rl.learn.loop import evaluate_members
from ctgraph_rl.runs import checkpoints, job
from ctgraph_rl.runs import session as runs_session
from ctgraph_rl.runs.config import target
from ctgraph_rl.runs.session import agents_together, why_agents_learn_alone
from ctgraph_rl.runs.train import new_agent, with_method

EIGHT = tuple(range(8))
THREE_SEEDS = (0, 3, 8)
CURRICULUM = of(Block(ONE, 80), Block(THREE, 32), task_id="at_boundaries")
"""Blocks of no whole number of batches, which are of 32 frames."""

CPU = torch.device("cpu")
GPU = torch.device("cuda")
ONE_EPOCH = ("agent.num_minibatches=2", "agent.num_epochs=1")


@pytest.fixture
def captured(monkeypatch) -> None:
    """Use regions on every device."""
    monkeypatch.setattr(collect, "captures", lambda device: True)


@pytest.fixture
def make(compose):
    """Makes a group of an agent's name."""

    def make(name: str = "ppo", seeds: tuple[int, ...] = THREE_SEEDS, *overrides: str) -> CapturedGroup:
        minibatches = () if name == "a2c" else ONE_EPOCH
        cfg = compose(f"agent={name}", *TINY, *minibatches, *overrides)
        make_agent = with_method(target(cfg, "agent"), target(cfg, "method"), CURRICULUM)
        generators = []
        agents: list[Any] = []
        for seed in seeds:
            agents.append(new_agent(CURRICULUM, make_agent, seed))
            generators.append(torch.Generator().set_state(torch.get_rng_state()))
        return agents_together(agents, generators, GPU)

    return make


def learn(group: CapturedGroup, seeds=THREE_SEEDS, **how: Any) -> list[RunLog]:
    logs = [RunLog() for _ in seeds]
    learn_together(CURRICULUM, group, seeds, logs, **how)
    return logs


def states(group: CapturedGroup) -> list[Any]:
    pairs = zip(group.agents, group.device_generators, strict=True)
    return [(saved_and_loaded(agent.state_dict()), draws.get_state()) for agent, draws in pairs]


def test_each_seed_draws_its_own_words_whichever_seeds_are_beside_it():
    draws = Draws((5, 2**40), CPU)
    alone = Draws((2**40,), CPU)

    found = torch.cat([draws.words(7), draws.words(3)], dim=1)
    its = torch.cat([alone.words(7), alone.words(3)], dim=1)

    assert torch.equal(found[1:], its)
    zero = torch.zeros(1, dtype=torch.int64)
    first = philox.draw(torch.tensor([5]), zero, zero, philox.STREAM_AGENT, 1)
    assert found[0, 4:7].tolist() == [word.item() for word in first[:3]]
    assert len(set(found.flatten().tolist())) == 20


def test_draws_are_exponential_numbers_above_zero_and_orders_of_all_items():
    draws = Draws((0,), CPU)

    numbers = draws.exponential(40_000).double()
    orders = torch.cat([draws.orders(5) for _ in range(500)])

    assert numbers.min() > 0
    for quantile in (0.1, 0.5, 0.9):
        share = (numbers < -torch.tensor(1 - quantile).log()).double().mean().item()
        assert abs(share - quantile) < 5 * (quantile * (1 - quantile) / 40_000) ** 0.5
    assert torch.equal(orders.sort(dim=1).values, torch.arange(5).expand(500, 5))
    at_first = (orders == 0).double().mean(dim=0)
    assert ((at_first - 0.2).abs() < 5 * (0.16 / 500) ** 0.5).all()


def test_draws_go_on_from_a_saved_state(make):
    group = make()
    group.draws.words(3)
    saved = [draws.get_state() for draws in group.device_generators]
    expected = group.draws.words(8)

    for draws, state in zip(group.device_generators, saved, strict=True):
        draws.set_state(state)

    assert torch.equal(group.draws.words(8), expected)
    assert group.draws.seed.flatten().tolist() == [*THREE_SEEDS]


def spread(group: CapturedGroup) -> None:
    """Let seeds act in different ways."""
    learn(group)
    with torch.no_grad():
        for parameter in chain(*(agent.parameters() for agent in group.agents)):
            parameter.mul_(9)
    group.stack.read()


@pytest.mark.parametrize(("name", "num_lengths"), [("ppo", 2), ("lstm_ppo", 1)])
def test_seeds_are_evaluated_at_once_as_each_alone_and_without_one_that_failed(make, name, num_lengths):
    group = make(name)
    spread(group)
    frames = CURRICULUM.num_frames
    curriculum = replace(CURRICULUM, evaluation=Evaluation(6, greedy=True))
    at_once, alone = ([Evaluator(curriculum, seed, RunLog()) for seed in THREE_SEEDS] for _ in range(2))

    evaluate_members(at_once, group, frames, "after", failed={1})
    for evaluator, agent in zip(alone, group.agents, strict=True):
        evaluator.evaluate_if_due(agent, frames)

    found, expected = ([lines(each.log) for each in some] for some in (at_once, alone))
    assert found == [expected[0], [], expected[2]]
    assert len({line["length_mean"] for line in expected[0] + expected[2]}) >= num_lengths


@pytest.mark.parametrize("greedy", [False, True])
@pytest.mark.parametrize("name", ["ppo", "lstm_ppo"])
def test_exact_measures_of_seeds_at_once_are_those_of_each_alone(make, name, greedy, monkeypatch):
    group = make(name)
    spread(group)
    monkeypatch.setattr(exact, "HISTORIES_AT_ONCE", 6)
    curriculum = replace(CURRICULUM, evaluation=Evaluation(exact=True, greedy=greedy))
    at_once, alone = ([Evaluator(curriculum, seed, RunLog()) for seed in THREE_SEEDS] for _ in range(2))
    frames = CURRICULUM.num_frames

    with monkeypatch.context() as patch:
        patch.setattr(Evaluator, "evaluate_if_due", None)
        evaluate_members(at_once, group, frames, "after", failed={1})
    for evaluator, agent in zip(alone, group.agents, strict=True):
        evaluator.evaluate_if_due(agent, frames)

    found, expected = ([lines(each.log) for each in some] for some in (at_once, alone))
    assert [len(each) for each in found] == [2, 0, 2]
    for line, its in zip(found[0] + found[2], expected[0] + expected[2], strict=True):
        assert line == pytest.approx(its, abs=1e-5)
    assert greedy or len({line["length_mean"] for line in expected[0] + expected[2]}) > 1


def test_what_changes_an_agent_at_the_start_of_a_task_changes_what_acts(make):
    group = make("a2c")
    assert group.stack.weights

    with torch.no_grad():
        group.agents[1].weights[1].fill_(0.5)
    group.start_task(0)

    assert (group.stack.kept[group.stack.weights[1]][1] == 0.5).all()


def test_what_a_method_draws_at_a_boundary_follows_from_the_counter_of_its_seed(make):
    group = make("a2c", THREE_SEEDS, "method=mask_ri")
    other = make("a2c", THREE_SEEDS, "method=mask_ri")
    other.generators[0].manual_seed(99)

    for each in (group, other):
        each.start_task(0)
        each.start_task(1)

    assert torch.equal(group.methods[0].own[0], other.methods[0].own[0])
    assert len({method.own[0][0].item() for method in group.methods}) == 3


@pytest.mark.parametrize(
    ("name", "overrides"),
    others_slow(
        [
            ("ppo", ()),
            ("a2c", ()),
            ("a2c", ("agent.normalize_advantage=true", "method=ewc")),
            ("lstm_ppo", ()),
            *(("ppo", (f"method={method}",)) for method in ("scratch", "l2", "ewc", "si", "mask_ri")),
            ("lstm_ppo", ("method=mask_lc",)),
        ],
        ("a2c", ("agent.normalize_advantage=true", "method=ewc")),
    ),
)
def test_eight_seeds_learn_from_what_each_would_alone_with_its_losses_and_gradients(name, overrides, make, monkeypatch):
    group = make(name, EIGHT, *overrides)
    compared = []

    def compare(minibatch):
        state = group.stack.state
        losses = losses_of(group.first, state, minibatch)
        [gradient, *_] = torch.autograd.grad(total_loss(losses).sum(), state.weights)
        for number, agent in enumerate(group.agents):
            alone = agent.loss({key: value[number] for key, value in minibatch.items()})
            torch.testing.assert_close({key: value[number] for key, value in losses.items()}, alone)
            [expected] = torch.autograd.grad(total_loss(alone), group.learners[number].weights[:1])
            torch.testing.assert_close(gradient[number].mT if expected.ndim == 2 else gradient[number], expected)
        compared.append(gradient)

    def learned(batch):
        group.stack.write()
        found = group.first.with_advantage(batch, group.seeds)
        for number, (agent, part) in enumerate(zip(group.learners, batch.chunk(8), strict=True)):
            expected = agent.with_advantage(part, agent.one_seed)
            its = {key: value.chunk(8)[number] for key, value in found.items()}
            torch.testing.assert_close(its, expected, rtol=1e-4, atol=1e-5)
        minibatches = list(group.first.minibatches_of(batch, group.seeds))
        for number in range(8):
            drawn = torch.cat([minibatch["advantage"][number].flatten() for minibatch in minibatches])
            own = found["advantage"].chunk(8)[number].flatten()
            assert torch.equal(drawn.sort().values, own.sort().values), "a seed draws each frame of this seed once"
        compare(minibatches[0])
        return CapturedGroup.learn(group, batch)

    monkeypatch.setattr(group, "learn", learned)
    learn(group, EIGHT)

    assert all(method.samples.remaining == 0 for method in group.methods if hasattr(method, "samples"))
    assert all((method.path != 0).any() for method in group.methods if hasattr(method, "path"))
    assert len(compared) == 4
    assert all(gradient.abs().max() > 0 for gradient in compared)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "method"), [("ppo", "finetune"), ("lstm_ppo", "finetune"), ("ppo", "mask_lc")])
def test_memory_of_graphs_changes_no_bit_of_seeds(name, method, make, captured, monkeypatch):
    group = make(name, THREE_SEEDS, f"method={method}")
    logs = learn(group)
    monkeypatch.undo()
    other = make(name, THREE_SEEDS, f"method={method}")
    monkeypatch.setattr(other, "gradient_step", other._usual_update)

    other_logs = learn(other)

    assert equal(states(group), states(other))
    assert list(map(lines, logs)) == list(map(lines, other_logs))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["finetune", "mask_ri"])
def test_another_seed_beside_it_changes_no_bit_of_a_seed(method, make, captured):
    group = make("ppo", (0, 3, 8), f"method={method}")
    other = make("ppo", (0, 5, 8), f"method={method}")

    logs = learn(group, (0, 3, 8))
    other_logs = learn(other, (0, 5, 8))

    for number in (0, 2):
        assert equal(states(group)[number], states(other)[number])
        assert lines(logs[number]) == lines(other_logs[number])
    assert not equal(states(group)[1], states(other)[1])


@pytest.mark.parametrize(
    ("name", "method"),
    others_slow(
        [("a2c", "finetune"), ("ppo", "finetune"), ("lstm_ppo", "finetune"), ("ppo", "mask_ri"), ("a2c", "ewc")],
        ("a2c", "finetune"),
    ),
)
def test_seeds_are_resumed_from_any_state_as_if_they_had_never_stopped(name, method, make, captured, tmp_path):
    def new_logs(folder: str) -> list[RunLog]:
        (tmp_path / folder).mkdir()
        return [RunLog(tmp_path / folder / f"{seed}.jsonl") for seed in THREE_SEEDS]

    kept: list[Any] = []
    group = make(name, THREE_SEEDS, f"method={method}")
    logs = new_logs("whole")
    learn_together(
        CURRICULUM,
        group,
        THREE_SEEDS,
        logs,
        checkpoint=lambda make_states, end: kept.append(saved_and_loaded(make_states())),
    )

    for place in (1, len(kept) - 1):
        for seed in THREE_SEEDS:
            (tmp_path / f"{seed}.jsonl").write_bytes((tmp_path / "whole" / f"{seed}.jsonl").read_bytes())
        pairs = zip(THREE_SEEDS, kept[place], strict=True)
        resumed_logs = [RunLog.resume(tmp_path / f"{seed}.jsonl", state["log"]) for seed, state in pairs]
        resumed = make(name, THREE_SEEDS, f"method={method}")
        learn_together(CURRICULUM, resumed, THREE_SEEDS, resumed_logs, saved=kept[place])
        assert equal(states(resumed), states(group))
        assert list(map(lines, resumed_logs)) == list(map(lines, logs))


@pytest.mark.slow
def test_a_seed_that_is_not_finite_fails_alone_and_changes_no_bit_of_another(make, captured, monkeypatch):
    group = make()
    logs = learn(group)
    spoiled = make()
    batches = []

    def spoil(batch):
        batches.append(batch)
        if len(batches) == 2:
            name = spoiled.stack.weights[0]
            spoiled.stack.kept[name].data[1] = torch.nan
        return CapturedGroup.learn(spoiled, batch)

    monkeypatch.setattr(spoiled, "learn", spoil)
    spoiled_logs = [RunLog() for _ in THREE_SEEDS]
    failed = learn_together(CURRICULUM, spoiled, THREE_SEEDS, spoiled_logs)

    assert list(failed) == [1]
    assert re.match(r"seed 3: loss_objective is nan in block 1 after 64 frames; the run stops here", str(failed[1]))
    for number in (0, 2):
        assert equal(states(group)[number], states(spoiled)[number])
        assert lines(logs[number]) == lines(spoiled_logs[number])
    assert all(weight.isfinite().all() for weight in spoiled.stack.kept.values())


def test_what_cannot_be_captured_for_all_seeds_says_why(compose):
    def reason(name: str, method: str = "finetune", **changes: Any) -> str | None:
        few = () if name == "dqn" else ONE_EPOCH
        cfg = compose(f"agent={name}", f"method={method}", *TINY, *few)
        make_agent = with_method(target(cfg, "agent"), target(cfg, "method"), CURRICULUM)
        agent: Any = new_agent(CURRICULUM, make_agent, 0)
        for key, value in changes.items():
            agent.optimiser.param_groups[0][key] = value
        return why_agents_learn_alone(agent, GPU)

    assert reason("dqn") == "DQN cannot be vectorised over seeds on a GPU"
    rule = "cannot be vectorised over seeds on a GPU: it acts before or after a batch"
    assert (reason("ppo", "packnet"), reason("ppo", "clear")) == (f"PackNet {rule}", f"CLEAR {rule}")
    assert reason("ppo", "mask_sc") == f"MaskSC {rule}"
    assert reason("ppo_count") == "PPOCount does not learn by the steps that a batch of seeds shares"
    assert reason("ppo", amsgrad=True) == "Adam with these settings cannot be vectorised over seeds"
    assert reason("lstm_ppo") is reason("ppo", "ewc") is reason("ppo", "si") is None


@pytest.mark.slow
def test_a_sweep_on_a_gpu_trains_seeds_with_memory_as_one_job_and_resumes_it_bit_by_bit(
    monkeypatch, captured, tmp_path
):
    on_gpu = {
        "agents_together": lambda agents, generators, device: agents_together(agents, generators, GPU),
        "why_agents_learn_alone": lambda agent, device: why_agents_learn_alone(agent, GPU),
    }
    for name, function in on_gpu.items():
        monkeypatch.setattr(job if name.startswith("why") else runs_session, name, function)
    monkeypatch.chdir(tmp_path)
    few = ("curriculum=ct2_interfering", "curriculum.num_frames=96", "evaluation.num_episodes=2")
    settings = ("seed=0,1", "together=true", "agent=lstm_ppo", *few, *TINY, *ONE_EPOCH)
    assert sweep(monkeypatch, *settings, "hydra.sweep.dir=whole") == 0
    offers = []

    def stop(*given):
        checkpoints.offer_all(*given)
        offers.append(given)
        if len(offers) == 2:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(runs_session, "offer_all", stop)
        assert sweep(patch, *settings) == 130
    assert sweep(monkeypatch, *settings) == 0

    pairs = list(zip(sorted(Path("runs").rglob("agent.pt")), sorted(Path("whole").rglob("agent.pt")), strict=True))
    assert len(pairs) == 2 and len(offers) == 2
    for one, other in pairs:
        assert equal(torch.load(one, weights_only=True), torch.load(other, weights_only=True))
        log, expected = (RunLog.read(path.parent / "run.jsonl") for path in (one, other))
        assert lines(log) == lines(expected)
        begun = RunLog.begun(one.parent / "run.jsonl")
        assert begun["together"] == [0, 1]
