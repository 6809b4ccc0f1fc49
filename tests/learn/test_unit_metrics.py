"""Metrics of hidden units: known answers on activations by hand, each against the trap that gives another number."""

from __future__ import annotations

import math
from copy import deepcopy
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from helpers.learning import learn_together, train
from torch import Tensor

import curricula
from baselines.exchanges.isolated import Isolated
from baselines.lstm_ppo import LSTMPPO
from baselines.ppo import PPO
from baselines.update.seeds import SeedGroup
from ctgraph_rl import Block, Curriculum, Evaluation
from ctgraph_rl.learn.collect import agent_specs
from ctgraph_rl.learn.collective import Member, learn_collective
from ctgraph_rl.learn.lifelong import learn_curriculum
from ctgraph_rl.learn.unit_metrics import (
    NUM_FRESH,
    UnitMeter,
    fresh_images,
    norms,
    task_images,
    unit_metrics,
)
from ctgraph_rl.log.measurement import without_time
from ctgraph_rl.log.run_log import RunLog
from ctgraph_rl.runs import job
from ctgraph_rl.tasks.configurations import ct_co_b1, ct_fo_b1, ct_su_b1
from ctgraph_rl.tasks.images import OneHot


def layer(*rows: list[float], shares: list[float] | None = None) -> tuple[Tensor, Tensor]:
    """Activations by row, weighted equally unless shares are given."""
    values = torch.tensor(rows)
    return values, torch.full([len(rows)], 1 / len(rows)) if shares is None else torch.tensor(shares)


def of_all(layers: dict[str, tuple[Tensor, Tensor]]) -> dict[str, float]:
    """Metrics of rows that are all that there are."""
    return unit_metrics(layers, complete=True)


def test_a_unit_is_dormant_up_to_a_share_of_its_layers_mean_activation():
    """Scores 0, 0.02, 0.08 and 3.9; the mean of each unit over rows comes before the mean over units."""
    found = of_all({"a": layer([0, 0.01, 0.08, 0], [0, 0.03, 0.08, 7.8])})

    assert [found[f"dormant_{threshold}"] for threshold in ("0", "0.025", "0.1")] == [0.25, 0.5, 0.75]


def test_a_score_is_no_mean_over_rows_of_shares_of_a_row():
    """In the quiet row the first unit has half of all; by rows its score would be 0.505."""
    found = of_all({"a": layer([0.001, 0.001], [0.0, 100.0])})

    assert found["dormant_0.025"] == 0.5


def test_dead_units_are_zero_in_all_rows_and_no_share_of_zero_entries():
    """Five of eight entries are 0, and one of four units is dead."""
    found = of_all({"a": layer([0, 1, 0, 0], [0, 0, 1, 1])})

    assert found["dead"] == 0.25


def test_negative_activations_are_not_dead_and_do_not_cancel():
    found = of_all({"a": layer([-1, 1], [1, 1])})

    assert (found["dead"], found["dormant_0.1"]) == (0, 0)


def test_a_total_counts_units_and_is_no_mean_of_layers():
    """One of two units and none of six: an eighth, where the mean of layers is a quarter."""
    found = of_all({"a": layer([0, 1]), "b": layer([1] * 6)})

    assert (found["dead"], found["dead_a"], found["dead_b"]) == (0.125, 0.5, 0)
    assert found["dormant_0"] == 0.125


def test_rows_count_by_their_shares():
    """The unit is on in a row that stands for 1 % of frames; equal weights would give it the score 1."""
    rare = layer([1.0, 1.0], [0.0, 1.0], shares=[0.01, 0.99])

    assert of_all({"a": rare})["dormant_0.025"] == 0.5
    assert of_all({"a": layer([1.0, 1.0], [0.0, 1.0])})["dormant_0.1"] == 0


def test_ranks_of_orthogonal_rows_are_full_and_of_equal_rows_one():
    full = of_all({"a": layer(*torch.eye(4).tolist())})
    one = of_all({"a": layer(*[[1.0, 2.0, 3.0, 4.0]] * 4)})

    for name in ("rank_effective", "rank_srank", "rank_stable"):
        assert full[name] == pytest.approx(1, abs=1e-9)
        assert one[name] == pytest.approx(0.25, abs=1e-6)


