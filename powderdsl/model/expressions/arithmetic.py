"""Arithmetic and comparisons: kinds, ranges and exact constant folding.

Integers carry their bounds; draws add up with integers only and compare exactly; everything else is
float32, one rounding an operation, in the order written.
"""

from __future__ import annotations

from fractions import Fraction
from math import ceil, floor
from typing import TYPE_CHECKING

from powderdsl.diagnostics import Span
from powderdsl.model.builtins import COORDINATES
from powderdsl.model.expressions.operands import FALSE, TRUE, Number, Operand, constant, negation
from powderdsl.model.types import CHANCE, DIRECTION, ELEMENT, FLAG, REAL, VEC2, Expr, Kind, integer
from powderdsl.syntax.ast import Syntax

if TYPE_CHECKING:
    from powderdsl.model.expressions.scope import Scope
    from powderdsl.model.expressions.typer import Typer

Value = Expr | Number

MAX_MODULUS = 64

_FLIP = {"<": ">", ">": "<", "<=": ">=", ">=": "<=", "==": "==", "!=": "!="}


def compare(
    typer: Typer,
    operator: str,
    left: Value,
    right: Value,
    span: Span,
    places: tuple[Span, Span] | None = None,
) -> Expr:
    """A comparison as `eq`, `lt` or `le`, maybe negated. `places` are where the two sides stand, for messages."""
    places = places or (span, span)
    if operator == "!=":
        return negation(compare(typer, "==", left, right, span, places), span)
    if operator in (">", ">="):
        return compare(typer, _FLIP[operator], right, left, span, (places[1], places[0]))
    if isinstance(left, Number) and isinstance(right, Number):
        holds = {
            "==": left.value == right.value,
            "<": left.value < right.value,
            "<=": left.value <= right.value,
        }[operator]
        return TRUE if holds else FALSE
    op = {"==": "eq", "<": "lt", "<=": "le"}[operator]
    kinds = {operand.kind.name for operand in (left, right) if isinstance(operand, Expr)}
    if "draw" in kinds:
        return _compare_draw(typer, op, left, right, span, places)
    if kinds & {"element", "direction", "flag", "vec2"}:
        return _compare_discrete(typer, op, left, right, span, places)
    if kinds == {"int"}:
        return _compare_whole(typer, op, left, right, span)
    return Expr(op, FLAG, (typer.real(left, span), typer.real(right, span)), span=span)


_COMPARABLE = {
    FLAG: ("a condition", "a condition holds or not: write it, or `not` and it"),
    ELEMENT: ("an element", "ask for an element, or one of a set, with `is`"),
    DIRECTION: ("a direction", "such as `left`, or `at(-1, 1)`"),
}
"""Kinds that are compared with their own kind only: in words, and what to write instead."""


def _compare_discrete(
    typer: Typer, op: str, left: Value, right: Value, span: Span, places: tuple[Span, Span]
) -> Expr:
    for value, other, place in ((left, right, places[1]), (right, left, places[0])):
        if isinstance(value, Expr) and value.kind in _COMPARABLE:
            words, fix = _COMPARABLE[value.kind]
            if not isinstance(other, Expr) or other.kind != value.kind:
                raise typer.wrong(other, f"{words} to compare with {words}", place, fix)
            if op != "eq":
                raise typer.fail(
                    "PD401",
                    f"{words} is not more or less than another",
                    span,
                    "has no order",
                    "use `==` or `!=`",
                )
            return Expr(op, FLAG, (left, right), span=span)  # type: ignore[arg-type]
    raise typer.fail(
        "PD401",
        "vectors are not compared",
        span,
        "one side is a vector",
        "compare `length(…)`, or `.row` and `.column`",
    )


def _compare_whole(typer: Typer, op: str, left: Value, right: Value, span: Span) -> Expr:
    """Integers with integers; a bound such as 1.5 is rounded to the integer that means the same."""
    if isinstance(left, Number) and left.value.denominator != 1:
        if op == "eq":
            return FALSE
        left = Number(Fraction(floor(left.value) + (op == "le")))
    elif isinstance(right, Number) and right.value.denominator != 1:
        if op == "eq":
            return FALSE
        right = Number(Fraction(ceil(right.value) - (op == "le")))
    a, b = typer.whole(left, span), typer.whole(right, span)
    return Expr(op, FLAG, (a, b), span=span)


