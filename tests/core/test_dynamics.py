import random
from itertools import islice, product

import pytest
import torch
from helpers.oracles import DECISION, END, FAIL, HOME, WAIT, node_numbers, tree_states, tree_step

from ctgraph_rl.core.graph import CTGraph
from ctgraph_rl.core.philox import (
    STREAM_IMAGES,
    STREAM_NOISE,
    STREAM_STEP,
    by_tensors,
    draw,
    philox,
    randint,
    splitmix64,
)
from ctgraph_rl.core.reading import _NOISE_ROWS, add_noise, by_parts, by_pixel
from ctgraph_rl.core.tree import State, stays, transition
from ctgraph_rl.core.tree import tree_params as make_tree

SHAPES = list(product((2, 3), (1, 2, 3)))

KNOWN_ANSWERS = [
    ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
    ((0xFFFFFFFF,) * 4, (0xFFFFFFFF,) * 2, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
    (
        (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
        (0xA4093822, 0x299F31D0),
        (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
    ),
]
"""Counter, key and output of Philox4x32-10, published with Random123 (Salmon et al. 2011)."""


def philox_in_python(counter, key):
    """Philox4x32-10 on Python's integers."""
    c, k = list(counter), list(key)
    for _ in range(10):
        high0, low0 = divmod(0xD2511F53 * c[0], 2**32)
        high1, low1 = divmod(0xCD9E8D57 * c[2], 2**32)
        c = [high1 ^ c[1] ^ k[0], low1, high0 ^ c[3] ^ k[1], low0]
        k = [(k[0] + 0x9E3779B9) % 2**32, (k[1] + 0xBB67AE85) % 2**32]
    return tuple(c)


def tree_params(b, d, num_rows, stay_below=0):
    return make_tree(*(torch.full((num_rows,), value) for value in (b, (b**d - 1) // (b - 1), stay_below)))


def states_and_actions(b, d):
    """Every state, the ways to fail included, with every action up to b + 1 and both wait draws."""
    states = tree_states(b, d) + [(FAIL, path) for kind, path in tree_states(b, d) if kind == WAIT]
    return list(product(states, range(b + 2), (False, True)))


def as_tensors(b, d, cases):
    """Plain states as the tensors of a batch."""
    nodes = node_numbers(b, d)
    kinds, numbers = zip(*((int(kind), nodes[path]) for kind, path in cases), strict=True)
    return State(torch.tensor(kinds), torch.tensor(numbers))


@pytest.mark.parametrize("philox", [philox, by_tensors])
@pytest.mark.parametrize(("counter", "key", "expected"), KNOWN_ANSWERS)
def test_philox_meets_the_published_known_answers(philox, counter, key, expected):
    words = philox(tuple(map(torch.tensor, counter)), tuple(map(torch.tensor, key)))

    assert tuple(map(int, words)) == expected


@pytest.mark.parametrize(("counter", "key", "expected"), KNOWN_ANSWERS)
def test_the_plain_python_philox_meets_the_published_known_answers(counter, key, expected):
    assert philox_in_python(counter, key) == expected


def test_philox_equals_plain_python_on_random_words():
    source = random.Random(0)
    inputs = [[source.getrandbits(32) for _ in range(6)] for _ in range(500)]
    expected = [list(philox_in_python(row[:4], row[4:])) for row in inputs]

    columns = torch.tensor(inputs).unbind(-1)
    words = torch.stack(philox(columns[:4], columns[4:]), -1)

    assert words.tolist() == expected


@pytest.mark.parametrize("seed", [0, 1, 2**32 - 1, 2**32 + 7, 2**63 - 1])
@pytest.mark.parametrize("tick", [0, 1, 2**32 - 1, 2**32 + 3, 2**62])
def test_a_draw_is_a_philox_block_of_its_seed_row_tick_stream_and_block(seed, tick):
    row, block, stream = 2**32 - 2, 2**28 - 1, STREAM_IMAGES
    counter = (tick % 2**32, tick // 2**32, row, block + stream * 2**28)
    expected = philox_in_python(counter, (seed % 2**32, seed // 2**32))

    words = draw(torch.tensor(seed), torch.tensor(row), torch.tensor(tick), stream, block)

    assert tuple(map(int, words)) == expected


def test_no_two_draws_of_rows_ticks_streams_and_blocks_are_equal():
    rows, ticks = torch.arange(64).view(-1, 1, 1), torch.arange(32).view(1, -1, 1)

    words = [
        torch.stack(draw(torch.tensor(1), rows, ticks, stream, torch.arange(4)), -1).view(-1, 4)
        for stream in (STREAM_STEP, STREAM_NOISE, STREAM_IMAGES)
    ]

    assert len(torch.cat(words).unique(dim=0)) == 3 * 64 * 32 * 4


@pytest.mark.parametrize("high", [2, 3, 7, 360, 2**31])
def test_randint_splits_the_words_evenly_from_zero_to_high_exclusive(high):
    second_value_from = -(-(2**32) // high)
    words = torch.tensor([0, second_value_from - 1, second_value_from, 2**32 - 1])

    values = randint(words, high)

    assert values.tolist() == [0, 0, 1, high - 1]


def test_randint_below_one_is_zero():
    assert randint(torch.tensor([0, 2**32 - 1]), 1).tolist() == [0, 0]


@pytest.mark.parametrize(
    ("wait_prob", "first_word", "second_word", "expected"),
    [
        (0.0, 0, 0, False),
        (0.5, 2**31 - 1, 2**32 - 1, True),
        (0.5, 2**31, 0, False),
        (2**-63, 0, 1, True),
        (2**-63, 0, 2, False),
        (0.75, 3 * 2**30 - 1, 2**32 - 1, True),
        (0.75, 3 * 2**30, 0, False),
        (1 - 2**-53, 2**32 - 1, 2**32 - 1, False),
    ],
)
def test_a_wait_draw_stays_for_exactly_the_share_p_of_all_words(wait_prob, first_word, second_word, expected):
    tree = tree_params(2, 2, 1, int(wait_prob * 2**63))
    words = (torch.tensor([first_word]), torch.tensor([second_word]), torch.zeros(1), torch.zeros(1))

    assert stays(words, tree).tolist() == [expected]


@pytest.mark.parametrize(("b", "d"), SHAPES)
def test_every_state_and_action_leads_where_the_paper_says(b, d):
    cases = states_and_actions(b, d)
    expected = as_tensors(b, d, [tree_step(b, d, *case) for case in cases])
    states, actions, stay = zip(*cases, strict=True)

    after = transition(
        as_tensors(b, d, states), torch.tensor(actions), torch.tensor(stay), tree_params(b, d, len(cases))
    )

    assert torch.equal(after.state_type, expected.state_type)
    assert torch.equal(after.node, expected.node)


@pytest.mark.parametrize(("b", "d"), SHAPES)
def test_as_many_states_can_be_reached_as_the_closed_form_counts(b, d):
    reached, frontier = set(), {(int(HOME), 0)}
    tree = tree_params(b, d, 1)

    while frontier:
        reached |= frontier
        found = set()
        for (kind, node), action in product(frontier, range(b + 1)):
            state = State(torch.tensor([kind]), torch.tensor([node]))
            after = transition(state, torch.tensor([action]), torch.tensor([False]), tree)
            failed = int(after.state_type) == FAIL
            found.add((int(FAIL), 0) if failed else (int(after.state_type), int(after.node)))
        frontier = found - reached

    assert len(reached) == CTGraph(b, d).num_states


@pytest.mark.parametrize(
    ("kind", "action", "expected"),
    [
        (HOME, 0, WAIT),
        (HOME, 2, WAIT),
        (WAIT, 0, DECISION),
        (WAIT, 1, FAIL),
        (DECISION, 0, FAIL),
        (DECISION, 1, WAIT),
        (DECISION, 2, WAIT),
        (DECISION, 3, FAIL),
        (END, 0, END),
        (FAIL, 0, FAIL),
    ],
)
def test_the_table_of_transitions_at_the_root_of_a_binary_tree(kind, action, expected):
    state = State(torch.tensor([int(kind)]), torch.tensor([0]))

    after = transition(state, torch.tensor([action]), torch.tensor([False]), tree_params(2, 2, 1))

    assert after.state_type.tolist() == [expected]


def test_rows_of_one_batch_may_have_trees_of_their_own():
    tree = make_tree(torch.tensor([2, 3, 3]), torch.tensor([3, 1, 4]), torch.zeros(3, dtype=torch.int64))
    state = State(torch.full((3,), int(DECISION)), torch.tensor([1, 0, 0]))

    after = transition(state, torch.tensor([3, 3, 3]), torch.zeros(3, dtype=torch.bool), tree)

    assert after.state_type.tolist() == [FAIL, WAIT, WAIT]
    assert after.node.tolist() == [1, 3, 3]


def test_the_deepest_tree_has_no_overflow_on_the_way_to_its_last_leaf():
    b, d = 2, 60
    state, tree = State(torch.tensor([int(HOME)]), torch.tensor([0])), tree_params(b, d, 1)

    for action in [0, 0, *[2, 0] * d]:
        state = transition(state, torch.tensor([action]), torch.tensor([False]), tree)

    assert (int(state.state_type), int(state.node)) == (END, 2**61 - 2)


def test_the_transition_can_be_vmapped():
    b, d = 2, 2
    states, actions, stay = zip(*states_and_actions(b, d), strict=True)
    tree = tree_params(b, d, len(states))._replace(extra_end_step=torch.arange(len(states)) % 2 == 0)
    arguments = (as_tensors(b, d, states), torch.tensor(actions), torch.tensor(stay), tree)
    in_dims = type(tree)(
        *(None if field in ("next_kind", "decides", "width", "by_action", "swap") else 0 for field in tree._fields)
    )

    mapped = torch.vmap(transition, in_dims=(0, 0, 0, in_dims))(*arguments)

    assert all(torch.equal(*pair) for pair in zip(mapped, transition(*arguments), strict=True))


def test_draws_can_be_vmapped_over_rows():
    rows, seed, tick = torch.arange(8), torch.tensor(3), torch.tensor(5)

    mapped = torch.vmap(lambda row: torch.stack(draw(seed, row, tick, STREAM_STEP)))(rows)

    assert torch.equal(mapped, torch.stack(draw(seed, rows, tick, STREAM_STEP), -1))


def splitmix64_in_python(seed):
    """The published generator, number by number."""
    while True:
        seed = (seed + 0x9E3779B97F4A7C15) % 2**64
        z = (seed ^ (seed >> 30)) * 0xBF58476D1CE4E5B9 % 2**64
        z = (z ^ (z >> 27)) * 0x94D049BB133111EB % 2**64
        yield z ^ (z >> 31)


def test_splitmix64_meets_the_published_known_answers():
    known = [6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431, 16408922859458223821]

    assert [number % 2**64 for number in splitmix64(torch.tensor(1234567), 5).tolist()] == known


def test_splitmix64_equals_plain_python_for_any_start():
    starts = [0, 1, -1, 2**63 - 1, -(2**63), 123456789]

    found = splitmix64(torch.tensor(starts), 40)

    for start, numbers in zip(starts, found.tolist(), strict=True):
        assert [number % 2**64 for number in numbers] == list(islice(splitmix64_in_python(start % 2**64), 40))


@pytest.mark.parametrize("add_noise", [add_noise, by_parts, by_pixel])
def test_noise_gives_every_pixel_sixteen_bits_of_the_observations_own_sequence(add_noise):
    images = torch.zeros(2, 1, 9, 9, dtype=torch.uint8)
    words = draw(torch.tensor(9), torch.tensor([4, 5]), torch.tensor([6, 7]), STREAM_NOISE)
    expected = []
    for row, noise in enumerate((10, 255)):
        numbers = islice(splitmix64_in_python(int(words[0][row]) << 32 | int(words[1][row])), 21)
        bits = [number >> shift & 0xFFFF for number in numbers for shift in (0, 16, 32, 48)]
        expected.append([value * (noise + 1) >> 16 for value in bits[:81]])

    start = (words[0] << 32) | words[1]
    noise = add_noise(images, start, torch.tensor([10, 255]))

    assert noise.flatten(1).tolist() == expected


@pytest.mark.parametrize("add_noise", [add_noise, by_parts, by_pixel])
def test_noise_of_many_rows_is_that_of_each_part_of_them(add_noise):
    n = 2 * _NOISE_ROWS + 3
    images = torch.zeros(n, 1, 4, 4, dtype=torch.uint8)
    arguments = (torch.arange(n) * 7**20, torch.arange(n) % 256)

    whole = add_noise(images, *arguments)

    for part in (slice(0, 5), slice(_NOISE_ROWS - 2, _NOISE_ROWS + 2), slice(n - 4, n)):
        alone = add_noise(images[part], *(argument[part] for argument in arguments))
        assert torch.equal(whole[part], alone)


@pytest.mark.parametrize("branching", [(2, 3), (61, 62), (62, 63), (2, 64, 1000)])
def test_decisions_are_the_actions_up_to_each_rows_own_branching_factor(branching):
    cases = [(b, a) for b in branching for a in (-2, -1, 0, 1, 2, b - 1, b, b + 1, b + 2, 10**6)]
    factors, action = (torch.tensor(values) for values in zip(*cases, strict=True))
    tree = make_tree(factors, torch.ones_like(factors), torch.zeros_like(factors))
    state = State(torch.full_like(factors, DECISION), torch.zeros_like(factors))

    after = transition(state, action, None, tree)

    decided = [1 <= a <= b for b, a in cases]
    assert after.state_type.tolist() == [WAIT if holds else FAIL for holds in decided]
    assert after.node.tolist() == [a if holds else 0 for holds, (_, a) in zip(decided, cases, strict=True)]
