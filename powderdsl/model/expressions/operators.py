"""Operands of expressions, and the operators on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from math import ceil, floor
from typing import TYPE_CHECKING

from powderdsl.diagnostics import Span
from powderdsl.model.builtins import COORDINATES
from powderdsl.model.operations import COMPARISONS, INTEGER, OPERATIONS
from powderdsl.model.types import (
    CHANCE,
    DIRECTION,
    ELEMENT,
    FLAG,
    REAL,
    VEC2,
    Expr,
    Kernel,
    Kind,
    Offset,
    integer,
)
from powderdsl.syntax.ast import Syntax

if TYPE_CHECKING:
    from powderdsl.model.expressions.typer import Typer


MAX_CHAIN = 16
"""Longest chain of `and` or `or` that nests to one side: what walks expressions recurses."""


@dataclass(frozen=True)
class SetOf:
    """A set of elements, ids ascending. `name` is set where a rule names one element."""

    ids: tuple[int, ...]
    name: str | None = None


@dataclass(frozen=True)
class Place:
    """This cell or a neighbor. As a value it is the element found there."""

    offset: Offset


@dataclass(frozen=True)
class PlaceChoice:
    """One place where the condition holds, the other one elsewhere. As a value it is an element, or a direction."""

    condition: Expr
    yes: Place | PlaceChoice
    no: Place | PlaceChoice


@dataclass(frozen=True)
class Number:
    """An exact constant."""

    value: Fraction


@dataclass(frozen=True)
class Bounds:
    """`lo..hi`, both included."""

    lo: int
    hi: int


@dataclass(frozen=True)
class Items:
    """A list in parentheses."""

    items: tuple[Operand, ...]


@dataclass(frozen=True)
class Absent:
    """`name?` of something that no loaded pack defines."""

    name: str


@dataclass(frozen=True)
class Broken:
    """A name whose definition has been reported: using it is not a second mistake."""


Operand = Expr | SetOf | Place | PlaceChoice | Number | Bounds | Items | Kernel | Absent | Broken
Value = Expr | Number
"""Operands that arithmetic and comparisons work on."""


class Poisoned(Exception):
    """This expression has been reported already: whatever contains it stays silent."""


class Unresolved(Exception):
    """This rule needs `name`, which no loaded pack defines, and marks it with a `?`."""

    def __init__(self, name: str):
        super().__init__(name)
        self.name = name


# Where an expression stands

Matrix = tuple[tuple[int, int], tuple[int, int]]
IDENTITY: Matrix = ((1, 0), (0, 1))


@dataclass(frozen=True)
class Scope:
    """Where an expression stands: its pack, the local names, and how it is turned by a symmetry."""

    pack: str
    locals: dict[str, Operand]
    orientation: Matrix = IDENTITY

    def bind(self, **names: Operand) -> Scope:
        return replace(self, locals={**self.locals, **names})


def turned(offset: Offset, matrix: Matrix) -> Offset:
    (a, b), (c, d) = matrix
    return (a * offset[0] + b * offset[1], c * offset[0] + d * offset[1])


# Expressions

ELEMENT_HERE = Expr("element", ELEMENT)
TRUE, FALSE = Expr("const", FLAG, value=1), Expr("const", FLAG, value=0)


def constant(number: Number, span: Span | None = None) -> Expr:
    """A number as a constant: an int if it is an integer, else a float."""
    if number.value.denominator == 1:
        whole = int(number.value)
        return Expr("const", integer(whole, whole), value=whole, span=span)
    return Expr("const", REAL, value=float(number.value), span=span)


def look(value: Expr, offset: Offset, span: Span | None = None) -> Expr:
    """A value at a neighbor; offsets of nested looks add up, constants are the same everywhere."""
    if value.op == "look":
        inner = value.value
        assert isinstance(inner, tuple)
        offset = (offset[0] + inner[0], offset[1] + inner[1])
        value = value.args[0]
    if offset == (0, 0) or value.op in ("const", "param"):
        return value
    return Expr("look", value.kind, (value,), offset, span)


def member(value: Expr, ids: tuple[int, ...], span: Span | None = None) -> Expr:
    return Expr("member", FLAG, (value,), frozenset(ids), span)


def negation(value: Expr, span: Span | None = None) -> Expr:
    if value.op == "const":
        return FALSE if value.value else TRUE
    return value.args[0] if value.op == "not" else Expr("not", FLAG, (value,), span=span)


def conjunction(values: list[Expr], span: Span | None = None) -> Expr:
    """All of them, constants folded."""
    return _folded("and", values, TRUE, FALSE, span)


def disjunction(values: list[Expr], span: Span | None = None) -> Expr:
    """Any of them, constants folded."""
    return _folded("or", values, FALSE, TRUE, span)


def _folded(op: str, values: list[Expr], neutral: Expr, absorbing: Expr, span: Span | None) -> Expr:
    if absorbing in values:
        return absorbing
    kept = [value for value in values if value != neutral]
    return _joined(op, kept, span) if kept else neutral


def _joined(op: str, values: list[Expr], span: Span | None) -> Expr:
    """All values under one operation, pair by pair from the left; long lists as a balanced tree."""
    if len(values) > MAX_CHAIN:
        middle = len(values) // 2
        halves = (_joined(op, values[:middle], span), _joined(op, values[middle:], span))
        return Expr(op, FLAG, halves, span=span)
    result = values[0]
    for value in values[1:]:
        result = Expr(op, FLAG, (result, value), span=span)
    return result


Placed = tuple[Value, Span]
"""A value and where it stands."""

MAX_MODULUS = 64


def kind_name(value: Operand | None) -> str:
    """The name of a runtime value's kind; nothing for other operands."""
    return value.kind.name if isinstance(value, Expr) else ""


