"""Whether two nodes of the IR have the same value in every cell of every world: a proof, or not decided.

Nodes of one graph that look alike are one object. Others are compared part by part, and where that does not do, by
trying everything that the cells around can hold: each input at each place is a variable, and so is whatever cannot be
enumerated, such as a comparison of floats. Variables that a small world makes equal, because its grid wraps, are
tried as if they were free, so that equality here is equality everywhere.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field
from math import lcm, prod
from typing import Any

import numpy as np

from powderdsl.ir.ops import COMMUTATIVE, OPS, REAL, Node, Offset

Array = np.ndarray[Any, Any]
Variable = tuple[Hashable, ...]

MAX_CASES = 1 << 21
"""Assignments that are tried for one question."""

MAX_WORK = 1_000_000_000
"""Assignments times nodes that are evaluated for one mutant. Proofs end by work, so they are the same on any machine."""

VISIT = 200
"""Work for a node that is looked at to find the variables, whether the question is decided or not."""

MAX_DEPTH = 600


class Undecided(Exception):
    """A question is too large."""


@dataclass(frozen=True)
class Holders:
    """The elements whose cells can hold anything in a slot, and by id what cells of the others hold there."""

    ids: frozenset[int]
    usual: tuple[int, ...]


@dataclass(frozen=True)
class Cells:
    """What is known of cells: values that an input can hold, and inputs that some elements alone are free to hold."""

    domains: Mapping[str, tuple[int, ...]]
    holders: Mapping[str, Holders]


@dataclass
class Comparison:
    """Compares nodes of one graph. It remembers what it has decided, and how much work is left."""

    cells: Cells
    left: int = MAX_WORK
    _known: dict[tuple[int, int], bool] = field(default_factory=dict)

    def equal(self, a: Node, b: Node) -> bool:
        """True is a proof; False says that it is not so, or could not be decided."""
        if a is b:
            return True
        key = (a.index, b.index) if a.index < b.index else (b.index, a.index)
        if key not in self._known:
            self._known[key] = False  # until it is known better
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
            return (self.never(condition) and self.equal(no, b)) or (
                self.always(condition) and self.equal(yes, b)
            )
        if a.op in ("swap", "arrive"):
            return self.never(a.args[1]) and self.equal(a.args[2], b)
        return False

    def never(self, flag: Node) -> bool:
        """Whether a flag is no everywhere."""
        return self._holds(flag, lambda value: not value.any())

    def always(self, flag: Node) -> bool:
        """Whether a flag is yes everywhere."""
        return self._holds(flag, lambda value: bool(value.all()))

    def _holds(self, flag: Node, question: Callable[[Array], bool]) -> bool:
        return self._decided((flag,), lambda case: question(case.value(flag, (0, 0))[case.valid]))

    def _tried(self, a: Node, b: Node) -> bool:
        if REAL in (a.type, b.type):
            return False
        return self._decided(
            (a, b),
            lambda case: bool((case.value(a, (0, 0)) == case.value(b, (0, 0)))[case.valid].all()),
        )

    def _decided(self, roots: tuple[Node, ...], question: Callable[[_Cases], bool]) -> bool:
        """What holds in every case. Where there are too many, what others around are counted is any number."""
        for counted in (False, True):
            try:
                return question(_Cases.of(roots, self.cells, self, counted))
            except (Undecided, RecursionError):
                continue
        return False

    def spend(self, work: int) -> None:
        self.left -= work
        if self.left < 0:
            raise Undecided


def _plus(a: Offset, b: Offset) -> Offset:
    return a[0] + b[0], a[1] + b[1]


def _minus(a: Offset, b: Offset) -> Offset:
    return a[0] - b[0], a[1] - b[1]


def _reads(node: Node, at: Offset) -> list[tuple[Node, Offset]]:
    """The parts of a node and where they are read."""
    match node.op:
        case "shift":
            return [(node.args[0], _plus(at, node.attr[:2]))]
        case "count":
            return [(node.args[0], _plus(at, (dy, dx))) for dy, dx, _ in node.attr[0]]
        case "swap":
            content, movers, rest = node.args
            there, back = _plus(at, node.attr), _minus(at, node.attr)
            return [(movers, at), (content, there), (movers, back), (content, back), (rest, at)]
        case "arrive":
            content, movers, rest = node.args
            back = _minus(at, node.attr)
            return [(movers, back), (content, back), (rest, at)]
    return [(arg, at) for arg in node.args]


def _is_free(node: Node) -> bool:
    """Whether a node that is not a float is a variable of its own: it depends on some, or on a parameter."""
    if node.op in ("param", "inside", "draw", "sqrt"):
        return node.op != "inside"
    if node.op == "below":
        return node.args[0].op != "const"
    return any(arg.type == REAL for arg in node.args)


@dataclass
class _Cases:
    """All assignments to the variables that some nodes depend on, and the nodes' values in each."""

    variables: dict[Variable, Array]
    """For each, its value in each case."""
    thresholds: Mapping[str, list[int]]
    moduli: Mapping[str, int]
    valid: Array
    work: Comparison
    size: int
    counted: bool
    _values: dict[tuple[int, Offset], Array] = field(default_factory=dict)

    @classmethod
    def of(cls, roots: tuple[Node, ...], cells: Cells, work: Comparison, counted: bool) -> _Cases:
        """Find the variables and lay out the cases. Raises Undecided if there are too many.

        Args:
            counted: take what a count finds in other cells for a variable of its own. More cases than there are can
                only refute.
        """
        seen: set[tuple[int, Offset]] = set()
        uses: dict[Variable, set[Hashable]] = {}
        inputs: dict[Variable, Node] = {}
        thresholds: dict[str, set[int]] = {}
        moduli: dict[str, int] = {}
        stack: list[tuple[Node, Offset, Hashable]] = [(root, (0, 0), "value") for root in roots]
        while stack:
            node, at, use = stack.pop()
            if node.op == "input" and node.type != REAL:
                name: Variable = ("input", node.attr, at)
                inputs[name] = node
                uses.setdefault(name, set()).add(use)
                continue
            if (node.index, at) in seen:
                continue
            seen.add((node.index, at))
            work.spend(VISIT)
            if len(seen) > 20_000:
                raise Undecided
            if node.type == REAL:
                raise Undecided  # only through a comparison, which is free
            if _is_free(node):
                inputs[("free", node.index, _at(node, at))] = node
                continue
            match node.op:
                case "coordinate":
                    moduli[node.attr[0]] = lcm(moduli.get(node.attr[0], 1), node.attr[1])
                    inputs[("coordinate", node.attr[0], _at(node, at))] = node
                case "inside":
                    inputs[("inside", at, node.attr)] = node
                case "below":
                    thresholds.setdefault(node.attr[0], set()).add(node.args[0].attr)
                    inputs[("draw", node.attr[0], at)] = node
                case "shift" if not node.attr[2]:
                    inputs[("inside", at, node.attr[:2])] = node
                case "count" if counted:
                    inputs[_others(node, at)] = node
                case "count" if not node.attr[1]:
                    for dy, dx, _ in node.attr[0]:
                        if (dy, dx) != (0, 0):
                            inputs[("inside", at, (dy, dx))] = node
            if node.op == "below":
                continue
            for part, place in _reads(node, at):
                if counted and node.op == "count" and place != at:
                    continue
                asked: Hashable = "value"
                if node.op in ("in_set", "table"):
                    asked = (node.op, node.attr)
                stack.append((part, place, asked))
        domains: dict[Variable, list[int]] = {}
        ordered = {stream: sorted(cuts) for stream, cuts in thresholds.items()}
        for name, node in inputs.items():
            domains[name] = _domain(name, node, uses.get(name, set()), uses, cells, ordered, moduli)
        size = prod(len(values) for values in domains.values())
        if size > MAX_CASES:
            raise Undecided
        work.spend(size * max(len(seen), 1))
        table: dict[Variable, Array] = {}
        stride = 1
        number = np.arange(size)
        for name, values in domains.items():
            table[name] = np.asarray(values, np.int32)[number // stride % len(values)]
            stride *= len(values)
        return cls(table, ordered, moduli, _valid(table, cells, size), work, size, counted)

    def value(self, node: Node, at: Offset) -> Array:
        """The node's value at a place, in each case."""
        key = (node.index, at)
        if key not in self._values:
            self._values[key] = self._value(node, at)
        return self._values[key]

    def _value(self, node: Node, at: Offset) -> Array:
        if node.op == "input":
            return self.variables[("input", node.attr, at)]
        if _is_free(node):
            return self.variables[("free", node.index, _at(node, at))]
        match node.op:
            case "const":
                return np.full(self.size, int(node.attr), np.int32)
            case "coordinate":
                which, modulus = node.attr[:2]
                number = self.variables[("coordinate", which, _at(node, at))] % modulus
                return number >> node.attr[2] & 1 if len(node.attr) > 2 else number
            case "inside":
                return self.variables[("inside", at, node.attr)]
            case "below":
                place = self.thresholds[node.attr[0]].index(node.args[0].attr)
                return (self.variables[("draw", node.attr[0], at)] <= place).astype(np.int32)
            case "count":
                return self._count(node, at)
        parts = [self.value(part, place) for part, place in _reads(node, at)]
        own, shared = _EVALUATE.get(node.op), OPS[node.op].evaluate
        if own is not None:
            found: Array = own(node, self, at, *parts)
        elif shared is not None:
            found = shared(node.attr, *parts)
        else:
            raise Undecided
        return found.astype(np.int32)

    def _count(self, node: Node, at: Offset) -> Array:
        weights, wraps = node.attr
        total = np.zeros(self.size, np.int32)
        if self.counted:
            total += self.variables[_others(node, at)]
            weights = tuple(weight for weight in weights if weight[:2] == (0, 0))
        for dy, dx, weight in weights:
            held = self.value(node.args[0], _plus(at, (dy, dx)))
            if not wraps and (dy, dx) != (0, 0):
                held = held * self.variables[("inside", at, (dy, dx))]
            total += weight * held
        return total

    def shifted(self, node: Node, at: Offset, value: Array) -> Array:
        """What is seen at a neighbor: nothing beyond the edge, unless it wraps."""
        return value if node.attr[2] else value * self.variables[("inside", at, node.attr[:2])]


def _others(node: Node, at: Offset) -> Variable:
    """What a count finds in other cells, as a variable: the same one where only the cell itself makes a difference."""
    weights, wraps = node.attr
    return "counted", node.args[0].index, wraps, tuple(sorted(w for w in weights if w[:2] != (0, 0))), at


def _at(node: Node, at: Offset) -> Offset:
    """Where a variable stands: numbers of the whole world stand nowhere."""
    everywhere = node.op == "param" or (node.op == "coordinate" and node.attr[0] == "step")
    return (0, 0) if everywhere else at


def _domain(
    name: Variable,
    node: Node,
    uses: set[Hashable],
    all_uses: Mapping[Variable, set[Hashable]],
    cells: Cells,
    thresholds: Mapping[str, list[int]],
    moduli: Mapping[str, int],
) -> list[int]:
    """The values of a variable that can make a difference."""
    match name[0]:
        case "inside":
            return [0, 1]
        case "coordinate":
            return list(range(moduli[str(name[1])]))
        case "draw":
            return list(range(len(thresholds[str(name[1])]) + 1))
        case "counted":
            low, high = node.args[0].type.lo, node.args[0].type.hi
            weights = [weight for dy, dx, weight in node.attr[0] if (dy, dx) != (0, 0)]
            ends = [(min(0, w * low, w * high), max(0, w * low, w * high)) for w in weights]
            least, most = sum(end[0] for end in ends), sum(end[1] for end in ends)
            if most - least > 300:
                raise Undecided
            return list(range(least, most + 1))
        case "free":
            if node.type.hi - node.type.lo > 300:
                raise Undecided
            return list(range(node.type.lo, node.type.hi + 1))
    slot = str(name[1])
    values = list(cells.domains.get(slot) or range(node.type.lo, node.type.hi + 1))
    if len(values) > 300:
        raise Undecided
    asked = set(uses)
    if slot == "element":
        for other, holders in cells.holders.items():
            if ("input", other, name[2]) in all_uses:
                asked |= {("in_set", holders.ids), ("table", holders.usual)}
    if "value" in asked:
        return values
    kinds: dict[tuple[object, ...], int] = {}
    questions: list[Any] = sorted(asked, key=repr)
    for value in values:
        kinds.setdefault(tuple(_answer(value, *question) for question in questions), value)
    return list(kinds.values())


def _answer(value: int, op: str, attr: Any) -> object:
    """What `in_set` or `table` say of a value."""
    if op == "in_set":
        return value in attr
    return attr[value] if 0 <= value < len(attr) else None


def _valid(table: Mapping[Variable, Array], cells: Cells, size: int) -> Array:
    """The cases that can be: where an element is not free to hold a value, there is the usual one."""
    valid = np.ones(size, bool)
    for name, values in table.items():
        element = table.get(("input", "element", name[2])) if name[0] == "input" else None
        if element is not None and name[1] in cells.holders:
            holders = cells.holders[str(name[1])]
            usual = np.asarray(holders.usual, np.int32)[element]
            valid &= np.isin(element, sorted(holders.ids)) | (values == usual)
    return valid


_EVALUATE: dict[str, Callable[..., Any]] = {
    "shift": lambda node, cases, at, a: cases.shifted(node, at, a),
    "not": lambda node, cases, at, a: 1 - a,
    "and": lambda node, cases, at, a, b: a & b,
    "or": lambda node, cases, at, a, b: a | b,
    "xor": lambda node, cases, at, a, b: a ^ b,
    "in_set": lambda node, cases, at, a: np.isin(a, sorted(node.attr)),
    "table": lambda node, cases, at, a: np.asarray(node.attr, np.int32)[np.clip(a, 0, len(node.attr) - 1)],
    "select": lambda node, cases, at, c, a, b: np.where(c != 0, a, b),
    "swap": lambda node, cases, at, moves, there, target, back, rest: np.where(
        moves != 0, there, np.where(target != 0, back, rest)
    ),
    "arrive": lambda node, cases, at, target, back, rest: np.where(target != 0, back, rest),
}
"""Exact evaluation of the operations that read cells, look up values, or work on flags; `OPS` has the arithmetic."""
