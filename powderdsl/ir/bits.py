"""IR on numbers -> IR on bit planes: every integer becomes a few flags, every rule gates, shifts and swaps.

The result is ordinary IR without integers: flags and floats remain. A slot of integers becomes one slot of flags
for each bit plane, ``element:0`` the lowest. `Gates` fold as they are built, by the same equations as the stages.
"""

from __future__ import annotations

import operator
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial, reduce
from itertools import groupby, permutations
from typing import Any, NamedTuple

from powderdsl.ir.ops import (
    FLAG,
    OPS,
    REAL,
    Graph,
    Node,
    Offset,
    PassGraph,
    Program,
    SlotType,
    Type,
    integer,
    kernel_rows,
    nodes_of,
    plane_name,
)

MAX_TABLE_BITS = 12

MAX_GATES = 1 << 14
"""Maximum number of nodes of a pass on bit planes. A C++ compiler takes a quarter of a minute to compile this many."""


class NotBits(Exception):
    """Raised for a pass that bit planes cannot express, but torch tensors can. `place` is the rule's file and line."""

    def __init__(self, why: str, place: str = ""):
        super().__init__(why)
        self.place = place


def _opposite(a: Node, b: Node) -> bool:
    return (a.op == "not" and a.args[0] is b) or (b.op == "not" and b.args[0] is a)


def simpler(build: Graph, op: str, args: tuple[Node, ...], attr: Hashable = None) -> Node | None:
    """A simpler node equal to an operation, or None: constants evaluated, except floats, and the algebra of flags."""
    row = OPS[op]
    constants = [arg.attr for arg in args if arg.op == "const" and arg.type != REAL]
    if row.evaluate is not None and len(constants) == len(args):
        return build.const(row.value(attr, *constants), row.type_of(attr, args))
    match op, args:
        case "not", (Node("not", args=(a,)),):  # not not a = a
            return a
        case "and" | "or", (a, b):
            absorbing = op == "or"
            for x, y in ((a, b), (b, a)):
                if x.op == "const":  # a and no = no, a or yes = yes, a and yes = a
                    return x if x.attr is absorbing else y
                if x is y:  # a and a = a
                    return y
                if x.op == "not" and x.args[0] is y:  # a and not a = no
                    return build.flag(absorbing)
        case "xor", (a, b):
            if a is b or _opposite(a, b):
                return build.flag(a is not b)
            for x, y in ((a, b), (b, a)):
                if x.op == "const":  # a xor yes = not a
                    return build.not_(y) if x.attr else y
        case "select", (condition, yes, no):
            if condition.op == "const":
                return yes if condition.attr else no
            if yes is no:
                return yes
            if yes.type == FLAG:
                if yes is condition or (yes.op == "const" and yes.attr):  # select(c, yes, b) = c or b
                    return build.or_(condition, no)
                if yes.op == "const":
                    return build.and_(build.not_(condition), no)
                if no is condition or (no.op == "const" and not no.attr):
                    return build.and_(condition, yes)
                if no.op == "const":
                    return build.or_(build.not_(condition), yes)
                if _opposite(yes, no):
                    return build.derive("xor", build.not_(condition), yes)
            if condition.op == "not":  # select(not c, a, b) = select(c, b, a)
                return Graph.derive(build, op, condition.args[0], no, yes)
    return None


Bits = tuple[Node, ...]
"""The bit planes of an integer in two's complement, lowest first; the last is the sign, constant where there is none."""


