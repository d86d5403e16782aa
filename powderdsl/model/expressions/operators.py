"""Operands of expressions, and the operators and functions on them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import lru_cache, partial
from math import ceil, floor
from typing import TYPE_CHECKING

from powderdsl.diagnostics import Reporter, Source, Span, suggest
from powderdsl.model.builtins import (
    COORDINATES,
    DIRECTIONS,
    ELSEWHERE,
    KERNEL_SHAPES,
    KERNELS,
    MAX_MAGNITUDE,
    MAX_RADIUS,
    shaped_kernel,
)
from powderdsl.model.composition.names import words_of
from powderdsl.model.operations import COMPARISONS, FUNCTIONS, INTEGER, NUMBER, OPERATIONS, PLACE, Operation
from powderdsl.model.types import (
    CHANCE,
    DIRECTION,
    DRAW,
    ELEMENT,
    FLAG,
    REAL,
    VEC2,
    Expr,
    Kernel,
    Kind,
    Offset,
    integer,
    plus,
)
from powderdsl.syntax.parse import Syntax, parse_text

if TYPE_CHECKING:
    from powderdsl.model.expressions.typer import Typer


MAX_CHAIN = 16
"""Longest chain of `and` or `or` that nests to one side, since walks over expressions recurse."""


@dataclass(frozen=True)
class SetOf:
    """A set of elements with ascending ids. `name` is set if a rule names a single element."""

    ids: tuple[int, ...]
    name: str | None = None


@dataclass(frozen=True)
class Place:
    """This cell or a neighbor. As a value, it is the element there."""

    offset: Offset


@dataclass(frozen=True)
class PlaceChoice:
    """A choice between two places by a condition. As a value, it is an element or a direction."""

    condition: Expr
    yes: Place | PlaceChoice
    no: Place | PlaceChoice


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
    """A name whose definition has been reported, so that using it is not a second mistake."""


Operand = Expr | SetOf | Place | PlaceChoice | Bounds | Items | Kernel | Absent | Broken


class Poisoned(Exception):
    """This expression has already been reported, so expressions that contain it are not."""


class Unresolved(Exception):
    """This rule needs `name`, which no loaded pack defines, and marks it with a `?`."""

    def __init__(self, name: str):
        super().__init__(name)
        self.name = name


# Scopes

Matrix = tuple[tuple[int, int], tuple[int, int]]
IDENTITY: Matrix = ((1, 0), (0, 1))


@dataclass(frozen=True)
class Scope:
    """The context of an expression: its pack, the local names, and the orientation under a symmetry."""

    pack: str
    locals: dict[str, Operand]
    orientation: Matrix = IDENTITY

    def bind(self, /, **names: Operand) -> Scope:
        return replace(self, locals={**self.locals, **names})


def rotate(offset: Offset, matrix: Matrix) -> Offset:
    (a, b), (c, d) = matrix
    return (a * offset[0] + b * offset[1], c * offset[0] + d * offset[1])


# Expressions

ELEMENT_HERE = Expr("element", ELEMENT)
TRUE, FALSE = Expr("const", FLAG, value=1), Expr("const", FLAG, value=0)


def number(value: float | Fraction) -> Expr:
    """An exact constant, without a kind until it is used."""
    return Expr("const", NUMBER, value=Fraction(value))


def look(value: Expr, offset: Offset, span: Span | None = None) -> Expr:
    """A value at a neighbor. Nested offsets add up; constants are the same everywhere."""
    if value.op == "look":
        offset, value = plus(offset, value.value), value.args[0]
    if offset == (0, 0) or value.op in ("const", "param"):
        return value
    return Expr("look", value.kind, (value,), offset, span)


def member(value: Expr, ids: tuple[int, ...], span: Span | None = None) -> Expr:
    return Expr("member", FLAG, (value,), frozenset(ids), span)


def negation(value: Expr, span: Span | None = None) -> Expr:
    if value.op == "const":
        return FALSE if value.value else TRUE
    return value.args[0] if value.op == "not" else Expr("not", FLAG, (value,), span=span)


def _fold(op: str, neutral: Expr, absorbing: Expr, values: list[Expr], span: Span | None = None) -> Expr:
    if absorbing in values:
        return absorbing
    others = [value for value in values if value != neutral]
    return _join(op, others, span) if others else neutral


conjunction = partial(_fold, "and", TRUE, FALSE)
"""All of some conditions, constants folded."""

disjunction = partial(_fold, "or", FALSE, TRUE)
"""Any of some conditions, constants folded."""


def _join(op: str, values: list[Expr], span: Span | None) -> Expr:
    """All values combined by an operation, in pairs from the left; long lists as a balanced tree."""
    if len(values) > MAX_CHAIN:
        middle = len(values) // 2
        halves = (_join(op, values[:middle], span), _join(op, values[middle:], span))
        return Expr(op, FLAG, halves, span=span)
    result = values[0]
    for value in values[1:]:
        result = Expr(op, FLAG, (result, value), span=span)
    return result


PlacedValue = tuple[Expr, Span]
"""A value and its span."""

MAX_MODULUS = 64


def kind_name(value: Operand | None) -> str:
    """The name of a runtime value's kind; empty for other operands."""
    return value.kind.name if isinstance(value, Expr) else ""


