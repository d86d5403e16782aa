"""Turns operands into the kind that their place needs, and literals into exact numbers, or reports why not."""

from __future__ import annotations

import re
from fractions import Fraction

from powderdsl.diagnostics import Label, Reporter, Span
from powderdsl.model.builtins import MAX_MAGNITUDE, MAX_OFFSET, OCTANTS
from powderdsl.model.expressions.operators import (
    ELEMENT_HERE,
    FALSE,
    Absent,
    Bounds,
    Broken,
    Items,
    Number,
    Operand,
    Place,
    PlaceChoice,
    Poisoned,
    SetOf,
    Unresolved,
    constant,
    look,
    member,
)
from powderdsl.model.types import CHANCE, DIRECTION, ELEMENT, FLAG, REAL, VEC2, Expr, Kernel, Kind, Offset
from powderdsl.syntax.ast import Syntax

_KINDS = {
    "int": "an integer",
    "flag": "a condition",
    "element": "an element",
    "direction": "a direction",
    "chance": "a chance",
    "draw": "a random draw",
    "real": "a float",
    "vec2": "a vector",
}
_HELPS = {
    "chance": ("such as `5%`, or a parameter",),
    "vec2": ("such as `vector(1, 0)`: rows down, columns right",),
    "direction": ("such as `left`, or `octant(…)`",),
}
"""What to write where a value of a kind is needed."""

_OPERANDS: dict[type, str] = {
    Place: "a place",
    PlaceChoice: "a choice of places",
    Number: "a number",
    Bounds: "a range",
    Items: "a list",
    Kernel: "a kernel",
}


def describe(operand: Operand) -> str:
    """An operand's kind in words, for messages."""
    match operand:
        case Expr():
            return _KINDS.get(operand.kind.name, "a number")
        case SetOf():
            return "an element" if operand.name else "a set of elements"
        case Absent():
            return f"`{operand.name}`, which is not loaded"
    return _OPERANDS.get(type(operand), "something broken")


