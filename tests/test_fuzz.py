"""1,010 seeded cases: whatever is given works, or is refused by an error that says what is wrong."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.learning import train
from helpers.reference_files import SHIPPED_2023
from helpers.stopped_runs import Slow, limited

from baselines.parts.catalogue import CatalogueEntry, catalogue
from ctgraph_rl import (
    Block,
    CTGraph,
    CTGraphEnv,
    Curriculum,
    Evaluation,
    Observations,
    Protocol,
    RunLog,
    Task,
    evaluate,
    learn_curriculum,
    load,
)
from ctgraph_rl.batch.rows import Rows
from ctgraph_rl.checks import is_json_object
from ctgraph_rl.core.rewards import REWARD_FNS
from ctgraph_rl.gym import CTGraphGymEnv, CTGraphVectorEnv
from ctgraph_rl.log.export import write_l2logger
from ctgraph_rl.log.files import AGENT, CURRICULUM, LOG, METRICS
from ctgraph_rl.log.scores import scores
from ctgraph_rl.log.sums import is_complete
from ctgraph_rl.log.tables import write_tables
from ctgraph_rl.policies import OptimalPolicy
from ctgraph_rl.report import formats, results
from ctgraph_rl.runs.read import find_runs
from ctgraph_rl.runs.train import new_agent, with_method
from ctgraph_rl.tasks.configurations import ct_fo_b1, ct_su_b1
from ctgraph_rl.tasks.images import IMAGE_SETS, OneHot
from ctgraph_rl.tasks.switch import AtRandom, ByEpisode, Drift

pytestmark = pytest.mark.slow

SECONDS = 120
"""For one case; most take a hundredth of a second."""

CASES = {"constructors": 650, "runs": 130, "files": 230}
PARTS = 10

ALLOWED = (ValueError, OSError, FloatingPointError, ModuleNotFoundError)
"""Errors that are documented; OSError of files alone."""

NOT_OURS = (
    "truth value",
    "invalid literal",
    "could not convert",
    "not enough values",
    "too many values",
    "too large to",
)
"""Words of errors that Python, NumPy and torch raise."""

BASE = ct_su_b1((1, 2))
SMALL_CURRICULUM = Curriculum("fuzz", 1, "a test", (Block(BASE, 32), Block(ct_su_b1((2, 1)), 32)), Evaluation(2))

ONE_BLOCK = replace(
    SMALL_CURRICULUM,
    blocks=(Block((BASE, ct_su_b1((2, 1))), 64),),
    evaluation=Evaluation(4, episodes_per_row=2, adapt_episodes=2),
)
"""A distribution of tasks, and episodes to adapt in."""

VALUES: list[Any] = [
    *(None, True, False, -1, 0, 1, 2, 3, 7, 2**31, 2**60, 2**63, 2**70, -(2**70), 10**400),
    *(0.0, 0.5, -0.5, 1.0, 1.5, 1e-30, 1e-300, 1e300, math.nan, math.inf, -math.inf),
    *("", "x", "all", "seen", "hidden", "one_hot", "cpu", "cuda:99", "meta", "a\0b", "\udc80", "x" * 5000, b"x"),
    *((), (1,), (1, 2), (2, 1), (2, 2), (3, 3), [1, 1], [[1], 2], {}, {1: 2}, {"a": 1}, {0, 1}, (None,), (1.5, 2)),
    *(np.array([True, False]), np.array([1, 2]), np.array(2), np.int64(2), np.float32(0.5), np.bool_(True)),
    *(torch.tensor([True, False]), torch.tensor([1, 2]), torch.tensor(2), torch.tensor(0.5), torch.device("meta")),
    *(object(), int, Task, abs, BASE, (BASE,), [BASE, BASE], CTGraph(2, 2), OneHot(5), SMALL_CURRICULUM),
]


def fails(case: Callable[[], object], names: Callable[[str], bool]) -> str | None:
    """What is wrong with the way in which a case ends; None if it works or is refused as it should be."""
    try:
        with limited(SECONDS):
            case()
    except ALLOWED as error:
        message = str(error)
        if not message or any(words in message for words in NOT_OURS) or not names(message):
            return f"{type(error).__name__}: {message[:200]}"
    except Slow as error:
        return str(error)
    except Exception as error:
        return f"{type(error).__name__}: {str(error)[:200]}"
    return None


def given(kind: Any, **arguments: Any) -> tuple[Callable[..., Any], dict[str, Any]]:
    return kind, arguments


def of_fields(value: Any) -> tuple[Callable[..., Any], dict[str, Any]]:
    """A frozen dataclass that is made again with other fields."""
    return partial(replace, value), {field.name: getattr(value, field.name) for field in fields(value) if field.init}


def steps(make: Callable[..., Any], **arguments: Any) -> None:
    make(**arguments).rollout(2)


def gym_steps(make: Callable[..., Any], **arguments: Any) -> None:
    env = make(**arguments)
    env.reset(seed=1)
    env.step(env.action_space.sample())


@cache
def entries(group: str) -> tuple[CatalogueEntry, ...]:
    """All agents, or all methods."""
    return tuple(catalogue(group))


def tiny(name: str) -> dict[str, Any]:
    """The settings of an agent's yaml, made small."""
    settings = dict(next(entry for entry in entries("agent") if entry.name == name).settings)
    small = {"num_envs": 2, "num_steps": 8, "hidden_size": 4, "batch_size": 4, "buffer_size": 64, "num_minibatches": 1}
    small |= {
        "num_epochs": 1,
        "num_updates": 1,
        "compile": False,
        "adapt_episodes": 2,
        "num_trials": 1,
        "segment_size": 2,
    }
    small |= {"num_steps": 24} if "adapt_episodes" in settings else {}
    return settings | {key: value for key, value in small.items() if key in settings}


