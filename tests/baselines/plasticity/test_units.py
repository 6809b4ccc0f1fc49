"""Hidden units of every network: all that reads them, and their activations, equal histories once."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from functools import partial

import pytest
import torch
from helpers.small_agents import agent_of, batches, learnt_from, others_slow

from baselines.parts import merge as merging
from baselines.parts.networks import HISTORY
from baselines.parts.units import activations, hidden_layers
from ctgraph_rl import CTGraphEnv, PaperImages
from ctgraph_rl.packages import conf_dir
from ctgraph_rl.runs.settings import names_in
from curricula.paper import ct_su_b1

TASK = replace(ct_su_b1((1, 2)), images=PaperImages(16, size=12))
CNN = "agent.encoder=cnn"
NETWORKS = {
    "mlp": ("ppo", ["encoder.1", "encoder.2"]),
    "cnn": ("ppo", ["convolution.1", "convolution.2", "encoder.1", "encoder.2"], CNN),
    "q": ("dqn", ["convolution.1", "convolution.2", "encoder.1", "head.1"], CNN),
    "recurrent q": ("drqn", ["encoder.1", "memory"]),
    "quantiles": ("qrdqn_lstm", ["encoder.1", "memory"]),
    **{name: ("lstm_ppo", ["encoder.1", "cell"], f"cell={name}") for name in ("none", "frames", "amrl_avg")},
    **{name: ("lstm_ppo", ["encoder.1", "memory"], f"cell={name}") for name in ("lstm", "gru", "min_gru")},
    "backpropamine": ("lstm_ppo", ["encoder.1", "memory"], "cell=backpropamine"),
    "attention": ("lstm_ppo", ["encoder.1", "wider", "memory"], "cell=attention"),
    "amrl_max": ("lstm_ppo", ["encoder.1", "cell"], "cell=amrl_max", "agent.cell.reads_action=true"),
}


@pytest.fixture(autouse=True)
def always(monkeypatch):
    """Small batches go over their histories, too."""
    monkeypatch.setattr(merging, "FEWEST_FRAMES", 0)
    monkeypatch.setattr(merging, "LARGEST_SHARE", 100.0)


def made(compose, kind: str) -> tuple:
    """An agent, and a minibatch that it would learn from."""
    name, _, *overrides = NETWORKS[kind]
    agent = agent_of(compose, name, CTGraphEnv([TASK] * 16, seed=3), *overrides)
    [batch] = batches(agent, TASK, 1)
    return agent, learnt_from(deepcopy(agent), batch)[0]


def test_every_cell_is_tried():
    tried = {setting for _, _, *settings in NETWORKS.values() for setting in settings}
    assert tried >= {f"cell={name}" for name in names_in(conf_dir(), "cell")}


@pytest.mark.parametrize("kind", others_slow(NETWORKS, "cnn"))
def test_a_unit_is_read_by_the_readers_columns_and_nothing_else(compose, kind):
    agent, minibatch = made(compose, kind)
    layers = hidden_layers(agent.policy)
    assert [layer.name for layer in layers] == NETWORKS[kind][1]

    before = agent.outputs(minibatch)
    values = activations(agent.policy, minibatch)
    for number, layer in enumerate(layers):
        if layer.activation is None:
            continue
        unit = values[layer.name][0].sum(dim=0).argmax()
        changed = deepcopy(agent)
        with torch.no_grad():
            for reader in hidden_layers(changed.policy)[number].readers:
                assert len(reader.columns) == layer.num_units
                reader.weight[:, reader.columns[unit]] = 0
        handle = layer.activation.register_forward_hook(partial(without, unit))
        expected = agent.outputs(minibatch)
        handle.remove()

        found = changed.outputs(minibatch)

        for key, value in expected.items():
            torch.testing.assert_close(found[key], value, rtol=1e-5, atol=1e-6)
        assert any(not torch.allclose(found[key], value, atol=1e-4) for key, value in before.items())


def without(unit, module, arguments, output):
    """A layer's output with 0 in place of a unit."""
    return output.index_fill(-1, unit, 0.0)


@pytest.mark.parametrize("kind", others_slow(NETWORKS, "cnn", "lstm"))
def test_activations_are_those_of_all_frames_by_their_shares(compose, kind):
    agent, minibatch = made(compose, kind)
    single = {key: value for key, value in minibatch.items() if not str(key).endswith("number")}
    if HISTORY in minibatch:
        assert len(activations(agent.policy, minibatch)["encoder.1"][0]) < minibatch["action"].numel()

    found = activations(agent.policy, minibatch)
    for name, weighted in activations(agent.policy, single).items():
        assert weighted[1].sum() == pytest.approx(1)
        assert found[name][1].sum() == pytest.approx(1)
        torch.testing.assert_close(mean_of_squares(found[name]), mean_of_squares(weighted))
    if kind == "lstm":
        encoder = agent.trunk.encoder.module
        inputs = minibatch["observation"].flatten(2).flatten(0, 1) * encoder.scale
        every = encoder.linear(inputs).relu().square().mean(dim=0)
        torch.testing.assert_close(mean_of_squares(found["encoder.1"]), every)


def mean_of_squares(weighted) -> torch.Tensor:
    """The mean of squares over frames."""
    values, shares = weighted
    return shares @ values.square()


def test_shares_count_the_frames_of_equal_inputs(compose):
    agent, minibatch = made(compose, "mlp")
    images = minibatch["observation"].flatten(1).unique(dim=0, return_counts=True)[1]

    _, shares = activations(agent.policy, minibatch)["encoder.1"]

    assert sorted(shares.tolist()) == pytest.approx(sorted((images / images.sum()).tolist()))
    assert len(images) < len(minibatch["observation"])