class Gates(Graph):
    """Boolean circuits on bit planes: gates that fold as they are built, adders, comparators, truth tables.

    `slots` are the types of the slots that lowered nodes read.
    """

    def __init__(self, slots: Mapping[str, Type] | None = None) -> None:
        super().__init__()
        self.no = self.flag(False)
        self.yes = self.flag(True)
        self.slots = slots or {}
        self.values: dict[Node, Any] = {}
        """The flag or float that each node was lowered to, or the planes of its integer."""

    def derive(self, op: str, *args: Node, attr: Hashable = None) -> Node:
        known = simpler(self, op, args, attr) if args and args[-1].type == FLAG else None
        if known is not None:
            return known
        if op == "xor":
            a, b = args
            if a.op == b.op == "not":  # not a xor not b = a xor b
                return self.derive("xor", a.args[0], b.args[0])
            for x, y in ((a, b), (b, a)):
                if x.op == "not":  # not a xor b = not (a xor b)
                    return self.not_(self.derive("xor", x.args[0], y))
        return super().derive(op, *args, attr=attr)

    def shift(self, a: Node, offset: Offset, wraps: bool = True) -> Node:
        if a.type == REAL and a.op in ("const", "param"):  # lowering may make a float uniform
            return self.shift_uniform(a, offset, wraps)
        if a is self.no or (a is self.yes and wraps):
            return a
        if a.type == FLAG and a.op == "shift" and a.attr[2] and wraps:
            dy, dx, _ = a.attr
            return self.shift(a.args[0], (dy + offset[0], dx + offset[1]))
        if a.op == "not" and wraps and offset != (0, 0):  # both may be read, and one of them is then stored
            return self.not_(self.shift(a.args[0], offset))
        return super().shift(a, offset, wraps)

    # Integers. `type` is the range of the result.

    def constant(self, value: int) -> Bits:
        type = integer(value, value)
        return self.fit([self.flag(bool(value >> i & 1)) for i in range(type.bits)], type)

    def fit(self, planes: Sequence[Node], type: Type) -> Bits:
        """The same number in the planes of a range that contains it. They may lack a sign if it is never negative."""
        fitted = [planes[min(i, len(planes) - 1)] for i in range(type.bits)]
        return (*fitted,) if type.signed else (*fitted, self.no)

    def full_adder(self, a: Node, b: Node, c: Node) -> tuple[Node, Node]:
        """Sum and carry of three bits."""
        half = self.derive("xor", a, b)
        return self.derive("xor", half, c), self.or_(self.and_(a, b), self.and_(half, c))

    def pairs(self, a: Bits, b: Bits, count: int = 0) -> Iterator[tuple[Node, Node]]:
        """The lowest `count` bits of two numbers, side by side; by default, as many as the longer one has."""
        for i in range(count or max(len(a), len(b))):
            yield a[min(i, len(a) - 1)], b[min(i, len(b) - 1)]

    def add(self, a: Bits, b: Bits, type: Type, carry: Node | None = None) -> Bits:
        """a + b (+ carry)."""
        carry = carry or self.no
        planes = []
        for x, y in self.pairs(a, b, type.bits):
            total, carry = self.full_adder(x, y, carry)
            planes.append(total)
        return self.fit(planes, type)

    def sub(self, a: Bits, b: Bits, type: Type) -> Bits:
        """a - b, which is a + (-b - 1) + 1."""
        return self.add(a, tuple(map(self.not_, b)), type, self.yes)

    def neg(self, a: Bits, type: Type) -> Bits:
        """-a, where `type` is the range of a."""
        return self.sub(self.constant(0), a, integer(-type.hi, -type.lo))

    def eq(self, a: Bits, b: Bits) -> Node:
        same = [self.not_(self.derive("xor", x, y)) for x, y in self.pairs(a, b)]
        return reduce(self.and_, same)

    def lt(self, a: Bits, b: Bits) -> Node:
        """a < b: the highest different bit decides; evaluated from the lowest bit up."""
        *pairs, signs = self.pairs(a, b)
        result = self.no
        for x, y in (*pairs, signs[::-1]):  # the sign counts the other way
            result = self.select(self.derive("xor", x, y), y, result)
        return result

    def choose(self, condition: Node, yes: Bits, no: Bits, type: Type) -> Bits:
        """One number where a condition is true, the other elsewhere."""
        return self.fit([self.select(condition, *pair) for pair in self.pairs(yes, no, type.bits)], type)

    def divide(self, a: Bits, b: Bits, most: int) -> tuple[Bits, Bits]:
        """a / b rounded down, and the remainder, for 0 < b ≤ most; both are arbitrary where b is 0.

        Long division from the highest bit: twice the remainder so far plus the bit, less b if it fits.
        """
        *bits, sign = a
        rest, quotient = self.constant(0), [sign]
        if sign is not self.no:  # it counts as minus one: minus one time b, and b - 1 left
            less = self.sub(b, self.constant(1), integer(-1, most - 1))
            rest = self.choose(sign, less, rest, integer(0, most - 1))
        for bit in reversed(bits):
            doubled = (bit, *rest)
            smaller = self.lt(doubled, b)
            reduced = self.sub(doubled, b, integer(-most, 2 * most - 1))
            rest = self.choose(smaller, doubled, reduced, integer(0, most - 1))
            quotient.append(self.not_(smaller))
        return tuple(reversed(quotient)), rest

    def total(self, terms: Iterable[tuple[Node, int]], count: int) -> Bits:
        """The sum of weighted flags, as `count` planes without a sign: a carry-save tree."""
        columns: defaultdict[int, list[Node]] = defaultdict(list)
        for flag, weight in terms:
            for i in range(weight.bit_length()):
                if weight >> i & 1 and flag is not self.no:
                    columns[i].append(flag)
        planes = []
        for i in range(count):
            column = columns[i]
            while len(column) > 1:
                third = column.pop(0) if len(column) > 2 else self.no
                total, carry = self.full_adder(column.pop(0), column.pop(0), third)
                column.append(total)
                columns[i + 1].append(carry)
            planes.append(column[0] if column else self.no)
        return (*planes, self.no)

    def lower(self, node: Node) -> Node | Bits:
        """A node of a pass on bit planes. Raises NotBits."""
        args = tuple([self.values[arg] for arg in node.args])
        if node.type.name != "int" and tuple not in map(type, args):
            return self.flat(node, args)
        if node.op not in _INTEGERS:
            raise NotBits(f"{node.op} of integers")
        return _INTEGERS[node.op](self, node, *args)

    def flat(self, node: Node, args: tuple[Node, ...]) -> Node:
        """The operation of a node on flags or floats, or on one plane of each argument."""
        row = _FLAT.get(node.op)
        return row(self, node, *args) if row else self.rebuild(node, args)

    def look_up(self, a: Bits, of: Type, function: Callable[[int], int | None], type: Type) -> Bits:
        """The value of a function of a small integer in a range; None means any value."""
        if of.bits > MAX_TABLE_BITS:
            raise NotBits(f"a table over {of.bits} planes")
        values = {number & ((1 << of.bits) - 1): function(number) for number in range(of.lo, of.hi + 1)}
        planes = []
        for i in range(type.bits):
            matters = holds = 0
            for place, value in values.items():
                if value is not None:
                    matters |= 1 << place
                    holds |= (value >> i & 1) << place
            planes.append(self.truth_table(a[: of.bits], matters, holds))
        return self.fit(planes, type)

    def truth_table(self, inputs: Sequence[Node], matters: int, values: int) -> Node:
        """Any function of a few planes: bit n of `values` is its value for the number n, if it `matters`."""
        used = []
        for i, plane in enumerate(inputs):
            if plane.op != "const":
                used.append(i)
                continue
            half = _half(len(inputs), i)
            matters, values = (matters >> (1 << i), values >> (1 << i)) if plane.attr else (matters, values)
            matters, values = matters & half, values & half

        def circuit(split: TableSplit) -> Node:
            if split.low is None:
                return self.flag(split is _YES)
            plane = inputs[split.input]
            if split.high is None:
                return self.derive("xor", plane, circuit(split.low))
            return self.select(plane, circuit(split.high), circuit(split.low))

        return circuit(_best_split(matters, values, len(inputs), tuple(used)))


