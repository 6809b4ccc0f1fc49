"""The training loops of the page on TorchRL learn; none of our agents is in them."""

import re

import pytest
from helpers.paths import CHECKOUT

TEXT = (CHECKOUT / "docs" / "how-to" / "torchrl.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def loops():
    """What the page's blocks, one program, define."""
    names = {}
    exec(compile("\n\n".join(re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)), "torchrl.md", "exec"), names)
    return names


@pytest.mark.slow
@pytest.mark.parametrize("name", ["train_ppo", "train_dqn", "train_lstm_ppo"])
def test_every_loop_of_the_page_reaches_nine_tenths_of_the_optimum(loops, name):
    assert loops[name](seed=0) >= 0.9


def test_the_page_has_the_loops_that_are_tested_and_no_baseline(loops):
    assert sorted(name for name in loops if name.startswith("train_")) == ["train_dqn", "train_lstm_ppo", "train_ppo"]
    assert "baselines" not in TEXT
