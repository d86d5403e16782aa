"""Every operation of the language, in one table.

The words of functions, their arguments' kinds, the folding of constants, ranges of integers, the search of
`logic.satisfy`, the printed model, the lowering, random rules and the table in `docs/language/expressions.md` follow from it. The
oracle, `model.reference`, has its own table.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import Any

from powderdsl.model.types import DIRECTION, FLAG, REAL, VEC2, Kind

Bounds = tuple[Any, Any]

INTEGER = Kind("int", -math.inf, math.inf)
NUMBER, PLACE = Kind("number"), Kind("place")
"""Kinds of arguments: any integer; integers, which stay integers, or else floats; a neighbor, which becomes the `value`."""


@dataclass(frozen=True)
class Operation:
    """A row of `OPERATIONS`.

    about: one sentence, which for functions appears in `docs/language/expressions.md`. `value` is the further argument
        of an `Expr` of this operation.
    usage: the syntax of a call; empty for operations with another syntax.
    takes: the kinds of the arguments. Without them, a function has its own check in `expressions.operators`.
    gives: the kind of the result. Without one, it is an integer with the range of `between`, or a float.
    most: the maximum number of arguments, if more than in `usage`.
    meaning: an equivalent expression of the language, in the names of the arguments.
    sign, binds: the operator between its arguments, or before one, and its precedence.
    lowers: its operation in the IR, if that has another name.
    evaluate: the exact value for the values of the arguments, and `value` if there is one.
    monotone: the extremes of the value are at extremes of the arguments.
    bounds: the bounds of the value for those of the arguments, if it is not monotone.
    """

    name: str
    about: str = ""
    usage: str = ""
    takes: tuple[Kind, ...] = ()
    gives: Kind | None = None
    most: int = 0
    meaning: str = ""
    sign: str = ""
    binds: int = 0
    lowers: str = ""
    evaluate: Callable[..., Any] | None = None
    monotone: bool = False
    bounds: Callable[..., Bounds] | None = None

    @property
    def parameters(self) -> list[str]:
        """The names of a function's arguments."""
        return self.usage.partition("(")[2].rstrip(")").removesuffix(", …").split(", ")

    def between(self, *bounds: Bounds) -> Bounds | None:
        """The bounds of the value for those of the arguments, if known; flags are 0, 1, False or True."""
        if self.bounds is not None:
            return self.bounds(*bounds)
        if not self.monotone or self.evaluate is None:
            return None
        values = [self.evaluate(*corner) for corner in product(*bounds)]
        return min(values), max(values)


def _abs_bounds(a: Bounds) -> Bounds:
    return 0 if a[0] <= 0 <= a[1] else min(map(abs, a)), max(map(abs, a))


