"""Hyperparameters out of range are refused by name; those that must be known are listed here."""

from __future__ import annotations

import re

import hydra
import pytest
from helpers.small_agents import AGENTS, YAML

from ctgraph_rl import CTGraphEnv
from curricula.paper import ct_su_b1

ENV = CTGraphEnv([ct_su_b1()])

EVERY = [
    ("num_envs=0", "num_envs must be an integer >= 1, got 0"),
    ("num_steps=1.5", "num_steps must be an integer >= 1, got 1.5"),
    ("hidden_size=0", "hidden_size must be an integer >= 1, got 0"),
    ("learning_rate=0", "learning_rate must be a number > 0, got 0"),
    ("learning_rate=fast", "learning_rate must be a number > 0, got 'fast'"),
    ("gamma=1.5", r"gamma must be in \[0, 1\], got 1.5"),
    ("gamma=0", "gamma must be a number > 0, got 0"),
    ("max_grad_norm=-1", "max_grad_norm must be a number > 0, got -1"),
]
OF_POLICY_GRADIENTS = [
    ("num_layers=0", "num_layers must be an integer >= 1, got 0"),
    ("optimiser=sgd", "optimiser must be one of adam, rmsprop, got 'sgd'"),
    ("normalize_advantage=1", "normalize_advantage must be true or false, got 1"),
]
OF_ACTOR_CRITICS = [
    ("gae_lambda=-0.1", r"gae_lambda must be in \[0, 1\], got -0.1"),
    ("entropy_coeff=-1", "entropy_coeff must be a number >= 0, got -1"),
    ("critic_coeff=null", "critic_coeff must be a number >= 0, got None"),
]
OF_PPO = [
    ("clip_epsilon=0", "clip_epsilon must be a number > 0, got 0"),
    ("num_epochs=0", "num_epochs must be an integer >= 1, got 0"),
    ("num_minibatches=0", "num_minibatches must be an integer >= 1, got 0"),
]
OF_COMPILED = [("compile=1", "compile must be true or false, got 1")]
OF_Q_LEARNERS = [
    ("n_steps=0", "n_steps must be an integer >= 1, got 0"),
    ("batch_size=0", "batch_size must be an integer >= 1, got 0"),
    ("num_updates=0", "num_updates must be an integer >= 1, got 0"),
    ("target_update_interval=0", "target_update_interval must be an integer >= 1, got 0"),
    ("annealing_num_steps=0", "annealing_num_steps must be an integer >= 1, got 0"),
    ("eps_init=2", r"eps_init must be in \[0, 1\], got 2"),
    ("eps_init=0.01", "eps_end must be <= eps_init=0.01, got 0.05"),
    ("replay_on_task_change=drop", "replay_on_task_change must be one of clear, keep, got 'drop'"),
]
OF_ONE = {
    "dqn": [
        ("buffer_size=0", "buffer_size must be an integer >= 1, got 0"),
        ("double=2", "double must be true or false, got 2"),
        ("priority_alpha=-1", "priority_alpha must be a number >= 0, got -1"),
        ("priority_beta=2", r"priority_beta must be in \[0, 1\], got 2"),
    ],
    "drqn": [("buffer_size=15", "buffer_size must be an integer >= num_steps=16, got 15")],
    "qrdqn_lstm": [
        ("buffer_size=15", "buffer_size must be an integer >= num_steps=16, got 15"),
        ("num_quantiles=0", "num_quantiles must be an integer >= 1, got 0"),
    ],
    "lstm_ppo": [("num_minibatches=3", "num_envs=256 must be a multiple of num_minibatches=3")],
    "rl2": [("trial_episodes=0", "trial_episodes must be an integer >= 1, got 0")],
    "ppo": [("num_minibatches=3", r"num_envs \* num_steps = 8192 must be a multiple of num_minibatches=3")],
    "ppo_count": [
        ("bonus_coeff=-1", "bonus_coeff must be a number >= 0, got -1"),
        ("num_hash_bits=25", r"num_hash_bits must be an integer in 1\.\.24, got 25"),
    ],
}


def bad_values(name: str) -> list[tuple[str, str]]:
    """Overrides that an agent refuses, with the messages."""
    shared = (*EVERY, *OF_POLICY_GRADIENTS, *OF_ACTOR_CRITICS, *OF_PPO, *OF_COMPILED, *OF_Q_LEARNERS)
    return [bad for bad in shared if bad[0].split("=")[0] in YAML[name]] + OF_ONE.get(name, [])


def refusal(name: str, override: str) -> str:
    """What an agent says to an override; nothing if it takes it."""
    given = YAML[name].copy()
    given.merge_with_dotlist([override])
    kind = hydra.utils.get_object(given.pop("_target_"))
    try:
        kind(ENV.observation_spec_unbatched, ENV.action_spec_unbatched, **given)
    except ValueError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("name", AGENTS)
def test_hyperparameters_out_of_range_are_refused_by_name(name):
    said = {(override, message): refusal(name, override) for override, message in bad_values(name)}

    assert {bad: found for bad, found in said.items() if not re.search(bad[1], found)} == {}
    assert len(said) >= 11


@pytest.mark.parametrize("name", AGENTS)
def test_every_hyperparameter_has_a_rule(name):
    given = sorted(str(key) for key in YAML[name] if key != "_target_")

    assert [key for key in given if not re.search(rf"\b{key} must be", refusal(name, f"{key}=nonsense"))] == []
