"""Tasks that are no CT-graphs: what is asked of them, and their JSON."""

import sys
from dataclasses import dataclass, replace
from types import ModuleType

import pytest
from gymnasium.wrappers import FlattenObservation
from helpers.scripted import ONE

from ctgraph_rl import Block, Curriculum, Evaluation
from ctgraph_rl.tasks.kinds.gym_task import GymTask

LAKE = GymTask("FrozenLake-v1", {"is_slippery": False}, label="firm")
SLIPPERY = GymTask("FrozenLake-v1", label="slippery")
LAKES = Curriculum("lakes", 1, "here", (Block(LAKE, 64), Block(SLIPPERY, 64)))


@dataclass(frozen=True)
class Half:
    """Lacks two members."""

    observation_shape: tuple[int, ...] = (4,)
    num_actions: int = 2


@dataclass(frozen=True)
class Whole(Half):
    """A task of a user."""

    level: int = 1

    @property
    def label_parts(self):
        return {"level": f"level{self.level}"}

    @classmethod
    def make_env(cls, tasks, seed=0, **kwargs):
        raise NotImplementedError


@dataclass
class Mutable:
    """Cannot be hashed."""

    observation_shape: tuple[int, ...] = (4,)
    num_actions: int = 2
    label_parts: str = "level"
    make_env: str = "none"


def test_a_curriculum_of_another_kind_has_labels_a_fingerprint_and_json():
    again = Curriculum.from_json(LAKES.to_json())

    assert again == LAKES
    assert LAKES.labels == ("firm", "slippery")
    assert LAKES.to_json()["about"]["tasks"] == [{"label": "firm"}, {"label": "slippery"}]
    assert len({LAKES.fingerprint, replace(LAKES, blocks=LAKES.blocks[:1]).fingerprint}) == 2


def test_the_same_task_is_equal_however_its_arguments_are_given():
    pairs = GymTask("FrozenLake-v1", [["is_slippery", False], ["desc", ["SF", "FG"]]])

    assert pairs == GymTask("FrozenLake-v1", {"desc": ["SF", "FG"], "is_slippery": False})
    assert hash(pairs) == hash(replace(pairs))
    assert GymTask("A-v0", wrappers=[FlattenObservation]).wrappers[0].endswith(":FlattenObservation")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Block(Half(), 64), "Half is no task, it lacks label_parts, make_env: see .*TaskLike"),
        (lambda: Block(Mutable(), 64), "Mutable is no task, it cannot be hashed: put @dataclass"),
        (lambda: Block((ONE, LAKE), 64), "tasks of one environment must be of one kind, got Task and GymTask"),
        (lambda: Curriculum("c", 1, "-", (Block(ONE, 8), Block(LAKE, 8))), "must be of one kind, got Task and GymTask"),
        (lambda: replace(LAKES, evaluation=Evaluation(held_out=(ONE,))), "must be of one kind, got GymTask and Task"),
        (lambda: Curriculum("c", 1, "-", (Block((Whole(), Whole((4,), 3)), 8),)), r"as many actions, got \[2, 3\]"),
        (lambda: Curriculum("c", 1, "-", (Block((Whole(), Whole((5,))), 8),)), r"one shape, got \[\(4,\), \(5,\)\]"),
        (lambda: GymTask(""), "id must be the id of an environment, got ''"),
        (lambda: GymTask("A-v0", {"a": {1, 2}}), "kwargs must be plain values by name, .* got {'a': {1, 2}}"),
        (lambda: GymTask("A-v0", {"render_mode": "human"}), "render_mode must be 'rgb_array', .*'human' opens"),
        (lambda: GymTask("A-v0", wrappers=("Flatten",)), r"such as .*'my_module:MyWrapper', .* got \('Flatten',\)"),
        (lambda: GymTask("A-v0", max_episode_steps=0), "max_episode_steps must be an integer >= 1, got 0"),
        (lambda: GymTask("A-v0", return_range=(1, 0)), r"return_range must be the lowest and the highest .*\(1, 0\)"),
    ],
)
def test_a_bad_task_is_refused_by_rule_value_and_fix(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_nothing_that_a_file_names_is_imported():
    content = LAKES.to_json()

    for field, value, message in (
        ("id", "this:Lake-v0", "the task needs the modules this: import them first"),
        ("wrappers", ["this:s"], "the task needs the modules this: import them first"),
        ("type", "this.Task", "type 'this.Task' is no kind of tasks that is known here: import this first"),
    ):
        tasks = [{**content["tasks"][0], field: value}, content["tasks"][1]]
        with pytest.raises(ValueError, match=message):
            Curriculum.from_json({**content, "tasks": tasks})
    assert "this" not in sys.modules


def test_a_users_kind_of_tasks_is_read_where_its_module_is_imported(monkeypatch):
    module = ModuleType("my_tasks")
    module.Whole = Whole
    monkeypatch.setitem(sys.modules, "my_tasks", module)
    monkeypatch.setattr(Whole, "__module__", "my_tasks")
    mine = Curriculum("mine", 1, "-", (Block(Whole(level=2), 8), Block(Whole(level=3), 8)))
    content = mine.to_json()

    assert content["tasks"][0] == {"type": "my_tasks.Whole", "observation_shape": [4], "num_actions": 2, "level": 2}
    monkeypatch.delitem(sys.modules, "my_tasks")
    with pytest.raises(ValueError, match=r"type 'my_tasks.Whole' is no kind of tasks that is known here"):
        Curriculum.from_json(content)


def test_the_optimum_of_a_lake_is_that_of_every_policy_of_its_states_and_steps():
    two = GymTask("FrozenLake-v1", {"desc": ["SF", "HG"], "is_slippery": True}, max_episode_steps=4)
    table, best = two.make().unwrapped.P, {}

    def value(state, steps):
        if steps and (state, steps) not in best:
            best[state, steps] = max(
                sum(p * (r + (0 if end else value(after, steps - 1))) for p, after, r, end in table[state][action])
                for action in range(4)
            )
        return best.get((state, steps), 0)

    assert two.optimal_value(1.0) == pytest.approx(value(0, 4), abs=1e-12)
    assert 0 < value(0, 4) < 1
    assert LAKE.return_bounds == (0.0, 1.0)
    assert GymTask("FrozenLake-v1", {"is_slippery": False}, max_episode_steps=5).optimal_value(1.0) == 0
    assert GymTask("FrozenLake-v1", {"is_slippery": False}).optimal_value(0.5) == 0.5**5


def test_what_is_not_known_of_an_environment_says_why():
    with pytest.raises(ValueError, match=r"the best mean return of CartPole-v1 is not known, .* give return_range"):
        _ = GymTask("CartPole-v1").return_bounds
    assert GymTask("CartPole-v1", return_range=(1, 500)).optimal_value(1.0) == 500
