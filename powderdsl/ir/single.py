"""Float32 arithmetic on Python's numbers, which are float64: round after each operation, and the result is exact.

Sums, differences, products, quotients and roots of float32 values that are rounded to float64 and then to float32 are
rounded correctly (Figueroa 1995: 53 bits are at least 2·24 + 2).
"""

from __future__ import annotations

import math
import struct
from array import array


def single(value: float) -> float:
    """The nearest float32; infinite beyond the largest."""
    return array("f", (value,))[0]


def all_ones(value: float) -> bool:
    """True if all bits of the fraction of the float32 are ones."""
    return int.from_bytes(struct.pack("<f", value), "little") & 0x7FFFFF == 0x7FFFFF


def stepped(value: float, by: int) -> float:
    """The float32 that is `by` steps away from a finite float32 of at least 0."""
    (bits,) = struct.unpack("<I", struct.pack("<f", abs(value)))
    return struct.unpack("<f", struct.pack("<I", bits + by))[0]


def square_root(value: float) -> float:
    """The square root; NaN below 0."""
    return single(math.sqrt(value)) if value >= 0 else math.nan


def smaller(a: float, b: float) -> float:
    """The minimum; NaN if either is."""
    return math.nan if a != a or b != b else min(a, b)


def larger(a: float, b: float) -> float:
    """The maximum; NaN if either is."""
    return math.nan if a != a or b != b else max(a, b)
