"""Shifts move outwards over what is computed cell by cell: one read a neighbor and value, shared by all rules."""

from __future__ import annotations

from powderdsl.ir.build import Builder
from powderdsl.ir.ops import Node
from powderdsl.ir.rewrite import Rewrite


def _shift_of_shift(node: Node, build: Builder) -> Node | None:
    """shift(shift(x, a), b) = shift(x, a + b), where both wrap."""
    if node.op == "shift" and node.args[0].op == "shift":
        inner = node.args[0]
        (dy, dx, wraps), (ey, ex, inner_wraps) = node.attr, inner.attr
        if wraps and inner_wraps:
            return build.shift(inner.args[0], (dy + ey, dx + ex))
    return None


def _in_set_of_shift(node: Node, build: Builder) -> Node | None:
    """shift(x) in S = shift(x in S): a flag is a fraction of a number, and the question is asked once."""
    if node.op == "in_set" and node.args[0].op == "shift":
        inner = node.args[0]
        dy, dx, wraps = inner.attr
        if wraps:
            return build.shift(build.in_set(inner.args[0], node.attr), (dy, dx))
    return None


def _compare_of_shift(node: Node, build: Builder) -> Node | None:
    """shift(x) < c = shift(x < c)."""
    if node.op in ("eq", "lt", "le"):
        a, b = node.args
        for moved, other, flipped in ((a, b, False), (b, a, True)):
            if moved.op == "shift" and other.op == "const" and moved.attr[2]:
                pair = (other, moved.args[0]) if flipped else (moved.args[0], other)
                dy, dx, _ = moved.attr
                return build.shift(build.compare(node.op, *pair), (dy, dx))
    return None


def _not_of_shift(node: Node, build: Builder) -> Node | None:
    """not shift(x) = shift(not x), so that both meet what they combine with on one side."""
    if node.op == "not" and node.args[0].op == "shift" and node.args[0].attr[2]:
        dy, dx, _ = node.args[0].attr
        return build.shift(build.not_(node.args[0].args[0]), (dy, dx))
    return None


def _join_shifts(node: Node, build: Builder) -> Node | None:
    """shift(a) and shift(b) = shift(a and b), where both look the same way."""
    if node.op in ("and", "or", "xor"):
        a, b = node.args
        if a.op == b.op == "shift" and a.attr == b.attr and a.attr[2]:
            dy, dx, _ = a.attr
            return build.shift(build.make(node.op, node.type, a.args[0], b.args[0]), (dy, dx))
    return None


SHARE: tuple[Rewrite, ...] = (
    _shift_of_shift,
    _in_set_of_shift,
    _compare_of_shift,
    _not_of_shift,
    _join_shifts,
)
