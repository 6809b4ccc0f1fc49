"""What tests of agents and methods share."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pytest
import torch

from baselines.learner import compiled_gradient_step


@pytest.fixture
def compile_by(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[Any], None]]:
    """Sets the backend that compiles gradient steps; steps of other tests are compiled again."""

    def set_backend(backend: Any) -> None:
        monkeypatch.setattr(torch, "compile", partial(torch.compile, backend=backend))
        compiled_gradient_step.cache_clear()

    yield set_backend
    compiled_gradient_step.cache_clear()