def _quotient_bounds(a: Bounds, b: Bounds) -> Bounds:
    """The bounds of a quotient by divisors of one sign: the extremes are at the ends of both ranges."""
    divisors = [d for d in (b[0], min(b[1], -1), max(b[0], 1), b[1]) if d and b[0] <= d <= b[1]]
    corners = [x // d for x in a for d in divisors] + [0] * (b[0] <= 0 <= b[1])
    return min(corners), max(corners)


_TABLE = (
    # Where values come from
    Operation("const", "value: the constant"),
    Operation("param", "value: the parameter's qualified name"),
    Operation("element", "the element of this cell"),
    Operation(
        "property", "value: the name of the property, of this cell's element or overridden in the cell"
    ),
    Operation("field", "value: the field's name, or a pass's scratch field"),
    Operation("let", "value: the name of a value fixed earlier in the pass"),
    Operation("draw", "value: the stream's name; a number strictly between 0 and 1"),
    Operation("coordinate", "value: (row, column or step, modulus)"),
    # Neighborhoods
    Operation(
        "count",
        "the number of cells in the neighborhood that match; `box` by default",
        "count(SET in KERNEL)",
        most=16,
    ),
    Operation("sum", "the weighted sum of a value over the neighborhood", "sum(VALUE in KERNEL)"),
    Operation("at", "the neighbor ROWS down and COLUMNS right", "at(ROWS, COLUMNS)"),
    Operation(
        "inside",
        "whether that neighbor is inside the grid",
        "inside(PLACE)",
        (PLACE,),
        FLAG,
    ),
    Operation("look", "value: offset; the argument at that neighbor (the grid wraps around)"),
    # Vectors
    Operation("octant", "the direction a vector points to", "octant(VEC2)", (VEC2,), DIRECTION),
    Operation("length", "the length of a vector", "length(VEC2)", (VEC2,), REAL),
    Operation("vector", "a vector of two numbers", "vector(ROWS, COLUMNS)", (REAL, REAL), VEC2),
    Operation("row_part", "the first component of a vec2"),
    Operation("column_part", "the second component of a vec2"),
    # Numbers
    Operation("min", "the smallest number", "min(A, B)", (NUMBER,), most=8, evaluate=min, monotone=True),
    Operation("max", "the largest number", "max(A, B)", (NUMBER,), most=8, evaluate=max, monotone=True),
    Operation("abs", "the absolute value", "abs(A)", (NUMBER,), evaluate=abs, bounds=_abs_bounds),
    Operation(
        "clamp", "the number, limited to the bounds", "clamp(A, LOW, HIGH)", meaning="min(max(A, LOW), HIGH)"
    ),
    Operation("add", sign="+", binds=5, evaluate=operator.add, monotone=True),
    Operation("sub", sign="-", binds=5, evaluate=operator.sub, monotone=True),
    Operation("mul", sign="*", binds=6, evaluate=operator.mul, monotone=True),
    Operation("div", "real division; x / 0 is 0", sign="/", binds=6, evaluate=lambda a, b: a / b if b else 0),
    Operation(
        "quotient",
        "integer division, rounded down; x div 0 is 0",
        sign="div",
        binds=6,
        evaluate=lambda a, b: a // b if b else 0,
        bounds=_quotient_bounds,
    ),
    Operation("mod", "value: the modulus, an integer above 0", sign="mod", binds=6, evaluate=operator.mod),
    Operation("neg", sign="-", binds=7, evaluate=operator.neg, monotone=True),
    Operation("to_real", "an int, flag or chance as float32; a draw rounded to float32"),
    # Directions and choices
    Operation(
        "opposite",
        "the opposite neighbor or direction",
        "opposite(PLACE)",
        evaluate=lambda a: (a + 4) % 8,
    ),
    Operation(
        "clockwise",
        "the neighbor or direction a quarter turn clockwise",
        "clockwise(PLACE)",
        evaluate=lambda a: (a + 2) % 8,
    ),
    Operation(
        "counterclockwise",
        "the neighbor or direction a quarter turn counterclockwise",
        "counterclockwise(PLACE)",
    ),
    Operation("pick", "one of the values, all equally likely", "pick(DRAW, A, B, …)", most=17),
    Operation(
        "choose",
        "condition, value if it holds, value otherwise",
        lowers="select",
        evaluate=lambda condition, yes, no: yes if condition else no,
        monotone=True,
    ),
    # Waves
    Operation("sin", "the sine of an angle in radians", "sin(A)", (REAL,), REAL),
    Operation("cos", "the cosine of an angle in radians", "cos(A)", (REAL,), REAL),
    # Conditions
    Operation(
        "member",
        "value: frozen set of ids; whether the argument is one of them",
        lowers="in_set",
        evaluate=lambda a, ids: a in ids,
    ),
    Operation(
        "eq",
        sign="==",
        binds=4,
        evaluate=operator.eq,
        bounds=lambda a, b: (a[0] == a[1] == b[0] == b[1], a[0] <= b[1] and b[0] <= a[1]),
    ),
    Operation("lt", sign="<", binds=4, evaluate=operator.lt, monotone=True),
    Operation("le", sign="<=", binds=4, evaluate=operator.le, monotone=True),
    Operation("not", sign="not ", binds=3, evaluate=operator.not_, monotone=True),
    Operation("and", sign="and", binds=2, evaluate=lambda a, b: a and b, monotone=True),
    Operation("or", sign="or", binds=1, evaluate=lambda a, b: a or b, monotone=True),
)

OPERATIONS: dict[str, Operation] = {row.name: row for row in _TABLE}
"""Every operation of the language. The model does not contain `at`, `pick`, or functions with a `meaning`."""

FUNCTIONS: dict[str, Operation] = {row.name: row for row in _TABLE if row.usage}
"""The operations that rules call by name."""

COMPARISONS: dict[str, str] = {row.sign: row.name for row in _TABLE if row.binds == OPERATIONS["eq"].binds}
"""The operations that compare, by their signs."""
