"""Rules in worlds that lack an element: which lines cannot happen there, and which can only copy what exists.

An element is absent if no cell holds it and no field names it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from powderdsl.analysis.changes import HERE, Asked, RuleLine, rule_line
from powderdsl.model.expressions.operators import (
    FALSE,
    TRUE,
    conjunction,
    disjunction,
    look,
    member,
    negation,
)
from powderdsl.model.logic.satisfy import Facts
from powderdsl.model.types import ELEMENT, Assign, Expr, Let, Move, Rule, Ruleset, Transform, integer

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
        lets: list[Let] = []
        for moment in pass_.moments:
            asked = Asked.of(moment, facts)
            for rule in moment.rules:
                if asked.may(rule):
                    wants = _wants(rule, asked, lets, named)
                    line = rule_line(rule, pass_)
                    found[line] = _either(found[line], wants) if line in found else wants
            lets += moment.lets
    return found


def _wants(rule: Rule, asked: Asked, lets: list[Let], named: Ids) -> Wants:
    """The needs of one rule. `lets` were fixed earlier in the pass."""
    nodes = list(_nodes_of(rule, {**{let.name: let.value for let in lets}, **asked.lets}))
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
    found: set[int] = set()
    fields = [*ruleset.fields, *(item for pass_ in ruleset.passes for item in pass_.scratch)]
    found |= {int(value) for item in fields if item.kind == ELEMENT for value in item.defaults}
    for _, moment in ruleset.substeps():
        values = [let.value for let in moment.lets]
        for rule in moment.rules:
            values += [one.value for one in ([rule] if isinstance(rule, Assign) else rule.effects)]
        nodes = [node for value in values if value.kind == ELEMENT for node in value.walk()]
        found |= {int(node.value) for node in nodes if node.op == "const" and node.kind == ELEMENT}
    return frozenset(found)


def _nodes_of(rule: Rule, lets: dict[str, Expr]) -> Iterator[Expr]:
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

    def __init__(self, asked: Asked, gone: Ids, earlier: list[Let]):
        self.gone = gone
        self.ids = frozenset(asked.facts.ids) - gone
        self.facts = replace(asked.facts, ids=tuple(sorted(self.ids)))
        self.constants: dict[str, Expr] = {}
        lets: dict[str, Expr] = {}
        for let in (*earlier, *asked.moment.lets):
            lets[let.name] = self.rewrite(let.value)
            if lets[let.name].op == "const":
                self.constants[let.name] = lets[let.name]
        now = {let.name: lets[let.name] for let in asked.moment.lets}
        self.asked = Asked(replace(asked.moment, rules=()), self.facts, now)

    def may(self, rule: Rule) -> bool:
        """Whether the rule may happen there."""
        assert rule.mask is not None
        return bool(self.ids) and self.asked.may(replace(rule, mask=self.rewrite(rule.mask)))

    def may_make(self, rule: Rule) -> bool:
        """Whether the rule may bring about an element that the world lacks."""
        if not isinstance(rule, Transform):
            left = rule.leaving if isinstance(rule, Move) else None
            return left is not None and left.value in self.gone and self.may(rule)
        made = member(self.rewrite(rule.target), tuple(self.gone))
        there = replace(rule, mask=self.rewrite(rule.mask))
        return bool(self.ids) and self.asked.may(there, (made, HERE))

    def rewrite(self, expr: Expr) -> Expr:
        """The expression as it is in this world: what asks for these elements is false, a count of them is 0."""
        if expr.op == "let":
            return self.constants.get(str(expr.value), expr)
        limited = self.facts.fields.get(str(expr.value)) if expr.op == "field" else None
        if limited and limited.of is not None and not limited.of & self.ids:
            return Expr("const", expr.kind, value=limited.default)
        args = tuple(self.rewrite(arg) for arg in expr.args)
        same = all(new is old for new, old in zip(args, expr.args, strict=True))
        return self._folded(expr if same else replace(expr, args=args))

    def _folded(self, expr: Expr) -> Expr:
        args = expr.args
        match expr.op:
            case "member" if (args[0].args[0] if args[0].op == "look" else args[0]).op in (
                "element",
                "field",
            ):
                if not expr.value & self.ids:
                    return FALSE
                return TRUE if expr.value >= self.ids else expr
            case "not":
                return negation(args[0])
            case "and":
                return conjunction(list(args))
            case "or":
                return disjunction(list(args))
            case "look":
                return look(args[0], expr.value)
            case "count" if args[0] == FALSE:
                return _ZERO
            case "eq" | "lt" | "le" if all(arg.op == "const" and arg.kind.name == "int" for arg in args):
                a, b = (arg.value for arg in args)
                return TRUE if {"eq": a == b, "lt": a < b, "le": a <= b}[expr.op] else FALSE
        return expr
