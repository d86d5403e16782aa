"""Quotients made of products are those of a division, down to the smallest dividend for which the stage makes them."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest

from powderdsl.schedule.exact import DIGITS, LEAST, MOST, Size, _constant, _is_near


def rounded(value: Fraction) -> np.float32:
    """The nearest float32; below the normal ones only if it is exact."""
    if not value:
        return np.float32(0)
    exponent = math.frexp(float(value))[1] - DIGITS - 1
    found = np.float32(math.ldexp(round(value / Fraction(2) ** exponent), exponent))
    assert abs(found) >= 2.0**LEAST or Fraction(float(found)) == value
    return found


def by_products(dividend: np.float32, divisor: np.float32) -> np.float32:
    """What `divide_near` in vectors.hpp computes."""
    inverse = Fraction(float(np.float32(1) / divisor))
    quotient = rounded(Fraction(float(dividend)) * inverse)
    rest = Fraction(float(dividend)) - Fraction(float(quotient)) * Fraction(float(divisor))
    assert rounded(rest) == rest
    assert not rest or abs(rest) >= Fraction(2) ** LEAST
    return rounded(rest * inverse + Fraction(float(quotient)))


@pytest.mark.parametrize("divisor", [18.0, 3.0, -7.0, 0.1, 1e6, 1.0000001])
def test_quotients(divisor: float) -> None:
    random = np.random.default_rng(5)
    short = np.float32(divisor)
    size = _constant(float(short))
    near = [
        exponent for exponent in range(LEAST, MOST) if _is_near(Size(LEAST, exponent, exponent + 1), size)
    ]
    assert near == list(range(near[0], near[-1] + 1))
    assert near[0] < -60 < 60 < near[-1]  # sums of damped floats lie between
    for exponent in (near[0], 0, near[-1]):
        fractions = 1 + random.integers(0, 1 << DIGITS, 300) / (1 << DIGITS)
        for dividend in (fractions * 2.0**exponent).astype(np.float32):
            assert by_products(dividend, short) == dividend / short
