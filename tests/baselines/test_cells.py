"""Cells: step by step and over sequences, what they hold, what they read, and that they are saved."""

from __future__ import annotations

from functools import partial
from itertools import pairwise, product

import pytest
import torch
from helpers.small_agents import batches, others_slow, parameters_equal, saved_and_loaded
from hydra.utils import instantiate
from omegaconf import OmegaConf
from torch import nn

from baselines.cells.cell import Cell
from baselines.cells.scan import linear_scan, max_scan
from baselines.parts.catalogue import catalogue
from baselines.parts.networks import EncoderModule, RecurrentModule
from ctgraph_rl import CTGraphEnv
from ctgraph_rl.learn.collect import UNSTORED
from ctgraph_rl.packages import conf_dir
from ctgraph_rl.runs.settings import names_in
from curricula.paper import ct_su_b1

CELLS = names_in(conf_dir(), "cell")
ROWS, STEPS, FEATURES, OUTPUTS, ACTIONS = 5, 12, 3, 4, 3
OWN = {"reads_action": True, "reads_reward": True}

every_cell = pytest.mark.parametrize("name", CELLS)


def build(name: str) -> partial:
    """What builds a cell with the settings of its file."""
    return instantiate(OmegaConf.load(f"{conf_dir()}/cell/{name}.yaml"))


def make(name: str, inputs: int = FEATURES, **settings) -> Cell:
    """A cell with the settings of its file, in float64, with equal weights for every call."""
    torch.manual_seed(0)
    return build(name)(inputs, OUTPUTS, ACTIONS, **settings).double()


def trunk_of(cell: Cell) -> RecurrentModule:
    """A trunk whose features are the observation itself."""
    return RecurrentModule(EncoderModule(nn.Identity(), in_keys=["observation"], out_keys=["features"]), cell)


def sequences(starts: torch.Tensor) -> dict[str, torch.Tensor]:
    """What a trunk reads in [rows, steps], some of it several times."""
    generator = torch.Generator().manual_seed(1)
    kinds = torch.randn(6, FEATURES, generator=generator, dtype=torch.float64)
    return {
        "observation": kinds[torch.randint(6, starts.shape, generator=generator)],
        "is_init": starts.unsqueeze(-1),
        "previous_action": torch.randint(ACTIONS, starts.shape, generator=generator),
        "reward": torch.randint(2, starts.shape, generator=generator).double().unsqueeze(-1),
    }


def step_by_step(trunk: RecurrentModule, data: dict, state: dict) -> torch.Tensor:
    outputs = []
    for step in range(data["is_init"].shape[1]):
        written = trunk.act({key: value[:, step] for key, value in data.items()} | state)
        outputs.append(written.pop("memory"))
        state = {key[1]: value for key, value in written.items()}
    return torch.stack(outputs, dim=1)


def zeros_before(trunk: RecurrentModule) -> dict[str, torch.Tensor]:
    return dict(trunk.zero_state(ROWS).select(*trunk.state_keys).items())


def state_before(trunk: RecurrentModule) -> dict[str, torch.Tensor]:
    """The state after a few steps of other sequences."""
    state = zeros_before(trunk)
    for _ in range(3):
        data = {key: value[:, 0] for key, value in sequences(torch.zeros(ROWS, 1, dtype=torch.bool)).items()}
        written = trunk.act(data | state)
        state = {key[1]: value.detach() for key, value in written.items() if key != "memory"}
    return state