def is_integer(value: Value) -> bool:
    """Whether a value is an integer, or a constant that is one."""
    return value.value.denominator == 1 if isinstance(value, Number) else value.kind.name == "int"


def whole_constant(operand: Operand) -> int | None:
    """The integer that an operand is, if it is a constant one."""
    return int(operand.value) if isinstance(operand, Number) and is_integer(operand) else None


def arithmetic(typer: Typer, op: str, values: Sequence[Placed], span: Span) -> Value:
    """An operation on numbers: constants are folded, integers stay integers, all else becomes floats."""
    row = OPERATIONS[op]
    numbers = [value.value for value, _ in values if isinstance(value, Number)]
    if row.evaluate is not None and len(numbers) == len(values):
        return Number(Fraction(row.evaluate(*numbers)))
    if all(is_integer(value) for value, _ in values):
        args = tuple(typer.of_kind(value, INTEGER, place) for value, place in values)
        bounds = row.between(*((arg.kind.lo, arg.kind.hi) for arg in args))
        if bounds is not None:
            return Expr(op, integer(*bounds), args, span=span)
    return Expr(op, REAL, tuple(typer.of_kind(value, REAL, place) for value, place in values), span=span)


# Comparisons

_COMPARABLE = {
    FLAG: ("a condition", "a condition holds or not: write it, or `not` and it"),
    ELEMENT: ("an element", "ask for an element, or one of a set, with `is`"),
    DIRECTION: ("a direction", "such as `left`, or `at(-1, 1)`"),
}
"""Kinds that are compared with their own kind only: in words, and what to write instead."""


def compare(typer: Typer, sign: str, left: Placed, right: Placed, span: Span) -> Expr:
    """A comparison as `eq`, `lt` or `le`, maybe negated."""
    if sign == "!=":
        return negation(compare(typer, "==", left, right, span), span)
    if sign in (">", ">="):
        return compare(typer, sign.replace(">", "<"), right, left, span)
    (a, _), (b, _) = left, right
    op = COMPARISONS[sign]
    evaluate = OPERATIONS[op].evaluate
    if evaluate is not None and isinstance(a, Number) and isinstance(b, Number):
        return TRUE if evaluate(a.value, b.value) else FALSE
    kinds = {kind_name(value) for value in (a, b)} - {""}
    if "draw" in kinds:
        return _compare_draw(typer, op, left, right, span)
    if kinds & {"element", "direction", "flag", "vec2"}:
        return _compare_discrete(typer, op, left, right, span)
    if kinds == {"int"}:
        return _compare_integers(typer, op, a, b, span)
    return Expr(op, FLAG, tuple(typer.of_kind(value, REAL, span) for value in (a, b)), span=span)


