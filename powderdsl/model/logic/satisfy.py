"""Can these conditions hold at once? A small constraint search over elements, properties, fields, counts and draws.

The answer errs on one side only: False is a proof, True may mean "could not decide". The search cannot enumerate float
comparisons, parameters and large ranges: it treats them as free, the same expression at the same place once.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property, lru_cache
from typing import Any, NamedTuple, TypeVar, cast

from powderdsl.model.operations import OPERATIONS, Bounds
from powderdsl.model.types import FLAG, HERE, Expr, Field, Offset, Property, plus

Variable = tuple[str, object, Offset]
"""A variable: its sort, the name or expression, and the place."""
Lets = dict[str, Expr]
"""Values of a substep by name."""
Conditions = Sequence[tuple[Expr, Offset]]
"""Each with the place where it must hold."""

MAX_DOMAIN = 256
MAX_LET = 150
"""Maximum number of nodes of a let's value; a larger one is treated as free."""

BUDGET = 500_000
"""Nodes evaluated in a group of questions, about half a second. The largest shipped ruleset needs a twentieth."""

MAX_QUESTION = 100_000
"""Nodes evaluated for one question. A harder one stays undecided, so that the others keep their share."""

QUESTION = 60
"""The cost of a question besides its evaluations."""


class _Exhausted(Exception):
    """The question takes too much work to answer."""


@dataclass
class Budget:
    """The remaining work for some questions, counted in nodes, so that it is the same on every machine."""

    left: int = BUDGET
    most: int = MAX_QUESTION
    """For one question."""

    def spend(self, nodes: int) -> None:
        """Subtract work from the rest. Raises _Exhausted if too little is left."""
        self.left -= nodes
        if self.left < 0:
            raise _Exhausted


@dataclass(frozen=True, eq=False)
class Facts:
    """The facts about cells: the existing ids, and the properties of the elements."""

    ids: tuple[int, ...]
    properties: dict[str, Property]
    fields: dict[str, Field]
    """Those that exist only on some elements read their default elsewhere."""
    side_multiple: int = 1
    """The sides of all worlds are multiples of this number."""
    names: dict[int, str] = field(default_factory=dict)
    """Names of the elements by id, for examples in messages."""
    budget: Budget = field(default_factory=Budget)

    @cached_property
    def known(self) -> Facts:
        """One object for all facts of the same content: the key of cached answers."""
        return _known(
            self.ids, tuple(self.properties.items()), tuple(self.fields.items()), self.side_multiple
        )

    def relaxed(self) -> Facts:
        """The facts with unknown properties, as elements of other packs may have."""
        free = dict(self.properties)
        for name, p in free.items():
            unknown = replace(p, values=("?",) * len(p.values))
            free[name] = unknown if p.kind.name == "chance" else replace(p, stored=frozenset(self.ids))
        return replace(self, properties=free, budget=Budget())


def decide(facts: Facts, conditions: Conditions, lets: Lets | None = None) -> bool | None:
    """True if the conditions may hold together; None if deciding takes too much work. False is a proof."""
    if lets and _answer(facts, conditions, None, _Search.possible) is False:
        return False  # for any values of lets
    return _answer(facts, conditions, lets, _Search.possible)


def satisfiable(facts: Facts, conditions: Conditions, lets: Lets | None = None) -> bool:
    """False only if the conditions, each at its place, can never hold together."""
    return decide(facts, conditions, lets) is not False


def some(answers: Iterable[bool | None]) -> bool | None:
    """True at the first answer that is True; else None if one is None, else False."""
    undecided = False
    for answer in answers:
        if answer:
            return True
        undecided |= answer is None
    return None if undecided else False


Key = TypeVar("Key", bound=Hashable)


class Answers(dict[Key, bool | None]):
    """The answers for rules that have several copies, joined by `some`."""

    def add(self, rule: Key, answer: bool | None) -> None:
        self[rule] = some((self.get(rule, False), answer))

    def where(self, answer: bool | None) -> list[Key]:
        return [rule for rule, known in self.items() if known is answer]


