"""Typed expressions -> IR nodes. Draws become comparisons of integers with exact thresholds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from math import ceil, floor, pi
from typing import Any

from powderdsl.ir.build import Builder
from powderdsl.ir.ops import FLAG, REAL, Node, Threshold, component_names, integer, kernel_rows
from powderdsl.ir.single import single
from powderdsl.model.types import Expr, Kernel, Property, Ruleset

Pair = tuple[Node, Node]
"""A vector: its row and column components."""

NEAR, FAR = 0.92387953251128674, 0.38268343236508977
"""cos(π/8) and cos(3π/8), where octants end."""

HALF_PI = (1.5703125, 0.0004837512969970703125, 7.549789954891609e-08)
"""π/2 in three parts, the first two of few bits."""

SINE = (-1 / 6, 1 / 120, -1 / 5040, 1 / 362880)
COSINE = (1 / 24, -1 / 720, 1 / 40320, -1 / 3628800)
"""The series of sine and cosine from x³ and x⁴ on."""

ROUNDER = 12582912.0
"""1.5 · 2²³, which rounds what is added to it to an integer."""


@dataclass
class Inputs:
    """What expressions read: the current node of each slot, and lets."""

    ruleset: Ruleset
    build: Builder
    state: dict[str, Node]
    lets: dict[str, Node | Pair]

    def property_of(self, prop: Property, element: Node) -> Node:
        """A property of given elements; values that are parameters are chosen one at a time."""
        build = self.build
        values = prop.values
        if any(isinstance(value, str) for value in values):
            type = FLAG if prop.kind.name == "flag" else integer(0, 0)
            return self.by_element(
                element,
                [param_node(self, v) if isinstance(v, str) else build.const(v, type) for v in values],  # type: ignore[arg-type]  # only numbers are left
            )
        if prop.kind.name == "flag":
            return build.in_set(element, frozenset(i for i, value in enumerate(values) if value))
        return build.table(element, tuple(int(value) for value in values))  # type: ignore[arg-type]  # only numbers are left

    def by_element(self, element: Node, values: list[Node]) -> Node:
        """The value that belongs to the element: one select a distinct value."""
        groups: dict[Node, set[int]] = {}
        for identity, value in enumerate(values):
            groups.setdefault(value, set()).add(identity)
        (result, _), *others = sorted(groups.items(), key=lambda group: -len(group[1]))
        for value, ids in others:
            result = self.build.select(self.build.in_set(element, frozenset(ids)), value, result)
        return result


def lower_expression(expr: Expr, at: Inputs) -> Node | Pair:
    """The node of a checked expression; a pair for vectors."""
    return _LOWER[expr.op](expr, at)


def node(expr: Expr, at: Inputs) -> Node:
    """The node of an expression that is not a vector."""
    lowered = lower_expression(expr, at)
    assert isinstance(lowered, Node)
    return lowered


def pair(expr: Expr, at: Inputs) -> Pair:
    lowered = lower_expression(expr, at)
    assert not isinstance(lowered, Node)
    return lowered


def param_node(at: Inputs, name: str, threshold: Threshold | None = None) -> Node:
    """A parameter's value, or as a chance the number of draws that lie below it."""
    param = next(p for p in at.ruleset.params if p.name == name)
    if threshold is not None:
        return at.build.make("param", integer(0, 1 << threshold.bits), attr=(name, threshold))
    type = {"flag": FLAG, "int": integer(int(param.kind.lo), int(param.kind.hi))}.get(param.kind.name, REAL)
    return at.build.make("param", type, attr=(name, None))


def _const(expr: Expr, at: Inputs) -> Node:
    build = at.build
    match expr.kind.name:
        case "flag":
            return build.flag(bool(expr.value))
        case "real" | "chance" | "number":
            return build.real(_float32(expr.value))
    return build.integer(int(expr.value))


def _float32(value: object) -> float:
    """A constant as the float32 it is rounded to, going through float64 as the reference does."""
    return single(float(value))  # type: ignore[arg-type]  # a constant is a number


def _property(expr: Expr, at: Inputs) -> Node:
    prop = at.ruleset.property(str(expr.value))
    assert prop is not None
    if prop.stored:
        return at.state[prop.name]
    if prop.kind.name == "chance":
        return _chance(expr, at)
    return at.property_of(prop, at.state["element"])


