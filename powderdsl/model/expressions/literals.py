"""Numbers as written -> exact numbers. No float is involved: `2%` is 1/50."""

from __future__ import annotations

from fractions import Fraction

from powderdsl.model.builtins import MAX_MAGNITUDE
from powderdsl.model.expressions.operands import Coercer
from powderdsl.syntax.ast import Syntax


def read_number(syntax: Syntax, coercer: Coercer) -> Fraction:
    """The exact value of an integer, decimal or percentage literal."""
    text = syntax.text
    if syntax.kind == "integer" and len(text) > 1 and text[0] == "0":
        raise coercer.fail(
            "PD110",
            f"`{text}` starts with a zero",
            syntax.span,
            "not a plain number",
            f"write `{text.lstrip('0') or '0'}`",
        )
    if "e" in text.lower() and abs(int(text.lower().split("e")[1])) > 12:
        raise coercer.fail(
            "PD402", f"`{text}` is too large or too small", syntax.span, f"the limit is {MAX_MAGNITUDE:,}"
        )
    value = Fraction(text.removesuffix("%"))
    if syntax.kind == "percent":
        value /= 100
    if abs(value) > MAX_MAGNITUDE:
        raise coercer.fail("PD402", f"`{text}` is too large", syntax.span, f"the limit is {MAX_MAGNITUDE:,}")
    return value


def read_bounds(syntax: Syntax, coercer: Coercer) -> tuple[int, int]:
    """`LOW..HIGH` with whole literals."""
    if syntax.kind != "range":
        raise coercer.fail("PD401", "expected a range", syntax.span, "such as `0..7`")
    bounds = []
    for end in syntax.children:
        sign, literal = (-1, end.children[0]) if end.kind == "negate" else (1, end)
        if literal.kind != "integer":
            raise coercer.fail("PD405", "a range has integers at its ends", end.span, "not an integer")
        bounds.append(sign * int(read_number(literal, coercer)))
    lo, hi = bounds
    if lo > hi:
        raise coercer.fail(
            "PD402", "a range that runs backwards", syntax.span, f"{lo} is above {hi}", f"write `{hi}..{lo}`"
        )
    return lo, hi
