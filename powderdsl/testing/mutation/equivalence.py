"""Proves that a mutant means the same as the original: pass by pass, and substep by substep."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from math import lcm, prod
from typing import Any

import numpy as np

from powderdsl.ir.lower import lower_pass, lower_substep, part_names
from powderdsl.ir.ops import COMMUTATIVE, OPS, REAL, Graph, Node, Offset
from powderdsl.model.state import slots
from powderdsl.model.types import Pass, Ruleset, minus, plus


def proven_equal(first: Ruleset, second: Ruleset) -> bool:
    """True if two compositions provably turn every world into the same world. False proves nothing.

    Worlds must hold the same, so that a changed range, default or kind of a field is a difference by itself.
    """
    if not _same_worlds(first, second):
        return False
    same_tables = first.properties == second.properties
    cells = _cells(first)
    for mine, theirs in zip(first.passes, second.passes, strict=True):
        if same_tables and mine == theirs:
            continue
        if not _same_pass(first, mine, second, theirs, cells):
            return False
    return True


def _same_worlds(first: Ruleset, second: Ruleset) -> bool:
    streams = {stream.name: stream for stream in first.streams}
    return (
        [(e.name, e.id) for e in first.elements] == [(e.name, e.id) for e in second.elements]
        and slots(first) == slots(second)
        and [(p.name, p.kind, p.stored) for p in first.properties]
        == [(p.name, p.kind, p.stored) for p in second.properties]
        and first.params == second.params
        and all(streams.get(stream.name, stream) == stream for stream in second.streams)
        and [p.name for p in first.passes] == [p.name for p in second.passes]
    )


def _cells(ruleset: Ruleset) -> Cells:
    ids = tuple(element.id for element in ruleset.elements)
    domains: dict[str, tuple[int, ...]] = {}
    holders: dict[str, Holders] = {}
    for slot in slots(ruleset):
        if slot.is_real:
            continue
        (name,) = part_names(slot.name, slot.kind)
        prop = ruleset.property(slot.name)
        if slot.kind.name == "element":
            domains[name] = ids
        if prop is not None and slot.kind.name in ("int", "flag"):
            holders[name] = Holders(
                prop.stored, tuple(int(value) if isinstance(value, int) else 0 for value in prop.values)
            )
        elif slot.of is not None and not slot.own:
            holders[name] = Holders(slot.of, (int(slot.default),) * (max(ids) + 1))
    return Cells(domains, holders)


def _same_pass(first: Ruleset, mine: Pass, second: Ruleset, theirs: Pass, cells: Cells) -> bool:
    """Substep by substep, each from whatever the one before may have left; if that does not do, as a whole."""
    if mine.scratch != theirs.scratch:
        return False
    numbers = range(len(mine.moments))
    if len(mine.moments) == len(theirs.moments) and all(
        _same_substep(first, mine, second, theirs, number, cells) for number in numbers
    ):
        return True
    graph = Graph()
    return _same_writes(lower_pass(first, mine, graph), lower_pass(second, theirs, graph), graph, cells)


def _same_substep(
    first: Ruleset, mine: Pass, second: Ruleset, theirs: Pass, number: int, cells: Cells
) -> bool:
    graph = Graph()
    return _same_writes(
        lower_substep(first, mine, number, graph), lower_substep(second, theirs, number, graph), graph, cells
    )


def _same_writes(first: dict[str, Node], second: dict[str, Node], graph: Graph, cells: Cells) -> bool:
    """True if both passes write the same values; a slot that a pass does not write keeps its value."""
    compare = Comparison(cells)
    for name in dict.fromkeys([*first, *second]):
        mine, theirs = first.get(name), second.get(name)
        written = mine or theirs
        assert written is not None
        if name.startswith("let ") and (mine is None or theirs is None):
            continue  # no other rule reads a value that the other does not have
        kept = graph.node("input", written.type, (), name)
        if not compare.equal(mine or kept, theirs or kept):
            return False
    return True


Array = np.ndarray[Any, Any]
Variable = tuple[Hashable, ...]

MAX_CASES = 1 << 21
"""Assignments that are tried for one question."""

MAX_WORK = 1_000_000_000
"""Assignments times nodes that are evaluated for one mutant. Proofs end by work, so they are the same on any machine."""

VISIT = 200
"""Work for a node that is looked at to find the variables, whether the question is decided or not."""

MAX_VALUES = 301
"""Values of one variable."""


class Undecided(Exception):
    """A question is too large."""


@dataclass(frozen=True)
class Holders:
    """The elements whose cells can hold anything in a slot, and by id what cells of the others hold there."""

    ids: frozenset[int]
    usual: tuple[int, ...]


@dataclass(frozen=True)
class Cells:
    """Facts about cells: values that an input can hold, and inputs that only some elements are free to hold."""

    domains: Mapping[str, tuple[int, ...]]
    holders: Mapping[str, Holders]


@dataclass
class Comparison:
    """Compares nodes of one graph. It remembers what it has decided, and how much work is left."""

    cells: Cells
    left: int = MAX_WORK
    _known: dict[tuple[int, int], bool] = field(default_factory=dict)

    def equal(self, a: Node, b: Node) -> bool:
        """True is a proof; False means that they differ, or that it could not be decided."""
        if a is b:
            return True
        key = (a.index, b.index) if a.index < b.index else (b.index, a.index)
        if key not in self._known:
            self._known[key] = False  # for questions that lead back to this one
            self._known[key] = (
                self._alike(a, b) or self._simpler(a, b) or self._simpler(b, a) or self._tried(a, b)
            )
        return self._known[key]

    def _alike(self, a: Node, b: Node) -> bool:
        """The same operation on equal parts."""
        if a.op != b.op or a.attr != b.attr or len(a.args) != len(b.args) or not a.args:
            return False
        if all(self.equal(x, y) for x, y in zip(a.args, b.args, strict=True)):
            return True
        turned = a.op in COMMUTATIVE and (a.type != REAL or a.args[0].type != REAL)
        return turned and all(self.equal(x, y) for x, y in zip(a.args, reversed(b.args), strict=True))

    def _simpler(self, a: Node, b: Node) -> bool:
        """A choice of which only one branch is ever taken, a movement in which nothing moves."""
        if a.op == "select":
            condition, yes, no = a.args
            return (self.is_always(condition, 0) and self.equal(no, b)) or (
                self.is_always(condition, 1) and self.equal(yes, b)
            )
        if a.op in ("swap", "arrive"):
            return self.is_always(a.args[1], 0) and self.equal(a.args[2], b)
        return False

    def is_always(self, flag: Node, value: int) -> bool:
        """True if a flag has this value, 0 or 1, in every cell."""
        return self._decided(
            (flag,), lambda case: bool((case.value(flag, (0, 0)) == value)[case.valid].all())
        )

    def _tried(self, a: Node, b: Node) -> bool:
        if REAL in (a.type, b.type):
            return False
        return self._decided(
            (a, b),
            lambda case: bool((case.value(a, (0, 0)) == case.value(b, (0, 0)))[case.valid].all()),
        )

    def _decided(self, roots: tuple[Node, ...], question: Callable[[_Cases], bool]) -> bool:
        """True if the question holds in every case. If there are too many cases, counts of other cells may be any number."""
        for counted in (False, True):
            try:
                return question(_Cases(roots, self.cells, self, counted))
            except (Undecided, RecursionError):
                continue
        return False

    def spend(self, work: int) -> None:
        self.left -= work
        if self.left < 0:
            raise Undecided


def _reads(node: Node, at: Offset) -> list[tuple[Node, Offset]]:
    """The parts of a node and where they are read."""
    match node.op:
        case "shift":
            return [(node.args[0], plus(at, node.attr[:2]))]
        case "count":
            return [(node.args[0], plus(at, (dy, dx))) for dy, dx, _ in node.attr[0]]
        case "swap":
            content, movers, rest = node.args
            there, back = plus(at, node.attr), minus(at, node.attr)
            return [(movers, at), (content, there), (movers, back), (content, back), (rest, at)]
        case "arrive":
            content, movers, rest = node.args
            back = minus(at, node.attr)
            return [(movers, back), (content, back), (rest, at)]
    return [(arg, at) for arg in node.args]


def _is_free(node: Node) -> bool:
    """True if a node counts as a variable: it depends on floats or on a parameter, and is not a float itself."""
    chance = node.op == "below" and node.args[0].op != "const"
    return chance or node.op == "param" or any(arg.type == REAL for arg in node.args)


class _Cases:
    """All assignments to the variables that some nodes depend on, and the nodes' values in each.

    Args:
        counted: take what a count finds in other cells for a variable of its own. More cases than there are can only
            refute.

    Raises:
        Undecided: there are too many.
    """

    def __init__(self, roots: tuple[Node, ...], cells: Cells, work: Comparison, counted: bool):
        self.cells, self.work, self.counted = cells, work, counted
        self.inputs: dict[Variable, Node] = {}
        self.uses: dict[Variable, set[Hashable]] = {}
        """The questions about each input: its value, or only whether it is in a set."""
        self.thresholds: dict[str, list[int]] = {}
        self.moduli: dict[str, int] = {}
        nodes = self._find_inputs(roots)
        domains = {name: self._domain(name, node) for name, node in self.inputs.items()}
        self.size = prod(len(values) for values in domains.values())
        if self.size > MAX_CASES:
            raise Undecided
        work.spend(self.size * max(nodes, 1))
        self.variables: dict[Variable, Array] = {}
        """For each, its value in each case."""
        stride = 1
        number = np.arange(self.size)
        for name, values in domains.items():
            self.variables[name] = np.asarray(values, np.int32)[number // stride % len(values)]
            stride *= len(values)
        self.valid = self._valid()
        self._values: dict[tuple[int, Offset], Array] = {}

    def _find_inputs(self, roots: tuple[Node, ...]) -> int:
        """Find the variables; the number of nodes that were looked at."""
        seen: set[tuple[int, Offset]] = set()
        stack: list[tuple[Node, Offset, Hashable]] = [(root, (0, 0), "value") for root in roots]
        while stack:
            node, at, use = stack.pop()
            if node.op == "input" and node.type != REAL:
                name: Variable = ("input", node.attr, at)
                self.inputs[name] = node
                self.uses.setdefault(name, set()).add(use)
                continue
            if (node.index, at) in seen:
                continue
            seen.add((node.index, at))
            self.work.spend(VISIT)
            if len(seen) > 20_000 or node.type == REAL:  # floats only through a comparison, which is free
                raise Undecided
            self.inputs.update(dict.fromkeys(self._own_variables(node, at), node))
            if _is_free(node):
                continue
            if node.op == "below":
                cuts = self.thresholds.get(node.attr[0], [])
                self.thresholds[node.attr[0]] = sorted({*cuts, node.args[0].attr})
                continue
            if node.op == "coordinate":
                self.moduli[node.attr[0]] = lcm(self.moduli.get(node.attr[0], 1), node.attr[1])
            asked: Hashable = (node.op, node.attr) if node.op in ("in_set", "table") else "value"
            for part, place in _reads(node, at):
                if not (self.counted and node.op == "count" and place != at):
                    stack.append((part, place, asked))
        return len(seen)

    def _own_variables(self, node: Node, at: Offset) -> list[Variable]:
        """The variables that a node reads itself, besides those of its parts."""
        if _is_free(node):
            return [("free", node.index, _at(node, at))]
        match node.op:
            case "coordinate":
                return [("coordinate", node.attr[0], _at(node, at))]
            case "inside":
                return [("inside", at, node.attr)]
            case "below":
                return [("draw", node.attr[0], at)]
            case "shift" if not node.attr[2]:
                return [("inside", at, node.attr[:2])]
            case "count" if self.counted:
                return [_others(node, at)]
            case "count" if not node.attr[1]:
                return [("inside", at, (dy, dx)) for dy, dx, _ in node.attr[0] if (dy, dx) != (0, 0)]
        return []

    def _domain(self, name: Variable, node: Node) -> list[int]:
        """The values of a variable that can make a difference."""
        low, high = node.type.lo, node.type.hi
        match name[0]:
            case "inside":
                return [0, 1]
            case "coordinate":
                return list(range(self.moduli[str(name[1])]))
            case "draw":
                return list(range(len(self.thresholds[str(name[1])]) + 1))
            case "counted":
                held = node.args[0].type
                ends = [(0, w * held.lo, w * held.hi) for dy, dx, w in node.attr[0] if (dy, dx) != (0, 0)]
                low, high = sum(map(min, ends)), sum(map(max, ends))
        values: Sequence[int] = range(low, high + 1)
        if name[0] == "input":
            values = self.cells.domains.get(str(name[1])) or values
        if len(values) > MAX_VALUES:
            raise Undecided
        return self._told_apart(name, values) if name[0] == "input" else list(values)

    def _told_apart(self, name: Variable, values: Sequence[int]) -> list[int]:
        """One of each kind of values that the questions about an input tell apart."""
        asked = set(self.uses[name])
        if name[1] == "element":
            for other, holders in self.cells.holders.items():
                if ("input", other, name[2]) in self.uses:
                    asked |= {("in_set", holders.ids), ("table", holders.usual)}
        if "value" in asked:
            return list(values)
        kinds: dict[tuple[object, ...], int] = {}
        questions: list[Any] = sorted(asked, key=repr)
        for value in values:
            kinds.setdefault(tuple(_answer(value, *question) for question in questions), value)
        return list(kinds.values())

    def _valid(self) -> Array:
        """The cases that can be: where an element is not free to hold a value, there is the usual one."""
        valid = np.ones(self.size, bool)
        for name, values in self.variables.items():
            element = self.variables.get(("input", "element", name[2])) if name[0] == "input" else None
            if element is not None and name[1] in self.cells.holders:
                holders = self.cells.holders[str(name[1])]
                usual = np.asarray(holders.usual, np.int32)[element]
                valid &= np.isin(element, sorted(holders.ids)) | (values == usual)
        return valid

    def value(self, node: Node, at: Offset) -> Array:
        """The node's value at a place, in each case."""
        key = (node.index, at)
        if key not in self._values:
            self._values[key] = self._value(node, at)
        return self._values[key]

    def _value(self, node: Node, at: Offset) -> Array:
        if node.op == "input":
            return self.variables[("input", node.attr, at)]
        own = [self.variables[name] for name in self._own_variables(node, at)]
        if _is_free(node):
            return own[0]
        match node.op:
            case "const":
                return np.full(self.size, int(node.attr), np.int32)
            case "coordinate":
                number = own[0] % node.attr[1]
                return number >> node.attr[2] & 1 if len(node.attr) > 2 else number
            case "inside":
                return own[0]
            case "below":
                place = self.thresholds[node.attr[0]].index(node.args[0].attr)
                return (own[0] <= place).astype(np.int32)
            case "count":
                return self._count(node, at)
        parts = [self.value(part, place) for part, place in _reads(node, at)]
        if node.op == "shift":  # nothing beyond the edge, unless it wraps
            return parts[0] * own[0] if own else parts[0]
        evaluate = _EVALUATE.get(node.op, OPS[node.op].value)
        value: Array = evaluate(node.attr, *parts)
        return value.astype(np.int32)

    def _count(self, node: Node, at: Offset) -> Array:
        weights, wraps = node.attr
        total = np.zeros(self.size, np.int32)
        if self.counted:
            total += self.variables[_others(node, at)]
            weights = tuple(weight for weight in weights if weight[:2] == (0, 0))
        for dy, dx, weight in weights:
            held = self.value(node.args[0], plus(at, (dy, dx)))
            if not wraps and (dy, dx) != (0, 0):
                held = held * self.variables[("inside", at, (dy, dx))]
            total += weight * held
        return total