def _compare_discrete(typer: Typer, op: str, left: Placed, right: Placed, span: Span) -> Expr:
    for (value, _), (other, place) in ((left, right), (right, left)):
        if isinstance(value, Expr) and value.kind in _COMPARABLE:
            words, fix = _COMPARABLE[value.kind]
            if not isinstance(other, Expr) or other.kind != value.kind:
                raise typer.wrong(other, f"{words} to compare with {words}", place, fix)
            if op != "eq":
                message = f"{words} is not more or less than another"
                raise typer.fail("PD401", message, span, "has no order", "use `==` or `!=`")
            return Expr(op, FLAG, (left[0], right[0]), span=span)  # type: ignore[arg-type]  # both are Expr: see above
    fix = "compare `length(…)`, or `.row` and `.column`"
    raise typer.fail("PD401", "vectors are not compared", span, "one side is a vector", fix)


def _compare_integers(typer: Typer, op: str, left: Value, right: Value, span: Span) -> Expr:
    """Integers with integers; a bound such as 1.5 is rounded to the integer that means the same."""
    if op == "eq" and not (is_integer(left) and is_integer(right)):
        return FALSE
    if isinstance(left, Number) and not is_integer(left):
        left = Number(Fraction(floor(left.value) + (op == "le")))
    elif isinstance(right, Number) and not is_integer(right):
        right = Number(Fraction(ceil(right.value) - (op == "le")))
    return Expr(op, FLAG, tuple(typer.of_kind(value, INTEGER, span) for value in (left, right)), span=span)


def _compare_draw(typer: Typer, op: str, left: Placed, right: Placed, span: Span) -> Expr:
    if op == "eq":
        message, fix = "a draw never equals anything exactly", "compare with `<` or `>`"
        raise typer.fail("PD401", message, span, "always false", fix)
    first = kind_name(left[0]) == "draw"
    (draw, _), (other, place) = (left, right) if first else (right, left)
    assert isinstance(draw, Expr)
    if kind_name(other) == "draw":
        raise typer.fail("PD401", "two draws are not compared", span, "one side must be a number")
    if isinstance(other, Number):
        if not draw.kind.lo <= other.value <= draw.kind.hi:
            if (draw.kind.lo, draw.kind.hi) == (0, 1):
                shown = f"{float(other.value):g}"
                fix = f"`{shown}%`" if 0 <= other.value <= 100 else "a chance such as `20%`"
                message, label = f"a draw compared with {shown}", "draws lie between 0 and 1"
                raise typer.fail("PD403", message, place, label, f"did you mean {fix}?")
            return TRUE if (other.value > draw.kind.hi) == first else FALSE
        kind = CHANCE if 0 <= other.value <= 1 else Kind("number")
        _check_resolution(typer, draw, other.value, place)
        other = Expr("const", kind, value=other.value, span=span)
    if other.kind.name == "real":
        draw = typer.of_kind(draw, REAL, span)
    elif other.kind.name not in ("chance", "number", "int"):
        fix = "such as `5%`, a parameter or a property"
        raise typer.wrong(other, "a chance to compare the draw with", place, fix)
    # A draw lies strictly between two multiples of its resolution's half step: `<` and `<=` mean the same.
    return Expr("lt", FLAG, (draw, other) if first else (other, draw), span=span)