def single_domains(facts: Facts, condition: Expr, lets: Lets) -> dict[Variable, frozenset[object]]:
    """The values of single variables that a condition allows: an element, a field or a count at a place."""
    return _answer(facts, [(condition, HERE)], lets, _Search.single_domains) or {}


def example(facts: Facts, conditions: Conditions, lets: Lets) -> dict[Offset, int]:
    """Elements by place for which the conditions hold together; empty if none are found."""
    return _ask(facts, conditions, lets, _Search.example) or {}


Answer = TypeVar("Answer")


def _ask(
    facts: Facts, conditions: Conditions, lets: Lets | None, answer: Callable[[_Search], Answer]
) -> Answer | None:
    """The answer of a search for these conditions; None if that takes too much work."""
    # A question may spend `most` nodes: the rest is set aside meanwhile, so that one check at each node is enough.
    budget = facts.budget
    reserve = max(budget.left - budget.most, 0)
    budget.left -= reserve
    try:
        budget.spend(QUESTION)
        return answer(_Search(facts, conditions, lets or {}))
    except _Exhausted:
        return None
    finally:
        if reserve:
            budget.left = max(budget.left, 0) + reserve


@lru_cache(maxsize=64)
def _known(
    ids: tuple[int, ...], properties: tuple[tuple[str, Property], ...], fields: tuple[tuple[str, Field], ...], side: int
) -> Facts:  # fmt: skip
    return Facts(ids, dict(properties), dict(fields), side)


@lru_cache(maxsize=2048)
def _answered(
    known: Facts,
    conditions: tuple[tuple[Expr, Offset], ...],
    lets: tuple[tuple[str, Expr], ...],
    most: int,
    answer: Callable[[_Search], Any],
) -> tuple[Any, int]:
    """The answer to a question, and its work: editors ask the same after each key."""
    budget = Budget(most, most)
    result = _ask(replace(known, budget=budget), conditions, dict(lets), answer)
    return result, most - max(budget.left, 0)


def _answer(
    facts: Facts, conditions: Conditions, lets: Lets | None, answer: Callable[[_Search], Answer]
) -> Answer | None:
    """As `_ask`, for answers that name no places in files."""
    budget = facts.budget
    if budget.left < budget.most:
        return _ask(facts, conditions, lets, answer)
    result, work = _answered(facts.known, tuple(conditions), tuple((lets or {}).items()), budget.most, answer)
    budget.left -= work
    return cast("Answer | None", result)


class _Term(NamedTuple):
    """A part of a condition at its place. `keys` are the numbers of the variables that it reads, in order.

    `about` is the operation's further argument: a property, the elements and the default of a field, or a shift.
    """

    op: str
    node: Expr
    keys: tuple[int, ...] = ()
    args: tuple[_Term, ...] = ()
    about: Any = None

    def conjuncts(self) -> Iterator[_Term]:
        """The parts that must all hold for the condition to hold."""
        if self.op != "and":
            yield self
        else:
            for arg in self.args:
                yield from arg.conjuncts()