def _slot(name: str, at: Inputs) -> Node | Pair:
    if name in at.state:
        return at.state[name]
    row, column = component_names(name)
    return at.state[row], at.state[column]


def _each(function: Callable[..., Node], *values: Node | Pair) -> Node | Pair:
    """Apply to numbers, or to both parts of vectors; numbers beside vectors serve both parts."""
    if all(isinstance(value, Node) for value in values):
        return function(*values)
    rows = [value if isinstance(value, Node) else value[0] for value in values]
    columns = [value if isinstance(value, Node) else value[1] for value in values]
    return function(*rows), function(*columns)


def _look(expr: Expr, at: Inputs) -> Node | Pair:
    offset = expr.value
    return _each(lambda a: at.build.shift(a, offset), lower_expression(expr.args[0], at))


def _arithmetic(expr: Expr, at: Inputs) -> Node | Pair:
    return _each(partial(at.build.derive, expr.op), *(lower_expression(arg, at) for arg in expr.args))


def _member(expr: Expr, at: Inputs) -> Node:
    return at.build.in_set(node(expr.args[0], at), expr.value)


def _logic(expr: Expr, at: Inputs) -> Node:
    return at.build.make(expr.op, FLAG, *(node(arg, at) for arg in expr.args))


def _to_real(expr: Expr, at: Inputs) -> Node:
    argument = expr.args[0]
    if argument.kind.name == "draw":
        return _draw_real(argument, at)
    if argument.kind.name == "chance":
        return _chance(argument, at)
    return at.build.to_real(node(argument, at))


def _draw_real(expr: Expr, at: Inputs) -> Node:
    """A draw as float32. Sums with integers are rounded after each addition."""
    if expr.op == "draw":
        return at.build.make("draw", REAL, attr=_stream(expr, at))
    parts = [_draw_real(a, at) if a.kind.name == "draw" else at.build.to_real(node(a, at)) for a in expr.args]
    if expr.op == "look":
        return at.build.shift(parts[0], expr.value)
    return at.build.derive(expr.op, parts[0], parts[1])


def _chance(expr: Expr, at: Inputs, threshold: Threshold | None = None) -> Node:
    """A chance as float32, or as the number of draws below it."""
    build = at.build

    def number(value: Any) -> Node:
        if isinstance(value, str):
            return param_node(at, value, threshold)
        return (
            build.real(_float32(value)) if threshold is None else build.integer(draws_below(value, threshold))
        )

    match expr.op:
        case "const" | "param":
            return number(expr.value)
        case "look":
            return build.shift(_chance(expr.args[0], at, threshold), expr.value)
        case "choose":
            condition, yes, no = expr.args
            return build.select(node(condition, at), _chance(yes, at, threshold), _chance(no, at, threshold))
        case "let":
            value = at.lets[str(expr.value)]
            assert isinstance(value, Node)
            return value
    prop = at.ruleset.property(str(expr.value))
    assert prop is not None
    return at.by_element(at.state["element"], [number(value) for value in prop.values])


# Draws


def _stream(expr: Expr, at: Inputs) -> tuple[str, int]:
    stream = next(s for s in at.ruleset.streams if s.name == expr.value)
    return stream.name, stream.bits


def _split_draw(expr: Expr, at: Inputs) -> tuple[Expr, tuple[int, int], Node | None]:
    """A draw expression as (draw, where it is read, integer added to it)."""
    if expr.op == "draw":
        return expr, (0, 0), None
    if expr.op == "look":
        draw, (dy, dx), extra = _split_draw(expr.args[0], at)
        oy, ox = expr.value
        return draw, (dy + oy, dx + ox), at.build.shift(extra, (oy, ox)) if extra else None
    left, right = expr.args
    if left.kind.name == "draw":
        draw, offset, extra = _split_draw(left, at)
        other = node(right, at)
        other = at.build.derive("neg", other) if expr.op == "sub" else other
    else:
        draw, offset, extra = _split_draw(right, at)
        other = node(left, at)
    return draw, offset, at.build.derive("add", extra, other) if extra else other


