"""What the oracle's operations on floats mean, step by step: each rounds once, to float32.

Numbers are [B, H, W], vectors [B, 2, H, W]. Another order of these steps would give other bits.
"""

from __future__ import annotations

import math
from typing import Any

from powderdsl.arrays import np

Array = np.ndarray[Any, Any]

FAN = {
    op: np.dtype("float32").type(value)
    for op, value in (("near", 0.92387953251128674), ("far", 0.38268343236508977))
}
"""cos(π/8) and cos(3π/8): the borders of the octants."""


HALF_PI = (1.5703125, 0.0004837512969970703125, 7.549789954891609e-08)
"""π/2 in three parts, the first two of so few bits that small multiples of them are exact."""

SERIES = ((-1 / 6, 1 / 120, -1 / 5040, 1 / 362880), (1 / 24, -1 / 720, 1 / 40320, -1 / 3628800))
"""Coefficients of the sine from x³ on, and of the cosine from x⁴ on."""

ROUNDER = 12582912.0
"""1.5 · 2²³: a float32 of a smaller magnitude plus this number is rounded to an integer."""


def divide(a: Array, b: Array) -> Array:
    a, b = _vector_with_number(a, b)
    return np.where(b == 0, np.float32(0), a / b)


def _vector_with_number(a: Array, b: Array) -> tuple[Array, Array]:
    """Vectors are [B, 2, H, W]: a number beside one gets an axis to match."""
    if a.ndim == b.ndim:
        return a, b
    return (a, b[:, None]) if a.ndim == 4 else (a[:, None], b)


def multiply(a: Array, b: Array) -> Array:
    a, b = _vector_with_number(a, b)
    return a * b


def length(v: Array) -> Array:
    y, x = v[:, 0], v[:, 1]
    return np.sqrt(y * y + x * x)


def wave(x: Array, *, cosine: bool) -> Array:
    """The sine or cosine of angles in radians, within 2⁻²² for those up to 1000.

    x is the q-th multiple of π/2 plus a rest, and what rounding took off the rest. Both waves follow from its series.
    """
    sine, cosine_of = ([np.float32(number) for number in row] for row in SERIES)
    rounder, whole = np.float32(ROUNDER), np.float32(1)
    q = (x * np.float32(2 / math.pi) + rounder) - rounder
    coarse, middle, fine = (q * np.float32(part) for part in HALF_PI)
    near = (x - coarse) - middle  # exact
    rest = near - fine
    small = (near - rest) - fine
    turn = q - np.float32(4) * ((q * np.float32(0.25) - np.float32(0.375) + rounder) - rounder)
    z = rest * rest
    rising = rest + (small + rest * (z * (sine[0] + z * (sine[1] + z * (sine[2] + z * sine[3])))))
    higher = z * z * (cosine_of[0] + z * (cosine_of[1] + z * (cosine_of[2] + z * cosine_of[3])))
    level = whole - (np.float32(0.5) * z + (rest * small - higher))
    odd = ((turn > np.float32(0.5)) & (turn < np.float32(1.5))) | (turn > np.float32(2.5))
    down = (turn > np.float32(0.5)) & (turn < np.float32(2.5)) if cosine else turn > np.float32(1.5)
    value = np.where(~odd if cosine else odd, level, rising)
    return np.where(down, -value, value)


def octant(v: Array) -> Array:
    """The octant of the angle acos(x / (|v| + 0.001)), by comparing x with the octants' borders."""
    y, x = v[:, 0], v[:, 1]
    reach = np.sqrt(y * y + x * x) + np.float32(0.001)
    near, far = FAN["near"] * reach, FAN["far"] * reach
    lower = np.where(x > -far, 2, np.where(x > -near, 3, 4))
    half = np.where(x > near, 0, np.where(x > far, 1, lower))
    return np.where(y < 0, (8 - half) % 8, half)
