"""Circuits against Python's integers, on every value of small ranges; float32 without NumPy against NumPy's."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import product

import numpy as np
import pytest

from powderdsl.ir.bits import Bits, Gates
from powderdsl.ir.ops import FLAG, OPS, Node, integer, single, stepped
from tests.schedule.interpreter import World, evaluate

RANGES = [(0, 1), (0, 5), (-3, 3), (-8, 7), (-2, 9), (3, 12)]


def values_of(planes: Sequence[Node], inputs: Mapping[str, np.ndarray]) -> list[np.ndarray]:
    """The value of each node for each assignment of the inputs."""
    (count,) = {len(values) for values in inputs.values()}
    slots = {name: values[None] for name, values in inputs.items()}
    found = evaluate(planes, World((1, count), slots, {}, {}), {})
    return [found[id(plane)][0] for plane in planes]


def numbers_of(bits: Bits, inputs: Mapping[str, np.ndarray]) -> np.ndarray:
    *low, sign = (value.astype(int) for value in values_of(bits, inputs))
    return np.sum([plane << i for i, plane in enumerate(low)], axis=0) - (sign << len(low))


def variable(name: str, lo: int, hi: int, gates: Gates) -> Bits:
    type = integer(lo, hi)
    return gates.fit([gates.input(f"{name}{i}", FLAG) for i in range(type.bits)], type)


def assignments(name: str, values: np.ndarray, bits: Bits) -> dict[str, np.ndarray]:
    return {f"{name}{i}": values >> i & 1 != 0 for i in range(len(bits))}


def every_pair(first: Iterable[int], second: Iterable[int]) -> np.ndarray:
    """Two rows: all numbers of the first range with all of the second."""
    return np.array([*product(first, second)]).T


@pytest.mark.parametrize("first", RANGES)
@pytest.mark.parametrize("second", RANGES)
def test_arithmetic(first: tuple[int, int], second: tuple[int, int]) -> None:
    gates = Gates()
    a, b = variable("a", *first, gates), variable("b", *second, gates)
    total = gates.add(a, b, integer(first[0] + second[0], first[1] + second[1]))
    difference = gates.sub(a, b, integer(first[0] - second[1], first[1] - second[0]))
    x, y = every_pair(range(first[0], first[1] + 1), range(second[0], second[1] + 1))
    inputs = assignments("a", x, a) | assignments("b", y, b)
    assert (numbers_of(total, inputs) == x + y).all()
    assert (numbers_of(difference, inputs) == x - y).all()
    less, same = values_of([gates.lt(a, b), gates.eq(a, b)], inputs)
    assert (less == (x < y)).all()
    assert (same == (x == y)).all()


@pytest.mark.parametrize("first", RANGES)
@pytest.mark.parametrize("most", [1, 2, 3, 5, 8])
def test_division(first: tuple[int, int], most: int) -> None:
    gates = Gates()
    a, b = variable("a", *first, gates), variable("b", 0, most, gates)
    x, y = every_pair(range(first[0], first[1] + 1), range(1, most + 1))
    inputs = assignments("a", x, a) | assignments("b", y, b)
    found = [numbers_of(bits, inputs) for bits in gates.divide(a, b, most)]
    assert np.array_equal(found, np.divmod(x, y))


@pytest.mark.parametrize("bounds", RANGES)
def test_truth_tables(bounds: tuple[int, int]) -> None:
    gates = Gates()
    a = variable("a", *bounds, gates)
    numbers = np.arange(bounds[0], bounds[1] + 1)
    places = [int(number) & ((1 << len(a)) - 1) for number in numbers]
    every = 1 << len(numbers)
    for members in range(0, every, max(1, every // 97)):
        wanted = members >> np.arange(len(numbers)) & 1
        values = sum(int(holds) << place for holds, place in zip(wanted, places, strict=True))
        node = gates.truth_table(a, sum(1 << place for place in places), values)
        (found,) = values_of([node], assignments("a", numbers, a))
        assert np.array_equal(found, wanted != 0)


@pytest.mark.parametrize("size", [1, 2, 3, 5, 9])
def test_sums_of_flags(size: int) -> None:
    gates = Gates()
    flags = [gates.input(f"f{i}", FLAG) for i in range(size)]
    planes = gates.total([(flag, 1) for flag in flags], size.bit_length())
    values = np.array([*product((False, True), repeat=size)])
    inputs = {f"f{i}": column for i, column in enumerate(values.T)}
    assert (numbers_of(planes, inputs) == values.sum(1)).all()


def test_gates_fold() -> None:
    gates = Gates()
    a, b = gates.input("a", FLAG), gates.input("b", FLAG)
    assert gates.and_(a, gates.not_(a)) is gates.no
    assert gates.or_(a, gates.not_(a)) is gates.yes
    assert gates.derive("xor", a, a) is gates.no
    assert gates.not_(gates.not_(a)) is a
    assert gates.select(a, b, b) is b
    assert gates.and_(a, b) is gates.and_(b, a)


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
def test_floats_are_those_of_numpy(numpy: Callable[..., np.ndarray], op: str) -> None:
    with np.errstate(all="ignore"):
        wanted = numpy(A, B)
    row = OPS[op]
    pairs = [(float(a), float(b)) for a, b in zip(A, B, strict=True)]
    found = np.array([row.value(None, *pair[: len(row.args)]) for pair in pairs], np.float32)
    np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize("value", [0.0, 2.0**-149, 1.0, 0.1, 3e38])
def test_neighbors_of_floats(value: float) -> None:
    value = single(value)
    above = stepped(value, 1)
    assert above == np.nextafter(np.float32(value), np.float32(math.inf))
    assert stepped(above, -1) == value
