"""Values under `let` that some conditions ask for by name: a contradiction between them needs no search.

`if wants and not right.wants` asks for one value here and denies it on the right: for two such cells side by side,
whatever the value depends on, the conditions exclude each other.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from powderdsl.model.types import Expr, Offset

Literal = tuple[str, Offset]
"""The name of a value, and the place where it is asked for."""


def contradict(conditions: Sequence[tuple[Expr, Offset]]) -> bool:
    """Whether one of the conditions needs a value to hold at a place where another one needs that it does not."""
    found: dict[Literal, bool] = {}
    return any(
        found.setdefault(literal, holds) != holds
        for condition, at in conditions
        for literal, holds in _literals([(condition, at, True)])
    )


def _literals(waiting: Iterable[tuple[Expr, Offset, bool]]) -> Iterator[tuple[Literal, bool]]:
    """What must hold, or must not, for conditions to be as they are said to be."""
    stack = list(waiting)
    while stack:
        expr, at, holds = stack.pop()
        match expr.op:
            case "let":
                yield (str(expr.value), at), holds
            case "not":
                stack.append((expr.args[0], at, not holds))
            case "look":
                stack.append((expr.args[0], (at[0] + expr.value[0], at[1] + expr.value[1]), holds))
            case "and" if holds:
                stack += [(arg, at, True) for arg in expr.args]
            case "or" if not holds:
                stack += [(arg, at, False) for arg in expr.args]
