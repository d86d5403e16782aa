"""The functions of the line language, one checker each; `builtins.FUNCTIONS` says how they are called."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from typing import TYPE_CHECKING

from powderdsl.diagnostics import Span, suggest
from powderdsl.model.builtins import FUNCTIONS, KERNEL_SHAPES, KERNELS, MAX_RADIUS, shaped_kernel
from powderdsl.model.expressions.operators import (
    Number,
    Operand,
    Place,
    PlaceChoice,
    Scope,
    Value,
    choose,
    compare,
    disjunction,
    extreme,
    is_integer,
    kind_name,
    on_integers,
)
from powderdsl.model.expressions.symbols import ELSEWHERE
from powderdsl.model.types import DIRECTION, DRAW, FLAG, REAL, VEC2, Expr, Kernel, Kind, integer
from powderdsl.syntax.ast import Syntax

if TYPE_CHECKING:
    from powderdsl.model.expressions.typer import Typer

Call = Callable[["Typer", Syntax, Scope], Operand]


def call(typer: Typer, syntax: Syntax, scope: Scope) -> Operand:
    """The value of a function, or a kernel of a radius."""
    name, count = syntax.text, len(syntax.children)
    function = FUNCTIONS.get(name)
    if function is None and name not in KERNEL_SHAPES:
        word = Span(syntax.span.source, syntax.span.start, syntax.span.start + len(name))
        meant = ELSEWHERE.get(name.lower())
        helps = (meant,) if meant else suggest(name, [*FUNCTIONS, *KERNEL_SHAPES], "functions")
        if not helps:
            helps = (f"functions: {', '.join(f'`{known}`' for known in FUNCTIONS)}",)
        raise typer.fail("PD301", f"unknown function `{name}`", word, "not a function", *helps)
    (lo, hi), usage = (function.arity, function.signature) if function else ((1, 1), f"{name}(RADIUS)")
    if not lo <= count <= hi:
        wanted = "1 value" if lo == hi == 1 else f"{lo} values" if lo == hi else f"{lo} to {hi} values"
        message, label = f"`{name}` takes {wanted}, found {count}", "too few" if count < lo else "too many"
        raise typer.fail("PD406", message, syntax.span, label, f"write `{usage}`")
    return CALLS[name](typer, syntax, scope) if function else _shaped(typer, syntax, scope)


# Neighborhoods


def _split_kernel(typer: Typer, syntax: Syntax, scope: Scope) -> tuple[list[Syntax], Kernel]:
    """The arguments, and the kernel of a last argument `… in KERNEL`."""
    *others, last = syntax.children
    found = _kernel(typer, last.children[1], scope) if last.kind == "in_" else None
    if found is not None:
        return [*others, last.children[0]], found
    default = typer.turn(KERNELS["box"], scope)
    assert isinstance(default, Kernel)
    return [*others, last], default


def _kernel(typer: Typer, syntax: Syntax, scope: Scope) -> Kernel | None:
    """The kernel that stands after `in`, if it is one."""
    found: Operand | None = None
    if syntax.kind == "name" and (syntax.text not in KERNEL_SHAPES or syntax.text in KERNELS):
        found = typer.find(syntax.text, syntax.span, scope)
    elif syntax.kind in ("name", "call") and syntax.text in KERNEL_SHAPES:
        found = typer.evaluate(syntax, scope)
    return found if isinstance(found, Kernel) else None


def _shaped(typer: Typer, syntax: Syntax, scope: Scope) -> Kernel:
    (argument,) = syntax.children
    value = typer.evaluate(argument, scope)
    if not isinstance(value, Number) or not is_integer(value):
        label = f"expected 1 to {MAX_RADIUS}"
        raise typer.fail("PD405", "a radius is an integer constant", argument.span, label)
    radius = int(value.value)
    if not 1 <= radius <= MAX_RADIUS:
        label = f"a radius lies in 1..{MAX_RADIUS}"
        raise typer.fail("PD402", f"a kernel of radius {radius}", argument.span, label)
    return shaped_kernel(syntax.text, radius)


def _count(typer: Typer, syntax: Syntax, scope: Scope) -> Expr:
    arguments, kernel = _split_kernel(typer, syntax, scope)
    flag = disjunction([typer.condition(argument, scope) for argument in arguments], syntax.span)
    return Expr("count", _sum_range(kernel, 0, 1), (flag,), kernel, syntax.span)


def _sum(typer: Typer, syntax: Syntax, scope: Scope) -> Expr:
    (argument,), kernel = _split_kernel(typer, syntax, scope)
    value = typer.value_of(argument, scope)
    match kind_name(value):
        case "flag":
            return _count(typer, syntax, scope)
        case "int":
            assert isinstance(value, Expr)
            kind = _sum_range(kernel, value.kind.lo, value.kind.hi)
            return typer.bounded(Expr("sum", kind, (value,), kernel, syntax.span), syntax.span)
        case "vec2":
            return Expr("sum", VEC2, (value,), kernel, syntax.span)  # type: ignore[arg-type]  # a vector is an Expr
    return Expr("sum", REAL, (typer.real(value, argument.span),), kernel, syntax.span)


def _sum_range(kernel: Kernel, lo: float, hi: float) -> Kind:
    """The range of a weighted sum. A neighbor outside the grid counts as zero, so it is a summand too."""
    lo, hi = min(lo, 0), max(hi, 0)
    ends = [sorted((w * lo, w * hi)) for _, _, w in kernel.weights]
    return integer(sum(end[0] for end in ends), sum(end[1] for end in ends))


# Places and vectors


def _at(typer: Typer, syntax: Syntax, scope: Scope) -> Operand:
    steps = []
    for child in syntax.children:
        value = typer.evaluate(child, scope)
        if not isinstance(value, Number) or not is_integer(value):
            label = "not an integer constant"
            fix = "where it varies, loop over the values: `any(… for n in 0..3)`"
            raise typer.fail("PD405", "`at` takes two integer constants", child.span, label, fix)
        steps.append(int(value.value))
    return typer.turn(Place(typer.offset((steps[0], steps[1]), syntax.span)), scope)


def _inside(typer: Typer, syntax: Syntax, scope: Scope) -> Expr:
    place = typer.place(typer.evaluate(syntax.children[0], scope), syntax.children[0].span)
    return Expr("inside", FLAG, value=place.offset, span=syntax.span)


def _of_vector(op: str, kind: Kind) -> Call:
    """A function of one vector."""

    def check(typer: Typer, syntax: Syntax, scope: Scope) -> Expr:
        (child,) = syntax.children
        return Expr(op, kind, (typer.vector(typer.evaluate(child, scope), child.span),), span=syntax.span)

    return check


def _vector(typer: Typer, syntax: Syntax, scope: Scope) -> Expr:
    parts = tuple(typer.real(typer.evaluate(child, scope), child.span) for child in syntax.children)
    return Expr("vector", VEC2, parts, span=syntax.span)


def _turned(quarters: int) -> Call:
    """A function that turns a neighbor or a direction clockwise; a mirrored copy of a rule turns it the other way."""

    def check(typer: Typer, syntax: Syntax, scope: Scope) -> Operand:
        operand = typer.evaluate(syntax.children[0], scope)
        if isinstance(operand, PlaceChoice):
            operand = typer.direction(operand, syntax.children[0].span)
        (a, b), (c, d) = scope.orientation
        turns = quarters * (a * d - b * c) % 4
        if isinstance(operand, Expr) and operand.kind == DIRECTION:
            result = operand
            for op in ("clockwise",) * (turns % 2) + ("opposite",) * (turns // 2):
                result = Expr(op, DIRECTION, (result,), span=syntax.span)
            return result
        dy, dx = typer.place(operand, syntax.children[0].span).offset
        for _ in range(turns):
            dy, dx = dx, -dy
        return Place((dy, dx))

    return check


# Draws


def _pick(typer: Typer, syntax: Syntax, scope: Scope) -> Operand:
    """One of several values by a draw, as choices between them."""
    first, *children = syntax.children
    draw = typer.evaluate(first, scope)
    if not isinstance(draw, Expr) or draw.kind != DRAW:
        fix = "such as `pick(movement, left, right)`: a stream's draw comes first"
        raise typer.wrong(draw, "a random draw", first.span, fix)
    operands = [(typer.evaluate(child, scope), child.span) for child in children]
    result, place = operands[-1]
    for number in range(len(operands) - 1, 0, -1):
        limit = Number(Fraction(number, len(operands)))
        below = compare(typer, "<", (draw, first.span), (limit, first.span), syntax.span)
        result = choose(typer, below, operands[number - 1], (result, place), syntax.span)
    return result


# Numbers


def _of_number(op: str) -> Call:
    """A function of one float."""

    def check(typer: Typer, syntax: Syntax, scope: Scope) -> Expr:
        (child,) = syntax.children
        return Expr(op, REAL, (typer.real(typer.evaluate(child, scope), child.span),), span=syntax.span)

    return check


def _extreme(typer: Typer, syntax: Syntax, scope: Scope) -> Value:
    values = [typer.value_of(child, scope) for child in syntax.children]
    return extreme(typer, syntax.text, values, syntax.span)


def _abs(typer: Typer, syntax: Syntax, scope: Scope) -> Value:
    value = typer.value_of(syntax.children[0], scope)
    if isinstance(value, Number):
        return Number(abs(value.value))
    if value.kind.name == "int":
        return on_integers(typer, "abs", (value,), syntax.span)
    return Expr("abs", REAL, (typer.real(value, syntax.children[0].span),), span=syntax.span)


def _clamp(typer: Typer, syntax: Syntax, scope: Scope) -> Value:
    value, low, high = (typer.value_of(child, scope) for child in syntax.children)
    least, most = _bounds_of(low), _bounds_of(high)
    if least is not None and most is not None and least[0] > most[1]:
        words = [child.span.text for child in syntax.children]
        message, label = "the bounds of `clamp` are the wrong way round", "below the other bound"
        fix = f"write `clamp({words[0]}, {words[2]}, {words[1]})`"
        raise typer.fail("PD406", message, syntax.children[2].span, label, fix)
    raised = extreme(typer, "max", [value, low], syntax.span)
    return extreme(typer, "min", [raised, high], syntax.span)


def _bounds_of(value: Value) -> tuple[Fraction | float, Fraction | float] | None:
    """The least and the greatest value of a number, if they are known."""
    if isinstance(value, Number) or (value.op == "const" and isinstance(value.value, (int, float))):
        return value.value, value.value
    return (value.kind.lo, value.kind.hi) if value.kind.name == "int" else None


CALLS: dict[str, Call] = {
    "count": _count,
    "sum": _sum,
    "at": _at,
    "inside": _inside,
    "octant": _of_vector("octant", DIRECTION),
    "length": _of_vector("length", REAL),
    "vector": _vector,
    "min": _extreme,
    "max": _extreme,
    "abs": _abs,
    "clamp": _clamp,
    "opposite": _turned(2),
    "clockwise": _turned(1),
    "counterclockwise": _turned(3),
    "pick": _pick,
    "sin": _of_number("sin"),
    "cos": _of_number("cos"),
}
