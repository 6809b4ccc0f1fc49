"""What holds for every lifelong-learning method and agent: what is refused, runs, saved states, fine-tuning."""

from __future__ import annotations

from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from helpers.kill_runs import equal
from helpers.scripted import ONE, THREE, TWO, Scripted, of
from helpers.small_agents import MINIBATCHES, REPLAY, TINY, made, others_slow, saved_and_loaded, weights_for

from baselines.methods.method import Method, TaskMethod
from baselines.methods.parts.importance import Samples
from ctgraph_rl import Block, Curriculum, Evaluation, RunLog, learn_curriculum
from ctgraph_rl.packages import conf_dir
from ctgraph_rl.runs import job
from ctgraph_rl.runs.train import new_agent

AGENTS = {"a2c": [], "dqn": REPLAY, "drqn": REPLAY, "lstm_ppo": MINIBATCHES, "ppo": MINIBATCHES}

SETTINGS = {
    "clear": ["method.buffer_size=48"],
    "ewc": ["method.num_samples=8", "method.heads=single"],
    "ewc_published": ["method.num_samples=8"],
    "l2": ["method.heads=multi"],
    "mas": ["method.num_samples=8"],
    "mask_amsc": ["method.num_samples=8", "method.competence=none", "method.shuffled=true"],
    "mask_sc": ["method.num_samples=8", "method.every=1", "method.threshold=-1"],
    "si": ["method.heads=single"],
}
"""Overrides that make a method small, or meet more of it."""

METHODS = sorted(path.stem for path in Path(conf_dir(), "method").glob("*.yaml"))

BLOCKS = (Block(ONE, 80), Block(TWO, 64), Block(THREE, 96), Block(ONE, 40))
CURRICULUM = of(*BLOCKS, evaluation=Evaluation(2, greedy=False, before=False), task_id="one_hot")
"""Batches of 32 frames, and at the end of blocks of less; the first task comes again."""

KEPT = (4, 8)
"""Updates after which a state is kept: within the second block, and at the end of the third."""


class Life(NamedTuple):
    """Learns a curriculum with a new agent with a method."""

    curriculum: Curriculum
    make_agent: Any

    def new(self) -> Any:
        return new_agent(self.curriculum, self.make_agent, 0)

    def live(
        self, saved: dict[str, Any] | None = None, kept: tuple[int, ...] = KEPT
    ) -> tuple[Any, list[dict[str, Any]], list[Any]]:
        """The agent at the end, what was logged, and the states after some updates."""
        agent, log, updates, states = self.new(), RunLog(), count(1), []

        def keep(state: Any, at_block_end: bool) -> None:
            if next(updates) in kept:
                states.append(saved_and_loaded(state()))

        torch.manual_seed(0 if saved is None else 1234)
        learn_curriculum(self.curriculum, agent, 7, log, saved=saved, checkpoint=keep)
        lines = [{key: value for key, value in line.items() if key != "seconds"} for line in log.measurements]
        return agent, lines, states


def life(compose, agent: str, method: str, *overrides: str, curriculum: Curriculum = CURRICULUM) -> Life:
    make_alone = made(compose, "agent", agent, *TINY, *AGENTS[agent])
    make_method = made(compose, "method", method, *SETTINGS.get(method, []), *overrides)
    prepared = make_method().prepare(curriculum)
    return Life(prepared, lambda *specs: make_method().attach(make_alone(*specs), prepared))


# What is refused


NEEDS_IDS = ("cka_rl", "mask_amsc", "mask_blc", "mask_lc", "mask_ri", "mask_sc", "mask_shared", "packnet", "scratch")
NEEDS_BOUNDARIES = ("ewc", "ewc_published", "l2", "mas", "si", *NEEDS_IDS)
FREE = ("clear", "finetune", "multitask")


def prepared(compose, method: str, curriculum: Curriculum, *overrides: str) -> Curriculum:
    return made(compose, "method", method, *overrides)().prepare(curriculum)


