"""Floats as the shortest text that means the same number."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterator

from powderdsl.arrays.dtypes import dtype, float32


def shown(value: bool | int | float, kind: dtype) -> str:
    """A number of a type as NumPy prints it."""
    number = float(value)
    if kind is not float32 or not math.isfinite(number) or number == 0:
        return str(value)
    text = next(one for one in _texts(number) if array("f", [float(one)])[0] == number)
    if 1e-4 <= abs(number) < 1e6:
        return repr(float(text))  # the same digits: they are fewer than Python ever needs
    digits, _, exponent = text.partition("e")
    return f"{digits.rstrip('0').rstrip('.')}e{exponent}"


def _texts(number: float) -> Iterator[str]:
    """Texts near a number, from few digits to many."""
    power = abs(math.frexp(number)[0]) == 0.5
    for places in range(17):
        text = f"{number:.{places}e}"
        yield text
        if (
            power
        ):  # there are more numbers below it than above: the next larger text may be nearer than it looks
            digits, _, exponent = text.partition("e")
            yield f"{float(digits) + math.copysign(10.0**-places, number):.{places}f}e{exponent}"
