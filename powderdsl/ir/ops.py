"""The IR: one table of operations, immutable interned nodes, and programs made of substeps.

A node has a value in each cell of each world: a flag, an integer with a declared range, or a float32. There is no
control flow inside a substep. Equal nodes of one graph are the same object, so common sub-expressions are free.
"""

from __future__ import annotations

import math
import operator
import struct
from array import array
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from itertools import chain, starmap
from typing import Any, TypeVar

Offset = tuple[int, int]
Range = tuple[int, int]
Item = TypeVar("Item")

SNAP = 2.0**-20
"""Floats of a smaller magnitude are stored as zero."""


@dataclass(frozen=True)
class Type:
    """``flag``, ``int`` (lo..hi, inclusive) or ``real`` (float32)."""

    name: str
    lo: int = 0
    hi: int = 0

    def __str__(self) -> str:
        return f"{self.lo}..{self.hi}" if self.name == "int" else self.name

    @property
    def bits(self) -> int:
        """The number of bit planes of an integer."""
        if self.signed:
            return max((-self.lo - 1).bit_length(), max(self.hi, 0).bit_length()) + 1
        return max(self.hi.bit_length(), 1)

    @property
    def signed(self) -> bool:
        """True if the highest bit plane is a sign."""
        return self.lo < 0


FLAG, REAL = Type("flag", 0, 1), Type("real")


def integer(lo: int, hi: int) -> Type:
    return Type("int", lo, hi)


@dataclass(frozen=True)
class Threshold:
    """A chance as a number of draws of `bits` bits: those below it, or up to it if not `strict`."""

    bits: int
    strict: bool = True

    def __str__(self) -> str:
        return f"{'lt' if self.strict else 'le'}{self.bits}"


_ARGS, _TYPE = operator.attrgetter("args"), operator.attrgetter("type")


# Float32 arithmetic on Python's numbers, which are float64: sums, differences, products, quotients and roots of float32
# values that are rounded to float64 and then to float32 are rounded correctly (Figueroa 1995: 53 bits are at least 2·24 + 2).


def single(value: float) -> float:
    """The nearest float32; infinite beyond the largest."""
    return array("f", (value,))[0]


def all_ones(value: float) -> bool:
    """True if all bits of the fraction of the float32 are ones."""
    return int.from_bytes(struct.pack("<f", value), "little") & 0x7FFFFF == 0x7FFFFF


def stepped(value: float, by: int) -> float:
    """The float32 that is `by` steps away from a finite float32 of at least 0."""
    (bits,) = struct.unpack("<I", struct.pack("<f", abs(value)))
    return struct.unpack("<f", struct.pack("<I", bits + by))[0]


def square_root(value: float) -> float:
    """The square root; NaN below 0."""
    return single(math.sqrt(value)) if value >= 0 else math.nan


def smaller(a: float, b: float) -> float:
    """The minimum; NaN if either is."""
    return math.nan if a != a or b != b else min(a, b)


def larger(a: float, b: float) -> float:
    """The maximum; NaN if either is."""
    return math.nan if a != a or b != b else max(a, b)


@dataclass(frozen=True)
class Op:
    """A row of the table: the kinds of the arguments and of the result, and facts derived from them.

    Kinds are names of types, `?` for any, `=` for arguments of equal kind, `*` for any number of arguments. `bounds`
    gives the range of an integer result for the types of the arguments, `evaluate` the result for their values, with
    which stages fold constants; both take `attr` first if there is one. Without `evaluate` the result depends on more
    than these. `gates` is the cost of the operation on bit planes.
    """

    name: str
    args: tuple[str, ...]
    result: str
    attr: str = ""
    about: str = ""
    bounds: Callable[..., Range] | None = None
    evaluate: Callable[..., Any] | None = None
    commutative: bool = False
    gates: int = 0

    def type_of(self, attr: Any, args: Sequence[Node]) -> Type:
        kind = args[-1].type.name if self.result == "=" else self.result
        if kind != "int":
            return FLAG if kind == "flag" else REAL
        assert self.bounds is not None
        return integer(*self.bounds(*([attr] if self.attr else []), *map(_TYPE, args)))

    def value(self, attr: Any, *args: Any) -> Any:
        """The result for the values of the arguments, floats rounded to float32. Raises LookupError without `evaluate`."""
        if self.evaluate is None:
            raise LookupError(self.name)
        result = self.evaluate(*([attr] if self.attr else []), *args)
        return single(result) if isinstance(result, float) else result