@pytest.mark.parametrize("method", [*NEEDS_IDS, "ewc_published"])
def test_hidden_task_ids_are_refused_where_they_are_needed(compose, method):
    with pytest.raises(
        ValueError, match=r" needs task ids, which are hidden: set protocol\.task_id=one_hot or at_boun"
    ):
        prepared(compose, method, of(*BLOCKS))


@pytest.mark.parametrize("method", ["l2", "ewc", "mas", "si"])
def test_output_layers_of_each_task_need_task_ids_and_shared_ones_do_not(compose, method):
    assert prepared(compose, method, of(*BLOCKS)) == of(*BLOCKS)

    with pytest.raises(
        ValueError, match=r"needs task ids, which are hidden: .* or at_boundaries, or method\.heads=single"
    ):
        prepared(compose, method, of(*BLOCKS), "method.heads=multi")


@pytest.mark.parametrize("method", NEEDS_BOUNDARIES)
def test_hidden_boundaries_are_refused_where_they_are_needed(compose, method):
    curriculum = of(*BLOCKS, boundaries="hidden", task_id="one_hot")

    with pytest.raises(ValueError, match=r" needs announced task changes: set protocol\.boundaries=announced"):
        prepared(compose, method, curriculum)


@pytest.mark.parametrize("method", NEEDS_IDS)
def test_blocks_of_several_tasks_are_refused_where_each_task_has_something_of_its_own(compose, method):
    curriculum = of(Block(ONE, 64), Block((ONE, TWO), 64), Block((TWO, THREE), 64), task_id="one_hot")

    with pytest.raises(ValueError, match=r" needs blocks of one task each, and blocks \[2, 3\] have several"):
        prepared(compose, method, curriculum)


@pytest.mark.parametrize("method", FREE)
def test_what_needs_to_know_nothing_takes_any_curriculum(compose, method):
    curriculum = of(Block((ONE, TWO), 64), Block(THREE, 64), boundaries="hidden")

    assert prepared(compose, method, curriculum).num_frames == 128


@pytest.mark.parametrize("method", [name for name in METHODS if name not in ("finetune", "multitask")])
def test_an_agent_that_is_no_learner_is_refused_before_it_is_touched(compose, method):
    agent = Scripted()
    before = dict(vars(agent))

    with pytest.raises(ValueError, match=r" needs an agent with `method`, `weights`.*, got Scripted: derive it from "):
        made(compose, "method", method)().attach(agent, CURRICULUM)

    assert vars(agent) == before


def test_a_refused_pair_leaves_no_file(compose, tmp_path):
    cfg = compose("curriculum=fo_b1_4tasks", "agent=ppo", "method=mask_lc")

    with pytest.raises(ValueError, match="MaskLC needs task ids, which are hidden"):
        job.run_job(cfg, tmp_path)

    assert list(tmp_path.iterdir()) == []


def test_multitask_refuses_what_cannot_be_learned_at_once(compose):
    with pytest.raises(ValueError, match="needs at least two tasks, got one"):
        prepared(compose, "multitask", of(Block(ONE, 64), Block(ONE, 64)))
    with pytest.raises(
        ValueError, match=r"has no boundaries to give task ids at: set protocol\.task_id=one_hot or hid"
    ):
        prepared(compose, "multitask", of(*BLOCKS, task_id="at_boundaries"))


