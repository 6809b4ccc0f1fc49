"""Seeds that learn as one batch: each as alone, none changed by another, resumed bit by bit."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from helpers.kill_runs import equal
from helpers.learning import learn_together
from helpers.scripted import ONE, THREE, TWO, ScriptedGroup, Told, decide, first_training, lines, of
from helpers.small_agents import BATCHED, MINIBATCHES, TINY, others_slow, saved_and_loaded

from baselines.methods.l2 import L2
from baselines.methods.method import Method
from baselines.update import seeds as together
from baselines.update.seeds import SeedGroup
from baselines.update.stack import Stack
from baselines.update.update import (
    losses_of,
    over_seeds,
    total_loss,
    transform_gradients,
    unstacked,
    update,
    with_tensors,
)
from ctgraph_rl import Block, Curriculum, Evaluation, RunLog, learn_curriculum
from ctgraph_rl.learn.refusals import why_not_together
from ctgraph_rl.runs.config import target
from ctgraph_rl.runs.train import new_agent, with_method
from ctgraph_rl.tasks.switch import AtRandom, ByEpisode

SEEDS = (0, 3, 8)

COMPILED = [("ppo", "scratch"), ("prioritized dqn", "finetune")]

ALSO = ("si", "packnet", "clear", "cka_rl")

METHODS = ("scratch", "l2", "ewc", "ewc_published", "mas", "mask_ri", "mask_lc", "mask_blc", *ALSO)

EACH = [*((name, "finetune") for name in BATCHED), *(("ppo", method) for method in METHODS)]

SOME = [("a2c", "mask_lc"), ("ppo", "ewc"), ("ppo_published", "mask_lc"), ("prioritized dqn", "finetune")]

CURRICULUM = of(Block(ONE, 48), Block(THREE, 72), Block(ONE, 24), task_id="at_boundaries")
"""Blocks of no whole number of batches, which are of 32 frames, and a task that returns."""

LESS_EVALUATED = replace(CURRICULUM, evaluation=Evaluation(1, greedy=False, before=False))

ONE_BATCH_EACH = replace(LESS_EVALUATED, blocks=tuple(Block(task, 32) for task in (ONE, THREE, ONE)))


class Together(NamedTuple):
    """Learns a curriculum with new agents, one of each seed."""

    make_agent: Any
    curriculum: Curriculum = CURRICULUM

    def group(self, seeds=SEEDS) -> SeedGroup:
        generators = []

        def built(seed: int):
            agent = new_agent(self.curriculum, self.make_agent, seed)
            generators.append(torch.Generator().set_state(torch.get_rng_state()))
            return agent

        return SeedGroup([built(seed) for seed in seeds], generators)

    def learn(self, seeds=SEEDS, saved=None, logs=None, checkpoint=None) -> tuple[SeedGroup, list[RunLog]]:
        group, logs = self.group(seeds), [RunLog() for _ in seeds] if logs is None else logs
        torch.manual_seed(1234)
        learn_together(self.curriculum, group, seeds, logs, saved=saved, checkpoint=checkpoint)
        return group, logs

    def alone(self, seed: int) -> tuple[Any, RunLog]:
        agent = new_agent(self.curriculum, self.make_agent, seed)
        return agent, learn_curriculum(self.curriculum, agent, seed)


@pytest.fixture
def make(compose):
    """Makes a `Together` of an agent's name in `BATCHED` or with memory, a method and more settings."""

    def make(name: str = "a2c", method: str = "finetune", *overrides: str, curriculum=CURRICULUM) -> Together:
        settings = [*TINY, *BATCHED.get(name, MINIBATCHES), *overrides]
        cfg = compose(f"agent={name.removeprefix('prioritized ')}", f"method={method}", *settings)
        make_agent = with_method(target(cfg, "agent"), target(cfg, "method"), curriculum)
        return Together(make_agent, curriculum)

    return make


def states(group: SeedGroup) -> list[tuple[Any, torch.Tensor]]:
    pairs = zip(group.agents, group.generators, strict=True)
    return [(saved_and_loaded(agent.state_dict()), generator.get_state()) for agent, generator in pairs]


alternating = decide(lambda data: 1 + data["step_count"].squeeze(-1) % 2)
"""Decisions that depend on the steps of the episode alone."""


