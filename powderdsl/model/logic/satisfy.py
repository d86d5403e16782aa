"""Can these conditions hold at once? A small constraint search over elements, properties, fields, counts and draws.

The answer errs to one side only: False is a proof, True may mean "could not decide". The search cannot enumerate float
comparisons, parameters and large ranges: it treats them as free, the same expression at the same place once.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

from powderdsl.model.operations import OPS, Bounds
from powderdsl.model.types import Assign, Expr, Moment, Offset, Pass, Property, Rule

Literal = tuple[str, Offset]
"""The name of a value, and the place where it is asked for."""


def contradict(conditions: Sequence[tuple[Expr, Offset]]) -> bool:
    """Whether one of the conditions needs a value to hold at a place where another one needs that it does not."""
    found: dict[Literal, bool] = {}
    return any(
        found.setdefault(literal, holds) != holds
        for condition, at in conditions
        for literal, holds in _literals([(condition, at, True)])
    )


def _literals(waiting: Iterable[tuple[Expr, Offset, bool]]) -> Iterator[tuple[Literal, bool]]:
    """What must hold, or must not, for conditions to be as they are said to be."""
    stack = list(waiting)
    while stack:
        expr, at, holds = stack.pop()
        match expr.op:
            case "let":
                yield (str(expr.value), at), holds
            case "not":
                stack.append((expr.args[0], at, not holds))
            case "look":
                stack.append((expr.args[0], (at[0] + expr.value[0], at[1] + expr.value[1]), holds))
            case "and" if holds:
                stack += [(arg, at, True) for arg in expr.args]
            case "or" if not holds:
                stack += [(arg, at, False) for arg in expr.args]


HERE: Offset = (0, 0)

Key = tuple[str, object, Offset]
Assignment = dict[Key, Any]
Lets = dict[str, Expr]
"""Values of a substep by name."""
Conditions = Sequence[tuple[Expr, Offset]]
"""Each with the place where it is asked."""

MAX_DOMAIN = 256
MAX_LET = 150
"""Nodes of a let's value that are looked through; a larger one is taken for free."""

BUDGET = 500_000
"""Nodes evaluated in a group of questions: half a second. The largest shipped ruleset needs a twentieth of it."""

MAX_QUESTION = 100_000
"""Nodes evaluated for one question. A harder one stays undecided, and the others keep their share."""

QUESTION = 60
"""The cost of a question besides its evaluations."""


class Exhausted(Exception):
    """The question takes too much work to answer."""


@dataclass
class Budget:
    """Work that is left for some questions, counted in nodes: the same on every machine, in every order."""

    left: int = BUDGET
    most: int = MAX_QUESTION
    """For one question."""

    def spend(self, nodes: int) -> None:
        self.left -= nodes
        if self.left < 0:
            raise Exhausted

    @property
    def is_exhausted(self) -> bool:
        return self.left < 0

    @contextmanager
    def question(self, most: int | None = None) -> Iterator[None]:
        """Spend at most this much within. The rest is left for the next question."""
        reserve = max(self.left - (most or self.most), 0)
        self.left -= reserve
        try:
            yield
        finally:
            if reserve:
                self.left = max(self.left, 0) + reserve


@dataclass(frozen=True)
class Facts:
    """What is known about cells: which ids exist, and the properties of the elements."""

    ids: tuple[int, ...]
    properties: dict[str, Property]
    field_sets: dict[str, frozenset[int]]
    """Fields that exist only on some elements: elsewhere they read their default."""
    field_defaults: dict[str, object]
    side_multiple: int = 1
    """The sides of all worlds are multiples of this number."""
    names: dict[int, str] = field(default_factory=dict, compare=False, repr=False)
    """Names of the elements by id, for examples in messages."""
    budget: Budget = field(default_factory=Budget, compare=False, repr=False)

    def relaxed(self) -> Facts:
        """The same cells, but with any element's properties: what a rule could meet in other packs."""
        ids = frozenset(self.ids)
        free = {
            name: replace(p, values=("?",) * len(p.values))
            if p.kind.name == "chance"
            else replace(p, stored=ids)
            for name, p in self.properties.items()
        }
        return replace(self, properties=free)


