"""Random numbers by counter, as pure tensor functions: Philox4x32-10 (Salmon et al. 2011).

The 128-bit counter holds (ticks of the row, row, stream and block), the 64-bit key holds the seed. Different (seed,
row, stream, tick) are different inputs of a bijection per key, so no two rows share a block, and a row's draws depend
only on its seed, its number and its count of observations. Unsigned 32-bit words are held in int64.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ctgraph_rl.core import kernel

PhiloxWords = tuple[Tensor, ...]

_WORD = 0xFFFFFFFF
_MULTIPLIERS = (0xD2511F53, 0xCD9E8D57)
_KEY_STEPS = (0x9E3779B9, 0xBB67AE85)
_ROUNDS = 10

STREAM_STEP, STREAM_NOISE, STREAM_IMAGES, STREAM_REWARD, STREAM_GOAL, STREAM_TASK, STREAM_AGENT = range(7)
"""What a draw is for: a step's small draws, pixel noise, image sets, reward noise, changes of goal and of task, agents.
"""
_STREAM_SHIFT = 28  # 16 streams of 2**28 blocks each


def philox(counter: PhiloxWords, key: PhiloxWords) -> PhiloxWords:
    """Philox4x32-10: four random words for a counter of four words and a key of two, of broadcastable shapes."""
    words = (*counter, *key)
    return kernel.philox(words) if kernel.takes(*words) else by_tensors(counter, key)


def by_tensors(counter: PhiloxWords, key: PhiloxWords) -> PhiloxWords:
    """`philox` without C code."""
    c0, c1, c2, c3 = counter
    k0, k1 = key
    for _ in range(_ROUNDS):
        even_high, even_low = _product(c0, _MULTIPLIERS[0])
        odd_high, odd_low = _product(c2, _MULTIPLIERS[1])
        c0 = (odd_high ^ c1 ^ k0) & _WORD
        c1 = odd_low
        c2 = (even_high ^ c3 ^ k1) & _WORD
        c3 = even_low
        k0 = (k0 + _KEY_STEPS[0]) & _WORD
        k1 = (k1 + _KEY_STEPS[1]) & _WORD
    return c0, c1, c2, c3


def _product(a: Tensor, b: Tensor | int) -> tuple[Tensor, Tensor]:
    """The upper and the lower word of a 64-bit product of two words; the upper in the low 32 bits.

    No number may leave int64: overflow is undefined in compiled C++.
    """
    if not torch.compiler.is_compiling():
        product = a * b  # the low 64 bits are exact
        return product >> 32, product & _WORD
    rest = (a & 1) * b
    half = (a >> 1) * b + (rest >> 1)
    return half >> 31, ((half & 0x7FFFFFFF) << 1) | (rest & 1)


def draw(seed: Tensor, row: Tensor, tick: Tensor, stream: int, block: Tensor | int = 0) -> PhiloxWords:
    """Four random words per element for (seed, row, tick, stream, block).

    Args:
        seed: int64 >= 0, any shape that broadcasts with the others.
        row: int64 in [0, 2**32).
        tick: int64 >= 0.
        stream: one of the ``STREAM_*`` constants.
        block: in [0, 2**28), for more than four words.
    """
    last = block + (stream << _STREAM_SHIFT)
    if not isinstance(last, Tensor):  # `torch.full` writes on the device, where `torch.as_tensor` copies from the CPU
        last = torch.full((), last, dtype=torch.int64, device=tick.device)
    counter = (tick & _WORD, tick >> 32, row, last)
    key = (seed & _WORD, seed >> 32)
    return philox(counter, key)


_GOLDEN = -0x61C8864680B583EB  # 0x9E3779B97F4A7C15 and the two factors as signed 64-bit integers
_MIX = (-0x40A7B892E31B1A47, -0x6B2FB644ECCEEE15)


def splitmix64(start: Tensor, count: int) -> Tensor:
    """SplitMix64 (Steele, Lea and Flood 2014): the first ``count`` numbers for each start; cheap noise.

    Args:
        start: int64 [...], the seed of each sequence.

    Returns:
        int64 [..., count], all 64 bits random.
    """
    return splitmix64_at(start.unsqueeze(-1), torch.arange(count, device=start.device))


def splitmix64_at(start: Tensor, place: Tensor) -> Tensor:
    """The number at a place in `splitmix64`; int64 tensors that broadcast."""
    z = start + _GOLDEN * (place + 1)
    z.bitwise_xor_((z >> 30).bitwise_and_(0x3FFFFFFFF)).mul_(_MIX[0])
    z.bitwise_xor_((z >> 27).bitwise_and_(0x1FFFFFFFFF)).mul_(_MIX[1])
    return z.bitwise_xor_((z >> 31).bitwise_and_(0x1FFFFFFFF))


def randint(word: Tensor, high: Tensor | int) -> Tensor:
    """A word as an integer in [0, high); probabilities are off by less than 2**-32."""
    return (word * high) >> 32


def randint_wide(words: tuple[Tensor, Tensor], high: Tensor) -> Tensor:
    """Two words as an integer in [0, high), high <= 2**62; probabilities are off by less than 2**-64."""
    upper, lower = words
    high_upper = high >> 32
    high_lower = high & _WORD
    middle_high, middle_low = _product(upper, high_lower)
    low_high, _ = _product(lower, high_lower)
    carry = (low_high & _WORD) + middle_low + lower * high_upper
    return upper * high_upper + (middle_high & _WORD) + (carry >> 32)


_NORMAL_CELLS = 256
_NORMAL_UNIT = 2.0**-20


def normal_table() -> Tensor:
    """Upper-tail quantiles of the normal distribution at (1 + i / 256) 2**e, e = -1..30; float64."""
    cell = torch.arange(32 * _NORMAL_CELLS + 1, dtype=torch.float64, device="cpu")
    octave = (cell / _NORMAL_CELLS).floor()
    tail = (1 + cell / _NORMAL_CELLS - octave) * 2 ** (octave - 1 - 32)
    return (-torch.special.ndtri(tail) / _NORMAL_UNIT).round() * _NORMAL_UNIT


def normal(word: Tensor, table: Tensor) -> Tensor:
    """A word as a standard normal number, a multiple of 2**-20 up to 6.3 in size; float64.

    The inverse distribution function by linear interpolation in 256 cells per octave of the tail. Every operation is
    exact in float64, so devices and compiled code agree bit by bit.
    """
    tail = (word >> 1).to(torch.float64) + 0.5
    bits = tail.view(torch.int64)  # of a double: octave, cell, place in it
    cell = (bits >> 44) - (1022 << 8)
    place = (bits & ((1 << 44) - 1)).to(torch.float64) * 2.0**-44
    low = table[cell]
    high = table[cell + 1]
    size = low + (high - low) * place
    size = (size / _NORMAL_UNIT).round() * _NORMAL_UNIT
    return torch.where((word & 1).bool(), size, -size)
