"""Plasticities with methods, seeds together and compiled steps; what does not fit is refused before any work."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from itertools import cycle
from typing import Any

import pytest
import torch
from helpers.learning import learn_together
from helpers.plastic import equal, minibatch_of, plastic, weights_of
from helpers.scripted import ONE, TWO, of
from helpers.small_agents import CURRICULUM, SETTINGS, TINY, less, made, names_in, others_slow, small

from baselines.methods.si import SI
from baselines.plasticity.redo import ReDo
from baselines.plasticity.shrink_and_perturb import ShrinkAndPerturb
from baselines.update.seeds import SeedGroup
from ctgraph_rl import Block, Evaluation, Protocol, RunLog, learn_curriculum
from ctgraph_rl.learn.collect import agent_specs
from ctgraph_rl.runs import config
from ctgraph_rl.runs.job import make_agent
from ctgraph_rl.runs.read import read_run
from ctgraph_rl.runs.train import new_agent, with_method

PLASTICITIES = [name for name in names_in("plasticity") if name != "none"]
RECYCLING = ["continual_backprop", "fire", "redo", "shrink_and_perturb", "shrink_and_perturb_soft"]
BUSY = {
    "redo": ["plasticity.period=1", "plasticity.threshold=0.5"],
    "continual_backprop": ["plasticity.rate=0.2", "plasticity.maturity=1"],
    "c_chain": ["plasticity.window=2"],
    "l2_init": ["plasticity.coeff=1.0"],
    "shrink_and_perturb_soft": ["plasticity.shrink=0.9", "plasticity.perturb=0.1"],
}
TWO_BLOCKS = of(
    Block(ONE, 32), Block(TWO, 32), task_id="at_boundaries", evaluation=Evaluation(1, greedy=False, before=False)
)


def maker(compose, agent: str, plasticity: str, method: str = "finetune", *overrides: str) -> Any:
    """What builds a tiny agent with a plasticity and a method."""
    make = made(compose, "agent", agent, *TINY, *less(agent), *overrides)
    make_method = made(compose, "method", method, *SETTINGS.get(method, []))
    make_plasticity = made(compose, "plasticity", plasticity, *BUSY.get(plasticity, []))
    return with_method(make, make_method, TWO_BLOCKS, make_plasticity)


def together(make: Any, seeds: tuple[int, ...]) -> tuple[list, list[RunLog]]:
    """Agents that learned as one batch, and their logs."""
    agents = []
    generators = []
    for seed in seeds:
        agents.append(new_agent(TWO_BLOCKS, make, seed))
        generators.append(torch.Generator().set_state(torch.get_rng_state()))
    logs = [RunLog() for _ in seeds]
    learn_together(TWO_BLOCKS, SeedGroup(agents, generators), seeds, logs)
    return agents, logs


PAIRS = [
    *("c_chain ppo", "c_chain lstm_ppo", "c_chain dqn", "continual_backprop dqn", "fire lstm_ppo"),
    *("fresh_optimiser ppo", "l2_init dqn", "layer_norm a2c", "parseval ppo", "redo a2c", "redo lstm_ppo"),
    *("shrink_and_perturb dqn", "shrink_and_perturb_soft ppo"),
]
"""Each plasticity that takes several seeds, and each agent several times."""


@pytest.mark.parametrize("pair", others_slow(PAIRS, "redo a2c"))
def test_a_seed_learns_together_as_alone_whatever_the_others_are(compose, pair):
    name, agent = pair.split()
    make = maker(compose, agent, name)

    agents, logs = together(make, (0, 3))

    others, _ = together(make, (0, 8))
    assert equal(weights_of(agents[0]), weights_of(others[0]))
    if pair == "redo a2c" or agent == "dqn":
        return
    log = learn_curriculum(TWO_BLOCKS, new_agent(TWO_BLOCKS, make, 3), 3)
    for one, other in zip(logs[1].of_kind("training"), log.of_kind("training"), strict=True):
        for key in set(one) & {"loss_objective", "loss_l2_init", "loss_parseval", "recycled"}:
            assert one[key] == pytest.approx(other[key], rel=1e-3, abs=1e-4)


def test_upgd_refuses_seeds_together_by_name(compose):
    from baselines.update.seeds import why_not_together

    agent = new_agent(TWO_BLOCKS, maker(compose, "ppo", "upgd"), 0)

    assert "UPGD" in why_not_together(agent)


ALLOW_ALL = ("ewc", "si", "mas", "l2", "clear")
FIX = ("packnet", "mask_ri", "mask_lc", "cka_rl")


METHODS = (*ALLOW_ALL, "scratch", "finetune")


@pytest.mark.slow
@pytest.mark.parametrize("name", PLASTICITIES)
def test_each_method_takes_each_plasticity_or_refuses_it_by_name(compose, name):
    for method in (*METHODS, *FIX):
        make = maker(compose, "ppo", name, method)
        refused = method in FIX and (name in RECYCLING or (name == "layer_norm" and method.startswith("mask")))
        if refused:
            with pytest.raises(ValueError, match=r"fixes or makes weights|masks weight matrices"):
                new_agent(TWO_BLOCKS, make, 0)
        else:
            new_agent(TWO_BLOCKS, make, 0)


TWO_EACH = [*zip(PLASTICITIES, cycle(METHODS), strict=False), *zip(PLASTICITIES, cycle(METHODS[3:]), strict=False)]
NONE_DRAWN = [("c_chain", "mask_lc"), ("l2_init", "packnet"), ("parseval", "mask_ri"), ("upgd", "cka_rl")]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "method"), dict.fromkeys([*TWO_EACH, *NONE_DRAWN]))
def test_a_method_learns_with_a_plasticity(compose, name, method):
    make = maker(compose, "ppo", name, method)

    log = learn_curriculum(TWO_BLOCKS, new_agent(TWO_BLOCKS, make, 0))

    assert len(log.of_kind("training")) == 2


def test_methods_that_fix_weights_refuse_recycling(compose):
    methods = ["packnet", "mask_ri", "cka_rl", "packnet", "mask_lc"]
    for name, method in zip(RECYCLING, methods, strict=True):
        agent = plastic(compose, made(compose, "plasticity", name)())
        with pytest.raises(ValueError, match="would draw again: take plasticity=none, or one that draws none"):
            made(compose, "method", method)().attach(agent, TWO_BLOCKS)


def test_a_trunk_that_is_kept_refuses_recycling(compose):
    agent = plastic(compose, ReDo(0.1, 1, reset_moments=True))

    with pytest.raises(ValueError, match="Finetune fixes or makes weights, which ReDo would draw again"):
        made(compose, "method", "finetune", "method.trunk=kept")().attach(agent, CURRICULUM)


def test_si_counts_no_recycling_as_learning(compose):
    agent = plastic(compose, ReDo(0.0, 1000, reset_moments=True))
    method = SI(epsilon=0.1, coeff=1.0, heads="single")
    attached = method.attach(agent, CURRICULUM)
    attached.start_task(0)
    minibatch_of(attached.agent)
    path = method.path.clone()
    changed = method.weights.vector().detach() - method.start
    recycled = [torch.ones(layer.num_units, dtype=torch.bool) for layer in agent.plasticity.layers]

    assert agent.plasticity.recycle(recycled) == 16

    assert torch.equal(path, method.path) and path.any()
    torch.testing.assert_close(method.weights.vector().detach() - method.start, changed)


def test_the_method_acts_last_at_a_boundary(compose):
    agent = plastic(compose, ShrinkAndPerturb(0.0, 0.0, "boundary", reset_moments=False))
    method = made(compose, "method", "ewc", "method.heads=multi", *SETTINGS["ewc"])()
    attached = method.attach(agent, CURRICULUM)
    attached.start_task(0)
    heads = [parameter.detach().clone() for parameter in method.weights.in_head_parameters]

    attached.start_task(0)

    assert equal(heads, list(method.weights.in_head_parameters))
    assert not agent.trunk.module.linear.weight.any()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "agent"),
    [("l2_init", "ppo"), ("c_chain", "dqn"), ("layer_norm", "dqn"), ("redo", "ppo"), ("shrink_and_perturb", "ppo")],
)
def test_a_compiled_step_learns_as_one_that_is_not(compose, name, agent):
    numbers = []
    for compiled in ("true", "false"):
        make = maker(compose, agent, name, "finetune", f"agent.compile={compiled}")
        log = learn_curriculum(TWO_BLOCKS, new_agent(TWO_BLOCKS, make, 0))
        first = log.of_kind("training")[0]
        numbers.append({key: value for key, value in first.items() if key.startswith("loss")})

    assert numbers[0] == pytest.approx(numbers[1], rel=1e-3, abs=1e-5)


BAD = {
    "l2_init": {"coeff": [-1, float("nan")], "power": [3], "reduction": ["max"]},
    "shrink_and_perturb": {"shrink": [1.5], "perturb": [-0.1], "every": ["block"], "reset_moments": [2]},
    "redo": {"threshold": [-0.1], "period": [0, 2.5], "reset_moments": ["yes"]},
    "continual_backprop": {"rate": [2], "maturity": [-1], "decay": [1.0], "reset_moments": [2]},
    "parseval": {"coeff": [-1], "scale": [0]},
    "c_chain": {"coeff": [-1], "target": [-1], "window": [0], "lag": [0], "distance": ["mse"]},
    "fire": {"iterations": [0, 1.5], "heads": [2], "reset_moments": [2]},
    "upgd": {
        "form": ["rmsprop"],
        "weight_decay": [-1],
        "utility_decay": [1.0],
        "noise": [-1],
        "betas": [0.9],
        "eps": [0],
    },
}


@pytest.mark.parametrize("name", BAD)
def test_a_setting_out_of_range_is_refused_in_a_line_with_its_name_and_value(compose, name):
    make = made(compose, "plasticity", name)
    assert set(BAD[name]) == set(make.keywords)

    for key, values in BAD[name].items():
        for value in values:
            with pytest.raises(ValueError, match=rf"^{key} must .*, got {re.escape(repr(value))}$"):
                make(**{key: value})
    if name == "upgd":
        with pytest.raises(ValueError, match=r"^betas\[1\] must be in \[0, 1\), got 1$"):
            make(betas=[0.9, 1])


def test_agents_and_changes_that_do_not_fit_are_refused_by_name(compose):
    hidden = replace(TWO_BLOCKS, protocol=Protocol(boundaries="hidden"))
    fire = made(compose, "plasticity", "fire")
    redo = made(compose, "plasticity", "redo")
    upgd = made(compose, "plasticity", "upgd")
    with pytest.raises(ValueError, match=r"FIRE acts at announced task changes: set protocol\.boundaries=announced"):
        fire().attach(small(compose, "ppo"), hidden)
    with pytest.raises(ValueError, match="ReDo acts on hidden units, and MOHQA has none"):
        redo().attach(small(compose, "mohqa"), TWO_BLOCKS)
    with pytest.raises(ValueError, match="FIRE acts where a task starts, and PEARL draws its tasks"):
        fire().attach(made(compose, "agent", "pearl")(*agent_specs(TWO_BLOCKS)), TWO_BLOCKS)
    with pytest.raises(ValueError, match=r"UPGD is an optimiser .* set agent\.compile=false"):
        upgd().attach(small(compose, "ppo", (ONE,), "agent.compile=true"), TWO_BLOCKS)
    with pytest.raises(ValueError, match="plasticity_settings are those of a plasticity: give plasticity=NAME, too"):
        make_agent("ppo", TWO_BLOCKS, plasticity_settings={"period": 3})
    with pytest.raises(ValueError, match="unknown plasticity 'redoo': did you mean 'redo'"):
        make_agent("ppo", TWO_BLOCKS, plasticity="redoo")


@pytest.mark.parametrize("name", ["maml", "penn_a"])
def test_agents_with_other_gradient_steps_are_refused_by_name(compose, name):
    kind = made(compose, "agent", name).func
    upgd = made(compose, "plasticity", "upgd")

    with pytest.raises(
        ValueError, match=f"UPGD needs an agent with the gradient steps of Learner, not {kind.__name__}"
    ):
        upgd().attach(kind.__new__(kind), TWO_BLOCKS)


def test_none_is_in_no_name_and_others_are_in_the_runs_and_the_tables_names(compose, tmp_path):
    plain = config.plain(compose("agent=ppo"))
    assert config.plain(compose("agent=ppo", "plasticity=none")) == plain and "plasticity" not in plain
    names = set()
    for each in ("none", "redo", "fire"):
        cfg = compose("agent=ppo", f"plasticity={each}")
        log = {"kind": "run", "schema": 1, "curriculum": "two", "fingerprint": "f", "config": config.plain(cfg)}
        folder = tmp_path / each
        folder.mkdir()
        (folder / "run.jsonl").write_text(json.dumps(log) + "\n")
        names.add(read_run(folder).agent)

    assert names == {"PPO", "PPO + ReDo", "PPO + FIRE"}
