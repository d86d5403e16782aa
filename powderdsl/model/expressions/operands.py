"""What a piece of syntax can stand for while it is checked, and how one kind becomes another.

Compile-time operands (sets, places, numbers) vanish before the checked model; `Expr` stays.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from fractions import Fraction

from powderdsl.diagnostics import Label, Reporter, Span
from powderdsl.model.builtins import MAX_MAGNITUDE, MAX_OFFSET, OCTANTS
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


@dataclass(frozen=True)
class SetOf:
    """A set of elements, ids ascending. `name` is given if it was written as one element's name."""

    ids: tuple[int, ...]
    name: str | None = None


@dataclass(frozen=True)
class Place:
    """This cell or a neighbor. As a value it is the element found there."""

    offset: Offset


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
    """A parenthesised list."""

    items: tuple[Operand, ...]


@dataclass(frozen=True)
class Absent:
    """`name?` of something that no loaded pack defines."""

    name: str


@dataclass(frozen=True)
class Broken:
    """A name whose definition has been reported: using it is not a second mistake."""


Operand = Expr | SetOf | Place | Number | Bounds | Items | Kernel | Absent | Broken


class Poisoned(Exception):
    """This expression has been reported already: whatever contains it stays silent."""


class Unresolved(Exception):
    """This rule needs `name`, which no loaded pack defines, and says so with a `?`."""

    def __init__(self, name: str):
        super().__init__(name)
        self.name = name


MAX_CHAIN = 16
"""Longest chain of `and` or `or` that nests to one side: what walks expressions recurses."""

ELEMENT_HERE = Expr("element", ELEMENT)
TRUE, FALSE = Expr("const", FLAG, value=1), Expr("const", FLAG, value=0)


def describe(operand: Operand) -> str:
    """An operand's kind in words, for messages."""
    match operand:
        case Expr():
            return {"int": "an integer", "flag": "a condition", "element": "an element", "direction": "a direction",
                    "chance": "a chance", "draw": "a random draw", "real": "a float", "vec2": "a vector"}.get(operand.kind.name, "a number")  # fmt: skip
        case SetOf():
            return "an element" if operand.name else "a set of elements"
        case Place():
            return "a place"
        case Number():
            return "a number"
        case Bounds():
            return "a range"
        case Items():
            return "a list"
        case Kernel():
            return "a kernel"
        case Absent():
            return f"`{operand.name}`, which is not loaded"
    return "something broken"