class _Unknown(Exception):
    """The value depends on something free."""


class _Joint(NamedTuple):
    """A condition on several variables. `compares`: bounds may decide it before all of them are chosen."""

    condition: Expr
    at: Offset
    keys: dict[Key, None]
    compares: bool


class Search:
    """One question. Conditions are given with the place they are asked at."""

    def __init__(self, facts: Facts, lets: Lets | None = None):
        self.facts = facts
        self.lets = lets or {}
        self.conditions: list[tuple[Expr, Offset]] = []
        self._chosen: Assignment = {}
        self._domains: dict[Key, list[Any]] = {}
        self._opened: dict[str, tuple[Expr, int]] = {}

    def require(self, condition: Expr, at: Offset = (0, 0)) -> None:
        """Add a condition; conjunctions are split, lets of this substep are looked through."""
        self._split(self._resolve(condition)[0], at)

    def _split(self, condition: Expr, at: Offset) -> None:
        if condition.op == "and":
            for arg in condition.args:
                self._split(arg, at)
        elif condition.op == "look":
            self._split(condition.args[0], _plus(at, condition.value))
        else:
            self.conditions.append((condition, at))

    def _resolve(self, expr: Expr) -> tuple[Expr, int]:
        """The expression with this substep's lets looked through, and how many nodes it has then."""
        if expr.op == "let" and expr.value in self.lets:
            name = str(expr.value)
            if name not in self._opened:
                value, size = self._resolve(self.lets[name])
                self._opened[name] = (value, size) if size <= MAX_LET else (expr, 1)
            return self._opened[name]
        self.facts.budget.spend(1)
        if not expr.args:
            return expr, 1
        parts = [self._resolve(arg) for arg in expr.args]
        args = tuple(part for part, _ in parts)
        same = all(new is old for new, old in zip(args, expr.args, strict=True))
        return expr if same else replace(expr, args=args), 1 + sum(size for _, size in parts)

    @cached_property
    def thresholds(self) -> dict[object, list[float]]:
        """Constants that each stream is compared with: between two of them all draws are alike."""
        found: dict[object, set[float]] = {}
        for node in (node for condition, _ in self.conditions for node in condition.walk()):
            if node.op == "lt" and any(arg.kind.name == "draw" for arg in node.args):
                parts = [part for arg in node.args for part in arg.walk()]
                numbers = [
                    float(part.value)
                    for part in parts
                    if part.op == "const" and isinstance(part.value, (int, Fraction))
                ]
                for draw in (part for part in parts if part.op == "draw"):
                    found.setdefault(draw.value, set()).update(number % 1 for number in numbers)
        return {stream: sorted(values) for stream, values in found.items()}

    def possible(self) -> bool:
        """False if no assignment satisfies all conditions."""
        joint = self._narrow()
        if joint is None:
            return False
        # Small domains first; what is equally small in the order in which the conditions name it.
        order = sorted(
            {key: None for one in joint for key in one.keys}, key=lambda key: len(self._domains[key])
        )
        return self._assign(order, 0, joint, self._chosen)

    def alone(self) -> dict[Key, frozenset[object]] | None:
        """The values that conditions on one variable leave of it, draws left out; None if one leaves nothing."""
        if self._narrow() is None:
            return None
        cut = {key: values for key, values in self._domains.items() if key[0] != "draw"}
        return {key: frozenset(values) for key, values in cut.items() if len(values) < len(self._domain(key))}

    def _narrow(self) -> list[_Joint] | None:
        """Apply the conditions on one variable; the others, or None if no assignment is left."""
        variables = [self._variables(condition, at) for condition, at in self.conditions]
        named = dict.fromkeys(key for keys in variables for key in keys or ())
        domains = self._domains = {key: self._domain(key) for key in named}
        joint = []
        for (condition, at), keys in zip(self.conditions, variables, strict=True):
            if keys is None:
                continue
            if not keys and not self._holds(condition, at, {}):
                return None
            if len(keys) == 1:
                (key,) = keys
                domains[key] = [v for v in domains[key] if self._holds(condition, at, {key: v})]
                if not domains[key]:
                    return None
            if len(keys) > 1:
                compares = any(node.op in ("eq", "lt", "le") for node in condition.walk())
                joint.append(_Joint(condition, at, keys, compares))
        return joint

    def example(self) -> dict[Offset, int]:
        """After `possible`: an element for each place that the conditions ask about."""
        keys = [key for key in self._domains if key[0] == "element"]
        return {key[2]: self._chosen.get(key, self._domains[key][0]) for key in keys}

    def _assign(self, order: list[Key], index: int, joint: list[_Joint], chosen: Assignment) -> bool:
        if index == len(order):
            return True
        key = order[index]
        ready, waiting = [], []
        for one in joint:
            if key in one.keys:
                if all(k in chosen or k == key for k in one.keys):
                    ready.append(one)
                elif one.compares:
                    waiting.append(one)
        for value in self._domains[key]:
            chosen[key] = value
            if (
                all(self._holds(one.condition, one.at, chosen) for one in ready)
                and all(self._bounds(one.condition, one.at, chosen)[1] for one in waiting)
                and self._assign(order, index + 1, joint, chosen)
            ):
                return True
        chosen.pop(key, None)
        return False

    def _holds(self, condition: Expr, at: Offset, chosen: Assignment) -> bool:
        try:
            return bool(self._value(condition, at, chosen))
        except _Unknown:
            return True

    def _domain(self, key: Key) -> list[Any]:
        what, name, _ = key
        if what == "element":
            return list(self.facts.ids)
        if what == "side":
            return list(range(self.facts.side_multiple))
        if what == "draw":
            cuts = [0.0, *self.thresholds.get(name, []), 1.0]
            between = ((a + b) / 2 for a, b in itertools.pairwise(cuts) if a < b)
            # A draw of 16 or 32 bits may be a threshold itself: neither above nor below it.
            return [*between, *(c for c in cuts if (c * 2**17) % 2 == 1 or (c * 2**33) % 2 == 1)]
        kind = name.kind if isinstance(name, Expr) else self.facts.properties[str(name)].kind
        match kind.name:
            case "element":
                return list(self.facts.ids)
            case "direction":
                return list(range(8))
            case "flag":
                return [0, 1]
        return list(range(int(kind.lo), int(kind.hi) + 1))

    def _variables(self, expr: Expr, at: Offset) -> dict[Key, None] | None:
        """The variables of an expression, in the order they are named; None if one of them cannot be enumerated."""
        found: dict[Key, None] = {}

        def visit(node: Expr, at: Offset) -> None:
            self.facts.budget.spend(1)
            match node.op:
                case "element":
                    found[("element", None, at)] = None
                case "property":
                    prop = self.facts.properties[str(node.value)]
                    found[("element", None, at)] = None
                    if prop.stored:
                        found[("property", prop.name, at)] = None
                    if any(isinstance(value, str) for value in prop.values):
                        raise _Unknown
                case "field" if node.value in self.facts.field_sets:
                    found[("element", None, at)] = None
                    found[_opaque(node, at)] = None
                case "draw":
                    found[("draw", node.value, at)] = None
                case "coordinate":
                    found[_coordinate(node, at, self.facts.side_multiple)[0]] = None
                case "look":
                    visit(node.args[0], _plus(at, node.value))
                case "const":
                    pass
                case _ if _is_opaque(node):
                    found[_opaque(node, at)] = None
                case _:
                    for arg in node.args:
                        visit(arg, at)

        try:
            visit(expr, at)
        except _Unknown:
            return None
        return found

    def _value(self, node: Expr, at: Offset, chosen: Assignment):  # type: ignore[no-untyped-def]
        budget = self.facts.budget  # `spend` written out: this is where the time goes
        budget.left -= 1
        if budget.left < 0:
            raise Exhausted
        match node.op:
            case "const":
                return node.value
            case "element":
                return chosen[("element", None, at)]
            case "property":
                prop = self.facts.properties[str(node.value)]
                element = chosen[("element", None, at)]
                return chosen[("property", prop.name, at)] if element in prop.stored else prop.values[element]
            case "field" if node.value in self.facts.field_sets:
                if chosen[("element", None, at)] not in self.facts.field_sets[str(node.value)]:
                    return self.facts.field_defaults[str(node.value)]
                return chosen[_opaque(node, at)]
            case "draw":
                return chosen[("draw", node.value, at)]
            case "coordinate":
                key, shift = _coordinate(node, at, self.facts.side_multiple)
                return (chosen[key] + shift) % node.value[1]
            case "look":
                return self._value(node.args[0], _plus(at, node.value), chosen)
            case _ if _is_opaque(node):
                return chosen[_opaque(node, at)]
            case "and":
                return all(self._value(arg, at, chosen) for arg in node.args)
            case "or":
                return any(self._value(arg, at, chosen) for arg in node.args)
            case "choose":
                condition, yes, no = node.args
                return self._value(yes if self._value(condition, at, chosen) else no, at, chosen)
        args = [self._value(arg, at, chosen) for arg in node.args]
        return _EVALUATE[node.op](node, *args)

    def _bounds(self, node: Expr, at: Offset, chosen: Assignment) -> Bounds:
        """The bounds of the value while some variables are open; those of a flag are 0 and 1."""
        self.facts.budget.spend(1)
        match node.op:
            case "const":
                return (node.value, node.value) if isinstance(node.value, (int, float, Fraction)) else _ANY
            case "element":
                return self._span(("element", None, at), chosen)
            case "member":
                known = self._bounds(node.args[0], at, chosen)
                return (0, 1) if known[0] != known[1] else (known[0] in node.value,) * 2
            case "property":
                prop = self.facts.properties[str(node.value)]
                key: Key = ("element", None, at)
                elements = [chosen[key]] if key in chosen else self._domains[key]
                values = [prop.values[one] for one in elements if one not in prop.stored]
                numbers = [value for value in values if isinstance(value, (int, float, Fraction))]
                if len(values) < len(elements):
                    numbers += self._span(("property", prop.name, at), chosen)
                self.facts.budget.spend(len(elements))
                return min(numbers), max(numbers)
            case "field" if node.value in self.facts.field_sets:
                default = self.facts.field_defaults[str(node.value)]
                if not isinstance(default, (int, float)):
                    return _ANY
                key = ("element", None, at)
                if key in chosen and chosen[key] not in self.facts.field_sets[str(node.value)]:
                    return default, default
                low, high = self._span(_opaque(node, at), chosen)
                return (low, high) if key in chosen else (min(low, default), max(high, default))
            case "draw":
                return self._span(("draw", node.value, at), chosen)
            case "coordinate":
                key, shift = _coordinate(node, at, self.facts.side_multiple)
                if key not in chosen:
                    return 0, node.value[1] - 1
                return ((chosen[key] + shift) % node.value[1],) * 2
            case "look":
                return self._bounds(node.args[0], _plus(at, node.value), chosen)
            case _ if _is_opaque(node):
                return self._span(_opaque(node, at), chosen)
        args = [self._bounds(arg, at, chosen) for arg in node.args]
        bounds = OPS[node.op].bounds
        if bounds is not None:
            return bounds(node, *args)
        if all(low == high for low, high in args):
            return (_EVALUATE[node.op](node, *(low for low, _ in args)),) * 2
        return (node.kind.lo, node.kind.hi) if node.kind.name == "int" else _ANY

    def _span(self, key: Key, chosen: Assignment) -> Bounds:
        """The least and the greatest value of a variable: domains ascend."""
        if key in chosen:
            return chosen[key], chosen[key]
        domain = self._domains[key]
        return (domain[0], domain[-1]) if key[0] != "draw" else (0.0, 1.0)


