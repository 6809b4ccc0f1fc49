"""What methods with modulating masks share: a fixed random network, and for each task which of its weights count.

Ben-Iwhiwhu et al. 2023 (TMLR, arXiv 2212.11110), on the supermasks of Wortsman et al. 2020 (arXiv 2006.14769).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from baselines.methods.method import TaskMethod
from baselines.methods.weights import Weights, flat
from ctgraph_rl.checks import require
from ctgraph_rl.tasks.curriculum import Curriculum

if TYPE_CHECKING:
    from baselines.learner import Learner


class Masks(TaskMethod):
    """The weights are w = c * 1[s >= 0], elementwise: c is drawn once and fixed, the scores s of each task are learned.

    c has the sign of the weights that the agent was built with and the size sqrt(2 / inputs of the layer); biases are
    0. Scores begin uniform in +-1 / sqrt(inputs), and their gradient is that of the mask (straight through):
    dL/ds = c dL/dw. What a class adds is how a new task's scores begin.

    Stored are c, the scores of each of the curriculum's tasks and those of the present one: 4 P bytes each; a mask
    alone could be kept in P bits.
    """

    constant: Tensor  # c, float32 [P]
    scores: Tensor  # of tasks that have ended, in the order of their beginning; float32 [tasks, P]
    own: nn.ParameterList  # the scores that are learned, float32 [n] of each weight tensor

    def put_on(self, agent: Learner, weights: Weights, curriculum: Curriculum) -> None:
        """See `Method`; the optimiser changes scores from now on."""
        super().put_on(agent, weights, curriculum)
        named = zip(weights.names, weights.parameters, strict=True)
        vectors = [name for name, each in named if each.ndim < 2 and "bias" not in name.rpartition(".")[2]]
        rule = f"{type(self).__name__} masks weight matrices, and {', '.join(vectors)} are none"
        require((not vectors, f"{rule}: take another method, or a network without such layers"))
        self.ended = 0
        """Tasks whose scores are kept."""

        constant = flat([_signed_constant(parameter) for parameter in weights.parameters])
        self.register_buffer("constant", constant.detach())
        self.register_buffer("scores", torch.zeros(self.num_tasks, len(weights)))
        self.own = nn.ParameterList(self.new_scores())
        agent.optimise(self.live)
        self._write()

    @property
    def live(self) -> list[nn.Parameter]:
        """What the optimiser changes."""
        return list(self.own)

    @torch.no_grad()
    def new_scores(self) -> list[Tensor]:
        """Random scores, float32 [n] of each weight tensor."""
        return [_drawn_scores(parameter).flatten() for parameter in self.weights.parameters]

    def present_scores(self) -> Sequence[Tensor]:
        """The scores that make the present mask, float32 [n] of each weight tensor, as functions of what is learned."""
        return list(self.own)

    @torch.no_grad()
    def start_task(self, task: int | None) -> None:
        """Begin with a new task's scores, or go back to those of a task that was here before."""
        super().start_task(task)
        if self.place < self.ended:
            self.go_on_from(self.weights.split(self.scores[self.place]))
        else:
            self.begin()
        self.agent.optimise(self.live)
        self._write()
        self.agent.weights_changed()

    def begin(self) -> None:
        """Draw a new task's scores."""
        self.go_on_from(self.new_scores())

    def go_on_from(self, scores: Sequence[Tensor]) -> None:
        """Give what is learned the values of scores."""
        for own, value in zip(self.own, scores, strict=True):
            own.copy_(value)

    @torch.no_grad()
    def end_task(self) -> None:
        """Keep the task's scores."""
        present = self.present_scores()
        self.scores[self.place] = flat(present)
        self.go_on_from(present)
        self.ended = max(self.ended, self.place + 1)

    def gradients(self, gradients: Sequence[Tensor]) -> Sequence[Tensor]:
        """Those of what is learned, through the scores."""
        with torch.enable_grad():
            scores = self.present_scores()
        constants = self.weights.split(self.constant)
        of_scores = [constant * gradient.flatten() for constant, gradient in zip(constants, gradients, strict=True)]
        return torch.autograd.grad(scores, self.live, of_scores, materialize_grads=True)

    def settle(self) -> None:
        """Give the network the weights that count now."""
        self._write()

    @torch.no_grad()
    def weights_of(self, task: int) -> Tensor | None:
        """The weights that count in a task."""
        place = self.place_of(task)
        return None if not self.begun or place == self.place else _masked(self.scores[place], self.constant)

    @torch.no_grad()
    def _write(self) -> None:
        self.weights.write_parts(list(map(_masked, self.present_scores(), self.weights.split(self.constant))))

    def get_extra_state(self) -> dict[str, Any]:
        """Who has which place, and how many have ended."""
        return {**super().get_extra_state(), "ended": self.ended}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore what `get_extra_state` gave."""
        super().set_extra_state(state)
        self.ended = state["ended"]


class CombinedMasks(Masks):
    """`Masks` whose new scores are a linear combination of those of earlier tasks and of new ones.

    In the k-th task each weight tensor l has s = sum_i a_i s_i + a_k s_k, where a is the softmax of k learned numbers
    b_l; the earlier tasks' scores s_i stay as they are. At the task's end s is kept as its scores. The numbers b take 4
    bytes for each task and weight tensor.
    """

    betas: nn.Parameter  # b, float32 [weight tensors, tasks]; the last one in use is the new scores'

    def put_on(self, agent: Learner, weights: Weights, curriculum: Curriculum) -> None:
        """See `Method`."""
        self.betas = nn.Parameter(torch.zeros(len(weights.parameters), len(curriculum.tasks)))
        super().put_on(agent, weights, curriculum)

    @property
    def live(self) -> list[nn.Parameter]:
        """The new scores, and the weights of the combination where there is one."""
        return [*self.own, self.betas]

    @property
    def num_combined(self) -> int:
        """Earlier tasks whose scores the present task's are made from."""
        return self.ended if self.place >= self.ended else 0

    def new_betas(self, num_earlier: int) -> Tensor:
        """What the learned numbers of the earlier tasks, and behind them of the new scores, begin with."""
        raise NotImplementedError

    def begin(self) -> None:
        """Draw a new task's scores, and begin with its combination."""
        super().begin()
        self.betas.zero_()
        self.betas[:, : self.place + 1] = self.new_betas(self.place)

    def present_scores(self) -> Sequence[Tensor]:
        """The combination."""
        earlier = self.num_combined
        if not earlier:
            return super().present_scores()
        old = self.weights.split(self.scores[:earlier])
        return list(map(_combined, self.betas[:, : earlier + 1], old, self.own))


def _masked(scores: Tensor, constant: Tensor) -> Tensor:
    return torch.where(scores >= 0, constant, 0.0)


def _combined(betas: Tensor, old: Tensor, new: Tensor) -> Tensor:
    """Scores of a weight tensor, [n], of earlier [k, n] and new ones; shares are a softmax of k + 1."""
    shares = betas.softmax(dim=0)  # by the tensor: the compiler of torch 2.13 fails at eight numbers for all of them
    return (shares[:-1, None] * old).sum(dim=0) + shares[-1] * new


def _signed_constant(parameter: Tensor) -> Tensor:
    """The sign of weights times sqrt(2 / inputs); 0 for biases."""
    if parameter.ndim < 2:
        return torch.zeros_like(parameter)
    return parameter.sign() * (2 / parameter[0].numel()) ** 0.5


def _drawn_scores(parameter: Tensor) -> Tensor:
    """Uniform in +-1 / sqrt(inputs); 0 for biases."""
    if parameter.ndim < 2:
        return torch.zeros_like(parameter)
    most = parameter[0].numel() ** -0.5
    return torch.empty_like(parameter).uniform_(-most, most)
