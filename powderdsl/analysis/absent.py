"""Rules in worlds that lack an element: which lines cannot happen there, and which can only copy what exists.

An element is absent if no cell holds it and no field names it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from powderdsl.analysis.changes import Asked, RuleLine, rule_line
from powderdsl.model.expressions.operators import FALSE, member
from powderdsl.model.logic.satisfy import Facts, Lets, satisfiable
from powderdsl.model.types import (
    ELEMENT,
    FLAG,
    HERE,
    Expr,
    Move,
    Rule,
    Ruleset,
    Transform,
    integer,
    substeps,
    writes_of,
)

_ZERO = Expr("const", integer(0, 0), value=0)

MAX_NEEDS = 6
"""So many needs are kept for a line, the smallest ones."""

Ids = frozenset[int]


@dataclass(frozen=True)
class Wants:
    """The elements that a line depends on. Of each of `needs` one element must exist, or the line cannot happen.

    `copies`: ids that it only brings about where these already exist.
    """

    needs: tuple[Ids, ...]
    copies: Ids


def find_wants(ruleset: Ruleset, facts: Facts) -> dict[RuleLine, Wants]:
    """The needs of each line that may happen."""
    named = named_by_fields(ruleset)
    found: dict[RuleLine, Wants] = {}
    for pass_ in ruleset.passes:
        lets: Lets = {}
        for moment in pass_.moments:
            asked = Asked(moment, facts, moment.values)
            for rule in moment.rules:
                if asked.may(rule):
                    wants = _wants(rule, asked, lets | asked.lets, named)
                    line = rule_line(rule, pass_)
                    found[line] = _either(found[line], wants) if line in found else wants
            lets |= asked.lets
    return found


def _wants(rule: Rule, asked: Asked, lets: Lets, named: Ids) -> Wants:
    """The needs of one rule. `lets` are those of its substep and of earlier ones of the pass."""
    nodes = list(_nodes_of(rule, lets))
    reads_names = any(node.op in ("field", "let") and node.kind == ELEMENT for node in nodes)
    sets = [frozenset(node.value) for node in nodes if node.op == "member"]
    candidates = [frozenset({number}) for number in asked.facts.ids]
    candidates += sorted(dict.fromkeys(sets), key=_by_size)
    needs: list[Ids] = []
    copies: set[int] = set()
    for ids in candidates:
        if any(known <= ids for known in needs) or (reads_names and ids & named):
            continue
        world = Lacking(asked, ids, lets)
        if not world.may(rule):
            needs.append(ids)
        if len(ids) == 1 and not world.may_make(rule):
            copies |= ids
    return Wants(tuple(sorted(needs, key=_by_size)), frozenset(copies))


def _either(first: Wants, second: Wants) -> Wants:
    """The needs that two rules share: an element that the first or the second needs must exist."""
    joined = dict.fromkeys(a | b for a in first.needs for b in second.needs)
    least = [ids for ids in joined if not any(other < ids for other in joined)]
    return Wants(tuple(sorted(least, key=_by_size)[:MAX_NEEDS]), first.copies & second.copies)


def _by_size(ids: Ids) -> tuple[int, list[int]]:
    return len(ids), sorted(ids)


def named_by_fields(ruleset: Ruleset) -> Ids:
    """The ids that a field or a value under `let` may name although no cell ever held them."""
    fields = [*ruleset.fields, *(item for pass_ in ruleset.passes for item in pass_.scratch)]
    found = {int(value) for item in fields if item.kind == ELEMENT for value in item.defaults}
    for _, moment in substeps(ruleset.passes):
        values = [*moment.values.values(), *(w.value for rule in moment.rules for w in writes_of(rule))]
        nodes = [node for value in values if value.kind == ELEMENT for node in value.walk()]
        found |= {int(node.value) for node in nodes if node.op == "const" and node.kind == ELEMENT}
    return frozenset(found)


def _nodes_of(rule: Rule, lets: Lets) -> Iterator[Expr]:
    """Every part of a rule's condition and target, and of the values under `let` that they read."""
    parts = [*filter(None, [rule.mask, rule.target if isinstance(rule, Transform) else None])]
    seen: set[str] = set()
    while parts:
        for node in parts.pop().walk():
            yield node
            if node.op == "let" and node.value not in seen:
                seen.add(node.value)
                parts.append(lets[node.value])


class Lacking:
    """A substep in a world without some elements, which has had none of them since the step began.

    Rival rules are ignored, so more is considered possible.
    """

    def __init__(self, asked: Asked, gone: Ids, lets: Lets):
        self.gone = gone
        facts = replace(asked.facts, ids=tuple(number for number in asked.facts.ids if number not in gone))
        self.asked = Asked(replace(asked.moment, rules=()), facts, {})
        for name, value in lets.items():
            there = self.rewrite(value)
            if name in asked.lets:
                self.asked.lets[name] = there
            elif value.kind == FLAG and not self._can(there):
                self.asked.lets[name] = FALSE  # so it was when it was fixed

    def _can(self, *conditions: Expr) -> bool:
        """Whether a cell of this world may fulfill these conditions."""
        facts = self.asked.facts
        return bool(facts.ids) and satisfiable(facts, [(one, HERE) for one in conditions], self.asked.lets)

    def may(self, rule: Rule) -> bool:
        """Whether the rule may happen there."""
        return self._can(self.rewrite(rule.mask))

    def may_make(self, rule: Rule) -> bool:
        """Whether the rule may bring about an element that the world lacks."""
        if isinstance(rule, Transform):
            made = member(self.rewrite(rule.target), tuple(self.gone))
            return self._can(self.rewrite(rule.mask), made)
        left = rule.leaving if isinstance(rule, Move) else None
        return left is not None and left.value in self.gone and self.may(rule)

    def rewrite(self, expr: Expr) -> Expr:
        """The expression as it is in this world: a count of what no cell fulfills is 0."""
        args = tuple(self.rewrite(arg) for arg in expr.args)
        if expr.op == "count" and not self._can(*args):
            return _ZERO
        return replace(expr, args=args)
