"""Floats of which more is known than their type: how small and how large they get, and so which operations are exact."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from powderdsl.ir.ops import REAL, SNAP, Node, ordered
from powderdsl.schedule.rewrite import map_values
from powderdsl.schedule.types import Compute, Guard, Schedule, Statement

DIGITS = 23
"""Binary places of a float32 after the first."""

LEAST, MOST = -126, 127
"""Exponents of normal float32 values."""


@dataclass(frozen=True)
class Size:
    """A float is 0, or of a magnitude from 2^least to 2^most; in any case it is a multiple of 2^grid."""

    grid: int
    least: int
    most: int


ZERO = Size(MOST, MOST, LEAST)


def exact(schedule: Schedule) -> Schedule:
    """Products that are exact become part of the sum; divisions by constants that stay far from the limits are marked.

    `a + b * 0.5` → `fused(a, b, 0.5)`, rounded once: equal, since `b * 0.5` is exact where it is not below normal
    floats. `a / 18` → `ratio(a, 18)`. Slots hold 0 or magnitudes from SNAP on: that bounds everything computed of them.
    """
    graph = schedule.graph
    known = _sizes(schedule)

    def product(node: Node) -> tuple[Node, float] | None:
        """An exact product with a power of two."""
        if node.op != "mul":
            return None
        for value, factor in (node.args, node.args[::-1]):
            size = known.of(value)
            if factor.op == "const" and factor.attr and size is not None:
                part, exponent = math.frexp(float(factor.attr))
                moved = (size.least + exponent - 1, size.most + exponent)
                if abs(part) == 0.5 and LEAST <= moved[0] and moved[1] <= MOST:
                    return value, float(factor.attr)
        return None

    def rule(node: Node) -> Node | None:
        if node.type != REAL:
            return None
        if node.op in ("add", "sub"):
            first, second = node.args
            if found := product(second):
                value, factor = found
                sign = -1.0 if node.op == "sub" else 1.0
                return graph.node("fused", REAL, (first, value, graph.node("const", REAL, (), sign * factor)))
            if node.op == "add" and (found := product(first)):
                return graph.node("fused", REAL, (second, found[0], graph.node("const", REAL, (), found[1])))
        if node.op == "div" and node.args[1].op == "const" and node.args[1].attr:
            size = known.of(node.args[0])
            if size is not None and _is_near(size, _constant(float(node.args[1].attr))):
                return graph.node("ratio", REAL, node.args)
        return None

    return map_values(schedule, rule)


def _is_near(dividend: Size, divisor: Size) -> bool:
    """Whether a quotient can be made of products: it is normal, and so is what a product of it leaves of the dividend.

    That rest is a multiple of the last binary place of the quotient times that of the divisor.
    """
    least, most = dividend.least - divisor.most - 1, dividend.most - divisor.least + 1
    return LEAST <= least - DIGITS + divisor.grid and LEAST <= least and most < MOST


class _Sizes:
    def __init__(self, variables: dict[str, Size | None]):
        self.variables = variables
        self.memo: dict[int, tuple[Node, Size | None]] = {}

    def of(self, root: Node) -> Size | None:
        """The size of a float; None if nothing is known."""
        for node in ordered([root]):
            if id(node) not in self.memo and node.type == REAL:
                size = self.node(node)
                self.memo[id(node)] = (node, None if size is None else _rounded(size))
        return self.memo[id(root)][1]

    def node(self, node: Node) -> Size | None:
        if node.op == "load":
            return self.variables.get(str(node.attr))
        if node.op == "const":
            return _constant(float(node.attr))
        if node.op == "settle":
            return _settled(*node.attr)
        args = [self.memo[id(arg)][1] for arg in node.args if arg.type == REAL]
        sizes = [arg for arg in args if arg is not None]
        if len(sizes) < len(args) or not args:
            return None
        match node.op:
            case "shift" | "select" | "neg" | "abs" | "min" | "max":
                return _joined(sizes)
            case "add" | "sub":
                grid = min(size.grid for size in sizes)
                return Size(grid, grid, max(size.most for size in sizes) + 1)
            case "mul":
                a, b = sizes
                least = a.least + b.least
                return Size(max(a.grid + b.grid, least - DIGITS), least, a.most + b.most)
            case "fused":
                a, b, c = sizes
                grid = min(a.grid, b.grid + c.grid)
                return Size(grid, grid, max(a.most, b.most + c.most) + 1)
            case "div" | "ratio" if node.args[1].op == "const" and node.args[1].attr:
                a, b = sizes
                least = a.least - b.most - 1
                return Size(least - DIGITS, least, a.most - b.least + 1)
        return None


def _sizes(schedule: Schedule) -> _Sizes:
    """The sizes of all variables. A variable of a guard may also be the old one."""
    values: dict[str, list[Node]] = {}
    for name, value in _assigned(schedule.body):
        values.setdefault(name, []).append(value)
    slots = dict(schedule.finds)
    bounds = {
        slots[slot].name: value.attr
        for slot, node in schedule.leaves
        if slot in slots and node.type == REAL and node.op == "load"
        for value in values.get(str(node.attr), ())
        if value.op == "settle"
    }
    known: dict[str, Size | None] = {
        var.name: _settled(*bounds.get(var.name, (-(2.0**MOST), 2.0**MOST)))
        for var in slots.values()
        if var.type == REAL
    }
    found = _Sizes(known)
    for name, roots in values.items():
        sizes = [found.of(root) for root in roots]
        known[name] = _joined([size for size in sizes if size is not None]) if None not in sizes else None
    return found


def _assigned(body: Sequence[Statement]) -> Iterator[tuple[str, Node]]:
    """The values of variables that are floats, in order."""
    for statement in body:
        match statement:
            case Compute(outs):
                for out in outs:
                    values = (out.value, out.otherwise) if out.otherwise is not None else (out.value,)
                    yield from ((out.var.name, value) for value in values if out.var.type == REAL)
            case Guard(_, inner, keeps):
                yield from _assigned(inner)
                yield from ((var.name, value) for var, value in keeps if var.type == REAL)


def _joined(sizes: list[Size]) -> Size:
    return Size(min(s.grid for s in sizes), min(s.least for s in sizes), max(s.most for s in sizes))


def _constant(value: float) -> Size:
    if not value or not math.isfinite(value):
        return ZERO if not value else Size(LEAST, LEAST, MOST)
    exponent = math.frexp(value)[1]
    top, bottom = abs(value).as_integer_ratio()
    grid = (top & -top).bit_length() - bottom.bit_length()
    return Size(grid, exponent - 1, exponent)


def _settled(lo: float, hi: float) -> Size:
    least = math.frexp(SNAP)[1] - 1
    return Size(least - DIGITS, least, math.frexp(max(abs(lo), abs(hi), SNAP))[1])


def _rounded(size: Size) -> Size | None:
    """What follows from another: a multiple of 2^n is at least that large; None where floats are not normal."""
    least = max(size.least, size.grid)
    grid = max(size.grid, least - DIGITS)
    return Size(grid, least, size.most) if least >= LEAST and size.most <= MOST else None