def is_integer(value: Expr) -> bool:
    """True for an integer value, and for an integer constant."""
    return value.value.denominator == 1 if value.kind == NUMBER else value.kind.name == "int"


def integer_constant(
    typer: Typer, syntax: Syntax, scope: Scope, lo: int, hi: int, message: str, label: str = "", *helps: str
) -> int:
    value = typer.evaluate(syntax, scope)
    if isinstance(value, Expr) and value.kind == NUMBER and is_integer(value) and lo <= value.value <= hi:
        return int(value.value)
    raise typer.fail("PD405", message, syntax.span, label or f"expected {lo} to {hi}", *helps)


def arithmetic(typer: Typer, op: str, values: Sequence[PlacedValue], span: Span) -> Expr:
    """An operation on numbers: constants are folded, integers stay integers, all else becomes floats.

    An integer added to a draw, or subtracted from it, shifts its range.
    """
    row = OPERATIONS[op]
    kinds = [value.kind.name for value, _ in values]
    if row.evaluate is not None and {*kinds} == {"number"}:
        return number(row.evaluate(*(value.value for value, _ in values)))
    shifts = sorted(kinds) in (["draw", "int"], ["draw", "number"]) and (
        op == "add" or (op == "sub" and kinds[0] == "draw")
    )
    if shifts or all(is_integer(value) for value, _ in values):
        args = tuple(v if v.kind.name == "draw" else typer.of_kind(v, INTEGER, place) for v, place in values)
        bounds = row.between(*((arg.kind.lo, arg.kind.hi) for arg in args))
        if bounds is not None:
            return Expr(op, Kind("draw" if shifts else "int", *bounds), args, span=span)
    return Expr(op, REAL, tuple(typer.of_kind(value, REAL, place) for value, place in values), span=span)


# Comparisons

_COMPARABLE = {
    FLAG: ("a condition", "a condition is true or false: write it, or `not` and the condition"),
    ELEMENT: ("an element", "test for an element, or one of a set, with `is`"),
    DIRECTION: ("a direction", "such as `left`, or `at(-1, 1)`"),
}
"""Kinds that are only compared with values of the same kind: in words, and the fix."""


def compare(typer: Typer, sign: str, left: PlacedValue, right: PlacedValue, span: Span) -> Expr:
    """A comparison as `eq`, `lt` or `le`, possibly negated."""
    if sign == "!=":
        return negation(compare(typer, "==", left, right, span), span)
    if sign in (">", ">="):
        return compare(typer, sign.replace(">", "<"), right, left, span)
    (a, _), (b, _) = left, right
    op = COMPARISONS[sign]
    evaluate = OPERATIONS[op].evaluate
    if evaluate is not None and a.kind == b.kind == NUMBER:
        return TRUE if evaluate(a.value, b.value) else FALSE
    kinds = {a.kind.name, b.kind.name} - {"number"}
    if "draw" in kinds:
        return _compare_draw(typer, op, left, right, span)
    if kinds & {"element", "direction", "flag", "vec2"}:
        return _compare_discrete(typer, op, left, right, span)
    kind = INTEGER if kinds == {"int"} else REAL
    if kind == INTEGER:
        # A bound such as 1.5 is rounded to the equivalent integer.
        if op == "eq" and not (is_integer(a) and is_integer(b)):
            return FALSE
        if not is_integer(a):
            a = number(floor(a.value) + (op == "le"))
        elif not is_integer(b):
            b = number(ceil(b.value) - (op == "le"))
    return Expr(op, FLAG, (typer.of_kind(a, kind, span), typer.of_kind(b, kind, span)), span=span)


