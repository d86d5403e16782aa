"""Constructors of IR nodes: types and ranges follow from the arguments."""

from __future__ import annotations

from collections.abc import Callable, Hashable

from powderdsl.ir.ops import FLAG, REAL, Graph, Node, Offset, Type, integer

Range = tuple[int, int]


def _product(a: Type, b: Type) -> Range:
    corners = [x * y for x in (a.lo, a.hi) for y in (b.lo, b.hi)]
    return min(corners), max(corners)


def _union(a: Type, b: Type) -> Range:
    return min(a.lo, b.lo), max(a.hi, b.hi)


_RANGES: dict[str, Callable[..., Range]] = {
    "add": lambda a, b: (a.lo + b.lo, a.hi + b.hi),
    "sub": lambda a, b: (a.lo - b.hi, a.hi - b.lo),
    "mul": _product,
    "min": lambda a, b: (min(a.lo, b.lo), min(a.hi, b.hi)),
    "max": lambda a, b: (max(a.lo, b.lo), max(a.hi, b.hi)),
    "neg": lambda a: (-a.hi, -a.lo),
    "abs": lambda a: (max(a.lo, -a.hi, 0), max(-a.lo, a.hi)),
    "select": lambda condition, yes, no: _union(yes, no),
    "swap": lambda content, movers, rest: _union(content, rest),
    "arrive": lambda content, movers, rest: _union(content, rest),
}
"""The ranges of integers that follow from those of the arguments."""


class Builder:
    """Makes well-typed nodes in one graph. `place` is where the rule being lowered was written."""

    def __init__(self, graph: Graph | None = None):
        self.graph = graph or Graph()
        self.place = ""

    def make(self, op: str, type: Type, *args: Node, attr: Hashable = None) -> Node:
        return self.graph.node(op, type, args, attr, (self.place,) if self.place else ())

    # Sources

    def input(self, slot: str, type: Type) -> Node:
        return self.make("input", type, attr=slot)

    def flag(self, value: bool) -> Node:
        return self.make("const", FLAG, attr=bool(value))

    def integer(self, value: int) -> Node:
        return self.make("const", integer(value, value), attr=int(value))

    def real(self, value: float) -> Node:
        return self.make("const", REAL, attr=float(value))

    def const(self, value: int | float, type: Type) -> Node:
        if type == FLAG:
            return self.flag(bool(value))
        return self.real(value) if type == REAL else self.integer(int(value))

    # Flags

    def not_(self, a: Node) -> Node:
        return self.make("not", FLAG, a)

    def and_(self, a: Node, b: Node) -> Node:
        return self.make("and", FLAG, a, b)

    def or_(self, a: Node, b: Node) -> Node:
        return self.make("or", FLAG, a, b)

    def any(self, nodes: list[Node]) -> Node:
        result = nodes[0] if nodes else self.flag(False)
        for node in nodes[1:]:
            result = self.or_(result, node)
        return result

    def in_set(self, value: Node, members: frozenset[int]) -> Node:
        return self.make("in_set", FLAG, value, attr=members)

    def compare(self, op: str, a: Node, b: Node) -> Node:
        return self.make(op, FLAG, a, b)

    # Numbers

    def derive(self, op: str, *args: Node, attr: Hashable = None) -> Node:
        """One of the operations of `_RANGES`, or the same on floats or flags."""
        last = args[-1].type
        type = integer(*_RANGES[op](*(arg.type for arg in args))) if last.name == "int" else last
        return self.make(op, type, *args, attr=attr)

    def quotient(self, a: Node, b: Node) -> Node:
        """Integer division, rounded down; 0 where b is 0."""
        (al, ah), (bl, bh) = (a.type.lo, a.type.hi), (b.type.lo, b.type.hi)
        divisors = [d for d in (bl, min(bh, -1), max(bl, 1), bh) if d and bl <= d <= bh]
        corners = [x // d for x in (al, ah) for d in divisors] + [0] * (bl <= 0 <= bh)
        return self.make("quotient", integer(min(corners), max(corners)), a, b)

    def mod(self, a: Node, modulus: int) -> Node:
        return self.make("mod", integer(0, modulus - 1), a, attr=modulus)

    def table(self, index: Node, values: tuple[int, ...]) -> Node:
        reachable = values[max(index.type.lo, 0) : index.type.hi + 1] or values
        return self.make("table", integer(min(reachable), max(reachable)), index, attr=values)

    def to_real(self, a: Node) -> Node:
        return a if a.type == REAL else self.make("to_real", REAL, a)

    def clamp(self, a: Node, lo: int, hi: int) -> Node:
        """Integers clamped to bounds, where their range asks for it."""
        if a.type.lo < lo:
            a = self.derive("max", a, self.integer(lo))
        if a.type.hi > hi:
            a = self.derive("min", a, self.integer(hi))
        return a

    # Neighbors, choices, movements

    def shift(self, a: Node, offset: Offset, wraps: bool = True) -> Node:
        if offset == (0, 0):
            return a
        type = a.type
        if type.name == "int" and not wraps:
            type = integer(min(type.lo, 0), max(type.hi, 0))
        return self.make("shift", type, a, attr=(*offset, wraps))

    def shift_uniform(self, a: Node, offset: Offset, wraps: bool) -> Node:
        """A constant or parameter at a neighbor: the same, and zero outside unless it wraps."""
        if wraps or offset == (0, 0) or (a.op == "const" and not a.attr):
            return a
        return self.select(self.make("inside", FLAG, attr=offset), a, self.const(0, a.type))

    def select(self, condition: Node, yes: Node, no: Node) -> Node:
        return self.derive("select", condition, yes, no)

    def rebuild(self, node: Node, args: tuple[Node, ...]) -> Node:
        """The same operation on other arguments; ranges are derived again where they follow from the arguments."""
        if node.op in _RANGES:
            return self.derive(node.op, *args, attr=node.attr)
        if node.op == "shift":
            dy, dx, wraps = node.attr
            return self.shift(args[0], (dy, dx), wraps)
        if node.op == "table":
            return self.table(args[0], node.attr)
        return self.make(node.op, node.type, *args, attr=node.attr)