@every_cell
@pytest.mark.parametrize("start_probability", [0.0, 0.3])
def test_a_cell_and_its_gradients_are_the_same_step_by_step_over_sequences_and_over_a_tree(name, start_probability):
    trunk = trunk_of(make(name, **OWN))
    starts = torch.rand(ROWS, STEPS, generator=torch.Generator().manual_seed(2)) < start_probability
    data, state = sequences(starts), state_before(trunk)
    by = torch.randn(ROWS, STEPS, OUTPUTS, dtype=torch.float64)

    stored = {key: value.unsqueeze(1) for key, value in state.items()}
    given = data | stored
    different, which = trunk.of_histories(given | trunk.number_histories(given))
    ways = (step_by_step(trunk, data, state), trunk.over_time(data | stored), different[which].view_as(by))

    weights = list(trunk.parameters())
    expected, *others = [(way, *(torch.autograd.grad(way, weights, by) if weights else ())) for way in ways]
    for found in others:
        torch.testing.assert_close(found, expected, atol=1e-10, rtol=1e-10)
    assert (len(different) < ROWS * STEPS) == (start_probability > 0)


@every_cell
def test_a_state_in_which_an_episode_starts_is_zero_and_is_left_behind(name):
    trunk = trunk_of(make(name))
    data = {key: value[:, 0] for key, value in sequences(torch.ones(ROWS, 1, dtype=torch.bool)).items()}

    fresh, after = (trunk.act(data | state)["memory"] for state in (zeros_before(trunk), state_before(trunk)))

    assert torch.equal(fresh, after)
    assert not any(value.any() for value in trunk.cell.zeros(ROWS))


@every_cell
def test_a_cell_that_remembers_reads_what_was_before_a_step_and_any_cell_what_is_at_it(name):
    trunk = trunk_of(make(name))
    data = sequences(torch.zeros(ROWS, 2, dtype=torch.bool))
    state = {key: value.unsqueeze(1) for key, value in trunk.zero_state(ROWS).items()}
    changed = {**data, "observation": data["observation"].clone()}
    changed["observation"][:, 0] += 1

    difference = (trunk.over_time(data | state) - trunk.over_time(changed | state)).abs().amax(dim=(0, 2))

    assert difference[0] > 0
    assert (difference[1] > 0) == trunk.cell.memory


@every_cell
@pytest.mark.parametrize("key", ["previous_action", "reward"])
def test_what_a_cell_reads_of_its_own_past_is_a_setting_and_nothing_at_the_start_of_an_episode(name, key):
    for reads in ({}, {"reads_action": key == "previous_action", "reads_reward": key == "reward"}):
        trunk = trunk_of(make(name, **reads))
        assert set(trunk.in_keys) == {"observation", "is_init", *trunk.cell.state_keys, *[key] * bool(reads)}
    data = {key: value[:, 0] for key, value in sequences(torch.tensor([[True], [False]])).items()}
    data |= trunk.zero_state(2).select(*trunk.state_keys)

    value, changed = (trunk.act(given)["memory"] for given in (data, {**data, key: (data[key] + 1) % 3}))

    assert torch.equal(value[0], changed[0])
    assert not torch.equal(value[1], changed[1])


@pytest.mark.parametrize(
    ("name", "agent"),
    others_slow(product(CELLS, ["lstm_ppo", "drqn"]), *product(["attention", "backpropamine", "gru"], ["lstm_ppo"])),
)
def test_an_agent_with_a_cell_is_saved_and_restored_bit_by_bit(name, agent):
    if agent == "drqn" and any(key.startswith(UNSTORED) for key in make(name).state_keys):
        pytest.skip("replay needs a state that is stored")
    less = {"num_epochs": 1} if agent == "lstm_ppo" else {"batch_size": 2, "num_updates": 2}
    one, other = (agent_with(partial(build(name), **OWN), agent, **less) for _ in range(2))
    first, second = batches(one, ct_su_b1(), 2)
    one.learn(first)

    other.load_state_dict(saved_and_loaded(one.state_dict()))
    for learner in (one, other):
        torch.manual_seed(1)
        learner.learn(second)

    assert parameters_equal(one, other)
    goes_on = ~second["is_init"][:, 1:, 0]
    assert torch.equal(second["previous_action"][:, 1:][goes_on], second["action"][:, :-1][goes_on])
    assert torch.equal(second["reward"][:, 1:][goes_on], second["next", "reward"][:, :-1][goes_on])