class Coercer:
    """Turns operands into the kind that their place needs, or reports why not."""

    def __init__(self, reporter: Reporter):
        self.reporter = reporter
        self._misused: set[tuple[Span, str]] = set()

    def fail(self, code: str, message: str, span: Span, label: str = "", *helps: str) -> Poisoned:
        """Report an error; the exception to raise after it."""
        self.reporter.error(code, message, span, label, helps=helps)
        return Poisoned()

    def wrong(self, operand: Operand, wanted: str, span: Span, *helps: str) -> Poisoned:
        """Report an operand of the wrong kind; the exception to raise after it."""
        if isinstance(operand, Broken):
            return Poisoned()
        secondary = []
        if isinstance(operand, Expr) and operand.op == "let" and operand.span not in (None, span):
            assert operand.span is not None
            if (operand.span, wanted) in self._misused:
                return Poisoned()  # one value of the wrong kind is one mistake, however often it is used
            self._misused.add((operand.span, wanted))
            secondary = [Label(operand.span, "its value, set here")]
        found = describe(operand)
        message, label = f"expected {wanted}, found {found}", f"this is {found}"
        self.reporter.error("PD401", message, span, label, secondary=secondary, helps=helps)
        return Poisoned()

    def flag(self, operand: Operand, span: Span) -> Expr:
        match operand:
            case Expr() if operand.kind == FLAG:
                return operand
            case SetOf() | Items():
                return member(ELEMENT_HERE, self.set_of(operand, span).ids, span)
            case Absent():
                return FALSE
        kind = operand.kind.name if isinstance(operand, Expr) else type(operand).__name__
        fix = {
            "int": "compare it: `… > 0`",
            "draw": "compare it with a chance: `… < 5%`",
            "Place": "name the element at that place: `… is ELEMENT`",
        }.get(kind)
        raise self.wrong(operand, "a condition", span, *([fix] if fix else []))

    def set_of(self, operand: Operand, span: Span) -> SetOf:
        match operand:
            case SetOf():
                return operand
            case Absent():
                return SetOf(())
            case Items():
                ids = {number for item in operand.items for number in self.set_of(item, span).ids}
                return SetOf(tuple(sorted(ids)))
        raise self.wrong(operand, "a set of elements", span)

    def place(self, operand: Operand, span: Span) -> Place:
        if isinstance(operand, Place):
            return operand
        if isinstance(operand, Absent):
            raise Unresolved(operand.name)
        raise self.wrong(operand, "a neighbor", span, "such as `below`, `above.left`, or `at(2, -1)`")

    def value(self, operand: Operand, span: Span) -> Expr | Number:
        """A runtime value or a number, as arithmetic and comparisons need."""
        match operand:
            case Expr() | Number():
                return operand
            case SetOf(_, None):
                return self.flag(operand, span)
            case SetOf() | Place() | PlaceChoice() | Absent():
                return self.of_kind(operand, ELEMENT, span)
        raise self.wrong(operand, "a value", span)

    def of_kind(self, operand: Operand, kind: Kind, span: Span) -> Expr:
        """A value of a kind, as arguments and fields need it. Constants out of its range are reported."""
        match kind.name, operand:
            case "flag", Number() if operand.value in (0, 1):
                return Expr("const", FLAG, value=int(operand.value), span=span)
            case "flag", _:
                return self.flag(operand, span)
            case _, Absent():
                raise Unresolved(operand.name)
            case "element" | "direction", PlaceChoice():
                ways = (self.of_kind(operand.yes, kind, span), self.of_kind(operand.no, kind, span))
                return Expr("choose", kind, (operand.condition, *ways), span=span)
            case "element", Place():
                return look(ELEMENT_HERE, operand.offset, span)
            case "element", SetOf():
                if operand.name is None:
                    raise self.wrong(operand, "one element", span, "name the element itself")
                return Expr("const", ELEMENT, value=operand.ids[0], span=span)
            case "direction", Place():
                if operand.offset not in OCTANTS:
                    raise self.fail("PD401", "not a direction", span, "directions are the eight neighbors")
                return Expr("const", DIRECTION, value=OCTANTS.index(operand.offset), span=span)
        value = operand if kind.name in ("element", "direction") else self.value(operand, span)
        if isinstance(value, Number):
            return self._constant(value.value, kind, span)
        if isinstance(value, Expr):
            if value.kind.name == kind.name:
                return value
            converted = self._converted(value, kind, span)
            if converted is not None:
                return converted
        helps = (
            _integer_helps(value, span)
            if kind.name == "int" and isinstance(value, Expr)
            else _HELPS.get(kind.name, ())
        )
        raise self.wrong(value, "a number" if kind.name == "real" else _KINDS[kind.name], span, *helps)

    def _converted(self, value: Expr, kind: Kind, span: Span) -> Expr | None:
        """A number as a float or a chance. Draws that integers were added to are rounded after each operation."""
        source = value.kind.name
        if kind.name == "chance":
            return (
                value if source == "real" else self._converted(value, REAL, span) if source == "int" else None
            )
        if kind.name != "real" or source not in ("int", "chance", "draw", "flag"):
            return None
        if source == "draw" and value.op in ("add", "sub"):
            return Expr(value.op, REAL, tuple(self.of_kind(arg, REAL, span) for arg in value.args), span=span)
        if source == "draw" and value.op == "look":
            return look(self.of_kind(value.args[0], REAL, span), value.value, span)
        return Expr("to_real", REAL, (value,), span=span)

    def _constant(self, number: Fraction, kind: Kind, span: Span) -> Expr:
        """A number written in a rule, as a constant of a kind."""
        match kind.name:
            case "vec2" if number == 0:
                zero = Expr("const", REAL, value=0.0, span=span)
                return Expr("vector", VEC2, (zero, zero), span=span)
            case "chance" if 0 <= number <= 1:
                return Expr("const", CHANCE, value=number, span=span)
            case "chance":
                fix = "write a chance from `0%` to `100%`"
                if 1 < number <= 100 and "%" not in span.text:
                    fix = f"did you mean `{float(number):g}%`?"
                message = f"a chance of {float(number * 100):g}%"
                raise self.fail("PD403", message, span, "chances lie in 0%..100%", fix)
            case "int" if number.denominator != 1:
                label = f"{float(number):g} is not whole"
                fix = "write an integer; a field may also be declared as `real(LOW..HIGH)`"
                raise self.fail("PD401", "expected an integer", span, label, fix)
            case "int" | "real":
                if kind != REAL and not kind.lo <= number <= kind.hi:
                    label = f"the range is {kind.lo:g}..{kind.hi:g}"
                    fix = "write a number in this range, or widen it where it is declared"
                    raise self.fail("PD402", f"{float(number):g} lies outside {kind}", span, label, fix)
                if kind.name == "int":
                    return constant(Number(number), span)
                return Expr("const", REAL, value=float(number), span=span)
        raise self.wrong(Number(number), _KINDS[kind.name], span, *_HELPS.get(kind.name, ()))

    def offset(self, offset: Offset, span: Span) -> Offset:
        """An offset that rules can reach."""
        if max(abs(offset[0]), abs(offset[1])) > MAX_OFFSET:
            label = f"rules reach {MAX_OFFSET} cells a step"
            raise self.fail("PD409", "the neighbor is too far away", span, label)
        return offset

    def bounded(self, value: Expr, span: Span) -> Expr:
        """An integer; reports a range that is too large."""
        most = max(abs(value.kind.lo), abs(value.kind.hi))
        if most > MAX_MAGNITUDE:
            raise self.fail("PD402", f"numbers up to {most:,}", span, f"the limit is {MAX_MAGNITUDE:,}")
        return value


