"""The IR: one immutable, interned node; one table of operations; programs made of substeps.

A node has a value in each cell of each world: a flag, an integer with a declared range, or a float32. There is no
control flow inside a substep. Equal nodes of one graph are the same object, so common sub-expressions are free.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Container, Hashable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

from powderdsl.ir.single import divided, larger, single, smaller, square_root

Offset = tuple[int, int]

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


@dataclass(frozen=True)
class Op:
    """A row of the table: argument types (`?` any, `=` all alike, `*` any number of them), result, what `attr` is.

    `evaluate` gives the result for `attr` and the values of the arguments, with which stages fold constants. None where the result depends on more than these, or is a choice between planes.
    """

    name: str
    args: tuple[str, ...]
    result: str
    attr: str = ""
    about: str = ""
    evaluate: Callable[..., Any] | None = None


def _settle(attr: tuple[float, float], a: float) -> float:
    kept = smaller(larger(a, single(attr[0])), single(attr[1]))
    return kept if abs(kept) >= SNAP else 0.0  # NaN is not ≥ SNAP


def _plain(evaluate: Callable[..., Any]) -> Callable[..., Any]:
    """A function of the arguments alone; floats are rounded to float32."""

    def result(attr: None, *args: Any) -> Any:
        found = evaluate(*args)
        return single(found) if isinstance(found, float) else found

    return result


# fmt: off
_TABLE = (
    # where values come from
    Op("input", (), "?", "slot", "what the pass finds in a slot"),
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
    Op("shift", ("?",), "=", "(rows, columns, wraps)", "the value at a neighbor; zero outside unless it wraps"),
    Op("count", ("flag",), "int", "((rows, columns, weight)…, wraps)", "weighted number of neighbors that hold"),
    # flags
    Op("not", ("flag",), "flag"),
    Op("and", ("flag", "flag"), "flag"),
    Op("or", ("flag", "flag"), "flag"),
    Op("xor", ("flag", "flag"), "flag"),
    # integers and floats
    Op("in_set", ("int",), "flag", "frozen set", "whether the value is one of these"),
    Op("table", ("int",), "int", "values by index, from 0"),
    Op("eq", ("=", "="), "flag", evaluate=_plain(operator.eq)),
    Op("lt", ("=", "="), "flag", evaluate=_plain(operator.lt)),
    Op("le", ("=", "="), "flag", evaluate=_plain(operator.le)),
    Op("add", ("=", "="), "=", evaluate=_plain(operator.add)),
    Op("sub", ("=", "="), "=", evaluate=_plain(operator.sub)),
    Op("mul", ("=", "="), "=", evaluate=_plain(operator.mul)),
    Op("div", ("real", "real"), "real", about="x / 0 is 0", evaluate=_plain(divided)),
    Op("quotient", ("int", "int"), "int", about="rounded down; x div 0 is 0", evaluate=_plain(lambda a, b: a // b if b else 0)),
    Op("neg", ("?",), "=", evaluate=_plain(operator.neg)),
    Op("abs", ("?",), "=", evaluate=_plain(abs)),
    Op("min", ("=", "="), "=", evaluate=_plain(smaller)),
    Op("max", ("=", "="), "=", evaluate=_plain(larger)),
    Op("mod", ("int",), "int", "modulus", evaluate=lambda modulus, a: a % modulus),
    Op("sqrt", ("real",), "real", evaluate=_plain(square_root)),
    Op("to_real", ("?",), "real"),
    Op("settle", ("real",), "real", "(low, high)", "NaN → 0, clamped to the bounds, smaller than SNAP → 0", _settle),
    # choices and movements
    Op("select", ("flag", "=", "="), "=", about="second argument where the first holds, else the third"),
    Op("swap", ("=", "flag", "="), "=", "offset", "(content, movers, rest): movers and their targets exchanged"),
    Op("arrive", ("=", "flag", "="), "=", "offset", "(content, movers, rest): targets get the movers' content"),
)
# fmt: on

OPS: dict[str, Op] = {op.name: op for op in _TABLE}
"""Every operation of the IR."""

COMMUTATIVE = frozenset({"and", "or", "xor", "eq", "add", "mul", "min", "max"})
LEAVES = frozenset({"input", "const", "param", "coordinate", "inside", "draw"})


@dataclass(frozen=True, eq=False, slots=True)
class Node:
    """An operation on nodes. Made by `Graph.node` only; identity is equality within a graph."""

    op: str
    type: Type
    args: tuple[Node, ...]
    attr: Any
    index: int
    places: tuple[str, ...] = field(default=(), repr=False)
    """Where it was written: ``rules/acme.yaml:12``. Takes no part in interning."""


class Graph:
    """Makes and interns nodes. Arguments of commutative operations are sorted, except floats: their order is kept."""

    def __init__(self) -> None:
        self._nodes: dict[Hashable, Node] = {}

    def copy(self) -> Graph:
        """A graph with the same nodes, to which others can be added."""
        made = Graph()
        made._nodes = dict(self._nodes)
        return made

    @property
    def size(self) -> int:
        """The number of nodes."""
        return len(self._nodes)

    def node(
        self,
        op: str,
        type: Type,
        args: tuple[Node, ...] = (),
        attr: Hashable = None,
        places: tuple[str, ...] = (),
    ) -> Node:
        if op in COMMUTATIVE and args[0].type != REAL and args[0].index > args[1].index:
            args = (args[1], args[0])
        # A const's type keeps 1 and 1.0 and True apart; -0.0 never arises as a constant.
        key = (op, type.name, tuple(arg.index for arg in args), attr)
        found = self._nodes.get(key)
        if found is None:
            found = Node(op, type, args, attr, len(self._nodes), places)
            self._nodes[key] = found
        return found


@dataclass(frozen=True)
class SubstepGraph:
    """What one substep writes: the new node of each slot, and the flags without which nothing changes."""

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


def component_names(name: str) -> tuple[str, str]:
    """The slots of a vector."""
    return f"{name}.row", f"{name}.column"


def component_of(slot: str) -> tuple[str, int | None]:
    """The vector that a slot is a component of, and which; the slot itself and None for any other."""
    for i, end in enumerate(component_names("")):
        if slot.endswith(end):
            return slot.removesuffix(end), i
    return slot, None


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


def ordered(roots: Iterable[Node], known: Container[int] = ()) -> list[Node]:
    """All nodes that some nodes need, arguments before their users, in a stable order; those `known` by id left out."""
    seen: dict[int, Node] = {}
    for root in roots:
        stack = [root] if id(root) not in known else []
        while stack:
            node = stack[-1]
            for arg in node.args:
                if id(arg) not in seen and id(arg) not in known:
                    stack.append(arg)
                    break
            else:
                seen[id(node)] = node
                stack.pop()
    return list(seen.values())


def nodes_of(pass_: PassGraph, *, substeps: bool = True) -> list[Node]:
    """All nodes that a pass needs, as `ordered`: for its outputs and, unless told otherwise, for its substeps."""
    roots = [node for _, node in pass_.outputs]
    if substeps:
        writes = [node for one in pass_.substeps for _, node in one.writes]
        roots = [*writes, *roots, *(guard for one in pass_.substeps for guard in one.guards)]
    return ordered(roots)


def walk(node: Node) -> Iterator[Node]:
    """A node and everything below it, each once."""
    seen: set[int] = set()
    stack = [node]
    while stack:
        top = stack.pop()
        if id(top) not in seen:
            seen.add(id(top))
            yield top
            stack.extend(top.args)