@pytest.mark.parametrize(
    "curriculum",
    [
        pytest.param(of(Block(THREE, 48), Block(ONE, 72)), marks=pytest.mark.slow),
        of(Block(THREE, 48), Block(ONE, 72), boundaries="hidden", task_id="one_hot"),
        of(Block((ONE, THREE), 48), Block(TWO, 48)),
        of(Block((ONE, THREE), 96, ByEpisode(2)), Block(TWO, 40), boundaries="hidden"),
        of(Block((THREE, ONE), 64, AtRandom(0.5)), Block(TWO, 40), boundaries="hidden"),
    ],
)
def test_with_given_actions_each_seed_has_the_trajectories_measurements_and_evaluations_of_a_run_alone(curriculum):
    group, logs = ScriptedGroup(len(SEEDS), alternating), [RunLog() for _ in SEEDS]

    learn_together(curriculum, group, SEEDS, logs)

    for seed, agent, log in zip(SEEDS, group.agents, logs, strict=True):
        alone = Told(alternating, num_envs=8, num_steps=4)
        assert lines(learn_curriculum(curriculum, alone, seed)) == lines(log)
        for one, other in zip(alone.batches, agent.batches, strict=True):
            assert equal(one.to_dict(), other.to_dict())
    pairs = zip(*(agent.batches for agent in group.agents[:2]), strict=True)
    assert any(not torch.equal(one["observation"], other["observation"]) for one, other in pairs)


@pytest.mark.parametrize(
    ("name", "method"),
    others_slow(EACH, ("prioritized dqn", "finetune"), ("ppo", "mask_lc")),
)
def test_losses_and_gradients_of_the_first_update_in_each_task_are_those_of_a_run_alone(
    make, monkeypatch, name, method
):
    its, found = make(name, method, curriculum=LESS_EVALUATED), []
    start, update = SeedGroup.start_task, SeedGroup._update

    def started(group, task=None):
        start(group, task)
        found.append(None)

    def compared(group, stack, minibatches, errors):
        if found[-1] is None:
            for learner in group.learners:
                learner.double()
            found[-1] = (
                of_all(group, minibatches),
                [of_one(*pair) for pair in zip(group.learners, minibatches, strict=True)],
            )
            for learner in group.learners:
                learner.float()
        return update(group, stack, minibatches, errors)

    monkeypatch.setattr(SeedGroup, "start_task", started)
    monkeypatch.setattr(SeedGroup, "_update", compared)
    its.learn()

    assert len(found) == 3
    for (losses, gradients), alone in found:
        for number, (its_losses, its_gradients) in enumerate(alone):
            assert list(losses) == list(its_losses)
            for key, value in its_losses.items():
                torch.testing.assert_close(losses[key][number], value, rtol=1e-10, atol=1e-10)
            for gradient, one in zip(gradients, its_gradients, strict=True):
                torch.testing.assert_close(gradient[number], one, rtol=1e-10, atol=1e-10)
        assert any(gradient.abs().max() > 1e-6 for gradient in gradients)


def of_all(group: SeedGroup, minibatches) -> tuple[dict[str, torch.Tensor], list[torch.Tensor]]:
    """Losses of a group, and the gradients of what is trained."""
    first, state = group.learners[0], Stack(group.learners).state
    batch = {key: torch.stack([wide(each[key]) for each in minibatches]) for key in minibatches[0]}
    losses = losses_of(first, state, batch)
    gradients = list(map(unstacked, torch.autograd.grad(total_loss(losses).sum(), state.weights)))
    return losses, list(with_tensors(first, state, transform_gradients, state, gradients))


def of_one(learner, minibatch) -> tuple[dict[str, torch.Tensor], list[torch.Tensor]]:
    batch = {key: wide(value) for key, value in minibatch.items()}
    losses = learner.losses(learner.weights, batch, learner.other_weights())
    gradients = torch.autograd.grad(total_loss(losses), learner.weights)
    return losses, list(learner.method.transform_gradients(gradients, learner.weights))


def wide(value: torch.Tensor) -> torch.Tensor:
    return value.double() if value.is_floating_point() else value


