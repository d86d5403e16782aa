"""What a value under `let` still says after later moments have changed the world: what it asks of rows, columns, the step."""

from __future__ import annotations

from collections.abc import Mapping

from powderdsl.model.operands import TRUE, conjunction, disjunction, look
from powderdsl.model.types import FLAG, Expr


def lasting(lets: Mapping[str, Expr]) -> dict[str, Expr]:
    """The flags among some values, as they can be looked through later.

    Each is itself, as something unknown, and the condition on coordinates that follows from it.
    """
    found = {}
    for name, value in lets.items():
        if value.kind == FLAG:
            asked = _follows(value, lets)
            if asked != TRUE:
                found[name] = conjunction([Expr("let", FLAG, value=f"{name} before"), asked])
    return found


def _follows(expr: Expr, lets: Mapping[str, Expr]) -> Expr:
    """A condition on coordinates alone that holds wherever the expression does."""
    if all(node.op in _COORDINATES for node in expr.walk()):
        return expr
    match expr.op:
        case "and":
            return conjunction([_follows(arg, lets) for arg in expr.args])
        case "or":
            return disjunction([_follows(arg, lets) for arg in expr.args])
        case "look":
            return look(_follows(expr.args[0], lets), expr.value)
        case "let" if expr.value in lets:
            return _follows(lets[str(expr.value)], lets)
    return TRUE


_COORDINATES = frozenset(
    (
        "const",
        "coordinate",
        "not",
        "and",
        "or",
        "eq",
        "lt",
        "le",
        "add",
        "sub",
        "mul",
        "quotient",
        "neg",
        "abs",
        "mod",
    )
)
