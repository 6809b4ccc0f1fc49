"""Cells: step by step and over sequences, what they hold, what they read, and that they are saved."""

from __future__ import annotations

import pytest
import torch
from helpers.small_agents import MINIBATCHES, TINY, batches, parameters_equal, saved_and_loaded
from hydra.utils import instantiate
from omegaconf import OmegaConf
from torch import nn

from baselines.catalogue import catalogue
from baselines.cells.cell import Cell
from baselines.networks import EncoderModule, RecurrentModule
from ctgraph_rl import CTGraphEnv
from ctgraph_rl.learn.collect import UNSTORED
from ctgraph_rl.packages import conf_dir
from ctgraph_rl.runs.config import names_in
from curricula.paper import ct_su_b1

CELLS = names_in(conf_dir(), "cell")
ROWS, STEPS, FEATURES, OUTPUTS, ACTIONS = 5, 12, 3, 4, 3
OWN = {"reads_action": True, "reads_reward": True}

every_cell = pytest.mark.parametrize("name", CELLS)


def make(name: str, **settings) -> Cell:
    """A cell with the settings of its file, in float64, with equal weights for every call."""
    torch.manual_seed(0)
    build = instantiate(OmegaConf.load(f"{conf_dir()}/cell/{name}.yaml"))
    return build(FEATURES, OUTPUTS, ACTIONS, **settings).double()


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


def state_before(trunk: RecurrentModule) -> dict[str, torch.Tensor]:
    """The state after a few steps of other sequences."""
    state = dict(trunk.zero_state(ROWS).select(*trunk.state_keys).items())
    for _ in range(3):
        data = {key: value[:, 0] for key, value in sequences(torch.zeros(ROWS, 1, dtype=torch.bool)).items()}
        written = trunk.act(data | state)
        state = {key[1]: value.detach() for key, value in written.items() if key != "memory"}
    return state


@every_cell
@pytest.mark.parametrize("start_probability", [0.0, 0.3])
def test_a_cell_and_its_gradients_are_the_same_step_by_step_and_over_sequences(name, start_probability):
    trunk = trunk_of(make(name, **OWN))
    starts = torch.rand(ROWS, STEPS, generator=torch.Generator().manual_seed(2)) < start_probability
    data, state = sequences(starts), state_before(trunk)
    by = torch.randn(ROWS, STEPS, OUTPUTS, dtype=torch.float64)

    stored = {key: value.unsqueeze(1) for key, value in state.items()}
    found, expected = trunk.over_time(data | stored), step_by_step(trunk, data, state)

    weights = list(trunk.parameters())
    gradients = [torch.autograd.grad(values, weights, by) if weights else () for values in (found, expected)]
    torch.testing.assert_close((found, *gradients[0]), (expected, *gradients[1]), atol=1e-10, rtol=1e-10)


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


@every_cell
@pytest.mark.parametrize("agent", ["lstm_ppo", "drqn"])
def test_an_agent_with_a_cell_is_saved_and_restored_bit_by_bit(name, agent, small_agent):
    if agent == "drqn" and any(key.startswith(UNSTORED) for key in make(name).state_keys):
        pytest.skip("replay needs a state that is stored")
    own = [f"cell={name}", "agent.cell.reads_action=true", "agent.cell.reads_reward=true"]
    less = MINIBATCHES if agent == "lstm_ppo" else ["agent.batch_size=2", "agent.num_updates=2"]
    one, other = (small_agent(agent, [ct_su_b1()], *own, *TINY, *less) for _ in range(2))
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
    with pytest.raises(ValueError, match=r"DRQN replays .* whose state is stored, not .*: use agent=lstm_ppo"):
        agent_with(UnstoredSum, "drqn")


@pytest.mark.parametrize("name", ["ppo", "dqn"])
def test_an_agent_without_memory_takes_no_cell(name, small_agent):
    with pytest.raises(ValueError, match=r"no memory.*agent=lstm_ppo.*leave the cell out"):
        small_agent(name, [ct_su_b1()], "cell=lstm")