def _clamp(limits: tuple[float, float], a: float) -> float:
    result = smaller(larger(a, single(limits[0])), single(limits[1]))
    return result if abs(result) >= SNAP else 0.0  # NaN is not ≥ SNAP


def _quotient(a: int, b: int) -> int:
    return a // b if b else 0


def _corners(evaluate: Callable[[int, int], int], a: Type, others: Iterable[int]) -> Range:
    values = [evaluate(x, y) for y in others for x in (a.lo, a.hi)]
    return min(values), max(values)


def _reachable(values: tuple[int, ...], index: Type) -> Range:
    values = values[max(index.lo, 0) : index.hi + 1] or values
    return min(values), max(values)


def _union(a: Type, b: Type) -> Range:
    return min(a.lo, b.lo), max(a.hi, b.hi)


# fmt: off
_TABLE = (
    # sources of values
    Op("input", (), "?", "slot", "the value of a slot before the pass"),
    Op("const", (), "?", "value", "the same everywhere"),
    Op("param", (), "?", "(name, threshold or None[, bit])", "one number a world: its value, or a chance as a threshold"),
    Op("coordinate", (), "?", "(row | column | step, modulus[, bit])"),
    Op("inside", (), "flag", "offset", "whether that neighbor lies inside the grid"),
    Op("below", ("int",), "flag", "(stream, bits)", "whether the stream's draw k is less than the argument"),
    Op("draw", (), "real", "(stream, bits)", "(k + ½) / 2^bits, rounded to float32"),
    # the same on bit planes
    Op("chance", (), "flag", "(stream, bits, limit)", "whether the stream's draw k is less than a constant"),
    Op("below_planes", ("*flag",), "flag", "(stream, bits)", "`below`, the limit's bit planes given highest first"),
    # neighbors
    Op("shift", ("=",), "=", "(rows, columns, wraps)", "the value at a neighbor; zero outside unless it wraps",
       lambda at, a: (a.lo, a.hi) if at[2] else (min(a.lo, 0), max(a.hi, 0))),
    Op("count", ("flag",), "int", "((rows, columns, weight)…, wraps)", "weighted number of neighbors that hold",
       lambda attr, a: (sum(min(w, 0) for *_, w in attr[0]), sum(max(w, 0) for *_, w in attr[0]))),
    # flags
    Op("not", ("flag",), "flag", evaluate=lambda a: 1 - a, gates=1),
    Op("and", ("flag", "flag"), "flag", evaluate=operator.and_, commutative=True, gates=1),
    Op("or", ("flag", "flag"), "flag", evaluate=operator.or_, commutative=True, gates=1),
    Op("xor", ("flag", "flag"), "flag", evaluate=operator.xor, commutative=True, gates=1),
    # integers and floats
    Op("in_set", ("int",), "flag", "frozen set", "whether the value is one of these", evaluate=lambda members, a: a in members),
    Op("table", ("int",), "int", "values by index, from 0", "",
       _reachable, operator.getitem),
    Op("eq", ("=", "="), "flag", evaluate=operator.eq, commutative=True),
    Op("lt", ("=", "="), "flag", evaluate=operator.lt),
    Op("le", ("=", "="), "flag", evaluate=operator.le),
    Op("add", ("=", "="), "=", "", "", lambda a, b: (a.lo + b.lo, a.hi + b.hi), operator.add, commutative=True),
    Op("sub", ("=", "="), "=", "", "", lambda a, b: (a.lo - b.hi, a.hi - b.lo), operator.sub),
    Op("mul", ("=", "="), "=", "", "", lambda a, b: _corners(operator.mul, a, (b.lo, b.hi)), operator.mul, commutative=True),
    Op("div", ("real", "real"), "real", "", "x / 0 is 0", evaluate=lambda a, b: a / b if b else 0.0),
    Op("quotient", ("int", "int"), "int", "", "rounded down; x div 0 is 0",
       lambda a, b: _corners(_quotient, a, [d for d in (b.lo, -1, 0, 1, b.hi) if b.lo <= d <= b.hi]), _quotient),
    Op("mod", ("int",), "int", "modulus", "", lambda modulus, a: (0, modulus - 1), lambda modulus, a: a % modulus),
    Op("neg", ("=",), "=", "", "", lambda a: (-a.hi, -a.lo), operator.neg),
    Op("abs", ("=",), "=", "", "", lambda a: (max(a.lo, -a.hi, 0), max(-a.lo, a.hi)), abs),
    Op("min", ("=", "="), "=", "", "", lambda a, b: (min(a.lo, b.lo), min(a.hi, b.hi)), smaller, commutative=True),
    Op("max", ("=", "="), "=", "", "", lambda a, b: (max(a.lo, b.lo), max(a.hi, b.hi)), larger, commutative=True),
    Op("sqrt", ("real",), "real", evaluate=square_root),
    Op("to_real", ("?",), "real"),
    Op("clamp", ("real",), "real", "(low, high)", "NaN → 0, clamped to the bounds, smaller than SNAP → 0", evaluate=_clamp),
    # choices and movements
    Op("select", ("flag", "=", "="), "=", "", "second argument where the first is true, else the third",
       lambda condition, yes, no: _union(yes, no), gates=3),
    Op("swap", ("=", "flag", "="), "=", "offset", "(content, movers, rest): movers and their targets exchanged",
       lambda offset, content, movers, rest: _union(content, rest)),
    Op("arrive", ("=", "flag", "="), "=", "offset", "(content, movers, rest): targets get the movers' content",
       lambda offset, content, movers, rest: _union(content, rest)),
)
# fmt: on

