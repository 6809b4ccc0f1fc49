"""The base classes of modulating masks: a fixed random network, and for each task a mask over its weights.

Ben-Iwhiwhu et al. 2023 (TMLR, arXiv 2212.11110), on the supermasks of Wortsman et al. 2020 (arXiv 2006.14769).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from typing_extensions import override

from baselines.methods.method import TaskMethod
from baselines.methods.parts.weights import Weights, flat
from ctgraph_rl.checks import LARGEST_INT, is_int, require


class Masks(TaskMethod):
    """The weights are w = c * 1[s >= 0], elementwise: c is drawn once and fixed, the scores s of each task are learned.

    c has the sign of the agent's first weights and the size sqrt(2 / inputs of the layer); biases are 0. Initial scores
    are uniform in +-1 / sqrt(inputs), and their gradient is that of the mask (straight through): dL/ds = c dL/dw.
    Subclasses say how a new task's scores start.

    Stored are c, the scores of each of the curriculum's tasks and the present ones: 4 P bytes each; a mask without
    scores takes P bits.

    Args:
        backbone_seed: of c and the initial scores of each slot, so that agents with different seeds share them and can
            exchange masks; None: from the agent's seed.
    """

    stackable = True
    may_recycle = False
    counts = ("ended",)
    agent_members = (*TaskMethod.agent_members, "replace_optimiser")

    constant: Tensor  # c, float32 [P]
    scores: Tensor  # of tasks that have ended, by slot; float32 [tasks, P]
    own: nn.ParameterList  # the scores that are trained, float32 [n] of each weight tensor
    betas: nn.Parameter  # b, of methods that combine scores, float32 [weight tensors, n]
    places: Tensor  # the b that `combine` reads, int64 [n + 1]
    offsets: Tensor  # added to them: 0, or -infinity, float32 [n + 1]

    def __init__(self, backbone_seed: int | None = None) -> None:
        super().__init__()
        rule = f"backbone_seed must be an integer in [0, 2**63) or null, got {backbone_seed!r}"
        require((backbone_seed is None or is_int(backbone_seed, 0, LARGEST_INT), rule))
        self.backbone_seed = backbone_seed

    @override
    def setup(self) -> None:
        super().setup()
        vectors = [name for name, each in self.weights.named if each.ndim < 2 and "bias" not in name.rpartition(".")[2]]
        rule = f"{type(self).__name__} masks weight matrices, and {', '.join(vectors)} are none"
        require((not vectors, f"{rule}: take another method, or no such layers, which plasticity=layer_norm adds"))
        self.ended = 0
        scores = self.weights.zeros().repeat(self.num_tasks, 1)
        own = self.initial_scores()
        if self.backbone_seed is not None:
            with torch.random.fork_rng(devices=[]):  # agents are built from torch's global generator of the CPU
                torch.default_generator.manual_seed(self.backbone_seed)
                self.agent.reset_parameters()
                scores = torch.stack([flat(self.initial_scores()) for _ in range(self.num_tasks)])
            own = [part.clone() for part in self.weights.split(scores[0])]
        constant = flat([_signed_constant(parameter) for parameter in self.weights.parameters])
        self.register_buffer("constant", constant.detach())
        self.register_buffer("scores", scores)
        self.own = nn.ParameterList(own)
        self.agent.replace_optimiser(self.trainable)
        self._write()

    @property
    def trainable(self) -> list[nn.Parameter]:
        """The optimiser's parameters."""
        return list(self.own)

    @torch.no_grad()
    def initial_scores(self) -> list[Tensor]:
        """Draw random scores, float32 [n] of each weight tensor."""
        found = []
        for parameter in self.weights.parameters:
            scores = torch.zeros_like(parameter)
            if parameter.ndim > 1:
                most = parameter[0].numel() ** -0.5
                scores.uniform_(-most, most)
            found.append(scores.flatten())
        return found

    def current_scores(self) -> Sequence[Tensor]:
        """Return the present mask's scores, float32 [n] of each weight tensor, from the trained parameters."""
        return list(self.own)

    @torch.no_grad()
    @override
    def start_task(self, task: int | None) -> None:
        super().start_task(task)
        if self.slot < self.ended:
            self.set_scores(self.weights.split(self.scores[self.slot]))
        else:
            self.init_scores()
        self.agent.replace_optimiser(self.trainable)
        self._write()
        self.agent.weights_changed()

    def init_scores(self) -> None:
        """Initialise a new task's scores."""
        drawn = self.initial_scores()
        self.set_scores(drawn if self.backbone_seed is None else self.weights.split(self.scores[self.slot]))

    def set_places(self, places: Sequence[int], excluded: int, device: torch.device) -> None:
        """Set which b `combine` reads, the last for the own scores, and exclude the last of the others."""
        none = [-torch.inf] * excluded
        offsets = [0.0] * (len(places) - excluded - 1) + none + [0.0]
        self.places = torch.tensor(places, device=device, dtype=torch.int64)
        self.offsets = torch.tensor(offsets, device=device, dtype=torch.float32)

    def combine(self, others: Tensor) -> Sequence[Tensor]:
        """Combine other scores, [n, P], with the own ones, by the b of `set_places`."""
        betas = self.betas.index_select(-1, self.places) + self.offsets
        return list(map(combined, betas.unbind(-2), self.weights.split(others), self.own))

    def set_scores(self, scores: Sequence[Tensor]) -> None:
        """Set the trained scores."""
        for own, value in zip(self.own, scores, strict=True):
            own.copy_(value)

    @override
    @torch.no_grad()
    def end_task(self) -> None:
        present = self.current_scores()
        self.scores[self.slot] = flat(present)
        self.set_scores(present)
        self.ended = max(self.ended, self.slot + 1)

    @override
    def transform_gradients(self, gradients: Sequence[Tensor], weights: Sequence[Tensor]) -> Sequence[Tensor]:
        with torch.enable_grad():
            scores = self.current_scores()
        constants = self.weights.split(self.constant)
        of_scores = [c * gradient.reshape(c.shape) for c, gradient in zip(constants, gradients, strict=True)]
        return torch.autograd.grad(scores, self.trainable, of_scores, materialize_grads=True)

    @override
    @torch.no_grad()
    def after_step(self, weights: Sequence[Tensor]) -> None:
        masked = map(_masked, self.current_scores(), self.weights.split(self.constant))
        for weight, part in zip(weights, masked, strict=True):
            weight.copy_(part.view_as(weight))

    @override
    @torch.no_grad()
    def task_weights(self, task: int) -> Tensor | None:
        slot = self.other_slot(task)
        return None if slot is None else _masked(self.scores[slot], self.constant)

    @torch.no_grad()
    def scores_of(self, task: int) -> Tensor:
        """Return a copy of a started task's scores, float32 [P]; of the present one, its scores now."""
        slot = self.started.index(task)
        return flat(self.current_scores()) if slot == self.slot else self.scores[slot].clone()

    @torch.no_grad()
    def take_scores(self, scores: Tensor) -> None:
        """Replace the present task's scores, [P]; the optimiser keeps its state."""
        self.set_scores(self.weights.split(scores))
        self._write()
        self.agent.weights_changed()

    def _write(self) -> None:
        self.after_step(self.weights.parameters)


def zero_betas(weights: Weights, count: int) -> nn.Parameter:
    """Return so many b of 0 for each weight tensor."""
    return nn.Parameter(torch.zeros(len(weights.parameters), count, dtype=torch.float32, device="cpu"))


def _masked(scores: Tensor, constant: Tensor) -> Tensor:
    return torch.where(scores >= 0, constant, 0.0)


def combined(betas: Tensor, old: Tensor, new: Tensor) -> Tensor:
    """Combine earlier scores of a weight tensor, [..., k, n], with new ones, [..., n], by softmax shares."""
    shares = betas.softmax(dim=-1)  # by the tensor: the compiler of torch 2.13 fails at eight numbers for all of them
    return (shares[..., :-1, None] * old).sum(dim=-2) + shares[..., -1:] * new


def _signed_constant(parameter: Tensor) -> Tensor:
    if parameter.ndim < 2:
        return torch.zeros_like(parameter)
    return parameter.sign() * (2 / parameter[0].numel()) ** 0.5