def _compare_draw(
    typer: Typer, op: str, left: Value, right: Value, span: Span, places: tuple[Span, Span]
) -> Expr:
    if op == "eq":
        raise typer.fail(
            "PD401", "a draw never equals anything exactly", span, "always false", "compare with `<` or `>`"
        )
    on_left = isinstance(left, Expr) and left.kind.name == "draw"
    draw, other, place = (left, right, places[1]) if on_left else (right, left, places[0])
    assert isinstance(draw, Expr)
    if isinstance(other, Expr) and other.kind.name == "draw":
        raise typer.fail("PD401", "two draws are not compared", span, "one side must be a number")
    if isinstance(other, Number):
        if not draw.kind.lo <= other.value <= draw.kind.hi:
            if (draw.kind.lo, draw.kind.hi) == (0, 1):
                shown = f"{float(other.value):g}"
                fix = f"`{shown}%`" if 0 <= other.value <= 100 else "a chance such as `20%`"
                raise typer.fail(
                    "PD403",
                    f"a draw compared with {shown}",
                    place,
                    "draws lie between 0 and 1",
                    f"did you mean {fix}?",
                )
            return TRUE if (other.value > draw.kind.hi) == (draw is left) else FALSE
        kind = CHANCE if 0 <= other.value <= 1 else Kind("number")
        other = Expr("const", kind, value=other.value, span=span)
        _check_resolution(typer, draw, other, place)
    if other.kind.name == "real":
        draw = typer.real(draw, span)
    elif other.kind.name not in ("chance", "number", "int"):
        raise typer.wrong(
            other, "a chance to compare the draw with", place, "such as `5%`, a parameter or a property"
        )
    # A draw lies strictly between two multiples of its resolution's half step: `<` and `<=` mean the same.
    pair = (draw, other) if isinstance(left, Expr) and left.kind.name == "draw" else (other, draw)
    return Expr("lt", FLAG, pair, span=span)


def _check_resolution(typer: Typer, draw: Expr, other: Expr, span: Span) -> None:
    if draw.op != "draw" or not isinstance(other.value, Fraction) or not 0 < other.value < 1:
        return
    stream = typer.symbols.streams.get(str(draw.value))
    steps = 1 << (stream.bits if stream else 32)
    p = other.value
    nearest = Fraction(max(0, ceil(p * steps - Fraction(1, 2))), steps)
    if abs(nearest - p) > p / 20:
        typer.reporter.report(
            "PD404",
            f"a chance of {float(100 * p):.3g}% is drawn as {float(100 * nearest):.3g}%",
            span,
            f"this stream draws in steps of 1/{steps}",
            helps=["declare the stream with `bits: 32`, or say `with chance`"],
        )


def binary(typer: Typer, kind: str, left: Value, right: Value, syntax: Syntax) -> Operand:
    """`+ - * /` on numbers and vectors."""
    op = {"add": "add", "subtract": "sub", "multiply": "mul", "divide": "div"}[kind]
    span = syntax.span
    if isinstance(left, Number) and isinstance(right, Number):
        if op == "div" and right.value == 0:
            raise typer.fail("PD402", "division by zero", syntax.children[1].span, "this is 0")
        value = {"add": left.value + right.value, "sub": left.value - right.value, "mul": left.value * right.value,
                 "div": left.value / (right.value or 1)}[op]  # fmt: skip
        if abs(value) > 10**6 or value.denominator > 10**18:
            raise typer.fail("PD402", "a constant out of reach", span, "numbers go up to 1,000,000")
        return Number(value)
    kinds = {operand.kind.name for operand in (left, right) if isinstance(operand, Expr)}
    if kinds & {"flag", "element", "direction"}:
        bad = next(
            o
            for o in (left, right)
            if isinstance(o, Expr) and o.kind.name in ("flag", "element", "direction")
        )
        raise typer.wrong(bad, "a number", syntax.children[0 if bad is left else 1].span)
    if "vec2" in kinds:
        return _vector_arithmetic(typer, op, left, right, span)
    if isinstance(right, Number) and right.value == 0 and op == "div":
        raise typer.fail("PD402", "division by zero", syntax.children[1].span, "this is 0")
    whole = all(
        (o.value.denominator == 1) if isinstance(o, Number) else o.kind.name == "int" for o in (left, right)
    )
    if whole and op != "div":
        a, b = typer.whole(left, span), typer.whole(right, span)
        return typer.bounded(Expr(op, _bounds(op, a.kind, b.kind), (a, b), span=span), span)
    if "draw" in kinds:
        draws = [o for o in (left, right) if isinstance(o, Expr) and o.kind.name == "draw"]
        rest = [o for o in (left, right) if not (isinstance(o, Expr) and o.kind.name == "draw")]
        if op in ("add", "sub") and len(draws) == 1 and not (op == "sub" and right is draws[0]):
            other = rest[0]
            if isinstance(other, Number) or other.kind.name == "int":
                other = typer.whole(other, span)
                bounds = _bounds(op, draws[0].kind, other.kind)
                args = (left, other) if left is draws[0] else (other, draws[0])
                return Expr(op, Kind("draw", bounds.lo, bounds.hi), args, span=span)
    return Expr(op, REAL, (typer.real(left, span), typer.real(right, span)), span=span)