class Coercer:
    """Turns operands into the kind that their place wants, or reports why not."""

    def __init__(self, reporter: Reporter):
        self.reporter = reporter
        self._misused: set[tuple[Span, str]] = set()

    def fail(self, code: str, message: str, span: Span, label: str = "", *helps: str) -> Poisoned:
        """Report an error; the exception to raise after it."""
        self.reporter.error(code, message, span, label, helps=helps)
        return Poisoned()

    def wrong(self, operand: Operand, wanted: str, span: Span, *helps: str) -> Poisoned:
        if isinstance(operand, Broken):
            return Poisoned()
        found = describe(operand)
        secondary = []
        if (
            isinstance(operand, Expr)
            and operand.op == "let"
            and operand.span is not None
            and operand.span != span
        ):
            if (operand.span, wanted) in self._misused:
                return Poisoned()  # one value of the wrong kind is one mistake, however often it is used
            self._misused.add((operand.span, wanted))
            secondary = [Label(operand.span, "its value, set here")]
        self.reporter.error(
            "PD401",
            f"expected {wanted}, found {found}",
            span,
            f"this is {found}",
            secondary=secondary,
            helps=helps,
        )
        return Poisoned()

    def flag(self, operand: Operand, span: Span) -> Expr:
        match operand:
            case Expr() if operand.kind == FLAG:
                return operand
            case SetOf():
                return member(ELEMENT_HERE, operand.ids, span)
            case Items():
                return self.flag(self.set_of(operand, span), span)
            case Absent():
                return FALSE
            case Expr() if operand.kind.name == "int":
                raise self.wrong(operand, "a condition", span, "compare it: `… > 0`")
            case Expr() if operand.kind.name == "draw":
                raise self.wrong(operand, "a condition", span, "compare it with a chance: `… < 5%`")
            case Place():
                raise self.wrong(operand, "a condition", span, "say what is there: `… is ELEMENT`")
        raise self.wrong(operand, "a condition", span)

    def set_of(self, operand: Operand, span: Span) -> SetOf:
        match operand:
            case SetOf():
                return operand
            case Absent():
                return SetOf(())
            case Items():
                ids: set[int] = set()
                for item in operand.items:
                    ids |= set(self.set_of(item, span).ids)
                return SetOf(tuple(sorted(ids)))
        raise self.wrong(operand, "a set of elements", span)

    def place(self, operand: Operand, span: Span) -> Place:
        if isinstance(operand, Place):
            return operand
        if isinstance(operand, Absent):
            raise Unresolved(operand.name)
        raise self.wrong(operand, "a neighbor", span, "such as `below`, `above.left`, or `at(2, -1)`")

    def element(self, operand: Operand, span: Span) -> Expr:
        match operand:
            case Expr() if operand.kind == ELEMENT:
                return operand
            case Place():
                return look(ELEMENT_HERE, operand.offset, span)
            case SetOf() if operand.name is not None:
                return Expr("const", ELEMENT, value=operand.ids[0], span=span)
            case SetOf():
                raise self.wrong(operand, "one element", span, "name the element itself")
            case Absent():
                raise Unresolved(operand.name)
        raise self.wrong(operand, "an element", span)

    def value(self, operand: Operand, span: Span) -> Expr | Number:
        """A runtime value or a number: what arithmetic and comparison work on."""
        match operand:
            case Expr() | Number():
                return operand
            case Place():
                return look(ELEMENT_HERE, operand.offset, span)
            case SetOf() if operand.name is not None:
                return self.element(operand, span)
            case SetOf():
                return self.flag(operand, span)
            case Absent():
                raise Unresolved(operand.name)
        raise self.wrong(operand, "a value", span)

    def real(self, operand: Operand, span: Span) -> Expr:
        value = self.value(operand, span)
        if isinstance(value, Number):
            return Expr("const", REAL, value=float(value.value), span=span)
        if value.kind.name == "real":
            return value
        if value.kind.name == "draw" and value.op in (
            "add",
            "sub",
        ):  # as floats: a rounding an operation
            return Expr(value.op, REAL, tuple(self.real(arg, span) for arg in value.args), span=span)
        if value.kind.name == "draw" and value.op == "look":
            return look(self.real(value.args[0], span), value.value, span)
        if value.kind.name in ("int", "chance", "draw", "flag"):
            return Expr("to_real", REAL, (value,), span=span)
        raise self.wrong(value, "a number", span)

    def whole(self, operand: Operand, span: Span) -> Expr:
        value = self.value(operand, span)
        if isinstance(value, Number):
            if value.value.denominator != 1:
                raise self.fail(
                    "PD401", "expected an integer", span, f"{float(value.value):g} is not whole",
                    "write an integer; a field may also be declared as `real(LOW..HIGH)`")  # fmt: skip
            return constant(value, span)
        if value.kind.name == "int":
            return value
        raise self.wrong(value, "an integer", span, *_whole_helps(value, span))

    def chance(self, operand: Operand, span: Span) -> Expr:
        """A probability: a constant within 0..1, or a property, parameter or field that is one."""
        value = self.value(operand, span)
        if isinstance(value, Number):
            if not 0 <= value.value <= 1:
                shown = f"{float(value.value * 100):g}%"
                meant = 1 < value.value <= 100 and "%" not in span.text
                fix = (
                    f"did you mean `{float(value.value):g}%`?"
                    if meant
                    else "write a chance from `0%` to `100%`"
                )
                raise self.fail("PD403", f"a chance of {shown}", span, "chances lie in 0%..100%", fix)
            return Expr("const", CHANCE, value=value.value, span=span)
        if value.kind.name in ("chance", "real"):
            return value
        if value.kind.name == "int":
            return self.real(value, span)
        raise self.wrong(value, "a chance", span, "such as `5%`, or a parameter")

    def of_kind(self, operand: Operand, kind: Kind, span: Span) -> Expr:
        """A value to store in something of `kind`. Constants out of range are reported."""
        match kind.name:
            case "flag":
                if isinstance(operand, Number) and operand.value in (0, 1):
                    return Expr("const", FLAG, value=int(operand.value), span=span)
                return self.flag(operand, span)
            case "element":
                return self.element(operand, span)
            case "direction":
                return self.direction(operand, span)
            case "chance":
                return self.chance(operand, span)
            case "vec2":
                if isinstance(operand, Number) and operand.value == 0:
                    zero = Expr("const", REAL, value=0.0, span=span)
                    return Expr("vector", VEC2, (zero, zero), span=span)
                value = self.value(operand, span)
                if isinstance(value, Expr) and value.kind.name == "vec2":
                    return value
                raise self.wrong(value, "a vector", span, "such as `vector(1, 0)`: rows down, columns right")
            case "real":
                value = self.real(operand, span)
            case _:
                value = self.whole(operand, span)
        if (
            value.op == "const"
            and isinstance(value.value, (int, float))
            and not kind.lo <= value.value <= kind.hi
        ):
            raise self.fail(
                "PD402",
                f"{value.value:g} lies outside {kind}",
                span,
                f"the range is {kind.lo:g}..{kind.hi:g}",
                "write a number in this range, or widen it where it is declared",
            )
        return value

    def direction(self, operand: Operand, span: Span) -> Expr:
        if isinstance(operand, Place):
            if operand.offset in OCTANTS:
                return Expr("const", DIRECTION, value=OCTANTS.index(operand.offset), span=span)
            raise self.fail("PD401", "not a direction", span, "directions are the eight neighbors")
        if isinstance(operand, Expr) and operand.kind == DIRECTION:
            return operand
        if isinstance(operand, Absent):
            raise Unresolved(operand.name)
        raise self.wrong(operand, "a direction", span, "such as `left`, or `octant(…)`")

    def offset(self, offset: Offset, span: Span) -> Offset:
        if max(abs(offset[0]), abs(offset[1])) > MAX_OFFSET:
            raise self.fail(
                "PD409", "a neighbor too far away", span, f"rules reach {MAX_OFFSET} cells a step"
            )
        return offset

    def bounded(self, value: Expr, span: Span) -> Expr:
        """An integer whose declared range is still reasonable."""
        if max(abs(value.kind.lo), abs(value.kind.hi)) > MAX_MAGNITUDE:
            raise self.fail(
                "PD402",
                f"numbers up to {max(abs(value.kind.lo), abs(value.kind.hi)):,}",
                span,
                f"the limit is {MAX_MAGNITUDE:,}",
            )
        return value


