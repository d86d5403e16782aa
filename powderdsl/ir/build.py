"""Constructors of IR nodes: types and ranges follow from the arguments."""

from __future__ import annotations

from collections.abc import Hashable

from powderdsl.ir.ops import FLAG, REAL, Graph, Node, Offset, Type, integer


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

    def arithmetic(self, op: str, a: Node, b: Node) -> Node:
        if a.type == REAL:
            return self.make(op, REAL, a, b)
        (al, ah), (bl, bh) = (a.type.lo, a.type.hi), (b.type.lo, b.type.hi)
        match op:
            case "add":
                type = integer(al + bl, ah + bh)
            case "sub":
                type = integer(al - bh, ah - bl)
            case "mul":
                corners = [x * y for x in (al, ah) for y in (bl, bh)]
                type = integer(min(corners), max(corners))
            case "min":
                type = integer(min(al, bl), min(ah, bh))
            case _:
                type = integer(max(al, bl), max(ah, bh))
        return self.make(op, type, a, b)

    def neg(self, a: Node) -> Node:
        return self.make("neg", REAL if a.type == REAL else integer(-a.type.hi, -a.type.lo), a)

    def abs(self, a: Node) -> Node:
        if a.type == REAL:
            return self.make("abs", REAL, a)
        low = 0 if a.type.lo <= 0 <= a.type.hi else min(abs(a.type.lo), abs(a.type.hi))
        return self.make("abs", integer(low, max(abs(a.type.lo), abs(a.type.hi))), a)

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
            a = self.arithmetic("max", a, self.integer(lo))
        if a.type.hi > hi:
            a = self.arithmetic("min", a, self.integer(hi))
        return a

    # Neighbors, choices, movements

    def shift(self, a: Node, offset: Offset, wraps: bool = True) -> Node:
        if offset == (0, 0):
            return a
        type = a.type
        if type.name == "int" and not wraps:
            type = integer(min(type.lo, 0), max(type.hi, 0))
        return self.make("shift", type, a, attr=(*offset, wraps))

    def joined(self, a: Type, b: Type) -> Type:
        return integer(min(a.lo, b.lo), max(a.hi, b.hi)) if a.name == "int" else a

    def select(self, condition: Node, yes: Node, no: Node) -> Node:
        return self.make("select", self.joined(yes.type, no.type), condition, yes, no)

    def move(self, op: str, content: Node, movers: Node, rest: Node, offset: Offset) -> Node:
        """`swap` or `arrive`."""
        return self.make(op, self.joined(content.type, rest.type), content, movers, rest, attr=offset)
