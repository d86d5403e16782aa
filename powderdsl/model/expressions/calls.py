"""The functions of the line language, one checker each; `builtins.FUNCTIONS` says how they are called."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from typing import TYPE_CHECKING

from powderdsl.diagnostics import Span, suggest
from powderdsl.model.builtins import FUNCTIONS, KERNEL_SHAPES, KERNELS, MAX_RADIUS, shaped_kernel
from powderdsl.model.expressions import arithmetic
from powderdsl.model.expressions.operands import Number, Operand, Place, disjunction
from powderdsl.model.expressions.unknown import ELSEWHERE
from powderdsl.model.types import DIRECTION, FLAG, REAL, VEC2, Expr, Kernel, integer
from powderdsl.syntax.ast import Syntax

if TYPE_CHECKING:
    from powderdsl.model.expressions.scope import Scope
    from powderdsl.model.expressions.typer import Typer


def _split_kernel(typer: Typer, syntax: Syntax, scope: Scope) -> tuple[list[Syntax], Kernel]:
    """The arguments, and the kernel of a last argument `… in KERNEL`."""
    arguments = list(syntax.children)
    last = arguments[-1]
    if last.kind == "in_":
        found = _kernel(typer, last.children[1], scope)
        if found is not None:
            arguments[-1] = last.children[0]
            return arguments, found
    default = typer.turn(KERNELS["box"], scope)
    assert isinstance(default, Kernel)
    return arguments, default


def _kernel(typer: Typer, syntax: Syntax, scope: Scope) -> Kernel | None:
    """The kernel that stands after `in`, if it is one."""
    if syntax.kind == "name" and (syntax.text not in KERNEL_SHAPES or syntax.text in KERNELS):
        found = typer.find(syntax.text, syntax.span, scope)
    elif syntax.kind in ("name", "call") and syntax.text in KERNEL_SHAPES:
        found = typer.evaluate(syntax, scope)
    else:
        return None
    return found if isinstance(found, Kernel) else None


def read_radius(typer: Typer, syntax: Syntax, scope: Scope) -> int:
    """The radius of a kernel: an integer constant."""
    value = typer.evaluate(syntax, scope)
    if not isinstance(value, Number) or value.value.denominator != 1:
        raise typer.fail(
            "PD405", "a radius is an integer constant", syntax.span, f"expected 1 to {MAX_RADIUS}"
        )
    radius = int(value.value)
    if not 1 <= radius <= MAX_RADIUS:
        label = f"a radius lies in 1..{MAX_RADIUS}"
        raise typer.fail("PD402", f"a kernel of radius {radius}", syntax.span, label)
    return radius


def _shaped(typer: Typer, syntax: Syntax, scope: Scope) -> Operand:
    return shaped_kernel(syntax.text, read_radius(typer, syntax.children[0], scope))


def call(typer: Typer, syntax: Syntax, scope: Scope) -> Operand:
    """The value of a function, or a kernel of a radius."""
    name = syntax.text
    name_span = Span(syntax.span.source, syntax.span.start, syntax.span.start + len(name))
    function = FUNCTIONS.get(name)
    if function is None and name not in KERNEL_SHAPES:
        meant = ELSEWHERE.get(name.lower())
        helps = (meant,) if meant else suggest(name, [*FUNCTIONS, *KERNEL_SHAPES], "functions")
        if not helps:
            helps = (f"functions: {', '.join(f'`{known}`' for known in FUNCTIONS)}",)
        raise typer.fail("PD301", f"unknown function `{name}`", name_span, "not a function", *helps)
    (lo, hi), usage = (function.arity, function.signature) if function else ((1, 1), f"{name}(RADIUS)")
    count = len(syntax.children)
    if not lo <= count <= hi:
        wanted = "1 value" if lo == hi == 1 else f"{lo} values" if lo == hi else f"{lo} to {hi} values"
        raise typer.fail(
            "PD406",
            f"`{name}` takes {wanted}, found {count}",
            syntax.span,
            "too few" if count < lo else "too many",
            f"write `{usage}`",
        )
    return CALLS[name](typer, syntax, scope) if function else _shaped(typer, syntax, scope)


def _count(typer: Typer, syntax: Syntax, scope: Scope) -> Operand:
    arguments, kernel = _split_kernel(typer, syntax, scope)
    flag = disjunction([typer.condition(argument, scope) for argument in arguments], syntax.span)
    weights = [w for _, _, w in kernel.weights]
    kind = integer(sum(w for w in weights if w < 0), sum(w for w in weights if w > 0))
    return Expr("count", kind, (flag,), kernel, syntax.span)


def _sum(typer: Typer, syntax: Syntax, scope: Scope) -> Operand:
    (argument,), kernel = _split_kernel(typer, syntax, scope)
    value = typer.value(typer.evaluate(argument, scope), argument.span)
    if isinstance(value, Expr) and value.kind.name == "flag":
        return _count(typer, syntax, scope)
    if isinstance(value, Expr) and value.kind.name == "int":
        # A neighbor outside the grid counts as zero, so the range of each summand includes it.
        lo, hi = min(value.kind.lo, 0), max(value.kind.hi, 0)
        ends = [sorted((w * lo, w * hi)) for _, _, w in kernel.weights]
        kind = integer(sum(e[0] for e in ends), sum(e[1] for e in ends))
        return typer.bounded(Expr("sum", kind, (value,), kernel, syntax.span), syntax.span)
    if isinstance(value, Expr) and value.kind.name == "vec2":
        return Expr("sum", VEC2, (value,), kernel, syntax.span)
    return Expr("sum", REAL, (typer.real(value, argument.span),), kernel, syntax.span)


def _at(typer: Typer, syntax: Syntax, scope: Scope) -> Operand:
    steps = []
    for child in syntax.children:
        value = typer.evaluate(child, scope)
        if not isinstance(value, Number) or value.value.denominator != 1:
            fix = "where it varies, loop over the values: `any(… for n in 0..3)`"
            raise typer.fail(
                "PD405", "`at` takes two whole constants", child.span, "not an integer constant", fix
            )
        steps.append(int(value.value))
    place = Place(typer.offset((steps[0], steps[1]), syntax.span))
    return typer.turn(place, scope)


def _inside(typer: Typer, syntax: Syntax, scope: Scope) -> Operand:
    place = typer.place(typer.evaluate(syntax.children[0], scope), syntax.children[0].span)
    return Expr("inside", FLAG, value=place.offset, span=syntax.span)


def _vector_argument(typer: Typer, syntax: Syntax, scope: Scope) -> Expr:
    child = syntax.children[0]
    return typer.of_kind(typer.evaluate(child, scope), VEC2, child.span)


def _octant(typer: Typer, syntax: Syntax, scope: Scope) -> Operand:
    return Expr("octant", DIRECTION, (_vector_argument(typer, syntax, scope),), span=syntax.span)


def _length(typer: Typer, syntax: Syntax, scope: Scope) -> Operand:
    return Expr("length", REAL, (_vector_argument(typer, syntax, scope),), span=syntax.span)


def _vector(typer: Typer, syntax: Syntax, scope: Scope) -> Operand:
    parts = tuple(typer.real(typer.evaluate(child, scope), child.span) for child in syntax.children)
    return Expr("vector", VEC2, parts, span=syntax.span)


def _extreme(typer: Typer, syntax: Syntax, scope: Scope) -> Operand:
    values = [
        (typer.value(typer.evaluate(child, scope), child.span), child.span) for child in syntax.children
    ]
    return arithmetic.extreme(typer, syntax.text, values, syntax.span)


def _abs(typer: Typer, syntax: Syntax, scope: Scope) -> Operand:
    child = syntax.children[0]
    value = typer.value(typer.evaluate(child, scope), child.span)
    if isinstance(value, Number):
        return Number(abs(value.value))
    if value.kind.name == "int":
        hi = max(abs(value.kind.lo), abs(value.kind.hi))
        lo = 0 if value.kind.lo <= 0 <= value.kind.hi else min(abs(value.kind.lo), abs(value.kind.hi))
        return Expr("abs", integer(lo, hi), (value,), span=syntax.span)
    return Expr("abs", REAL, (typer.real(value, child.span),), span=syntax.span)


def _clamp(typer: Typer, syntax: Syntax, scope: Scope) -> Operand:
    value, low, high = ((typer.value(typer.evaluate(c, scope), c.span), c.span) for c in syntax.children)
    least, most = _bounds_of(low[0]), _bounds_of(high[0])
    if least is not None and most is not None and least[0] > most[1]:
        raise typer.fail(
            "PD406",
            "the bounds of `clamp` are the wrong way round",
            high[1],
            "below the other bound",
            f"write `clamp({value[1].text}, {high[1].text}, {low[1].text})`",
        )
    raised = arithmetic.extreme(typer, "max", [value, low], syntax.span)
    return arithmetic.extreme(
        typer, "min", [(typer.value(raised, syntax.span), syntax.span), high], syntax.span
    )


def _bounds_of(value: Expr | Number) -> tuple[Fraction | float, Fraction | float] | None:
    """The least and the greatest value of a number, if they are known."""
    if isinstance(value, Number):
        return value.value, value.value
    if value.op == "const" and isinstance(value.value, (int, float)):
        return value.value, value.value
    return (value.kind.lo, value.kind.hi) if value.kind.name == "int" else None


def _opposite(typer: Typer, syntax: Syntax, scope: Scope) -> Operand:
    span = syntax.children[0].span
    operand = typer.evaluate(syntax.children[0], scope)
    if isinstance(operand, Expr) and operand.kind == DIRECTION:
        return Expr("opposite", DIRECTION, (operand,), span=syntax.span)
    place = typer.place(operand, span)
    return Place((-place.offset[0], -place.offset[1]))


CALLS: dict[str, Callable[[Typer, Syntax, Scope], Operand]] = {
    "count": _count,
    "sum": _sum,
    "at": _at,
    "inside": _inside,
    "octant": _octant,
    "length": _length,
    "vector": _vector,
    "min": _extreme,
    "max": _extreme,
    "abs": _abs,
    "clamp": _clamp,
    "opposite": _opposite,
}