OPS: dict[str, Op] = {op.name: op for op in _TABLE}
"""Every operation of the IR."""

COMMUTATIVE = frozenset(op.name for op in _TABLE if op.commutative)


@dataclass(frozen=True, eq=False, slots=True)
class Node:
    """An operation on nodes. Created only by `Graph.node`; identity is equality within a graph."""

    op: str
    type: Type
    args: tuple[Node, ...] = field(repr=False)
    attr: Any
    index: int
    places: tuple[str, ...] = field(default=(), repr=False)
    """The rule's file and line: ``rules/acme.yaml:12``. Interning ignores it."""

    def is_input(self, slot: str) -> bool:
        """True if the node is the value of a slot before the pass."""
        return self.op == "input" and self.attr == slot


class Graph:
    """Creates and interns nodes. Arguments of commutative operations are sorted, except floats, which keep their order."""

    def __init__(self) -> None:
        self._nodes: dict[Hashable, Node] = {}
        self.place = ""
        """The file and line of the rule for which nodes are created."""

    def copy(self) -> Graph:
        """A graph with the same nodes, to which others can be added."""
        graph = Graph()
        graph._nodes = dict(self._nodes)
        return graph

    @property
    def size(self) -> int:
        return len(self._nodes)

    def node(self, op: str, type: Type, args: tuple[Node, ...] = (), attr: Hashable = None) -> Node:
        if op in COMMUTATIVE and args[0].type != REAL and args[0].index > args[1].index:
            args = (args[1], args[0])
        # A const's type keeps 1 and 1.0 and True apart; -0.0 never arises as a constant.
        key = (op, type.name, args, attr)
        node = self._nodes.get(key)
        if node is None:
            places = (self.place,) if self.place else ()
            node = self._nodes[key] = Node(op, type, args, attr, len(self._nodes), places)
        return node

    def derive(self, op: str, *args: Node, attr: Hashable = None) -> Node:
        """An operation whose type follows from its arguments."""
        return self.node(op, OPS[op].type_of(attr, args), args, attr)

    def input(self, slot: str, type: Type) -> Node:
        return self.node("input", type, attr=slot)

    def flag(self, value: bool) -> Node:
        return self.node("const", FLAG, attr=bool(value))

    def integer(self, value: int) -> Node:
        return self.node("const", integer(value, value), attr=int(value))

    def real(self, value: float) -> Node:
        return self.node("const", REAL, attr=float(value))

    def const(self, value: int | float, type: Type) -> Node:
        if type == FLAG:
            return self.flag(bool(value))
        return self.real(value) if type == REAL else self.integer(int(value))

    def not_(self, a: Node) -> Node:
        return self.derive("not", a)

    def and_(self, a: Node, b: Node) -> Node:
        return self.derive("and", a, b)

    def or_(self, a: Node, b: Node) -> Node:
        return self.derive("or", a, b)

    def any(self, flags: Sequence[Node]) -> Node:
        """The flag that is true where any of some flags is."""
        return reduce(self.or_, flags) if flags else self.flag(False)

    def select(self, condition: Node, yes: Node, no: Node) -> Node:
        return self.derive("select", condition, yes, no)

    def in_set(self, value: Node, members: frozenset[int]) -> Node:
        return self.derive("in_set", value, attr=members)

    def clamp(self, a: Node, lo: int, hi: int) -> Node:
        """Integers clamped to bounds, if their range exceeds them."""
        if a.type.lo < lo:
            a = self.derive("max", a, self.integer(lo))
        if a.type.hi > hi:
            a = self.derive("min", a, self.integer(hi))
        return a

    def shift(self, a: Node, offset: Offset, wraps: bool = True) -> Node:
        return a if offset == (0, 0) else self.derive("shift", a, attr=(*offset, wraps))

    def shift_uniform(self, a: Node, offset: Offset, wraps: bool) -> Node:
        """A constant or parameter at a neighbor: the same, and zero outside unless it wraps."""
        if wraps or offset == (0, 0) or (a.op == "const" and not a.attr):
            return a
        return self.select(self.derive("inside", attr=offset), a, self.const(0, a.type))

    def rebuild(self, node: Node, args: tuple[Node, ...]) -> Node:
        """The same operation on other arguments."""
        if args:
            return self.derive(node.op, *args, attr=node.attr)
        return self.node(node.op, node.type, attr=node.attr)