class _Search:
    """One search. Lets of the substep are replaced by their values; conjunctions are split."""

    def __init__(self, facts: Facts, conditions: Conditions, lets: Lets):
        self.facts, self.budget, self.lets = facts, facts.budget, lets
        self._opened: dict[tuple[str, Offset], tuple[_Term, int]] = {}
        self._numbers: dict[Variable, int] = {}
        self._cuts: dict[object, set[float]] = {}
        """Constants that the draws of each stream are compared with: between two of them all draws are alike."""
        self._terms = [part for expr, at in conditions for part in self._term(expr, at).conjuncts()]
        self._names = list(self._numbers)
        self._domains = {key: self._domain(*self._names[key]) for term in self._terms for key in term.keys}

    def possible(self) -> bool:
        """False if no assignment satisfies all conditions."""
        if not self._narrow():
            return False
        # Small domains first; domains of one size in the order in which the conditions name them.
        joint = [term for term in self._terms if len(term.keys) > 1]
        sizes = {key: len(self._domains[key]) for term in joint for key in term.keys}
        return self._assign(sorted(sizes, key=sizes.__getitem__), joint)

    def single_domains(self) -> dict[Variable, frozenset[object]] | None:
        """The values that conditions on one variable leave of it, without draws; None if nothing is left."""
        whole = self._domains.copy()
        if not self._narrow():
            return None
        return {
            self._names[key]: frozenset(values)
            for key, values in self._domains.items()
            if len(values) < len(whole[key]) and self._names[key][0] != "draw"
        }

    def example(self) -> dict[Offset, int]:
        """An element for each place that the conditions read, for which they hold."""
        if not self.possible():
            return {}
        elements = [key for key in self._domains if self._names[key][0] == "element"]
        return {self._names[key][2]: self._domains[key][0] for key in elements}

    def _narrow(self) -> bool:
        """Apply the conditions on one variable, or none; False if they leave no assignment."""
        for term in self._terms:
            if not term.keys and not self._bounds(term)[1]:
                return False
            if len(term.keys) == 1:
                (key,) = term.keys
                values = [value for value in self._domains[key] if self._allows(term, key, value)]
                if not values:
                    return False
                self._domains[key] = values
        return True

    def _assign(self, keys: list[int], joint: list[_Term]) -> bool:
        """Choose values of variables, one after another, for which the conditions may hold.

        Each choice is checked at once against the bounds of all conditions that read the variable (backtracking).
        """
        if not keys:
            return True
        key, *others = keys
        terms = [term for term in joint if key in term.keys]
        values = self._domains[key]
        for value in values:
            if all(self._allows(term, key, value) for term in terms) and self._assign(others, joint):
                return True
        self._domains[key] = values
        return False

    def _allows(self, term: _Term, key: int, value: Any) -> bool:
        """Choose a variable's value: whether the condition may hold with it."""
        self._domains[key] = [value]
        return bool(self._bounds(term)[1])

    def _domain(self, what: str, name: object, at: Offset) -> list[Any]:
        """All values of a variable, in rising order."""
        if what == "element":
            return list(self.facts.ids)
        if what == "side":
            return list(range(self.facts.side_multiple))
        if what == "draw":
            cuts = sorted(self._cuts.get(name, (0.0, 1.0)))
            between = ((a + b) / 2 for a, b in itertools.pairwise(cuts))
            # A draw of 16 or 32 bits may be a threshold itself: neither above nor below it.
            return sorted([*between, *(c for c in cuts if (c * 2**17) % 2 == 1 or (c * 2**33) % 2 == 1)])
        kind = name.kind if isinstance(name, Expr) else self.facts.properties[str(name)].kind
        match kind.name:
            case "element":
                return list(self.facts.ids)
            case "direction":
                return list(range(8))
            case "flag":
                return [0, 1]
        return list(range(int(kind.lo), int(kind.hi) + 1))

    def _term(self, node: Expr, at: Offset) -> _Term:
        """The expression at a place. A value that cannot be enumerated is ``unknown``."""
        self.budget.spend(1)
        unknown = _Term("unknown", node)
        match node.op:
            case "const":
                return _Term("const", node)
            case "look":
                return self._term(node.args[0], plus(at, node.value))
            case "let" if node.value in self.lets and (opened := self._open_let(node, at)):
                return opened
            case "element":
                return self._variable(node, "element", None, at)
            case "draw":
                return self._variable(node, "draw", node.value, at)
            case "property":
                prop = self.facts.properties[str(node.value)]
                if str in map(type, prop.values):
                    return unknown
                keys = [self._key("element", None, at)]
                if prop.stored:
                    keys.append(self._key("property", prop.name, at))
                return _Term("property", node, tuple(keys), about=prop)
            case "field" if (limited := self.facts.fields.get(str(node.value))) and limited.of is not None:
                about = limited.of, limited.default
                keys = [self._key("element", None, at), self._key("value", node, at)]
                return _Term("field", node, tuple(keys), about=about)
            case "coordinate":
                # The step is the same everywhere. A row or column follows from that of another place unless a seam may
                # be between: if the sides of the world are multiples of its modulus. Otherwise, it is free everywhere.
                axis, modulus = node.value
                if axis == "step":
                    return self._variable(node, "value", node, HERE)
                if self.facts.side_multiple % modulus:
                    return self._variable(node, "value", node, at)
                return _Term("coordinate", node, (self._key("side", axis, HERE),), about=at[axis == "column"])
            case "field" | "let" | "count" | "sum" | "inside" | "octant" | "param":
                kind = node.kind
                if kind.name in (*_FLOATS, "draw", "number") or kind.hi - kind.lo >= MAX_DOMAIN:
                    return unknown
                return self._variable(node, "value", node, at)
            case "eq" | "lt" | "le" if any(a.kind.name in _FLOATS and a.op != "const" for a in node.args):
                return self._variable(node, "value", node, at)
        if OPERATIONS[node.op].evaluate is None:
            return unknown
        args = tuple([self._term(arg, at) for arg in node.args])
        if node.op == "lt" and any(arg.kind.name == "draw" for arg in node.args):
            parts = list(node.walk())
            numbers = [part.value for part in parts if isinstance(part.value, (int, Fraction))]
            for part in parts:
                if part.op == "draw":
                    cuts = self._cuts.setdefault(part.value, {0.0, 1.0})
                    cuts.update(float(number) % 1 for number in numbers)
        return _Term(node.op, node, tuple(dict.fromkeys([key for arg in args for key in arg.keys])), args)

    def _open_let(self, let: Expr, at: Offset) -> _Term | None:
        """The value of a let at a place, if it is not too large."""
        if (let.value, at) not in self._opened:
            before = self.budget.left
            term = self._term(self.lets[let.value], at)
            self._opened[let.value, at] = term, before - self.budget.left
        term, size = self._opened[let.value, at]
        return term if size <= MAX_LET else None

    def _variable(self, node: Expr, what: str, name: object, at: Offset) -> _Term:
        return _Term("variable", node, (self._key(what, name, at),))

    def _key(self, what: str, name: object, at: Offset) -> int:
        return self._numbers.setdefault((what, name, at), len(self._numbers))

    def _bounds(self, term: _Term) -> Bounds:
        """The bounds of a value for those of the variables; a flag's are 0 and 1."""
        self.budget.left -= 1  # `spend` inlined, since most time is spent here
        if self.budget.left < 0:
            raise _Exhausted
        op, node, keys, args, about = term
        values, own = (self._domains[keys[0]], self._domains[keys[-1]]) if keys else ([], [])
        match op:
            case "variable":
                return values[0], values[-1]
            case "const":
                return node.value, node.value
            case "property":
                numbers = [about.values[element] for element in values if element not in about.stored]
                if len(numbers) < len(values):
                    numbers += own[0], own[-1]
                return min(numbers), max(numbers)
            case "field":
                elements, default = about
                numbers = [] if elements.isdisjoint(values) else [own[0], own[-1]]
                if not elements.issuperset(values):
                    numbers.append(default)
                return min(numbers), max(numbers)
            case "coordinate":
                numbers = [(side + about) % node.value[1] for side in values]
                return min(numbers), max(numbers)
        if args:
            row, bounds = OPERATIONS[op], list(map(self._bounds, args))
            assert row.evaluate is not None
            lows, highs = zip(*bounds, strict=True)
            if lows == highs:
                value = row.evaluate(*lows) if node.value is None else row.evaluate(*lows, node.value)
                return value, value
            combined = row.between(*bounds)
            if combined is not None:
                return combined
        return (
            (node.kind.lo, node.kind.hi) if node.kind.name == "int" else (0, 1) if node.kind == FLAG else _ANY
        )


_ANY: Bounds = (-math.inf, math.inf)

_FLOATS = ("real", "vec2", "chance")
