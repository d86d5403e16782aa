"""Vectors of integers as one large integer of Python: a lane of 8, 16, 32 or 64 bits for each element.

Python adds, shifts and combines large integers in C, so that an operation on a vector takes a few nanoseconds for each
element. Lanes wrap around as NumPy's integers do. Signed ones are in two's complement.
"""

from __future__ import annotations

from functools import lru_cache

_FLAG = bytes([0]) + bytes([1]) * 255


class Lanes:
    """The operations on vectors of `count` lanes of `size` bytes each. Memory is little-endian."""

    def __init__(self, count: int, size: int):
        self.count, self.size, self.bits, self.length = count, size, 8 * size, count * size
        self.ones = int.from_bytes((b"\1" + bytes(size - 1)) * count, "little")
        self.top = self.ones << (self.bits - 1)
        self.all = (1 << (8 * self.length)) - 1
        self.low = self.all ^ self.top

    def read(self, raw: bytes) -> int:
        return int.from_bytes(raw, "little")

    def write(self, vector: int) -> bytes:
        return vector.to_bytes(self.length, "little")

    def filled(self, value: int) -> int:
        """The same value in every lane; it may be negative."""
        return self.ones * (value & ((1 << self.bits) - 1))

    def flags(self, tops: int) -> bytes:
        """A byte of 0 or 1 for each lane, from the highest bits of the lanes; no other bits may be set."""
        if self.size == 1:
            return (tops >> 7).to_bytes(self.length, "little")
        return tops.to_bytes(self.length, "little")[self.size - 1 :: self.size].translate(_FLAG)

    def mask(self, flags: bytes) -> int:
        """Lanes of ones only where a flag is 1."""
        wide = bytearray(self.length)
        wide[:: self.size] = flags
        return int.from_bytes(wide, "little") * ((1 << self.bits) - 1)

    def add(self, a: int, b: int) -> int:
        return ((a & self.low) + (b & self.low)) ^ ((a ^ b) & self.top)

    def carries(self, a: int, b: int, total: int) -> int:
        """The highest bit of each lane whose unsigned sum did not fit."""
        return ((a & b) | ((a | b) & (self.all ^ total))) & self.top

    def subtract(self, a: int, b: int) -> int:
        return ((a | self.top) - (b & self.low)) ^ ((a ^ b ^ self.top) & self.top)

    def borrows(self, a: int, b: int, difference: int) -> int:
        """The highest bit of each lane in which unsigned a < b."""
        return (((self.all ^ a) & b) | ((self.all ^ a ^ b) & difference)) & self.top

    def less(self, a: int, b: int, signed: bool) -> int:
        """The highest bit of each lane in which a < b."""
        if signed:
            a, b = a ^ self.top, b ^ self.top
        return self.borrows(a, b, self.subtract(a, b))

    def nonzero(self, a: int) -> int:
        """The highest bit of each lane that is not 0."""
        return (((a & self.low) + self.low) | a) & self.top

    def multiply(self, a: int, factor: int) -> int:
        """Each lane times one number, which may be negative."""
        factor &= (1 << self.bits) - 1
        even = _even(self.count, self.size)
        odd = (a >> self.bits) & even
        return (((a & even) * factor) & even) | ((((odd * factor) & even) << self.bits) & self.all)

    def left(self, a: int, places: int) -> int:
        return (a & (self.ones * ((1 << self.bits - places) - 1))) << places

    def right(self, a: int, places: int, signed: bool) -> int:
        if signed:  # from 0 to 2^bits - 1, shifted, and back
            moved = self.right(a ^ self.top, places, False)
            return self.subtract(moved, self.filled(1 << (self.bits - 1) >> places))
        return (a >> places) & (self.ones * ((1 << self.bits - places) - 1))


@lru_cache(maxsize=64)
def lanes(count: int, size: int) -> Lanes:
    return Lanes(count, size)


@lru_cache(maxsize=64)
def _even(count: int, size: int) -> int:
    """Ones in every other lane, from the first."""
    pair = b"\xff" * size + bytes(size)
    return int.from_bytes((pair * (count // 2 + 1))[: count * size], "little")
