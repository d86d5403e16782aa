"""Shifts move outwards over what is computed cell by cell: one read a neighbor and value, shared by all rules."""

from __future__ import annotations

from powderdsl.ir.build import Builder
from powderdsl.ir.ops import Node
from powderdsl.ir.rewrite import Rules

SHARE = Rules()


def _wraps(node: Node) -> bool:
    return node.op == "shift" and node.attr[2]


@SHARE.on("shift")
def _shift_of_shift(node: Node, build: Builder) -> Node | None:
    """shift(shift(x, a), b) = shift(x, a + b), where both wrap."""
    (inner,) = node.args
    if not (_wraps(node) and _wraps(inner)):
        return None
    (dy, dx, _), (ey, ex, _) = node.attr, inner.attr
    return build.shift(inner.args[0], (dy + ey, dx + ex))


@SHARE.on("in_set", "not", "and", "or", "xor", "eq", "lt", "le")
def _of_shifts(node: Node, build: Builder) -> Node | None:
    """shift(a) and shift(b) = shift(a and b), not shift(a) = shift(not a), shift(x) < c = shift(x < c).

    What is combined then stands on one side, and a flag is a fraction of a number: the question is asked once.
    """
    shifts = [arg for arg in node.args if _wraps(arg)]
    compares = node.op in ("eq", "lt", "le")
    others = [arg for arg in node.args if not (compares and arg.op == "const") and not _wraps(arg)]
    if not shifts or others or (compares and len(shifts) > 1) or len({arg.attr for arg in shifts}) > 1:
        return None
    args = tuple(arg.args[0] if _wraps(arg) else arg for arg in node.args)
    return build.shift(build.rebuild(node, args), shifts[0].attr[:2])
