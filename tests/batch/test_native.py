"""The C kernel: the bits of the tensor code, for every kind of task, batch, call and face."""

from __future__ import annotations

import copy
import inspect
import pickle
import re
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing.reduction import ForkingPickler

import numpy as np
import pytest
import torch
from helpers.oracles import confounding, fully_observable, record, scripts, surjective
from helpers.small_agents import others_slow
from helpers.task_families import EVERY_KIND, MIXED, batch, batches, calls, examples, likely, seeds
from hypothesis import given
from tensordict import TensorDictBase
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.fx.experimental.proxy_tensor import make_fx
from torchrl.envs import StepCounter, TransformedEnv

from ctgraph_rl import Block, CTGraphEnv, Curriculum, Rows, Steps, rollout
from ctgraph_rl.batch import native
from ctgraph_rl.batch.native import Native
from ctgraph_rl.core import kernel as library
from ctgraph_rl.core.rewards import Arrival
from ctgraph_rl.core.row_params import ObservationParams, RewardParams
from ctgraph_rl.core.tree import TreeParams
from ctgraph_rl.gym import CTGraphGymEnv, CTGraphVectorEnv
from ctgraph_rl.learn.collect import collect, make_env
from ctgraph_rl.policies import RandomPolicy
from ctgraph_rl.tasks.configurations import ct_co_b1
from ctgraph_rl.tasks.switch import AtRandom, ByEpisode