def draws_below(chance: Fraction | float, threshold: Threshold) -> int:
    """How many of the 2^bits draws lie below a chance, or not above it."""
    scaled = Fraction(float(chance)) * (1 << threshold.bits) - Fraction(1, 2)
    count = ceil(scaled) if threshold.strict else floor(scaled) + 1
    return min(max(count, 0), 1 << threshold.bits)


def _lt(expr: Expr, at: Inputs) -> Node:
    left, right = expr.args
    if "draw" not in (left.kind.name, right.kind.name):
        return _compare(expr, at)
    # draw + extra < other, or other < draw + extra, which is the opposite of draw + extra <= other
    build = at.build
    flipped = right.kind.name == "draw"
    draw, offset, extra = _split_draw(right if flipped else left, at)
    other = left if flipped else right

    def below(limit: Node) -> Node:
        found = build.make(
            "below", FLAG, build.shift(limit, (-offset[0], -offset[1])), attr=_stream(draw, at)
        )
        return build.shift(found, offset)

    threshold = Threshold(_stream(draw, at)[1], strict=not flipped)
    if other.kind.name == "int":
        limit = node(other, at)
        result = build.compare("lt", extra or build.integer(0), limit)
        return build.not_(result) if flipped else result
    base = 0
    if isinstance(other.value, (int, Fraction)) and other.op == "const":
        base = floor(other.value)
        part = below(build.integer(draws_below(Fraction(other.value) - base, threshold)))
    else:
        part = below(_chance(other, at, threshold))
    if extra is None:
        result = part if base == 0 else build.flag(base > 0)
    else:
        bound = build.integer(base)
        less = build.compare("lt", extra, bound)
        result = build.or_(less, build.and_(build.compare("eq", extra, bound), part))
    return build.not_(result) if flipped else result


def _compare(expr: Expr, at: Inputs) -> Node:
    a, b = (node(arg, at) for arg in expr.args)
    if a.type == FLAG:
        return at.build.not_(at.build.make("xor", FLAG, a, b))
    return at.build.compare(expr.op, a, b)


# Neighborhoods and vectors


def _count(expr: Expr, at: Inputs) -> Node:
    kernel = expr.value
    type = integer(int(expr.kind.lo), int(expr.kind.hi))
    return at.build.make("count", type, node(expr.args[0], at), attr=(kernel.weights, kernel.wrap))


def _sum(expr: Expr, at: Inputs) -> Node | Pair:
    kernel = expr.value
    return _each(lambda a: _neighborhood(a, kernel, at.build), lower_expression(expr.args[0], at))


def _neighborhood(value: Node, kernel: Kernel, build: Builder) -> Node:
    """The weighted sum, each row from the left, then the rows from the top. Equal rows are summed once and shifted."""
    total: Node | None = None
    for dy, cells in kernel_rows(kernel.weights).items():
        row: Node | None = None
        for dx, weight in cells:
            term = build.shift(value, (0, dx), kernel.wrap)
            if weight != 1:
                factor = build.real(float(weight)) if value.type == REAL else build.integer(weight)
                term = build.derive("mul", term, factor)
            row = term if row is None else build.derive("add", row, term)
        assert row is not None
        row = build.shift(row, (dy, 0), kernel.wrap)
        total = row if total is None else build.derive("add", total, row)
    return total if total is not None else build.const(0, value.type)


def _length(vector: Pair, build: Builder) -> Node:
    y, x = vector
    squares = build.derive("add", build.derive("mul", y, y), build.derive("mul", x, x))
    return build.make("sqrt", REAL, squares)


def _octant(expr: Expr, at: Inputs) -> Node:
    """The octant, by comparing x with the borders of the octants at this length."""
    build = at.build
    y, x = pair(expr.args[0], at)
    reach = build.derive("add", _length((y, x), build), build.real(_float32(0.001)))
    near = build.derive("mul", build.real(_float32(NEAR)), reach)
    far = build.derive("mul", build.real(_float32(FAR)), reach)
    up = build.compare("lt", y, build.real(0.0))
    result: Node = build.integer(4)
    borders = (near, far, build.derive("neg", far), build.derive("neg", near))
    for octant in (3, 2, 1, 0):
        mirrored = build.select(up, build.integer((8 - octant) % 8), build.integer(octant))
        result = build.select(build.compare("lt", borders[octant], x), mirrored, result)
    return result


