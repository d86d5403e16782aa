"""Operands, which syntax stands for while it is checked; the scope where it stands; how expressions are put together.

Compile-time operands (sets, places, numbers) vanish before the checked model; `Expr` stays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction

from powderdsl.diagnostics import Span
from powderdsl.model.types import ELEMENT, FLAG, REAL, Expr, Kernel, Offset, integer

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