@pytest.fixture(autouse=True)
def tensors_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the kernel is compared with has no C code in it."""
    monkeypatch.setattr(library, "takes", lambda *tensors: False)


ENGINES = "off", "required"
every_kind = pytest.mark.parametrize("tasks", EVERY_KIND.values(), ids=EVERY_KIND)


def same(first: tuple[Tensor, ...], second: tuple[Tensor, ...]) -> bool:
    """Whether tensors are the same bit for bit: the sign of a zero counts."""
    pairs = zip(first, second, strict=True)
    return all(a.dtype == b.dtype and np.array_equal(bits(a), bits(b)) for a, b in pairs)


def bits(value: Tensor) -> np.ndarray:
    return value.contiguous().numpy().view(np.uint8 if value.element_size() == 1 else f"u{value.element_size()}")


@every_kind
@pytest.mark.parametrize("num_rows", [5, *(pytest.param(number, marks=pytest.mark.slow) for number in (1, 1000))])
def test_a_compiled_rollout_gives_the_bits_of_the_tensor_code(tasks, num_rows):
    tasks = batch(tasks, num_rows)
    rows, twin = (Rows(tasks, seed=2**62 + 5, first_row=2**31, kernel="off") for _ in range(2))
    actions = likely(tasks, 40)

    for part in actions.split(25):
        eager = rollout(rows, part, Steps.empty(rows, len(part)))
        compiled = rollout(twin, part, Steps.empty(twin, len(part)), kernel="required")

        assert same(eager, compiled)
        assert same(rows.state, twin.state)


def test_threads_and_large_batches_change_no_bit():
    tasks = batch(MIXED, 8192)
    actions, made = likely(tasks, 5), []

    for threads, kernel in ((1, "off"), (1, "required"), (2, "required"), (3, "required")):
        torch.set_num_threads(threads)
        rows = Rows(tasks, seed=1, kernel=kernel)
        made.append((*rollout(rows, actions, Steps.empty(rows, 5)), *rows.state))
    torch.set_num_threads(1)

    assert all(same(made[0], other) for other in made[1:])


@every_kind
def test_every_call_of_compiled_rows_gives_the_bits_of_the_tensor_code(tasks):
    tasks = batch(tasks, 6)
    rows, twin = (Rows(tasks, seed=3, first_row=2, kernel=kernel) for kernel in ENGINES)

    for number, (name, args) in enumerate(calls(40, len(tasks))):
        expected, found = getattr(rows, name)(*args), getattr(twin, name)(*args)

        expected, found = ((one,) if isinstance(one, Tensor) else one for one in (expected, found))
        assert same(expected, found), (number, name)
        assert same(rows.state, twin.state), (number, name)


@pytest.mark.parametrize("kind", others_slow(EVERY_KIND, *list(EVERY_KIND)[::4]))
def test_the_compiled_environment_gives_the_same_data_alone_and_when_it_is_wrapped(kind):
    tasks = batch(EVERY_KIND[kind], 6)
    eager, alone, inner = (
        CTGraphEnv(tasks, seed=3, noise_bank=5, kernel=kernel) for kernel in ("off", "required", "required")
    )
    wrapped = TransformedEnv(inner, StepCounter(step_count_key="steps"))
    actions = likely(tasks, 25)

    data, found, other = (record(env, actions) for env in (eager, alone, wrapped))

    assert (data == found).all() and set(data.keys(True, True)) == set(found.keys(True, True))
    assert (data == other.select(*data.keys(True, True))).all()
    assert same(eager.rows.state, alone.rows.state) and same(eager.rows.state, inner.rows.state)


@examples(7)
@given(batches(), seeds)
def test_any_tasks_compiled_give_the_bits_of_the_tensor_code(tasks, seed):
    rows, twin = (Rows(tasks, seed=seed, kernel="off") for _ in range(2))
    actions = likely(tasks, 30, seed)

    assert same(
        rollout(rows, actions, Steps.empty(rows, 30)), rollout(twin, actions, Steps.empty(twin, 30), kernel="required")
    )
    assert same(rows.state, twin.state)


@pytest.mark.parametrize(
    "switch",
    [
        *(pytest.param(each, marks=pytest.mark.slow) for each in (ByEpisode(2), AtRandom(0.4))),
        AtRandom(0.5, together=True),
    ],
)
def test_rows_that_change_their_tasks_give_the_same_data_compiled(switch):
    pool = [surjective(goal=(1, 2)), *MIXED]
    eager, compiled = (CTGraphEnv([pool[0]] * 20, task_pool=pool, kernel=kernel) for kernel in ENGINES)
    for env in (eager, compiled):
        env.switch_tasks(pool, switch)
    actions = scripts(25, 20)

    assert (record(eager, actions) == record(compiled, actions)).all()
    assert torch.equal(eager.rows.task, compiled.rows.task)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_the_gymnasium_batch_gives_the_same_data_compiled(mode):
    eager, compiled = (CTGraphVectorEnv(8, batch(MIXED, 8), autoreset_mode=mode, kernel=k) for k in ENGINES)
    actions = scripts(40, 8, 4).numpy()
    assert np.array_equal(eager.reset(seed=5)[0], compiled.reset(seed=5)[0])

    for action in actions:
        expected, found = eager.step(action), compiled.step(action)

        assert all(np.array_equal(*pair) for pair in zip(expected[:4], found[:4], strict=True))
        assert all(np.array_equal(expected[4][key], found[4][key]) for key in ("task", "outcome", "leaf"))
        if mode == "Disabled" and expected[2].any():
            options = {"reset_mask": expected[2]}
            assert np.array_equal(eager.reset(options=options)[0], compiled.reset(options=options)[0])


def test_the_gymnasium_environment_gives_the_same_data_compiled():
    eager, compiled = (CTGraphGymEnv(confounding(p=0.3), kernel=kernel) for kernel in ENGINES)

    for action in scripts(30, 1).flatten().tolist():
        if eager._is_over:
            assert np.array_equal(eager.reset(seed=9)[0], compiled.reset(seed=9)[0])
        expected, found = eager.step(action), compiled.step(action)
        assert np.array_equal(expected[0], found[0]) and expected[1:] == found[1:]


@pytest.mark.parametrize("clone", [copy.deepcopy, lambda rows: pickle.loads(pickle.dumps(rows))])
def test_a_copy_of_compiled_rows_goes_on_as_its_original(clone):
    rows = Rows(batch(MIXED, 6), kernel="required")
    rollout(rows, likely(batch(MIXED, 6), 7), Steps.empty(rows, 7))
    twin = clone(rows)

    found = [rollout(one, scripts(9, 6), Steps.empty(one, 9)) for one in (rows, twin)]

    assert same(*found) and twin.uses_kernel


def test_new_goals_tasks_streams_and_checkpoints_reach_the_kernel():
    tasks = [surjective(goal=(1, 2)), replace(confounding(p=0.5), reward_std=0.5)]
    rows, twin = (Rows(tasks * 3, kernel=kernel) for kernel in ENGINES)
    streams = torch.arange(6) + 2**40, torch.arange(6)
    changes = [
        lambda one: one.set_goals(torch.tensor([1, 2, 3] * 2)),
        lambda one: one.set_tasks(tasks[::-1] * 3),
        lambda one: one.set_tasks(tasks * 3, at_episode_end=True),
        lambda one: one.load_state_dict(Rows(tasks * 3, seed=8).state_dict()),
        lambda one: one.set_streams(*streams),
    ]

    for change in changes:
        for one in (rows, twin):
            change(one)
            one.restart()
        for action in scripts(12, 6):
            assert same(rows.step(action), twin.step(action))
            assert torch.equal(rows.restart(rows.is_done), twin.restart(twin.is_done))
    assert same(rows.state, twin.state)


@dataclass(frozen=True)
class Half:
    """A user's own reward."""

    def __call__(self, arrival: Arrival) -> Tensor:
        return (arrival.leaf == arrival.goal_leaf).float() / 2


