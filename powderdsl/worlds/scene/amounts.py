"""Integers in statements: written out, named, drawn (`a..b`), and arithmetic on them."""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from powderdsl.diagnostics import Span

Interval = tuple[int, int]
"""Lowest and highest value."""


@dataclass(frozen=True)
class Amount:
    """A number of a statement.

    `op`: ``number`` (value: int), ``name`` (value: str), ``draw`` (two arguments: uniform, both ends included),
    ``add sub mul div mod neg``; ``div`` and ``mod`` round down.
    """

    op: str
    args: tuple[Amount, ...] = ()
    value: int | str | None = None
    span: Span | None = field(default=None, compare=False, repr=False)

    def walk(self) -> Iterator[Amount]:
        """This amount and everything in it."""
        yield self
        for arg in self.args:
            yield from arg.walk()

    @property
    def is_number(self) -> bool:
        return self.op == "number"

    @property
    def integer(self) -> int:
        """The value of a number; of others 0."""
        return self.value if isinstance(self.value, int) else 0


def integers(amounts: Iterable[Amount | None]) -> tuple[int | None, ...] | None:
    """The values of numbers that are written out, None for open ends; None if one is drawn or named."""
    found = list(amounts)
    if not all(one is None or one.is_number for one in found):
        return None
    return tuple(None if one is None else one.integer for one in found)


def number(value: int, span: Span | None = None) -> Amount:
    return Amount("number", (), value, span)


CALCULATE: dict[str, Callable[[Any, Any], Any]] = {
    "add": operator.add,
    "sub": operator.sub,
    "mul": operator.mul,
    "div": operator.floordiv,
    "mod": operator.mod,
}
"""Operations on integers, or on tensors of them. Integers divided by 0 raise ZeroDivisionError."""


def filled_in(amount: Amount, values: Mapping[str, int]) -> Amount:
    """The amount with named numbers filled in and arithmetic on numbers done, except for divisions by 0."""
    if amount.op == "name" and amount.value in values:
        return number(values[str(amount.value)], amount.span)
    args = tuple(filled_in(arg, values) for arg in amount.args)
    if args and all(arg.is_number for arg in args):
        first, *rest = (arg.integer for arg in args)
        if amount.op == "neg":
            return number(-first, amount.span)
        divided = amount.op in ("div", "mod")
        if amount.op != "draw" and not (divided and rest[0] == 0):
            return number(CALCULATE[amount.op](first, rest[0]), amount.span)
        if not divided and first == rest[0]:
            return number(first, amount.span)
    return Amount(amount.op, args, amount.value, amount.span)


def interval(amount: Amount, names: Mapping[str, Interval]) -> Interval:
    """The lowest and highest value that the amount can have. Raises KeyError for an unknown name, ZeroDivisionError if a divisor may be 0."""
    if amount.op == "number":
        return amount.integer, amount.integer
    if amount.op == "name":
        return names[str(amount.value)]
    first, *rest = (interval(arg, names) for arg in amount.args)
    if amount.op == "neg":
        return -first[1], -first[0]
    second = rest[0]
    if amount.op == "draw":
        return min(first[0], second[0]), max(first[1], second[1])
    if amount.op in ("div", "mod") and second[0] <= 0 <= second[1]:
        raise ZeroDivisionError
    if amount.op == "mod":
        return (0, second[1] - 1) if second[0] > 0 else (second[0] + 1, 0)
    corners = [CALCULATE[amount.op](a, b) for a in first for b in second]
    return min(corners), max(corners)
