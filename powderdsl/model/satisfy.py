"""Can these conditions hold at once? A small constraint search over elements, properties, fields, counts and draws.

The answer errs to one side only: False is a proof, True may mean "could not tell". What it cannot enumerate
(float comparisons, parameters, large ranges) it treats as free, the same expression at the same place once.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property

from powderdsl.model.types import Expr, Offset, Property

Key = tuple[str, object, Offset]
Assignment = dict[Key, object]

MAX_DOMAIN = 256
MAX_STEPS = 20_000
MAX_LET = 150
"""Nodes of a let's value that are looked through; a larger one is taken for free."""

BUDGET = 500_000
"""Nodes evaluated in all questions about one ruleset: a second. The largest shipped ruleset needs a fifteenth of it."""

QUESTION = 60
"""What a question costs besides its evaluations."""


class _Exhausted(Exception):
    """The questions take too long: from here on the answer is that it could not be told."""


@dataclass
class Budget:
    """Work that is left for a ruleset's questions."""

    left: int = BUDGET

    def spend(self, nodes: int) -> None:
        self.left -= nodes
        if self.left < 0:
            raise _Exhausted

    @property
    def is_exhausted(self) -> bool:
        return self.left < 0


@dataclass(frozen=True)
class Facts:
    """What is known of cells: which ids exist, and what the elements' properties are."""

    ids: tuple[int, ...]
    properties: dict[str, Property]
    field_sets: dict[str, frozenset[int]]
    """Fields that exist only on some elements: elsewhere they read their default."""
    field_defaults: dict[str, object]
    names: dict[int, str] = field(default_factory=dict, compare=False, repr=False)
    """Names of the elements by id, for examples in messages."""
    budget: Budget = field(default_factory=Budget, compare=False, repr=False)

    def relaxed(self) -> Facts:
        """The same cells, but with any element's properties: what a rule could meet in other packs."""
        free = {
            name: replace(p, values=("?",) * len(p.values)) if p.kind.name == "chance" else replace(p, stored=frozenset(self.ids))
            for name, p in self.properties.items()
        }  # fmt: skip
        return replace(self, properties=free)


class _Unknown(Exception):
    """The value hangs on something free."""


class Search:
    """One question. Conditions are given with the place they are asked at."""

    def __init__(self, facts: Facts, lets: dict[str, Expr] | None = None):
        self.facts = facts
        self.lets = lets or {}
        self.conditions: list[tuple[Expr, Offset]] = []
        self._chosen: Assignment = {}
        self._domains: dict[Key, list[object]] = {}
        self._steps = 0
        self._opened: dict[str, tuple[Expr, int]] = {}

    def require(self, condition: Expr, at: Offset = (0, 0)) -> None:
        """Add a condition; conjunctions are split, lets of this moment are looked through."""
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
        """The expression with this moment's lets looked through, and how many nodes it has then."""
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
        for condition, _ in self.conditions:
            for node in condition.walk():
                if node.op == "lt" and any(arg.kind.name == "draw" for arg in node.args):
                    draws = [n.value for arg in node.args for n in arg.walk() if n.op == "draw"]
                    numbers = [
                        float(n.value)
                        for arg in node.args
                        for n in arg.walk()
                        if n.op == "const" and isinstance(n.value, (int, Fraction))
                    ]
                    for stream in draws:
                        found.setdefault(stream, set()).update(number % 1 for number in numbers)
        return {stream: sorted(values) for stream, values in found.items()}

    def possible(self) -> bool:
        """False if no assignment satisfies all conditions."""
        variables = [self._variables(condition, at) for condition, at in self.conditions]
        domains: dict[Key, list[object]] = {}
        for keys in variables:
            for key in keys or ():
                domains.setdefault(key, self._domain(key))
        checks = [
            (c, at, keys)
            for (c, at), keys in zip(self.conditions, variables, strict=True)
            if keys is not None
        ]
        for condition, at, keys in checks:
            if not keys and not self._holds(condition, at, {}):
                return False
            if len(keys) == 1:
                (key,) = keys
                domains[key] = [v for v in domains[key] if self._holds(condition, at, {key: v})]
                if not domains[key]:
                    return False
        rest = [(c, at, keys) for c, at, keys in checks if len(keys) > 1]
        order = sorted({key for _, _, keys in rest for key in keys}, key=lambda key: len(domains[key]))
        self._steps = 0
        self._domains = domains
        return self._assign(order, 0, domains, rest, self._chosen)

    def example(self) -> dict[Offset, int]:
        """After `possible`: an element for each place that the conditions ask about; nothing if the search gave up."""
        if self._steps > MAX_STEPS:
            return {}
        keys = [key for key in self._domains if key[0] == "element"]
        return {key[2]: int(str(self._chosen.get(key, self._domains[key][0]))) for key in keys}

    def _assign(
        self, order: list[Key], index: int, domains: dict[Key, list[object]], rest: list, chosen: Assignment
    ) -> bool:
        if index == len(order):
            return True
        key = order[index]
        ready = [
            (c, at) for c, at, keys in rest if key in keys and all(k in chosen or k == key for k in keys)
        ]
        for value in domains[key]:
            self._steps += 1
            if self._steps > MAX_STEPS:
                return True
            chosen[key] = value
            if all(self._holds(c, at, chosen) for c, at in ready) and self._assign(
                order, index + 1, domains, rest, chosen
            ):
                return True
        chosen.pop(key, None)
        return False

    def _holds(self, condition: Expr, at: Offset, chosen: Assignment) -> bool:
        try:
            return bool(self._value(condition, at, chosen))
        except _Unknown:
            return True

    def _domain(self, key: Key) -> list[object]:
        what, name, _ = key
        if what == "element":
            return list(self.facts.ids)
        if what == "property":
            kind = self.facts.properties[str(name)].kind
            return [0, 1] if kind.name == "flag" else list(range(int(kind.lo), int(kind.hi) + 1))
        if what == "draw":
            cuts = [0.0, *self.thresholds.get(name, []), 1.0]
            between = ((a + b) / 2 for a, b in itertools.pairwise(cuts) if a < b)
            # A draw of 16 or 32 bits may be a threshold itself: neither above nor below it.
            return [*between, *(c for c in cuts if (c * 2**17) % 2 == 1 or (c * 2**33) % 2 == 1)]
        assert isinstance(name, Expr)
        if name.kind.name in ("element", "direction"):
            return list(self.facts.ids) if name.kind.name == "element" else list(range(8))
        if name.kind.name == "flag":
            return [0, 1]
        return list(range(int(name.kind.lo), int(name.kind.hi) + 1))

    def _variables(self, expr: Expr, at: Offset) -> frozenset[Key] | None:
        """What the value hangs on; None if it hangs on something that cannot be enumerated."""
        found: set[Key] = set()

        def visit(node: Expr, at: Offset) -> None:
            self.facts.budget.spend(1)
            match node.op:
                case "element":
                    found.add(("element", None, at))
                case "property":
                    prop = self.facts.properties[str(node.value)]
                    found.add(("element", None, at))
                    if prop.stored:
                        found.add(("property", prop.name, at))
                    if any(isinstance(value, str) for value in prop.values):
                        raise _Unknown
                case "field" if node.value in self.facts.field_sets:
                    found.add(("element", None, at))
                    found.add(_opaque(node, at))
                case "draw":
                    found.add(("draw", node.value, at))
                case "look":
                    visit(node.args[0], _plus(at, node.value))
                case "const":
                    pass
                case _ if _is_opaque(node):
                    found.add(_opaque(node, at))
                case _:
                    for arg in node.args:
                        visit(arg, at)

        try:
            visit(expr, at)
        except _Unknown:
            return None
        return frozenset(found)

    def _value(self, node: Expr, at: Offset, chosen: Assignment):  # type: ignore[no-untyped-def]
        budget = self.facts.budget  # `spend` written out: this is where the time goes
        budget.left -= 1
        if budget.left < 0:
            raise _Exhausted
        match node.op:
            case "const":
                return node.value
            case "element":
                return chosen[("element", None, at)]
            case "property":
                prop = self.facts.properties[str(node.value)]
                element = chosen[("element", None, at)]
                assert isinstance(element, int)
                return chosen[("property", prop.name, at)] if element in prop.stored else prop.values[element]
            case "field" if node.value in self.facts.field_sets:
                if chosen[("element", None, at)] not in self.facts.field_sets[str(node.value)]:
                    return self.facts.field_defaults[str(node.value)]
                return chosen[_opaque(node, at)]
            case "draw":
                return chosen[("draw", node.value, at)]
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