@torch.no_grad()
def with_open_gates(name: str) -> Cell:
    """A cell of two inputs whose gates let in a cue, (1, 0), and hold it over blanks, (0, 1), where there is a gate."""
    cell = make(name, inputs=2)
    cue, blank = torch.tensor([[1.0, 0.0]]), torch.tensor([[0.0, 1.0]])
    opened, closed, given = 40 * (cue - blank), 40 * (blank - cue), 5 * cue
    aggregated = {"inner.lstm.weight_ih_l0": [opened, 0 * cue, given, opened]}  # which forgets at once
    weights = {
        "lstm": {"lstm.weight_ih_l0": [opened, 40 * (cue + blank), given, 40 * (cue + blank)]},  # i, f, g, o
        "gru": {"gru.weight_ih_l0": [0 * cue, closed, given]},  # r, z, n
        "min_gru": {"gate.weight": [opened], "candidate.weight": [cue]},
        "amrl_max": aggregated,
        "amrl_avg": aggregated,
    }
    for parameter in cell.parameters():
        parameter.zero_()
    for place, blocks in weights[name].items():
        cell.get_parameter(place).copy_(torch.cat([block.expand(OUTPUTS, 2) for block in blocks]))
    if hasattr(cell, "linear"):
        nn.init.eye_(cell.linear.weight)
    return cell


HELD = {
    "lstm": [1, 1],
    "gru": [1, 1],
    "min_gru": [1, 1],
    "amrl_max": [1, 1],
    "amrl_avg": [0.5, 1 / 300],
}
"""The share of a cue that is in the memory after 1 and 299 blanks."""


@pytest.mark.parametrize("name", HELD)
def test_a_cue_is_held_over_blanks(name):
    cell = with_open_gates(name)
    shown = torch.zeros(1, 300, dtype=torch.int64)
    shown[0, 1:] = 1

    memory = cell.sequence(torch.eye(2).double(), shown, torch.zeros(1, 300, dtype=torch.bool), cell.zeros(1))

    channel = OUTPUTS // 2 if "amrl" in name else 0
    share = memory[0, :, channel] / memory[0, 0, channel]
    assert share[[1, 299]].tolist() == pytest.approx(HELD[name], rel=1e-4)


def test_stacked_frames_hold_the_last_ones_and_no_others():
    cell = make("frames", num_frames=3)
    inputs = torch.randn(1, 8, FEATURES).double().requires_grad_()

    output = cell.sequence(inputs[0], torch.arange(8).view(1, 8), torch.arange(8).view(1, 8) == 6, cell.zeros(1))

    reads = [torch.autograd.grad(output[0, t].sum(), inputs, retain_graph=True)[0].any(dim=-1)[0] for t in (5, 6, 7)]
    assert [each.nonzero().flatten().tolist() for each in reads] == [[3, 4, 5], [6], [6, 7]]


