"""Effects of rules on elements: which may become which, which may be moved. Derived from the checked model."""

from __future__ import annotations

from dataclasses import dataclass

from powderdsl.diagnostics import Span
from powderdsl.model.expressions.operands import ELEMENT_HERE, member
from powderdsl.model.logic.satisfy import Facts, satisfiable
from powderdsl.model.types import Expr, Move, Offset, Rule, Ruleset, Swap, Transform

HERE: Offset = (0, 0)


@dataclass(frozen=True)
class Reaction:
    """A rule that may turn elements into others. `before` and `after` are ids, ascending.

    The rules that one line was unrolled into are one reaction.
    """

    before: tuple[int, ...]
    after: tuple[int, ...]
    pass_name: str
    pack: str
    span: Span


def reactions(ruleset: Ruleset) -> tuple[Reaction, ...]:
    """Every line that turns elements into others, in the order they run."""
    facts = facts_of(ruleset)
    found: dict[Span, Reaction] = {}
    for pass_, moment in ruleset.substeps():
        lets = {let.name: let.value for let in moment.lets}
        for rule in moment.rules:
            if isinstance(rule, Transform):
                known = found.get(rule.span)
                before = set(known.before if known else ()) | _before(rule, facts, lets)
                after = set(known.after if known else ()) | _after(rule, facts, lets)
                ids = tuple(sorted(before)), tuple(sorted(after))
                found[rule.span] = Reaction(*ids, pass_.name, pass_.pack, rule.span)
    return tuple(found.values())


def facts_of(ruleset: Ruleset) -> Facts:
    """Facts about cells, for questions to `model.logic.satisfy`."""
    limited = {f.name: f for f in ruleset.fields if f.of is not None}
    return Facts(
        tuple(element.id for element in ruleset.elements),
        {prop.name: prop for prop in ruleset.properties},
        {name: f.of for name, f in limited.items() if f.of is not None},
        {name: f.default for name, f in limited.items()},
        ruleset.side_multiple,
    )


def _before(rule: Transform, facts: Facts, lets: dict[str, Expr]) -> set[int]:
    """The elements that the rule may change; one that becomes itself is not changed."""
    same = rule.target.value if rule.target.op == "const" else None
    return {number for number in facts.ids if number != same and _possible(rule, number, HERE, facts, lets)}


def _after(rule: Transform, facts: Facts, lets: dict[str, Expr]) -> set[int]:
    if rule.target.op == "const":
        return {int(rule.target.value)}
    return {
        number
        for number in facts.ids
        if satisfiable(facts, [(rule.mask, HERE), (member(rule.target, (number,)), HERE)], lets)
    }


def _possible(rule: Rule, number: int, at: Offset, facts: Facts, lets: dict[str, Expr]) -> bool:
    """Whether the rule may happen while the cell `at` has this element."""
    assert rule.mask is not None
    return satisfiable(facts, [(member(ELEMENT_HERE, (number,)), at), (rule.mask, HERE)], lets)


def moved_ids(ruleset: Ruleset) -> frozenset[int]:
    """The elements that some rule may move or push aside."""
    facts = facts_of(ruleset)
    found: set[int] = set()
    for _, moment in ruleset.substeps():
        lets = {let.name: let.value for let in moment.lets}
        for rule in moment.rules:
            if isinstance(rule, (Swap, Move)):
                found |= {
                    number
                    for number in facts.ids
                    if number not in found
                    and any(_possible(rule, number, at, facts, lets) for at in (HERE, rule.offset))
                }
    return frozenset(found)


def unchanging_ids(ruleset: Ruleset) -> frozenset[int]:
    """The elements that no rule moves or turns into anything: they stay in place permanently."""
    changed = {number for reaction in reactions(ruleset) for number in reaction.before}
    everything = frozenset(element.id for element in ruleset.elements)
    return everything - moved_ids(ruleset) - changed
