"""CKA-RL: each task's weights are the first task's, a vector of the task, and a mixture of earlier vectors.

Hu et al. 2025 (Continual Knowledge Adaptation for Reinforcement Learning, NeurIPS, arXiv 2510.19314).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from typing_extensions import override

from baselines.methods.method import TaskMethod
from baselines.methods.parts.weights import flat, head_names, write_flat
from ctgraph_rl.checks import at_least_one, one_of, positive, require, true_or_false

SCOPES = ("actor_head", "all")


class CKARL(TaskMethod):
    """w = w_base + v_k + sum_j softmax(scale * alpha)_j v_j, for some or all of the network's weights.

    w_base are the weights at the end of the first task, which is learned without a method. In each later task v_k
    starts at 0 and is trained together with alpha; at the end it joins the pool of vectors v_j. If the pool is full,
    the mean of the two vectors with the highest cosine replaces them. Mask LC combines masks' scores in the same way.

    All other weights are shared. An earlier task is played with its w and the present other weights. A task that
    returns trains its w further, without a mixture.

    Stored are w_base, v_k, the pool's vectors and w of each of the curriculum's tasks, 4 S bytes each; S is the number
    of weights in ``scope``.

    Args:
        scope: ``actor_head``, the output layer that decides the action, as published, or ``all`` weights.
        pool_size: most vectors v_j.
        scale: s.
        random_alpha: start alpha at N(0, 1) / n, with n vectors in the pool; False: at 0, with equal shares.
        alpha_rate: learning rate of alpha by that of the agent, exact for Adam and RMSprop.
    """

    stackable = of_one_seed = True
    may_recycle = False
    counts = ("ended", "num_pooled")
    agent_members = (*TaskMethod.agent_members, "replace_optimiser")

    base: Tensor  # float32 [S]
    pool: Tensor  # float32 [pool_size, S]
    kept: Tensor  # w of tasks that have ended, by slot, float32 [tasks, S]
    own: nn.ParameterList  # w_base + v_k, of each weight tensor in scope
    alpha: nn.Parameter  # alpha / alpha_rate, float32 [pool_size]

    def __init__(self, scope: str, pool_size: int, scale: float, random_alpha: bool, alpha_rate: float) -> None:
        super().__init__()
        require(
            *one_of(SCOPES, scope=scope),
            *at_least_one(pool_size=pool_size),
            *positive(scale=scale, alpha_rate=alpha_rate),
            *true_or_false(random_alpha=random_alpha),
        )
        self.scope = scope
        self.pool_size = pool_size
        self.random_alpha = random_alpha
        self.alpha_rate = alpha_rate
        self.factor = scale * alpha_rate

    @override
    def setup(self) -> None:
        names = self.weights.names if self.scope == "all" else head_names(self.agent.policy, without="state_value")
        self.inside = [name in names for name in self.weights.names]
        message = f"{type(self.agent).__name__} has no output layer behind a trunk for scope=actor_head: set scope=all"
        require((any(self.inside), message))
        self.in_scope = self.weights.mask_of(names)
        super().setup()
        self.ended = self.num_pooled = 0
        own = self._within(self.weights.parameters)
        vector = flat(own).detach()
        self.register_buffer("base", torch.zeros_like(vector))
        self.register_buffer("pool", vector.new_zeros(self.pool_size, len(vector)))
        self.register_buffer("kept", vector.new_zeros(self.num_tasks, len(vector)))
        self.own = nn.ParameterList([each.detach().clone() for each in own])
        self.alpha = nn.Parameter(vector.new_zeros(self.pool_size))
        self.agent.replace_optimiser(self.trainable)

    @override
    def num_kept(self) -> int:
        return int(self.in_scope.sum())

    @property
    def trainable(self) -> list[nn.Parameter]:
        """The optimiser's parameters: the weights, with w_base + v_k in scope, and alpha."""
        own = iter(self.own)
        weights = zip(self.weights.parameters, self.inside, strict=True)
        return [*(next(own) if inside else parameter for parameter, inside in weights), self.alpha]

    @property
    def num_combined(self) -> int:
        """Number of vectors v_j in the present weights."""
        return self.num_pooled if self.slot >= self.ended else 0

    @property
    def shares(self) -> Tensor:
        """softmax(scale * alpha), float32 [num_combined]."""
        return (self.factor * self.alpha[: self.num_combined]).softmax(dim=0)

    def current(self) -> Tensor:
        """Return w in scope, float32 [S]."""
        own = flat(list(self.own))
        return own + self.shares @ self.pool[: self.num_combined] if self.num_combined else own

    @torch.no_grad()
    @override
    def start_task(self, task: int | None) -> None:
        super().start_task(task)
        if self.slot < self.ended:
            write_flat(self.kept[self.slot], list(self.own))
        elif self.slot:
            write_flat(self.base, list(self.own))
        if self.num_combined:
            make = torch.randn if self.random_alpha else torch.zeros
            drawn = make(self.num_combined, dtype=torch.float32, device="cpu")
            self.alpha[: self.num_combined] = drawn.to(self.alpha) / (self.num_combined * self.alpha_rate)
        self.agent.replace_optimiser(self.trainable)
        self.after_step(self.weights.parameters)
        self.agent.weights_changed()

    @torch.no_grad()
    @override
    def end_task(self) -> None:
        present = self.current()
        if self.slot >= self.ended:
            if self.slot:
                self._add(flat(list(self.own)) - self.base)
            else:
                self.base.copy_(present)
        self.kept[self.slot] = present
        write_flat(present, list(self.own))
        self.ended = max(self.ended, self.slot + 1)

    @override
    def transform_gradients(self, gradients: Sequence[Tensor], weights: Sequence[Tensor]) -> Sequence[Tensor]:
        in_scope = flat(self._within(gradients))
        shares = self.shares.detach()
        along = self.pool[: self.num_combined] @ in_scope
        of_alpha = self.factor * shares * (along - shares @ along)
        return [*gradients, torch.cat([of_alpha, torch.zeros_like(self.alpha[self.num_combined :])])]

    @override
    @torch.no_grad()
    def after_step(self, weights: Sequence[Tensor]) -> None:
        write_flat(self.current(), self._within(weights))

    @torch.no_grad()
    @override
    def task_weights(self, task: int) -> Tensor | None:
        return self.present_with(task, self.in_scope, self.kept)

    def _within(self, tensors: Sequence[Tensor]) -> list[Tensor]:
        return [each for each, inside in zip(tensors, self.inside, strict=True) if inside]

    def _add(self, vector: Tensor) -> None:
        vectors = torch.cat([self.pool[: self.num_pooled], vector.unsqueeze(0)])
        if len(vectors) > self.pool_size:
            vectors = merged(vectors)
        self.num_pooled = len(vectors)
        self.pool[: self.num_pooled] = vectors


def merged(vectors: Tensor) -> Tensor:
    """Return vectors, [n, S], with their mean in place of the two of the highest cosine, [n - 1, S]."""
    directions = nn.functional.normalize(vectors, dim=1)
    cosines = (directions @ directions.T).fill_diagonal_(-torch.inf)
    pair = divmod(int(cosines.argmax()), len(vectors))
    others = [number for number in range(len(vectors)) if number not in pair]
    return torch.cat([vectors[others], vectors[list(pair)].mean(dim=0, keepdim=True)])