class TableSplit(NamedTuple):
    """A truth table split on an input: its values for 1 and for 0; `high` is None if they are opposite."""

    input: int
    high: TableSplit | None = None
    low: TableSplit | None = None
    """No gates, for a table that is the same everywhere."""
    cost: int = 0
    """The number of gates; a constant half saves one."""


_NO, _YES = TableSplit(-1), TableSplit(-2)


@cache
def _half(inputs: int, i: int) -> int:
    """The numbers of `inputs` bits whose bit i is 0, as a set of bits."""
    step = 1 << i
    return ((1 << (1 << inputs)) - 1) // ((1 << 2 * step) - 1) * ((1 << step) - 1)


def _split(matters: int, values: int, inputs: int, order: Sequence[int]) -> TableSplit:
    """Split a truth table on its inputs in order; halves that agree where both matter are joined."""
    if not matters & values or not matters & ~values:
        return _YES if matters & values else _NO
    first, rest = order[0], order[1:]
    half, step = _half(inputs, first), 1 << first
    # Numbers whose bit is 1 move to the positions of those whose bit is 0, so that both halves can be compared.
    low, high = matters & half, matters >> step & half
    nos, yeses = values & low, values >> step & high
    differ = (nos ^ yeses) & low & high
    if differ in (0, low & high):  # equal or opposite wherever both matter: one table serves both halves
        if differ:
            yeses ^= high
        joined = _split(low | high, nos | yeses & ~low, inputs, rest)
        return TableSplit(first, None, joined, joined.cost + 1) if differ else joined
    yes, no = _split(high, yeses, inputs, rest), _split(low, nos, inputs, rest)
    return TableSplit(first, yes, no, yes.cost + no.cost + (2 if yes.cost and no.cost else 1))


