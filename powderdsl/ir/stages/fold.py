"""Constant folding and the algebra of flags. Each row's equation is its comment. Floats are never re-associated."""

from __future__ import annotations

from math import frexp

from powderdsl.ir.build import Builder
from powderdsl.ir.ops import FLAG, OPS, REAL, Node
from powderdsl.ir.rewrite import Rules
from powderdsl.ir.single import following, preceding, single, square_root

FOLD = Rules()


def _is(node: Node, value: object) -> bool:
    return node.op == "const" and node.attr is value


@FOLD.on("not")
def _not(node: Node, build: Builder) -> Node | None:
    (a,) = node.args
    match a.op:
        case "const":  # not yes = no
            return build.flag(not a.attr)
        case "not":  # not not a = a
            return a.args[0]
        case "le" if a.args[0].type != REAL:  # not (a ≤ b) = b < a, integers only: a NaN is neither
            return build.compare("lt", a.args[1], a.args[0])
        case "lt" if a.args[0].type != REAL:  # not (a < b) = b ≤ a
            return build.compare("le", a.args[1], a.args[0])
    return None


@FOLD.on("and", "or")
def _and_or(node: Node, build: Builder) -> Node | None:
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
        return build.in_set(a.args[0], a.attr | b.attr if absorbing else a.attr & b.attr)
    return None


@FOLD.on("xor")
def _xor(node: Node, build: Builder) -> Node | None:
    a, b = node.args
    for x, y in ((a, b), (b, a)):
        if x.op == "const":  # a xor yes = not a
            return build.not_(y) if x.attr else y
    return build.flag(False) if a is b else None


@FOLD.on("in_set")
def _in_set(node: Node, build: Builder) -> Node | None:
    (a,) = node.args
    if a.op == "const":
        return build.flag(a.attr in node.attr)
    reachable = frozenset(i for i in node.attr if a.type.lo <= i <= a.type.hi)
    if not reachable:  # x in {} = no
        return build.flag(False)
    if len(reachable) == a.type.hi - a.type.lo + 1:  # x in everything = yes
        return build.flag(True)
    return build.in_set(a, reachable)


@FOLD.on("eq", "lt", "le")
def _compare(node: Node, build: Builder) -> Node | None:
    """Comparisons of integers that their ranges decide."""
    a, b = (arg.type for arg in node.args)
    if a.name != "int":
        return None
    always, never = {
        "eq": (a.lo == a.hi == b.lo == b.hi, a.hi < b.lo or b.hi < a.lo),
        "lt": (a.hi < b.lo, b.hi <= a.lo),
        "le": (a.hi <= b.lo, b.hi < a.lo),
    }[node.op]
    return build.flag(always) if always or never else None


@FOLD.on("add", "sub", "mul", "min", "max", "neg", "abs", "mod", "quotient")
def _integer_constants(node: Node, build: Builder) -> Node | None:
    """Integer arithmetic on constants."""
    evaluate = OPS[node.op].evaluate
    if evaluate is None or node.type.name != "int" or any(arg.op != "const" for arg in node.args):
        return None
    return build.integer(int(evaluate(node.attr, *(arg.attr for arg in node.args))))


@FOLD.on("add", "sub", "quotient")
def _neutral(node: Node, build: Builder) -> Node | None:
    """a + 0 = a, a - 0 = a, a div 1 = a. Zeros of either sign are alike: clamping makes them one, nothing tells them apart."""
    a, b = node.args
    if b.op == "const" and b.attr == (1 if node.op == "quotient" else 0):
        return a
    return b if node.op == "add" and a.op == "const" and a.attr == 0 else None


@FOLD.on("mod")
def _small_mod(node: Node, build: Builder) -> Node | None:
    """x mod n = x where 0 ≤ x < n."""
    (a,) = node.args
    return a if a.type.lo >= 0 and a.type.hi < node.attr else None


@FOLD.on("select")
def _select(node: Node, build: Builder) -> Node | None:
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


@FOLD.on("swap", "arrive")
def _movement(node: Node, build: Builder) -> Node | None:
    """Nothing moves, or everything is alike."""
    content, movers, rest = node.args
    return rest if _is(movers, False) or (content.op == "const" and rest is content) else None


@FOLD.on("shift")
def _shift_of_constant(node: Node, build: Builder) -> Node | None:
    (a,) = node.args
    dy, dx, wraps = node.attr
    if a.op == "coordinate" and a.attr[0] == "step" and wraps:
        return a
    return build.shift_uniform(a, (dy, dx), wraps) if a.op in ("const", "param") else None


@FOLD.on("below")
def _below(node: Node, build: Builder) -> Node | None:
    """A chance that nothing or everything is below."""
    limit, bits = node.args[0].type, node.attr[1]
    return build.flag(limit.hi > 0) if limit.hi <= 0 or limit.lo >= 1 << bits else None


@FOLD.on("count")
def _count(node: Node, build: Builder) -> Node | None:
    return build.integer(0) if _is(node.args[0], False) else None


@FOLD.on("div")
def _divide(node: Node, build: Builder) -> Node | None:
    """x / 2^k = x · 2^-k, exactly."""
    a, b = node.args
    if b.op == "const" and b.attr and frexp(abs(b.attr))[0] == 0.5:
        return build.derive("mul", a, build.real(1.0 / b.attr))
    return None


@FOLD.on("lt")
def _root(node: Node, build: Builder) -> Node | None:
    """c < √x = c' < x, where c' is the last float whose root does not exceed c: roots are rounded, but never out of order."""
    if node.args[1].op != "sqrt" or node.args[0].op != "const":
        return None
    limit = single(node.args[0].attr)
    if not 0 <= limit < 1e18:  # its square must be finite
        return None
    square = single(limit * limit)
    while square_root(square) > limit:
        square = preceding(square)
    while square_root(after := following(square)) <= limit:
        square = after
    return build.compare("lt", build.real(square), node.args[1].args[0])


@FOLD.on("inside")
def _inside(node: Node, build: Builder) -> Node | None:
    """A cell lies inside its own grid."""
    return build.flag(True) if node.attr[:2] == (0, 0) else None
