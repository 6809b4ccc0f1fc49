"""The JSON parameters of the paper's Table 3."""

from __future__ import annotations

import json

import pytest

from ctgraph_rl import Task
from ctgraph_rl.tasks.configurations import ct_co_b1, ct_fo_b1, ct_fo_b2, ct_posr_b1, ct_su_b1
from ctgraph_rl.tasks.images import OneHot, PaperImages

TABLE_3 = {
    "Seed": 1,
    "graph_shape": {"d": 2, "b": 2, "p": 0.5},
    "reward": {"high_r": 1, "fail_r": -1, "std_r": 0.1},
    "observations": {"MDP_D": False, "MDP_W": False, "W_IDs": [3, 3], "D_IDs": [2, 2]},
    "image set": {"seed": 2, "1D": False, "nr_images": 5, "noise on read": 10, "rotation on read": 5},
}
"""Every parameter of the table under its printed name."""


def shape(d: int, p: float, **observations: object) -> dict[str, object]:
    return {"graph_shape": {"d": d, "b": 2, "p": p}, "observations": observations}


@pytest.mark.parametrize(
    ("content", "task"),
    [
        (shape(2, 0, MDP_D=True, MDP_W=True), ct_fo_b1()),
        (shape(3, 0.5, MDP_D=True, MDP_W=True), ct_fo_b2()),
        (shape(2, 0, MDP_D=False, MDP_W=False, D_IDs=[2, 2], W_IDs=[3, 3]), ct_su_b1()),
        (shape(2, 0, MDP_D=False, MDP_W=False, D_IDs=[2, 2], W_IDs=[3, 102]), ct_co_b1()),
        (shape(2, 0.5, MDP_D=False, MDP_W=False, D_IDs=[2, 2], W_IDs=[3, 3]), ct_posr_b1()),
        ({"graph_shape": {"d": 2, "b": 2}}, ct_su_b1()),
    ],
)
def test_the_parameters_that_the_paper_prints_are_its_configurations(content, task):
    assert Task.from_json(content, task.goal) == task


def test_every_parameter_of_the_table_counts(tmp_path):
    (tmp_path / "task.json").write_text(json.dumps(TABLE_3), encoding="utf-8")

    task = Task.from_json(tmp_path / "task.json", (2, 1))

    x = task.observations
    assert (task.goal, task.graph.wait_prob, task.images) == ((2, 1), 0.5, PaperImages(5, 2))
    assert (task.goal_reward, task.fail_reward, task.reward_std, task.reward_noise) == (1.0, -1.0, 0.1, "additive")
    assert (x.decision_ids, x.wait_ids, x.end_ids) == ((2, 2), (3, 3), (4, 4))
    assert (x.read_noise, x.read_rotation, x.reward_cue, x.legacy_index) == (10, 5, False, False)
    assert not task.extra_end_step


def test_rotation_0_and_names_with_underscores_are_read():
    still = {**TABLE_3, "image_set": {"noise_on_read": 0, "rotation_on_read": 0}}
    del still["image set"]

    assert Task.from_json(still, (1, 1)).observations.read_rotation == 0


def test_one_dimensional_observations_are_one_hot():
    content = {
        "graph_shape": {"d": 2, "b": 2},
        "observations": {"MDP_D": True, "MDP_W": True},
        "image set": {"1D": True},
    }

    assert Task.from_json(content, (1, 1)).images == OneHot(16)


def test_decisions_may_be_unique_where_waits_are_not():
    x = Task.from_json(shape(5, 0, MDP_D=True), (1,) * 5).observations

    assert (x.wait_ids, x.decision_ids, x.end_ids) == ((2, 2), (3, 33), (34, 65))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"graph_shape": {"d": 2}}, r"configuration: graph_shape.b is missing"),
        ({"graph_shape": {"d": 2, "b": 2, "q": 0}}, r"Table 3 has no graph_shape.q; choices: d, b, p"),
        ({"rewards": {}}, r"unknown section 'rewards'; did you mean 'reward'\?"),
        ({"reward": 1}, r"section 'reward' must be an object, got 1"),
        ({"observations": {"graph_ends": [4, 4]}}, r"Table 3 has no observations.graph_ends"),
        ({"image set": {"1D": "no"}}, r"image_set.1D must be true or false, got 'no'"),
        ({"image set": {"rotation on read": 400}}, r"read_rotation must be whole degrees in 0..359, got 400"),
        ({"observations": {"W_IDs": [1, 3]}}, r"wait_ids=\(1, 3\) overlaps fail_ids=\(1, 1\)|overlaps wait_ids"),
        ({"graph_shape": {"d": 2, "b": 2, "p": 1}}, r"wait_prob must be in \[0, 1\), got 1"),
        ({"image set": {"nr_images": 3}}, r"num_images=3 is too few for id 4"),
    ],
)
def test_bad_parameters_are_refused_with_the_rule(change, message):
    with pytest.raises(ValueError, match=message):
        Task.from_json({**TABLE_3, **change}, (1, 1))


def test_the_goal_is_not_in_the_table():
    with pytest.raises(ValueError, match="goal is not in Table 3 and must be given"):
        Task.from_json(TABLE_3)
