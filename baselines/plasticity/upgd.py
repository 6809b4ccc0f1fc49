"""UPGD: utility-based perturbed gradient descent, an optimiser that changes useful weights less.

Elsayed and Mahmood 2024 (ICLR, arXiv 2404.00781), and AdaptiveUPGD of the authors' code for reinforcement learning.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from typing_extensions import override

from baselines.parts.learner import Learner
from baselines.plasticity.plasticity import Plasticity
from ctgraph_rl.checks import is_real, not_negative, one_of, positive, require

FORMS = ("adam", "sgd")


class UPGD(Plasticity):
    """Replaces the agent's optimiser by `UPGDOptimiser`, with the agent's learning rate.

    Args:
        form: ``adam`` or ``sgd``.
        weight_decay: l, >= 0.
        utility_decay: b, in [0, 1).
        noise: s, >= 0.
        betas: decays of Adam's moments, in [0, 1) each.
        eps: of Adam, > 0.
    """

    stackable = False

    def __init__(
        self,
        form: str,
        weight_decay: float,
        utility_decay: float,
        noise: float,
        betas: Sequence[float],
        eps: float,
    ) -> None:
        super().__init__()
        pair = isinstance(betas, Sequence) and len(betas) == 2
        require((pair, f"betas must be two numbers, got {betas!r}"))
        decays = [("utility_decay", utility_decay), ("betas[0]", betas[0]), ("betas[1]", betas[1])]
        require(
            *one_of(FORMS, form=form),
            *not_negative(weight_decay=weight_decay, noise=noise),
            *positive(eps=eps),
            *((is_real(value, 0) and value < 1, f"{name} must be in [0, 1), got {value!r}") for name, value in decays),
        )
        self.make_optimiser = partial(
            UPGDOptimiser,
            form=form,
            weight_decay=weight_decay,
            utility_decay=utility_decay,
            noise=noise,
            betas=tuple(betas),
            eps=eps,
        )

    @override
    def setup(self, agent: Learner) -> None:
        compiled = "UPGD is an optimiser of Python, which a compiled step cannot take: set agent.compile=false"
        require((agent.compiled_step is None, compiled))
        rate = agent.optimiser.defaults["lr"]
        agent.optimiser = self.make_optimiser(agent.trainable, lr=rate, seed=self.generator.initial_seed())


class UPGDOptimiser(torch.optim.Optimizer):
    """With a learning rate a, gradients g, noise x ~ N(0, 1), t steps, and the maximum over all weights:

        u <- b u + (1 - b) (-g w),  k = 1 - sigmoid(u / (1 - b^t) / max u),
        sgd:   w <- (1 - a l) w - a k (g + s x),
        adam:  w <- (1 - a l) w - 2 a k (m / (sqrt v + eps) + s x),

    with Adam's moments m and v, corrected for their start. A maximum below the smallest normal number counts as that.

    Args:
        seed: of the noise, which depends on it and t only.
        settings: as of `UPGD`.
    """

    def __init__(self, parameters: Iterable[nn.Parameter], **settings: Any) -> None:
        super().__init__(parameters, settings)

    @override
    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]
        [group] = self.param_groups
        weights = [weight for weight in group["params"] if weight.grad is not None]
        for weight in weights:
            state = self.state[weight]
            if not state:
                state["step"] = torch.zeros((), dtype=torch.float32, device="cpu")
                for name in ("utility", "exp_avg", "exp_avg_sq"):
                    state[name] = torch.zeros_like(weight)
            state["step"] += 1
            state["utility"].lerp_(-weight.grad * weight, 1 - group["utility_decay"])
        largest = torch.stack([self.state[weight]["utility"].max() for weight in weights]).max()
        largest = largest.clamp(min=torch.finfo(largest.dtype).tiny)
        steps = int(self.state[weights[0]]["step"])
        generator = torch.Generator(device="cpu").manual_seed((group["seed"] + (steps << 32)) % 2**63)
        for weight in weights:
            state = self.state[weight]
            utility = state["utility"] / (1 - group["utility_decay"] ** steps)
            kept = 1 - torch.sigmoid(utility / largest)
            noise = torch.randn(weight.shape, generator=generator, dtype=torch.float32, device="cpu")
            change = self._direction(group, weight, state, steps) + group["noise"] * noise.to(weight)
            rate = 2 * group["lr"] if group["form"] == "adam" else group["lr"]
            weight.mul_(1 - group["lr"] * group["weight_decay"]).sub_(rate * kept * change)

    def _direction(self, group: dict[str, Any], weight: Tensor, state: dict[str, Tensor], steps: int) -> Tensor:
        gradient = weight.grad
        assert gradient is not None
        if group["form"] == "sgd":
            return gradient
        first, second = group["betas"]
        state["exp_avg"].lerp_(gradient, 1 - first)
        state["exp_avg_sq"].lerp_(gradient.square(), 1 - second)
        mean = state["exp_avg"] / (1 - first**steps)
        square = state["exp_avg_sq"] / (1 - second**steps)
        return mean / (square.sqrt() + group["eps"])
