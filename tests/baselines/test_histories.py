"""Frames of one history are computed once: losses and gradients are those of all frames, but for rounding."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import pytest
import torch
from helpers.small_agents import SETTINGS, agent_of, batches, learnt_from, others_slow, stay, with_method
from helpers.small_agents import made as builder_of
from torch import Tensor

from baselines.parts import merge as merging
from baselines.parts.merge import KIND, merge
from baselines.parts.networks import HISTORY, INPUT
from baselines.parts.policy_gradient import critic_loss
from baselines.update.update import losses_of, total_loss, transform_gradients, update_state
from ctgraph_rl import CTGraphEnv
from ctgraph_rl.learn.collect import collect
from ctgraph_rl.packages import conf_dir
from ctgraph_rl.runs.settings import names_in
from curricula.paper import ct_su_b1

NUMBERS = (INPUT, HISTORY, KIND)


ONE, TWO = ct_su_b1((1, 2)), ct_su_b1((2, 1))
NOISY = replace(ONE, observations=replace(ONE.observations, read_noise=10))
WAITS = replace(ONE, graph=replace(ONE.graph, wait_prob=0.5))

BATCHES = {
    "several tasks with ids": ([ONE, TWO] * 8, {"ids": True}),
    "one row": ([ONE], {}),
    "all different": ([NOISY] * 16, {}),
    "cut episodes": ([WAITS] * 16, {}),
    "a short batch": ([ONE] * 16, {"steps": 3}),
    "equal rows": ([ONE] * 16, {"equal": True}),
}

AGENTS = {
    **{name: (name, ()) for name in ("a2c", "ppo", "ppo_count", "ppo_rnd", "reinforce", "rl2")},
    **{f"lstm_ppo {cell}": ("lstm_ppo", (f"cell={cell}",)) for cell in names_in(conf_dir(), "cell")},
    "lstm_ppo amrl straight": ("lstm_ppo", ("cell=amrl_max", "agent.cell.straight_through=true")),
    "lstm_ppo reads": ("lstm_ppo", ("cell=lstm", "agent.cell.reads_action=true", "agent.cell.reads_reward=true")),
}


@pytest.fixture(autouse=True)
def always(monkeypatch):
    """Small batches go over their histories, too."""
    monkeypatch.setattr(merging, "FEWEST_FRAMES", 0)
    monkeypatch.setattr(merging, "LARGEST_SHARE", 100.0)


def made(compose, name: str, kind: str, learn: int = 0) -> tuple:
    """An agent that has learned from some batches, and a minibatch of one more, in which episodes continue."""
    agent_name, overrides = AGENTS[name]
    tasks, about = BATCHES[kind]
    ids = {task: number for number, task in enumerate(dict.fromkeys(tasks))} if about.get("ids") else None
    env = CTGraphEnv(tasks, seed=3, task_ids=ids)
    rows = f"agent.num_envs={len(tasks)}"
    minibatches = [] if agent_name in ("a2c", "reinforce") else ["agent.num_minibatches=1"]
    agent = agent_of(compose, agent_name, env, rows, *minibatches, *overrides)
    count = (learn + 1) * agent.num_steps + about.get("steps", agent.num_steps)
    for number, batch in enumerate(
        collect(env, agent.policy, len(tasks) * count, agent.num_steps, agent.initial_state)
    ):
        if about.get("equal"):
            batch = torch.cat([batch[:1]] * len(tasks))
        if number <= learn:
            agent.learn(batch)
    return agent, learnt_from(deepcopy(agent), batch)[0]


def of_dtype(minibatch: dict, dtype: torch.dtype) -> dict:
    return {key: value.to(dtype) if value.is_floating_point() else value for key, value in minibatch.items()}


def computed(agent, minibatch: dict, dtype: torch.dtype, once: bool) -> tuple[dict[str, Tensor], Tensor]:
    """The losses, and the gradient of their sum as one vector."""
    agent = deepcopy(agent).to(dtype)
    given = {key: value for key, value in of_dtype(minibatch, dtype).items() if once or key not in NUMBERS}
    losses = agent.loss(given)
    total = sum(value for key, value in losses.items() if key.startswith("loss_"))
    gradients = torch.autograd.grad(total, list(agent.policy.parameters()))
    return losses, torch.cat([gradient.flatten() for gradient in gradients])


ALL_DIFFER = ("all different", "one row", "a short batch")
CASES = [(name, kind) for name in AGENTS for kind in BATCHES]
CHEAP = [("ppo", kind) for kind in BATCHES] + [
    (name, "several tasks with ids") for name in ("a2c", "rl2", "lstm_ppo gru")
]
CHEAP += [("lstm_ppo lstm", kind) for kind in BATCHES]


@pytest.mark.parametrize(("name", "kind"), others_slow(CASES, *CHEAP))
def test_losses_and_gradients_of_histories_are_those_of_all_frames(compose, name, kind):
    agent, minibatch = made(compose, name, kind)
    if name not in ("a2c", "reinforce"):
        minibatch["action_log_prob"] = minibatch["action_log_prob"] + 0.1 * (minibatch[KIND] % 5 - 2)

    found, expected = (computed(agent, minibatch, torch.float64, once) for once in (True, False))

    assert {KIND, HISTORY} <= minibatch.keys()
    assert len(merge(minibatch)[0]) < minibatch["action"].numel() or kind in (
        "all different",
        "one row",
        "a short batch",
    )
    torch.testing.assert_close(found, expected, atol=1e-10, rtol=1e-10)


def with_method_computed(
    attached, minibatch: dict, once: bool, dtype: torch.dtype = torch.float64
) -> tuple[dict[str, Tensor], list[Tensor]]:
    """Losses and penalties, and the gradients of what is trained."""
    learner = deepcopy(attached).to(dtype).unwrapped
    given = {key: value for key, value in of_dtype(minibatch, dtype).items() if once or key not in NUMBERS}
    state = update_state(learner)
    losses = losses_of(learner, state, given)
    gradients = torch.autograd.grad(total_loss(losses), state.weights, materialize_grads=True)
    return losses, list(transform_gradients(learner, learner.weights, state, gradients))


METHODS = ("ewc", "si", "mas", "mask_ri", "mask_lc", "clear", "packnet")
WITH_METHODS = [(name, method) for name in ("ppo", "lstm_ppo") for method in METHODS]


@pytest.mark.parametrize(("name", "method"), others_slow(WITH_METHODS, ("ppo", "ewc"), ("lstm_ppo", "clear")))
def test_with_a_method_where_a_task_returns_histories_give_what_all_frames_do(compose, name, method):
    tasks = (ONE, TWO)
    make_method = builder_of(compose, "method", method, *SETTINGS.get(method, []))
    attached = with_method(compose, name, make_method(), tasks, "agent.num_minibatches=1")
    stay(attached, 0, tasks)
    stay(attached, 1, tasks)
    attached.start_task(0)

    for steps in (attached.unwrapped.num_steps, 5):  # a whole batch, and a shortened last one
        batch = batches(attached, ONE, 1)[0][:, :steps]
        minibatch = learnt_from(attached.unwrapped, batch)[0]
        (found, gradients), (expected, of_expected) = (
            with_method_computed(attached, minibatch, once) for once in (True, False)
        )

        assert len(merge(minibatch)[0]) < minibatch["action"].numel()
        own = {"loss_objective", "loss_critic", "loss_entropy", "entropy"}
        assert (found.keys() > own) == (method in ("ewc", "si", "mas", "clear"))
        torch.testing.assert_close(found, expected, atol=1e-10, rtol=1e-10)
        torch.testing.assert_close(gradients, of_expected, atol=1e-10, rtol=1e-10)
        ways = (with_method_computed(attached, minibatch, once, torch.float32) for once in (True, False))
        require_little_rounding((expected, as_vector(of_expected)), *((each[0], as_vector(each[1])) for each in ways))


def as_vector(gradients: list[Tensor]) -> Tensor:
    return torch.cat([gradient.flatten() for gradient in gradients])


def require_little_rounding(exact: tuple, found: tuple, plain: tuple) -> None:
    """Losses, and gradients as one vector, err at most three times as much as by all frames."""
    unit = torch.finfo(torch.float32).eps
    for key, value in exact[0].items():
        assert (found[0][key] - value).abs() <= 3 * (plain[0][key] - value).abs() + 1e-4 * value.abs(), key
    vectors = [torch.stack([losses[key].double() for key in exact[0]]) for losses, _ in (exact, found, plain)]
    for correct, by_histories, by_frames in (vectors, [gradient for _, gradient in (exact, found, plain)]):
        most = 3 * (by_frames - correct).norm() + 4 * unit * correct.norm()
        assert (by_histories - correct).norm() <= most


OFTEN = ("cut episodes", "several tasks with ids")
ROUNDED = [(name, kind, learn) for name in AGENTS for kind in OFTEN for learn in (0, 60)]
ROUNDED += [
    (name, kind, learn)
    for name in ("ppo", "lstm_ppo lstm")
    for kind in BATCHES
    for learn in (0, 60)
    if kind not in OFTEN
]


@pytest.mark.parametrize(
    ("name", "kind", "learn"), others_slow(ROUNDED, ("ppo", "cut episodes", 0), ("lstm_ppo lstm", "cut episodes", 0))
)
def test_histories_round_at_most_three_times_as_much_as_all_frames(compose, name, kind, learn):
    agent, minibatch = made(compose, name, kind, learn)

    exact = computed(agent, minibatch, torch.float64, once=False)
    found = computed(agent, minibatch, torch.float32, once=True)
    plain = computed(agent, minibatch, torch.float32, once=False)

    require_little_rounding(exact, found, plain)


@pytest.mark.parametrize(("cell", "cost"), [("lstm", 1.0), ("backpropamine", 1.5), ("attention", 0.6 * 32)])
def test_cells_whose_steps_take_longer_go_over_fewer_histories(compose, monkeypatch, cell, cost):
    def minibatch(largest):
        monkeypatch.setattr(merging, "LARGEST_SHARE", largest)
        return made(compose, f"lstm_ppo {cell}", "cut episodes")[1]

    history = minibatch(100.0)[HISTORY]
    share = int(history.max()) / history.numel()

    assert KIND in minibatch(1.01 * cost * share)
    assert KIND not in minibatch(0.99 * cost * share)


def test_a_step_that_no_later_one_follows_leaves_weights_of_later_ones_as_they_are(compose):
    agent, minibatch = made(compose, "lstm_ppo backpropamine", "several tasks with ids")
    before = deepcopy(agent.trunk.cell.modulator.weight)
    first = {key: value[:, :1] for key, value in minibatch.items()}

    agent.optimiser.state.clear()
    agent.gradient_step(first)

    assert torch.equal(agent.trunk.cell.modulator.weight, before)


def test_frames_of_one_history_and_action_with_other_old_log_probabilities_are_of_two_kinds(small_agent):
    agent = small_agent("ppo", [ONE])
    items = {
        "observation": torch.zeros(2, 4, 12, 12, dtype=torch.uint8),
        "action": torch.zeros(2, 4, dtype=torch.int64),
        "action_log_prob": torch.tensor([[-1.0] * 4, [-1.0, -1.0, -1.0, -1.0000001]]),
        "advantage": torch.ones(2, 4, 1),
    }

    numbers = merging.number_frames(agent.trunk, items, 1)

    assert numbers[HISTORY].unique().tolist() == [0]
    assert len(numbers[KIND].unique()) == 2 and (numbers[KIND] == numbers[KIND][1, 3]).sum() == 1


def test_a_critic_near_its_targets_is_not_lost_in_rounding():
    generator = torch.Generator().manual_seed(0)
    target = (100 + 0.01 * torch.randn(4096, 1, generator=generator, dtype=torch.float64)).float()
    value = torch.full((4096, 1), 100.001)
    kinds = torch.randint(3, (4096,), generator=generator)
    zeros = torch.zeros(4096, dtype=torch.float32)
    batch = {KIND: kinds, "action": kinds, "action_log_prob": zeros, "advantage": zeros, "value_target": target}

    chosen, frames = merge(batch)
    found = critic_loss(value[chosen], frames, 1.0)

    naive = value[0].square() - 2 * value[0] * target.mean() + target.square().mean()
    exact = (value.double() - target.double()).square().mean()
    assert (found - exact).abs() <= 1e-7 * exact
    assert (naive - exact).abs() > 0.5 * exact, "squares around 0 are lost in this case"
