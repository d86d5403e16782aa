"""Worlds as formulas: the content of a cell after some passes, as gates over the content of cells around it before.

Bits are literals of a net. Floats are uninterpreted terms: equal operations on equal terms are equal, and little
more. The grid is the infinite plane: a world that wraps is a plane that repeats, so what holds for all planes holds
for all worlds.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Protocol

from powderdsl.ir.lower import draws_below
from powderdsl.ir.ops import OPS, REAL, Node, Offset, Program, Threshold, integer
from powderdsl.model.state import Slot, fresh_values, holders, slots
from powderdsl.model.types import Ruleset
from powderdsl.prover.net import FALSE, TRUE, Literal, Net
from powderdsl.prover.solver import OutOfWork

LEAVES = ("const", "param", "draw")
"""Operations whose terms have no parts."""

Term = int
"""The number of a float term."""

Cell = tuple[int, int]

MAX_SIZE = 1_500_000
"""Maximum number of gates and terms of one question."""


WORK_PER_SECOND = 1_000_000
"""Units of work per second on a slow machine: clauses and literals that the solver visits, and tenths of gates."""


class Undecided(Exception):
    """Raised for a question that is too large, or of a kind that formulas do not cover."""


@dataclass
class Budget:
    """The remaining work, counted so that it ends at the same point on every machine."""

    left: int

    @classmethod
    def of(cls, seconds: float) -> Budget:
        """The work that takes about this many seconds."""
        return cls(int(seconds * WORK_PER_SECOND))

    def spend(self, work: int) -> None:
        """Raise OutOfWork if not enough is left."""
        self.left -= work
        if self.left < 0:
            raise OutOfWork


class Terms:
    """Float terms: ``(operation, attribute, *arguments)``. A term is its number; equal terms are one."""

    def __init__(self) -> None:
        self.terms: list[tuple[object, ...]] = []
        self._numbers: dict[tuple[object, ...], Term] = {}
        self._choices: dict[Term, frozenset[int]] = {}

    def leaf(self, *name: object) -> Term:
        """A constant, a parameter, a draw or the content of a slot."""
        number = self._numbers.setdefault(name, len(self.terms))
        if number == len(self.terms):
            self.terms.append(name)
        return number

    def constant(self, value: float) -> Term:
        return self.leaf("const", value + 0.0)  # zeros of either sign are alike

    def value(self, term: Term) -> float | None:
        """The value of a constant."""
        kind, value, *_ = self.terms[term]
        return value if kind == "const" else None  # type: ignore[return-value]

    def choices(self, term: Term) -> frozenset[int]:
        """The gates that decide which of its parts a term equals."""
        if term not in self._choices:
            kind, attr, *args = self.terms[term]
            parts: list[Any] = args if kind in OPS and kind not in LEAVES else []
            own = [attr >> 1] if kind == "select" else []  # type: ignore[operator]
            self._choices[term] = frozenset(own).union(*map(self.choices, parts))
        return self._choices[term]

    def choose(self, condition: Literal, yes: Term, no: Term) -> Term:
        if condition & 1:
            condition, yes, no = condition ^ 1, no, yes
        for side, term in enumerate((yes, no)):  # the same choice again
            kind, *parts = self.terms[term]
            if kind == "select" and parts[0] == condition:
                yes, no = (parts[1], no) if side == 0 else (yes, parts[2])  # type: ignore[assignment]
        return no if condition == FALSE or yes == no else self.leaf("select", condition, yes, no)

    def apply(self, op: str, attr: object, args: Sequence[Term]) -> Term:
        """An operation, evaluated on constants. Sums and products commute; x + 0, x - 0, x · 1 and x / 1 are x."""
        values = [self.value(arg) for arg in args]
        if None not in values and OPS[op].evaluate is not None:
            return self.constant(OPS[op].value(attr, *values))
        if len(args) == 2:
            if op == "sub" and values[1] is not None:
                return self.apply("add", attr, (args[0], self.constant(-values[1])))
            if op == "add" and args[0] == args[1]:
                return self.apply("mul", attr, (args[0], self.constant(2.0)))
            neutral = {"add": 0.0, "sub": 0.0, "mul": 1.0, "div": 1.0}.get(op)
            if neutral is not None and values[1] == neutral:
                return args[0]
            if op in ("add", "mul"):
                if values[0] == neutral:
                    return args[1]
                args = sorted(args)
        return self.leaf(op, attr, *args)


class World(Protocol):
    """A world, given by formulas."""

    def bit(self, plane: str, y: int, x: int) -> Literal: ...
    def real(self, slot: str, y: int, x: int) -> Term: ...


@dataclass(frozen=True)
class Layout:
    """A slot of integers: its bit planes, and its well-formed values."""

    slot: Slot
    planes: tuple[str, ...]
    signed: bool
    lo: int
    hi: int
    usual: tuple[int | None, ...]
    """By id: the value in fresh cells; None if a parameter decides."""
    holders: frozenset[int] | None
    """Elements whose cells may have unusual values; None for all."""

    def bits(self, world: World, y: int, x: int) -> list[Literal]:
        return [world.bit(plane, y, x) for plane in self.planes]


def layouts(ruleset: Ruleset, program: Program) -> dict[str, Layout]:
    """The slots of flags and integers by name, that of elements first."""
    parts = {part.name: part for part in program.slots}
    rows = {}
    for slot in slots(ruleset):
        if slot.is_real:
            continue
        names, type = parts[slot.name].planes, parts[slot.name].type
        prop = ruleset.property(slot.name)
        usual: list[int | None] = [*map(int, fresh_values(ruleset, slot))]
        if prop is not None:
            usual = [None if isinstance(value, str) else usual[i] for i, value in enumerate(prop.values)]
        own = holders(ruleset, slot) or None
        rows[slot.name] = Layout(slot, names, type.signed, type.lo, type.hi, tuple(usual), own)
    return rows


class Symbols:
    """The variables of one question: bits of cells, draws, parameters and places; `facts` are true literals.

    `program` has the passes to examine, and the streams, parameters and slots of the ruleset.
    """

    def __init__(
        self,
        ruleset: Ruleset,
        program: Program,
        budget: Budget,
        limit: int = MAX_SIZE,
        shared: dict[str, Layout] | None = None,
    ) -> None:
        self.ruleset, self.budget = ruleset, budget
        budget.spend(0)  # create nothing if no work is left
        self.net = Net()
        self.terms = Terms()
        self.layouts = shared or layouts(ruleset, program)
        self.ids = [element.id for element in ruleset.elements]
        self.facts: list[Literal] = []
        self.general: list[Literal] = []
        """Facts about parameters and about the numbers of rows, columns and steps."""
        self.comparisons: dict[tuple[str, Term, Term], Literal] = {}
        self.limit = limit
        self.turn: Callable[[Cell], Cell] | None = None
        """While a turned world is evaluated: the map from its cells to those of the other one."""
        self._owners = {plane: row for row in self.layouts.values() for plane in row.planes}
        self._known: set[object] = set()

    @property
    def size(self) -> int:
        return self.net.size + len(self.terms.terms)

    def _once(self, *key: object) -> bool:
        """Return True the first time that a key is given."""
        is_new = key not in self._known
        self._known.add(key)
        return is_new

    def _add(self, fact: Literal) -> None:
        self.facts.append(fact)
        self.general.append(fact)

    def draw(self, stream: str, y: int, x: int, bits: int) -> list[Literal]:
        y, x = self.turn((y, x)) if self.turn else (y, x)
        return [self.net.variable("draw", stream, y, x, i) for i in range(bits)]

    def parameter(self, name: str, threshold: Threshold | None, bit: int) -> Literal:
        """A bit of a parameter, or of a chance as a number of draws."""
        net = self.net
        literal = net.variable("param", name, threshold, bit)
        if self._once("param", name, threshold):
            param = next(param for param in self.ruleset.params if param.name == name)
            if threshold is not None:
                bits = [net.variable("param", name, threshold, i) for i in range(threshold.bits + 1)]
                self._add(net.below(bits, (1 << threshold.bits) + 1))
            elif param.kind.name == "int":
                type = integer(int(param.kind.lo), int(param.kind.hi))
                bits = [net.variable("param", name, None, i) for i in range(type.bits)]
                self._add(net.within(bits, type.lo, type.hi, signed=type.signed))
        return literal

    def coordinate(self, axis: str, modulus: int, bit: int, y: int, x: int) -> Literal:
        """A bit of a row's, a column's or a step's number, modulo something."""
        if self.turn and axis != "step":
            raise Undecided("numbers of rows and columns in rotated or mirrored worlds")
        net, at = self.net, {"row": y, "column": x}.get(axis, 0)
        # Where sides are not a multiple of the modulus, numbers restart at an edge: each row may then have any.
        repeats = axis == "step" or self.ruleset.side_multiple % modulus == 0
        key = (axis, modulus) if repeats else (axis, modulus, at)
        bits = [net.variable("coordinate", *key, i) for i in range(max((modulus - 1).bit_length(), 1))]
        if self._once("coordinate", *key):
            self._add(net.below(bits, modulus))
        if not repeats:
            return bits[bit]
        return net.member(bits, [number for number in range(modulus) if (number + at) % modulus >> bit & 1])

    def inside(self, at: Cell, offset: Offset) -> Literal:
        """Return whether a neighbor lies inside the grid."""
        if self.turn:
            at, offset = self.turn(at), self.turn(offset)
        parts = zip(("row", "column"), at, offset, strict=True)
        near = ((axis, a, e) for axis, a, d in parts for e in range(d, 0, -1 if d > 0 else 1))
        return self.net.all(self.net.variable("outside", *name) ^ 1 for name in near)  # those between too

    def compare(self, op: str, a: Term, b: Term) -> Literal:
        """A comparison of floats: a variable, decided only for constants."""
        left, right = self.terms.value(a), self.terms.value(b)
        if left is not None and right is not None:
            return int(bool(OPS[op].value(None, left, right)))
        key = (op, a, b)
        return self.comparisons.setdefault(key, self.about("comparison", *key))

    def about(self, *name: Any) -> Literal:
        """A variable about two floats, named by their terms: these depend on the gates that choose their parts."""
        literal = self.net.variable(*name)
        self.net.inputs[literal >> 1] = (*frozenset().union(*map(self.terms.choices, name[-2:])),)
        return literal

    def cells_read(self, gates: Iterable[int]) -> dict[Cell, dict[str, None]]:
        """The cells of worlds of variables that are among some gates, with the planes that are read there."""
        cells: dict[Cell, dict[str, None]] = {}
        for number in gates:
            name = self.net.names.get(number)
            if name and name[0] == "cell":
                _, _, plane, y, x = name
                cells.setdefault((y, x), {})[plane] = None
        return cells

    def well_formed(
        self, world: World, cell: Cell, planes: Iterable[str] | None = None, ranges: Ranges | None = None
    ) -> list[Literal]:
        """Return the facts about every cell in these planes: known elements, numbers in their ranges, and usual
        values in cells whose elements can have no others. `ranges` are narrower ranges."""
        net, element = self.net, self.layouts["element"]
        owned = self._owners if planes is None else filter(self._owners.__contains__, planes)
        owners = dict.fromkeys(map(self._owners.__getitem__, owned))
        ids = element.bits(world, *cell)
        facts = [net.member(ids, self.ids)]
        for row in owners:
            if row is element:
                continue
            bits = row.bits(world, *cell)
            if row.slot.kind.name == "element":
                facts.append(net.member(bits, self.ids))
            else:
                lo, hi = (ranges or {}).get(row.slot.name, (row.lo, row.hi))
                facts.append(net.within(bits, lo, hi, signed=row.signed))
            groups: dict[int, list[int]] = {}
            for identity in self.ids if row.holders is not None else ():
                value = row.usual[identity]
                if identity not in row.holders and value is not None:  # type: ignore[operator]
                    groups.setdefault(value, []).append(identity)
            for value, members in groups.items():
                facts.append(net.or_(net.member(ids, members) ^ 1, net.member(bits, [value])))
        return facts


