"""Tests of every kind of tasks, by `TaskLike`, and of its environment."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import check_env_specs

from ctgraph_rl.learn.collect import SHOWN, make_env
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.kinds.task_like import TaskLike
from ctgraph_rl.tasks.protocol import Block, Protocol
from ctgraph_rl.tasks.switch import ByEpisode

NUM_STEPS = 40

TOO_LONG = f"no episode ended in {NUM_STEPS} steps: give tasks with a shorter time limit"


class _OfTasks:
    def make_tasks(self) -> Sequence[Any]:
        """Return two different tasks of one kind, equal at every call."""
        raise NotImplementedError

    def curriculum(self, **protocol: Any) -> Curriculum:
        """Return a curriculum with a block of each task."""
        blocks = tuple(Block((task,), num_frames=64) for task in self.make_tasks())
        return Curriculum("contract", 1, "a test", blocks, protocol=Protocol(**protocol))


class TaskContract(_OfTasks):
    """Tests of a kind of tasks. Override `make_tasks`.

    Example:
        >>> class TestMyTask(TaskContract):
        ...     def make_tasks(self):
        ...         return [MyTask(level=1), MyTask(level=2)]
    """

    def test_tasks_are_equal_and_hashed_by_value(self) -> None:
        """Two calls of `make_tasks` give the same, different tasks."""
        once = list(self.make_tasks())
        again = list(self.make_tasks())

        assert once == again
        assert [hash(task) for task in once] == [hash(task) for task in again]
        assert once[0] != once[1]

    def test_a_curriculum_of_them_has_labels_and_survives_json(self) -> None:
        """The fingerprint is of the tasks' values."""
        curriculum = self.curriculum()

        assert all(curriculum.labels)
        assert Curriculum.from_json(curriculum.to_json()).fingerprint == curriculum.fingerprint
        assert replace(curriculum, blocks=curriculum.blocks[:1]).fingerprint != curriculum.fingerprint

    def test_what_is_known_of_returns_is_in_order_or_says_why_it_is_not_known(self) -> None:
        """Of ``return_bounds`` and ``optimal_value``."""
        for task in self.make_tasks():
            if hasattr(type(task), "return_bounds") and hasattr(type(task), "optimal_value"):
                try:
                    low, high = task.return_bounds
                    assert low <= task.optimal_value(1.0) <= high
                except ValueError as error:
                    assert str(error)


class EnvironmentContract(_OfTasks):
    """Tests of a kind's environment. Override `make_tasks`."""

    shows_task_ids = True
    """False leaves out tests of changing tasks."""

    def make_env(self, rows: Sequence[TaskLike], seed: int = 0, **protocol: Any) -> Any:
        """Return an environment with these rows."""
        return make_env(self.curriculum(**protocol), rows, seed)

    def steps(self, env: Any, actions: Sequence[Any] = ()) -> Iterator[tuple[TensorDictBase, TensorDictBase]]:
        """Yield steps from a reset on, each with the next data; actions are random unless given."""
        data = env.reset()
        for number in range(len(actions) or NUM_STEPS):
            data = data.set("action", actions[number]) if actions else env.rand_action(data)
            step, data = env.step_and_maybe_reset(data)
            yield step, data.clone()

    def test_data_are_as_the_specs_say(self) -> None:
        """By TorchRL's check, and the tasks' shapes and actions."""
        first, other = self.make_tasks()
        env = self.make_env([first, other, first])

        check_env_specs(env, break_when_any_done="both")
        assert tuple(env.batch_size) == (3,)
        assert tuple(env.observation_spec_unbatched["observation"].shape) == tuple(first.observation_shape)
        assert getattr(env.action_spec_unbatched, "n", None) == first.num_actions

    def test_counts_and_sums_are_of_an_episode(self) -> None:
        """They start again with an episode; ``next`` shows those of its end."""
        first, _ = self.make_tasks()
        env = self.make_env([first] * 4)
        count = torch.zeros(4, 1, dtype=torch.int64, device="cpu")
        total = torch.zeros(4, 1, dtype=torch.float32, device="cpu")
        ended = 0

        for step, following in self.steps(env):
            after = step["next"]
            done = step["next", "done"]
            count = count + 1
            total = total + after["reward"]
            assert count.equal(after["step_count"])
            assert torch.allclose(total, after["episode_reward"])
            assert following["is_init"].equal(done)
            count = count * ~done
            total = total * ~done
            ended = ended + int(done.sum())
            assert count.equal(following["step_count"])
        assert ended, TOO_LONG

    def test_equal_seeds_and_actions_give_equal_data(self) -> None:
        """A run repeats bit for bit."""
        tasks = list(self.make_tasks())
        once = list(self.steps(self.make_env(tasks, seed=3)))
        actions = [step["action"] for step, _ in once]
        again = list(self.steps(self.make_env(tasks, seed=3), actions))

        for (step, following), (other, other_following) in zip(once, again, strict=True):
            _assert_equal(step, other, following, other_following)

    def test_a_row_changes_its_task_where_its_episode_ends(self) -> None:
        """``set_tasks(tasks, at_episode_end=True)``, by shown ids."""
        if not self.shows_task_ids:
            return
        first, other = self.make_tasks()
        env = self.make_env([first] * 3, task_id="one_hot")
        env.reset()
        env.set_tasks([first] * 3)
        data = env.reset()
        env.set_tasks([other] * 3, at_episode_end=True)

        self._follow_ids(env, data, lambda episodes: episodes > 0)

    def test_a_switch_changes_the_task_of_each_episode(self) -> None:
        """``switch_tasks(tasks, switch)``, where an environment with ids has it."""
        tasks = list(self.make_tasks())
        if not self.shows_task_ids:
            return
        env = self.make_env(tasks[:1] * 3, task_id="one_hot")
        if hasattr(env, "switch_tasks"):
            env.switch_tasks(tasks, ByEpisode())

            self._follow_ids(env, env.reset(), lambda episodes: episodes % 2 == 1)

    def _follow_ids(self, env: Any, data: TensorDictBase, is_second: Callable[[Tensor], Tensor]) -> None:
        episodes = torch.zeros(3, 1, dtype=torch.int64, device="cpu")
        for _ in range(NUM_STEPS):
            step, data = env.step_and_maybe_reset(env.rand_action(data))
            assert step["next", "task_id"][:, 1:].bool().equal(is_second(episodes))
            episodes = episodes + step["next", "done"]
            assert data["task_id"][:, 1:].bool().equal(is_second(episodes))
        assert episodes.any(), TOO_LONG

    def test_a_saved_environment_resumes_with_the_same_bits(self) -> None:
        """Where tasks have ``resumes``."""
        tasks = list(self.make_tasks())
        if not getattr(tasks[0], "resumes", False):
            return
        env = self.make_env(tasks)
        other = self.make_env(tasks)
        *_, (_, data) = self.steps(env)
        env.set_tasks(tasks[::-1], at_episode_end=True)
        other.load_state_dict(env.state_dict())

        for _ in range(NUM_STEPS):
            env.rand_action(data)
            step, following = env.step_and_maybe_reset(data.clone())
            again, data = other.step_and_maybe_reset(data.clone())
            _assert_equal(step, again, following, data)


def _assert_equal(
    step: TensorDictBase, other: TensorDictBase, following: TensorDictBase, other_following: TensorDictBase
) -> None:
    assert all(step["next", key].equal(other["next", key]) for key in (*SHOWN, "reward", "done"))
    assert all(following[key].equal(other_following[key]) for key in SHOWN)