def _check_resolution(typer: Typer, draw: Expr, chance: Fraction, span: Span) -> None:
    """Warn of a chance that is far from the nearest one that the stream can draw."""
    if draw.op != "draw" or not 0 < chance < 1:
        return
    stream = typer.symbols.streams.get(str(draw.value))
    steps = 1 << (stream.bits if stream else 32)
    nearest = Fraction(max(0, ceil(chance * steps - Fraction(1, 2))), steps)
    if abs(nearest - chance) > chance / 20:
        message = f"a chance of {float(100 * chance):.3g}% is drawn as {float(100 * nearest):.3g}%"
        label = f"this stream draws in steps of 1/{steps}"
        fix = "declare the stream with `bits: 32`, or say `with chance`"
        typer.reporter.report("PD404", message, span, label, helps=[fix])


# `is` and `in`


def holds(typer: Typer, left: Operand, right: Operand, syntax: Syntax) -> Expr:
    """Whether `left` is, or lies in, `right`, for every pair of operands that can stand there."""
    span = syntax.span
    first, second = (child.span for child in syntax.children)
    match left, right:
        case Place(), Place():
            return TRUE if left == right else FALSE
        case Place(), Items() if all(isinstance(item, Place) for item in right.items):
            return TRUE if left in right.items else FALSE
        case Place(), Expr() if right.kind == FLAG:
            return look(right, left.offset, span)
        case Number(), Number():
            return TRUE if left == right else FALSE
        case SetOf(), SetOf() if left.name is not None:
            return TRUE if left.ids[0] in right.ids else FALSE
        case (PlaceChoice(), Place() | PlaceChoice()) | (Place(), PlaceChoice()):
            one, other = typer.of_kind(left, DIRECTION, first), typer.of_kind(right, DIRECTION, second)
            return compare(typer, "==", (one, span), (other, span), span)
        case Expr(), Place() | PlaceChoice():
            return compare(typer, "==", (left, span), (typer.of_kind(right, DIRECTION, second), span), span)
        case _, Expr() if right.kind == DIRECTION:
            return compare(typer, "==", (typer.of_kind(left, DIRECTION, first), span), (right, span), span)
        case _, Bounds():
            value = (typer.value(left, first), span)
            low, high = ((Number(Fraction(bound)), span) for bound in (right.lo, right.hi))
            parts = [compare(typer, "<=", low, value, span), compare(typer, "<=", value, high, span)]
            return conjunction(parts, span)
        case _, Items() if any(_stands_alone(item) for item in right.items):
            return disjunction([_equals(typer, left, item, syntax) for item in right.items], span)
        case _, Number():
            raise _not_a_set(typer, syntax)
        case _, Absent():
            return FALSE
        case Absent(), _:
            raise Unresolved(left.name)
    ids = typer.set_of(right, second).ids
    if isinstance(left, SetOf) and left.name is None:
        raise typer.wrong(left, "a place or an element before `is`", first, "such as `below is …`")
    return member(typer.of_kind(left, ELEMENT, first), ids, span)


def _stands_alone(item: Operand) -> bool:
    """Whether an item of a list is compared by itself: numbers and directions. The others join to a set of elements."""
    return isinstance(item, (Number, Place)) or kind_name(item) == "direction"


def _equals(typer: Typer, left: Operand, item: Operand, syntax: Syntax) -> Expr:
    """Whether `left` is one item of a list: numbers are compared, places and elements named."""
    if isinstance(item, Number) and not isinstance(left, Number):
        value = typer.value(left, syntax.children[0].span)
        return compare(typer, "==", (value, syntax.span), (item, syntax.span), syntax.span)
    return holds(typer, left, item, syntax)


def _not_a_set(typer: Typer, syntax: Syntax) -> Poisoned:
    second = syntax.children[1]
    message, fix = "`in` asks for a range or a set", "compare numbers with `==`"
    if syntax.kind in ("is_", "is_not"):
        message = "`is` asks for an element or a direction"
    elif second.kind == "sub":
        fix = "a range is written `LOW..HIGH`"
    return typer.fail("PD401", message, second.span, "this is a number", fix)


