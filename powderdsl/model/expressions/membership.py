"""`X is Y` and `X in Y`: what the two sides can be, and what it means."""

from __future__ import annotations

from fractions import Fraction
from typing import TYPE_CHECKING

from powderdsl.model.expressions import arithmetic
from powderdsl.model.expressions.operands import (
    FALSE,
    TRUE,
    Absent,
    Bounds,
    Items,
    Number,
    Operand,
    Place,
    Poisoned,
    SetOf,
    Unresolved,
    conjunction,
    disjunction,
    look,
    member,
)
from powderdsl.model.types import DIRECTION, FLAG, Expr
from powderdsl.syntax.ast import Syntax

if TYPE_CHECKING:
    from powderdsl.model.expressions.typer import Typer


def holds(typer: Typer, left: Operand, right: Operand, syntax: Syntax) -> Expr:
    """Whether `left` is, or lies in, `right`."""
    span = syntax.span
    first, second = syntax.children
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
        case Expr(), Place():
            return arithmetic.compare(typer, "==", left, typer.direction(right, second.span), span)
        case _, Expr() if right.kind == DIRECTION:
            return arithmetic.compare(typer, "==", typer.direction(left, first.span), right, span)
        case _, Bounds():
            value = typer.value(left, first.span)
            low, high = Number(Fraction(right.lo)), Number(Fraction(right.hi))
            return conjunction(
                [
                    arithmetic.compare(typer, "<=", low, value, span),
                    arithmetic.compare(typer, "<=", value, high, span),
                ],
                span,
            )
        case _, Items() if any(_stands_alone(item) for item in right.items):
            return disjunction([_equals(typer, left, item, syntax) for item in right.items], span)
        case _, Number():
            raise _not_a_set(typer, syntax)
        case _, Absent():
            return FALSE
        case Absent(), _:
            raise Unresolved(left.name)
    ids = typer.set_of(right, second.span).ids
    if isinstance(left, SetOf) and left.name is None:
        raise typer.wrong(left, "a place or an element before `is`", first.span, "such as `below is …`")
    return member(typer.element(left, first.span), ids, span)


def _stands_alone(item: Operand) -> bool:
    """Whether an item of a list is compared by itself: numbers and directions. The others join to a set of elements."""
    return isinstance(item, (Number, Place)) or (isinstance(item, Expr) and item.kind == DIRECTION)


def _equals(typer: Typer, left: Operand, item: Operand, syntax: Syntax) -> Expr:
    """Whether `left` is one item of a list: numbers are compared, places and elements named."""
    if isinstance(item, Number) and not isinstance(left, Number):
        return arithmetic.compare(typer, "==", typer.value(left, syntax.children[0].span), item, syntax.span)
    return holds(typer, left, item, syntax)


def _not_a_set(typer: Typer, syntax: Syntax) -> Poisoned:
    second = syntax.children[1]
    if syntax.kind in ("is_", "is_not"):
        return typer.fail(
            "PD401", "`is` asks for an element or a direction", second.span, "this is a number",
            "compare numbers with `==`")  # fmt: skip
    fix = "a range is written `LOW..HIGH`" if second.kind == "subtract" else "compare numbers with `==`"
    return typer.fail("PD401", "`in` asks for a range or a set", second.span, "this is a number", fix)