def _turned(eighths: int) -> Callable[[Expr, Inputs], Node]:
    return lambda expr, at: at.build.mod(
        at.build.derive("add", node(expr.args[0], at), at.build.integer(eighths)), 8
    )


def _wave(expr: Expr, at: Inputs) -> Node:
    """A sine or cosine: π/2 is taken off in three parts, then follows a series. See `model.reference` for each step."""
    build, x = at.build, node(expr.args[0], at)

    def real(value: float) -> Node:
        return build.real(_float32(value))

    def add(a: Node, b: Node) -> Node:
        return build.derive("add", a, b)

    def sub(a: Node, b: Node) -> Node:
        return build.derive("sub", a, b)

    def mul(a: Node, b: Node) -> Node:
        return build.derive("mul", a, b)

    def rounded(value: Node) -> Node:
        return sub(add(value, real(ROUNDER)), real(ROUNDER))

    def series(coefficients: tuple[float, ...]) -> Node:
        *others, total = map(real, coefficients)
        for coefficient in reversed(others):
            total = add(coefficient, mul(z, total))
        return total

    def between(low: float, high: float) -> Node:
        return build.and_(build.compare("lt", real(low), turn), build.compare("lt", turn, real(high)))

    q = rounded(mul(x, real(2 / pi)))
    coarse, middle, fine = (mul(q, real(part)) for part in HALF_PI)
    near = sub(sub(x, coarse), middle)
    rest = sub(near, fine)
    small = sub(sub(near, rest), fine)
    turn = sub(q, mul(real(4.0), rounded(sub(mul(q, real(0.25)), real(0.375)))))
    z = mul(rest, rest)
    rising = add(rest, add(small, mul(rest, mul(z, series(SINE)))))
    level = sub(real(1.0), add(mul(real(0.5), z), sub(mul(rest, small), mul(mul(z, z), series(COSINE)))))
    odd = build.or_(between(0.5, 1.5), build.compare("lt", real(2.5), turn))
    is_cosine = expr.op == "cos"
    down = between(0.5, 2.5) if is_cosine else build.compare("lt", real(1.5), turn)
    value = build.select(odd, rising, level) if is_cosine else build.select(odd, level, rising)
    return build.select(down, build.derive("neg", value), value)


def _vector(expr: Expr, at: Inputs) -> Pair:
    return node(expr.args[0], at), node(expr.args[1], at)


def _choose(expr: Expr, at: Inputs) -> Node | Pair:
    if expr.kind.name == "chance":
        return _chance(expr, at)
    condition = node(expr.args[0], at)
    values = [lower_expression(arg, at) for arg in expr.args[1:]]
    return _each(lambda a, b: at.build.select(condition, a, b), *values)


_LOWER: dict[str, Callable[[Expr, Inputs], Node | Pair]] = {
    "const": _const,
    "param": lambda e, at: param_node(at, str(e.value)),
    "element": lambda e, at: at.state["element"],
    "property": _property,
    "field": lambda e, at: _slot(str(e.value), at),
    "let": lambda e, at: at.lets[str(e.value)],
    "draw": _draw_real,
    "coordinate": lambda e, at: at.build.make(
        "coordinate", integer(int(e.kind.lo), int(e.kind.hi)), attr=e.value
    ),
    "inside": lambda e, at: at.build.make("inside", FLAG, attr=e.value),
    "look": _look,
    "member": _member,
    **dict.fromkeys(("not", "and", "or"), _logic),
    **dict.fromkeys(("eq", "le"), _compare),
    "lt": _lt,
    **dict.fromkeys(("add", "sub", "mul", "min", "max", "div", "neg", "abs"), _arithmetic),
    "quotient": lambda e, at: at.build.quotient(node(e.args[0], at), node(e.args[1], at)),
    "mod": lambda e, at: at.build.mod(node(e.args[0], at), e.value),
    "to_real": _to_real,
    "count": _count,
    "sum": _sum,
    "choose": _choose,
    "octant": _octant,
    "opposite": _turned(4),
    "clockwise": _turned(2),
    "sin": _wave,
    "cos": _wave,
    "length": lambda e, at: _length(pair(e.args[0], at), at.build),
    "row_part": lambda e, at: pair(e.args[0], at)[0],
    "column_part": lambda e, at: pair(e.args[0], at)[1],
    "vector": _vector,
}
"""One lowering for every operation of the model."""
