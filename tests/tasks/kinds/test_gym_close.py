"""Environments of Gymnasium are closed at every end."""

import signal

import gymnasium
import numpy as np
import pytest
import torch

from baselines.exchanges.isolated import Isolated
from ctgraph_rl import Block, Curriculum, Evaluation, GymTask, Recorder, evaluate, learn_curriculum, make_agent
from ctgraph_rl.batch.gym_env import GymEnv
from ctgraph_rl.learn.collective import Member, learn_collective


class Counted(gymnasium.Env):
    """Counts those of it that are open; ``fails`` says when it raises an error."""

    observation_space = gymnasium.spaces.Box(0, 1, (2,))
    action_space = gymnasium.spaces.Discrete(2)
    most = 0
    fails_after = None
    interrupts = False

    def __init__(self, number=0, fails=""):
        self.fails = fails
        OPEN.add(id(self))
        Counted.most = max(Counted.most, len(OPEN))

    def reset(self, *, seed=None, options=None):
        self.steps = 0
        return np.zeros(2, dtype=np.float32), {}

    def step(self, action):
        self.steps += 1
        if Counted.fails_after is not None:
            Counted.fails_after -= 1
            if Counted.fails_after < 0:
                if Counted.interrupts:
                    signal.raise_signal(signal.SIGINT)
                raise OSError("the game crashed")
        return np.zeros(2, dtype=np.float32), 0.0, self.steps == 3, False, {}

    def close(self):
        OPEN.discard(id(self))
        if "close" in self.fails:
            raise RuntimeError("the window is gone")


def bad_wrapper(env):
    """Raise an error."""
    raise OSError("no wrapper")


OPEN: set[int] = set()
gymnasium.register("close/Counted-v0", Counted, max_episode_steps=9)
gymnasium.register("close/Endless-v0", Counted)
TASKS = [GymTask("close/Counted-v0", {"number": number}) for number in (0, 1)]


@pytest.fixture(autouse=True)
def none_is_open(monkeypatch):
    OPEN.clear()
    monkeypatch.setattr(Counted, "fails_after", None)
    monkeypatch.setattr(Counted, "interrupts", False)
    monkeypatch.setattr(Counted, "most", 0)
    yield
    assert not OPEN


def curriculum_of(*tasks):
    return Curriculum("counted", 1, "-", tuple(Block(task, 64) for task in tasks), Evaluation(num_episodes=3))


def learn(curriculum):
    agent = make_agent("a2c", curriculum, num_envs=4, num_steps=8, hidden_size=4)
    learn_curriculum(curriculum, agent)


def policy(data):
    return data.set("action", torch.zeros(data.batch_size, dtype=torch.int64))


def test_a_closed_environment_has_none_open_and_refuses_to_step():
    env = GymEnv(TASKS)
    data = env.rand_action(env.reset())
    assert len(OPEN) == 2

    env.close()
    env.close()

    assert not OPEN
    for act in (env.reset, lambda: env.step(data)):
        with pytest.raises(ValueError, match="the environments of this GymEnv are closed: make another one"):
            act()


def test_a_row_that_gets_another_task_closes_the_former_s_environment():
    env = GymEnv(TASKS[:1] * 3, task_pool=TASKS)
    for turn in range(4):
        env.set_tasks([TASKS[turn % 2]] * 3)
        env.reset()
        assert len(OPEN) == 3
    env.close()


def test_a_run_an_evaluation_and_a_recorder_leave_none_open():
    curriculum = curriculum_of(*TASKS)

    learn(curriculum)
    assert not OPEN
    assert Counted.most <= 4 + 6
    evaluate(policy, TASKS, 2)
    assert not OPEN
    with Recorder(curriculum) as recorder:
        recorder.evaluate(lambda observation: np.zeros(len(observation), dtype=np.int64), 0)
        assert not OPEN


@pytest.mark.parametrize("steps", [45, 90, 130], ids=["first evaluation", "block", "later"])
@pytest.mark.parametrize("interrupts", [False, True], ids=["error", "SIGINT"])
def test_an_error_and_an_interrupt_leave_none_open(steps, interrupts):
    curriculum = curriculum_of(*TASKS)
    agent = make_agent("a2c", curriculum, num_envs=4, num_steps=8, hidden_size=4)
    Counted.fails_after = steps
    Counted.interrupts = interrupts

    with pytest.raises(KeyboardInterrupt if interrupts else OSError):
        learn_curriculum(curriculum, agent)


def test_a_collective_leaves_none_open_where_a_member_fails():
    curriculum = curriculum_of(*TASKS)
    members = []
    for seed in (0, 1):
        agent = make_agent("a2c", curriculum, num_envs=4, num_steps=8, hidden_size=4)
        members.append(Member(curriculum, agent, seed))
    Counted.fails_after = 45

    with pytest.raises(OSError, match="the game crashed") as caught:
        learn_collective(members, Isolated(2, 1, 0.0, 0.0))
    assert not OPEN
    assert caught.tb  # which holds the members


def test_an_error_of_a_policy_leaves_none_open():
    with pytest.raises(ZeroDivisionError):
        evaluate(lambda data: 1 / 0, TASKS, 2)


@pytest.mark.parametrize(
    "task",
    [
        GymTask("close/Endless-v0"),
        GymTask("close/Counted-v0", channels="last"),
        GymTask("close/Counted-v0", wrappers=[bad_wrapper]),
        GymTask("close/Counted-v0", wrappers=["gymnasium.wrappers:NoSuchWrapper"]),
    ],
    ids=["no limit", "channels", "wrapper", "no wrapper"],
)
def test_an_environment_that_is_refused_is_closed(task):
    with pytest.raises(ValueError, match=r"Counted-v0|Endless-v0"):
        GymEnv([task])


def test_an_environment_that_fails_while_it_is_probed_is_closed():
    Counted.fails_after = 0

    with pytest.raises(ValueError, match="OSError: the game crashed"):
        GymEnv([GymTask("close/Counted-v0", {"number": 5})])


def test_rows_that_were_made_are_closed_where_a_later_one_cannot_be_made(monkeypatch):
    GymEnv(TASKS).close()
    original = GymTask.make
    made = []

    def make_two(task):
        if len(made) == 2:
            raise OSError("too many")
        made.append(original(task))
        return made[-1]

    monkeypatch.setattr(GymTask, "make", make_two)
    with pytest.raises(OSError, match="too many") as caught:
        GymEnv(TASKS * 2)
    assert not OPEN
    assert len(made) == 2
    assert caught.tb  # which holds the environment, so that it is not closed as garbage


def test_an_environment_that_fails_to_close_hides_no_error_and_keeps_no_other_open(capsys):
    failing = GymTask("close/Counted-v0", {"fails": "close"})

    evaluate(policy, [failing], 2)
    with pytest.raises(ZeroDivisionError):
        evaluate(lambda data: 1 / 0, [failing, failing], 2)

    assert "note: Counted failed to close: RuntimeError('the window is gone')" in capsys.readouterr().err


def test_spaces_and_bounds_leave_none_open(monkeypatch):
    closed = []
    lake = gymnasium.make("FrozenLake-v1").unwrapped
    monkeypatch.setattr(type(lake), "close", lambda env: closed.append(id(env)))
    task = GymTask("FrozenLake-v1", {"is_slippery": False}, max_episode_steps=17)

    assert task.return_bounds == (0.0, 1.0)
    assert task.num_actions == 4
    assert len(closed) == 2