@dataclass(frozen=True)
class SubstepGraph:
    """The writes of one substep: the new node of each slot, and the flags without which nothing changes."""

    label: str
    place: str
    writes: tuple[tuple[str, Node], ...]
    guards: tuple[Node, ...]


@dataclass(frozen=True)
class PassGraph:
    """A pass: substeps in order. Nodes read slots through `input`, or the nodes that earlier substeps wrote."""

    name: str
    pack: str
    substeps: tuple[SubstepGraph, ...]
    outputs: tuple[tuple[str, Node], ...]
    """The last node of every slot that the pass changes."""

    def map(
        self, write: Callable[[str, Node], Iterable[tuple[str, Node]]], guard: Callable[[Node], Node]
    ) -> PassGraph:
        """The pass with other writes for each write of a slot, and another node for each guard."""

        def rewrite(pairs: Iterable[tuple[str, Node]]) -> tuple[tuple[str, Node], ...]:
            return tuple(chain.from_iterable(starmap(write, pairs)))

        substeps = [
            replace(step, writes=rewrite(step.writes), guards=tuple(map(guard, step.guards)))
            for step in self.substeps
        ]
        return replace(self, substeps=tuple(substeps), outputs=rewrite(self.outputs))


@dataclass(frozen=True)
class SlotType:
    """A slot holds one scalar of each cell: vectors are two slots, ``name.row`` and ``name.column``.

    `state` names the state's array, if that is not the slot's name, and `component` the part of a vector in it.
    """

    name: str
    type: Type
    default: int | float
    resets: bool
    state: str = ""
    component: int | None = None

    def of(self, array: Any) -> Any:
        """The slot's part of the state's array [B, H, W], or [B, 2, H, W] for a vector."""
        return array if self.component is None else array[:, self.component]

    @cached_property
    def planes(self) -> tuple[str, ...]:
        """The slots of its bit planes, lowest first; the slot itself for flags and floats."""
        if self.type.name != "int":
            return (self.name,)
        return tuple(plane_name(self.name, i) for i in range(self.type.bits))


