"""What a policy does, counted; an episode step by step and as a film."""

import sys

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from ctgraph_rl.core.graph import StateType
from ctgraph_rl.env import CTGraphEnv
from ctgraph_rl.learn.evaluate import evaluate
from ctgraph_rl.play import gif
from ctgraph_rl.play.gif import save_gif
from ctgraph_rl.play.player import Player
from ctgraph_rl.play.visits import visits
from ctgraph_rl.policies import NavigationPolicy, OptimalPolicy, RandomPolicy
from ctgraph_rl.tasks.configurations import ct_fo_b1, ct_fo_b2, ct_su_b1, make_task
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.protocol import Block

HOME, WAIT, DECISION, END, FAIL = StateType


def test_the_optimal_policy_is_seen_on_the_way_to_the_goal_alone():
    counts, actions = visits(ct_fo_b1((2, 1)), OptimalPolicy, num_episodes=7)

    way = [(HOME, 0), (WAIT, 0), (DECISION, 0), (WAIT, 2), (DECISION, 2), (WAIT, 5), (END, 5)]
    assert counts == dict.fromkeys(way, 7)
    assert set(actions) == set(way[:-1])
    assert (actions[WAIT, 0], actions[DECISION, 0], actions[DECISION, 2]) == ([1, 0, 0], [0, 0, 1], [0, 1, 0])


def test_counts_agree_with_the_episodes_that_evaluate_plays():
    task = ct_fo_b2()

    counts, actions = visits(task, RandomPolicy, num_episodes=500, seed=3, greedy=False)
    episodes = evaluate(RandomPolicy, [task], 500, seed=3, greedy=False)

    fails = int((episodes["leaf"] < 0).sum())
    assert counts[FAIL, 0] == fails and 450 < fails <= 500
    assert sum(count for (kind, _), count in counts.items() if kind == END) == 500 - fails
    steps = sum(count for (kind, _), count in counts.items() if kind in (HOME, WAIT, DECISION))
    assert steps == int(episodes["step_count"].sum())
    assert all(sum(shares) == pytest.approx(1) for shares in actions.values())


def test_an_end_state_that_takes_one_more_action_is_counted_once():
    counts, _ = visits(make_task("CT-FO-B1", extra_end_step=True), OptimalPolicy, num_episodes=5)

    assert counts[END, 3] == counts[HOME, 0] == 5


def test_actions_of_a_curriculums_wider_tasks_are_counted():
    wide = make_task(branching_factor=4, depth=1, one_hot=True, fully_observable=False)
    narrow = make_task(branching_factor=2, depth=1, one_hot=True, fully_observable=False)
    curriculum = Curriculum("mixed", 1, "tests", (Block(wide, 1), Block(narrow, 1)))

    counts, actions = visits(narrow, _always_four, num_episodes=3, curriculum=curriculum)

    assert counts == {(HOME, 0): 3, (WAIT, 0): 3, (FAIL, 0): 3}
    assert actions == {(HOME, 0): [0, 0, 0, 0, 1], (WAIT, 0): [0, 0, 0, 0, 1]}


def _always_four(data):
    return data.set("action", torch.full(data.batch_size, 4))


def test_rows_play_no_more_than_their_episodes():
    counts, _ = visits(ct_fo_b2(), NavigationPolicy, num_episodes=60, episodes_per_row=3)

    assert counts[HOME, 0] == 60
    assert sum(count for (kind, _), count in counts.items() if kind == END) == 60


def test_a_policy_that_is_bound_to_another_environment_is_refused():
    with pytest.raises(ValueError, match="acts in the environment that it was built on"):
        visits(ct_fo_b1(), OptimalPolicy(CTGraphEnv([ct_fo_b1()])))


def test_counting_leaves_the_global_generator_as_it_was():
    before = torch.get_rng_state()

    visits(ct_fo_b1(), RandomPolicy, num_episodes=5, greedy=False)

    assert torch.equal(torch.get_rng_state(), before)


class _Counter:
    """Recurrent: waits and decides in turn, by the number of steps in its memory."""

    def policy(self, data):
        step = data["steps"]
        script = torch.tensor([0, 0, 1, 0, 2, 0, 0])
        data["action"] = script[step.clamp_max(6)].squeeze(-1)
        return data.set(("next", "steps"), step + 1)

    def initial_state(self, num_envs):
        return TensorDict({"steps": torch.zeros(num_envs, 1, dtype=torch.int64)}, [num_envs])


def test_a_recurrent_policy_keeps_its_memory_within_an_episode_and_loses_it_after():
    agent, task = _Counter(), ct_su_b1((1, 2))

    counts, _ = visits(task, agent.policy, agent.initial_state, num_episodes=6, episodes_per_row=2)
    player = Player(task, agent.policy, agent.initial_state)
    lengths = []
    for _ in range(2):
        player.start()
        lengths.append(1)
        while not player.step():
            lengths[-1] += 1

    assert counts[END, 4] == 6
    assert lengths == [6, 6]
    assert int(player.data["outcome"]) == 3


def test_a_player_takes_the_action_it_is_given():
    player = Player(ct_fo_b1((2, 2)))
    player.start()

    over = [player.step(action) for action in (0, 0, 2, 0, 2, 0)]

    assert over == [False] * 5 + [True]
    assert (float(player.data["episode_reward"]), int(player.data["leaf"])) == (1.0, 3)
    assert StateType(int(player.env.state_type)) == END


def test_a_film_shows_every_step_from_home_to_the_end(tmp_path):
    from PIL import Image, ImageSequence

    task, path = ct_fo_b1((2, 1)), tmp_path / "episode.gif"
    player = Player(task, OptimalPolicy)

    save_gif(player, path)

    with Image.open(path) as film:
        frames = [(frame.convert("RGB").copy(), frame.info["duration"]) for frame in ImageSequence.Iterator(film)]
    assert [duration for _, duration in frames] == [600] * 6 + [1800]
    assert frames[0][0].size == (384, 192)
    assert len({frame.tobytes() for frame, _ in frames}) == 7
    expected = player.env.render()[0].numpy()
    assert np.abs(np.asarray(frames[-1][0]).astype(int) - expected).mean() < 1  # a palette of 256 colours


def test_a_film_ends_after_most_pictures_and_changes_no_random_state(tmp_path, monkeypatch):
    from PIL import Image

    monkeypatch.setattr(gif, "MOST_PICTURES", 5)

    before = torch.get_rng_state()
    player = Player(make_task(branching_factor=2, depth=30, fully_observable=False), OptimalPolicy)

    save_gif(player, tmp_path / "long.gif")

    with Image.open(tmp_path / "long.gif") as film:
        assert film.n_frames == 5
    assert torch.equal(torch.get_rng_state(), before)


def test_a_film_without_pillow_names_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "PIL", None)

    with pytest.raises(ModuleNotFoundError, match=r"^GIFs need pillow: pip install 'ctgraph_rl\[plot\]'$"):
        save_gif(Player(ct_fo_b1(), OptimalPolicy), tmp_path / "a.gif")
