"""What a value under `let` still says after later substeps have changed the world: what it asks of rows, columns, the step."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import islice

from powderdsl.model.expressions.operands import TRUE, conjunction, disjunction, look
from powderdsl.model.operations import OPS
from powderdsl.model.types import FLAG, Expr

MAX_PARTS = 64
"""Parts of a condition that follows from a value; of a longer one nothing is kept, which is true of it too."""


def lasting(lets: Mapping[str, Expr]) -> dict[str, Expr]:
    """The flags among some values, in the order in which they were fixed, as they can be looked through later.

    Each is itself, as something unknown, and the condition on coordinates that follows from it.
    """
    found: dict[str, Expr] = {}
    follow: dict[str, Expr] = {}
    for name, value in lets.items():
        if value.kind != FLAG:
            continue
        asked = _follows(value, follow)
        if asked != TRUE and sum(1 for _ in islice(asked.walk(), MAX_PARTS + 1)) <= MAX_PARTS:
            follow[name] = asked
            found[name] = conjunction([Expr("let", FLAG, value=f"{name} before"), asked])
    return found


def _follows(expr: Expr, follow: Mapping[str, Expr]) -> Expr:
    """A condition on coordinates alone that holds wherever the expression does. `follow` has those of earlier values."""
    if all(node.op in _COORDINATES for node in expr.walk()):
        return expr
    match expr.op:
        case "and":
            return conjunction([*dict.fromkeys(_follows(arg, follow) for arg in expr.args)])
        case "or":
            return disjunction([*dict.fromkeys(_follows(arg, follow) for arg in expr.args)])
        case "look":
            return look(_follows(expr.args[0], follow), expr.value)
        case "let":
            return follow.get(str(expr.value), TRUE)
    return TRUE


_COORDINATES = frozenset(
    ("const", "coordinate", "and", "or", *(name for name, row in OPS.items() if row.evaluate))
)