WRONG = [
    ("clear", "buffer_size=0", "buffer_size must be an integer >= 1, got 0"),
    ("clear", "policy_coeff=-1", "policy_coeff must be a number >= 0, got -1"),
    ("clear", "value_coeff=x", "value_coeff must be a number >= 0, got 'x'"),
    ("cka_rl", "scope=trunk", "scope must be one of actor_head, all, got 'trunk'"),
    ("cka_rl", "pool_size=0", "pool_size must be an integer >= 1, got 0"),
    ("ewc", "coeff=0", "coeff must be a number > 0, got 0"),
    ("ewc", "online=1", "online must be true or false, got 1"),
    ("ewc", "alpha=1.5", "alpha must be .* got 1.5"),
    ("ewc", "fisher=true_one", "fisher must be one of policy, loss, got 'true_one'"),
    ("ewc", "num_samples=0", "num_samples must be an integer >= 1, got 0"),
    ("l2", "heads=two", "heads must be one of auto, single, multi, got 'two'"),
    ("mas", "num_samples=1.5", "num_samples must be an integer >= 1, got 1.5"),
    ("mask_amsc", "distance=near", "distance must be one of cosine, l2, got 'near'"),
    ("mask_amsc", "competence=test", "competence must be one of training, evaluation, none, got 'test'"),
    ("mask_amsc", "temperature=0", "temperature must be a number > 0, got 0"),
    ("mask_amsc", "num_samples=20000", "at least num_samples=20000, or no task is embedded, got 10000"),
    ("mask_sc", "embedding=ot", "embedding must be one of lwe, swe, got 'ot'"),
    ("mask_sc", "every=0", "every must be an integer >= 1, got 0"),
    ("mask_sc", "selection=best", "selection must be one of similarity, random, none, all, parent, depth_prefix, got"),
    ("mask_sc", "threshold=2", r"threshold must be a number in \[-1, 1\], got 2"),
    ("packnet", "retrain=1", r"retrain must be a number in \[0, 1\), got 1"),
    ("si", "epsilon=0", "epsilon must be a number > 0, got 0"),
]


@pytest.mark.parametrize(("method", "setting", "message"), WRONG)
def test_a_value_out_of_range_is_refused_and_named(compose, method, setting, message):
    with pytest.raises(ValueError, match=message):
        made(compose, "method", method, f"method.{setting}")()


def test_a_buffer_that_holds_no_whole_row_is_refused_where_rows_are_replayed(compose):
    with pytest.raises(ValueError, match="buffer_size must be at least the 4 steps of a row, got 3"):
        life(compose, "lstm_ppo", "clear", "method.buffer_size=3").new()

    assert len(life(compose, "ppo", "clear", "method.buffer_size=3").new().method.reservoir) == 0


# Runs


ENOUGH = ("cka_rl", "clear", "ewc", "packnet")
"""A method of each family."""


@pytest.mark.parametrize(
    ("agent", "method"),
    [
        pytest.param(agent, method, marks=[pytest.mark.slow] if other or method not in ENOUGH else [])
        for number, method in enumerate(METHODS)
        for place, agent in enumerate(AGENTS)
        if (other := (number + place) % len(AGENTS)) == 0 or (other == 2 and method in ENOUGH)
    ],
)
def test_agents_go_on_with_every_method_as_if_never_stopped(compose, agent, method):
    its = life(compose, agent, method)
    whole, lines, states = its.live()
    state = states[(METHODS.index(method) + list(AGENTS).index(agent)) % 2]  # half of a method's agents take the first

    resumed, later, _ = its.live(state)
    assert equal(dict(resumed.state_dict()), dict(whole.state_dict()))
    assert later and later == lines[-len(later) :]
    if method != "multitask":
        assert [state["frames"] for state in states] == [112, 240]
    check_policies(its, whole)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["ewc", "mas"])
def test_a_run_goes_on_from_the_end_of_a_block_that_has_shortened_the_sequences_that_are_kept(compose, method):
    its = life(compose, "lstm_ppo", method, "method.num_samples=64")

    whole, _, (state,) = its.live(kept=(3,))
    resumed, _, _ = its.live(state)

    steps = [
        part["items"]["action"].shape[1] for part in state["agent"]["agent.method._extra_state"]["samples"]["parts"]
    ]
    assert state["frames"] == 80 and steps == [4, 2]
    assert equal(dict(resumed.state_dict()), dict(whole.state_dict()))


def test_kept_minibatches_of_one_length_are_restored():
    samples, restored = Samples(8), Samples(8)
    for size in (3, 5):
        samples.remaining = 8
        samples.add({"action": torch.rand(size, 2), "learnt": torch.rand(size, 2) < 0.5})

    restored.restore(samples.state(), torch.device("cpu"))

    assert restored.num_held == samples.num_held
    assert equal(restored.state(), samples.state())