def test_a_rank_is_a_share_of_the_images_where_they_are_fewer_than_units():
    found = of_all({"a": layer([1, 0, 0, 0, 0, 0, 0, 0], [0, 1, 0, 0, 0, 0, 0, 0])})

    assert found["rank_effective"] == pytest.approx(1)
    assert found["rank_srank"] == found["rank_stable"] == 1


def test_equal_rows_change_no_rank_where_they_share_a_weight():
    """A row of half of all, twice as two quarters; unweighted, the singular values would differ."""
    once = of_all({"a": layer([1.0, 0.0], [0.0, 1.0])})
    twice = of_all({"a": layer([1.0, 0.0], [0.0, 1.0], [0.0, 1.0], shares=[0.5, 0.25, 0.25])})

    for name in ("rank_effective", "rank_stable"):
        assert twice[name] == pytest.approx(once[name])


def test_three_ranks_of_the_same_singular_values_differ_as_defined():
    """Singular values 3, 1, 0.03, 0: srank sums them, not their squares; only the stable rank squares them."""
    sigma = [3.0, 1.0, 0.05, 0.0]
    found = of_all({"a": layer(*torch.diag(torch.tensor(sigma)).tolist())})

    shares = [value / 4.05 for value in sigma[:3]]
    assert found["rank_effective"] == pytest.approx(math.exp(-sum(p * math.log(p) for p in shares)) / 4, abs=1e-6)
    assert found["rank_srank"] == 3 / 4
    assert found["rank_stable"] == pytest.approx((9 + 1 + 0.0025) / 9 / 4, abs=1e-6)


def test_ranks_do_not_change_with_scale_and_those_of_a_dead_layer_are_0():
    values, share = layer([3, 1, 2], [1, 5, 1])
    small = of_all({"a": (1e-3 * values, share)})

    assert small["rank_effective"] == pytest.approx(of_all({"a": (values, share)})["rank_effective"])
    assert of_all({"a": (0 * values, share)})["rank_stable"] == 0


def test_a_rank_is_that_of_the_last_layer():
    found = of_all({"a": layer([1, 0], [0, 1]), "b": layer([1, 1], [1, 1])})

    assert found["rank_effective"] == pytest.approx(0.5)


def test_metrics_of_no_layer_are_refused():
    with pytest.raises(ValueError, match="metrics of units need a hidden layer, and the network has none"):
        unit_metrics({})


def test_a_rank_of_fewer_observations_than_units_is_refused_unless_they_are_all():
    with pytest.raises(ValueError, match="a rank needs at least as many observations as units, 3, got 2: show more"):
        unit_metrics({"a": layer([1, 0], [0, 1]), "b": layer([1, 0, 0], [0, 1, 0])})

    assert unit_metrics({"a": layer([1, 0, 0]), "b": layer([1, 0], [0, 1])})["rank_stable"] == 1
    assert of_all({"b": layer([1, 0, 0], [0, 1, 0])})["rank_stable"] == 1


def test_norms_are_of_all_weights_of_their_change_and_of_the_gradient_before_it_is_cut():
    policy = torch.nn.Linear(2, 1)
    with torch.no_grad():
        policy.weight.copy_(torch.tensor([[3.0, 4.0]]))
        policy.bias.fill_(12.0)
    before = torch.tensor([0.0, 4.0, 8.0])

    found = norms([*policy.parameters()], before, {"grad_norm": 7.0})

    assert found == {"norm_weights": 13.0, "norm_updates": 5.0, "norm_gradients": 7.0}


@pytest.mark.parametrize(
    ("task", "count"), [(ct_fo_b1(), 16), (ct_su_b1(), 5), (ct_co_b1(), 104)], ids=["fo", "su", "co"]
)
def test_images_of_a_task_are_those_of_its_states_each_once(task, count):
    images = task_images(task, (1, 12, 12))

    assert len(images) == len(images.unique(dim=0))
    assert len(images) == count


def test_fresh_images_are_no_images_of_the_task_and_missing_where_none_can_be_drawn():
    task = ct_fo_b1()

    fresh = fresh_images(task, 64)

    both = torch.cat([fresh, task_images(task, (1, 12, 12))])
    assert len(fresh) == NUM_FRESH
    assert len(both.unique(dim=0)) == len(both)
    assert fresh_images(SimpleNamespace(images=OneHot(8)), 64) is None