@pytest.mark.parametrize(("name", "method"), others_slow([*EACH[:2], *SOME, ("dqn", "finetune")], ("a2c", "finetune")))
def test_each_seed_ends_near_its_run_alone(make, name, method):
    soon = ["agent.target_update_interval=1"] * ("dqn" in name)  # within the first batch
    its = make(name, method, *soon, curriculum=ONE_BATCH_EACH)

    group, logs = its.learn()

    for seed, agent, log in zip(SEEDS, group.agents, logs, strict=True):
        alone, its_log = its.alone(seed)
        assert [line.keys() for line in lines(log)] == [line.keys() for line in lines(its_log)]
        assert agent.state_dict().keys() == alone.state_dict().keys()
        assert first_training(log) == pytest.approx(first_training(its_log), rel=1e-4, abs=1e-5, nan_ok=True)


@pytest.mark.parametrize("method", others_slow(ALSO, "si"))
def test_a_batch_changes_weights_and_what_a_method_keeps_as_in_a_run_alone(make, monkeypatch, method):
    its, compared, learn = make("ppo", method, curriculum=LESS_EVALUATED), [], SeedGroup.learn

    def checked(group, batch):
        copies = deepcopy(group.agents)
        alone = []
        for number, part in enumerate(batch.chunk(len(copies))):
            with random_as(group.generators[number]):
                copies[number].learn(part)
            alone.append(copies[number].state_dict())
        measured = learn(group, batch)
        for agent, expected in zip(group.agents, alone, strict=True):
            torch.testing.assert_close(agent.state_dict(), expected, rtol=1e-3, atol=1e-4)
        compared.append(len(alone))
        return measured

    monkeypatch.setattr(SeedGroup, "learn", checked)
    its.learn()

    assert compared == [3] * 6


@contextmanager
def random_as(generator: torch.Generator) -> Iterator[None]:
    """Torch's global generator in the state of another, which stays where it is."""
    before = torch.get_rng_state()
    torch.set_rng_state(generator.get_state())
    yield
    torch.set_rng_state(before)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "method"), SOME[::3])
def test_seeds_act_by_a_graph_of_the_operations_of_their_networks_as_they_are(make, monkeypatch, name, method):
    act, compared = SeedGroup._act, []

    def checked(group, stack, data):
        outputs = act(group, stack, data)
        fresh = Stack(group.learners)
        present = over_seeds(group.first, lambda learner, weights, data: learner.outputs(data), fresh.state, data)
        assert outputs.keys() == present.keys()
        compared.extend(torch.equal(outputs[key], present[key]) for key in present)
        return outputs

    monkeypatch.setattr(SeedGroup, "_act", checked)
    make(name, method).learn()

    assert len(compared) > 8
    assert all(compared)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "method"), COMPILED)
def test_a_compiled_step_is_the_same_step_of_fewer_seeds_at_a_time(make, monkeypatch, compile_by, name, method):
    compile_by("aot_eager")
    its = make(
        name, method, "agent.compile=true", curriculum=of(Block(ONE, 64), Block(THREE, 64), task_id="at_boundaries")
    )
    sizes = []
    step = SeedGroup._step

    def compared(group, stack, batch):
        first = stack.learners[0]
        in_double = {key: wide(value) for key, value in batch.items()}
        one = state_in_double(stack.state)
        other = state_in_double(stack.state)
        measured = first.compiled_step(first, one, in_double)
        expected = update(first, other, in_double)
        sizes.append(len(batch["action"]))
        torch.testing.assert_close(measured, expected, rtol=1e-10, atol=1e-10)
        torch.testing.assert_close(values_of(one), values_of(other), rtol=1e-10, atol=1e-10)
        return step(group, stack, batch)

    monkeypatch.setattr(SeedGroup, "_step", compared)
    monkeypatch.setattr(together, "_most_at_once", lambda learner: 2)
    learnt = SeedGroup.learnt
    ended = []
    batches = []

    def counted(group, batch):
        ended.clear()
        measured = learnt(group, batch)
        batches.append([after - len(sizes) for after, _ in ended])
        states = {random.numpy().tobytes() for _, random in ended}
        assert len(states) == len(group.methods), "each with the random numbers of its seed"
        return measured

    monkeypatch.setattr(SeedGroup, "learnt", counted)
    monkeypatch.setattr(Method, "after_learning", lambda method: ended.append((len(sizes), torch.get_rng_state())))
    its.learn()

    assert set(sizes) == {2, 1}, "of two seeds, and of the third"
    once = [] if method == "finetune" else [0, 0, 0]
    assert batches == [once] * len(batches), "each method once, after the steps of all seeds"