def _integer_helps(value: Expr, span: Span) -> tuple[str, ...]:
    """What to write instead of a float where an integer is wanted."""
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


# Literals: no float is involved, `2%` is 1/50


def read_number(syntax: Syntax, coercer: Coercer) -> Fraction:
    """The exact value of an integer, decimal or percentage literal."""
    text = syntax.text
    if syntax.kind == "integer" and len(text) > 1 and text[0] == "0":
        fix = f"write `{text.lstrip('0') or '0'}`"
        raise coercer.fail("PD110", f"`{text}` starts with a zero", syntax.span, "not a plain number", fix)
    limit = f"the limit is {MAX_MAGNITUDE:,}"
    if "e" in text.lower() and abs(int(text.lower().split("e")[1])) > 12:
        raise coercer.fail("PD402", f"`{text}` is too large or too small", syntax.span, limit)
    value = Fraction(text.removesuffix("%"))
    if syntax.kind == "percent":
        value /= 100
    if abs(value) > MAX_MAGNITUDE:
        raise coercer.fail("PD402", f"`{text}` is too large", syntax.span, limit)
    return value


def read_bounds(syntax: Syntax, coercer: Coercer) -> tuple[int, int]:
    """The bounds of `LOW..HIGH`, integer literals."""
    if syntax.kind != "range":
        raise coercer.fail("PD401", "expected a range", syntax.span, "such as `0..7`")
    bounds = []
    for end in syntax.children:
        sign, literal = (-1, end.children[0]) if end.kind == "neg" else (1, end)
        if literal.kind != "integer":
            raise coercer.fail("PD405", "a range has integers at its ends", end.span, "not an integer")
        bounds.append(sign * int(read_number(literal, coercer)))
    lo, hi = bounds
    if lo > hi:
        label, fix = f"{lo} is above {hi}", f"write `{hi}..{lo}`"
        raise coercer.fail("PD402", "a range that runs backwards", syntax.span, label, fix)
    return lo, hi