def _bounds(op: str, a: Kind, b: Kind) -> Kind:
    if op == "add":
        return integer(a.lo + b.lo, a.hi + b.hi)
    if op == "sub":
        return integer(a.lo - b.hi, a.hi - b.lo)
    corners = [x * y for x in (a.lo, a.hi) for y in (b.lo, b.hi)]
    return integer(min(corners), max(corners))


def _vector_arithmetic(typer: Typer, op: str, left: Value, right: Value, span: Span) -> Expr:
    left_is, right_is = (isinstance(o, Expr) and o.kind.name == "vec2" for o in (left, right))
    if op in ("add", "sub") and not (left_is and right_is):
        raise typer.fail(
            "PD401",
            "a vector adds up with vectors only",
            span,
            "one side is not a vector",
            "write `vector(rows, columns)`",
        )
    if (op == "mul" and left_is and right_is) or (op == "div" and right_is):
        raise typer.fail(
            "PD401",
            "a vector is multiplied or divided by a number",
            span,
            "the other way round, or two vectors",
        )
    if op == "div" and isinstance(right, Number) and right.value == 0:
        raise typer.fail("PD402", "division by zero", span, "the divisor is 0")
    a = left if left_is else typer.real(left, span)
    b = right if right_is else typer.real(right, span)
    return Expr(op, VEC2, (a, b), span=span)  # type: ignore[arg-type]


def negate(typer: Typer, value: Value, span: Span) -> Operand:
    if isinstance(value, Number):
        return Number(-value.value)
    if value.kind.name == "int":
        return Expr("neg", integer(-value.kind.hi, -value.kind.lo), (value,), span=span)
    if value.kind.name in ("element", "flag"):
        raise typer.wrong(value, "a number", span, "an item of a list has a blank after its `-`")
    if value.kind.name == "vec2":
        return Expr("neg", VEC2, (value,), span=span)
    return Expr("neg", REAL, (typer.real(value, span),), span=span)