def plane_name(slot: str, bit: int) -> str:
    """The slot of a bit of an integer slot."""
    return f"{slot}:{bit}"


def kernel_rows(weights: Iterable[tuple[int, int, int]]) -> dict[int, tuple[tuple[int, int], ...]]:
    """The columns and weights of each row of a kernel, from weights by row and column."""
    rows: dict[int, tuple[tuple[int, int], ...]] = {}
    for dy, dx, weight in weights:
        rows[dy] = (*rows.get(dy, ()), (dx, weight))
    return rows


@dataclass(frozen=True)
class Program:
    """A ruleset in IR."""

    name: str
    slots: tuple[SlotType, ...]
    params: tuple[tuple[str, str], ...]
    """Qualified name and kind."""
    streams: tuple[tuple[str, int, int], ...]
    """Name, number in the hash, bits."""
    passes: tuple[PassGraph, ...]


def needed(roots: Iterable[Item], below: Callable[[Item], Sequence[Item]]) -> dict[Item, Sequence[Item]]:
    """Map some items, and all items below them, each after the items directly below it."""
    done: dict[Item, Sequence[Item]] = {}
    begun: dict[Item, Sequence[Item]] = {}
    stack = [*roots][::-1]
    while stack:
        top = stack[-1]
        if top in done:
            stack.pop()
        elif top in begun:
            done[top] = begun[top]
        else:
            begun[top] = below(top)
            stack += reversed(begun[top])
    return done


def ordered(roots: Iterable[Node]) -> list[Node]:
    """All nodes that some nodes need, arguments before their users, in a stable order."""
    return [*needed(roots, _ARGS)]


def nodes_of(pass_: PassGraph, *, substeps: bool = True) -> list[Node]:
    """All nodes that a pass needs, as `ordered`: for its outputs and, unless told otherwise, for its substeps."""
    writes: list[tuple[str, Node]] = []
    guards: list[Node] = []
    for step in pass_.substeps if substeps else ():
        writes += step.writes
        guards += step.guards
    return ordered([*[node for _, node in (*writes, *pass_.outputs)], *guards])


def taken(stack: list[Item]) -> Iterator[Item]:
    """Pop each item of a stack once, while the caller adds others."""
    seen: set[Item] = set()
    while stack:
        top = stack.pop()
        if top not in seen:
            seen.add(top)
            yield top


def walk(node: Node) -> Iterator[Node]:
    """A node and everything below it, each once."""
    stack = [node]
    for top in taken(stack):
        yield top
        stack += top.args


def conjunctions(node: Node) -> Iterator[Node]:
    """A flag and the flags whose conjunction it is, each once, in order."""
    stack = [node]
    for top in taken(stack):
        yield top
        stack += reversed(top.args) if top.op == "and" else ()


def conjuncts(node: Node) -> list[Node]:
    """The flags of `conjunctions` that are not conjunctions themselves."""
    return [part for part in conjunctions(node) if part.op != "and"]
