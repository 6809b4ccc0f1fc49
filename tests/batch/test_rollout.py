"""The fast path: the same data as the standard path, for every kind of task."""

from __future__ import annotations

from itertools import product

import pytest
import torch
from helpers.oracles import record, scripts, surjective
from helpers.small_agents import others_slow
from helpers.task_families import FAMILIES, MIXED
from torchrl.envs import StepCounter, TransformedEnv

from ctgraph_rl import CTGraphEnv, Rows, Steps, Task, rollout
from ctgraph_rl.batch.tensor_engine import MAX_TICKS
from ctgraph_rl.core import philox

ENGINES = ("off", "required")
every_engine = pytest.mark.parametrize("kernel", ENGINES)
NUM_ROWS, NUM_STEPS = 8, 60


def rows_of(tasks: list[Task]) -> list[Task]:
    return (tasks * NUM_ROWS)[:NUM_ROWS]


def actions_of(tasks: list[Task], num_steps: int = NUM_STEPS) -> torch.Tensor:
    return scripts(num_steps, NUM_ROWS, 1 + max(task.graph.branching_factor for task in tasks))


def assert_same(steps: Steps, data) -> None:
    """``data`` [N, T] of the standard path."""
    assert torch.equal(steps.observation[:-1], data["observation"].transpose(0, 1))
    for field in ("is_init", "action"):
        ours = getattr(steps, field)[: steps.action.shape[0]]
        assert torch.equal(ours, data[field].transpose(0, 1).view(ours.shape))
    for field in ("reward", "done", "outcome"):
        ours = getattr(steps, field)
        assert torch.equal(ours, data["next", field].transpose(0, 1).view(ours.shape))


@pytest.mark.parametrize(
    ("name", "kernel"),
    others_slow(product(FAMILIES, ENGINES), *product(FAMILIES, ["required"]), *product(list(FAMILIES)[::3], ["off"])),
)
def test_the_fast_path_gives_the_data_of_the_standard_path(name, kernel):
    """For all families by the kernel, whose data test_native.py compares with those of the tensor engine."""
    tasks = FAMILIES[name]
    env, rows = (kind(rows_of(tasks), seed=3, first_row=2, kernel=kernel) for kind in (CTGraphEnv, Rows))
    actions = actions_of(tasks)

    data = record(env, actions)
    steps = rollout(rows, actions, Steps.empty(rows, NUM_STEPS))

    assert_same(steps, data)


@pytest.mark.parametrize("name", others_slow(FAMILIES, *list(FAMILIES)[::3]))
def test_the_environment_gives_the_same_data_alone_and_when_it_is_wrapped(name):
    """By the tensor engine; test_native.py compares the kernel's with it."""
    tasks = FAMILIES[name]
    alone, inner = (CTGraphEnv(rows_of(tasks), seed=3, kernel="off") for _ in range(2))
    wrapped = TransformedEnv(inner, StepCounter(step_count_key="steps"))
    actions = actions_of(tasks, 30)

    data, other = record(alone, actions), record(wrapped, actions)

    assert (other.select(*data.keys(True, True)) == data).all()
    assert all(torch.equal(*pair) for pair in zip(alone.rows.state, wrapped.base_env.rows.state, strict=True))


@pytest.mark.slow
@pytest.mark.parametrize(("num_rows", "options"), [(5, None), (16, {"cpp.simdlen": 1})], ids=["vectors", "scalars"])
def test_compiled_draws_are_the_same_words(num_rows, options):
    compiled = torch.compile(philox.draw, fullgraph=True, dynamic=False, options=options)
    wide = torch.compile(philox.randint_wide, fullgraph=True, dynamic=False, options=options)
    seed, row = torch.tensor([2**62 + 12345]), torch.arange(num_rows) * 2**27 + 2**31
    high = torch.arange(1, num_rows + 1) * 2**57 - 1

    words, found = philox.draw(seed, row, row + 2**40, 3), compiled(seed, row, row + 2**40, 3)

    assert all(torch.equal(*pair) for pair in zip(words, found, strict=True))
    assert torch.equal(philox.randint_wide((words[0], words[1]), high), wide((words[0], words[1]), high))


@pytest.mark.slow
@pytest.mark.parametrize(("kernel", "num_graphs"), [("off", 1), ("auto", 2)])  # another for the step after the kernel
def test_the_compiled_environment_gives_the_same_bits_by_few_graphs_and_afterwards_without_them(kernel, num_graphs):
    """Captured and traced; tests/core compiles a step of everything to machine code."""
    tasks, graphs = FAMILIES["confounding"], []

    def traced(graph, inputs):
        graphs.append(graph)
        return torch._dynamo.lookup_backend("aot_eager")(graph, inputs)

    eager, compiled = (CTGraphEnv(rows_of(tasks), check_actions=False, kernel=kernel) for _ in range(2))
    compiled.compile(warmup=2, backend=traced)
    more_than_draws_ahead = actions_of(tasks, MAX_TICKS + 50)

    with torch.no_grad():
        data, other = record(eager, more_than_draws_ahead), record(compiled, more_than_draws_ahead)
        with torch.compiler.set_stance("force_eager"):
            last = [record(env, actions_of(tasks, 10)) for env in (eager, compiled)]

    assert (data == other).all() and (last[0] == last[1]).all()
    assert len(graphs) == num_graphs