def built(group: str, name: str, **settings: Any) -> Any:
    kind = next(entry for entry in entries(group) if entry.name == name).kind
    return partial(kind, **settings)


def agents() -> Iterator[tuple[str, Any]]:
    for entry in entries("agent"):

        def make(name: str = entry.name, **settings: Any) -> object:
            curriculum = ONE_BLOCK if name in ("cavia", "maml", "pearl") else SMALL_CURRICULUM
            return new_agent(curriculum, built("agent", name, **settings), 0)

        yield entry.name, (make, tiny(entry.name))


def methods() -> Iterator[tuple[str, Any]]:
    one_hot = replace(SMALL_CURRICULUM, protocol=Protocol("at_boundaries"))
    for entry in entries("method"):

        def make(entry: Any = entry, **settings: Any) -> object:
            method = built("method", entry.name, **settings)
            curriculum = method().prepare(one_hot)
            agent = built("agent", "ppo", **tiny("ppo"))
            return new_agent(curriculum, with_method(agent, method, curriculum), 0)

        if entry.settings:
            yield entry.name, (make, dict(entry.settings))


def constructors() -> dict[str, tuple[Callable[..., Any], dict[str, Any]]]:
    images = [kind(5) for kind in IMAGE_SETS if kind.__name__ in ("PaperImages", "OneHot")]
    parts = [BASE, BASE.graph, BASE.observations, ct_fo_b1((1, 2)), *(kind() for kind in REWARD_FNS.values()), *images]
    parts += [ByEpisode(2), AtRandom(0.5), Drift(3), SMALL_CURRICULUM, SMALL_CURRICULUM.blocks[0], Evaluation(4)]
    parts += [Protocol("one_hot", task_ids=(0, 1)), Block((BASE, ct_su_b1((1, 1))), 32, Drift(3))]
    env = {"tasks": [BASE] * 2, "seed": 0, "first_row": 0, "task_pool": None, "device": "cpu", "check_actions": True}
    env |= {"noise_bank": 0, "task_ids": None, "num_task_ids": None, "kernel": "auto", "info": True}
    rows = {name: value for name, value in env.items() if name in ("tasks", "seed", "first_row", "device", "kernel")}
    evaluation = {"policy": OptimalPolicy, "tasks": [BASE], "num_episodes": 2, "seed": 0, "greedy": True}
    evaluation |= {"episodes_per_row": 1, "device": "cpu"}
    found = {f"{type(part).__name__} {i}": of_fields(part) for i, part in enumerate(parts)}
    found |= {"env": (partial(steps, CTGraphEnv), env), "rows": (Rows, rows), "evaluate": (evaluate, evaluation)}
    found["vector"] = partial(gym_steps, CTGraphVectorEnv), {"num_envs": 2, "task": BASE, "kernel": "auto"}
    found["gym"] = partial(gym_steps, CTGraphGymEnv), {"task": BASE, "kernel": "auto"}
    found["optimum"] = given(BASE.optimal_value, gamma=0.9)
    found["policy"] = given(lambda policy: BASE.policy_value(policy), policy=torch.full((5, 3), 1 / 3))
    return found | dict(agents()) | dict(methods())


