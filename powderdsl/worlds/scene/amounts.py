"""Integers in drawing statements: constants, names, draws (`a..b`) and the arithmetic of rules."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

from powderdsl.diagnostics import Reporter, Span, suggest
from powderdsl.model.operations import OPERATIONS
from powderdsl.model.types import Expr, integer
from powderdsl.syntax.ast import Syntax
from powderdsl.syntax.yaml_tree import Scalar

AMOUNTS = {
    **{op: op for op in ("add", "sub", "mul", "quotient", "mod", "neg")},
    "div": "quotient",
    "range": "uniform",
}
"""The operation of each kind of syntax. Operands are integers, so `/` rounds down, as `div` does. ``uniform`` draws an
integer from a range that includes both ends."""

MAX_DIGITS = 9


Written = Syntax | Scalar
"""A word of a file and its location."""


def number(value: int, span: Span | None = None) -> Expr:
    """A constant."""
    return Expr("const", integer(value, value), value=value, span=span)


def constants(amounts: Iterable[Expr | None]) -> tuple[int | None, ...] | None:
    """The values of constants, None for open ends; None if an amount is not a constant."""
    values = list(amounts)
    if not all(amount is None or amount.op == "const" for amount in values):
        return None
    return tuple(None if amount is None else amount.value for amount in values)


def read_amount(
    syntax: Syntax, names: Mapping[str, Expr | None], reporter: Reporter, what: str = "a number"
) -> Expr | None:
    """Turn syntax into an integer expression with its range; constants are folded. Returns None after PD606 or PD802.

    Args:
        names: the amounts of names; None for a name whose definition has been reported.
        what: the number in words, for messages.
    """
    span, op = syntax.span, AMOUNTS.get(syntax.kind)
    if syntax.kind == "integer" and len(syntax.text) <= MAX_DIGITS:
        return number(int(syntax.text), span)
    if syntax.kind == "name" and syntax.text in names:
        named = names[syntax.text]
        return None if named is None else replace(named, span=span)
    if syntax.kind == "name":
        report_unknown("number", syntax, names, reporter)
        return None
    if op is None:
        label = "too large" if syntax.kind == "integer" else "not an integer"
        reporter.error("PD606", f"{what} must be an integer", span, label)
        return None
    operands = [read_amount(child, names, reporter, what) for child in syntax.children]
    args = tuple(operand for operand in operands if operand is not None)
    if len(args) < len(operands):
        return None
    ranges = [(int(arg.kind.lo), int(arg.kind.hi)) for arg in args]
    values = [arg.value for arg in args if arg.op == "const"]
    if op == "uniform":
        (low, first_high), (second_low, high) = ranges
        if low > high:
            label = "the first must not be above the second"
            reporter.error("PD606", f"a range {low}..{high} without numbers", span, label)
            return None
        if len(values) == 2 and low == high:
            return number(low, span)
        return Expr(op, integer(min(low, second_low), max(first_high, high)), args, span=span)
    if op in ("quotient", "mod") and ranges[1][0] <= 0 <= ranges[1][1]:
        reporter.error("PD606", "a division by zero", span, "the divisor can be 0")
        return None
    if op == "mod":
        modulus = args[1].value
        if args[1].op != "const" or modulus < 0:
            reporter.error("PD606", "`mod` takes a constant above 0", args[1].span, "not a constant above 0")
            return None
        amount = Expr("mod", integer(0, modulus - 1), args[:1], modulus, span)
    else:
        bounds = OPERATIONS[op].between(*ranges)
        assert bounds is not None
        amount = Expr(op, integer(*bounds), args, span=span)
    evaluate = OPERATIONS[op].evaluate
    if len(values) == len(args) and evaluate is not None:
        return number(evaluate(*values), span)
    return amount


def report_unknown(what: str, word: Written, known: Mapping[str, object], reporter: Reporter) -> None:
    """Report a name that the task does not define, PD802."""
    helps = suggest(word.text, known, f"{what}s") or (f"the task defines no {what}s",)
    reporter.error("PD802", f"unknown {what} `{word.text}`", word.span, "not defined", helps=helps)