@every_engine
def test_a_rollout_goes_on_where_the_last_one_ended(kernel):
    rows, twin = (Rows(rows_of(MIXED), kernel=kernel) for _ in range(2))
    actions = actions_of(MIXED)
    whole = rollout(rows, actions, Steps.empty(rows, NUM_STEPS))

    parts = [rollout(twin, part, Steps.empty(twin, len(part))) for part in actions.split(23)]

    for field in ("action", "reward", "done", "outcome"):
        assert torch.equal(torch.cat([getattr(part, field) for part in parts]), getattr(whole, field))
    for field in ("observation", "is_init"):
        assert torch.equal(torch.cat([getattr(part, field)[:-1] for part in parts]), getattr(whole, field)[:-1])
        assert torch.equal(getattr(parts[-1], field)[-1], getattr(whole, field)[-1])


@every_engine
def test_a_policy_gets_what_it_shall_act_on_and_where_episodes_begin(kernel):
    rows, seen = Rows([surjective(goal=(1, 2))] * 2), []

    def policy(observation: torch.Tensor, is_init: torch.Tensor) -> torch.Tensor:
        seen.append((observation.clone(), is_init.tolist()))
        return torch.tensor([[0, 0, 1, 0, 2, 0][(len(seen) - 1) % 6], 1])

    steps = rollout(rows, policy, Steps.empty(rows, 7), kernel)

    assert torch.equal(torch.stack([observation for observation, _ in seen]), steps.observation[:-1])
    assert [is_init for _, is_init in seen] == steps.is_init[:-1].tolist()
    assert steps.done[:, 0].tolist() == [False] * 5 + [True, False]
    assert steps.outcome[:, 0].tolist() == [0, 0, 0, 0, 0, 3, 0]
    assert steps.reward[:, 0].tolist() == [0, 0, 0, 0, 0, 1, 0]
    assert steps.outcome[:, 1].tolist() == [0, 1, 0, 1, 0, 1, 0]
    assert steps.is_init[:, 1].tolist() == [True, False] * 4


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (torch.zeros(5, 2, dtype=torch.int32), r"actions must be int64 of shape \[5, 2\].*got torch.int32 \[5, 2\]"),
        (torch.zeros(4, 2, dtype=torch.int64), r"got torch.int64 \[4, 2\]"),
        (torch.full((5, 2), 3), r"with values in 0..2, got 3..3"),
        (torch.full((5, 2), -1), r"got -1..-1"),
        (lambda observation, is_init: torch.zeros(3, dtype=torch.int64), r"shape \[2\].*got torch.int64 \[3\]"),
        (lambda observation, is_init: torch.tensor([0, 9]), r"got 0..9"),
    ],
)
def test_what_is_no_action_is_refused_and_the_rows_stay(actions, message):
    rows = Rows([surjective()] * 2)
    rows.reset()
    before = rows.state

    with pytest.raises(ValueError, match=message):
        rollout(rows, actions, Steps.empty(rows, 5))

    assert all(torch.equal(*pair) for pair in zip(rows.state, before, strict=True))


def test_buffers_of_other_rows_are_refused():
    rows, other = Rows([surjective()] * 2), Rows([surjective()] * 3)
    actions, steps = torch.zeros(5, 2, dtype=torch.int64), Steps.empty(rows, 5)

    with pytest.raises(
        ValueError, match=r"Steps.empty\(rows, 5\), got observation torch.uint8 \[6, 3, 1, 12, 12\] on cpu"
    ):
        rollout(rows, actions, Steps.empty(other, 5))
    with pytest.raises(ValueError, match=r"got reward torch.int64 \[5, 2\] on cpu"):
        rollout(rows, actions, steps._replace(reward=steps.reward.long()))
    with pytest.raises(ValueError, match="num_steps must be an integer >= 1, got 0"):
        Steps.empty(rows, 0)


@pytest.mark.parametrize("change", ["goals", "tasks", "reset"])
def test_a_policy_that_changes_the_rows_is_refused(change):
    rows = Rows([surjective()] * 2)
    changes = {"goals": lambda: rows.set_goals([(2, 2)] * 2), "tasks": lambda: rows.set_tasks(rows.tasks)}

    def policy(observation: torch.Tensor, is_init: torch.Tensor) -> torch.Tensor:
        changes.get(change, rows.reset)()
        return torch.zeros(2, dtype=torch.int64)

    with pytest.raises(ValueError, match="a policy must not change the rows during a rollout"):
        rollout(rows, policy, Steps.empty(rows, 3))


@pytest.mark.parametrize("policy", [None, [[0, 0]], torch.zeros(1, 2).numpy()])
def test_what_is_no_policy_is_refused(policy):
    rows = Rows([surjective()] * 2)

    with pytest.raises(ValueError, match="policy must be a function or a tensor of actions"):
        rollout(rows, policy, Steps.empty(rows, 1))
    with pytest.raises(ValueError, match=r"actions must be int64 of shape \[2\]"):
        rollout(rows, lambda observation, is_init: policy, Steps.empty(rows, 1))


def test_nothing_is_learned_through_a_rollout():
    rows, weight = Rows([surjective()] * 2), torch.ones(1, requires_grad=True)

    steps = rollout(rows, lambda observation, _: (observation[:, 0, 0, 0] * weight > 300).long(), Steps.empty(rows, 5))

    assert not any(buffer.requires_grad for buffer in steps)