def _whole_helps(value: Expr, span: Span) -> tuple[str, ...]:
    """What to write instead of a float where a whole one is wanted."""
    if value.kind.name != "real":
        return ()
    declared = "or declare what takes it as `real(LOW..HIGH)`"
    whole = all(arg.op in ("to_real", "const") for arg in value.args)
    if value.op == "div" and whole and span.text.count("/") == 1:
        left, _, right = span.text.partition("/")
        return (f"integer division rounds down: `{left.strip()} div {right.strip()}`", declared)
    factor = next((arg.value for arg in value.args if arg.op == "const"), None)
    if value.op == "mul" and whole and isinstance(factor, (int, float)) and span.text.count("*") == 1:
        number = next(
            part.strip() for part in span.text.split("*") if not re.fullmatch(r"[-\d.eE%\s]+", part)
        )
        ratio = Fraction(factor).limit_denominator(1000)
        times = "" if ratio.numerator == 1 else f" * {ratio.numerator}"
        return (f"integers stay whole: `{number}{times} div {ratio.denominator}`", declared)
    return ("`a div b` divides integers and rounds down", declared)


def constant(number: Number, span: Span | None = None) -> Expr:
    """A number as a constant: an int if it is whole, else a real."""
    if number.value.denominator == 1:
        whole = int(number.value)
        return Expr("const", integer(whole, whole), value=whole, span=span)
    return Expr("const", REAL, value=float(number.value), span=span)


def look(value: Expr, offset: Offset, span: Span | None = None) -> Expr:
    """The value as it is at a neighbor; looks of looks add up, constants are the same everywhere."""
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
    kept: list[Expr] = []
    for value in values:
        if value == FALSE:
            return FALSE
        if value != TRUE:
            kept.append(value)
    return _joined("and", kept, span) if kept else TRUE


def disjunction(values: list[Expr], span: Span | None = None) -> Expr:
    """Any of them, constants folded."""
    kept: list[Expr] = []
    for value in values:
        if value == TRUE:
            return TRUE
        if value != FALSE:
            kept.append(value)
    return _joined("or", kept, span) if kept else FALSE


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
