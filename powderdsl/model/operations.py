"""Every operation of the model in one table: what its `value` is, and what it gives for known arguments or between bounds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from powderdsl.model.types import Expr

Bounds = tuple[Any, Any]


@dataclass(frozen=True)
class Operation:
    """A row of `OPS`.

    evaluate: the exact value for the values of the arguments. The search of `logic.satisfy` gives up on an operation
        without it, unless it has a case of its own there.
    bounds: between which numbers the value lies, for the bounds of the arguments; flags are 0, 1, False or True.
        Without it an integer has those of its kind, and a value whose arguments are known is known.
    """

    about: str = ""
    evaluate: Callable[..., Any] | None = None
    bounds: Callable[..., Bounds] | None = None


def _chosen_bounds(node: Expr, condition: Bounds, yes: Bounds, no: Bounds) -> Bounds:
    if condition[0] == condition[1]:
        return yes if condition[0] else no
    return min(yes[0], no[0]), max(yes[1], no[1])


def _product_bounds(node: Expr, a: Bounds, b: Bounds) -> Bounds:
    products = [x * y for x in a for y in b]
    return min(products), max(products)


def _abs_bounds(node: Expr, a: Bounds) -> Bounds:
    return (0 if a[0] <= 0 <= a[1] else min(abs(a[0]), abs(a[1]))), max(abs(a[0]), abs(a[1]))


def _turned(about: str, eighths: int) -> Operation:
    """An operation that turns a direction clockwise."""

    def bounds(node: Expr, a: Bounds) -> Bounds:
        return ((a[0] + eighths) % 8,) * 2 if a[0] == a[1] else (0, 7)

    return Operation(about, evaluate=lambda node, a: (a + eighths) % 8, bounds=bounds)


OPS: dict[str, Operation] = {
    "const": Operation("value: the constant"),
    "param": Operation("value: the parameter's qualified name"),
    "element": Operation("the element of this cell"),
    "property": Operation(
        "value: the property's name, as this cell's element has it (or as the cell overrides it)"
    ),
    "field": Operation("value: the field's name, or a pass's scratch field"),
    "let": Operation("value: the name of a value fixed earlier in the pass"),
    "draw": Operation("value: the stream's name; a number strictly between 0 and 1"),
    "coordinate": Operation("value: (row, column or step, modulus)"),
    "inside": Operation("value: offset; whether that neighbor lies inside the grid"),
    "look": Operation("value: offset; the argument as it is at that neighbor (the grid wraps around)"),
    "member": Operation(
        "value: frozen set of ids; whether the argument is one of them",
        evaluate=lambda node, a: a in node.value,
    ),
    "not": Operation(evaluate=lambda node, a: not a, bounds=lambda node, a: (1 - a[1], 1 - a[0])),
    "and": Operation(bounds=lambda node, a, b: (a[0] and b[0], a[1] and b[1])),
    "or": Operation(bounds=lambda node, a, b: (a[0] or b[0], a[1] or b[1])),
    "eq": Operation(
        evaluate=lambda node, a, b: a == b,
        bounds=lambda node, a, b: (a[0] == a[1] == b[0] == b[1], a[0] <= b[1] and b[0] <= a[1]),
    ),
    "lt": Operation(evaluate=lambda node, a, b: a < b, bounds=lambda node, a, b: (a[1] < b[0], a[0] < b[1])),
    "le": Operation(
        evaluate=lambda node, a, b: a <= b, bounds=lambda node, a, b: (a[1] <= b[0], a[0] <= b[1])
    ),
    "add": Operation(evaluate=lambda node, a, b: a + b, bounds=lambda node, a, b: (a[0] + b[0], a[1] + b[1])),
    "sub": Operation(evaluate=lambda node, a, b: a - b, bounds=lambda node, a, b: (a[0] - b[1], a[1] - b[0])),
    "mul": Operation(evaluate=lambda node, a, b: a * b, bounds=_product_bounds),
    "div": Operation("real division; x / 0 is 0"),
    "quotient": Operation(
        "integer division, rounded down; x div 0 is 0", evaluate=lambda node, a, b: a // b if b else 0
    ),
    "neg": Operation(evaluate=lambda node, a: -a, bounds=lambda node, a: (-a[1], -a[0])),
    "abs": Operation(evaluate=lambda node, a: abs(a), bounds=_abs_bounds),
    "min": Operation(
        evaluate=lambda node, a, b: min(a, b), bounds=lambda node, a, b: (min(a[0], b[0]), min(a[1], b[1]))
    ),
    "max": Operation(
        evaluate=lambda node, a, b: max(a, b), bounds=lambda node, a, b: (max(a[0], b[0]), max(a[1], b[1]))
    ),
    "mod": Operation("value: the modulus, an integer above 0", evaluate=lambda node, a: a % node.value),
    "to_real": Operation("an int, flag or chance as float32; a draw rounded to float32"),
    "count": Operation("value: kernel; weighted number of neighborhood cells where the argument holds"),
    "sum": Operation(
        "value: kernel; weighted sum of the argument, within a row from the left, then the rows from the top"
    ),
    "choose": Operation("condition, value if it holds, value otherwise", bounds=_chosen_bounds),
    "octant": Operation("the direction a vec2 points to"),
    "opposite": _turned("the direction the other way", 4),
    "clockwise": _turned("the direction a quarter turn to the right", 2),
    "length": Operation("√(y² + x²) in float32"),
    "sin": Operation("the sine of a float32, see `model.reference`"),
    "cos": Operation("the cosine of a float32"),
    "row_part": Operation("the first component of a vec2"),
    "column_part": Operation("the second component of a vec2"),
    "vector": Operation("a vec2 from its two components"),
}
"""Every operation of the model."""