def shown(value: Any) -> str:
    try:
        return repr(value)[:12]
    except ValueError:
        return ""


def constructor_case(draw: random.Random, _: Path, kinds: dict[str, Any]) -> tuple[str, str | None]:
    """One or two arguments of a constructor are any values."""
    name = draw.choice(sorted(kinds))
    make, arguments = kinds[name]
    changed = {
        key: draw.choice(VALUES) for key in draw.sample(sorted(arguments), min(len(arguments), draw.choice((1, 1, 2))))
    }

    def names(message: str) -> bool:
        words = {*changed, *(key.removesuffix("s") for key in changed), *map(shown, changed.values())}
        words |= {type(value).__name__ for value in changed.values()}
        return any(word.lower() in message.lower() for word in words if word)

    return f"{name} {changed!r:.200}", fails(lambda: make(**{**arguments, **changed}), names)


def any_curriculum(draw: random.Random) -> Curriculum:
    depth, b = draw.choice((1, 2)), draw.choice((2, 3))
    graph = CTGraph(b, depth, draw.choice((0.0, 0.3)))
    goals = [tuple(draw.randint(1, b) for _ in range(depth)) for _ in range(draw.randint(1, 3))]
    observations = draw.choice((BASE.observations, Observations((2, 3), (4, 5), (6, 7))))
    room = observations.last_id + 1
    base = replace(BASE, graph=graph, goal=goals[0], observations=observations, images=OneHot(room))
    tasks = list(dict.fromkeys(replace(base, goal=goal) for goal in goals))
    blocks = [Block(draw.choice((task, task, tuple(tasks))), draw.choice((16, 32, 48))) for task in tasks]
    if len(tasks) > 1 and draw.random() < 0.3:
        blocks.append(Block(tuple(tasks), 32, draw.choice((ByEpisode(1), AtRandom(0.5), Drift(2, True)))))
    held_out = tuple(replace(base, goal=(1,) * depth, goal_reward=2.0) for _ in range(draw.randint(0, 1)))
    every = draw.choice((0, 16, 8, 12))
    how = Evaluation(2, draw.random() < 0.5, 1, draw.random() < 0.8, every, draw.random() < 0.7, "all", held_out)
    how = replace(how, tasks=draw.choice(("all", "seen")))
    boundaries = draw.choice(("announced", "announced", "announced", "hidden"))
    protocol = Protocol(draw.choice(("hidden", "one_hot", "one_hot", "one_hot")), boundaries)
    if draw.random() < 0.2:
        protocol = Protocol("at_boundaries", draw.choice(("announced", "announced", "hidden")))
    return Curriculum("any", 1, "a test", tuple(blocks), how, protocol)


def run_case(draw: random.Random, folder: Path, _: Any) -> tuple[str, str | None]:
    """Any curriculum, agent and method; a short run in memory or in a directory, whose files are then read."""
    agent, method = (draw.choice(entries(group)).name for group in ("agent", "method"))
    settings, of_method = tiny(agent), next(e.settings for e in entries("method") if e.name == method)
    odd = draw.choice([None, *settings])
    if odd is not None and draw.random() < 0.5:
        settings[odd] = draw.choice((1, 2, 3, 0.5, 1e-5, 1.0))
    seed, written = draw.randint(0, 99), draw.random() < 0.4

    def case() -> None:
        curriculum = any_curriculum(draw)
        make_method = built("method", method, **of_method)
        curriculum = make_method().prepare(curriculum)
        learner = new_agent(curriculum, with_method(built("agent", agent, **settings), make_method, curriculum), seed)
        if written:
            train(curriculum, learner, folder, seed)
            assert json.loads((folder / METRICS).read_text(encoding="utf-8"))
            assert find_runs([folder])[0][0].reason is None
        else:
            scores(learn_curriculum(curriculum, learner, seed), curriculum)

    return f"{agent} {method} {odd}={settings.get(odd or '')} seed {seed}", fails(
        case, lambda message: len(message) > 20
    )


def a_run(folder: Path) -> Path:
    """The directory of a finished run."""
    run = folder / "run"
    run.mkdir()
    make = built("agent", "reinforce", **tiny("reinforce"))
    train(SMALL_CURRICULUM, new_agent(SMALL_CURRICULUM, make, 0), run, 0)
    BASE_FILE.update({path.name: path.read_bytes() for path in run.iterdir() if path.is_file()})
    return run


