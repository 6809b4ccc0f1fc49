"""Masks that combine a selection of the earlier tasks: what is selected, and what a selection changes."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from helpers.scripted import ONE, TWO
from helpers.small_agents import CURRICULUM, TASKS, Tiny, batches, same, seen, stay, weights_for, with_method
from tensordict import TensorDict
from torch.testing import assert_close

import curricula
from baselines.methods import mask_amsc
from baselines.methods.mask_amsc import MaskAMSC, sparsemax
from baselines.methods.mask_lc import MaskLC
from baselines.methods.mask_ri import MaskRI
from baselines.methods.mask_sc import MaskSC
from baselines.methods.method import AgentWithMethod
from baselines.parts.embedding import linear_wasserstein, reference_points, transitions
from ctgraph_rl import CTGraphEnv
from ctgraph_rl.learn.evaluate import evaluate
from ctgraph_rl.policies import OptimalPolicy, RandomPolicy

AXIS = torch.eye(4)


EMBEDDING = {"embedding": "lwe", "num_samples": 8, "buffer_size": 100, "num_references": 50}
EMBEDDING |= {"num_directions": 128, "num_quantiles": 128}
GATE = {"competence": "training", "competence_batches": 2, "shuffled": False}


def sc(**changes: Any) -> MaskSC:
    """MaskSC with a sample of 8 transitions."""
    return MaskSC(**{"selection": "similarity", "threshold": 0.5, "top_k": 3, "every": 10, **EMBEDDING, **changes})


def amsc(**changes: Any) -> MaskAMSC:
    """AMSC with a sample of 8 transitions."""
    given = {"distance": "cosine", "z_score": True, "temperature": 1.0, "every": 1, **GATE, **EMBEDDING}
    return MaskAMSC(**{**given, **changes})


def after(method: Any, *embeddings: torch.Tensor, number: int | None = None) -> Any:
    """The method in a task behind as many earlier ones as there are embeddings but one, with these embeddings."""
    AgentWithMethod(Tiny(), method, curricula.load("ct28"))
    ids = curricula.load("ct28").protocol.task_ids[: number or len(embeddings)]
    for each in ids[:-1]:
        method.start_task(each)
        method.end_task()
    method.start_task(ids[-1])
    method.embeddings = dict(enumerate(embeddings))
    if isinstance(method, MaskAMSC):
        method.competence = dict.fromkeys(range(len(ids)), 1.0)
    return method


# What a selection changes


@pytest.mark.parametrize(("selection", "twin"), [("all", MaskLC), pytest.param("none", MaskRI, marks=pytest.mark.slow)])
def test_all_selected_is_mask_lc_and_none_is_mask_ri_bit_by_bit(compose, selection, twin):
    attached = with_method(compose, "a2c", sc(selection=selection))
    other = with_method(compose, "a2c", twin())

    for each in (attached, other):
        torch.manual_seed(0)
        for number in (0, 1, 2, 0):
            stay(each, number)

    assert torch.equal(attached.method.scores, other.method.scores)
    for number in range(3):
        assert same(weights_for(attached, number), weights_for(other, number))


def test_a_step_combines_the_selected_tasks_and_the_new_scores_alone():
    torch.manual_seed(0)
    attached, minibatch = AgentWithMethod(Tiny(), sc(selection="none"), CURRICULUM), seen(6)
    its = attached.method
    for number in range(2):
        attached.start_task(number)
        attached.agent.gradient_step(minibatch)
        attached.end_task()
    attached.start_task(2)
    with torch.no_grad():
        its.betas[:, :3] = torch.tensor([3.0, 0.5, 1.0])
    kept = its.betas.detach().clone()

    its.select([1])
    found = torch.cat(list(its.current_scores())).detach()
    attached.agent.gradient_step(minibatch)

    own_share = math.exp(1.0) / (math.exp(0.5) + math.exp(1.0))
    before = torch.cat(list(its.own)).detach()
    assert_close(found[6:], before[6:])  # biases: their scores are 0
    assert torch.equal(its.betas[:, 0], kept[:, 0])  # of the one that is not selected
    assert (its.betas[0, [1, 2]] != kept[0, [1, 2]]).all()
    its.select([])
    assert_close(torch.cat(list(its.current_scores())), before)
    with torch.no_grad():
        its.betas.copy_(kept)
        its.select([1])
    expected = (1 - own_share) * its.scores[1] + own_share * before
    assert_close(torch.cat(list(its.current_scores())), expected)
    assert torch.equal(its.weights.vector(), torch.where(expected >= 0, its.constant, 0.0))


def test_the_last_selection_is_consolidated_and_the_next_task_starts_with_none(compose):
    attached = with_method(compose, "a2c", sc(selection="none"))
    its = attached.method
    stay(attached, 0)
    attached.start_task(1)
    its.select([0])
    for batch in batches(attached, TWO, 1):
        attached.learn(batch)
    its.select([0])
    combined = torch.cat(list(its.current_scores())).detach()

    attached.end_task()

    assert torch.equal(its.scores[1], combined)
    assert torch.equal(torch.cat(list(its.current_scores())), combined)
    attached.start_task(2)
    assert its.selected == []
    assert torch.equal(torch.cat(list(its.current_scores())), torch.cat(list(its.own)))


# Embeddings of tasks


def test_a_task_has_a_moving_average_of_the_embeddings_of_its_own_last_transitions(compose):
    attached = with_method(compose, "a2c", amsc())
    its, (first, second) = attached.method, batches(attached, ONE, 2)
    attached.start_task(0)
    stream, drawn = torch.get_rng_state(), []
    state = its.generator.get_state()

    for batch in (first, second):
        its.on_batch(batch)
        its.after_learning()
        drawn.append({key: value.clone() for key, value in its.recent.items()})

    its.generator.set_state(state)
    expected = None
    for kept, batch in zip(drawn, (first, second), strict=True):
        assert torch.equal(kept["action"], batch["action"].flatten()[-100:])
        places = torch.randperm(100, generator=its.generator)[:8]
        points = transitions(*(kept[key][places] for key in ("observation", "action")), kept["reward"][places, 0], 3)
        new = linear_wasserstein(points, reference_points(50, points.shape[1]))
        new = new / new.norm()
        expected = new if expected is None else (expected + new) / (expected + new).norm()
    assert_close(its.embeddings[0], expected)
    assert torch.equal(torch.get_rng_state(), stream)
    attached.start_task(1)
    its.on_batch(first[:, :1])
    assert len(its.recent["action"]) == 16


def test_a_task_with_fewer_transitions_than_a_sample_has_no_embedding_and_selects_nothing(compose):
    attached = with_method(compose, "a2c", amsc(num_samples=1000, buffer_size=1000))

    stay(attached, 0)
    stay(attached, 1)

    assert attached.method.embeddings == {} and attached.method.selected == []


@pytest.mark.slow
def test_tasks_of_ct28_with_the_same_images_have_the_nearest_embeddings():
    """Transitions of 64 random and 16 optimal episodes of each task."""
    reference, embeddings = reference_points(50, 148), []
    tasks = curricula.load("ct28").tasks[:16]
    for number, task in enumerate(tasks):
        parts = []
        for policy, rows in ((RandomPolicy, 64), (OptimalPolicy, 16)):
            env = CTGraphEnv([task] * rows, seed=number)
            steps = env.rollout(2 * task.graph.depth + 2, policy(env), break_when_any_done=False).flatten()
            parts.append((steps["observation"], steps["action"], steps["next", "reward"].squeeze(-1)))
        points = transitions(*map(torch.cat, zip(*parts, strict=True)), 3)
        places = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))[:128]
        embeddings.append(linear_wasserstein(points[places], reference))

    cosines = torch.nn.functional.normalize(torch.stack(embeddings), dim=1)
    cosines = cosines @ cosines.T
    family = torch.arange(16) % 4
    within = (family == family[:, None]) & ~torch.eye(16, dtype=torch.bool)
    assert cosines[within].min() > cosines[family != family[:, None]].max()


# What is selected


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([1.0, 0.0], [1.0, 0.0]),
        ([0.5, 0.0], [0.75, 0.25]),
        ([0.0, 0.0, 0.0], [1 / 3] * 3),
        ([2.0], [1.0]),
        ([], []),
        ([0.1, 1.0, 0.8], [0.0, 0.6, 0.4]),
    ],
)
def test_sparsemax_has_its_exact_values(values, expected):
    assert_close(sparsemax(torch.tensor(values)), torch.tensor(expected))


def mixed(*weights: float) -> torch.Tensor:
    """A direction with these cosines to the axes, and the rest on the last one."""
    rest = max(1 - sum(weight**2 for weight in weights), 0.0) ** 0.5
    return torch.tensor([*weights, *[0.0] * (3 - len(weights)), rest])


@pytest.mark.parametrize(
    ("settings", "number", "cosines", "expected"),
    [
        ({}, 2, [0.1, 0.09], [0]),  # of two always one, however alike
        ({"z_score": False}, 2, [0.1, 0.09], [0, 1]),
        ({"z_score": False, "temperature": 0.005}, 2, [0.1, 0.09], [0]),
        ({"distance": "l2"}, 2, [0.09, 0.1], [1]),
        ({"distance": "l2", "z_score": False}, 2, [1.0], [0]),  # distances 0 and 1.41
        ({}, 3, [0.5, 0.0, 0.5], [0, 2]),  # t = (0.71, -1.41, 0.71)
    ],
)
def test_amsc_selects_the_support_of_a_sparsemax_of_similarities(settings, number, cosines, expected):
    its = after(amsc(**settings), *AXIS[:number], mixed(*cosines))

    assert its.choose() == expected


def test_an_only_earlier_task_is_selected_however_dissimilar():
    assert after(amsc(), AXIS[0], AXIS[1]).choose() == [0]


def test_tasks_without_competence_are_left_out_behind_the_standardisation():
    its = after(amsc(), *AXIS[:3], mixed(0.9, 0.1, 0.2))
    its.competence[0] = 0.0
    free = after(amsc(competence="none"), *AXIS[:3], mixed(0.9, 0.1, 0.2))
    free.competence[0] = 0.0

    assert its.choose() == [1, 2]  # t = (1.40, -0.84, -0.56), and without the first both are near
    assert free.choose() == [0]
    its.competence = dict.fromkeys(range(4), 0.0)
    assert its.choose() == []


def test_competence_is_the_mean_return_of_the_last_batches():
    its = amsc()
    AgentWithMethod(Tiny(), its, CURRICULUM)
    its.compares = False
    its.start_task(0)

    for returns in ([1.0, 1.0], [0.0, 1.0, 0.5], [0.25]):
        number = len(returns)
        rows = {"episode_reward": torch.tensor([[*returns, 9.0]]), "done": torch.tensor([[True] * number + [False]])}
        its.on_batch(TensorDict({"next": {key: value.unsqueeze(-1) for key, value in rows.items()}}, [1, number + 1]))
    its.end_task()

    assert its.competence == {0: pytest.approx(1.75 / 4)}


def test_competence_can_be_the_return_of_an_evaluation_which_is_an_oracle_s(compose, monkeypatch):
    def optimal(policy: Any, tasks: Any, number: int, **given: Any) -> Any:
        assert policy is attached.agent.policy and tasks == [TWO] and number == its.curriculum.evaluation.num_episodes
        return evaluate(OptimalPolicy, tasks, number, **given)

    monkeypatch.setattr(mask_amsc, "evaluate", optimal)
    attached = with_method(compose, "a2c", amsc(competence="evaluation"))
    its = attached.method
    attached.start_task(1)
    stream = torch.get_rng_state()

    attached.end_task()

    assert its.competence == {0: 1.0}
    assert torch.equal(torch.get_rng_state(), stream)


def test_a_shuffled_selection_has_as_many_tasks_and_leaves_other_streams_alone():
    its = after(amsc(shuffled=True), *AXIS[:3], mixed(0.5, 0.0, 0.5))
    streams = torch.get_rng_state(), its.generator.get_state()

    found = [tuple(sorted(its.choose())) for _ in range(30)]

    assert set(found) == {(0, 1), (0, 2), (1, 2)}
    assert torch.equal(torch.get_rng_state(), streams[0]) and torch.equal(its.generator.get_state(), streams[1])


@pytest.mark.parametrize(
    ("settings", "expected"),
    [({}, [2, 0]), ({"top_k": 1}, [2]), ({"threshold": 0.1}, [2, 0, 1]), ({"threshold": 0.9}, [])],
)
def test_mask_sc_selects_the_nearest_above_its_threshold(settings, expected):
    present = torch.nn.functional.normalize(torch.tensor([0.6, 0.2, 0.7, 0.0]), dim=0)
    its = after(sc(**settings), *AXIS[:3], present)

    assert its.choose() == expected


@pytest.mark.parametrize(
    ("selection", "expected"),
    [("all", [*range(12)]), ("none", []), ("depth_prefix", [0, 4, 8]), ("parent", [8])],
)
def test_an_oracle_knows_the_family_of_a_task_of_ct28(selection, expected):
    its = sc(selection=selection)

    after(its, number=13)

    assert its.selected == its.choose() == expected


def test_a_random_selection_is_drawn_again_by_a_stream_of_its_own():
    its = sc(selection="random", top_k=2)
    after(its, number=6)
    stream = torch.get_rng_state()

    found = [frozenset(its.choose()) for _ in range(60)]

    assert len(set(found)) == 10 and {len(each) for each in found} == {2}
    assert torch.equal(torch.get_rng_state(), stream)


def test_selections_are_made_after_every_few_batches(compose):
    attached = with_method(compose, "a2c", sc(threshold=-1, every=2), TASKS)
    stay(attached, 0)
    attached.start_task(1)
    found = []

    for batch in batches(attached, TWO, 4):
        attached.learn(batch)
        found.append(list(attached.method.selected))

    assert found == [[], [0], [0], [0]]
