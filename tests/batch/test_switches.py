"""The switches of the authors' implementation against plain Python: what its recorded traces do not show."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import product

import pytest
import torch
from helpers.oracles import (
    DECISION,
    END,
    FAIL,
    HOME,
    WAIT,
    act,
    confounding,
    is_uniform,
    node_numbers,
    optimal,
    scripts,
    surjective,
    tree_states,
    tree_step,
)
from helpers.task_families import LEGACY, SWITCHED, VECTORS, legacy_number, read, seen, unique
from torch import Tensor

from ctgraph_rl import (
    CTGraph,
    CTGraphEnv,
    Needle,
    Observations,
    OneHot,
    ReferenceImages,
    ReferenceLinear,
    ReferenceOneHot,
    Task,
)
from ctgraph_rl.batch.rows import Rows
from ctgraph_rl.core import dynamics
from ctgraph_rl.core.philox import STREAM_GOAL, STREAM_NOISE, STREAM_STEP, draw
from ctgraph_rl.core.rotation import rotate

# All switches at once


class PlainRow:
    """One row by the decisions taken, which knows every switch. A tick has words for what it shows and for a stay."""

    def __init__(self, task: Task, seed: int, row: int, num_ticks: int) -> None:
        self.task, self.tick, self.goal = task, 0, task.goal_leaf
        self.episodes, self.lasts = (0 if task.legacy_goal_change else -1), 0
        of_row = (torch.tensor(seed), torch.tensor(row), torch.arange(num_ticks))
        streams = (STREAM_STEP, STREAM_NOISE, STREAM_GOAL)
        self.words = {stream: torch.stack(draw(*of_row, stream), -1).tolist() for stream in streams}

    def reset(self) -> None:
        self.tick += 1
        self.kind, self.path, self.done, self.reward = HOME, (), False, 0.0
        if self.task.goal_change is None:
            return
        first, last = self.task.goal_change
        words = self.words[STREAM_GOAL][self.tick]
        self.episodes += 1
        drawn_for = words[3] if not self.lasts else words[0]  # how long the next goal lasts
        self.lasts = self.lasts or first + (words[0] * (last - first + 1) >> 32)
        if self.episodes == self.lasts:
            self.goal = (words[1] << 32 | words[2]) * self.task.graph.num_end_states >> 64
            self.episodes, self.lasts = 0, first + (drawn_for * (last - first + 1) >> 32)

    def step(self, action: int) -> None:
        words, graph = self.words[STREAM_STEP][self.tick], self.task.graph
        self.tick += 1
        stays = (words[0] << 31 | words[1] >> 1) < Fraction(graph.wait_prob) * 2**63
        self.reward = self.task.step_reward
        if self.kind == END:
            self.kind, self.done = HOME, True
            return
        before = self.kind, self.path
        self.kind, self.path = tree_step(graph.branching_factor, graph.depth, before, action, stays)
        self.reward += self.task.goal_reward * self.share() if self.kind == END else 0.0
        self.reward += self.task.fail_reward if self.kind == FAIL else 0.0
        self.done = self.kind == FAIL or (self.kind == END and not self.task.extra_end_step)

    def number(self, path: tuple[int, ...]) -> int:
        return sum((a - 1) * self.task.graph.branching_factor**k for k, a in enumerate(reversed(path)))

    def share(self) -> float:
        if self.task.reward_fn == Needle():
            return float(self.number(self.path) == self.goal)
        b, d = self.task.graph.branching_factor, self.task.graph.depth
        goal = [self.goal // b ** (d - k) % b + 1 for k in range(1, d + 1)]
        parts = zip(range(d, 0, -1), self.path, goal, strict=True)
        return float(Fraction(sum(w * (1 - abs(a - g)) for w, a, g in parts), d * (d + 1) // 2))

    def id(self) -> int:
        x, b = self.task.observations, self.task.graph.branching_factor
        first, last = x.ids(self.kind)
        if not x.is_unique(self.kind):
            return first + (self.words[STREAM_STEP][self.tick][2] * (last - first + 1) >> 32)
        if x.legacy_index:
            return first + legacy_number(b, self.path) % (last - first + 1)
        before = 0 if self.kind == END else sum(b**level for level in range(len(self.path)))
        return first + before + self.number(self.path)

    def noisy(self, image: Tensor) -> Tensor:
        """SplitMix64 from 64 bits of the tick, four pixels from each of its numbers."""
        words, high, parts = self.words[STREAM_NOISE][self.tick], self.task.observations.read_noise + 1, []
        state, full = words[0] << 32 | words[1], 2**64 - 1
        while len(parts) < image.numel():
            state = state + 0x9E3779B97F4A7C15 & full
            z = (state ^ state >> 30) * 0xBF58476D1CE4E5B9 & full
            z = (z ^ z >> 27) * 0x94D049BB133111EB & full
            parts += [((z ^ z >> 31) >> place & 0xFFFF) * high >> 16 for place in (0, 16, 32, 48)]
        return (image + torch.tensor(parts[: image.numel()]).view(image.shape)).clamp_max(255).to(torch.uint8)

    def observation(self) -> Tensor:
        x, white = self.task.observations, self.task.images.white if hasattr(self.task.images, "white") else 254
        image = self.task.images.bank(0)[self.id()].clone()
        if image.ndim == 3:
            angle = self.words[STREAM_STEP][self.tick][3] * (x.read_rotation + 1) >> 32
            orders = {True: lambda: rotate(self.noisy(image), angle), False: lambda: self.noisy(rotate(image, angle))}
            image = orders[x.noise_before_rotation]()
        if x.reward_cue and self.kind == END:
            level = int(white * (self.reward - self.task.step_reward) / self.task.goal_reward)
            level = level % 256 if x.cue_wraps else max(0, min(level, int(white)))
            shown = image[-1:] if image.ndim == 1 else image[:, 3:9, 3:9]
            shown[...] = level
        return image


@pytest.mark.parametrize("tasks", [SWITCHED, VECTORS], ids=["images", "vectors"])
def test_a_mixed_batch_of_all_switches_follows_plain_rules_row_by_row(tasks):
    rows, steps = Rows(tasks, seed=5, first_row=3), 80
    plain = [PlainRow(task, 5, 3 + i, 2 * steps) for i, task in enumerate(tasks)]
    careless = scripts(steps, len(tasks), 7, seed=2).eq(6).tolist()
    mask, shown, outcomes = [True] * len(tasks), rows.reset(), Counter()

    for action, any_one in zip(scripts(steps, len(tasks), 5, seed=1).tolist(), careless, strict=True):
        for row, begins in zip(plain, mask, strict=True):
            row.reset() if begins else None
        expect(rows, shown, plain)
        taken = [a if free else best(row, a) for row, a, free in zip(plain, action, any_one, strict=True)]
        shown = rows.step(torch.tensor(taken))
        for row, a in zip(plain, taken, strict=True):
            row.step(a)
        expect(rows, shown, plain)
        outcomes.update(shown.outcome.tolist())
        mask = [row.done or a == 4 for row, a in zip(plain, action, strict=True)]
        shown = rows.reset(torch.tensor(mask))

    assert min(outcomes[outcome] for outcome in range(4)) > 5


def best(row: PlainRow, action: int) -> int:
    """An action that does not fail, from one that may."""
    return {WAIT: 0, DECISION: 1 + action % row.task.graph.branching_factor}.get(row.kind, action)


def expect(rows: Rows, shown: dynamics.Shown, plain: list[PlainRow]) -> None:
    for i, row in enumerate(plain):
        arrived, image = row.done and row.kind != FAIL, row.observation()
        outcome = (2 + (row.number(row.path) == row.goal)) if arrived else int(row.done)
        assert (rows.state_type[i].item(), rows.observation_id[i].item()) == (row.kind, row.id()), (i, row.tick)
        assert (rows.goal_leaf[i].item(), shown.done[i].item()) == (row.goal, row.done), (i, row.tick)
        assert (shown.outcome[i].item(), shown.leaf[i].item()) == (outcome, row.number(row.path) if arrived else -1)
        assert rows.reward[i].item() == torch.tensor(row.reward, dtype=torch.float32).item(), (i, row.tick)
        found = shown.observation[i]
        assert torch.equal(found[: len(image)], image) and not found[len(image) :].any(), (i, row.tick)


# The index


def ids_by_state(task: Task) -> dict[tuple, int]:
    """The id that each state of the tree shows."""
    b, d = task.graph.branching_factor, task.graph.depth
    states, number = tree_states(b, d), node_numbers(b, d)
    rows = Rows([task] * len(states))
    kind = torch.tensor([kind for kind, _ in states], dtype=torch.uint8)
    rows.state = rows.state._replace(state_type=kind, node=torch.tensor([number[path] for _, path in states]))
    return dict(zip(states, rows.observation_id.tolist(), strict=True))


@pytest.mark.parametrize(("b", "d"), [(2, 1), (2, 5), (3, 1), (3, 3), (3, 4), (4, 2), (4, 3), (5, 2), (7, 1)])
@pytest.mark.parametrize("room", [0, 1, 40])
def test_a_legacy_id_is_the_number_of_a_one_and_the_path_less_one_modulo_the_range(b, d, room):
    task = unique(b, d, room=room, legacy_index=True)

    ids = ids_by_state(task)

    assert ids.pop((HOME, ())) == 0
    for (kind, path), found in ids.items():
        first, last = task.observations.ids(kind)
        assert found == first + legacy_number(b, path) % (last - first + 1)


@pytest.mark.parametrize(
    ("b", "d", "room", "waits", "decisions"),
    [(3, 2, 0, 10, 3), (3, 3, 0, 31, 10), (4, 2, 0, 16, 4), (2, 4, 0, 31, 15), (3, 2, 4, 13, 4), (3, 2, 3, 12, 4)],
)
def test_three_branches_or_more_share_ids_in_ranges_of_exactly_their_number(b, d, room, waits, decisions):
    ids = ids_by_state(unique(b, d, room=room, legacy_index=True))

    different = {kind: len({found for (of, _), found in ids.items() if of == kind}) for kind in (WAIT, DECISION, END)}

    assert different == {WAIT: waits, DECISION: decisions, END: b**d}


@pytest.mark.parametrize("d", [1, 2, 3, 5])
def test_two_branches_change_the_ids_of_end_states_alone_which_begin_one_before_the_first(d):
    normal, legacy = (ids_by_state(unique(2, d, legacy_index=value)) for value in (False, True))

    first = normal[END, (1,) * d]

    assert all(normal[state] == i for state, i in legacy.items() if state[0] != END)
    ends = [legacy[END, path] - first for path in product((1, 2), repeat=d)]
    assert ends == [2**d - 1, *range(2**d - 1)]


def test_unique_waits_alone_fix_the_ids_of_end_states_and_draw_those_of_decisions():
    task = read(MDP_W=True, W_IDs=[14, 20])
    env = CTGraphEnv([replace(task, goal=path) for path in product((1, 2), repeat=2)] * 3000)
    env.reset()
    shown = []
    for _ in range(6):
        act(env, optimal(env))
        shown.append(env.observation_id.view(3000, 4))

    assert all(x.unique(dim=0).tolist() == y for x, y in zip(shown[::2], WAITS_OF_2_2, strict=False))
    assert shown[5].unique(dim=0).tolist() == [[13, 10, 11, 12]]
    pairs = (shown[1] - 7) * 3 + shown[3] - 7
    assert is_uniform(pairs.flatten().bincount(minlength=9).tolist())


WAITS_OF_2_2 = [[[14] * 4], [[15, 15, 16, 16]], [[17, 18, 19, 20]]]


def test_the_deepest_tree_is_numbered_beside_others_without_overflow():
    deep = Task(CTGraph(2, 60), (2,) * 60, Observations((2, 2), (3, 3), (4, 6), legacy_index=True), OneHot(28))
    rows = Rows([replace(deep, extra_end_step=True), replace(unique(3, 2, legacy_index=True), goal=(3, 3))])
    rows.reset()

    for k, action in enumerate([0, 0, *[2, 0] * 60]):
        rows.step(torch.tensor([action, [0, 0, 3, 0, 3, 0][min(k, 5)]]))

    assert (rows.node.tolist(), rows.state_type.tolist()) == ([2**61 - 2, 12], [END, END])
    assert (rows.reward.tolist(), rows.observation_id[1].item()) == ([1.0, 0.0], 19 + 16 % 9)
    shown = rows.step(torch.tensor([0, 0]))
    assert (shown.leaf.tolist(), shown.outcome.tolist(), rows.observation_id[0].item()) == ([2**60 - 1, 8], [3, 3], 0)


# The cue


@dataclass(frozen=True)
class Pays:
    """The same share at every end state."""

    share: float

    def __call__(self, arrival):
        return torch.full(arrival.leaf.shape, self.share)


def at_the_end(tasks: list[Task], goal: tuple[int, ...] = (1, 1)) -> Tensor:
    """What rows show that went to the end states of their tasks' goals while another was the goal."""
    env = CTGraphEnv(tasks)
    env.reset()
    for _ in range(6):
        env.set_goals([goal] * len(tasks))
        data = act(env, optimal(env))
    assert (env.state_type == END).all()
    return data["observation"]