_ANY: Bounds = (-math.inf, math.inf)
_EVALUATE = {name: row.evaluate for name, row in OPS.items() if row.evaluate}


def _plus(at: Offset, offset: Offset) -> Offset:
    return (at[0] + offset[0], at[1] + offset[1])


def _opaque(node: Expr, at: Offset) -> Key:
    return ("value", node, at)


def _coordinate(node: Expr, at: Offset, sides: int) -> tuple[Key, int]:
    """The variable that a coordinate depends on, and what is added to it.

    The step is the same everywhere. A row or column is known from that of another place if no seam comes between:
    where the sides of the world are multiples of its modulus. Elsewhere it is free at every place.
    """
    axis, modulus = node.value
    if axis == "step":
        return _opaque(node, (0, 0)), 0
    if sides % modulus:
        return _opaque(node, at), 0
    return ("side", axis, (0, 0)), at[axis == "column"]


_FLOATS = ("real", "vec2", "chance")


def _is_opaque(node: Expr) -> bool:
    """Whether a node is a variable of its own: a count, a field, or something that floats decide."""
    kind, op = node.kind, node.op
    if op in ("field", "let", "count", "sum", "inside", "octant", "param"):
        if kind.name in (*_FLOATS, "draw", "number") or kind.hi - kind.lo >= MAX_DOMAIN:
            raise _Unknown
        return True
    if op in ("eq", "lt", "le") and any(a.kind.name in _FLOATS and a.op != "const" for a in node.args):
        return True
    if node.op not in _EVALUATE and node.op not in ("and", "or", "choose"):
        raise _Unknown
    return False