def state_in_double(state):
    """A copy of what an update of a stack changes, in float64."""
    copied = deepcopy(state)
    is_adam = copied.optimiser.is_adam  # whose compiled step computes with the number of steps
    moments = [value for each in copied.optimiser.state for key, value in each.items() if is_adam or key != "step"]
    for tensor in [*copied.tensors.values(), *moments, *copied.others.values()]:
        tensor.data = wide(tensor.data)
    return copied


def values_of(state) -> dict[Any, torch.Tensor]:
    """The weights and moments of a stack."""
    moments = [(number, key) for number, its in enumerate(state.optimiser.state) for key in its]
    return dict(state.tensors) | {(number, key): state.optimiser.state[number][key] for number, key in moments}


@pytest.mark.parametrize(
    ("name", "method", "largest", "settings"),
    [
        ("a2c", "ewc", 0, []),
        pytest.param("ppo_published", "ewc_published", 512, ["agent.compile=true"], marks=pytest.mark.slow),
        pytest.param("ppo_published", "mask_lc", 512, ["agent.compile=true"], marks=pytest.mark.slow),
    ],
)
def test_large_minibatches_and_compiled_methods_are_learned_one_seed_after_the_other_by_the_agents_own_code(
    make, monkeypatch, compile_by, name, method, largest, settings
):
    compile_by("eager")
    monkeypatch.setattr(together, "LARGEST_MINIBATCH", largest)
    its = make(name, method, *settings, curriculum=ONE_BATCH_EACH)

    group, logs = its.learn(SEEDS[:2])

    assert not group.is_stacked
    for seed, agent, log in zip(SEEDS[:2], group.agents, logs, strict=True):
        alone, its_log = its.alone(seed)
        assert first_training(log) == pytest.approx(first_training(its_log), rel=1e-4, abs=1e-5, nan_ok=True)
        assert agent.state_dict().keys() == alone.state_dict().keys()


@pytest.mark.parametrize("method", others_slow(["finetune", "ewc", "mask_lc", "clear"], "finetune"))
def test_seeds_with_memory_have_the_bits_of_runs_alone(make, method):
    its = make("lstm_ppo", method)

    group, logs = its.learn(SEEDS[:2])

    for seed, agent, log in zip(SEEDS[:2], group.agents, logs, strict=True):
        alone, its_log = its.alone(seed)
        assert lines(log) == lines(its_log)
        assert equal(saved_and_loaded(agent.state_dict()), saved_and_loaded(alone.state_dict()))


@pytest.mark.parametrize(("name", "method"), others_slow(SOME[::3], ("prioritized dqn", "finetune")))
def test_another_seed_beside_it_changes_no_bit_of_a_seed(make, name, method):
    its = make(name, method, curriculum=ONE_BATCH_EACH)

    group, logs = its.learn((0, 3, 8))
    other, other_logs = its.learn((0, 5, 8))

    for number in (0, 2):
        assert equal(states(group)[number], states(other)[number])
        assert lines(logs[number]) == lines(other_logs[number])
    assert not equal(states(group)[1], states(other)[1])


@pytest.mark.parametrize(("name", "method"), others_slow([*SOME[:2], ("prioritized dqn", "l2")], ("a2c", "mask_lc")))
def test_a_group_is_resumed_from_any_state_as_if_it_had_never_stopped(make, tmp_path, name, method):
    its, kept = make(name, method), []

    def whole_logs(folder: Path) -> list[RunLog]:
        folder.mkdir()
        return [RunLog(folder / f"{seed}.jsonl") for seed in SEEDS]

    logs = whole_logs(tmp_path / "whole")
    group, _ = its.learn(logs=logs, checkpoint=lambda make_states, end: kept.append(saved_and_loaded(make_states())))

    for place in (len(kept) // 2, len(kept) - 1):
        for seed in SEEDS:
            (tmp_path / f"{seed}.jsonl").write_bytes((tmp_path / "whole" / f"{seed}.jsonl").read_bytes())
        pairs = zip(SEEDS, kept[place], strict=True)
        resumed_logs = [RunLog.resume(tmp_path / f"{seed}.jsonl", state["log"]) for seed, state in pairs]
        resumed, _ = its.learn(saved=kept[place], logs=resumed_logs)
        assert equal(states(resumed), states(group))
        assert list(map(lines, resumed_logs)) == list(map(lines, logs))


def spoil(monkeypatch, numbers=(1,)) -> None:
    """Let weights of some seeds be nan when the first batch of the second task is learned from."""
    learn, batches = SeedGroup.learn, []

    def spoiled(group, batch):
        batches.append(batch)
        for number in numbers if len(batches) == 3 else ():
            group.learners[number].weights[0].data.fill_(torch.nan)
        return learn(group, batch)

    monkeypatch.setattr(SeedGroup, "learn", spoiled)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "method"), [("a2c", "finetune"), *SOME[1:]])
