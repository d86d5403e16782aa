"""Circuits against Python's integers, on every value of small ranges; float32 without NumPy against NumPy's."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import product
from operator import and_, not_, or_, xor

import numpy as np
import pytest

from powderdsl.ir import single
from powderdsl.ir.bits import Bits, Gates
from powderdsl.ir.ops import FLAG, OPS, Node, integer

RANGES = [(0, 1), (0, 5), (-3, 3), (-8, 7), (-2, 9), (3, 12)]


def value_of(node: Node, inputs: dict[str, bool], known: dict[int, bool] | None = None) -> bool:
    known = {} if known is None else known
    if id(node) not in known:
        known[id(node)] = evaluate(node, [value_of(arg, inputs, known) for arg in node.args], inputs)
    return known[id(node)]


def evaluate(node: Node, args: list[bool], inputs: dict[str, bool]) -> bool:
    if node.op in ("input", "const"):
        return inputs[node.attr] if node.op == "input" else bool(node.attr)
    return bool(MEANING[node.op](*args))


MEANING: dict[str, Callable[..., bool]] = {
    "not": not_,
    "and": and_,
    "or": or_,
    "xor": xor,
    "select": lambda condition, yes, no: yes if condition else no,
}


def number_of(bits: Bits, inputs: dict[str, bool]) -> int:
    known: dict[int, bool] = {}
    total = sum(value_of(plane, inputs, known) << i for i, plane in enumerate(bits))
    return total - (value_of(bits[-1], inputs, known) << len(bits))


def variable(name: str, lo: int, hi: int, gates: Gates) -> Bits:
    type = integer(lo, hi)
    return gates.fit([gates.input(f"{name}{i}", FLAG) for i in range(type.bits)], type)


def assignment(name: str, value: int, bits: Bits) -> dict[str, bool]:
    return {f"{name}{i}": bool(value >> i & 1) for i in range(len(bits))}


@pytest.mark.parametrize("first", RANGES)
@pytest.mark.parametrize("second", RANGES)
def test_arithmetic(first: tuple[int, int], second: tuple[int, int]) -> None:
    gates = Gates()
    a, b = variable("a", *first, gates), variable("b", *second, gates)
    total = gates.add(a, b, integer(first[0] + second[0], first[1] + second[1]))
    difference = gates.sub(a, b, integer(first[0] - second[1], first[1] - second[0]))
    less, same = gates.lt(a, b), gates.eq(a, b)
    for x, y in product(range(first[0], first[1] + 1), range(second[0], second[1] + 1)):
        inputs = assignment("a", x, a) | assignment("b", y, b)
        assert number_of(total, inputs) == x + y
        assert number_of(difference, inputs) == x - y
        assert value_of(less, inputs) == (x < y)
        assert value_of(same, inputs) == (x == y)


@pytest.mark.parametrize("first", RANGES)
@pytest.mark.parametrize("most", [1, 2, 3, 5, 8])
def test_division(first: tuple[int, int], most: int) -> None:
    gates = Gates()
    a, b = variable("a", *first, gates), variable("b", 0, most, gates)
    quotient, rest = gates.divide(a, b, most)
    for x, y in product(range(first[0], first[1] + 1), range(1, most + 1)):
        inputs = assignment("a", x, a) | assignment("b", y, b)
        assert (number_of(quotient, inputs), number_of(rest, inputs)) == divmod(x, y)


@pytest.mark.parametrize("bounds", RANGES)
def test_truth_tables(bounds: tuple[int, int]) -> None:
    lo, hi = bounds
    gates = Gates()
    a = variable("a", lo, hi, gates)
    count = len(a)
    every = 1 << (hi - lo + 1)
    for members in range(0, every, max(1, every // 97)):
        matters = values = 0
        for number in range(lo, hi + 1):
            place = number & ((1 << count) - 1)
            matters |= 1 << place
            values |= (members >> (number - lo) & 1) << place
        node = gates.truth_table(a, matters, values)
        for number in range(lo, hi + 1):
            assert value_of(node, assignment("a", number, a)) == bool(members >> (number - lo) & 1)


@pytest.mark.parametrize("size", [1, 2, 3, 5, 9])
def test_sums_of_flags(size: int) -> None:
    gates = Gates()
    flags = [gates.input(f"f{i}", FLAG) for i in range(size)]
    planes = gates.total([(flag, 1) for flag in flags], size.bit_length())
    for values in product((False, True), repeat=size):
        inputs = {f"f{i}": v for i, v in enumerate(values)}
        assert number_of(planes, inputs) == sum(values)


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
    value = single.single(value)
    above = single.stepped(value, 1)
    assert above == np.nextafter(np.float32(value), np.float32(math.inf))
    assert single.stepped(above, -1) == value
