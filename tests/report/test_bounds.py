"""What intervals over seeds may not leave: bounds of returns by the rewards, of metrics by what each says of itself."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import pytest
import torch
from helpers.made_runs import all_runs, line, write_run
from torch import Tensor

import curricula
from ctgraph_rl import Block, Curriculum, metrics
from ctgraph_rl.core.graph import CTGraph
from ctgraph_rl.core.rewards import Arrival, Gradient, ReferenceLinear
from ctgraph_rl.metrics.bounds import Known
from ctgraph_rl.metrics.record import METRICS
from ctgraph_rl.report import page
from ctgraph_rl.report.bounds_of_runs import bounds_of, bounds_of_curriculum
from ctgraph_rl.report.intervals import UNBOUNDED, Bounds
from ctgraph_rl.report.results import comparisons, table
from ctgraph_rl.report.sections import sections
from ctgraph_rl.tasks.configurations import ct_co_b1, ct_su_b1
from ctgraph_rl.tasks.kinds.gym_task import GymTask

pytest.importorskip("scipy")
NEEDLE = ct_su_b1()


@dataclass(frozen=True)
class Own:
    """A reward that does not say its bounds."""

    def __call__(self, arrival: Arrival) -> Tensor:
        return arrival.leaf.float()


@pytest.mark.parametrize(
    ("changes", "bounds"),
    [
        ({}, (0, 1)),
        ({"goal_reward": 2.0, "fail_reward": -0.5}, (-0.5, 2)),
        ({"reward_fn": Gradient(), "goal_reward": -3.0}, (-3, 0)),
        ({"reward_fn": ReferenceLinear()}, (0, 1)),
        ({"step_reward": -0.1}, (-math.inf, 1)),
        ({"step_reward": 0.1}, (0, math.inf)),
        ({"reward_std": 0.1}, (0, 1)),
        ({"reward_fn": Own()}, (-math.inf, math.inf)),
    ],
)
def test_the_rewards_of_a_task_bound_its_return(changes, bounds):
    assert replace(NEEDLE, **changes).return_bounds == bounds


@pytest.mark.parametrize("reward_fn", [Gradient(), ReferenceLinear()])
@pytest.mark.parametrize("branching_factor", [2, 3, 5])
def test_no_end_state_pays_more_or_less_than_the_reward_says(reward_fn, branching_factor):
    leaves, b, depth = torch.arange(branching_factor**2), torch.tensor(branching_factor), torch.tensor(2)
    for goal in leaves.tolist():
        count = len(leaves)
        paid = reward_fn(Arrival(leaves, torch.full((count,), goal), b.expand(count), depth.expand(count), max_depth=2))
        low, high = reward_fn.bounds(branching_factor)
        assert low <= paid.min() and paid.max() <= high


@pytest.mark.parametrize(("low", "high"), [pytest.param(0.0, 1.0, marks=pytest.mark.slow), (-1.0, 2.0)])
def test_no_metric_of_any_matrix_or_curve_is_outside_of_what_it_says(low, high):
    generator = torch.Generator().manual_seed(0)
    known = Known(low, high, tasks=3, evaluations=6, lowest_share=0.0, highest_share=1.0)
    extremes = 0
    for _ in range(60):
        values = torch.rand(7, 3, generator=generator, dtype=torch.float64)
        values = torch.where(torch.rand(7, 3, generator=generator) < 0.7, values.round(), values) * (high - low) + low
        curves = metrics.Curves(values, (0, 1, 1, 2, 2, 3, 3), tuple(range(7)), ((0,), (1,), (2,)))
        regimes = [
            metrics.Regime(f"{j}", training, 1 + 100 * (values[i : i + 1, j] - low) / (high - low))
            for i in range(7)
            for j, training in ((i // 2 - 1, True), *((j, False) for j in range(3)))
            if not training or i % 2
        ]
        found = metrics.of_matrix(curves.ends, curves.trained) | metrics.of_curves(curves)
        found |= metrics.of_regimes(regimes)
        for name, metric in found.items():
            lowest, highest = METRICS[name].bounds(known)
            assert metric.value is None or lowest - 1e-9 <= metric.value <= highest + 1e-9, name
            extremes += metric.value in (lowest, highest)
    assert extremes > 50


def of_known_curriculum(folder, values):
    """Runs with their curriculum in their directories, one for each value: the return on the first task at the end."""
    learned = curricula.load("su_b1_4tasks")
    for seed, value in enumerate(values):
        performance = [[float(task < block) for task in range(4)] for block in range(4)]
        performance.append([value, 1.0, 1.0, 1.0])
        about = (learned.name, learned.fingerprint)
        run = write_run(folder / f"{seed}", curriculum=about, seed=seed, labels=learned.labels, performance=performance)
        learned.to_json(run / "curriculum.json")
    return all_runs([folder])


def test_intervals_of_runs_stay_within_what_their_curriculum_allows(tmp_path):
    runs = of_known_curriculum(tmp_path, (0.0, 1.0, 1.0, 1.0, 1.0))

    rows = table(runs)
    (section,) = sections(runs)
    matrix, changes = section.results[0].performance(), section.results[0].transfer()

    assert str(line(rows, "average_performance").estimate) == "0.95 [0.45, 1.00] n = 5"
    assert line(rows, "average_performance").estimate.method == "mean, Gaffke 95%"
    assert str(line(rows, "forgetting").estimate) == "0.07 [-0.49, 0.56] n = 5"
    assert str(line(rows, "solved_rate").estimate) == "0.95 [0.45, 1.00] n = 5"
    assert str(matrix[-1][0]) == str(line(rows, f"solved {section.labels[0]}").estimate) == "0.80 [0.28, 0.99] n = 5"
    assert str(matrix[1][0]) == "1.00 [0.48, 1.00] n = 5"  # all seeds agree
    assert changes[-1][0].high == pytest.approx(1 - 0.05**0.2)  # P(weight of +1 - weight of -1 > t) = (1 - t)**5 / 2


@pytest.mark.parametrize(
    ("changes", "deterministic"),
    [
        ({}, True),
        ({"graph": CTGraph(2, 2, 0.5)}, False),
        ({"reward_std": 0.1}, False),
        ({"goal_change": (1, 2)}, False),
        ({"observations": replace(NEEDLE.observations, read_noise=3)}, False),
        ({"observations": ct_co_b1().observations, "images": ct_co_b1().images}, False),
    ],
)
def test_a_task_is_deterministic_where_actions_alone_decide(changes, deterministic):
    assert replace(NEEDLE, **changes).is_deterministic == deterministic


def test_a_report_says_that_episodes_of_a_greedy_policy_without_chance_are_one(tmp_path):
    (section,) = sections(of_known_curriculum(tmp_path, (0.0, 1.0)))

    facts = dict(page.facts(section))
    assert facts["a sample"].startswith("one seed: a greedy policy on deterministic tasks plays one episode")


def test_of_another_curriculum_than_the_run_learned_nothing_is_known(tmp_path):
    runs = of_known_curriculum(tmp_path, (0.0, 1.0))
    (tmp_path / "0" / "curriculum.json").unlink()
    curricula.load("fo_b1_4tasks").to_json(tmp_path / "0" / "curriculum.json")

    assert bounds_of(runs[:1]).of_returns == UNBOUNDED
    assert bounds_of(runs).of_returns == Bounds(0, 1)  # the second run's directory says it
    assert bounds_of(runs).of_metric("of_another_version") == UNBOUNDED


def test_a_first_run_that_is_unfinished_does_not_bound_sums_over_time_by_its_few_evaluations(tmp_path):
    runs = of_known_curriculum(tmp_path, (1.0, 1.0))
    curves = {label: [(0, 0.0), (204_800, 1.0)] for label in runs[0].history.labels}
    unfinished = replace(runs[0], history=runs[0].history._replace(evaluations=curves))

    bounds = bounds_of([unfinished, runs[1]])

    assert bounds.of_metric("total_performance_over_time") == Bounds(0, 16)  # four tasks, four evaluations


def test_what_a_search_can_miss_is_bounded_by_the_episodes_of_a_row():
    learned = curricula.load("goal_search")  # four end states
    bounds = bounds_of_curriculum(learned).of_metric("search_regret")
    episodes = learned.evaluation.row_episodes
    most = sum(min(1, i / 4) for i in range(1, episodes + 1))

    assert bounds == pytest.approx((most - episodes, most))
    assert bounds_of_curriculum(learned).of_metric("held_out_search_regret") == bounds


def test_a_time_is_a_median_that_seeds_that_never_got_there_count_in(tmp_path):
    runs = of_known_curriculum(tmp_path, (1.0, 1.0, 1.0))
    for run, (value, never) in zip(runs, ((2.0, 0), (None, 1), (4.0, 0)), strict=True):
        found = {"value": value, "n_undefined": never, "definition": "ctgraph_rl/first-reward", "undefined": "never"}
        run.metrics["frames_to_first_reward"] = found

    estimate = line(table(runs), "frames_to_first_reward").estimate

    assert (estimate.value, estimate.low, estimate.high, estimate.n) == (4.0, 0.0, math.inf, 3)


def test_p_values_of_comparisons_are_corrected_for_all_pairs(tmp_path):
    for agent, values in (("A", (1.0, 1.0, 1.0)), ("B", (0.5, 0.25, 0.0)), ("C", (0.5, 0.0, 0.25))):
        for seed, value in enumerate(values):
            performance = ((0.0, 0.0), (1.0, 0.0), (value, 1.0))
            write_run(tmp_path / f"{agent}{seed}", agent=agent, seed=seed, performance=performance)

    found = comparisons(all_runs([tmp_path]), "average_performance")

    assert {pair[1:]: (each.p_value, each.holm) for pair, each in found.items()} == {
        ("A", "B"): (0.25, 0.75),
        ("A", "C"): (0.25, 0.75),
        ("B", "C"): (1.0, 1.0),
    }


def test_noise_widens_what_a_seed_can_have_by_four_standard_deviations_of_its_mean():
    curriculum = curricula.load("fo_b1_noisy")  # reward_std 0.5, 100 episodes in an evaluation
    bounds = bounds_of_curriculum(curriculum)

    assert bounds.of_returns == bounds.of_task(curriculum.labels[0]) == pytest.approx((-0.2, 1.2))
    assert bounds.of_change(curriculum.labels[0]) == pytest.approx((-1.4, 1.4))
    assert bounds.of_training == (-2, 3)  # a mean of one episode
    assert bounds.of_metric("normalised_performance") == pytest.approx((-0.2, 1.2))
    assert bounds.of_metric("regret") == UNBOUNDED
    assert bounds.of_metric("maintenance_of_evaluation") == pytest.approx((-140, 140))
    assert bounds.of_metric("remembering")[1] == 1


def test_held_out_tasks_that_pay_more_widen_the_bounds_of_what_is_measured_on_them():
    curriculum = curricula.load("ct8")
    held_out = replace(curriculum.tasks[0], goal_reward=2.0)
    evaluation = replace(curriculum.evaluation, held_out=(held_out,))

    found = bounds_of_curriculum(replace(curriculum, evaluation=evaluation))
    assert found.of_metric("held_out_adapted_return") == (0, 2)
    assert found.of_task(curriculum.labels[0]) == (0, 1)


def test_adaptation_measures_fewer_episodes_so_that_its_noise_is_larger():
    curriculum = curricula.load("fo_b1_noisy")
    evaluation = replace(curriculum.evaluation, num_episodes=100, episodes_per_row=4, adapt_episodes=1)

    assert bounds_of_curriculum(replace(curriculum, evaluation=evaluation)).of_returns == pytest.approx((-0.4, 1.4))


@pytest.mark.parametrize(
    ("changes", "noise"),
    [
        ({}, 0.0),
        ({"reward_std": 0.5}, 0.5),
        ({"reward_std": 0.5, "reward_noise": "multiplicative", "goal_reward": -3.0}, 1.5),
        ({"reward_std": 0.5, "reward_noise": "multiplicative", "reward_fn": Own()}, math.inf),
    ],
)
def test_the_noise_of_a_return_is_that_of_the_one_end_state_that_pays(changes, noise):
    assert replace(NEEDLE, **changes).return_noise == noise


def test_an_episode_bounds_a_sample_and_the_optimum_does_not():
    slippery = GymTask("FrozenLake-v1", max_episode_steps=20)
    known = bounds_of_curriculum(Curriculum("lake", 1, "-", (Block((slippery,), 64),)))

    assert slippery.optimal_value(1.0) < 0.5
    assert known.of_returns == slippery.return_bounds == (0, 1)
    assert known.of_metric("normalised_performance") == pytest.approx((0, 1 / slippery.optimal_value(1.0)))
    assert known.of_metric("memory_gap_closed") == known.of_metric("regret") == UNBOUNDED
    assert bounds_of_curriculum(curricula.load("ct8")).of_metric("memory_gap_closed") == (-math.inf, 1)


def test_what_follows_from_the_curriculum_has_no_interval(tmp_path):
    runs = of_known_curriculum(tmp_path, (1.0, 1.0, 1.0))
    for run in runs:
        run.metrics["optimal_performance"] = {"value": 1.0, "definition": "ctgraph_rl/ceiling-optimal"}

    estimate = line(table(runs), "optimal_performance").estimate

    assert str(estimate) == "1.00 n = 3" and estimate.method == "exact"
    exact = [name for name, entry in METRICS.items() if entry.is_exact]
    entropies = [f"state_entropy_{policy}" for policy in ("random", "navigation", "optimal")]
    assert sorted(exact) == sorted(["open_loop_ceiling", "memoryless_ceiling", "optimal_performance", *entropies])