def test_a_seed_that_is_not_finite_fails_alone_and_changes_no_bit_of_another(make, monkeypatch, tmp_path, name, method):
    its, kept = make(name, method), []
    group, logs = its.learn()

    spoil(monkeypatch)
    spoiled = its.group()
    spoiled_logs = [RunLog(tmp_path / f"{seed}.jsonl") for seed in SEEDS]
    more = {"checkpoint": lambda make_states, end: kept.append(saved_and_loaded(make_states()))}
    failed = learn_together(CURRICULUM, spoiled, SEEDS, spoiled_logs, **more)

    assert list(failed) == [1]
    assert re.match(
        r"seed 3: (loss_\w+|the largest weight) is nan in block 2 after 80 frames; the run stops here", str(failed[1])
    )
    for number in (0, 2):
        assert equal(states(group)[number], states(spoiled)[number])
        assert lines(logs[number]) == lines(spoiled_logs[number])
    assert lines(spoiled_logs[1]) == lines(logs[1])[: len(lines(spoiled_logs[1]))]
    assert all(line["frames"] < 80 for line in lines(spoiled_logs[1]))
    resumed_logs = [
        RunLog.resume(tmp_path / f"{seed}.jsonl", state["log"]) for seed, state in zip(SEEDS, kept[3], strict=True)
    ]
    resumed = its.group()
    again = learn_together(CURRICULUM, resumed, SEEDS, resumed_logs, saved=kept[3])
    assert str(again[1]) == str(failed[1])
    assert equal(states(resumed), states(spoiled))


def test_a_group_of_which_every_seed_has_failed_stops(make, monkeypatch):
    its, logs = make("ppo"), [RunLog() for _ in SEEDS]
    spoil(monkeypatch, range(3))

    failed = learn_together(CURRICULUM, its.group(), SEEDS, logs)

    assert list(failed) == [0, 1, 2]
    assert all(lines(log)[-1]["frames"] < 80 for log in logs)


class Doubled(L2):
    """A method with a hook that its base does not know."""

    def __init__(self) -> None:
        super().__init__(coeff=1.0, heads="single")

    def transform_gradients(self, gradients, weights):
        """Gradients of one seed."""
        return [2 * gradient for gradient in gradients]


def test_what_cannot_be_one_batch_says_why(compose):
    def reason(agent: str, method: str = "finetune", *more: str) -> str | None:
        cfg = compose(f"agent={agent}", f"method={method}", *TINY, *more)
        make_agent = with_method(target(cfg, "agent"), target(cfg, "method"), CURRICULUM)
        return together.why_not_together(new_agent(CURRICULUM, make_agent, 0))

    assert reason("drqn", "finetune") == "DRQN cannot be vectorised over seeds"
    agent = new_agent(CURRICULUM, with_method(target(compose("agent=ppo", *TINY), "agent"), Doubled, CURRICULUM), 0)
    assert (
        together.why_not_together(agent)
        == "Doubled cannot be vectorised over seeds: its hooks take the weights of one seed"
    )
    assert str(reason("ppo", "mask_amsc")).startswith("MaskAMSC cannot be vectorised over seeds: ")
    for cell in ("attention", "backpropamine"):
        assert "no less time on a CPU" in str(reason("lstm_ppo", "finetune", f"cell={cell}"))
    assert reason("lstm_ppo") is reason("lstm_ppo", "finetune", "cell=gru") is None
    assert reason("lstm_ppo") is reason("dqn") is reason("ppo", "mask_lc") is reason("ppo", "packnet") is None
    switching = of(Block((ONE, TWO), 96, ByEpisode(2, together=True)), boundaries="hidden")
    assert why_not_together(switching) == "its blocks change the tasks of all rows at once"
    assert why_not_together(CURRICULUM) is None