Ranges = Mapping[str, tuple[int, int]]


class Before:
    """A world of variables. Worlds with different tags are independent."""

    def __init__(self, symbols: Symbols, tag: str = "") -> None:
        self.symbols, self.tag = symbols, tag

    def bit(self, plane: str, y: int, x: int) -> Literal:
        return self.symbols.net.variable("cell", self.tag, plane, y, x)

    def real(self, slot: str, y: int, x: int) -> Term:
        return self.symbols.terms.leaf("cell", self.tag, slot, y, x)


class Turned:
    """A world, ``mirrored`` left to right or ``rotated`` clockwise."""

    def __init__(self, world: World, symbols: Symbols, turn: str) -> None:
        self.world, self.symbols, self.turn = world, symbols, turn
        self._directions = {
            plane: (row, i)
            for row in symbols.layouts.values()
            if row.slot.kind.name == "direction"
            for i, plane in enumerate(row.planes)
        }

    def place(self, at: Cell) -> Cell:
        """Return the cell of the world that a cell of the turned world shows."""
        return (at[0], -at[1]) if self.turn == "mirrored" else (-at[1], at[0])

    def bit(self, plane: str, y: int, x: int) -> Literal:
        cell, net = self.place((y, x)), self.symbols.net
        bit = self.world.bit(plane, *cell)
        if plane not in self._directions:
            return bit
        row, i = self._directions[plane]
        octants = [4 - octant if self.turn == "mirrored" else octant + 2 for octant in range(8)]
        turned = net.member(
            row.bits(self.world, *cell), [n for n, octant in enumerate(octants) if octant % 8 >> i & 1]
        )
        if row.holders is None:
            return turned
        element = self.symbols.layouts["element"].bits(self.world, *cell)
        return net.choice(net.member(element, row.holders), turned, bit)  # the usual value does not turn

    def real(self, slot: str, y: int, x: int) -> Term:
        raise Undecided("floats in rotated or mirrored worlds")


