"""The functional core: the same results alone, under vmap, compiled, and restored."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers.oracles import act, confounding, scripts, surjective
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv, check_env_specs
from torchrl.record import CSVLogger, PixelRenderTransform, VideoRecorder

from ctgraph_rl import CTGraph, CTGraphEnv, Gradient, OneHot, ReferenceLinear
from ctgraph_rl.core import dynamics
from ctgraph_rl.core.row_params import Uses
from ctgraph_rl.policies import OptimalPolicy

EVERYTHING = replace(
    confounding(p=0.5, read_noise=20, read_rotation=5, reward_cue=True),
    reward_fn=Gradient(),
    reward_std=0.3,
    step_reward=0.01,
    goal_change=(1, 3),
)
OTHER = replace(
    EVERYTHING, graph=CTGraph(3, 3, 0.2), goal=(1, 2, 3), reward_fn=ReferenceLinear(), reward_noise="multiplicative"
)


def make_env(seed: int = 0) -> CTGraphEnv:
    return CTGraphEnv([EVERYTHING] * 3 + [OTHER] * 3, seed=seed)


def flat(pair) -> list[torch.Tensor]:
    state, shown = pair
    return [*state, *shown]


@pytest.mark.parametrize("backend", ["eager", pytest.param("inductor", marks=pytest.mark.slow)])
def test_the_core_compiles_into_one_graph_with_the_same_bits(backend):
    env = make_env()
    env.reset()
    step = torch.compile(dynamics.step, fullgraph=True, backend=backend)
    state = env.rows.state

    for action in scripts(12, 6, 4):
        expected = dynamics.step(state, action, env.rows.params, env.rows.uses)
        found = step(state, action, env.rows.params, env.rows.uses)
        assert all(torch.equal(x, y) for x, y in zip(flat(found), flat(expected), strict=True))
        state, _ = dynamics.reset(expected[0], expected[1].done, env.rows.params, env.rows.uses)


def test_the_core_maps_over_a_further_dimension_with_vmap():
    env = make_env()
    env.reset()
    actions = scripts(5, 6, 4)

    state, shown = torch.vmap(lambda a: dynamics.step(env.rows.state, a, env.rows.params, env.rows.uses))(actions)

    alone = [flat(dynamics.step(env.rows.state, action, env.rows.params, env.rows.uses)) for action in actions]
    assert all(torch.equal(x, torch.stack(y)) for x, y in zip([*state, *shown], zip(*alone, strict=True), strict=True))


def test_a_step_of_the_core_changes_nothing_in_place():
    env = make_env()
    env.reset()
    before = [value.clone() for value in env.rows.state]

    dynamics.step(env.rows.state, torch.zeros(6, dtype=torch.int64), env.rows.params, env.rows.uses)

    assert all(torch.equal(x, y) for x, y in zip(env.rows.state, before, strict=True))


def test_what_has_no_use_changes_nothing_when_it_is_computed_all_the_same():
    env = CTGraphEnv([surjective()] * 4)
    env.reset()
    everything = Uses(reward_fns=env.rows.uses.reward_fns)

    for action in scripts(12, 4):
        lean = dynamics.step(env.rows.state, action, env.rows.params, env.rows.uses)
        full = dynamics.step(env.rows.state, action, env.rows.params, everything)
        assert all(torch.equal(x, y) for x, y in zip(flat(lean), flat(full), strict=True))
        act(env, action)
        env.reset(TensorDict({"_reset": lean[1].done.unsqueeze(-1)}, [4]))


def test_a_planner_can_go_back_to_a_state_and_sees_the_same_future():
    env = make_env()
    env.reset()
    act(env, [0] * 6)
    saved = env.get_state()
    first = [act(env, [0] * 6).clone() for _ in range(2)]

    data = env.reset(TensorDict({"state": saved}, [6]), set_state=True)
    again = [act(env, [0] * 6).clone() for _ in range(2)]

    assert data["step_count"].unique().tolist() == [1]
    assert not data["is_init"].any()
    assert all((x == y).all() for x, y in zip(first, again, strict=True))


def test_a_planner_can_branch_all_rows_off_one():
    env = CTGraphEnv([surjective()] * 3)
    env.reset()
    for _ in range(2):
        act(env, [0, 0, 0])

    env.reset(TensorDict({"state": env.get_state()[torch.tensor([1, 1, 1])]}, [3]), set_state=True)
    data = act(env, [0, 1, 2])

    assert data["outcome"].flatten().tolist() == [1, 0, 0]
    assert env.node.tolist() == [0, 1, 2]


def test_setting_the_state_of_some_rows_leaves_the_others():
    env = make_env()
    env.reset()
    saved = env.get_state()
    act(env, [0] * 6)
    mask = torch.tensor([True, False, False, True, False, False])
    before = env.get_state()

    env.reset(TensorDict({"state": saved.clone(), "_reset": mask.unsqueeze(-1)}, [6]), set_state=True)

    now = env.get_state()
    assert (now[mask] == saved[mask]).all()
    assert (now[~mask] == before[~mask]).all()


def test_a_state_is_a_copy():
    env = make_env()
    env.reset()
    saved = env.get_state()
    copy = saved.clone()

    act(env, [0] * 6)

    assert (saved == copy).all()


def test_a_checkpoint_is_a_few_integers_per_row_without_images():
    state = make_env().state_dict()

    assert set(state) == {
        f"rows.{name}" for name in (*dynamics.RowState._fields, "seed", "row", "task", "choice", "episodes")
    }
    assert all(value.numel() in (1, 6) for value in state.values())


def test_a_picture_is_192_pixels_high_when_no_size_is_given():
    env = make_env()
    env.reset()

    assert env.render().shape == (6, 192, 384, 3)


def test_a_reset_clears_all_of_the_episode_in_its_rows_and_leaves_the_others():
    env = CTGraphEnv([replace(surjective(), step_reward=0.5, goal_change=(2, 2))] * 2)
    env.reset()
    for action in (0, 0, 2):
        act(env, [action] * 2)

    env.reset(TensorDict({"_reset": torch.tensor([[True], [False]])}, [2]))

    assert {field: value.tolist() for field, value in env.get_state().items()} == {
        "state_type": [0, 1],
        "node": [0, 2],
        "tick": [5, 4],
        "step_count": [0, 3],
        "episode_reward": [0.0, 1.5],
        "goal_leaf": [0, 0],
        "episodes_left": [1, 2],
        "reward": [0.0, 0.5],
        "paid": [0.0, 0.0],
    }


@pytest.mark.parametrize(
    ("field", "value"), [("state_type", -1), ("state_type", 3), ("node", -1), ("node", 7), ("goal_leaf", 4)]
)
def test_a_state_that_its_tree_does_not_have_is_refused_and_changes_nothing(field, value):
    env = CTGraphEnv([surjective()] * 2)
    env.reset()
    before, given = env.get_state(), env.get_state()
    given[field][1] = value

    with pytest.raises(ValueError, match=r"rows \[1\] of the given state are finished or no states of their trees"):
        env.reset(TensorDict({"state": given}, [2]), set_state=True)

    assert (env.get_state() == before).all()


@pytest.mark.parametrize("given", [None, TensorDict(batch_size=[2]), TensorDict({"state": TensorDict()}, [2])])
def test_going_back_without_a_whole_state_is_refused(given):
    env = CTGraphEnv([surjective()] * 2)

    with pytest.raises(ValueError, match="set_state=True needs the rows' state under 'state'"):
        env.reset(given, set_state=True)


def test_torchrl_finds_the_specs_of_rows_that_use_everything_in_order():
    check_env_specs(make_env(), break_when_any_done="both")


def test_torchrls_recorder_makes_a_video_of_the_rows(tmp_path):
    env = make_env()
    video = VideoRecorder(CSVLogger("run", log_dir=str(tmp_path), video_format="pt"), "rows", in_keys=["pixels"])
    recorded = TransformedEnv(env, Compose(PixelRenderTransform(out_keys=["pixels"]), video))

    pixels = recorded.rollout(5, OptimalPolicy(env), break_when_any_done=False)["next", "pixels"]
    recorded.transform.dump()

    assert pixels.shape == (6, 5, 192, 384, 3)
    assert pixels.dtype == torch.uint8
    assert len(list(tmp_path.rglob("*.pt"))) == 1


def test_an_observation_that_no_machine_can_hold_is_refused_before_it_is_made():
    many = replace(surjective(), images=OneHot(10**7))

    with pytest.raises(ValueError, match=r"images and observations need 100,0.* bytes, this machine has"):
        CTGraphEnv([many])


def test_loading_leaves_an_earlier_checkpoint_as_it_was():
    env, other = make_env(seed=7), make_env(seed=99)
    env.reset(), other.reset()
    saved = env.state_dict()

    env.load_state_dict(other.state_dict())

    assert saved["rows.seed"].tolist() == [7]
    assert env.rows.seed.tolist() == [99]


def test_only_the_rows_that_are_set_need_a_running_state():
    env = CTGraphEnv([surjective()] * 2, check_actions=False)
    env.reset()
    act(env, [0, 0])
    act(env, [1, 0])
    saved = env.get_state()
    mask = torch.tensor([[False], [True]])

    env.reset(TensorDict({"state": saved.clone(), "_reset": mask}, [2]), set_state=True)

    with pytest.raises(ValueError, match=r"rows \[0\] of the given state"):
        env.reset(TensorDict({"state": saved.clone(), "_reset": ~mask}, [2]), set_state=True)


def test_a_given_state_keeps_the_types_of_the_rows_and_counts_from_zero():
    env = CTGraphEnv([surjective()] * 2)
    env.reset()
    given = env.get_state()
    given["state_type"], given["episode_reward"] = given["state_type"].long(), given["episode_reward"].double()

    env.reset(TensorDict({"state": given.clone()}, [2]), set_state=True)

    assert env.rows.state_type.dtype == torch.uint8
    assert env.rows.episode_reward.dtype == torch.float32
    given["tick"][1] = -1
    with pytest.raises(ValueError, match=r"rows \[1\] of the given state"):
        env.reset(TensorDict({"state": given}, [2]), set_state=True)


def test_what_an_environment_tells_of_its_rows_is_a_copy():
    env = CTGraphEnv([surjective()] * 2)
    env.reset()

    env.node[0], env.goal_leaf[0], env.state_type[0] = 5, 3, 4

    assert (env.node[0], env.goal_leaf[0], env.state_type[0]) == (0, 0, 0)
