"""A random numeric expression, and arithmetic that keeps its bounds."""

from __future__ import annotations

from dataclasses import dataclass

from powderdsl.model.builtins import MAX_MAGNITUDE

LIMIT = MAX_MAGNITUDE // 2
"""Largest magnitude of an integer expression."""


@dataclass(frozen=True)
class Number:
    """A numeric expression. Integers have bounds; `fixed`: the compiler may fold it to a constant."""

    text: str
    lo: float = 0
    hi: float = 0
    fixed: bool = False

    def __str__(self) -> str:
        return self.text

    @property
    def reach(self) -> float:
        """The largest magnitude."""
        return max(abs(self.lo), abs(self.hi))

    def within_limit(self) -> Number | None:
        """The number, or None if it may be too large for the compiler."""
        return self if self.reach <= LIMIT else None

    def __neg__(self) -> Number:
        return Number(f"(-{self})", -self.hi, -self.lo, self.fixed)

    def __abs__(self) -> Number:
        return Number(f"abs({self})", 0, self.reach, self.fixed)

    def __add__(self, other: Number) -> Number:
        return Number(
            f"({self} + {other})", self.lo + other.lo, self.hi + other.hi, self.fixed and other.fixed
        )

    def __sub__(self, other: Number) -> Number:
        return Number(
            f"({self} - {other})", self.lo - other.hi, self.hi - other.lo, self.fixed and other.fixed
        )

    def __mul__(self, other: Number) -> Number:
        corners = [a * b for a in (self.lo, self.hi) for b in (other.lo, other.hi)]
        return Number(f"({self} * {other})", min(corners), max(corners), self.fixed and other.fixed)

    def __floordiv__(self, by: int) -> Number:
        ends = self.lo // by, self.hi // by
        return Number(f"({self} div {by})", min(ends), max(ends))

    def clamped(self, lo: float, hi: float) -> Number:
        return Number(f"clamp({self}, {lo:g}, {hi:g})", lo, hi, self.fixed)
