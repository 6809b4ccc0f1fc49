"""The pages on the authors' implementation and on TorchRL: their Python runs, and what they say happens."""

import inspect
import json
import logging
import re
from dataclasses import replace

import pytest
import torch
from helpers.paths import CHECKOUT
from helpers.reference_files import DELETED, FILES, SHIPPED_2023, TRACES, changed

from ctgraph_rl import CTGraphEnv, Needle, Observations, PaperImages, Task
from ctgraph_rl.gym import CTGraphGymEnv
from ctgraph_rl.tasks.configurations import ct_su_b1

TEXT = (CHECKOUT / "docs" / "how-to" / "migrate.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
PROSE = re.sub(r"```python\n.*?```", "", TEXT, flags=re.DOTALL)


def read(goal=(1, 2), **changes):
    """The task of the shipped file with other values."""
    return Task.from_json(changed(SHIPPED_2023, **changes), goal)


def step(*actions):
    """Steps of one environment from a reset on."""
    env = CTGraphGymEnv(ct_su_b1())
    env.reset(seed=0)
    for action in actions:
        env.step(action)


def step_row(*actions):
    """Steps of a batch of one row from a reset on."""
    env = CTGraphEnv([ct_su_b1()])
    data = env.reset()
    for action in actions:
        data = env.step(data.set("action", torch.tensor([action])))["next"]


CONFOUNDING = {"observations__W_IDs": [3, 102], "observations__D_IDs": [2, 2], "observations__graph_ends": [103, 103]}

REFUSED = [
    (lambda: step(0, 1, 0), "no episode is running: reset first"),
    (lambda: step_row(0, 1, 0), "rows [0] are done: reset them first"),
    (lambda: step(7), "action must be an integer in 0..2, got 7"),
    (lambda: read(graph_shape__p=1.0), "wait_prob must be in [0, 1), got 1.0"),
    (lambda: read(graph_shape__d=0), "depth must be an integer >= 1, got 0"),
    (lambda: read(graph_shape__b=1), "branching_factor must be an integer >= 2, got 1"),
    (lambda: replace(read(), step_reward=-0.01).to_json(), "the file cannot express step_reward=-0.01: use 0.0"),
    (lambda: read(reward__fail_r=DELETED), "configuration: reward.fail_r is missing"),
    (lambda: read(observations__graph_ends=DELETED), "configuration: observations.graph_ends is missing"),
    (
        lambda: read(observations__W_IDs=[1, 1]),
        "fail_ids=(1, 1) overlaps wait_ids=(1, 1); let it start at 2 or later",
    ),
    (
        lambda: read(observations__W_IDs=[2, 3]),
        "decision_ids=(3, 3) overlaps wait_ids=(2, 3); let it start at 4 or later",
    ),
    (lambda: read(**CONFOUNDING), "num_images=40 is too few for id 103 in observations: needs at least 104"),
    (
        lambda: read(observations__MDP_W=True, observations__graph_ends=[4, 7]),
        "unique_waits needs 7 wait_ids, got 1 in (2, 2); use (2, 8)",
    ),
    (
        lambda: read(image_dataset__rotation_on_read=0),
        "image_dataset.rotation_on_read must be an integer in 1..360, got 0; it is exclusive: 1 is none, and 0 makes "
        "the authors' implementation crash",
    ),
    (lambda: read(reward__high_r=0.0), "reward_cue needs goal_reward > 0, got 0.0"),
    (
        lambda: read(image_dataset__1D=True),
        "image_dataset.1D needs noise_on_read below 1 and rotation_on_read 1, got 0.05 and 10: what the authors' "
        "implementation does with others is not recorded",
    ),
    (
        lambda: read(reward__reward_distribution="gradient"),
        "reward.reward_distribution must be 'needle_in_haystack' or 'linear', got 'gradient'",
    ),
    (
        lambda: read(goal=None),
        "goal is not in the file and must be given: the authors' implementation draws one at random or sets it with "
        "set_high_reward_path, counting from 0; add 1 to each entry of its path, such as the goal 1.2 for [0, 1]",
    ),
    (
        lambda: read(goal=(0, 1)),
        "goal must be 2 decisions in 1..2, such as 1.1, got (0, 1); "
        "a path of the authors' implementation counts from 0: use 1.2",
    ),
    (
        lambda: read(reward__min_static_reward_episodes=5, reward__max_static_reward_episodes=5),
        "reward.min_static_reward_episodes must be below max_static_reward_episodes, which is exclusive, and both "
        ">= 1, or both <= 0 for a goal that stays; got 5 and 5",
    ),
    (
        lambda: CTGraphGymEnv("CT-SU-B1", render_mode="human"),
        "render_mode must be None or one of ['rgb_array', 'ansi'], got 'human'",
    ),
]

SWITCHES = {
    Task: {"extra_end_step", "legacy_goal_change"},
    Observations: {"legacy_index", "noise_before_rotation", "reward_cue", "cue_wraps"},
}


def test_the_python_of_the_page_runs_and_prints_what_it_says_and_writes_nothing_else(tmp_path, monkeypatch, capsys):
    (config,) = (trace["config"] for trace in TRACES if trace["name"] == "full MDP d2")
    (tmp_path / "graph.json").write_text(json.dumps(config), encoding="utf-8")
    handlers = list(logging.getLogger().handlers)
    monkeypatch.chdir(tmp_path)

    exec(compile("".join(BLOCKS), "migrate.md", "exec"), {})

    lines = capsys.readouterr().out.splitlines()
    assert lines == ["0.0 False 0"] * 5 + ["1.0 False 0", "0.0 True 3", "True 16"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["graph.json", "graph_2023.json"]
    assert logging.getLogger().handlers == handlers


@pytest.mark.parametrize(("refused", "message"), REFUSED, ids=[message[:40] for _, message in REFUSED])
def test_every_error_of_the_page_is_raised(refused, message):
    with pytest.raises(ValueError) as refusal:
        refused()

    assert str(refusal.value) == message


def test_every_switch_of_the_page_exists_is_off_by_default_and_on_in_a_file():
    task = read(reward__min_static_reward_episodes=5, reward__max_static_reward_episodes=6)

    named = set(re.findall(r"(\w+)=True", PROSE))

    assert named == set().union(*SWITCHES.values())
    for kind, part in ((Task, task), (Observations, task.observations)):
        defaults = inspect.signature(kind).parameters
        assert {name: defaults[name].default for name in SWITCHES[kind]} == dict.fromkeys(SWITCHES[kind], False)
        assert {name: getattr(part, name) for name in SWITCHES[kind]} == dict.fromkeys(SWITCHES[kind], True)
    assert (ct_su_b1().reward_noise, task.reward_noise) == ("additive", "multiplicative")
    assert (ct_su_b1().reward_fn, ct_su_b1().images) == (Needle(), PaperImages(5))
    assert set(re.findall(r"Reference\w+", PROSE)) == {"ReferenceImages", "ReferenceLinear", "ReferenceOneHot"}


def test_the_page_has_every_key_of_every_dialect():
    keys = {key for file in FILES.values() for section in file.values() if isinstance(section, dict) for key in section}

    missing = [key for key in [*keys, *SHIPPED_2023] if f"`{key}`" not in PROSE]

    assert missing == []


TORCHRL = (CHECKOUT / "docs" / "how-to" / "torchrl.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def loops():
    """What the page's blocks, one program, define."""
    names = {}
    exec(compile("\n\n".join(re.findall(r"```python\n(.*?)```", TORCHRL, re.DOTALL)), "torchrl.md", "exec"), names)
    return names


@pytest.mark.slow
@pytest.mark.parametrize("name", ["train_ppo", "train_dqn", "train_lstm_ppo"])
def test_every_loop_of_the_page_reaches_nine_tenths_of_the_optimum(loops, name):
    assert loops[name](seed=0) >= 0.9


def test_the_page_has_the_loops_that_are_tested_and_no_baseline(loops):
    assert sorted(name for name in loops if name.startswith("train_")) == ["train_dqn", "train_lstm_ppo", "train_ppo"]
    assert "baselines" not in TORCHRL