@lru_cache(maxsize=4096)
def _best_split(matters: int, values: int, inputs: int, used: tuple[int, ...]) -> TableSplit:
    """The split with the fewest gates, of all orders of inputs; highest first if there are too many to try."""
    orders = [used[::-1]] if len(used) > 5 else permutations(used)
    return min((_split(matters, values, inputs, order) for order in orders), key=operator.attrgetter("cost"))


def plane_slots(slots: Iterable[SlotType]) -> tuple[SlotType, ...]:
    """The slots of the bit planes of integers, lowest bit first; flags and floats stay one slot."""
    planes: list[SlotType] = []
    for slot in slots:
        if slot.type.name != "int":
            planes.append(slot)
            continue
        for i, name in enumerate(slot.planes):
            planes.append(SlotType(name, FLAG, int(slot.default) >> i & 1, slot.resets))
    return tuple(planes)


def lower_bits(program: Program) -> Program:
    """The program on bit planes. Raises NotBits for the first pass that bit planes cannot express."""
    slots = plane_slots(program.slots)
    return replace(program, slots=slots, passes=tuple(map(partial(lower_pass, program), program.passes)))


def lower_pass(program: Program, pass_: PassGraph) -> PassGraph:
    """One pass of a program on bit planes. Raises NotBits."""
    slots = {slot.name: slot.type for slot in program.slots}
    gates = Gates(slots)
    values = gates.values
    for node in nodes_of(pass_):
        gates.place = node.places[0] if node.places else ""
        try:
            values[node] = gates.lower(node)
            if gates.size > MAX_GATES:
                raise NotBits(f"more than {MAX_GATES:,} gates")
        except NotBits as error:
            error.place = error.place or gates.place
            raise

    def write(name: str, node: Node) -> list[tuple[str, Node]]:
        """The writes of bit planes for a write of a slot. The range of a scratch slot is that of the node."""
        value = values[node]
        if isinstance(value, Node):
            return [(name, value)]
        type = slots.get(name, node.type)
        return [(plane_name(name, i), plane) for i, plane in enumerate(gates.fit(value, type)[: type.bits])]

    lowered = pass_.map(write, values.__getitem__)
    outputs = tuple([(name, node) for name, node in lowered.outputs if not node.is_input(name)])
    return replace(lowered, outputs=outputs)