def test_maxima_and_sums_are_those_since_the_last_reset():
    generator = torch.Generator().manual_seed(0)
    x, starts = torch.randn(6, 37, 3, generator=generator), torch.rand(6, 37, generator=generator) < 0.15

    largest = max_scan(x, starts)
    sums = linear_scan((~starts).float().unsqueeze(-1), x)

    for row in range(6):
        edges = [0, *(starts[row, 1:].nonzero().flatten() + 1).tolist(), 37]
        for first, last in pairwise(edges):
            assert torch.equal(largest[row, first:last], x[row, first:last].cummax(dim=0).values)
            torch.testing.assert_close(sums[row, first:last], x[row, first:last].cumsum(dim=0), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("aggregator", ["max", "mean"])
@pytest.mark.parametrize("straight_through", [False, True])
def test_the_gradient_of_an_aggregate_is_its_own_or_1_for_each_input(aggregator, straight_through):
    cell = make("amrl_max", aggregator=aggregator, straight_through=straight_through)
    x = torch.tensor([[0.5, 0.1, 0.3, 0.9, 0.2]], dtype=torch.float64).unsqueeze(-1).requires_grad_()
    starts, state = torch.tensor([[False, True, False, False, False]]), [x.new_zeros(1, 1) for _ in range(2)]

    aggregate = cell._aggregate(x, starts, state)[0]
    gradient = torch.autograd.grad(aggregate[0, -1].sum(), x)[0].flatten().tolist()

    own = {"max": ([0, 0, 0, 1, 0], 0.9), "mean": ([0, 0.25, 0.25, 0.25, 0.25], 0.375)}[aggregator]
    assert aggregate[0, -1].item() == pytest.approx(own[1], abs=1e-12)
    assert gradient == ([0, 1, 1, 1, 1] if straight_through else own[0])


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("amrl_max", {"aggregator": "min"}, "aggregator must be one of max, mean"),
        ("amrl_max", {"straight_through": 1}, "straight_through must be true or false"),
        ("frames", {"num_frames": 1}, "num_frames must be an integer >= 2, got 1: one frame is cell=none"),
        ("frames", {"num_frames": 10**6}, "num_frames must be at most 1,000"),
        ("gru", {"reads_action": "yes"}, "reads_action must be true or false"),
    ],
)
def test_settings_of_a_cell_that_cannot_be_are_refused(name, settings, message):
    with pytest.raises(ValueError, match=message):
        make(name, **settings)


def test_an_aggregated_memory_has_an_even_width():
    with pytest.raises(ValueError, match=r"hidden_size must be even.*got 5: use 6"):
        build("amrl_max")(3, 5, 3)


class Sum(Cell):
    """A cell that adds up its inputs."""

    state_keys = ("sum",)

    def zeros(self, num_rows):
        return (torch.zeros(num_rows, self.num_inputs, 2),)

    def step(self, inputs, state):
        sums = state[0] + inputs.unsqueeze(-1)
        return sums.sum(dim=-1), (sums,)


class UnstoredSum(Sum):
    state_keys = (f"{UNSTORED}sum",)


def agent_with(kind: type[Cell], name: str, **settings):
    entry = next(each for each in catalogue("agent") if each.name == name)
    env = CTGraphEnv([ct_su_b1()])
    torch.manual_seed(0)
    given = {**entry.settings, "num_envs": 16, "num_steps": 6, "hidden_size": 8, **settings}
    return entry.kind(env.observation_spec_unbatched, env.action_spec_unbatched, **given, cell=kind)


@pytest.mark.parametrize("name", ["lstm_ppo", "rl2"])
def test_an_unstored_state_is_carried_and_learned_with_as_a_stored_one_and_kept_once_a_batch(name):
    agents = [agent_with(kind, name) for kind in (Sum, UnstoredSum)]
    for agent in agents:
        torch.manual_seed(1)
        for batch in batches(agent, ct_su_b1(), 2):
            agent.learn(batch)

    key, nexts = UnstoredSum.state_keys[0], ("next", UnstoredSum.state_keys[0])
    assert parameters_equal(*agents)
    assert batch[key].stride(1) == batch[nexts].stride(1) == 0
    assert batch[key].any() and not torch.equal(batch[key], batch[nexts])


def test_a_cell_whose_state_is_not_stored_cannot_be_replayed():
    with pytest.raises(ValueError, match=r"DRQN replays .* whose state is stored, not UnstoredSum: use agent=lstm_ppo"):
        agent_with(UnstoredSum, "drqn")


@pytest.mark.parametrize("name", ["ppo", "dqn"])
def test_an_agent_without_memory_takes_no_cell(name, small_agent):
    with pytest.raises(ValueError, match=r"no memory.*agent=lstm_ppo.*leave the cell out"):
        small_agent(name, [ct_su_b1()], "cell=lstm")