CUES = {1.49: (122, 254), 1.0: (254, 254), 0.5: (127, 127), 0.0: (0, 0), -1 / 3: (172, 0), -1.0: (2, 0), -2.0: (4, 0)}
"""Shares of the goal's reward, and the brightness of white 254 where it wraps and where it saturates."""


@pytest.mark.parametrize("wraps", [True, False])
def test_the_cue_is_the_middle_of_the_image_at_white_times_the_share_cut_off(wraps):
    tasks = [replace(surjective(reward_cue=True, cue_wraps=wraps), reward_fn=Pays(share)) for share in CUES]
    tasks = [replace(task, goal_reward=8.0, images=ReferenceImages(5)) for task in tasks]

    shown = at_the_end(tasks)[:, 0]

    inside = torch.zeros(12, 12, dtype=torch.bool)
    inside[3:9, 3:9] = True
    expected = torch.tensor([levels[not wraps] for levels in CUES.values()], dtype=torch.uint8)
    assert torch.equal(shown[:, inside], expected.unsqueeze(-1).expand(-1, 36))
    assert torch.equal(shown[:, ~inside], ReferenceImages(5).images[4, ~inside].expand(len(tasks), -1))


@pytest.mark.parametrize(("noise", "levels"), [(0.05, [253, 126]), (10.5, [243, 121]), (254, [0, 0])])
def test_the_noise_of_the_image_set_lowers_the_white_of_the_cue(noise, levels):
    tasks = [replace(surjective(**LEGACY), reward_fn=Pays(share)) for share in (1.0, 0.5)]

    shown = at_the_end([replace(task, images=ReferenceImages(5, noise=noise)) for task in tasks])

    assert shown[:, 0, 6, 6].tolist() == levels