def _input(gates: Gates, node: Node) -> Bits:
    type = gates.slots[str(node.attr)]
    planes = [gates.input(plane_name(node.attr, i), FLAG) for i in range(type.bits)]
    return gates.fit(gates.fit(planes, type), node.type)


def _by_bit(gates: Gates, node: Node) -> Bits:
    planes = [gates.node(node.op, FLAG, attr=(*node.attr, i)) for i in range(node.type.bits)]
    return gates.fit(planes, node.type)


def _plane_by_plane(gates: Gates, node: Node, *args: Node | Bits) -> Bits:
    """An operation that applies to every plane. Flags serve all planes; swaps remain swaps of planes in place."""
    planes = []
    for i in range(node.type.bits):
        parts = [arg if isinstance(arg, Node) else arg[min(i, len(arg) - 1)] for arg in args]
        planes.append(gates.flat(node, tuple(parts)))
    return gates.fit(planes, node.type)


def _move(gates: Gates, node: Node, content: Node, movers: Node, rest: Node) -> Node:
    """Floats are moved cell by cell anyway: choices between the values of neighbors."""
    if content is rest and content.op == "const":
        return content
    if content.type == FLAG:
        return gates.derive(node.op, content, movers, rest, attr=node.attr)
    dy, dx = node.attr
    back = (-dy, -dx)
    moved = gates.select(gates.shift(movers, back), gates.shift(content, back), rest)
    return gates.select(movers, gates.shift(content, (dy, dx)), moved) if node.op == "swap" else moved


def _below(gates: Gates, node: Node, limit: Bits) -> Node:
    """A draw below a limit. A constant limit is an attribute; another is passed plane by plane, highest first."""
    stream, bits = node.attr
    (source,) = node.args
    if source.op == "select":
        condition, *parts = source.args
        draws = [_below(gates, replace(node, args=(part,)), gates.values[part]) for part in parts]
        return gates.select(gates.values[condition], *draws)
    if source.op == "const":
        count = int(source.attr)
        if count <= 0 or count >= 1 << bits:
            return gates.flag(count > 0)
        return gates.derive("chance", attr=(stream, bits, count))
    *planes, _ = gates.fit(limit, integer(0, 1 << bits))
    return gates.derive("below_planes", *reversed(planes), attr=(stream, bits))


def _compare(gates: Gates, node: Node, a: Bits, b: Bits) -> Node:
    left, right = node.args
    holds = getattr(operator, node.op)
    for side, bits, other in ((left, a, right), (right, b, left)):
        if other.op != "const":
            continue

        def test(number: int, side: Node = side, limit: int = other.attr) -> bool:
            return holds(number, limit) if side is left else holds(limit, number)

        if side.op == "count" and side.type.lo >= 0:  # none or some: `or` of neighbors, without counting
            some = {test(number) for number in range(1, side.type.hi + 1)}
            if len(some) == 1 and test(0) not in some:
                weights, wraps = side.attr
                flag = gates.values[side.args[0]]
                rows = [
                    gates.shift(
                        gates.any([gates.shift(flag, (0, dx), wraps) for dx, _ in pattern]), (dy, 0), wraps
                    )
                    for dy, pattern in kernel_rows(weights).items()
                ]
                joined = gates.any(rows)
                return joined if True in some else gates.not_(joined)
        if side.type.bits <= 5:
            return gates.look_up(bits, side.type, test, FLAG)[0]
    if node.op == "eq":
        return gates.eq(a, b)
    return gates.lt(a, b) if node.op == "lt" else gates.not_(gates.lt(b, a))