# Arithmetic


def binary(typer: Typer, left: Value, right: Value, syntax: Syntax) -> Value:
    """`+ - * /` on numbers and vectors."""
    op, span = syntax.kind, syntax.span
    kinds = [kind_name(value) for value in (left, right)]
    for value, kind, child in zip((left, right), kinds, syntax.children, strict=True):
        if kind in ("flag", "element", "direction"):
            raise typer.wrong(value, "a number", child.span)
    _check_divisor(typer, op, right, syntax)
    if "vec2" in kinds:
        return _on_vectors(typer, op, left, right, span)
    # An integer added to a draw, or subtracted from it, shifts its range.
    shifts = op == "add" or (op == "sub" and kinds[0] == "draw")
    if shifts and sorted(kinds) in (["", "draw"], ["draw", "int"]):
        args = tuple(
            value if isinstance(value, Expr) else typer.of_kind(value, INTEGER, span)
            for value in (left, right)
        )
        bounds = OPERATIONS[op].between(*((arg.kind.lo, arg.kind.hi) for arg in args))
        assert bounds is not None
        return Expr(op, Kind("draw", *bounds), args, span=span)
    result = arithmetic(typer, op, [(left, span), (right, span)], span)
    if isinstance(result, Number):
        if abs(result.value) > 10**6 or result.value.denominator > 10**18:
            raise typer.fail("PD402", "a constant out of reach", span, "numbers go up to 1,000,000")
        return result
    return typer.bounded(result, span)


def _check_divisor(typer: Typer, op: str, divisor: Value, syntax: Syntax) -> None:
    zero = divisor.value == 0 if isinstance(divisor, Number) else divisor.op == "const" and divisor.value == 0
    if op in ("div", "quotient") and zero:
        raise typer.fail("PD402", "division by zero", syntax.children[1].span, "this is 0")


def _on_vectors(typer: Typer, op: str, left: Value, right: Value, span: Span) -> Expr:
    first, second = (kind_name(value) == "vec2" for value in (left, right))
    if op in ("add", "sub") and not (first and second):
        message, fix = "a vector adds up with vectors only", "write `vector(rows, columns)`"
        raise typer.fail("PD401", message, span, "one side is not a vector", fix)
    if (op == "mul" and first and second) or (op == "div" and second):
        message = "a vector is multiplied or divided by a number"
        raise typer.fail("PD401", message, span, "the other way round, or two vectors")
    args = (
        value if kind_name(value) == "vec2" else typer.of_kind(value, REAL, span) for value in (left, right)
    )
    return Expr(op, VEC2, tuple(args), span=span)  # type: ignore[arg-type]  # vectors, or made real


def negate(typer: Typer, value: Value, span: Span) -> Value:
    kind = kind_name(value)
    if kind in ("element", "flag"):
        raise typer.wrong(value, "a number", span, "an item of a list has a blank after its `-`")
    if isinstance(value, Expr) and kind == "vec2":
        return Expr("neg", VEC2, (value,), span=span)
    return arithmetic(typer, "neg", [(value, span)], span)


def quotient(typer: Typer, syntax: Syntax, scope: Scope) -> Value:
    """`a div b`: integers, rounded down; 0 where b is 0."""
    values = [(typer.value_of(child, scope), child.span) for child in syntax.children]
    for value, span in values:
        if kind_name(value) == "real":
            raise typer.wrong(value, "an integer", span, "`div` divides integers; for floats say `/`")
        typer.of_kind(value, INTEGER, span)
    _check_divisor(typer, "quotient", values[1][0], syntax)
    return arithmetic(typer, "quotient", values, syntax.span)


