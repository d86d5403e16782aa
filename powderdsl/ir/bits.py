"""IR on numbers -> IR on bit planes: every integer becomes a few flags, every rule gates, shifts and swaps.

The result is ordinary IR without integers: flags and floats remain. A slot of integers becomes one slot of flags
for each bit plane, ``element:0`` the lowest.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from powderdsl.ir.build import Builder
from powderdsl.ir.gates import Bits, Gates, width
from powderdsl.ir.ops import (
    FLAG,
    REAL,
    Node,
    Offset,
    PassGraph,
    Program,
    SlotType,
    Type,
    kernel_rows,
    nodes_of,
    plane_name,
)

MAX_TABLE_BITS = 12

MAX_GATES = 1 << 14
"""Nodes of a pass on bit planes. Compiling this many takes a C++ compiler a quarter of a minute."""


class NotBits(Exception):
    """Something that bit planes cannot carry; torch tensors can. `place` is the rule's file and line."""

    def __init__(self, why: str, place: str = ""):
        super().__init__(why)
        self.place = place


def plane_slots(slot: SlotType) -> tuple[SlotType, ...]:
    """The slots of an integer's bit planes, lowest bit first; flags and floats stay one slot."""
    if slot.type.name != "int":
        return (slot,)
    count, _ = width(slot.type.lo, slot.type.hi)
    return tuple(
        SlotType(plane_name(slot.name, i), FLAG, int(slot.default) >> i & 1, slot.resets)
        for i in range(count)
    )


def lower_bits(program: Program) -> Program:
    """The program on bit planes. Raises NotBits for the first pass that they cannot carry."""
    slots = tuple(plane for slot in program.slots for plane in plane_slots(slot))
    passes = tuple(lower_pass(program, pass_) for pass_ in program.passes)
    return replace(program, slots=slots, passes=passes)


def lower_pass(program: Program, pass_: PassGraph) -> PassGraph:
    """One pass of a program on bit planes. Raises NotBits."""
    return _PassBits({slot.name: slot for slot in program.slots}).lower(pass_)