def _count(gates: Gates, node: Node, flag: Node) -> Bits:
    """A kernel as adders: each row pattern once, then the rows; negative weights are added inverted."""
    weights, wraps = node.attr
    sums: dict[object, list[Bits]] = {}
    terms: tuple[list[tuple[Node, int]], ...] = ([], [])
    for dy, pattern in kernel_rows(weights).items():
        if pattern not in sums:
            sums[pattern] = []
            for sign in (1, -1):
                own = [(dx, weight * sign) for dx, weight in pattern if weight * sign > 0]
                size = sum(weight for _, weight in own)
                row = [(gates.shift(flag, (0, dx), wraps), weight) for dx, weight in own]
                sums[pattern].append(gates.total(row, size.bit_length()))
        for side, planes in zip(terms, sums[pattern], strict=True):
            side += [(gates.shift(plane, (dy, 0), wraps), 1 << i) for i, plane in enumerate(planes)]
    lo, hi = node.type.lo, node.type.hi
    plus = gates.total(terms[0], max(hi.bit_length(), 1))
    if lo >= 0:
        return gates.fit(plus, node.type)
    return gates.sub(plus, gates.total(terms[1], max((-lo).bit_length(), 1)), node.type)


def _multiply(gates: Gates, node: Node, a: Bits, b: Bits) -> Bits:
    """Shifted additions; a negative factor counts its sign bit as minus."""
    bound = 1 << integer(min(node.type.lo, 0), node.type.hi).bits
    result = gates.constant(0)
    for i, bit in enumerate(b):
        if bit is not gates.no:
            term = (*[gates.no] * i, *[gates.and_(bit, plane) for plane in a])
            combine = gates.sub if i == len(b) - 1 else gates.add
            result = combine(result, term, integer(-bound, bound - 1))
    return gates.fit(result, node.type)


