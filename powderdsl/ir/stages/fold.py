"""Constant folding and the algebra of flags. Each row's equation is its comment. Floats are never re-associated."""

from __future__ import annotations

from math import frexp

import numpy as np

from powderdsl.ir.build import Builder
from powderdsl.ir.ops import FLAG, OPS, REAL, Node
from powderdsl.ir.rewrite import Rewrite


def _is(node: Node, value: object) -> bool:
    return node.op == "const" and node.attr is value


def _not(node: Node, build: Builder) -> Node | None:
    if node.op != "not":
        return None
    (a,) = node.args
    if a.op == "const":  # not yes = no
        return build.flag(not a.attr)
    if a.op == "not":  # not not a = a
        return a.args[0]
    if a.op == "le":  # not (a ≤ b) = b < a, integers only: a NaN is neither
        return build.compare("lt", a.args[1], a.args[0]) if a.args[0].type != REAL else None
    if a.op == "lt" and a.args[0].type != REAL:  # not (a < b) = b ≤ a
        return build.compare("le", a.args[1], a.args[0])
    return None


def _and_or(node: Node, build: Builder) -> Node | None:
    if node.op not in ("and", "or"):
        return None
    a, b = node.args
    absorbing = node.op == "or"
    for x, y in ((a, b), (b, a)):
        if _is(x, absorbing):  # a and no = no, a or yes = yes
            return x
        if _is(x, not absorbing) or x is y:  # a and yes = a, a and a = a
            return y
        if x.op == "not" and x.args[0] is y:  # a and not a = no
            return build.flag(absorbing)
    if a.op == b.op == "in_set" and a.args[0] is b.args[0]:  # x in S and x in T = x in S ∩ T
        sets = (a.attr, b.attr)
        joined = sets[0] | sets[1] if absorbing else sets[0] & sets[1]
        return build.in_set(a.args[0], joined)
    return None


def _xor(node: Node, build: Builder) -> Node | None:
    if node.op != "xor":
        return None
    a, b = node.args
    for x, y in ((a, b), (b, a)):
        if x.op == "const":  # a xor yes = not a
            return build.not_(y) if x.attr else y
    return build.flag(False) if a is b else None


def _in_set(node: Node, build: Builder) -> Node | None:
    if node.op != "in_set":
        return None
    (a,) = node.args
    members = node.attr
    assert isinstance(members, frozenset)
    if a.op == "const":
        return build.flag(a.attr in members)
    reachable = frozenset(i for i in members if a.type.lo <= i <= a.type.hi)
    if not reachable:  # x in {} = no
        return build.flag(False)
    if len(reachable) == a.type.hi - a.type.lo + 1:  # x in everything = yes
        return build.flag(True)
    return build.in_set(a, reachable) if reachable != members else None


def _compare(node: Node, build: Builder) -> Node | None:
    if node.op not in ("eq", "lt", "le") or node.args[0].type.name != "int":
        return None
    a, b = node.args
    (al, ah), (bl, bh) = (a.type.lo, a.type.hi), (b.type.lo, b.type.hi)
    if node.op == "eq":
        if ah < bl or bh < al:
            return build.flag(False)
        if al == ah == bl == bh:
            return build.flag(True)
        return None
    if node.op == "lt":
        return build.flag(True) if ah < bl else build.flag(False) if bh <= al else None
    return build.flag(True) if ah <= bl else build.flag(False) if bh < al else None


def _whole_constants(node: Node, build: Builder) -> Node | None:
    """Whole-number arithmetic on constants, and neutral elements."""
    evaluate = OPS[node.op].evaluate
    if node.type.name != "int" or evaluate is None:
        return None
    if all(arg.op == "const" for arg in node.args):
        return build.whole(int(evaluate(node.attr, *(int(arg.attr) for arg in node.args))))
    if node.op in ("add", "sub"):
        a, b = node.args
        if b.op == "const" and b.attr == 0:  # a + 0 = a
            return a
        if node.op == "add" and a.op == "const" and a.attr == 0:
            return b
    if node.op == "quotient" and node.args[1].op == "const" and node.args[1].attr == 1:  # x div 1 = x
        return node.args[0]
    if node.op == "mod":  # x mod n = x where 0 ≤ x < n
        (a,) = node.args
        if a.type.lo >= 0 and a.type.hi < node.attr:
            return a
    return None