@dataclass
class _PassBits:
    slots: dict[str, SlotType]
    build: Builder = field(default_factory=Builder)

    def lower(self, pass_: PassGraph) -> PassGraph:
        self.gates = Gates(self.build)
        self.values: dict[int, Node | Bits] = {}
        for node in nodes_of(pass_):
            self.build.place = node.places[0] if node.places else ""
            try:
                self.values[id(node)] = self._lower(node)
                if self.build.graph.size > MAX_GATES:
                    raise NotBits(f"more than {MAX_GATES:,} gates")
            except NotBits as error:
                error.place = error.place or self.build.place
                raise
        substeps = []
        for one in pass_.substeps:
            writes = tuple(w for name, node in one.writes for w in self._write(name, node))
            guards = tuple(self._flag(guard) for guard in one.guards)
            substeps.append(replace(one, writes=writes, guards=guards))
        outputs = tuple(w for name, node in pass_.outputs for w in self._write(name, node))
        kept = tuple((name, node) for name, node in outputs if not (node.op == "input" and node.attr == name))
        return replace(pass_, substeps=tuple(substeps), outputs=kept)

    def _write(self, name: str, node: Node) -> list[tuple[str, Node]]:
        """The writes of bit planes that a write of a slot becomes. The range of a scratch slot is that of the node."""
        value = self.values[id(node)]
        if isinstance(value, Node):
            return [(name, value)]
        if name in self.slots:
            type = self.slots[name].type
            value = self.gates.fit(value, type.lo, type.hi)
        return [(plane_name(name, i), plane) for i, plane in enumerate(value.planes)]

    def _flag(self, node: Node) -> Node:
        value = self.values[id(node)]
        assert isinstance(value, Node)
        return value

    def _bits(self, node: Node) -> Bits:
        value = self.values[id(node)]
        assert isinstance(value, Bits)
        return value

    def _lower(self, node: Node) -> Node | Bits:
        gates, build = self.gates, self.build
        args = node.args
        match node.op:
            case "input":
                return self._input(node)
            case "const" if node.type.name == "int":
                return gates.constant(int(node.attr))
            case "param" | "coordinate" if node.type.name == "int":
                count, signed = width(node.type.lo, node.type.hi)
                return Bits(
                    tuple(build.make(node.op, FLAG, attr=(*node.attr, i)) for i in range(count)), signed
                )
            case "below":
                return self._below(node)
            case "shift":
                return self._shift(node)
            case "count":
                return self._count(node)
            case "not":
                return gates.not_(self._flag(args[0]))
            case "and" | "or" | "xor":
                gate = {"and": gates.and_, "or": gates.or_, "xor": gates.xor}[node.op]
                return gate(*(self._flag(arg) for arg in args))
            case "in_set":
                return self._function(args[0], lambda value: value in node.attr)
            case "table":
                return self._numbers(args[0], node.type, node.attr.__getitem__, len(node.attr))
            case "eq" | "lt" | "le" if args[0].type.name == "int":
                return self._compare(node)
            case "select" if node.type.name == "int":
                yes, no = self._bits(args[1]), self._bits(args[2])
                return gates.select(self._flag(args[0]), yes, no, node.type.lo, node.type.hi)
            case "select" if node.type == FLAG:
                return gates.mux(*(self._flag(arg) for arg in args))
            case "swap" | "arrive":
                return self._movement(node)
            case "to_real":
                return self._to_real(args[0])
        if node.type.name == "int":
            return self._arithmetic(node)
        return build.make(node.op, node.type, *(self._flag(arg) for arg in args), attr=node.attr)

    def _input(self, node: Node) -> Node | Bits:
        if node.type.name != "int":
            return self.build.input(str(node.attr), node.type)
        slot = self.slots[str(node.attr)]
        count, signed = width(slot.type.lo, slot.type.hi)
        stored = Bits(tuple(self.build.input(plane_name(slot.name, i), FLAG) for i in range(count)), signed)
        return self.gates.fit(stored, node.type.lo, node.type.hi)

    def _shift(self, node: Node) -> Node | Bits:
        dy, dx, wraps = node.attr
        value = self.values[id(node.args[0])]
        if isinstance(value, Bits):
            value = self.gates.fit(value, node.type.lo, node.type.hi)
            return Bits(tuple(self.gates.shift(p, (dy, dx), wraps) for p in value.planes), value.signed)
        if value.type == FLAG:
            return self.gates.shift(value, (dy, dx), wraps)
        return self._shift_floats(value, (dy, dx), wraps)

    def _shift_floats(self, value: Node, offset: Offset, wraps: bool = True) -> Node:
        """Floats at a neighbor. Planes may have shown that they are the same everywhere, which has no neighbors."""
        if value.op in ("const", "param"):
            return self.build.shift_uniform(value, offset, wraps)
        return self.build.shift(value, offset, wraps)

    def _movement(self, node: Node) -> Node | Bits:
        """Swaps stay swaps, one for each bit plane: targets exchange planes in place."""
        movers = self._flag(node.args[1])
        content, rest = self.values[id(node.args[0])], self.values[id(node.args[2])]
        offset = node.attr
        if isinstance(content, Node):
            assert isinstance(rest, Node)
            if content.type == REAL:  # cell by cell anyway: choices between what neighbors hold
                dy, dx = offset
                targets = self.gates.shift(movers, (-dy, -dx), True)
                moved = self.build.select(targets, self._shift_floats(content, (-dy, -dx)), rest)
                if node.op == "swap":
                    moved = self.build.select(movers, self._shift_floats(content, (dy, dx)), moved)
                return moved
            return self.build.derive(node.op, content, movers, rest, attr=offset)
        assert isinstance(rest, Bits)
        content = self.gates.fit(content, node.type.lo, node.type.hi)
        rest = self.gates.fit(rest, node.type.lo, node.type.hi)
        planes = tuple(
            a if a is b and a.op == "const" else self.build.derive(node.op, a, movers, b, attr=offset)
            for a, b in zip(content.planes, rest.planes, strict=True)
        )
        return Bits(planes, content.signed)

    def _below(self, node: Node) -> Node:
        """A draw below a limit. A constant limit is an attribute; another is given plane by plane, highest first."""
        limit = node.args[0]
        stream, bits = node.attr
        if limit.op == "select":
            condition, yes, no = limit.args
            parts = [self._below(replace(node, args=(arg,))) for arg in (yes, no)]  # outside any graph
            return self.gates.mux(self._flag(condition), *parts)
        if limit.op == "const":
            count = int(limit.attr)
            if count <= 0:
                return self.gates.no
            if count >= 1 << bits:
                return self.gates.yes
            return self.build.make("chance", FLAG, attr=(stream, bits, count))
        planes = self.gates.fit(self._bits(limit), 0, 1 << bits).planes
        return self.build.make("below_planes", FLAG, *reversed(planes), attr=(stream, bits))

    def _function(self, argument: Node, function: Callable[..., int], below: int | None = None) -> Node:
        """A flag that depends on a small integer only; what it is from `below` on does not matter."""
        planes, type = self._bits(argument).planes, argument.type
        count = len(planes)
        if count > MAX_TABLE_BITS:
            raise NotBits(f"a table over {count} planes")
        table: list[bool | None] = [None] * (1 << count)
        for number in range(type.lo, type.hi + 1 if below is None else min(type.hi + 1, below)):
            table[number & ((1 << count) - 1)] = bool(function(number))
        return self.gates.truth_table(planes, table)

    def _numbers(
        self, argument: Node, type: Type, function: Callable[[int], int], below: int | None = None
    ) -> Bits:
        """An integer of a type that depends on a small integer only, bit by bit."""
        count, signed = width(type.lo, type.hi)
        planes = (self._function(argument, lambda v, i=i: function(v) >> i & 1, below) for i in range(count))
        return Bits(tuple(planes), signed)

    def _compare(self, node: Node) -> Node:
        near = self._any_neighbor(node)
        if near is not None:
            return near
        left, right = node.args
        a, b = self._bits(left), self._bits(right)
        holds = getattr(operator, node.op)
        if right.op == "const" and len(a.planes) <= 5:
            return self._function(left, lambda v: holds(v, right.attr))
        if left.op == "const" and len(b.planes) <= 5:
            return self._function(right, lambda v: holds(left.attr, v))
        if node.op == "eq":
            return self.gates.eq(a, b)
        return self.gates.lt(a, b) if node.op == "lt" else self.gates.not_(self.gates.lt(b, a))

    def _any_neighbor(self, node: Node) -> Node | None:
        """0 < count(x), 1 <= count(x), count(x) == 0: neighbors are joined, not counted."""
        left, right = node.args
        counted = right if right.op == "count" else left
        if counted.op != "count" or any(weight < 0 for _, _, weight in counted.attr[0]):
            return None
        bound = left if counted is right else right
        if bound.op != "const":
            return None
        side = "both" if node.op == "eq" else "right" if counted is right else "left"
        asked = (node.op, side, bound.attr)
        some = asked in (("lt", "right", 0), ("le", "right", 1))
        if not some and asked not in (("eq", "both", 0), ("lt", "left", 1), ("le", "left", 0)):
            return None
        weights, wraps = counted.attr
        flag = self._flag(counted.args[0])
        rows = kernel_rows(weights)
        joined = self.gates.any([
            self.gates.shift(self.gates.any([self.gates.shift(flag, (0, dx), wraps) for dx, _ in pattern]), (dy, 0), wraps)
            for dy, pattern in rows.items()
        ])  # fmt: skip
        return joined if some else self.gates.not_(joined)

    def _count(self, node: Node) -> Bits:
        """A kernel as adders: each pattern of a row once, then the rows; negative weights are added inverted."""
        gates = self.gates
        weights, wraps = node.attr
        flag = self._flag(node.args[0])
        sums: dict[tuple[tuple[int, int], ...], tuple[tuple[Node, ...], tuple[Node, ...]]] = {}
        columns: tuple[list[list[Node]], list[list[Node]]] = ([], [])
        for dy, pattern in kernel_rows(weights).items():
            if pattern not in sums:
                parts = []
                for sign in (1, -1):
                    own: list[list[Node]] = []
                    size = 0
                    for dx, weight in pattern:
                        if weight * sign > 0:
                            size += weight * sign
                            _put(own, gates.shift(flag, (0, dx), wraps), weight * sign)
                    parts.append(gates.total(own, size.bit_length()))
                sums[pattern] = (parts[0], parts[1])
            for target, planes in zip(columns, sums[pattern], strict=True):
                for i, plane in enumerate(planes):
                    _put(target, gates.shift(plane, (dy, 0), wraps), 1 << i)
        lo, hi = node.type.lo, node.type.hi
        plus = Bits(gates.total(columns[0], max(hi.bit_length(), 1)))
        if lo >= 0:
            return gates.fit(plus, lo, hi)
        minus = Bits(gates.total(columns[1], max((-lo).bit_length(), 1)))
        return gates.sub(plus, minus, lo, hi)

    def _arithmetic(self, node: Node) -> Bits:
        gates = self.gates
        lo, hi = node.type.lo, node.type.hi
        args = [self._bits(arg) for arg in node.args]
        match node.op:
            case "add":
                return gates.add(args[0], args[1], lo, hi)
            case "sub":
                return gates.sub(args[0], args[1], lo, hi)
            case "neg":
                return gates.sub(gates.constant(0), args[0], lo, hi)
            case "abs":
                negative = args[0].planes[-1] if args[0].signed else gates.no
                inner = node.args[0].type
                minus = gates.sub(gates.constant(0), args[0], -inner.hi, -inner.lo)
                return gates.select(negative, minus, args[0], lo, hi)
            case "min":
                return gates.select(gates.lt(args[0], args[1]), args[0], args[1], lo, hi)
            case "max":
                return gates.select(gates.lt(args[0], args[1]), args[1], args[0], lo, hi)
            case "mul":
                return self._multiply(args[0], args[1], lo, hi)
            case "quotient":
                return self._quotient(node, args[0], args[1])
            case "mod":
                return self._mod(node, args[0])
        raise NotBits(f"{node.op} of integers")

    def _multiply(self, a: Bits, b: Bits, lo: int, hi: int) -> Bits:
        """Shifted additions; a negative factor counts its sign bit as minus."""
        gates = self.gates
        result = gates.constant(0)
        count, _ = width(min(lo, 0), hi)
        bound = 1 << count
        for i, bit in enumerate(b.planes):
            term = Bits((*[gates.no] * i, *(gates.and_(bit, p) for p in a.planes)), a.signed)
            if b.signed and i == len(b.planes) - 1:
                result = gates.sub(result, term, -bound, bound - 1)
            else:
                result = gates.add(result, term, -bound, bound - 1)
        return gates.fit(result, lo, hi)

    def _quotient(self, node: Node, value: Bits, divisor: Bits) -> Bits:
        gates = self.gates
        lo, hi = node.type.lo, node.type.hi
        inner, by = node.args[0].type, node.args[1].type
        if by.lo == by.hi and by.lo > 0 and by.lo & (by.lo - 1) == 0:  # rounded down, as a shift is
            sign = (
                value.planes[-1] if value.signed else gates.no
            )  # what is left of a number that has fewer bits
            shifted = value.planes[by.lo.bit_length() - 1 :] or (sign,)
            return gates.fit(Bits(shifted, value.signed), lo, hi)
        if by.lo == by.hi and by.lo and len(value.planes) <= MAX_TABLE_BITS // 2:
            return self._numbers(node.args[0], node.type, lambda v: v // by.lo)
        most = max(abs(by.lo), abs(by.hi))
        if divisor.signed:  # a div -b = -a div b
            negative = divisor.planes[-1]
            reach = max(abs(inner.lo), abs(inner.hi))
            minus = gates.sub(gates.constant(0), value, -inner.hi, -inner.lo)
            value = gates.select(negative, minus, value, -reach, reach)
            opposite = gates.sub(gates.constant(0), divisor, -by.hi, -by.lo)
            divisor = gates.select(negative, opposite, divisor, 0, most)
        quotient, _ = gates.divide(value, divisor, most)
        none = gates.eq(divisor, gates.constant(0))
        return gates.select(none, gates.constant(0), quotient, lo, hi)

    def _mod(self, node: Node, value: Bits) -> Bits:
        modulus = node.attr
        if modulus & (modulus - 1) == 0:  # its lowest bits; of a modulus of 1 none
            bits = tuple(self.gates.bit(value, i) for i in range(modulus.bit_length() - 1))
            return Bits(bits or (self.gates.no,))
        if len(value.planes) > MAX_TABLE_BITS // 2:
            _, rest = self.gates.divide(value, self.gates.constant(modulus), modulus)
            return self.gates.fit(rest, 0, modulus - 1)
        return self._numbers(node.args[0], node.type, lambda v: v % modulus)

    def _to_real(self, argument: Node) -> Node:
        """A number from its planes: exact, since integers stay below 2^24."""
        build = self.build
        value = self.values[id(argument)]
        if isinstance(value, Node):
            if value.type == REAL:
                return value
            return build.select(value, build.real(1.0), build.real(0.0))
        if max(abs(argument.type.lo), abs(argument.type.hi)) >= 1 << 24:
            raise NotBits("an integer too large for float32")
        weights: dict[int, tuple[Node, float]] = {}  # equal planes count together
        always = 0.0
        for i, plane in enumerate(value.planes):
            weight = -float(1 << i) if value.signed and i == len(value.planes) - 1 else float(1 << i)
            if plane.op == "const":
                always += weight if plane.attr else 0.0
            else:
                weights[id(plane)] = (plane, weights.get(id(plane), (plane, 0.0))[1] + weight)
        if not weights:
            return build.real(always)
        (first, weight), *rest = weights.values()
        total = build.select(first, build.real(always + weight), build.real(always))
        for plane, weight in rest:
            total = build.derive("add", total, build.select(plane, build.real(weight), build.real(0.0)))
        return total


def _put(columns: list[list[Node]], plane: Node, weight: int) -> None:
    """Add a plane of some weight to columns of bits."""
    if plane.op == "const" and not plane.attr:
        return
    for i in range(weight.bit_length()):
        if weight >> i & 1:
            while len(columns) <= i:
                columns.append([])
            columns[i].append(plane)
