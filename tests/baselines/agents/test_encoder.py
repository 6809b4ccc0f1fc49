"""Convolutions before the first layer of an agent: their equation, every agent with them, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.small_agents import AGENTS, ONE_HOT_TASK, TINY, batches, less, others_slow
from torch.nn.functional import conv2d

from baselines.parts.networks import Convolutions, Encoder
from baselines.update.stack import Stack
from ctgraph_rl import PaperImages
from ctgraph_rl.tasks.configurations import ct_fo_b1

IMAGES = replace(ct_fo_b1(), images=PaperImages(16, size=20))


@pytest.mark.parametrize("shape", [(1, 12, 12), (3, 8, 20)])
def test_the_layers_over_patches_are_two_convolutions(shape):
    torch.manual_seed(0)
    layers = Convolutions(torch.Size(shape)).double()
    images = torch.randn(5, 2, *shape, dtype=torch.float64)

    kernels = layers.first.weight.view(16, shape[0], 4, 4)
    once = conv2d(images.flatten(0, 1), kernels, layers.first.bias, stride=4).relu()
    of_neighbours = layers.second.weight.view(16, 3, 3, 16).permute(0, 3, 1, 2)
    twice = conv2d(once, of_neighbours, layers.second.bias, padding=1).relu()

    expected = twice.permute(0, 2, 3, 1).reshape(5, 2, -1)
    torch.testing.assert_close(layers(images.flatten(-3)), expected, rtol=1e-10, atol=1e-10)
    assert layers.num_features == expected.shape[-1]


def test_task_ids_stand_beside_what_the_convolutions_found():
    encoder = Encoder(torch.Size([1, 12, 12]), high=255, num_features=4, num_extra=3, kind="cnn")
    image = torch.full((2, 1, 12, 12), 9, dtype=torch.uint8)

    one, other = encoder(image, torch.eye(3)[:2])

    difference = encoder.linear.weight[:, -3] - encoder.linear.weight[:, -2]
    before = encoder.linear(torch.cat([encoder.convolutions(image.flatten(1) / 255)[0], torch.eye(3)[0]]))
    torch.testing.assert_close(one, before.relu())
    torch.testing.assert_close(other, (before - difference).relu())


@pytest.mark.parametrize("name", others_slow(AGENTS, "ppo", "drqn"))
def test_an_agent_learns_with_convolutions_and_has_none_without(name, small_agent):
    agent = small_agent(name, [IMAGES], "agent.encoder=cnn", *TINY, *less(name))
    weights = [each for part in agent.modules() if isinstance(part, Convolutions) for each in part.parameters()]
    before = [each.clone() for each in weights]

    for batch in batches(agent, IMAGES, 2):
        agent.learn(batch)

    assert weights and any(not torch.equal(old, new) for old, new in zip(before, weights, strict=True))
    plain = small_agent(name, [IMAGES], *TINY, *less(name))
    assert not any(isinstance(part, Convolutions) for part in plain.modules())


@pytest.mark.parametrize(
    ("task", "kind", "message"),
    [
        (ONE_HOT_TASK, "cnn", r"encoder must be mlp for observations of shape \(5,\): cnn reads images whose sides"),
        (IMAGES, "resnet", "encoder must be one of mlp, cnn, got 'resnet'"),
    ],
)
def test_an_encoder_that_cannot_be_is_refused(task, kind, message, small_agent):
    with pytest.raises(ValueError, match=message):
        small_agent("ppo", [task], f"agent.encoder={kind}")


def test_a_stack_of_agents_with_convolutions_computes_what_each_computes(small_agent):
    agents = [small_agent("ppo", [IMAGES], "agent.encoder=cnn", *TINY) for _ in range(2)]
    for seed, agent in enumerate(agents):
        torch.manual_seed(seed)
        agent.reset_parameters()
    [batch] = batches(agents[0], IMAGES, 1)
    seen = {"observation": batch["observation"][:, 1]}

    stack = Stack(agents)
    data = {key: torch.stack([value] * 2) for key, value in seen.items()}
    together = stack.traced_outputs(data)(*stack.acting_inputs(data))

    for number, agent in enumerate(agents):
        for key, value in agent.outputs(seen).items():
            torch.testing.assert_close(together[key][number], value)
    assert not torch.allclose(*together["state_value"])