def _select(node: Node, build: Builder) -> Node | None:
    if node.op != "select":
        return None
    condition, yes, no = node.args
    if condition.op == "const":
        return yes if condition.attr else no
    if yes is no:
        return yes
    if condition.op == "not":  # select(not c, a, b) = select(c, b, a)
        return build.select(condition.args[0], no, yes)
    if node.type == FLAG:
        if _is(yes, True):  # select(c, yes, b) = c or b
            return build.or_(condition, no)
        if _is(yes, False):
            return build.and_(build.not_(condition), no)
        if _is(no, False):
            return build.and_(condition, yes)
        if _is(no, True):
            return build.or_(build.not_(condition), yes)
    if no.op == "select" and no.args[0] is condition:  # the outer choice hides the inner one
        return build.select(condition, yes, no.args[2])
    return None


def _movement(node: Node, build: Builder) -> Node | None:
    if node.op not in ("swap", "arrive"):
        return None
    content, movers, rest = node.args
    if _is(movers, False):  # nobody moves
        return rest
    if content.op == "const" and rest is content:  # everything is alike
        return rest
    return None


def _shift_of_constant(node: Node, build: Builder) -> Node | None:
    if node.op == "shift":
        (a,) = node.args
        wraps = node.attr[2]
        if a.op in ("const", "param") and (wraps or (a.op == "const" and not a.attr)):
            return a
        if a.op == "coordinate" and a.attr[0] == "step" and wraps:
            return a
        if a.op in ("const", "param"):  # nothing outside: the same inside, else zero
            inside = build.make("inside", FLAG, attr=node.attr[:2])
            return build.select(inside, a, build.const(0, a.type))
    return None


def _inside(node: Node, build: Builder) -> Node | None:
    """A cell lies inside its own grid."""
    return build.flag(True) if node.op == "inside" and node.attr[:2] == (0, 0) else None


def _below(node: Node, build: Builder) -> Node | None:
    if node.op != "below":
        return None
    (limit,) = node.args
    bits = node.attr[1]
    if limit.type.hi <= 0:  # a chance of nothing
        return build.flag(False)
    if limit.type.lo >= 1 << bits:  # a certainty
        return build.flag(True)
    return None


def _divide(node: Node, build: Builder) -> Node | None:
    """x / 2^k = x · 2^-k, exactly."""
    if node.op == "div" and node.args[1].op == "const":
        divisor = float(node.args[1].attr)
        if divisor and frexp(abs(divisor))[0] == 0.5:
            return build.arithmetic("mul", node.args[0], build.real(1.0 / divisor))
    return None


def _root(node: Node, build: Builder) -> Node | None:
    """c < √x = c' < x, where c' is the last float whose root does not exceed c: roots are rounded, but never out of order."""
    if node.op != "lt" or node.args[1].op != "sqrt" or node.args[0].op != "const":
        return None
    limit = np.float32(node.args[0].attr)
    if not 0 <= limit < 1e18:  # its square must be finite
        return None
    square = np.float32(limit) * np.float32(limit)
    while np.sqrt(square) > limit:
        square = np.nextafter(square, np.float32(0))
    while np.sqrt(after := np.nextafter(square, np.float32(np.inf))) <= limit:
        square = after
    return build.compare("lt", build.real(float(square)), node.args[1].args[0])


def _count(node: Node, build: Builder) -> Node | None:
    if node.op == "count" and _is(node.args[0], False):
        return build.whole(0)
    return None


FOLD: tuple[Rewrite, ...] = (
    _not, _and_or, _xor, _in_set, _compare, _whole_constants, _select, _movement, _shift_of_constant, _below, _count, _divide,
    _root, _inside,
)  # fmt: skip
