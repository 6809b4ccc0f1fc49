"""A training loop in the manner of TorchRL's tutorial on PPO learns a CT-graph; none of our agents is in it."""

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torch.distributions import Categorical
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.modules import ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from ctgraph_rl import CTGraphEnv
from ctgraph_rl.tasks.configurations import ct_fo_b1

FRAMES = 64 * 32
"""In a batch."""


class Scaled(nn.Module):
    """A small network of an image in 0..255."""

    def __init__(self, num_outputs):
        super().__init__()
        self.layers = nn.Sequential(nn.Flatten(-3), nn.Linear(144, 64), nn.Tanh(), nn.Linear(64, num_outputs))

    def forward(self, image):
        return self.layers(image / 255)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_ppo_of_torchrl_reaches_nine_tenths_of_the_optimum(seed):
    torch.manual_seed(seed)
    env = CTGraphEnv([ct_fo_b1()] * 64, seed=seed)
    logits = TensorDictModule(Scaled(3), ["observation"], ["logits"])
    spec = {"spec": env.action_spec_unbatched, "distribution_class": Categorical, "return_log_prob": True}
    actor = ProbabilisticActor(logits, in_keys=["logits"], **spec)
    critic = ValueOperator(Scaled(1), in_keys=["observation"])
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic)
    loss = ClipPPOLoss(actor, critic, entropy_coeff=0.01)
    optimiser = torch.optim.Adam(loss.parameters(), 1e-3)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(FRAMES), sampler=SamplerWithoutReplacement(), batch_size=256
    )
    frames = {"frames_per_batch": FRAMES, "total_frames": 30 * FRAMES}

    for batch in Collector(env, actor, auto_register_policy_transforms=True, **frames):
        advantage(batch)
        buffer.empty()
        buffer.extend(batch.reshape(-1))
        for _ in range(4):
            for minibatch in buffer:
                losses = loss(minibatch)
                optimiser.zero_grad()
                (losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]).backward()
                optimiser.step()

    returns = batch["next", "episode_reward"][batch["next", "done"]]
    assert returns.mean() >= 0.9
