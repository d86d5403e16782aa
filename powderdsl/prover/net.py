"""Circuits of gates with structural hashing.

A literal is twice the number of a gate, plus one where it is negated: 0 is false, 1 is true, ``a ^ 1`` is not a.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import reduce
from typing import Any

Literal = int

FALSE, TRUE = 0, 1


class Net:
    """Creates gates: ``and``, ``xor``, ``choice`` (second input if the first is true, else third), ``variable``.

    Equal gates are one object; gates of constants and of equal or opposite literals fold. Gate 0 is the constant.
    """

    def __init__(self) -> None:
        self.kinds = ["constant"]
        self.args: list[tuple[Literal, ...]] = [()]
        self.inputs: list[tuple[int, ...]] = [()]
        """The numbers of the gates that each gate reads."""
        self.names: dict[int, tuple[Any, ...]] = {}
        """The names of variables."""
        self._numbers: dict[tuple[object, ...], int] = {}
        self._members: dict[tuple[tuple[Literal, ...], int], Literal] = {}

    @property
    def size(self) -> int:
        return len(self.kinds)

    def _gate(self, kind: str, *args: Literal) -> Literal:
        key = (kind, *args)
        number = self._numbers.get(key)
        if number is None:
            number = self._numbers[key] = len(self.kinds)
            self.kinds.append(kind)
            self.args.append(args)
            self.inputs.append(tuple([literal >> 1 for literal in args]))
        return 2 * number

    def variable(self, *name: Any) -> Literal:
        """The variable of this name."""
        number = self._numbers.get(name)
        if number is None:
            number = self._numbers[name] = len(self.kinds)
            self.kinds.append("variable")
            self.args.append(())
            self.inputs.append(())
            self.names[number] = name
        return 2 * number

    def and_(self, a: Literal, b: Literal) -> Literal:
        if a == b or b == TRUE:
            return a
        if a == TRUE:
            return b
        if a == FALSE or b == FALSE or a == b ^ 1:
            return FALSE
        return self._gate("and", *((a, b) if a < b else (b, a)))

    def or_(self, a: Literal, b: Literal) -> Literal:
        return self.and_(a ^ 1, b ^ 1) ^ 1

    def xor(self, a: Literal, b: Literal) -> Literal:
        if a < 2:
            return b ^ a
        if b < 2:
            return a ^ b
        sign = (a ^ b) & 1
        a, b = a & ~1, b & ~1
        if a == b:
            return sign
        return self._gate("xor", *((a, b) if a < b else (b, a))) ^ sign

    def choice(self, condition: Literal, yes: Literal, no: Literal) -> Literal:
        """`yes` if the condition is true, else `no`."""
        if condition & 1:
            condition, yes, no = condition ^ 1, no, yes
        if condition == FALSE or yes == no:
            return no
        if yes == no ^ 1:
            return self.xor(condition, no)
        if yes in (TRUE, condition):
            return self.or_(condition, no)
        if yes in (FALSE, condition ^ 1):
            return self.and_(condition ^ 1, no)
        if no in (FALSE, condition):
            return self.and_(condition, yes)
        if no in (TRUE, condition ^ 1):
            return self.or_(condition ^ 1, yes)
        sign = no & 1
        return self._gate("choice", condition, yes ^ sign, no ^ sign) ^ sign

    def all(self, literals: Iterable[Literal]) -> Literal:
        return reduce(self.and_, literals, TRUE)

    def any(self, literals: Iterable[Literal]) -> Literal:
        return reduce(self.or_, literals, FALSE)

    # Numbers: their bits, lowest first

    def below(self, bits: Sequence[Literal], limit: int) -> Literal:
        """Return whether an unsigned number is below a constant."""
        if limit <= 0 or limit >= 1 << len(bits):
            return int(limit > 0)
        result = FALSE
        for i, bit in enumerate(bits):
            result = self.or_(bit ^ 1, result) if limit >> i & 1 else self.and_(bit ^ 1, result)
        return result

    def less(self, a: Sequence[Literal], b: Sequence[Literal]) -> Literal:
        """Return whether an unsigned number is less than another; a missing bit is 0."""
        result = FALSE
        for i in range(max(len(a), len(b))):
            x, y = (bits[i] if i < len(bits) else FALSE for bits in (a, b))
            result = self.choice(self.xor(x, y), y, result)
        return result

    def within(self, bits: Sequence[Literal], lo: int, hi: int, *, signed: bool) -> Literal:
        """Return whether a number lies in lo..hi."""
        if signed:  # half the range more makes signed numbers unsigned
            half = 1 << (len(bits) - 1)
            bits, lo, hi = [*bits[:-1], bits[-1] ^ 1], lo + half, hi + half
        return self.and_(self.below(bits, hi + 1), self.below(bits, lo) ^ 1)

    def member(self, bits: Sequence[Literal], values: Iterable[int]) -> Literal:
        """Return whether a number equals one of some values, which may be negative."""
        whole = (1 << len(bits)) - 1
        return self._member(tuple(bits), sum(1 << value for value in {value & whole for value in values}))

    def _member(self, bits: tuple[Literal, ...], values: int) -> Literal:
        """Return whether a number is in `values`, a bit set."""
        half = 1 << (len(bits) - 1) if bits else 0
        if not values or values == (1 << 2 * half) - 1 or not bits:
            return int(bool(values))
        key = (bits, values)
        if key not in self._members:
            low = (1 << half) - 1
            yes, no = (self._member(bits[:-1], part) for part in (values >> half, values & low))
            self._members[key] = self.choice(bits[-1], yes, no)
        return self._members[key]

    def cone(self, literals: Iterable[Literal]) -> list[int]:
        """The numbers of all gates that some literals depend on, constants excluded."""
        inputs = self.inputs
        stack = [*dict.fromkeys(literal >> 1 for literal in literals if literal > 1)]
        seen = set(stack)
        for number in stack:  # the list grows during the loop
            for below in inputs[number]:
                if below not in seen:
                    seen.add(below)
                    stack.append(below)
        return stack
