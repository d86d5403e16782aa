"""Float32 arithmetic without NumPy gives what NumPy gives, on all kinds of floats."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from powderdsl.ir import single
from powderdsl.ir.ops import OPS

RANDOM = np.random.default_rng(0).integers(0, 2**32, 4000, dtype=np.uint32).view(np.float32)
SPECIAL = np.array([0, 1, -1, 2.0**-149, 2.0**-126, 3.4e38, -3.4e38, np.inf, -np.inf, np.nan], np.float32)
A, B = (part.ravel() for part in np.meshgrid(np.concatenate([RANDOM[:60], SPECIAL]), SPECIAL))
A, B = np.concatenate([A, RANDOM[:2000]]), np.concatenate([B, RANDOM[2000:]])


@pytest.mark.parametrize(
    ("numpy", "op"),
    [
        (np.add, "add"),
        (np.subtract, "sub"),
        (np.multiply, "mul"),
        (lambda a, b: np.where(b == 0, np.float32(0), a / b), "div"),
        (lambda a, b: np.sqrt(a), "sqrt"),
        (np.minimum, "min"),
        (np.maximum, "max"),
    ],
)
def test_as_numpy(numpy: Callable[..., np.ndarray], op: str) -> None:
    with np.errstate(all="ignore"):
        wanted = numpy(A, B)
    row = OPS[op]
    pairs = [(float(a), float(b)) for a, b in zip(A, B, strict=True)]
    found = np.array([row.value(None, *pair[: len(row.args)]) for pair in pairs], np.float32)
    np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize("value", [0.0, 2.0**-149, 1.0, 0.1, 3e38])
def test_neighbors(value: float) -> None:
    value = single.single(value)
    above = single.stepped(value, 1)
    assert above == np.nextafter(np.float32(value), np.float32(math.inf))
    assert single.stepped(above, -1) == value