def modulo(typer: Typer, syntax: Syntax, scope: Scope) -> Value:
    """`x mod n` for an integer constant n; coordinates (and their sums) may only appear here."""
    left, right = syntax.children
    modulus = whole_constant(typer.evaluate(right, scope))
    if modulus is None or not 1 <= modulus <= MAX_MODULUS:
        label = f"expected 1 to {MAX_MODULUS}"
        raise typer.fail("PD405", "`mod` takes an integer constant", right.span, label)
    value = _coordinate_sum(typer, left, modulus, scope)
    if isinstance(value, Number):
        if not is_integer(value):
            raise typer.fail("PD401", "`mod` takes integers", left.span)
        return Number(value.value % modulus)
    return Expr("mod", integer(0, modulus - 1), (value,), modulus, syntax.span)


def _coordinate_sum(typer: Typer, syntax: Syntax, modulus: int, scope: Scope) -> Value:
    """Sums of coordinates, each reduced by the modulus, so that every part has a small declared range."""
    if syntax.kind == "name" and syntax.text in COORDINATES:
        return Expr("coordinate", integer(0, modulus - 1), (), (syntax.text, modulus), syntax.span)
    if syntax.kind in ("add", "sub"):
        left, right = (_coordinate_sum(typer, child, modulus, scope) for child in syntax.children)
        return binary(typer, left, right, syntax)
    if syntax.kind == "quotient" and _names_coordinate(syntax.children[0]):
        return _coordinate_quotient(typer, syntax, modulus, scope)
    value = typer.value_of(syntax, scope)
    return value if isinstance(value, Number) else typer.of_kind(value, INTEGER, syntax.span)


def _names_coordinate(syntax: Syntax) -> bool:
    """Whether a sum has a coordinate among its terms."""
    if syntax.kind in ("add", "sub"):
        return any(_names_coordinate(child) for child in syntax.children)
    return syntax.kind == "name" and syntax.text in COORDINATES


def _coordinate_quotient(typer: Typer, syntax: Syntax, modulus: int, scope: Scope) -> Expr:
    """`row div n` under `mod m`: what `row mod (n · m)` says, divided by n."""
    left, right = syntax.children
    most = MAX_MODULUS // modulus
    number = whole_constant(typer.evaluate(right, scope))
    if number is None or not 1 <= number <= most:
        label = f"expected 1 to {most}: times {modulus} it is at most {MAX_MODULUS}"
        raise typer.fail("PD405", "a coordinate is divided by an integer constant", right.span, label)
    inner = typer.of_kind(_coordinate_sum(typer, left, modulus * number, scope), INTEGER, left.span)
    known = Expr("mod", integer(0, modulus * number - 1), (inner,), modulus * number, left.span)
    by = constant(Number(Fraction(number)), right.span)
    return Expr("quotient", integer(0, modulus - 1), (known, by), span=syntax.span)


def choose(
    typer: Typer, condition: Expr, yes: tuple[Operand, Span], no: tuple[Operand, Span], span: Span
) -> Expr | PlaceChoice:
    """`a if c else b`, both of one kind; integers join their ranges. What it is of places depends on its use."""
    if isinstance(yes[0], (Place, PlaceChoice)) and isinstance(no[0], (Place, PlaceChoice)):
        return PlaceChoice(condition, yes[0], no[0])
    a, b = typer.value(*yes), typer.value(*no)
    kinds = {kind_name(value) or "number" for value in (a, b)}
    numbers = [value.value for value in (a, b) if isinstance(value, Number)]
    if is_integer(a) and is_integer(b):
        kind = INTEGER
    elif kinds <= {"chance", "number"} and all(0 <= number <= 1 for number in numbers):
        kind = CHANCE
    elif kinds <= {"int", "number", "real", "chance", "draw"}:
        kind = REAL
    else:  # a place is an element or a direction, whichever the other value is
        kind = next(o for o in (yes[0], no[0], a, b) if isinstance(o, Expr)).kind
    first, second = typer.of_kind(yes[0], kind, yes[1]), typer.of_kind(no[0], kind, no[1])
    if kind == INTEGER:
        kind = integer(min(first.kind.lo, second.kind.lo), max(first.kind.hi, second.kind.hi))
    return Expr("choose", kind, (condition, first, second), span=span)
