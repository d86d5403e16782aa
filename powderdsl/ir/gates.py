"""Boolean circuits on bit planes: gates that fold as they are built, adders, comparators, truth tables.

An integer is a `Bits`: bit planes from the lowest, and whether the highest is a sign (two's complement).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, reduce
from itertools import permutations
from typing import Any, NamedTuple

from powderdsl.ir.build import Builder
from powderdsl.ir.ops import FLAG, Node, Offset


@dataclass(frozen=True)
class Bits:
    """The bit planes of an integer, lowest first."""

    planes: tuple[Node, ...]
    signed: bool = False


def width(lo: int, hi: int) -> tuple[int, bool]:
    """The number of bit planes that a range takes, and whether the last is a sign."""
    if lo >= 0:
        return max(hi.bit_length(), 1), False
    return max((-lo - 1).bit_length(), max(hi, 0).bit_length()) + 1, True


class Gates:
    """Makes gates in a builder's graph; constants and repetitions fold at once."""

    def __init__(self, build: Builder):
        self.build = build
        self.no = build.flag(False)
        self.yes = build.flag(True)

    def not_(self, a: Node) -> Node:
        if a is self.no:
            return self.yes
        if a is self.yes:
            return self.no
        return a.args[0] if a.op == "not" else self.build.not_(a)

    def and_(self, a: Node, b: Node) -> Node:
        if a is self.no or b is self.no or _opposite(a, b):
            return self.no
        if a is self.yes or a is b:
            return b
        return a if b is self.yes else self.build.and_(a, b)

    def or_(self, a: Node, b: Node) -> Node:
        if a is self.yes or b is self.yes or _opposite(a, b):
            return self.yes
        if a is self.no or a is b:
            return b
        return a if b is self.no else self.build.or_(a, b)

    def xor(self, a: Node, b: Node) -> Node:
        if a is b:
            return self.no
        if _opposite(a, b):
            return self.yes
        for x, y in ((a, b), (b, a)):
            if x is self.no:
                return y
            if x is self.yes:
                return self.not_(y)
        if a.op == "not" and b.op == "not":
            return self.xor(a.args[0], b.args[0])
        for x, y in ((a, b), (b, a)):
            if x.op == "not":
                return self.not_(self.xor(x.args[0], y))
        return self.build.make("xor", FLAG, a, b)

    def mux(self, condition: Node, yes: Node, no: Node) -> Node:
        """`yes` where the condition holds, else `no`."""
        if condition is self.yes or yes is no:
            return yes
        if condition is self.no:
            return no
        if yes is self.yes or yes is condition:
            return self.or_(condition, no)
        if yes is self.no:
            return self.and_(self.not_(condition), no)
        if no is self.no or no is condition:
            return self.and_(condition, yes)
        if no is self.yes:
            return self.or_(self.not_(condition), yes)
        if _opposite(yes, no):
            return self.xor(self.not_(condition), yes)
        if condition.op == "not":
            return self.build.select(condition.args[0], no, yes)
        return self.build.select(condition, yes, no)

    def all(self, flags: Sequence[Node]) -> Node:
        return reduce(self.and_, flags, self.yes)

    def any(self, flags: Sequence[Node]) -> Node:
        return reduce(self.or_, flags, self.no)

    def shift(self, a: Node, offset: Offset, wraps: bool) -> Node:
        if a is self.no or (a is self.yes and wraps) or offset == (0, 0):
            return a
        if a.op == "shift" and a.attr[2] and wraps:
            dy, dx, _ = a.attr
            return self.shift(a.args[0], (dy + offset[0], dx + offset[1]), True)
        if a.op == "not" and wraps:  # both may be read, and one of them is then stored
            return self.not_(self.shift(a.args[0], offset, True))
        return self.build.shift(a, offset, wraps)

    # Integers

    def constant(self, value: int) -> Bits:
        count, signed = width(value, value)
        return Bits(tuple(self.yes if value >> i & 1 else self.no for i in range(count)), signed)

    def bit(self, a: Bits, index: int) -> Node:
        """Bit `index`, the sign or zero beyond the stored ones."""
        if index < len(a.planes):
            return a.planes[index]
        return a.planes[-1] if a.signed else self.no

    def fit(self, a: Bits, lo: int, hi: int) -> Bits:
        """The same number in the planes of a range that holds it."""
        count, signed = width(lo, hi)
        return Bits(tuple(self.bit(a, i) for i in range(count)), signed)

    def full_adder(self, a: Node, b: Node, c: Node) -> tuple[Node, Node]:
        """Sum and carry of three bits."""
        half = self.xor(a, b)
        return self.xor(half, c), self.or_(self.and_(a, b), self.and_(half, c))

    def add(self, a: Bits, b: Bits, lo: int, hi: int, carry: Node | None = None) -> Bits:
        """a + b (+ carry), whose range is lo..hi."""
        count, signed = width(lo, hi)
        carry = carry or self.no
        planes = []
        for i in range(count):
            total, carry = self.full_adder(self.bit(a, i), self.bit(b, i), carry)
            planes.append(total)
        return Bits(tuple(planes), signed)

    def invert(self, a: Bits) -> Bits:
        """-a - 1."""
        planes = a.planes if a.signed else (*a.planes, self.no)
        return Bits(tuple(self.not_(p) for p in planes), True)

    def sub(self, a: Bits, b: Bits, lo: int, hi: int) -> Bits:
        return self.add(a, self.invert(b), lo, hi, self.yes)

    def eq(self, a: Bits, b: Bits) -> Node:
        count = max(len(a.planes), len(b.planes)) + (a.signed != b.signed)
        return self.all([self.not_(self.xor(self.bit(a, i), self.bit(b, i))) for i in range(count)])

    def lt(self, a: Bits, b: Bits) -> Node:
        """a < b: from the lowest bit, the highest difference decides."""
        count = max(len(a.planes), len(b.planes)) + (a.signed != b.signed)
        result = self.no
        for i in range(count):
            x, y = self.bit(a, i), self.bit(b, i)
            if i == count - 1 and (a.signed or b.signed):  # the sign counts the other way
                x, y = y, x
            result = self.mux(self.xor(x, y), y, result)
        return result

    def select(self, condition: Node, yes: Bits, no: Bits, lo: int, hi: int) -> Bits:
        yes, no = self.fit(yes, lo, hi), self.fit(no, lo, hi)
        pairs = zip(yes.planes, no.planes, strict=True)
        return Bits(tuple(self.mux(condition, a, b) for a, b in pairs), yes.signed)

    def divide(self, a: Bits, b: Bits, most: int) -> tuple[Bits, Bits]:
        """a / b rounded down, and the remainder, where 0 < b ≤ most; where b is 0 they mean nothing.

        Long division from the highest bit: twice the remainder so far plus the bit, less b if it fits.
        """
        bits = list(reversed(a.planes))
        rest, quotient = self.constant(0), []
        if a.signed:  # the sign bit counts as minus one: minus one time b, and b - 1 left
            quotient.append(bits[0])
            less = self.sub(b, self.constant(1), -1, most - 1)
            rest = self.select(bits.pop(0), less, rest, 0, most - 1)
        for bit in bits:
            doubled = Bits((bit, *rest.planes))
            smaller = self.lt(doubled, b)
            reduced = self.sub(doubled, b, -most, 2 * most - 1)
            rest = self.select(smaller, doubled, reduced, 0, most - 1)
            quotient.append(self.not_(smaller))
        return Bits(tuple(reversed(quotient)), a.signed), rest

    def total(self, columns: list[list[Node]], count: int) -> tuple[Node, ...]:
        """The sum of bits given by weight (columns[i] have weight 2^i), as `count` planes: a carry-save tree."""
        planes = []
        for i in range(count):
            column = list(columns[i]) if i < len(columns) else []
            while len(column) > 1:
                third = column.pop(0) if len(column) > 2 else self.no
                total, carry = self.full_adder(column.pop(0), column.pop(0), third)
                column.append(total)
                while len(columns) <= i + 1:
                    columns.append([])
                columns[i + 1].append(carry)
            planes.append(column[0] if column else self.no)
        return tuple(planes)

    def truth_table(self, inputs: Sequence[Node], values: Sequence[bool | None]) -> Node:
        """Any function of a few planes; values by number, None where the number never occurs."""
        used = [i for i, plane in enumerate(inputs) if plane is not self.no and plane is not self.yes]
        fixed = sum(1 << i for i, plane in enumerate(inputs) if plane is self.yes)
        table = []
        for index in range(1 << len(used)):
            number = fixed | sum(1 << used[k] for k in range(len(used)) if index >> k & 1)
            table.append(values[number] if number < len(values) else None)
        planes = [inputs[i] for i in used]
        order = _best_order(tuple(table), len(used))
        gates = _Split(
            self.no, self.yes, lambda i, f: self.xor(planes[i], f), lambda i, f, g: self.mux(planes[i], f, g)
        )
        return _shannon(tuple(table), order, gates)


