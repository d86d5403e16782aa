"""`numpy.random.default_rng`: the same numbers from the same seeds, by PCG64."""

from __future__ import annotations

from collections.abc import Sequence
from math import prod
from typing import Any

from powderdsl.arrays.dtypes import float64, int64
from powderdsl.arrays.memories import packed
from powderdsl.arrays.ndarray import made, result

_MASK32, _MASK64, _MASK128 = (1 << 32) - 1, (1 << 64) - 1, (1 << 128) - 1
_MULTIPLIER = 0x2360ED051FC65DA44385DF649FCCF645


class Generator:
    """Random numbers from a seed, an integer of 0 or more or several."""

    def __init__(self, seed: int | Sequence[int]):
        first, second, third, fourth = _seeds(_words(seed))
        self._add = ((third << 64 | fourth) << 1 | 1) & _MASK128
        self._state = (self._add + (first << 64 | second)) & _MASK128
        self._advance()
        self._half: int | None = None

    def _advance(self) -> None:
        self._state = (self._state * _MULTIPLIER + self._add) & _MASK128

    def _next(self) -> int:
        """64 random bits."""
        self._advance()
        value, turn = (self._state >> 64 ^ self._state) & _MASK64, self._state >> 122
        return (value >> turn | value << (64 - turn)) & _MASK64

    def _next_half(self) -> int:
        """32 random bits; the upper half of a number is kept for the next call."""
        if self._half is not None:
            half, self._half = self._half, None
            return half
        value = self._next()
        self._half = value >> 32
        return value & _MASK32

    def random(self, size: Any = None) -> Any:
        """float64 in [0, 1)."""
        shape = _sides(size)
        values = [(self._next() >> 11) * 2.0**-53 for _ in range(prod(shape))]
        return _shaped(values, shape, size, float64)

    def integers(self, low: int, high: int | None = None, size: Any = None) -> Any:
        """int64 from `low` up to, and without, `high`; from 0 if there is one bound."""
        first, end = (0, int(low)) if high is None else (int(low), int(high))
        if end <= first:
            raise ValueError("low >= high")
        shape = _sides(size)
        values = [first + self._below(end - first) for _ in range(prod(shape))]
        return _shaped(values, shape, size, int64)

    def _below(self, count: int) -> int:
        """One of the numbers below `count`, each as likely as the others (Lemire's method)."""
        if count == 1:
            return 0
        bits, draw = (32, self._next_half) if count <= 1 << 32 else (64, self._next)
        span = 1 << bits
        if count == span:
            return draw()
        product = draw() * count
        if product & (span - 1) < count:
            least = (span - count) % count
            while product & (span - 1) < least:
                product = draw() * count
        return product >> bits


def default_rng(seed: int | Sequence[int]) -> Generator:
    return Generator(seed)


def _sides(size: Any) -> tuple[int, ...]:
    return () if size is None else (size,) if isinstance(size, int) else tuple(size)


def _shaped(values: list[Any], shape: tuple[int, ...], size: Any, kind: Any) -> Any:
    return result((), kind, packed(values, kind)) if size is None else made(shape, kind, packed(values, kind))


def _words(seed: int | Sequence[int]) -> list[int]:
    """The seed in words of 32 bits."""
    if not isinstance(seed, int):
        return [word for one in seed for word in _words(int(one))]
    if seed < 0:
        raise ValueError("expected non-negative integer")
    words = [seed & _MASK32]
    while seed := seed >> 32:
        words.append(seed & _MASK32)
    return words


def _seeds(entropy: list[int]) -> list[int]:
    """Four numbers of 64 bits that depend on every bit of the seed (NumPy's SeedSequence)."""
    constant = 0x43B0D7E5

    def hashed(value: int) -> int:
        nonlocal constant
        value ^= constant
        constant = constant * 0x931E8875 & _MASK32
        value = value * constant & _MASK32
        return value ^ value >> 16

    def mixed(a: int, b: int) -> int:
        value = (0xCA01F9DD * a - 0x4973F715 * b) & _MASK32
        return value ^ value >> 16

    pool = [hashed(word) for word in [*entropy[:4], *[0] * (4 - len(entropy))]]
    for source in range(4):
        for place in range(4):
            if place != source:
                pool[place] = mixed(pool[place], hashed(pool[source]))
    for word in entropy[4:]:
        for place in range(4):
            pool[place] = mixed(pool[place], hashed(word))
    constant, halves = 0x8B51F9DD, []
    for number in range(8):
        value = pool[number % 4] ^ constant
        constant = constant * 0x58F38DED & _MASK32
        value = value * constant & _MASK32
        halves.append(value ^ value >> 16)
    return [low | high << 32 for low, high in zip(halves[::2], halves[1::2], strict=True)]