@dataclass(frozen=True)
class Written:
    """A world with other contents in some planes, which `value` evaluates; the other planes are those of a world before."""

    before: World
    writes: Mapping[str, Any]
    value: Callable[[Any, int, int], int]

    def bit(self, plane: str, y: int, x: int) -> Literal:
        node = self.writes.get(plane)
        return self.before.bit(plane, y, x) if node is None else self.value(node, y, x)

    def real(self, slot: str, y: int, x: int) -> Term:
        node = self.writes.get(slot)
        return self.before.real(slot, y, x) if node is None else self.value(node, y, x)


def reset(before: World, symbols: Symbols) -> Written:
    """The world at the start of a step: some slots begin with their defaults."""
    rows = [row for row in symbols.layouts.values() if row.slot.resets]
    bits = {plane: int(row.slot.default) >> i & 1 for row in rows for i, plane in enumerate(row.planes)}
    return Written(before, bits, lambda bit, y, x: bit)


@dataclass(frozen=True)
class Renaming:
    """The names of another ruleset's parameters and streams. `fixed` has values of parameters."""

    params: Mapping[str, str] = field(default_factory=dict)
    streams: Mapping[str, str] = field(default_factory=dict)
    fixed: Mapping[str, Any] | None = None

    def stream(self, name: str) -> str:
        return self.streams.get(name, name)


