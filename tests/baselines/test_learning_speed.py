"""What makes learning fast: plain tensors equal to TorchRL's parts, compiled gradient steps, and the benchmark."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from helpers.scripted import BARE, RUN, seconds
from helpers.small_agents import GREEDY, SAMPLED, batches, learnt_from, others_slow, parameters_equal, saved_and_loaded
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torch import nn
from torch.fx import symbolic_trace
from torch.nn.utils.rnn import PackedSequence
from torchrl.envs.utils import set_exploration_type
from torchrl.modules import LSTMModule, set_recurrent_mode
from torchrl.objectives import A2CLoss, ClipPPOLoss, DQNLoss, ReinforceLoss, ValueEstimators

from baselines.cells.lstm import lstm_inputs, lstm_step
from baselines.cells.packed import Segments
from baselines.update import seeds as together
from baselines.update.compiled import compiler_options
from baselines.update.seeds import SeedGroup
from baselines.update.update import update, update_state
from benchmarks import agents as benchmark
from benchmarks import environment_ladder as ladder_of_envs
from ctgraph_rl import CTGraphEnv
from ctgraph_rl.learn.collect import collect, stack_steps, take_step
from curricula.paper import ct_su_b1


def test_a_step_in_plain_tensors_equals_torchrls():
    tasks = [ct_su_b1((1, 2)), ct_su_b1((2, 1))] * 8
    plain, stock = (CTGraphEnv(tasks, 3, task_ids={task: i for i, task in enumerate(tasks[:2])}) for _ in range(2))
    data, other = plain.reset(), stock.reset()
    generator = torch.Generator().manual_seed(0)

    steps, others = [], []
    for _ in range(12):
        action = torch.randint(3, (16,), generator=generator)
        written = {"action": action, "own": action.float(), ("next", "own"): action + 1.0}
        step, data = take_step(plain, dict(data) | written)
        expected, other = stock.step_and_maybe_reset(other.update(written))
        steps.append(step)
        others.append(expected)
        assert set(data) == set(other.keys()) and all((data[key] == other[key]).all() for key in data)

    batch, expected = stack_steps(steps, plain), torch.stack(others, dim=1)
    assert expected["next", "done"].any()
    assert set(batch.keys(True, True)) == set(expected.keys(True, True)) and (batch == expected).all()


@pytest.mark.parametrize("exploration", [GREEDY, SAMPLED])
@pytest.mark.parametrize("name", ["dqn", "drqn", "lstm_ppo", "ppo"])
def test_a_policy_in_plain_tensors_equals_torchrls(small_agent, name, exploration):
    agent = small_agent(name, [ct_su_b1()])
    stock = TensorDictSequential(*agent.policy.module)
    batch = batches(agent, ct_su_b1(), 1)[0]
    found, expected = (batch[:, 5].select(*agent.policy.in_keys) for _ in range(2))

    with set_exploration_type(exploration), torch.no_grad():
        for policy, data in ((agent.policy, found), (stock, expected)):
            torch.manual_seed(2)
            policy(data)

    keys = [key for key in found.keys(True, True) if key not in agent.policy.in_keys]
    assert "action" in keys
    assert all(torch.equal(found[key], expected[key]) for key in keys)


@pytest.mark.parametrize("episodes_start", [True, False])
def test_an_lstm_over_time_in_plain_tensors_equals_torchrls(small_agent, episodes_start):
    agent = small_agent("lstm_ppo", [ct_su_b1()])
    batch = batches(agent, ct_su_b1(), 2)[1]
    batch["is_init"][:, 1:] &= episodes_start

    memory = agent.trunk.over_time(batch)

    encoder, cell = agent.trunk.module
    with set_recurrent_mode(True):
        theirs = LSTMModule(lstm=cell.lstm, in_key="features", out_key="memory")
        expected = TensorDictSequential(encoder, theirs)(batch.select(*agent.trunk.in_keys))["memory"]
    assert batch["is_init"][:, 1:].any() == episodes_start
    torch.testing.assert_close(memory, expected, atol=1e-6, rtol=0)
    found, others = (
        torch.autograd.grad(values.square().mean(), list(agent.trunk.parameters())) for values in (memory, expected)
    )
    torch.testing.assert_close(found, others, atol=1e-6, rtol=0)


def test_a_packed_lstm_and_its_gradients_equal_pytorchs():
    torch.manual_seed(0)
    lstm, sizes = nn.LSTM(3, 4).double(), torch.tensor([5, 3, 3, 1])
    features, kinds = torch.randn(6, 3, dtype=torch.float64, requires_grad=True), torch.randint(6, (12,))
    h, c = torch.randn(2, 1, 5, 4, dtype=torch.float64, requires_grad=True).unbind()
    sequences = Segments(torch.arange(12), sizes, torch.arange(5), torch.ones(5, dtype=torch.bool))

    [memory] = sequences.run(partial(lstm_step, lstm), lstm_inputs(lstm, features), kinds.unsqueeze(0), (h[0], c[0]))

    expected = lstm(PackedSequence(features[kinds], sizes), (h, c))[0].data
    wanted, by = [features, h, c, *lstm.parameters()], torch.randn_like(memory)
    found, others = (torch.autograd.grad(values, wanted, by) for values in (memory, expected))
    torch.testing.assert_close((memory, *found), (expected, *others), atol=1e-10, rtol=0)


STOCK_LOSSES = {
    "a2c": (A2CLoss, ("entropy_coeff", "critic_coeff")),
    "ppo": (ClipPPOLoss, ("entropy_coeff", "critic_coeff", "clip_epsilon")),
    "reinforce": (ReinforceLoss, ()),
}


@pytest.mark.parametrize("name", STOCK_LOSSES)
def test_a_loss_and_its_gradients_in_plain_tensors_equal_torchrls(small_agent, name):
    make, keys = STOCK_LOSSES[name]
    values = {"entropy_coeff": 0.25, "critic_coeff": 2.0, "clip_epsilon": 0.01}
    agent = small_agent(name, [ct_su_b1()], *(f"agent.{key}={values[key]}" for key in keys))
    minibatch = learnt_from(agent, batches(agent, ct_su_b1(), 1)[0])[0]
    given = {key: values[key] for key in keys}
    stock = make(agent.actor, agent.critic, loss_critic_type="l2", functional=False, **given)

    losses = agent.loss(minibatch)
    features = agent.trunk.over_time(minibatch)
    expected = stock(TensorDict({**minibatch, "features": features}, features.shape[:1]))

    gradients, others = (
        torch.autograd.grad(sum(found[key] for key in losses if key.startswith("loss_")), list(agent.parameters()))
        for found in (losses, expected)
    )
    assert all(torch.equal(losses[key], expected[key]) for key in losses)
    assert all(torch.equal(*pair) for pair in zip(gradients, others, strict=True))


@pytest.mark.parametrize("double", ["true", "false"])
def test_the_loss_of_dqn_in_plain_tensors_equals_torchrls(small_agent, double):
    agent = small_agent("dqn", [ct_su_b1()], f"agent.double={double}", "agent.priority_alpha=0.6")
    agent.learn(batches(agent, ct_su_b1(), 1)[0])
    of_torchrl = DQNLoss(agent.greedy, delay_value=True, double_dqn=agent.settings.double, action_space="categorical")
    of_torchrl.target_value_network_params.data.update_(TensorDict.from_module(agent.target).data)
    of_torchrl.make_value_estimator(ValueEstimators.TD0, gamma=agent.settings.gamma)
    sample = agent.replay[:].set("priority_weight", torch.rand(128))

    losses = agent.loss(sample)
    expected = of_torchrl(sample)

    assert torch.equal(losses["loss_value"], expected["loss"])
    assert torch.equal(losses["td_error"], sample["td_error"].flatten())


@pytest.mark.parametrize("name", others_slow(["a2c", "dqn", "ppo", "ppo_published"], "a2c", "dqn", "ppo"))
def test_the_step_that_is_compiled_is_the_eager_one_but_for_rounding(small_agent, monkeypatch, name):
    agent, other = (small_agent(name, [ct_su_b1()]) for _ in range(2))
    minibatch = learnt_from(agent, batches(agent, ct_su_b1(), 1)[0])[-1]
    other.load_state_dict(saved_and_loaded(agent.state_dict()))

    eager = agent.gradient_step(minibatch)
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    whole = update(other, update_state(other), minibatch)

    assert list(eager) == list(whole)
    torch.testing.assert_close(whole, eager)
    for one, two in zip(agent.parameters(), other.parameters(), strict=True):
        torch.testing.assert_close(one, two, atol=1e-5, rtol=1e-4)
    expected, found = (one.optimiser.state_dict()["state"] for one in (agent, other))
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["dqn", "ppo_published"])  # a learner of values, and one of policies
def test_a_compiled_agent_learns_the_same_but_for_rounding(small_agent, name):
    agents = [small_agent(name, [ct_su_b1()], f"agent.compile={compiled}") for compiled in ("true", "false")]
    for agent in agents:
        torch.manual_seed(1)
        for batch in collect(CTGraphEnv([ct_su_b1()] * 16), agent.policy, 128 * 2 + 16, 8, agent.initial_state):
            agent.learn(batch)

    for one, two in zip(*(agent.parameters() for agent in agents), strict=True):
        torch.testing.assert_close(one, two, atol=1e-4, rtol=1e-3)
    agents[1].load_state_dict(saved_and_loaded(agents[0].state_dict()))
    assert parameters_equal(*agents)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["dqn", "ppo_count", "ppo_published"])  # values, policies, and one that counts
def test_an_agent_that_goes_on_from_a_saved_state_begins_with_a_compiled_step(small_agent, compile_by, name):
    compile_by("eager")
    agent, other = (small_agent(name, [ct_su_b1()], "agent.compile=true") for _ in range(2))
    first, second = batches(agent, ct_su_b1(), 2)
    agent.learn(first)
    other.load_state_dict(saved_and_loaded(agent.state_dict()))

    for one in (agent, other):
        torch.manual_seed(1)
        one.learn(second)

    assert parameters_equal(agent, other)


@pytest.mark.slow
def test_a_loss_that_is_not_a_number_stops_a_compiled_agent_and_is_named(small_agent, compile_by):
    compile_by("eager")
    agent = small_agent("ppo", [ct_su_b1()], "agent.compile=true")
    first, second = batches(agent, ct_su_b1(), 2)
    agent.learn(first)
    second["next", "reward"][3, 2] = float("nan")

    with pytest.raises(FloatingPointError, match=r"^loss_\w+ is nan$"):
        agent.learn(second)


@pytest.mark.parametrize("name", ["lstm_ppo", "drqn"])
def test_an_agent_with_an_lstm_is_not_compiled(small_agent, name):
    with pytest.raises(Exception, match="compile must be false for an agent with an LSTM"):
        small_agent(name, [ct_su_b1()], "+agent.compile=true")


def cells_of(lines: list[str], column: int) -> list[str]:
    return [line.split("|")[column].strip() for line in lines]


@pytest.mark.slow
def test_the_benchmark_prints_a_row_for_everybody(capsys):
    benchmark.main(["--agents", "a2c", "--rounds", "1", "--seconds", "0.001", "--seeds", "1", "--max-frames", "1"])

    lines = capsys.readouterr().out.splitlines()
    who = ["ours", "SB3, 256 rows, SB3VecEnv", "SB3, 256 rows, make_vec_env", "SB3, its defaults, 8 rows"]
    assert cells_of(lines[4:8], 3) == who
    assert cells_of(lines[11:], 2) == who
    assert cells_of(lines[11:], 3) == ["0 of 1 seeds"] * 4


def test_without_stable_baselines_and_jax_ours_is_measured_alone(capsys, monkeypatch):
    monkeypatch.setattr(benchmark, "find_spec", lambda name: None)

    benchmark.main(["--agents", "a2c", "--rounds", "1", "--seconds", "0.001", "--seeds", "0"])

    printed = capsys.readouterr()
    assert "pip install 'ctgraph_rl[benchmark]'" in printed.err.replace("\n", " ")
    assert "JAX is missing and not measured: pip install jax" in printed.err.splitlines()
    assert cells_of(printed.out.splitlines()[4:], 3) == ["ours"]


def test_jax_learns_with_the_settings_of_ours():
    jax_ppo = pytest.importorskip("benchmarks.jax_ppo", reason="needs jax")
    learner = jax_ppo.JAX("ppo", benchmark.on_256_rows("ppo"), benchmark.TASKS["CT-FO-B1"], 0)

    for _ in range(10):
        assert learner.learn() == 8192

    assert learner.success() > 0.95


def test_cells_are_measured_in_place_of_an_lstm(capsys):
    benchmark.main(["--cells", "none", "--rounds", "1", "--seconds", "0.001", "--seeds", "0"])

    assert cells_of(capsys.readouterr().out.splitlines()[4:], 2) == ["lstm_ppo cell=none"]


def test_a_benchmark_that_is_stopped_prints_what_it_has(capsys, monkeypatch):
    def stopped(*given):
        raise KeyboardInterrupt

    monkeypatch.setattr(benchmark, "find_spec", lambda name: None)
    monkeypatch.setattr(benchmark, "solve", stopped)

    benchmark.main(["--agents", "a2c", "--rounds", "1", "--seconds", "0.001", "--seeds", "1"])

    lines = [line for line in capsys.readouterr().out.splitlines() if "a2c" in line]
    assert cells_of(lines[:1], 3) == ["ours"]
    assert cells_of(lines[1:], 3) == ["0 of 0 seeds"]


def test_the_ladder_of_a_device_has_both_agents_and_seeds_together(capsys, monkeypatch):
    monkeypatch.setattr(ladder_of_envs, "measure", lambda rung, *how: rung.speeds.append(1e6))

    benchmark.main(["--device", "cpu", "--rows", "16", "--together", "2"])

    assert cells_of(capsys.readouterr().out.splitlines()[4:], 3) == [
        *("environment only", "ppo, step by step", "ppo, captured", "ppo, compiled and captured"),
        *("ppo, 2 seeds as one job", "environment only", "lstm_ppo, step by step", "lstm_ppo, captured"),
        "lstm_ppo, 2 seeds as one job",
    ]


@pytest.mark.parametrize("name", ["ppo, step by step", "ppo, captured", "ppo, 2 seeds as one job"])
def test_what_the_ladder_of_a_device_measures_learns(name):
    cpu = torch.device("cpu")
    [rung] = [rung for rung in benchmark.rungs(cpu, [16], [2]) if rung.name == name]

    ladder_of_envs.measure(rung, 2, 0.001, cpu)

    assert (rung.failure, len(rung.speeds)) == ("", 2)


def test_the_ratio_is_a_median_speed_by_ours():
    rungs = [
        ladder_of_envs.Rung("ours", "ppo", 256, None, speeds=[100.0, 300.0, 200.0]),
        ladder_of_envs.Rung("SB3", "ppo", 256, None, speeds=[50.0, 10.0, 40.0]),
    ]

    assert [(row["per_second"], row["ratio"]) for row in ladder_of_envs.found(rungs, "ours")] == [(200, 1), (40, 0.2)]


def test_most_seeds_must_solve_a_task():
    assert benchmark.medians([(8, 1.0), None, (16, 3.0)]) == ("12", "2.00")
    assert benchmark.medians([None, None, (16, 3.0)]) == ("1 of 3 seeds", "")


@pytest.mark.slow
def test_a_run_starts_within_1_3_times_the_bare_imports():
    assert any(seconds(RUN) / seconds(BARE) < 1.3 for _ in range(2)), "measured again where it was too long"


def test_graphs_for_acting_of_equal_code_are_compiled_once(small_agent, monkeypatch):
    group = SeedGroup([small_agent("ppo", [ct_su_b1()])], [torch.Generator()])
    zero, compiled = torch.zeros(1), []
    one, equal_one = (symbolic_trace(lambda x: x.sin()) for _ in range(2))
    other = symbolic_trace(lambda x: x.cos())
    monkeypatch.setattr(together, "compile", lambda *given: compiled.append(given) or f"graph {len(compiled)}")

    made = [group._compile(graph, (zero,)) for graph in (one, equal_one, other)]

    assert made == ["graph 1", "graph 1", "graph 2"]
    assert compiled == [(graph, [zero], compiler_options()) for graph in (one, other)]