def _quotient(gates: Gates, node: Node, value: Bits, divisor: Bits) -> Bits:
    of, by = (arg.type for arg in node.args)
    if by.lo == by.hi and by.lo > 0 and by.lo & (by.lo - 1) == 0:  # rounded down, as a shift rounds
        return gates.fit(value[by.lo.bit_length() - 1 :] or value[-1:], node.type)
    if by.lo == by.hi and by.lo and of.bits <= MAX_TABLE_BITS // 2:
        return gates.look_up(value, of, lambda number: number // by.lo, node.type)
    most = max(abs(by.lo), abs(by.hi))
    if by.signed:  # a div -b = -a div b
        negative = divisor[-1]
        reach = max(abs(of.lo), abs(of.hi))
        value = gates.choose(negative, gates.neg(value, of), value, integer(-reach, reach))
        divisor = gates.choose(negative, gates.neg(divisor, by), divisor, integer(0, most))
    quotient, _ = gates.divide(value, divisor, most)
    none = gates.eq(divisor, gates.constant(0))
    return gates.choose(none, gates.constant(0), quotient, node.type)


def _mod(gates: Gates, node: Node, value: Bits) -> Bits:
    modulus = node.attr
    if modulus & (modulus - 1) == 0:  # its lowest bits; none for a modulus of 1
        return gates.fit(value[: modulus.bit_length() - 1] or (gates.no,), node.type)
    if node.args[0].type.bits > MAX_TABLE_BITS // 2:
        _, rest = gates.divide(value, gates.constant(modulus), modulus)
        return gates.fit(rest, node.type)
    return gates.look_up(value, node.args[0].type, lambda number: number % modulus, node.type)


def _to_real(gates: Gates, node: Node, value: Bits) -> Node:
    """A number from its planes: exact, since integers stay below 2^24."""
    of = node.args[0].type
    if max(abs(of.lo), abs(of.hi)) >= 1 << 24:
        raise NotBits("an integer too large for float32")
    weights: dict[Node, float] = {}  # equal planes count together
    base = 0.0
    for i, plane in enumerate(value):
        weight = float(1 << i) if i < len(value) - 1 else -float(1 << i)
        if plane.op == "const":
            base += weight if plane.attr else 0.0
        else:
            weights[plane] = weights.get(plane, 0.0) + weight
    if not weights:
        return gates.real(base)
    (first, weight), *others = weights.items()
    total = gates.select(first, gates.real(base + weight), gates.real(base))
    for plane, weight in others:
        total = gates.derive("add", total, gates.select(plane, gates.real(weight), gates.real(0.0)))
    return total


_INTEGERS: dict[str, Callable[..., Node | Bits]] = {
    "input": _input,
    "const": lambda gates, node: gates.constant(node.attr),
    "param": _by_bit,
    "coordinate": _by_bit,
    "below": _below,
    "shift": _plane_by_plane,
    "count": _count,
    "in_set": lambda gates, node, a: gates.look_up(a, node.args[0].type, node.attr.__contains__, FLAG)[0],
    "table": lambda gates, node, a: gates.look_up(
        a, node.args[0].type, dict(enumerate(node.attr)).get, node.type
    ),
    "eq": _compare,
    "lt": _compare,
    "le": _compare,
    "add": lambda gates, node, a, b: gates.add(a, b, node.type),
    "sub": lambda gates, node, a, b: gates.sub(a, b, node.type),
    "mul": _multiply,
    "quotient": _quotient,
    "mod": _mod,
    "neg": lambda gates, node, a: gates.neg(a, node.args[0].type),
    "abs": lambda gates, node, a: gates.choose(a[-1], gates.neg(a, node.args[0].type), a, node.type),
    "min": lambda gates, node, a, b: gates.choose(gates.lt(a, b), a, b, node.type),
    "max": lambda gates, node, a, b: gates.choose(gates.lt(a, b), b, a, node.type),
    "to_real": _to_real,
    "select": _plane_by_plane,
    "swap": _plane_by_plane,
    "arrive": _plane_by_plane,
}
"""The gates of operations on integers or with integer results."""

_FLAT: dict[str, Callable[..., Node]] = {
    "shift": lambda gates, node, value: gates.shift(value, node.attr[:2], node.attr[2]),
    "to_real": lambda gates, node, value: gates.select(value, gates.real(1.0), gates.real(0.0)),
    "swap": _move,
    "arrive": _move,
}
"""The nodes of operations on flags and floats that have another form on bit planes."""


# Segments. Random numbers depend on streams, cells and steps, never on the pass: segments draw the same as the program.


@dataclass(frozen=True)
class Segment:
    """Consecutive passes. `planes` is `program` on bit planes, or None for passes on cells."""

    program: Program
    planes: Program | None


@dataclass(frozen=True)
class PassForm:
    """A pass and its form on bit planes, or the reason why bit planes cannot express it, and the rule."""

    cells: PassGraph
    planes: PassGraph | None
    why: str = ""
    place: str = ""


def choose_form(program: Program, pass_: PassGraph) -> PassForm:
    try:
        return PassForm(pass_, lower_pass(program, pass_))
    except NotBits as error:
        return PassForm(pass_, None, str(error), error.place)


def segments(
    program: Program, choose_form: Callable[[Program, PassGraph], PassForm] = choose_form
) -> tuple[Segment, ...]:
    """The longest segments of a program. Slots that reset do so in the first one only."""
    parts = []
    slots = program.slots
    forms = [choose_form(program, pass_) for pass_ in program.passes]
    for packed, group in groupby(forms, lambda form: form.planes is not None):
        run = tuple(group)
        part = replace(program, slots=slots, passes=tuple(form.cells for form in run))
        passes = tuple(form.planes for form in run if form.planes is not None)
        planes = replace(part, slots=plane_slots(slots), passes=passes)
        parts.append(Segment(part, planes if packed else None))
        slots = tuple(replace(slot, resets=False) for slot in program.slots)
    return tuple(parts) or (Segment(program, lower_bits(program)),)