def _compare_discrete(typer: Typer, op: str, left: PlacedValue, right: PlacedValue, span: Span) -> Expr:
    for (value, _), (other, place) in ((left, right), (right, left)):
        if value.kind in _COMPARABLE:
            words, fix = _COMPARABLE[value.kind]
            if other.kind != value.kind:
                raise typer.wrong(other, f"{words} to compare with {words}", place, fix)
            if op != "eq":
                message = f"{words} cannot be more or less than another"
                raise typer.fail("PD401", message, span, "has no order", "use `==` or `!=`")
            return Expr(op, FLAG, (left[0], right[0]), span=span)
    fix = "compare `length(…)`, or `.row` and `.column`"
    raise typer.fail("PD401", "vectors cannot be compared", span, "one side is a vector", fix)


def _compare_draw(typer: Typer, op: str, left: PlacedValue, right: PlacedValue, span: Span) -> Expr:
    if op == "eq":
        message, fix = "a draw never equals anything exactly", "compare with `<` or `>`"
        raise typer.fail("PD401", message, span, "always false", fix)
    first = left[0].kind.name == "draw"
    (draw, _), (other, place) = (left, right) if first else (right, left)
    if other.kind.name == "draw":
        raise typer.fail("PD401", "two draws cannot be compared", span, "one side must be a number")
    if other.kind == NUMBER:
        if not draw.kind.lo <= other.value <= draw.kind.hi:
            if (draw.kind.lo, draw.kind.hi) == (0, 1):
                shown = f"{float(other.value):g}"
                fix = f"`{shown}%`" if 0 <= other.value <= 100 else "a chance such as `20%`"
                message, label = f"a draw compared with {shown}", "draws are between 0 and 1"
                raise typer.fail("PD403", message, place, label, f"did you mean {fix}?")
            return TRUE if (other.value > draw.kind.hi) == first else FALSE
        kind = CHANCE if 0 <= other.value <= 1 else NUMBER
        _check_resolution(typer, draw, other.value, place)
        other = Expr("const", kind, value=other.value, span=span)
    if other.kind.name == "real":
        draw = typer.of_kind(draw, REAL, span)
    elif other.kind.name not in ("chance", "number", "int"):
        fix = "such as `5%`, a parameter or a property"
        raise typer.wrong(other, "a chance to compare the draw with", place, fix)
    # A draw is strictly between two multiples of half its resolution, so `<` and `<=` are equivalent.
    return Expr("lt", FLAG, (draw, other) if first else (other, draw), span=span)


def _check_resolution(typer: Typer, draw: Expr, chance: Fraction, span: Span) -> None:
    """Warn of a chance that is far from the nearest one that the stream can draw."""
    if draw.op != "draw" or not 0 < chance < 1:
        return
    stream = typer.symbols.streams.get(str(draw.value))
    steps = 1 << (stream.bits if stream else 32)
    nearest = Fraction(max(0, ceil(chance * steps - Fraction(1, 2))), steps)
    if abs(nearest - chance) > chance / 20:
        message = f"a chance of {float(100 * chance):.3g}% is rounded to {float(100 * nearest):.3g}%"
        label = f"this stream draws in steps of 1/{steps}"
        fix = "declare the stream with `bits: 32`, or write `with chance`"
        typer.reporter.report("PD404", message, span, label, helps=[fix])


# `is` and `in`