BASE_FILE: dict[str, bytes] = {}


def damaged(draw: random.Random, data: bytes) -> bytes:
    """Bytes changed, cut, repeated or, of JSON, values and keys changed."""
    way = draw.choice(("flip", "cut", "insert", "json", "json", "json", "lines"))
    if way == "flip":
        changed = bytearray(data)
        for _ in range(draw.choice((1, 3, 30))):
            changed[draw.randrange(len(changed))] = draw.randrange(256)
        return bytes(changed)
    if way == "cut":
        return data[: draw.randrange(len(data))]
    if way == "insert":
        place = draw.randrange(len(data))
        return (
            data[:place] + draw.choice((b"\0", b"[[[[", b'{"', b"1e999", b"\xff\xfe", b"\n\n", b"NaN")) + data[place:]
        )
    lines = data.split(b"\n")
    if way == "lines":
        draw.shuffle(lines)
        return b"\n".join(lines[: draw.randint(1, len(lines))])
    return _changed_json(draw, data)


PLAIN = [value for value in VALUES if is_json_object({"value": value}) and value != 10**400]


def _changed_json(draw: random.Random, data: bytes) -> bytes:
    """JSON, or a line of JSON lines, with a value or a key changed."""
    lines = [data] if data.lstrip().startswith(b"{\n") else [line for line in data.split(b"\n") if line]
    number = draw.randrange(len(lines))
    try:
        value = json.loads(lines[number])
    except ValueError:
        return data[: len(data) // 2]
    places: list[tuple[Any, Any]] = []

    def collect(part: Any) -> None:
        for key in part if isinstance(part, dict) else range(len(part)) if isinstance(part, list) else ():
            places.append((part, key))
            collect(part[key])

    collect(value)
    part, key = draw.choice(places)
    if isinstance(part, dict) and draw.random() < 0.3:
        part["new" if draw.random() < 0.5 else key + "x"] = part.pop(key)
    else:
        part[key] = draw.choice(PLAIN)
    lines[number] = json.dumps(value).encode()
    return b"\n".join(lines) + b"\n"


def file_case(draw: random.Random, folder: Path, _: Any) -> tuple[str, str | None]:
    """A file of a run is damaged, and all that reads it does."""
    if not BASE_FILE:
        a_run(folder)
    name = draw.choice((CURRICULUM, CURRICULUM, LOG, LOG, LOG, METRICS, AGENT, "task.json"))
    data = damaged(draw, json.dumps(SHIPPED_2023).encode() if name == "task.json" else BASE_FILE[name])
    run = folder / "damaged"
    run.mkdir(exist_ok=True)
    for other, content in BASE_FILE.items():
        (run / other).write_bytes(content)
    (run / name).write_bytes(data)
    log = partial(RunLog.read, run / LOG)
    uses: list[Callable[[], object]] = {
        CURRICULUM: [lambda: Curriculum.from_json(run / CURRICULUM), lambda: load(run)],
        LOG: [
            lambda: scores(log(), SMALL_CURRICULUM),
            lambda: (log().performance(), log().ends(), log().curves(), log().regimes()),
            lambda: write_tables(log(), run),
            lambda: write_l2logger(log().regimes(), run / f"l2logger{draw.random()}"),
            lambda: formats.text(results.table(find_runs([run])[0])),
            lambda: load(run),
        ],
        METRICS: [lambda: formats.text(results.table(find_runs([run])[0])), lambda: is_complete(run)],
        AGENT: [lambda: load(run)],
        "task.json": [lambda: Task.from_json(run / "task.json", (1, 1))],
    }[name]
    wrong = [fails(use, lambda message: len(message) > 20) for use in uses]
    return f"{name} {data[:60]!r}", next((each for each in wrong if each), None)


@pytest.mark.parametrize("part", range(PARTS))
@pytest.mark.parametrize("kind", CASES)
def test_any_case_works_or_is_refused_with_its_reason(kind, part, tmp_path):
    case = {"constructors": constructor_case, "runs": run_case, "files": file_case}[kind]
    kinds = constructors() if kind == "constructors" else {}
    wrong = []
    for number in range(part, CASES[kind], PARTS):
        folder = tmp_path / str(number)
        folder.mkdir()
        what, problem = case(random.Random(f"{kind} {number}"), folder, kinds)
        wrong += [f"case {number}: {what}: {problem}"] if problem else []

    assert not wrong, "\n".join(wrong)