class Zeros:
    """A learner with as many units that are on at no image as units that are on at all images."""

    num_envs, num_steps = 4, 2

    def __init__(self, num_zero: int = 1) -> None:
        self.policy = torch.nn.Linear(1, 1)
        self.num_zero = num_zero

    def initial_state(self, number):
        return {}

    def activations(self, data):
        ones = torch.ones(len(data["observation"]), self.num_zero)
        return {"only": (torch.cat([0 * ones, ones], dim=1), ones[:, 0] / len(ones))}


def unknown() -> Zeros:
    """A learner whose layers are not known."""
    made = Zeros()
    made.tells_units = False
    return made


def test_a_meter_appends_a_line_for_task_images_and_one_for_fresh_ones():
    """Two goals of a block show the same 16 images."""
    goals = (ct_fo_b1("1.1", image_seed=2), ct_fo_b1("2.2", image_seed=2))
    curriculum = Curriculum("mine", 1, "", (Block(ct_fo_b1(), 8), Block(goals, 8)))
    log = RunLog()

    UnitMeter(curriculum, Zeros(), log, True).measure(2, 8, "start")

    first, second = log.measurements
    assert [(line["images"], line["num_images"], line["dead"]) for line in (first, second)] == [
        ("task", 16, 0.5),
        ("fresh", 256, 0.5),
    ]
    assert {key: first[key] for key in ("kind", "block", "frames", "moment")} == {
        "kind": "units",
        "block": 2,
        "frames": 8,
        "moment": "start",
    }


def test_a_block_is_measured_on_its_images_with_all_places_of_a_channel():
    """The channel is on at the second place of the last image of block 2."""
    tasks = (ct_fo_b1(image_seed=1), ct_fo_b1(image_seed=2))
    last = task_images(tasks[1], (1, 12, 12)).unique(dim=0)[-1]
    agent = Zeros()

    def activations(data):
        is_last = (data["observation"] == last).flatten(1).all(dim=1).float()
        places = torch.stack([0 * is_last, is_last], dim=1).view(-1, 1)
        return {"channel": (places, torch.full([len(places)], 1 / len(places)))}

    agent.activations = activations
    log = RunLog()
    meter = UnitMeter(Curriculum("mine", 1, "", tuple(Block(task, 8) for task in tasks)), agent, log, True)
    meter.measure(1, 0, "start")
    meter.measure(2, 8, "start")

    assert [line["dead"] for line in log.measurements] == [1, 1, 0, 1]


def test_a_last_layer_of_300_units_is_shown_300_fresh_images():
    """Fewer would bound its rank."""
    log = RunLog()

    UnitMeter(SHORT, Zeros(150), log, True).measure(1, 0, "start")

    assert [line["num_images"] for line in log.measurements] == [16, 300]


SHORT = replace(
    curricula.load("fo_b1_4tasks", num_frames=128),
    blocks=curricula.load("fo_b1_4tasks", num_frames=128).blocks[:2],
    evaluation=Evaluation(every=64, exact=True),
)
PPO_SETTINGS = {
    **{"num_envs": 16, "num_steps": 2, "hidden_size": 4, "num_layers": 2, "optimiser": "adam", "learning_rate": 0.01},
    **{"gamma": 0.9, "normalize_advantage": False, "max_grad_norm": 0.5, "clip_epsilon": 0.2, "entropy_coeff": 0.01},
    **{"critic_coeff": 0.5, "num_epochs": 2, "num_minibatches": 2},
}


def learner(kind: type = PPO) -> PPO:
    torch.manual_seed(0)
    return kind(*agent_specs(SHORT), **PPO_SETTINGS)


def test_units_are_measured_at_starts_evaluations_and_ends_of_blocks():
    log = learn_curriculum(SHORT, learner(), log_units=True)

    moments = [(line["block"], line["frames"], line["moment"]) for line in log.of_kind("units")[::2]]
    assert moments == [
        *((1, 0, "start"), (1, 64, "during"), (1, 128, "end")),
        *((2, 128, "start"), (2, 192, "during"), (2, 256, "end")),
    ]


def test_units_are_measured_once_between_two_gradient_steps():
    """Batches have 32 frames."""
    often = replace(SHORT, evaluation=replace(SHORT.evaluation, every=16))

    log = learn_curriculum(often, learner(), log_units=True)

    moments = [(line["frames"], line["moment"]) for line in log.of_kind("units")[::2]]
    assert moments == [
        *((0, "start"), (32, "during"), (64, "during"), (96, "during"), (128, "end")),
        *((128, "start"), (160, "during"), (192, "during"), (224, "during"), (256, "end")),
    ]