def membership(typer: Typer, left: Operand, right: Operand, syntax: Syntax) -> Expr:
    """The condition `left is right` or `left in right`, for every allowed pair of operands."""
    span = syntax.span
    first, second = (child.span for child in syntax.children)
    match left, right:
        case Place(), Place():
            return TRUE if left == right else FALSE
        case Place(), Expr() if right.kind == FLAG:
            return look(right, left.offset, span)
        case Expr(), Expr() if left.kind == right.kind == NUMBER:
            return TRUE if left == right else FALSE
        case SetOf(), SetOf() if left.name is not None:
            return TRUE if left.ids[0] in right.ids else FALSE
        case (Expr() | Place() | PlaceChoice(), Place() | PlaceChoice()) | (_, Expr(kind=Kind("direction"))):
            direction, other = typer.of_kind(left, DIRECTION, first), typer.of_kind(right, DIRECTION, second)
            return compare(typer, "==", (direction, span), (other, span), span)
        case _, Bounds():
            value = (typer.value(left, first), span)
            low, high = (number(right.lo), span), (number(right.hi), span)
            parts = [compare(typer, "<=", low, value, span), compare(typer, "<=", value, high, span)]
            return conjunction(parts, span)
        case _, Items() if any(
            isinstance(item, Place) or kind_name(item) in ("number", "direction") for item in right.items
        ):  # the others join to a set of elements
            return disjunction([_equals(typer, left, item, syntax) for item in right.items], span)
        case _, Expr() if right.kind == NUMBER:
            message, fix = "`in` needs a range or a set", "compare numbers with `==`"
            if syntax.kind in ("is_", "is_not"):
                message = "`is` needs an element or a direction"
            elif syntax.children[1].kind == "sub":
                fix = "a range is written `LOW..HIGH`"
            raise typer.fail("PD401", message, second, "this is a number", fix)
        case _, Absent():
            return FALSE
        case Absent(), _:
            raise Unresolved(left.name)
    ids = typer.set_of(right, second).ids
    if isinstance(left, SetOf) and left.name is None:
        raise typer.wrong(left, "a place or an element before `is`", first, "such as `below is …`")
    return member(typer.of_kind(left, ELEMENT, first), ids, span)


def _equals(typer: Typer, left: Operand, item: Operand, syntax: Syntax) -> Expr:
    """The condition that `left` equals an item of a list. Numbers are compared; other items follow `membership`."""
    if isinstance(item, Expr) and item.kind == NUMBER:
        value = typer.value(left, syntax.children[0].span)
        return compare(typer, "==", (value, syntax.span), (item, syntax.span), syntax.span)
    return membership(typer, left, item, syntax)


# Arithmetic


def calculation(typer: Typer, syntax: Syntax, scope: Scope, modulus: int = 0) -> Expr:
    """`+ - * / div` on numbers and vectors, or on coordinates under a modulus.

    `a div b` divides integers, rounded down; 0 where b is 0.
    """
    op, span = syntax.kind, syntax.span
    values: list[PlacedValue] = []
    for child in syntax.children:
        value = _coordinate_sum(typer, child, modulus, scope) if modulus else typer.value_of(child, scope)
        if value.kind in _COMPARABLE:
            helps = ["write a space after the `-` of a list item"] if op == "neg" else []
            raise typer.wrong(value, "a number", child.span, *helps)
        if op == "quotient" and value.kind.name == "real":
            raise typer.wrong(value, "an integer", child.span, "`div` divides integers; `/` divides floats")
        if op == "quotient" and not is_integer(value):
            value = typer.of_kind(value, INTEGER, child.span)
        values.append((value, child.span))
    if op in ("div", "quotient") and values[1][0].op == "const" and values[1][0].value == 0:
        raise typer.fail("PD402", "division by zero", syntax.children[1].span, "this is 0")
    if any(value.kind.name == "vec2" for value, _ in values):
        return _on_vectors(typer, op, values, span)
    result = arithmetic(typer, op, values, span)
    if result.kind != NUMBER:
        return typer.check_range(result, span)
    if abs(result.value) > 10**6 or result.value.denominator > 10**18:
        raise typer.fail("PD402", "a constant out of range", span, "numbers go up to 1,000,000")
    return result


