"""Constants as written -> values of a kind: defaults, parameters, cells of a drawn field."""

from __future__ import annotations

from powderdsl.model.expressions.operands import Unresolved
from powderdsl.model.expressions.scope import Scope
from powderdsl.model.expressions.symbols import number_value
from powderdsl.model.expressions.typer import Typer
from powderdsl.model.types import Kind, Value
from powderdsl.syntax.ast import Syntax


def constant_of(syntax: Syntax, kind: Kind, scope: Scope, typer: Typer) -> Value:
    """The value of a constant expression. Raises Poisoned after reporting what is wrong with it."""
    try:
        value = typer.of_kind(typer.evaluate(syntax, scope), kind, syntax.span)
    except Unresolved as asleep:
        raise typer.fail("PD301", f"unknown name `{asleep.name}`", syntax.span) from None
    if value.op != "const" and not (value.op == "vector" and all(arg.op == "const" for arg in value.args)):
        raise typer.fail("PD405", "expected a constant", syntax.span, "depends on the world")
    return number_value(value, kind)