OWN = replace(surjective(), reward_fn=Half())


def test_what_a_required_kernel_cannot_run_is_refused_with_the_fix():
    rows = Rows([OWN])

    with pytest.raises(ValueError, match=r'rewards Needle.*got \[Half\(\)\]; use kernel="auto" or kernel="off"'):
        Rows([OWN], kernel="required")
    with pytest.raises(ValueError, match="knows the rewards"):
        rollout(rows, scripts(2, 1), Steps.empty(rows, 2), kernel="required")
    with pytest.raises(ValueError, match='runs on a CPU, got meta; use kernel="auto"'):
        Rows([surjective()], kernel="required").to("meta")
    for make in (partial(Rows, [surjective()]), partial(CTGraphEnv, [surjective()]), partial(CTGraphVectorEnv, 2)):
        with pytest.raises(ValueError, match="kernel must be one of auto, off, required, got True"):
            make(kernel=True)
    with pytest.raises(ValueError, match="kernel must be one of auto, off, required, got 'on'"):
        rollout(rows, scripts(2, 1), Steps.empty(rows, 2), kernel="on")


def test_by_default_the_kernel_runs_where_it_can_and_the_tensor_engine_elsewhere():
    found = [Rows([surjective()]), CTGraphEnv([surjective()]).rows, CTGraphGymEnv().rows, CTGraphVectorEnv(2).rows]

    assert all(rows.uses_kernel for rows in found)
    assert not Rows([surjective()], kernel="off").uses_kernel
    assert not Rows([surjective()], task_pool=[surjective(), OWN]).uses_kernel
    assert not Rows([surjective()]).to("meta").uses_kernel


def test_what_is_traced_takes_the_tensor_engine():
    rows, seen = Rows([surjective()] * 2), []
    rows.reset()

    def look(action: Tensor) -> Tensor:
        seen.append(rows.uses_kernel)
        return action + 1

    torch.vmap(look)(torch.zeros(3, 2))
    make_fx(look)(torch.zeros(2))
    torch.jit.trace(look, torch.zeros(2), check_trace=False)
    compiled = torch.compile(lambda action: action + rows.uses_kernel, backend="eager", fullgraph=True)
    with FakeTensorMode():
        look(torch.zeros(2))

    assert seen == [False] * 4 and compiled(torch.zeros(2)).tolist() == [0, 0] and rows.uses_kernel
    assert not rows._apply(FakeTensorMode().from_tensor).uses_kernel


@pytest.mark.parametrize("kernel", ["auto", "off", "required"])
def test_a_rollout_takes_the_engine_of_its_rows_or_the_one_that_it_is_given(monkeypatch, kernel):
    taken, run = [], Native.run
    monkeypatch.setattr(Native, "run", lambda *args, **kwargs: taken.append(1) or run(*args, **kwargs))
    rows, uses = Rows([surjective()] * 2, kernel=kernel), []

    for wanted in ("auto", "off", "required"):
        taken.clear()
        rollout(rows, scripts(2, 2), Steps.empty(rows, 2), kernel=wanted)
        uses.append(bool(taken))

    assert uses == [kernel != "off", False, True]