def _on_vectors(typer: Typer, op: str, values: Sequence[PlacedValue], span: Span) -> Expr:
    vectors = [value.kind.name == "vec2" for value, _ in values]
    if op in ("add", "sub") and not all(vectors):
        message, fix = "only vectors can be added to a vector", "write `vector(rows, columns)`"
        raise typer.fail("PD401", message, span, "one side is not a vector", fix)
    if (op == "mul" and all(vectors)) or (op == "div" and vectors[1]):
        message = "a vector can only be multiplied or divided by a number"
        raise typer.fail("PD401", message, span, "the other way round, or two vectors")
    args = (typer.of_kind(v, VEC2 if v.kind.name == "vec2" else REAL, place) for v, place in values)
    return Expr(op, VEC2, tuple(args), span=span)


def modulo(typer: Typer, syntax: Syntax, scope: Scope) -> Expr:
    """`x mod n` for an integer constant n; coordinates (and their sums) may only appear here."""
    left, right = syntax.children
    modulus = integer_constant(typer, right, scope, 1, MAX_MODULUS, "`mod` takes an integer constant")
    value = _coordinate_sum(typer, left, modulus, scope)
    if value.kind != NUMBER:
        return Expr("mod", integer(0, modulus - 1), (value,), modulus, syntax.span)
    if not is_integer(value):
        raise typer.fail("PD401", "`mod` takes integers", left.span)
    return number(value.value % modulus)


def _coordinate_sum(typer: Typer, syntax: Syntax, modulus: int, scope: Scope) -> Expr:
    """Sums of coordinates, each reduced by the modulus, so that every part has a small range."""
    if syntax.kind == "name" and syntax.text in COORDINATES:
        return Expr("coordinate", integer(0, modulus - 1), (), (syntax.text, modulus), syntax.span)
    if syntax.kind in ("add", "sub"):
        return calculation(typer, syntax, scope, modulus)
    if syntax.kind == "quotient" and not set(words_of(syntax.children[0])).isdisjoint(COORDINATES):
        return _coordinate_quotient(typer, syntax, modulus, scope)
    value = typer.value_of(syntax, scope)
    return value if value.kind == NUMBER else typer.of_kind(value, INTEGER, syntax.span)


