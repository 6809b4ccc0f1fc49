"""PENN-A: plasticity by hand, reproduction gene by gene, the law of mutations, and that depth 1 is solved."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from fractions import Fraction
from functools import partial

import pytest
import torch
from helpers.lab_files import environment
from helpers.scripted import DECISION_ID, ONE, decide, task
from helpers.small_agents import GREEDY, SAMPLED
from scipy.stats import kstest
from torch import nn
from torchrl.envs.utils import set_exploration_type

from baselines import penn_a
from baselines.penn_a import (
    OUTPUTS,
    WEIGHTS,
    PennA,
    Population,
    Reproduction,
    first_population,
    grown,
    live,
    mutation,
    winners,
)
from ctgraph_rl import Block, CTGraph, CTGraphEnv, Curriculum, Evaluation, Protocol, Task, evaluate, learn_curriculum
from ctgraph_rl.learn.collect import collect
from ctgraph_rl.runs.train import new_agent
from curricula.axes import all_goals

SETTINGS = {
    "num_envs": 16,
    "num_steps": 10,
    "num_batches": 2,
    "num_trials": 2,
    "life_episodes": 4,
    "num_latents": 5,
    "hidden_size": 5,
    "learning_rate": 0.001,
    "num_updates": 3,
    "batch_size": 4,
    "segment_size": 5,
    "crossover_prob": 0.1,
    "insert_prob": 0.04,
    "duplicate_prob": 0.02,
    "delete_prob": 0.06,
    "precision": 180,
}

STILL = {"learning_rate": 1e-7, "num_updates": 1}
"""The autoencoder hardly changes."""

NOTHING = Reproduction(
    segment_size=5, crossover_prob=0, insert_prob=0, duplicate_prob=0, delete_prob=0, precision=math.inf
)


def made(at=ONE, **changes):
    curriculum = Curriculum("one", 1, "here", (Block(at, 16 * 100),))
    return new_agent(curriculum, partial(PennA, **SETTINGS | changes), 0)


def some_population(count: int = 6, neurons: int = 4, inputs: int = 3) -> Population:
    """Individuals of 2 to ``neurons`` neurons, whose genes all differ."""
    torch.manual_seed(0)
    size = 2 + torch.arange(count) % (neurons - 1)
    genes = 1 + torch.rand(count, inputs + neurons, neurons)
    whole = Population(genes, torch.rand(count, 5), torch.rand(count, neurons) < 0.5, size)
    return whole._replace(genes=genes * whole.within(size))


def one_life(rule, modulates, genes):
    """A population of one individual."""
    given = torch.tensor(genes, dtype=torch.float32)[None]
    return Population(given, torch.tensor([rule]), torch.tensor([modulates]), torch.tensor([len(modulates)]))


# Plasticity


def test_a_step_is_that_of_the_equations(monkeypatch):
    monkeypatch.setattr(penn_a, "NOISE", 0.0)
    torch.manual_seed(0)
    modulates = [False, True, False]
    lives = one_life([0.5, -0.6, 0.7, 0.4, 0.3], modulates, (2 * torch.rand(5, 3) - 1).tolist())
    inputs = [0.3, 1.0]

    weights, outputs = live(lives, torch.tensor([inputs]), lives.weights(), torch.tensor([[0.2, -0.4, 0.1]]))

    a, b, c, d = (0.125, -0.216, 0.343, 0.064)
    w = lives.weights()[0].double().tolist()
    fixed = [[value == 0 or (j >= 2 and modulates[j - 2]) for value in row] for j, row in enumerate(w)]
    y = [0.2, -0.4, 0.1]
    for _ in range(5):
        x = inputs + y
        sums = [[sum(x[j] * w[j][i] for j in range(5) if (j == 3) == kind) for i in range(3)] for kind in (False, True)]
        y = [math.tanh(total / 2) for total in sums[0]]
        gains = [math.tanh(total / 2) * 100 * 0.027 for total in sums[1]]
        z = inputs + y
        for j, i in itertools.product(range(5), range(3)):
            if not fixed[j][i]:
                w[j][i] += gains[i] * (a * z[j] * y[i] + b * z[j] + c * y[i] + d)
                w[j][i] = min(max(w[j][i], -10), 10)
    assert 0 < sum(map(sum, fixed)) < 15
    torch.testing.assert_close(weights[0], torch.tensor(w), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(outputs[0], torch.tensor(y), rtol=1e-4, atol=1e-5)


def lived(lives: Population, steps: int = 3):
    """The weights at birth and after some steps."""
    weights, outputs = born, _ = lives.weights(), torch.zeros_like(lives.genes[:, 0])
    for step in range(steps):
        weights, outputs = live(lives, torch.tensor([[float(step % 2), 1.0]]), weights, outputs)
    return born, weights


GENES = [[0.9, 0.8, 0.7], [0.5, 0.9, -0.6], [0.8, 0.1, 0.9], [0.9, 0.1, 0.0], [0.3, 0.8, 0.9]]


def test_without_a_learning_rate_no_weight_changes():
    born, after = lived(one_life([0.9, 0.9, 0.9, 0.9, 0.0], [False, True, False], GENES))

    assert torch.equal(born, after)


def test_only_weights_to_modulated_neurons_change_and_none_from_a_modulatory_one():
    born, after = lived(one_life([0.9, 0.9, 0.9, 0.9, 0.2], [False, True, False], GENES))

    changed = (born != after)[0]
    assert changed[[0, 1, 2, 4], 0].all()
    assert not changed[3].any()
    assert not changed[:, 1:].any()  # what comes to these from the modulatory neuron is 0


def test_small_genes_give_neither_weights_nor_rules():
    lives = one_life([0.2, 0.5, -0.2, -0.5, 0.1], [False], [[0.21], [0.22]])

    torch.testing.assert_close(lives.weights().flatten(), torch.tensor([0, 10 * 0.22**3]))
    torch.testing.assert_close(lives.rates(), torch.tensor([[0, 0.125, 0, -0.125, 0.1]]))


# Reproduction


def test_mutations_have_the_law_of_the_source():
    torch.manual_seed(0)

    changes = mutation(torch.zeros(20_000, dtype=torch.float64), 180)

    drawn = -changes.abs().log() / 180  # uniform, as P(|change| > x) = -ln(x) / 180
    assert kstest(drawn.numpy(), "uniform").pvalue > 0.001
    assert abs((changes > 0).double().mean() - 0.5) < 4 * 0.5 / math.sqrt(20_000)


def test_most_individuals_of_the_first_generation_can_learn():
    """By a uniform rule; P(|g| > x) = -ln(x) / 10 of genes of weights."""
    torch.manual_seed(0)

    first = first_population(2001, 3)

    cube = 0.01 ** (1 / 3)
    assert abs((first.rule.abs() > cube).double().mean() - 0.77) < 0.02
    assert abs((first.genes[1:].abs() > cube).double().mean() + math.log(cube) / 10) < 0.01


def test_the_best_of_a_segment_has_all_its_children():
    fitness = torch.tensor([9.0, 0, 1, 5, 2, 3, 8, 7, 6, 4, 0, 2])

    assert winners(fitness, 5, 0).tolist() == [0] * 5 + [6] * 5 + [11] * 2
    assert winners(fitness, 5, 2).tolist() == [0, 1] + [6] * 5 + [7] * 5
    assert winners(fitness[:4], 5, 3).tolist() == [0, 1, 2, 3]


def test_the_best_individual_stays_and_is_the_first():
    parents = some_population(count=12)
    always = Reproduction(segment_size=5, crossover_prob=1, insert_prob=1, duplicate_prob=0, delete_prob=0, precision=1)

    children = always.children(parents, torch.tensor([0.0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 20, 10]))  # in no first segment

    width = int(parents.size[10])
    kept = [(children.genes[0, : 3 + width, :width], parents.genes[10, : 3 + width, :width])]
    kept += [(children.rule[0], parents.rule[10]), (children.size[0], parents.size[10])]
    assert all(torch.equal(*pair) for pair in kept)
    assert children.genes[0].count_nonzero() == (3 + width) * width


@pytest.mark.parametrize(("change", "sizes"), [("insert", 1), ("duplicate", 1), ("delete", -1)])
def test_a_neuron_is_inserted_duplicated_or_deleted_and_the_others_keep_their_genes(change, sizes):
    parents = some_population()
    how = replace(NOTHING, **{f"{change}_prob": 1})

    torch.manual_seed(1)
    children = how.resized(parents)

    assert torch.equal(children.size[1:], parents.size[1:] + sizes)
    for old, new, size in zip(parents.genes[1:], children.genes[1:], children.size[1:].tolist(), strict=True):
        diagonal = [new[3 + k, k].item() for k in range(size)]  # a neuron's gene to itself: all differ
        others = [old[3 + k, k].item() for k in range(size - sizes)]
        kept = [gene for gene in others if gene in diagonal]
        assert diagonal == (kept if change == "delete" else [*others, 0])
        assert len(kept) == min(size, size - sizes)
        assert diagonal[0] == others[0]
        known = size - (change == "insert")  # the genes of a new neuron are 0
        assert new[: 3 + known, :known].count_nonzero() == (3 + known) * known - (change == "duplicate")
        assert new.count_nonzero() == (3 + known) * known - (change == "duplicate")


def test_insertion_duplication_and_deletion_are_independent_draws_and_come_in_this_order():
    """A population of one neuron: only what came before can be copied or lost, but not the first one."""
    torch.manual_seed(0)
    count = 20_001
    genes = torch.full((count, 4, 1), 0.5)
    parents = Population(genes, torch.zeros(count, 5), torch.zeros(count, 1).bool(), torch.ones(count).long())
    i, d, x = 0.3, 0.4, 0.6

    children = replace(NOTHING, insert_prob=i, duplicate_prob=d, delete_prob=x).resized(parents)

    def share(chosen) -> float:
        return chosen[1:].double().mean().item()

    copies_first = (children.genes[:, 0, 1:] != 0).any(dim=1)  # 0 in a new neuron and in copies of one
    expected = {
        1: (1 - i) * (1 - d) + x * (i * (1 - d) + (1 - i) * d),
        2: (1 - x) * (i * (1 - d) + (1 - i) * d) + x * i * d,
        3: (1 - x) * i * d,
    }
    for size, chance in expected.items():
        assert abs(share(children.size == size) - chance) < 4 * math.sqrt(chance * (1 - chance) / count), size
    chance = (1 - i) * d * (1 - x) + i * d / 2 * (1 - x / 2)
    assert abs(share(copies_first) - chance) < 4 * math.sqrt(chance * (1 - chance) / count)
    assert children.size[0] == 1


def test_rows_and_columns_of_a_copied_neuron_are_those_of_its_model():
    parents = some_population(count=1, neurons=2)

    copy = grown(parents, torch.tensor([True]), torch.tensor([1]))

    assert copy.genes[0, 4, 2] == copy.genes[0, 5, 1] == parents.genes[0, 4, 1]
    assert copy.genes[0, 5, 2] == 0  # of the copy to itself
    assert torch.equal(copy.genes[0, :5, 1], copy.genes[0, :5, 2])
    assert torch.equal(copy.genes[0, 4, :2], copy.genes[0, 5, :2])
    assert torch.equal(copy.genes[0, :5, :2], parents.genes[0])
    assert copy.modulates[0].tolist() == parents.modulates[0, [0, 1, 1]].tolist()


def test_a_crossed_child_has_a_mates_last_rows_as_far_as_both_have_neurons():
    parents = some_population(count=4)
    mates = some_population(count=4)
    mates = mates._replace(genes=-mates.genes, size=mates.size).take(torch.tensor([3, 2, 1, 0]))

    torch.manual_seed(0)
    children = replace(NOTHING, crossover_prob=1).crossed(parents, mates)

    assert torch.equal(children.genes[0], parents.genes[0])
    for child, own, other in zip(children.genes[1:], parents.size[1:], mates.size[1:], strict=True):
        shared = int(min(own, other))
        from_mate = (child < 0)[: 3 + shared, :shared]
        first = int(from_mate[:, 0].int().argmax())
        assert from_mate.any()
        assert torch.equal(from_mate, (torch.arange(3 + shared) >= first).unsqueeze(-1).expand(-1, shared))
        assert (child < 0).sum() == from_mate.sum()


# Lives


def hand_made(agent):
    """Let all individuals wait but at decision states, where they take decision 2."""
    encoder = agent.autoencoder.encoder
    with torch.no_grad():
        for layer in encoder:
            if isinstance(layer, nn.Linear):
                layer.weight.copy_(torch.eye(5))
                layer.bias.zero_()
    genes = torch.zeros_like(agent.population.genes)
    genes[:, DECISION_ID, 0] = 1
    agent.population = agent.population._replace(genes=genes)
    return agent


def test_a_genome_that_waits_at_waits_and_turns_at_decisions_scores_what_such_a_policy_scores():
    tasks = [task(goal) for goal in itertools.product((1, 2), repeat=2)]
    agent = hand_made(made(tasks[0]))

    found = evaluate(agent.policy, tasks, 4, initial_state=agent.initial_state)

    expected = evaluate(decide(2), tasks, 4)
    assert expected["episode_reward"].mean() == 0.25
    for key in ("episode_reward", "outcome", "step_count"):
        assert torch.equal(found[key], expected[key]), key


def test_a_greedy_policy_is_the_best_individual_and_a_sampling_one_the_population():
    agent = hand_made(made())
    agent.population.genes[0] = 0  # waits everywhere
    data = CTGraphEnv([ONE] * 16).reset().update(agent.initial_state(16))
    data["observation"][:] = torch.eye(5, dtype=torch.uint8)[DECISION_ID]

    actions = {}
    for kind in (GREEDY, SAMPLED):
        with set_exploration_type(kind):
            actions[kind] = agent.policy(data.clone())["action"].tolist()

    assert actions[GREEDY] == [0] * 16
    assert actions[SAMPLED] == [0] * 2 + [2] * 14


def test_fitness_is_the_mean_over_trials_of_the_rewards_of_a_lifes_first_episodes():
    agent = hand_made(made(replace(ONE, goal=(2,), fail_reward=-0.5)))
    agent.population.genes[1] = 0
    env = CTGraphEnv([replace(ONE, goal=(2,), fail_reward=-0.5)] * 16)
    first, last = collect(env, agent.policy, 16 * 20, 10, agent.initial_state)

    assert agent.learn(first) == {}
    before = agent.rewards.clone()
    measured = agent.learn(last)

    assert before.tolist() == [2.0] * 2 + [-1.5] * 2 + [2.0] * 12  # at 4 and 3 steps an episode
    assert measured["fitness_best"] == 4.0
    assert measured["fitness_mean"] == (7 * 4 - 2) / 8
    assert (agent.generation, agent.lived, agent.rewards.abs().max()) == (1, 0, 0)


def test_a_life_begins_with_the_first_episode_after_its_generation():
    agent = made(num_batches=1, num_steps=3)
    seen = []
    for batch in collect(CTGraphEnv([ONE] * 16), agent.policy, 16 * 30, 3, agent.initial_state):
        seen.append(batch["next"].select("life", "trial").clone())
        waits = batch["next", "trial"][:, -1].squeeze(-1) == 0
        born = agent.population.weights().repeat_interleave(2, dim=0)
        if waits.any():
            assert batch["next", "trial"][waits].max() == 0
        assert batch["next", WEIGHTS].shape[-2:] == born.shape[-2:]
        assert batch["next", OUTPUTS].shape[-1:] == born.shape[-1:]
        agent.learn(batch)

    assert [int(part["life"].unique()) for part in seen] == list(range(10))
    assert all((part["trial"][:, 1:] >= part["trial"][:, :-1]).all() for part in seen)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_at_depth_1_a_population_learns_to_search_and_to_search_again(seed):
    """With the first latents: while it learns at the published rate, the autoencoder shows all but one image alike.

    These seeds take 20 generations, seed 0 takes 30.
    """
    shown = environment(1, (2, 2), (3, 3), (4, 4), fail_reward=-0.4, unique=(False, False))
    goals = all_goals(Task.from_json(shown, (1,)))
    halves = Block(goals, 50_000), Block(goals[::-1], 50_000)  # 10 episodes of 5 steps in 1,000 rows
    before = Evaluation(1, at_block_ends=False)
    curriculum = Curriculum("swap", 1, "here", halves * 20, before, Protocol(boundaries="hidden"))
    settings = {"num_envs": 1000, "num_steps": 50, "num_trials": 4, "life_episodes": 20, "num_latents": 16}
    agent = new_agent(curriculum, partial(PennA, **{**SETTINGS, **settings, "hidden_size": 64, **STILL}), seed)
    torch.manual_seed(seed)

    learn_curriculum(curriculum, agent, seed)

    swapped = [replace(goal, goal_change=(10, 10)) for goal in goals]
    found = evaluate(agent.policy, swapped, 800, seed=1, initial_state=agent.initial_state, episodes_per_row=20)
    returns = found["episode_reward"].view(80, 2, 10).mean(dim=(0, 1))
    assert returns[1] > 0.85  # of the second episodes; the best search has 1
    assert returns[2:].min() >= 0.95


def test_best_search_and_memory_score_96_5_at_depth_2_and_92_5_at_depth_3():
    for depth, ceiling in ((2, Fraction(193, 2)), (3, Fraction(185, 2))):
        ends = CTGraph(2, depth).num_end_states
        to_first = [Fraction(place) for place in range(ends)]  # failures before the first goal is found
        to_second = [1 + Fraction(place) for place in range(ends - 1)]  # one at the goal that was, then at the others

        assert 100 - sum(to_first) / ends - sum(to_second) / (ends - 1) == ceiling


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_trials": 3}, "num_envs must be a multiple of num_trials=3, the rows of an individual, got 16"),
        ({"num_envs": 8}, "num_envs must be at least segment_size=5 individuals, 10 rows, got 8"),
        ({"insert_prob": 1.5}, "insert_prob must be "),
        ({"at": replace(ONE, graph=CTGraph(3, 1))}, "one neuron for the actions 0, 1 and 2, and the task has 4"),
    ],
)
def test_what_does_not_fit_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        made(**changes)