def _opposite(a: Node, b: Node) -> bool:
    return (a.op == "not" and a.args[0] is b) or (b.op == "not" and b.args[0] is a)


class _Split(NamedTuple):
    """What truth tables become, split on one input (by number) after the other: gates, or a number of gates."""

    no: Any
    yes: Any
    xor: Callable[[int, Any], Any]
    mux: Callable[[int, Any, Any], Any]
    """Of the input, the half where it holds, and the other."""


_COST = _Split(0, 0, lambda i, f: f + 1, lambda i, f, g: f + g + (2 if f and g else 1))
"""Gates; a half that is constant saves one."""


def _shannon(table: tuple[bool | None, ...], order: tuple[int, ...], made: _Split) -> Any:
    """Split a truth table on its inputs in order; halves that agree where both matter are joined."""
    cares = {value for value in table if value is not None}
    if True not in cares:
        return made.no
    if False not in cares:
        return made.yes
    split, rest = order[0], order[1:]
    bit = 1 << split
    pairs = [(table[i & ~bit], table[i | bit]) for i in range(len(table))]
    if all(a is None or b is None or a == b for a, b in pairs):
        joined = tuple(a if a is not None else b for a, b in pairs)
        return _shannon(joined, rest, made)
    if all(a is None or b is None or a != b for a, b in pairs):
        flipped = tuple(a if a is not None else (None if b is None else not b) for a, b in pairs)
        return made.xor(split, _shannon(flipped, rest, made))
    high = tuple(value if i & bit else None for i, value in enumerate(table))
    low = tuple(value if not i & bit else None for i, value in enumerate(table))
    return made.mux(split, _shannon(high, rest, made), _shannon(low, rest, made))


@lru_cache(maxsize=4096)
def _best_order(table: tuple[bool | None, ...], inputs: int) -> tuple[int, ...]:
    """The order of inputs that takes the fewest gates; highest first where there are too many to try."""
    if inputs > 5:
        return tuple(reversed(range(inputs)))
    return min(permutations(range(inputs)), key=lambda order: _shannon(table, order, _COST))