def test_each_batch_is_measured_where_asked_and_learning_keeps_its_bits():
    plain = learn_curriculum(SHORT, learner())
    each = learn_curriculum(SHORT, learner(), log_units="batch")

    batches = [line["frames"] for line in each.of_kind("units")[::2] if line["moment"] == "batch"]
    assert batches == [32, 64, 96, 128, 160, 192, 224, 256]
    assert plain.of_kind("units") == []
    for line, measured in zip(plain.of_kind("training"), each.of_kind("training"), strict=True):
        assert without_time(line).items() <= measured.items()
        assert measured["norm_gradients"] == line["grad_norm"]
        assert measured["norm_updates"] > 0


def units_of(log: RunLog) -> list:
    return [without_time(line) for line in log.of_kind("units")]


def test_runs_seeds_together_and_collectives_measure_units_as_one_agent_alone(tmp_path):
    units = units_of(learn_curriculum(SHORT, learner(), log_units=True))

    train(SHORT, learner(), tmp_path, 0, log_units=True)
    assert units_of(RunLog.read(tmp_path / "run.jsonl")) == units

    agent = learner()
    log = RunLog()
    group = SeedGroup([agent], [torch.Generator().set_state(torch.get_rng_state())])
    learn_together(SHORT, group, [0], [log], log_units=True)
    assert units_of(log)[:2] == units[:2] and len(log.of_kind("units")) == len(units)

    members = [Member(SHORT, learner(), log_units=True), Member(SHORT, learner(), 1)]
    learn_collective(members, Isolated(2, 1, 0.0, 0.0))
    assert [units_of(member.log) for member in members] == [units, []]


def test_a_run_that_cannot_measure_units_is_refused_before_it_is_begun(tmp_path, compose):
    with pytest.raises(ValueError, match="log_units needs CT-graphs, whose images are known, got GymTask"):
        job.run_job(compose("curriculum=frozen_lake_4maps", "log_units=true"), tmp_path)
    with pytest.raises(ValueError, match="log_units must be True, False or 'batch', got 0"):
        learn_curriculum(SHORT, learner(), log_units=0)

    assert not (tmp_path / "run.jsonl").exists()


def test_a_meter_shows_images_where_the_weights_are():
    agent = Zeros()
    agent.policy.to("meta")
    shown = []
    agent.activations = lambda data: shown.append(data) or Zeros().activations({"observation": range(272)})

    UnitMeter(SHORT, agent, RunLog(), True).measure(1, 0, "start")

    assert {value.device.type for data in shown for value in data.values()} == {"meta"}


def test_a_resumed_run_measures_units_as_if_it_had_never_stopped():
    states = []

    def offer(make_state, at_block_end):
        states.append((deepcopy(make_state()), [*map(without_time, log.measurements)]))

    log = RunLog()
    learn_curriculum(SHORT, learner(), log=log, log_units=True, checkpoint=offer)
    for state, before in (states[2], states[3]):
        resumed = RunLog()
        learn_curriculum(SHORT, learner(), log=resumed, log_units=True, saved=state)

        assert [*before, *map(without_time, resumed.measurements)] == [*map(without_time, log.measurements)]


def test_with_memory_the_cells_outputs_are_units_too():
    log = RunLog()
    UnitMeter(SHORT, learner(LSTMPPO), log, True).measure(1, 0, "start")

    names = [name for name in log.measurements[0] if name.startswith("dead_")]
    assert names == ["dead_encoder.1", "dead_encoder.2", "dead_memory"]


@pytest.mark.parametrize(
    ("curriculum", "agent", "when", "message"),
    [
        ("fo_b1_4tasks", SimpleNamespace(), True, "log_units needs an agent that tells its hidden units, which Simple"),
        ("fo_b1_4tasks", unknown(), True, "log_units needs an agent that tells its hidden units, which Zeros does not"),
        ("frozen_lake_4maps", Zeros(), True, "log_units needs CT-graphs, whose images are known, got GymTask"),
        ("fo_b1_4tasks", Zeros(), "block", "log_units must be True, False or 'batch', got 'block'"),
    ],
)
def test_what_cannot_be_measured_is_refused(curriculum, agent, when, message):
    with pytest.raises(ValueError, match=message):
        UnitMeter(curricula.load(curriculum), agent, RunLog(), when)