def _others(node: Node, at: Offset) -> Variable:
    """A count's share from other cells, as a variable: the same one if only the cell itself makes a difference."""
    weights, wraps = node.attr
    return "counted", node.args[0].index, wraps, tuple(sorted(w for w in weights if w[:2] != (0, 0))), at


def _at(node: Node, at: Offset) -> Offset:
    """Return the offset of a variable: (0, 0) for numbers of the whole world."""
    everywhere = node.op == "param" or (node.op == "coordinate" and node.attr[0] == "step")
    return (0, 0) if everywhere else at


def _answer(value: int, op: str, attr: Any) -> object:
    """The answer of `in_set` or `table` for a value."""
    if op == "in_set":
        return value in attr
    return attr[value] if 0 <= value < len(attr) else None


_EVALUATE: dict[str, Callable[..., Any]] = {
    "in_set": lambda attr, a: np.isin(a, sorted(attr)),
    "table": lambda attr, a: np.asarray(attr, np.int32)[np.clip(a, 0, len(attr) - 1)],
    "min": lambda attr, a, b: np.minimum(a, b),
    "max": lambda attr, a, b: np.maximum(a, b),
    "quotient": lambda attr, a, b: np.where(b == 0, 0, a // np.where(b == 0, 1, b)),
    "select": lambda attr, c, a, b: np.where(c != 0, a, b),
    "swap": lambda attr, moves, there, target, back, rest: np.where(
        moves != 0, there, np.where(target != 0, back, rest)
    ),
    "arrive": lambda attr, target, back, rest: np.where(target != 0, back, rest),
}
"""The operations that read cells, and those that `OPS` evaluates for numbers only."""