Answer = TypeVar("Answer")


def _ask(
    facts: Facts, conditions: Conditions, lets: Lets | None, answer: Callable[[Search], Answer]
) -> Answer | None:
    """The answer of a search for these conditions; None if that takes too much work."""
    try:
        with facts.budget.question():
            facts.budget.spend(QUESTION)
            search = Search(facts, lets)
            for condition, at in conditions:
                search.require(condition, at)
            return answer(search)
    except Exhausted:
        return None


def decide(facts: Facts, conditions: Conditions, lets: Lets | None = None) -> bool | None:
    """Whether the conditions may hold together; None if that takes too much work. False is a proof."""
    if contradict(conditions):
        return False
    return _ask(facts, conditions, lets, Search.possible)


def satisfiable(facts: Facts, conditions: Conditions, lets: Lets | None = None) -> bool:
    """False only if the conditions, each at its place, can never hold together."""
    return decide(facts, conditions, lets) is not False


def can_hold(facts: Facts, conditions: Conditions, lets: Lets) -> bool:
    """Like `decide`, but raises Exhausted if that takes too much work."""
    answer = decide(facts, conditions, lets)
    if answer is None:
        raise Exhausted
    return answer


def alone(facts: Facts, condition: Expr, lets: Lets) -> dict[Key, frozenset[object]]:
    """What a condition leaves of variables that parts of it decide alone: an element, a field, a count at a place."""
    return _ask(facts, [(condition, HERE)], lets, Search.alone) or {}


def example(facts: Facts, conditions: Conditions, lets: Lets) -> dict[Offset, int]:
    """Elements by place with which the conditions hold together, or nothing if none are found."""
    return _ask(facts, conditions, lets, lambda one: one.example() if one.possible() else {}) or {}


def substeps(passes: Iterable[Pass]) -> Iterator[tuple[Pass, Moment, Lets]]:
    """The substeps of some passes with the values that `let` fixes in each."""
    for pass_ in passes:
        for moment in pass_.moments:
            yield pass_, moment, {let.name: let.value for let in moment.lets}


def writes_of(rule: Rule) -> tuple[Assign, ...]:
    """The assignments that a rule is or has."""
    return (rule,) if isinstance(rule, Assign) else rule.effects