_EVALUATE: dict[str, Callable] = {
    "member": lambda node, a: a in node.value,
    "not": lambda node, a: not a,
    "eq": lambda node, a, b: a == b,
    "lt": lambda node, a, b: a < b,
    "le": lambda node, a, b: a <= b,
    "add": lambda node, a, b: a + b,
    "sub": lambda node, a, b: a - b,
    "mul": lambda node, a, b: a * b,
    "neg": lambda node, a: -a,
    "abs": lambda node, a: abs(a),
    "min": lambda node, a, b: min(a, b),
    "max": lambda node, a, b: max(a, b),
    "mod": lambda node, a: a % node.value,
}
"""Exact evaluation of discrete operations."""


def _plus(at: Offset, offset: object) -> Offset:
    assert isinstance(offset, tuple)
    return (at[0] + offset[0], at[1] + offset[1])


def _opaque(node: Expr, at: Offset) -> Key:
    return ("value", node, at)


def _is_opaque(node: Expr) -> bool:
    """Whether a node is a variable of its own: a count, a field, or something that floats decide."""
    if node.op in ("field", "let", "count", "sum", "inside", "coordinate", "octant", "param"):
        if (
            node.kind.name in ("real", "vec2", "chance", "draw", "number")
            or node.kind.hi - node.kind.lo >= MAX_DOMAIN
        ):
            raise _Unknown
        return True
    if node.op in ("eq", "lt", "le") and any(
        arg.kind.name in ("real", "vec2", "chance") and arg.op != "const" for arg in node.args
    ):
        return True
    if node.op in ("to_real", "length", "vector", "row_part", "column_part", "div"):
        raise _Unknown
    return False


def satisfiable(
    facts: Facts, conditions: Sequence[tuple[Expr, Offset]], lets: dict[str, Expr] | None = None
) -> bool:
    """False only if the conditions, each at its place, can never hold together."""
    try:
        facts.budget.spend(QUESTION)
        search = Search(facts, lets)
        for condition, at in conditions:
            search.require(condition, at)
        return search.possible()
    except _Exhausted:
        return True


def example(
    facts: Facts, conditions: Sequence[tuple[Expr, Offset]], lets: dict[str, Expr]
) -> dict[Offset, int]:
    """Elements by place with which the conditions hold together, or nothing where none can be told."""
    try:
        search = Search(facts, lets)
        for condition, at in conditions:
            search.require(condition, at)
        return search.example() if search.possible() else {}
    except _Exhausted:
        return {}