def quotient(typer: Typer, syntax: Syntax, scope: Scope) -> Operand:
    """`a div b`: integers, rounded down; 0 where b is 0."""
    left, right = (typer.value(typer.evaluate(child, scope), child.span) for child in syntax.children)
    a, b = (
        _whole_part(typer, value, child.span)
        for value, child in zip((left, right), syntax.children, strict=True)
    )
    if b.op == "const" and b.value == 0:
        raise typer.fail("PD402", "division by zero", syntax.children[1].span, "this is 0")
    if a.op == b.op == "const":
        return Number(Fraction(int(a.value) // int(b.value)))
    return Expr("quotient", _quotient_bounds(a.kind, b.kind), (a, b), span=syntax.span)


def _whole_part(typer: Typer, value: Value, span: Span) -> Expr:
    """An operand of `div`."""
    if isinstance(value, Expr) and value.kind.name == "real":
        raise typer.wrong(value, "an integer", span, "`div` divides integers; for floats say `/`")
    return typer.whole(value, span)


def _quotient_bounds(a: Kind, b: Kind) -> Kind:
    """The range of a div b: for divisors of one sign, the extremes lie at the ends of both ranges."""
    divisors = [d for d in (b.lo, min(b.hi, -1), max(b.lo, 1), b.hi) if d and b.lo <= d <= b.hi]
    corners = [x // d for x in (a.lo, a.hi) for d in divisors]
    if b.lo <= 0 <= b.hi:
        corners.append(0)
    return integer(min(corners), max(corners))


def modulo(typer: Typer, syntax: Syntax, scope: Scope) -> Operand:
    """`x mod n` for an integer constant n; coordinates (and their sums) may only appear here."""
    left, right = syntax.children
    divisor = typer.value(typer.evaluate(right, scope), right.span)
    if (
        not isinstance(divisor, Number)
        or divisor.value.denominator != 1
        or not 1 <= divisor.value <= MAX_MODULUS
    ):
        raise typer.fail(
            "PD405", "`mod` takes an integer constant", right.span, f"expected 1 to {MAX_MODULUS}"
        )
    modulus = int(divisor.value)
    value = _coordinate_sum(typer, left, modulus, scope)
    if isinstance(value, Number):
        if value.value.denominator != 1:
            raise typer.fail("PD401", "`mod` takes integers", left.span)
        return Number(Fraction(int(value.value) % modulus))
    return Expr("mod", integer(0, modulus - 1), (value,), modulus, syntax.span)


def _coordinate_sum(typer: Typer, syntax: Syntax, modulus: int, scope: Scope) -> Value:
    """Sums of coordinates, each reduced by the modulus, so that every part has a small declared range."""
    if syntax.kind == "name" and syntax.text in COORDINATES:
        return Expr("coordinate", integer(0, modulus - 1), (), (syntax.text, modulus), syntax.span)
    if syntax.kind in ("add", "subtract"):
        left, right = (_coordinate_sum(typer, child, modulus, scope) for child in syntax.children)
        result = binary(typer, syntax.kind, left, right, syntax)
        assert isinstance(result, (Expr, Number))
        return result
    if syntax.kind == "quotient" and _names_coordinate(syntax.children[0]):
        return _coordinate_quotient(typer, syntax, modulus, scope)
    value = typer.value(typer.evaluate(syntax, scope), syntax.span)
    return value if isinstance(value, Number) else typer.whole(value, syntax.span)


def _names_coordinate(syntax: Syntax) -> bool:
    """Whether a sum has a coordinate among its terms."""
    if syntax.kind in ("add", "subtract"):
        return any(_names_coordinate(child) for child in syntax.children)
    return syntax.kind == "name" and syntax.text in COORDINATES


def _coordinate_quotient(typer: Typer, syntax: Syntax, modulus: int, scope: Scope) -> Expr:
    """`row div n` under `mod m`: what `row mod (n · m)` says, divided by n."""
    left, right = syntax.children
    divisor = typer.value(typer.evaluate(right, scope), right.span)
    most = MAX_MODULUS // modulus
    if not isinstance(divisor, Number) or divisor.value.denominator != 1 or not 1 <= divisor.value <= most:
        label = f"expected 1 to {most}: times {modulus} it is at most {MAX_MODULUS}"
        raise typer.fail("PD405", "a coordinate is divided by an integer constant", right.span, label)
    number = int(divisor.value)
    inner = typer.whole(_coordinate_sum(typer, left, modulus * number, scope), left.span)
    known = Expr("mod", integer(0, modulus * number - 1), (inner,), modulus * number, left.span)
    by = constant(Number(Fraction(number)), right.span)
    return Expr("quotient", integer(0, modulus - 1), (known, by), span=syntax.span)


def part(vector: Expr, name: str, span: Span) -> Expr:
    return Expr("row_part" if name == "row" else "column_part", REAL, (vector,), span=span)


def choose(
    typer: Typer, condition: Expr, yes: tuple[Operand, Span], no: tuple[Operand, Span], span: Span
) -> Expr:
    """`a if c else b`, both of one kind; integers join their ranges."""
    a, b = typer.value(*yes), typer.value(*no)
    kinds = [o.kind.name if isinstance(o, Expr) else "number" for o in (a, b)]
    if set(kinds) <= {"int", "number"} and all(
        not isinstance(o, Number) or o.value.denominator == 1 for o in (a, b)
    ):
        first, second = typer.whole(a, yes[1]), typer.whole(b, no[1])
        kind = integer(min(first.kind.lo, second.kind.lo), max(first.kind.hi, second.kind.hi))
        return Expr("choose", kind, (condition, first, second), span=span)
    if set(kinds) <= {"chance", "number"} and all(
        not isinstance(o, Number) or 0 <= o.value <= 1 for o in (a, b)
    ):
        return Expr("choose", CHANCE, (condition, typer.chance(a, yes[1]), typer.chance(b, no[1])), span=span)
    if set(kinds) <= {"int", "number", "real", "chance", "draw"}:
        return Expr("choose", REAL, (condition, typer.real(a, yes[1]), typer.real(b, no[1])), span=span)
    # A place is an element or a direction, whichever the other value is.
    target = next(o for o in (yes[0], no[0], a, b) if isinstance(o, Expr)).kind
    first, second = typer.of_kind(yes[0], target, yes[1]), typer.of_kind(no[0], target, no[1])
    return Expr("choose", target, (condition, first, second), span=span)


def extreme(typer: Typer, op: str, values: list[tuple[Value, Span]], span: Span) -> Operand:
    """`min` or `max` of several numbers."""
    result, _ = values[0]
    for value, _ in values[1:]:
        if isinstance(result, Number) and isinstance(value, Number):
            result = Number((min if op == "min" else max)(result.value, value.value))
            continue
        whole = all(
            (o.value.denominator == 1) if isinstance(o, Number) else o.kind.name == "int"
            for o in (result, value)
        )
        if whole:
            a, b = typer.whole(result, span), typer.whole(value, span)
            pick = min if op == "min" else max
            result = Expr(
                op, integer(pick(a.kind.lo, b.kind.lo), pick(a.kind.hi, b.kind.hi)), (a, b), span=span
            )
        else:
            result = Expr(op, REAL, (typer.real(result, span), typer.real(value, span)), span=span)
    return constant(result, span) if isinstance(result, Number) and result.value.denominator == 1 else result
