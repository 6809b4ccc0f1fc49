"""C-CHAIN: a gradient step changes the outputs at other frames as little as the step before.

Tang et al. 2025 (ICML, arXiv 2506.00592), on the reduction of churn by Tang and Berseth 2024 (NeurIPS, arXiv
2409.04792).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from typing_extensions import override

from baselines.methods.parts.weights import flat
from baselines.parts.learner import Learner
from baselines.parts.networks import Data, Items, TensorsByName, sequences_of, trunk_of
from baselines.parts.policy_gradient import PolicyGradient
from baselines.parts.q_learning import QLearner
from baselines.plasticity.plasticity import Plasticity
from ctgraph_rl.checks import at_least_one, not_negative, one_of, require

DISTANCES = ("kl", "cross_entropy")


class CChain(Plasticity):
    """Adds c D to the losses, on a minibatch that is drawn for it: of the same batch, or of the replay buffer.

    D is the mean of KL(p', p) of a policy p, or of (q - q')^2 of action values q. p' and q' are by the weights of some
    gradient steps ago. c is ``coeff`` at first. After ``window`` gradient steps, c = max(0, target * L / D), with the
    means of the last ``window`` for D and L, the agent's first loss: the policy's, or that of action values.

    Args:
        coeff: c at first, >= 0.
        target: share of the loss that the penalty is to have, >= 0; 0: c stays ``coeff``.
        window: gradient steps.
        lag: age of the weights in gradient steps; None: 1 of policies, 2 of action values, as in the authors' code.
        distance: ``kl``, or ``cross_entropy`` as in the code: the gradient of ``kl``, but D, which decides c, is larger
            by the policy's entropy.
    """

    stackable = False

    counts = ("num_steps", "present_coeff")
    earlier: Tensor  # the weights of the last gradient steps, float32 [lag, P], the oldest first
    recent: Tensor  # loss and D of the last gradient steps, float32 [window, 2]

    def __init__(self, coeff: float, target: float, window: int, lag: int | None, distance: str) -> None:
        super().__init__()
        require(
            *not_negative(coeff=coeff, target=target),
            *at_least_one(window=window, lag=1 if lag is None else lag),
            *one_of(DISTANCES, distance=distance),
        )
        self.present_coeff = float(coeff)
        self.target = target
        self.window = window
        self.lag = lag
        self.distance = distance
        self.num_steps = 0
        self.items: Items = {}
        """The present batch's inputs, [frames, ...], with memory [rows, steps, ...]."""

    @override
    def setup(self, agent: Learner) -> None:
        known = isinstance(agent, (PolicyGradient, QLearner)) and bool(self.layers)
        rule = f"CChain needs the outputs at any frames, which {type(agent).__name__} does not give"
        require((known, f"{rule}: take agent=ppo, lstm_ppo or dqn"))
        self.is_policy = isinstance(agent, PolicyGradient)
        names = {id(parameter): name for name, parameter in agent.named_parameters()}
        self.names = [names[id(parameter)] for parameter in agent.trainable]
        lag = self.lag or (1 if self.is_policy else 2)
        self.register_buffer("earlier", flat(agent.trainable).detach().repeat(lag, 1))
        self.register_buffer("recent", torch.zeros(self.window, 2, dtype=torch.float32, device="cpu"))

    @override
    def on_batch(self, batch: TensorDictBase) -> None:
        if self.is_policy:
            trunk: Any = trunk_of(self.agent.policy)
            states = trunk.state_keys if self.agent.memory else ()
            items = sequences_of(batch, trunk.in_keys, states)
            self.items = items if self.agent.memory else {key: value.flatten(0, 1) for key, value in items.items()}

    @override
    @torch.no_grad()
    def transform_minibatch(self, batch: Data) -> Data:
        other = self._draw(len(batch["action"]))
        weights = self.agent.weights
        parts = self.earlier[0].split([weight.numel() for weight in weights])
        before = {name: part.view_as(weight) for name, part, weight in zip(self.names, parts, weights, strict=True)}
        reference = self.agent.with_others(before, outputs_of, other)
        self.earlier = torch.cat([self.earlier[1:], flat(weights).detach().unsqueeze(0)])
        coeff = reference.new_tensor(self.present_coeff)
        added = {**other, "reference": reference, "coeff": coeff}
        return {**batch, **{("churn", key): value for key, value in added.items()}}

    def _draw(self, count: int) -> Items:
        agent = self.agent
        if isinstance(agent, QLearner):
            places = torch.randint(len(agent.replay), [count], generator=self.generator, device="cpu")
            device = next(agent.parameters()).device
            stored = agent.replay.storage._storage.items(True, True)
            keys = trunk_of(agent.policy).in_keys
            return {key: value.index_select(0, places).to(device) for key, value in stored if key in keys}
        size = len(next(iter(self.items.values())))
        places = torch.randperm(size, generator=self.generator, device="cpu")[:count]
        return {key: value[places.to(value.device)] for key, value in self.items.items()}

    @override
    def penalties(self, batch: Data, weights: Sequence[Tensor]) -> TensorsByName:
        other = {key[1]: value for key, value in batch.items() if key[0] == "churn"}
        if not other:
            return {}
        now = outputs_of(self.agent, other)
        before = other["reference"]
        if not self.is_policy:
            distance = (now - before).square().mean()
        else:
            of_entropy = before if self.distance == "kl" else torch.zeros_like(before)
            distance = (before.exp() * (of_entropy - now)).sum(dim=-1).mean()
        return {"loss_c_chain": other["coeff"] * distance, "churn": distance.detach()}

    @override
    def after_step(self, batch: Data, measured: TensorsByName) -> TensorsByName:
        loss = next(value for key, value in measured.items() if key.startswith("loss_"))
        used = measured["grad_norm"].new_tensor(self.present_coeff)
        self.recent[self.num_steps % self.window] = torch.stack([loss, measured["churn"]]).to(self.recent)
        self.num_steps += 1
        mean_loss, mean_churn = self.recent.mean(dim=0).tolist()
        if self.target > 0 and self.num_steps >= self.window and mean_churn > 0:
            self.present_coeff = max(0.0, self.target * mean_loss / mean_churn)
        return {**measured, "c_chain_coeff": used}


def outputs_of(agent: Learner, data: Data) -> Tensor:
    """Return log-probabilities of all actions, or action values, [..., num_actions]."""
    return agent.outputs(data)["log_probs" if isinstance(agent, PolicyGradient) else "action_value"]