def test_the_linear_reward_of_three_branches_shows_negative_shares_modulo_256():
    goals = list(product((1, 2, 3), repeat=2))
    tasks = [replace(surjective(3, 2, goal=goal, **LEGACY), reward_fn=ReferenceLinear()) for goal in goals]

    shown = at_the_end(tasks)[:, 0, 6, 6].tolist()

    thirds = [3 - 2 * (first - 1) - (second - 1) for first, second in goals]
    assert thirds == [3, 2, 1, 1, 0, -1, -1, -2, -3]
    assert shown == [254, 169, 84, 84, 0, 256 - 84, 256 - 84, 256 - 169, 256 - 254]


def test_vectors_have_254_at_the_id_and_the_cue_at_the_place_after_the_ids_of_their_own_task():
    sizes, shares = [16, 20, 33, 16], [0.5, 1.49, -1.0, 0.0]
    tasks = [
        replace(confounding(**{**LEGACY, "cue_wraps": k != 2}), images=ReferenceOneHot(size), reward_fn=Pays(share))
        for k, (size, share) in enumerate(zip(sizes, shares, strict=True))
    ]
    env = CTGraphEnv([replace(task, extra_end_step=True) for task in tasks])
    data, levels = env.reset(), [[0] * 4] * 6 + [[127, 122, 0, 0], [0] * 4]

    for level in levels:
        expected = torch.zeros(4, 34, dtype=torch.uint8)
        expected[range(4), env.observation_id] = 254
        expected[range(4), sizes] = torch.tensor(level, dtype=torch.uint8)
        assert torch.equal(data["observation"], expected)
        data = act(env, optimal(env)) if not data["done"].any() else data

    assert data["done"].all()
    assert env.observation_spec["observation"].is_in(data["observation"])