def test_frames_that_are_not_learned_from_do_not_count_among_the_samples():
    samples = Samples(4)
    for learnt in (1, 1, 3):
        samples.add({"action": torch.arange(4), "learnt": torch.arange(4) < learnt})

    assert [int(each["learnt"].sum()) for each in samples.minibatches] == [1, 3]
    assert samples.num_held == 4


def check_policies(its: Life, whole: Any) -> None:
    """A loaded agent has equal policies for every task, which differ where something is kept for each task."""
    differ = any(isinstance(module, TaskMethod) for module in whole.modules())
    loaded = its.new()
    loaded.load_state_dict(saved_and_loaded(whole.state_dict()))

    policies = [weights_for(whole, number) for number in range(3)]
    assert equal(policies, [weights_for(loaded, number) for number in range(3)])
    assert equal(policies[0], policies[1]) != differ


def test_packnet_goes_on_before_it_prunes_within_a_block(compose, monkeypatch):
    monkeypatch.setitem(globals(), "KEPT", (1,))
    its = life(compose, "ppo", "packnet", "method.retrain=0.3")  # prunes before the third update

    whole, _, states = its.live()
    resumed, _, _ = its.live(states[0])

    assert equal(dict(resumed.state_dict()), dict(whole.state_dict()))


@pytest.mark.parametrize("method", ["ewc_published", "mask_lc", "packnet"])
def test_ids_at_boundaries_are_enough(compose, method):
    curriculum = replace(CURRICULUM, protocol=replace(CURRICULUM.protocol, task_id="at_boundaries"))

    whole, lines, _ = life(compose, "ppo", method, curriculum=curriculum).live()

    assert whole.method.started if method != "ewc_published" else whole.method.heads.started == [0, 1, 2]
    assert sum(line["kind"] == "evaluation" for line in lines) == 12


@pytest.mark.parametrize("method", ["ewc", "l2", "mas", "si"])
def test_each_task_has_output_layers_of_its_own_where_ids_are_told_unless_it_is_said_otherwise(compose, method):
    hidden = replace(CURRICULUM, protocol=replace(CURRICULUM.protocol, task_id="hidden"))

    told = life(compose, "ppo", method, "method.heads=auto").new()
    secret = life(compose, "ppo", method, "method.heads=auto", curriculum=hidden).new()

    assert told.method.heads is not None
    assert secret.method.heads is None


def test_a_first_block_that_is_no_whole_batch_can_be_learned_with_replayed_rows(compose):
    curriculum = replace(CURRICULUM, blocks=(Block(ONE, 16), Block(TWO, 64)))

    whole, _, _ = life(compose, "lstm_ppo", "clear", curriculum=curriculum).live()

    assert len(whole.method.reservoir) == 12  # the second block's rows, of which 12 have 48 steps


# Fine-tuning


@pytest.mark.parametrize("agent", AGENTS)
def test_fine_tuning_is_the_agent_itself(compose, agent):
    alone = new_agent(CURRICULUM, made(compose, "agent", agent, *TINY, *AGENTS[agent]), 0)

    assert made(compose, "method", "finetune")().attach(alone, CURRICULUM) is alone


@pytest.mark.parametrize("agent", others_slow(AGENTS, "a2c"))
def test_the_hooks_of_no_method_change_no_bit(compose, agent):
    alone = life(compose, agent, "finetune")
    attached = Life(alone.curriculum, lambda *specs: Method().attach(alone.make_agent(*specs), alone.curriculum))

    (plain, lines, _), (hooked, others, _) = alone.live(), attached.live()

    assert equal(dict(plain.state_dict()), dict(hooked.agent.state_dict()))
    assert lines == others


def test_fine_tuning_takes_an_agent_that_is_no_learner(compose):
    agent = Scripted()

    assert made(compose, "method", "finetune")().attach(agent, CURRICULUM) is agent


def test_no_more_items_are_samples_than_there_are_frames_asked_for():
    samples = Samples(3)
    samples.add({"action": torch.arange(8)})

    assert len(list(samples.items())) == 3