def test_arrays_that_do_not_fit_are_refused_before_anything_is_written():
    rows = Rows([surjective()] * 4, kernel="required")
    steps = Steps.empty(rows, 2)
    wide = torch.zeros(3, 4, 1, 12, 13, dtype=torch.uint8)
    rows.reset()

    with pytest.raises(ValueError, match=r"observation must be torch.uint8 with 576 elements in a row"):
        rollout(rows, scripts(2, 4), steps._replace(observation=wide[..., :12]))
    with pytest.raises(ValueError, match=r"action must be torch.int64 with 4 elements in a row.*got torch.int64 \[3\]"):
        rows.step(torch.zeros(3, dtype=torch.int64))
    with pytest.raises(ValueError, match=r"action must be torch.int64.*got torch.int32 \[4\]"):
        rows.step(torch.zeros(4, dtype=torch.int32))
    assert not wide.any()


@pytest.mark.parametrize(("field", "value"), [("node", 2**40), ("node", -(2**40)), ("state_type", 5)])
def test_a_state_outside_the_tables_is_refused(field, value):
    rows = Rows([fully_observable()] * 3, kernel="required")
    rows.reset()
    kind = {"state_type": torch.full_like(rows.state_type, 1)}
    rows.state = rows.state._replace(**(kind | {field: torch.full_like(getattr(rows, field), value)}))

    with pytest.raises(ValueError, match="the rows' states are none of their tasks"):
        rows.step(torch.zeros(3, dtype=torch.int64))


def test_data_are_not_changed_by_later_steps():
    env = CTGraphEnv([confounding()] * 5, kernel="required")
    before = env.reset().clone()
    data = before.clone()
    step, _ = env.step_and_maybe_reset(data.set("action", torch.zeros(5, dtype=torch.int64)))
    kept, state = step.clone(), [value.clone() for value in env.rows.state]
    held = env.rows.state

    record(env, scripts(5, 5), env.reset())

    assert (step == kept).all() and same(held, tuple(state))


@pytest.mark.parametrize("missing", [None, "a compiler", "the rewards"])
def test_a_run_steps_by_the_kernel_where_there_is_one_and_elsewhere_by_tensors(monkeypatch, missing):
    if missing == "a compiler":
        monkeypatch.setattr("ctgraph_rl.batch.rows.is_available", lambda: False)
    if missing == "the rewards":
        monkeypatch.setattr(native, "KERNEL_REWARDS", ())
    curriculum = Curriculum("one", 1, "-", (Block(confounding(2, 2, 0.5), 480),))
    plain = CTGraphEnv(curriculum.tasks * 8, 3, kernel="off")

    env = make_env(curriculum, curriculum.tasks * 8, 3)

    assert env.rows.uses_kernel == (missing is None)
    assert all((one == other).all() for one, other in zip(*map(random_batches, (env, plain)), strict=True))


def random_batches(env: CTGraphEnv) -> list[TensorDictBase]:
    torch.manual_seed(0)
    return list(collect(env, RandomPolicy(env), 480, 20))


def test_the_kernel_reads_every_parameter_of_tasks_but_what_it_has_in_another_form():
    in_another_form = {"first_kind", "bank_start", "first_move", "next_kind", "decides", "width", "by_action"}
    source = inspect.getsource(native)

    named = {name for part in (TreeParams, ObservationParams, RewardParams) for name in part._fields}

    assert {name for name in named if not re.search(rf"\.{name}\b", source)} <= in_another_form


def test_tables_that_are_moved_into_shared_memory_are_read_where_they_are():
    tasks = [ct_co_b1()] * 64
    moved, plain = (CTGraphEnv(tasks, seed=3, kernel=kernel) for kernel in ("required", "off"))
    here, there = moved.reset(), plain.reset()
    actions = torch.randint(0, 3, (20, 64), generator=torch.Generator().manual_seed(0))
    before = moved.rows.bank.data_ptr()

    ForkingPickler.dumps(moved)  # as torch.multiprocessing does with what it sends

    assert moved.rows.bank.data_ptr() != before
    for action in actions:
        _, here = moved.step_and_maybe_reset(here.set("action", action))
        _, there = plain.step_and_maybe_reset(there.set("action", action))
        assert torch.equal(here["observation"], there["observation"])