# Noise before rotation


@pytest.mark.parametrize("read_on", [{"read_rotation": 45}, {"read_noise": 30}, {}])
def test_without_noise_or_rotation_their_order_makes_no_difference(read_on):
    late, early = (
        Rows([confounding(p=0.5, noise_before_rotation=value, **read_on), SWITCHED[0]], seed=3)
        for value in (True, False)
    )

    data = [seen(rows, scripts(40, 2)) for rows in (late, early)]

    assert all(torch.equal(*pair) for pair in zip(*data, strict=True))


def test_what_the_rotation_turns_in_from_outside_is_black_after_the_noise_and_noisy_before_it():
    tasks = [surjective(read_noise=99, read_rotation=45, noise_before_rotation=late) for late in (True, False)]
    late, early = (CTGraphEnv([task] * 3000, seed=4).reset()["observation"][:, 0] for task in tasks)
    angle = draw(torch.tensor(4), torch.arange(3000), torch.tensor(1), STREAM_STEP)[3] * 46 >> 32

    white = torch.full((1, 12, 12), 255, dtype=torch.uint8)
    outside = torch.cat([rotate(white, degrees) for degrees in range(46)])[angle] == 0

    assert outside[angle == 45].sum(1).max() > 2 and not outside[angle == 0].any()
    assert not late[outside].any()
    assert is_uniform(early[outside].bincount(minlength=100).tolist())


def test_noise_before_the_rotation_is_uniform_where_the_angle_is_zero():
    task = replace(read(), observations=Observations((2, 2), (3, 3), (4, 4), read_noise=20, read_rotation=3, **LEGACY))
    images = ReferenceImages(5, noise=20)
    rows = Rows([replace(task, images=images)] * 1600, seed=6)
    angle = draw(torch.tensor(6), torch.arange(1600), torch.tensor(1), STREAM_STEP)[3] * 4 >> 32

    noise = rows.reset().observation[angle == 0, 0].long() - images.images[0]

    assert is_uniform(angle.bincount(minlength=4).tolist())
    assert is_uniform(noise.flatten().bincount(minlength=21).tolist())