def _coordinate_quotient(typer: Typer, syntax: Syntax, modulus: int, scope: Scope) -> Expr:
    """`row div n` under `mod m`: the value of `row mod (n · m)`, divided by n."""
    left, right = syntax.children
    message = "a coordinate can only be divided by an integer constant"
    divisor = integer_constant(typer, right, scope, 1, MAX_MODULUS // modulus, message)
    inner = typer.of_kind(_coordinate_sum(typer, left, modulus * divisor, scope), INTEGER, left.span)
    known = Expr("mod", integer(0, modulus * divisor - 1), (inner,), modulus * divisor, left.span)
    by = typer.of_kind(number(divisor), INTEGER, right.span)
    return Expr("quotient", integer(0, modulus - 1), (known, by), span=syntax.span)


def choose(
    typer: Typer, condition: Expr, yes: tuple[Operand, Span], no: tuple[Operand, Span], span: Span
) -> Expr | PlaceChoice:
    """`a if c else b`, both of one kind; ranges of integers are joined. Choices between places have a kind by use."""
    if isinstance(yes[0], (Place, PlaceChoice)) and isinstance(no[0], (Place, PlaceChoice)):
        return PlaceChoice(condition, yes[0], no[0])
    a, b = typer.value(*yes), typer.value(*no)
    kinds = {value.kind.name for value in (a, b)}
    if is_integer(a) and is_integer(b):
        kind = INTEGER
    elif kinds <= {"chance", "number"} and all(v.kind == CHANCE or 0 <= v.value <= 1 for v in (a, b)):
        kind = CHANCE
    elif kinds <= {"int", "number", "real", "chance", "draw"}:
        kind = REAL
    else:  # a place is an element or a direction, whichever the other value is
        kind = next(o for o in (yes[0], no[0], a, b) if isinstance(o, Expr) and o.kind != NUMBER).kind
    first, second = typer.of_kind(yes[0], kind, yes[1]), typer.of_kind(no[0], kind, no[1])
    if kind == INTEGER:
        kind = integer(min(first.kind.lo, second.kind.lo), max(first.kind.hi, second.kind.hi))
    return Expr("choose", kind, (condition, first, second), span=span)


# Functions

Call = Callable[["Typer", Syntax, Scope], Operand]


def call(typer: Typer, syntax: Syntax, scope: Scope) -> Operand:
    """The value of a function, or a kernel of a radius."""
    name, count = syntax.text, len(syntax.children)
    function = FUNCTIONS.get(name)
    if function is None and name not in KERNEL_SHAPES:
        word = Span(syntax.span.source, syntax.span.start, syntax.span.start + len(name))
        meant = ELSEWHERE.get(name.lower())
        if name in DIRECTIONS:
            rows, columns = (2 * part for part in DIRECTIONS[name])
            meant = f"for a cell farther away, write `at(ROWS, COLUMNS)`: here `at({rows}, {columns})`"
        helps = (meant,) if meant else suggest(name, [*FUNCTIONS, *KERNEL_SHAPES], "functions")
        if not helps:
            helps = (f"functions: {', '.join(f'`{known}`' for known in FUNCTIONS)}",)
        raise typer.fail("PD301", f"unknown function `{name}`", word, "not a function", *helps)
    lo = len(function.parameters) if function else 1
    hi, usage = (function.most or lo, function.usage) if function else (1, f"{name}(RADIUS)")
    if not lo <= count <= hi:
        wanted = "1 value" if lo == hi == 1 else f"{lo} values" if lo == hi else f"{lo} to {hi} values"
        message, label = f"`{name}` takes {wanted}, found {count}", "too few" if count < lo else "too many"
        raise typer.fail("PD406", message, syntax.span, label, f"write `{usage}`")
    if function is None:
        message, argument = "a radius must be an integer constant", syntax.children[0]
        return shaped_kernel(name, integer_constant(typer, argument, scope, 1, MAX_RADIUS, message))
    if name in CALLS:
        return CALLS[name](typer, syntax, scope)
    operands = [(typer.evaluate(child, scope), child.span) for child in syntax.children]
    if function.meaning:
        return _expand(typer, function, operands, syntax.span)
    return _apply(typer, function, operands, syntax.span)


def _apply(typer: Typer, function: Operation, operands: list[tuple[Operand, Span]], span: Span) -> Operand:
    if NUMBER in function.takes:
        values = [(typer.value(*operand), operand[1]) for operand in operands]
        while len(values) > len(function.parameters):
            pair, rest = values[:2], values[2:]
            values = [(arithmetic(typer, function.name, pair, span), span), *rest]
        result = arithmetic(typer, function.name, values, span)
        return typer.of_kind(result, INTEGER, span) if is_integer(result) else result
    assert function.gives is not None
    args, value = [], None
    for operand, kind in zip(operands, function.takes, strict=True):
        if kind == PLACE:
            value = typer.place(*operand).offset
        else:
            args.append(typer.of_kind(operand[0], kind, operand[1]))
    return Expr(function.name, function.gives, tuple(args), value, span)


@lru_cache
def _meaning(function: Operation) -> Syntax:
    line = Span(Source(function.name, function.meaning), 0, len(function.meaning))
    syntax = parse_text(line, "expression", Reporter())
    assert syntax is not None
    return syntax


def _expand(
    typer: Typer, function: Operation, operands: Sequence[tuple[Operand, Span]], span: Span
) -> Operand:
    """The value of a function with a `meaning`. Mistakes are shown at the arguments, or at the call."""
    arguments = dict(zip(function.parameters, operands, strict=True))

    def placed(node: Syntax) -> Syntax:
        place = arguments[node.text][1] if node.text in arguments else span
        return replace(node, children=tuple(map(placed, node.children)), span=place)

    names = {name: operand for name, (operand, _) in arguments.items()}
    result = typer.evaluate(placed(_meaning(function)), Scope("", names))
    # An argument that the meaning repeats is copied, which doubles with each nested call.
    typer.spend(sum(1 for _ in result.walk()) if isinstance(result, Expr) else 1, span)
    return result


# Neighborhoods


def _kernel(typer: Typer, syntax: Syntax, scope: Scope) -> Kernel | None:
    """The kernel after `in`; None if the operand is not a kernel."""
    operand = typer.find(syntax.text, syntax.span, scope) if syntax.kind == "name" else None
    if operand is None and syntax.text in KERNEL_SHAPES:
        operand = typer.evaluate(syntax, scope)
    return operand if isinstance(operand, Kernel) else None


def _neighborhood(typer: Typer, syntax: Syntax, scope: Scope) -> Expr:
    """`count` and `sum`: of the arguments, over the kernel of a last argument `… in KERNEL`."""
    span = syntax.span
    *arguments, last = syntax.children
    kernel = _kernel(typer, last.children[1], scope) if last.kind == "in_" else None
    arguments.append(last.children[0] if kernel else last)
    kernel = kernel or KERNELS["box"]
    if syntax.text == "sum":
        value = typer.value_of(arguments[0], scope)
        match value.kind.name:
            case "int":
                kind = _sum_range(kernel, value.kind.lo, value.kind.hi)
                return typer.check_range(Expr("sum", kind, (value,), kernel, span), span)
            case "vec2":
                return Expr("sum", VEC2, (value,), kernel, span)
            case "flag":
                flags = [typer.flag(value, span)]
            case _:
                value = typer.of_kind(value, REAL, arguments[0].span)
                return Expr("sum", REAL, (value,), kernel, span)
    else:
        flags = [typer.condition(argument, scope) for argument in arguments]
    return Expr("count", _sum_range(kernel, 0, 1), (disjunction(flags, span),), kernel, span)


def _sum_range(kernel: Kernel, lo: float, hi: float) -> Kind:
    """The range of a weighted sum. A neighbor outside the grid is zero, so zero is a possible summand too."""
    lo, hi = min(lo, 0), max(hi, 0)
    least: float = 0
    most: float = 0
    for _, _, weight in kernel.weights:
        least += min(weight * lo, weight * hi)
        most += max(weight * lo, weight * hi)
    return integer(least, most)


# Places and directions


def _at(typer: Typer, syntax: Syntax, scope: Scope) -> Operand:
    message, label = "`at` takes two integer constants", "not an integer constant"
    fix = "for a variable offset, loop over the values: `any(… for n in 0..3)`"
    most = MAX_MAGNITUDE
    rows, columns = (
        integer_constant(typer, c, scope, -most, most, message, label, fix) for c in syntax.children
    )
    return typer.turn(Place(typer.offset((rows, columns), syntax.span)), scope)


_QUARTERS = {"clockwise": 1, "opposite": 2, "counterclockwise": 3}


def _turn(typer: Typer, syntax: Syntax, scope: Scope) -> Operand:
    """A neighbor or direction turned clockwise, or counterclockwise in a mirrored copy of a rule."""
    (child,) = syntax.children
    operand = typer.evaluate(child, scope)
    if isinstance(operand, PlaceChoice):
        operand = typer.of_kind(operand, DIRECTION, child.span)
    (a, b), (c, d) = scope.orientation
    turns = _QUARTERS[syntax.text] * (a * d - b * c) % 4
    if isinstance(operand, Expr) and operand.kind == DIRECTION:
        for op in ("clockwise",) * (turns % 2) + ("opposite",) * (turns // 2):
            operand = Expr(op, DIRECTION, (operand,), span=syntax.span)
        return operand
    dy, dx = typer.place(operand, child.span).offset
    for _ in range(turns):
        dy, dx = dx, -dy
    return Place((dy, dx))


# Draws and numbers


def _pick(typer: Typer, syntax: Syntax, scope: Scope) -> Operand:
    """Nested choices that pick one of several values by a draw."""
    first, *children = syntax.children
    draw = typer.evaluate(first, scope)
    if not isinstance(draw, Expr) or draw.kind != DRAW:
        fix = "such as `pick(movement, left, right)`: write a stream's draw first"
        raise typer.wrong(draw, "a random draw", first.span, fix)
    operands = [(typer.evaluate(child, scope), child.span) for child in children]
    result, place = operands[-1]
    for rank in range(len(operands) - 1, 0, -1):
        limit = number(Fraction(rank, len(operands)))
        below = compare(typer, "<", (draw, first.span), (limit, first.span), syntax.span)
        result = choose(typer, below, operands[rank - 1], (result, place), syntax.span)
    return result


CALLS: dict[str, Call] = {
    **dict.fromkeys(("count", "sum"), _neighborhood),
    "at": _at,
    **dict.fromkeys(_QUARTERS, _turn),
    "pick": _pick,
}
"""Functions whose arguments need more checks than their kinds."""
