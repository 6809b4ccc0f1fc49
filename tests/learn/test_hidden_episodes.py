"""Hidden episodes: no data of a learner say where an episode ends, and the log counts them all the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.scripted import ONE, THREE, TWO, Told, counting, decide, of
from helpers.small_agents import KINDS, SETTINGS, made, small
from tensordict import TensorDict
from torchrl.envs import check_env_specs

from baselines.methods.finetune import Finetune
from baselines.methods.scratch import Scratch
from ctgraph_rl import Block, CTGraphEnv, Evaluation, Protocol, Recorder, learn_curriculum, make_agent
from ctgraph_rl.learn.collect import ENDS, collect, make_env, without_ends
from ctgraph_rl.learn.refusals import check_episodes
from ctgraph_rl.tasks.kinds.gym_task import GymTask
from ctgraph_rl.tasks.switch import ByEpisode

ENDLESS = {"episodes": "hidden"}
GRAPHS = of(Block((ONE, THREE), 160), **ENDLESS)
LAKES = of(Block(GymTask("FrozenLake-v1", max_episode_steps=5), 160), **ENDLESS)
HOME, DECISION, WAIT, END = 0, 2, 3, 4
"""Ids that observations of `ONE` show."""


class Remembers(Told):
    """A scripted agent whose memory counts steps."""

    def __init__(self) -> None:
        super().__init__(counting, num_envs=4, num_steps=5)

    def initial_state(self, num_envs: int) -> TensorDict:
        return TensorDict({"memory": torch.zeros(num_envs, 1, dtype=torch.int64)}, batch_size=[num_envs])


def played(curriculum, num_rows: int = 4):
    """A batch of 40 steps of random actions, and what is hidden of it."""
    env = make_env(curriculum, curriculum.blocks[0].rows(num_rows), 0)
    torch.manual_seed(0)
    [batch] = collect(env, lambda data: data.set("action", env.action_spec.rand()), num_rows * 40, 40)
    return without_ends(batch), batch["next", ENDS]


@pytest.mark.parametrize("curriculum", [GRAPHS, LAKES], ids=["graphs", "gymnasium"])
def test_no_key_of_the_data_changes_at_an_episodes_end_but_observation_and_reward(curriculum):
    batch, hidden = played(curriculum)

    ended = hidden["done"][:, :-1]
    assert ended.sum() > 20
    assert not hidden["step_count"][:, 1:][ended].any() and not batch["next", "reward"][:, 1:][ended].any()
    known = {"observation", "is_init", "action", "reward", "done", "terminated", "truncated"}
    names = {key if isinstance(key, str) else key[-1] for key in batch.keys(True, True)}
    assert names <= known
    flags = [batch[key] for key in ("done", "terminated")] + [batch["next", key] for key in ("done", "terminated")]
    assert not torch.cat([*flags, batch["next", "is_init"]]).any()
    assert batch["is_init"][:, 0].all() and not batch["is_init"][:, 1:].any()
    assert batch["next", "observation"][:, :-1].equal(batch["observation"][:, 1:])


def test_the_last_state_of_an_episode_takes_one_more_action_without_effect():
    env = make_env(GRAPHS, [ONE], 0)

    [batch] = collect(env, decide(1), 10, 10)

    shown = batch["observation"].argmax(-1)[0].tolist()
    assert shown == [HOME, WAIT, DECISION, WAIT, END] * 2
    assert batch["next", "reward"].flatten().tolist() == [0, 0, 0, 1, 0] * 2
    hidden = batch["next", ENDS]
    assert hidden["done"].flatten().tolist() == [False, False, False, True, False] * 2
    assert hidden["step_count"].flatten().tolist() == [1, 2, 3, 4, 0] * 2
    assert hidden["episode_reward"].flatten().tolist() == [0, 0, 0, 1, 0] * 2


def test_the_log_counts_the_episodes_and_memory_is_kept_over_their_ends_and_announced_boundaries():
    agent = Remembers()

    log = learn_curriculum(of(Block(ONE, 40), Block(TWO, 60), evaluation=Evaluation(4), **ENDLESS), agent)

    training = [(m["episodes"], m["return_mean"], m["length_mean"]) for m in log.of_kind("training")]
    assert training == [(4, 1.0, 4.0)] * 2 + [(4, 0.0, 4.0)] * 3
    assert log.performance()[1].tolist() == [1.0, 0.0]
    seen = torch.cat(agent.batches, dim=1)
    assert ENDS not in seen["next"].keys()  # noqa: SIM118, a TensorDict is no dict
    assert seen["memory"][..., 0].tolist() == [list(range(25))] * 4
    assert seen["is_init"][..., 0].sum(1).tolist() == [1] * 4
    assert [event for event in agent.events if event[0] != "learn"] == [("start", None), "end", ("start", None), "end"]


def test_rows_change_tasks_with_the_next_episode_where_boundaries_are_hidden_or_tasks_switch():
    hidden = of(Block(ONE, 40), Block(TWO, 40), boundaries="hidden", **ENDLESS)
    switched = of(Block((ONE, TWO), 80, ByEpisode(1)), boundaries="hidden", **ENDLESS)

    returns = [
        [m["return_mean"] for m in learn_curriculum(each, Told(num_envs=4, num_steps=5)).of_kind("training")]
        for each in (hidden, switched)
    ]

    assert returns == [[1.0, 1.0, 0.0, 0.0], [1.0, 0.0, 1.0, 0.0]]


def test_torchrl_gets_one_endless_episode_with_task_ids_if_shown():
    env = CTGraphEnv([ONE, TWO] * 2, episodes="hidden", task_ids={ONE: 1, TWO: 0})
    check_env_specs(env, break_when_any_done="both")

    steps = env.rollout(30)

    assert steps.shape == (4, 30)
    ids = {key for key in env.observation_spec if key.startswith("task_")}
    assert set(steps["next"].keys()) == {"observation", "is_init", "reward", "done", "terminated", *ids}
    assert steps["task_id"][:, 7].tolist() == [[0, 1], [1, 0]] * 2
    assert steps["is_init"][..., 0].sum(1).tolist() == [1] * 4


def test_a_recorder_measures_learners_that_see_no_end():
    starts = []

    def policy(observation, state, episode_start):
        starts.append(episode_start.sum())
        return np.where(observation[:, DECISION] > 0, 1, 0), state

    curriculum = of(Block(ONE, 40), Block(TWO, 40), evaluation=Evaluation(6, episodes_per_row=3), **ENDLESS)
    with Recorder(curriculum) as recorder:
        measured = recorder.evaluate(policy, 0)

    assert measured == {"goal1": 1.0, "goal2": 0.0}
    assert starts == [4] + [0] * 13  # 2 rows of each task, 3 episodes of 4 steps and 2 steps between
    assert [m["episodes"] for m in recorder.log.of_kind("evaluation")] == [6, 6]


def test_only_agents_that_need_episodes_are_refused(compose):
    needing = {"mohqa", "rl2", "pearl", "maml", "cavia", "penn_a"}
    assert {name for name, kind in KINDS.items() if kind.needs_episodes} == needing

    for name in needing:
        agent = Told()
        agent.unwrapped = type(KINDS[name].__name__, (), {"needs_episodes": True})()
        with pytest.raises(ValueError, match=rf"^{KINDS[name].__name__} needs the ends of episodes, which are hidden"):
            check_episodes(GRAPHS, agent)
    with pytest.raises(ValueError, match=r"^RL2 needs .* ends of episodes, which protocol.episodes=hidden hides: set"):
        make_agent("rl2", GRAPHS)


@pytest.mark.parametrize(
    ("group", "name", "protocol", "kind"),
    [
        ("method", "mask_amsc", Protocol("at_boundaries", **ENDLESS), "MaskAMSC"),
        pytest.param(
            *("detector", "adwin", Protocol(boundaries="hidden", **ENDLESS), "ADWIN"),
            marks=pytest.mark.slow,  # it imports River
        ),
        ("detector", "amd", Protocol(boundaries="hidden", **ENDLESS), "AMD"),
    ],
)
def test_methods_and_detectors_that_read_episodes_are_refused(compose, group, name, protocol, kind):
    curriculum = replace(of(Block(ONE, 40), Block(TWO, 40)), protocol=protocol)
    part = made(compose, group, name)()
    method = part if group == "method" else part.labelling(Finetune("trained"))

    with pytest.raises(ValueError, match=rf"^{kind} needs the ends of episodes, which are hidden: set protocol.episo"):
        method.prepare(curriculum)


def test_a_detector_that_reads_no_episodes_labels_tasks_whose_episodes_are_hidden(compose):
    curriculum = of(Block(ONE, 160), Block(TWO, 160), boundaries="hidden", **ENDLESS)
    method = made(compose, "detector", "swoks", *SETTINGS["swoks"])().labelling(Scratch())
    agent = method.attach(small(compose, "ppo"), method.prepare(curriculum))

    log = learn_curriculum(curriculum, agent)

    assert {m["acted_label"] for m in log.of_kind("training")} >= {1}


def test_a_guide_and_a_partial_step_are_refused():
    with pytest.raises(ValueError, match="guide_frames=8 guides whole episodes, which episodes=hidden hides"):
        Protocol(guide_frames=8, **ENDLESS)
    with pytest.raises(ValueError, match="episodes must be one of shown, hidden, got 'none'"):
        CTGraphEnv([ONE], episodes="none")
    env = CTGraphEnv([ONE, ONE], episodes="hidden")
    data = env.reset().set("action", torch.zeros(2, dtype=torch.int64)).set("_step", torch.tensor([True, False]))
    with pytest.raises(ValueError, match="rows with hidden episodes step together: leave out _step"):
        env.step(data)
