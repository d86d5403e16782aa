"""Calls of functions: by the kinds of their arguments in `operations`, or one checker each where that is not enough."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from fractions import Fraction
from functools import lru_cache, reduce
from typing import TYPE_CHECKING

from powderdsl.diagnostics import Reporter, Source, Span, suggest
from powderdsl.model.builtins import KERNEL_SHAPES, KERNELS, MAX_RADIUS, shaped_kernel
from powderdsl.model.expressions.operators import (
    Number,
    Operand,
    Place,
    PlaceChoice,
    Placed,
    Scope,
    Value,
    arithmetic,
    choose,
    compare,
    disjunction,
    kind_name,
    whole_constant,
)
from powderdsl.model.expressions.symbols import ELSEWHERE
from powderdsl.model.operations import FUNCTIONS, NUMBER, PLACE, Operation
from powderdsl.model.types import DIRECTION, DRAW, REAL, VEC2, Expr, Kernel, Kind, integer
from powderdsl.syntax.ast import Syntax
from powderdsl.syntax.parse import parse_text

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
    lo = len(function.parameters) if function else 1
    hi, usage = (function.most or lo, function.usage) if function else (1, f"{name}(RADIUS)")
    if not lo <= count <= hi:
        wanted = "1 value" if lo == hi == 1 else f"{lo} values" if lo == hi else f"{lo} to {hi} values"
        message, label = f"`{name}` takes {wanted}, found {count}", "too few" if count < lo else "too many"
        raise typer.fail("PD406", message, syntax.span, label, f"write `{usage}`")
    if function is None:
        return _shaped(typer, syntax, scope)
    if name in CALLS:
        return CALLS[name](typer, syntax, scope)
    operands = [(typer.evaluate(child, scope), child.span) for child in syntax.children]
    if function.meaning:
        return _meant(typer, function, operands, syntax.span)
    return _applied(typer, function, operands, syntax.span)


def _applied(typer: Typer, function: Operation, operands: list[tuple[Operand, Span]], span: Span) -> Operand:
    """An operation on arguments of the kinds that it takes."""
    if NUMBER in function.takes:
        first, *others = ((typer.value(*operand), operand[1]) for operand in operands)
        if not others:
            return arithmetic(typer, function.name, [first], span)
        return reduce(lambda a, b: (arithmetic(typer, function.name, [a, b], span), span), others, first)[0]
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


def _meant(
    typer: Typer, function: Operation, operands: Sequence[tuple[Operand, Span]], span: Span
) -> Operand:
    """What a call stands for. Mistakes are shown at the arguments, or at the call."""
    places = {name: place for name, (_, place) in zip(function.parameters, operands, strict=True)}

    def placed(node: Syntax) -> Syntax:
        return replace(node, children=tuple(map(placed, node.children)), span=places.get(node.text, span))

    names = {name: operand for name, (operand, _) in zip(function.parameters, operands, strict=True)}
    result = typer.evaluate(placed(_meaning(function)), Scope("", names))
    # An argument that the meaning repeats is copied, which doubles from call to call.
    typer.spend(sum(1 for _ in result.walk()) if isinstance(result, Expr) else 1, span)
    return result


# Neighborhoods


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
    radius = whole_constant(typer.evaluate(argument, scope))
    if radius is None:
        label = f"expected 1 to {MAX_RADIUS}"
        raise typer.fail("PD405", "a radius is an integer constant", argument.span, label)
    if not 1 <= radius <= MAX_RADIUS:
        label = f"a radius lies in 1..{MAX_RADIUS}"
        raise typer.fail("PD402", f"a kernel of radius {radius}", argument.span, label)
    return shaped_kernel(syntax.text, radius)


def _neighborhood(typer: Typer, syntax: Syntax, scope: Scope) -> Expr:
    """`count` and `sum`: of the arguments, over the kernel of a last argument `… in KERNEL`."""
    span = syntax.span
    *arguments, last = syntax.children
    kernel = _kernel(typer, last.children[1], scope) if last.kind == "in_" else None
    arguments.append(last.children[0] if kernel else last)
    kernel = kernel or KERNELS["box"]
    if syntax.text == "sum":
        value = typer.value_of(arguments[0], scope)
        match kind_name(value):
            case "int":
                assert isinstance(value, Expr)
                kind = _sum_range(kernel, value.kind.lo, value.kind.hi)
                return typer.bounded(Expr("sum", kind, (value,), kernel, span), span)
            case "vec2":
                return Expr("sum", VEC2, (value,), kernel, span)  # type: ignore[arg-type]  # a vector is an Expr
            case "flag":
                flags = [typer.flag(value, span)]
            case _:
                number = typer.of_kind(value, REAL, arguments[0].span)
                return Expr("sum", REAL, (number,), kernel, span)
    else:
        flags = [typer.condition(argument, scope) for argument in arguments]
    return Expr("count", _sum_range(kernel, 0, 1), (disjunction(flags, span),), kernel, span)


def _sum_range(kernel: Kernel, lo: float, hi: float) -> Kind:
    """The range of a weighted sum. A neighbor outside the grid counts as zero, so it is a summand too."""
    lo, hi = min(lo, 0), max(hi, 0)
    ends = [sorted((w * lo, w * hi)) for _, _, w in kernel.weights]
    return integer(sum(end[0] for end in ends), sum(end[1] for end in ends))


# Places and directions


def _at(typer: Typer, syntax: Syntax, scope: Scope) -> Operand:
    steps = []
    for child in syntax.children:
        step = whole_constant(typer.evaluate(child, scope))
        if step is None:
            label = "not an integer constant"
            fix = "where it varies, loop over the values: `any(… for n in 0..3)`"
            raise typer.fail("PD405", "`at` takes two integer constants", child.span, label, fix)
        steps.append(step)
    return typer.turn(Place(typer.offset((steps[0], steps[1]), syntax.span)), scope)


_QUARTERS = {"clockwise": 1, "opposite": 2, "counterclockwise": 3}


def _turned(typer: Typer, syntax: Syntax, scope: Scope) -> Operand:
    """A neighbor or a direction turned clockwise; a mirrored copy of a rule turns it the other way."""
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


def _clamp(typer: Typer, syntax: Syntax, scope: Scope) -> Operand:
    operands: list[Placed] = [(typer.value_of(child, scope), child.span) for child in syntax.children]
    least, most = _bounds_of(operands[1][0]), _bounds_of(operands[2][0])
    if least is not None and most is not None and least[0] > most[1]:
        words = [child.span.text for child in syntax.children]
        message, label = "the bounds of `clamp` are the wrong way round", "below the other bound"
        fix = f"write `clamp({words[0]}, {words[2]}, {words[1]})`"
        raise typer.fail("PD406", message, syntax.children[2].span, label, fix)
    return _meant(typer, FUNCTIONS["clamp"], operands, syntax.span)


def _bounds_of(value: Value) -> tuple[Fraction | float, Fraction | float] | None:
    """The least and the greatest value of a number, if they are known."""
    if isinstance(value, Number):
        return value.value, value.value
    return (value.kind.lo, value.kind.hi) if value.kind.name == "int" else None


CALLS: dict[str, Call] = {
    **dict.fromkeys(("count", "sum"), _neighborhood),
    "at": _at,
    **dict.fromkeys(_QUARTERS, _turned),
    "pick": _pick,
    "clamp": _clamp,
}
"""Functions whose arguments need more than to be of a kind."""