class Formulas:
    """Nodes as formulas over an earlier world. Nodes of `cut` may have any value, in the plane that it names."""

    def __init__(self, before: World, symbols: Symbols, names: Renaming | None = None) -> None:
        self.before, self.symbols, self.names = before, symbols, names or Renaming()
        self.cut: Mapping[Node, tuple[str, str]] = {}
        self._values: dict[tuple[Node, int, int], int] = {}

    def after(self, writes: Iterable[tuple[str, Node]]) -> Written:
        """The world after some writes."""
        return Written(self.before, dict(writes), self.value)

    def value(self, node: Node, y: int, x: int) -> int:
        """The literal of a flag, or the term of a float, in a cell."""
        key = (node, y, x)
        value = self._values.get(key)
        if value is None:
            value = self._values[key] = self._compute(node, y, x)
            if self.symbols.size > self.symbols.limit or len(self._values) > 2 * self.symbols.limit:
                raise Undecided("too many gates")
        return value

    def _choose(self, is_real: bool, condition: Literal, yes: int, no: int) -> int:
        choose = self.symbols.terms.choose if is_real else self.symbols.net.choice
        return choose(condition, yes, no)

    def _parameter(self, attr: tuple[Any, ...], is_real: bool) -> int:
        name, threshold, *bits = attr
        bit, fixed = (bits or [0])[0], self.names.fixed
        if fixed is not None:
            value = draws_below(fixed[name], threshold) if threshold else fixed[name]
            return self.symbols.terms.constant(float(value)) if is_real else int(value) >> bit & 1
        name = self.names.params.get(name, name)
        return (
            self.symbols.terms.leaf("param", name)
            if is_real
            else self.symbols.parameter(name, threshold, bit)
        )

    def _compute(self, node: Node, y: int, x: int) -> int:
        symbols, net, terms, value = self.symbols, self.symbols.net, self.symbols.terms, self.value
        args, attr, is_real = node.args, node.attr, node.type == REAL
        if node in self.cut:
            tag, plane = self.cut[node]
            world = Before(symbols, tag)
            return world.real(plane, y, x) if is_real else world.bit(plane, y, x)
        match node.op:
            case "input":
                return self.before.real(attr, y, x) if is_real else self.before.bit(attr, y, x)
            case "const":
                return terms.constant(float(attr)) if is_real else int(bool(attr))
            case "and":
                first = value(args[0], y, x)
                return first if first == FALSE else net.and_(first, value(args[1], y, x))
            case "or":
                first = value(args[0], y, x)
                return first if first == TRUE else net.or_(first, value(args[1], y, x))
            case "xor":
                return net.xor(value(args[0], y, x), value(args[1], y, x))
            case "not":
                return value(args[0], y, x) ^ 1
            case "select":
                condition = value(args[0], y, x)
                if condition < 2:
                    return value(args[2 - condition], y, x)
                return self._choose(is_real, condition, value(args[1], y, x), value(args[2], y, x))
            case "shift":
                dy, dx, wraps = attr
                content = value(args[0], y + dy, x + dx)
                outside = terms.constant(0.0) if is_real else FALSE
                return (
                    content
                    if wraps
                    else self._choose(is_real, symbols.inside((y, x), (dy, dx)), content, outside)
                )
            case "swap" | "arrive":
                (dy, dx), (moved, movers, rest) = attr, args
                came = value(movers, y - dy, x - dx)
                result = FALSE if came == TRUE else value(rest, y, x)
                if came != FALSE:
                    result = self._choose(is_real, came, value(moved, y - dy, x - dx), result)
                left = value(movers, y, x) if node.op == "swap" else FALSE
                return self._choose(is_real, left, value(moved, y + dy, x + dx), result) if left else result
            case "chance":
                stream, bits, limit = attr
                return net.below(symbols.draw(self.names.stream(stream), y, x, bits), limit)
            case "below_planes":
                stream, bits = attr
                limits = [value(arg, y, x) for arg in reversed(args)]
                return net.less(symbols.draw(self.names.stream(stream), y, x, bits), limits)
            case "param":
                return self._parameter(attr, is_real)
            case "coordinate":
                axis, modulus, *bits = attr
                return symbols.coordinate(axis, modulus, bits[0] if bits else 0, y, x)
            case "inside":
                return symbols.inside((y, x), attr)
            case "draw":
                return terms.leaf("draw", self.names.stream(attr[0]), y, x)
            case "eq" | "lt" | "le":
                a, b = value(args[0], y, x), value(args[1], y, x)
                if args[0].type == REAL:
                    return symbols.compare(node.op, a, b)
                return {"eq": net.xor(a, b) ^ 1, "lt": net.and_(a ^ 1, b), "le": net.or_(a ^ 1, b)}[node.op]
        return terms.apply(node.op, attr, [value(arg, y, x) for arg in args])


@contextmanager
def deep_recursion() -> Iterator[None]:
    """A stack deep enough for formulas as deep as a pass's gates: calls in Python do not use the machine's stack."""
    before = sys.getrecursionlimit()
    sys.setrecursionlimit(10 * MAX_SIZE)
    try:
        yield
    finally:
        sys.setrecursionlimit(before)
