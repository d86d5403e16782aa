"""Effects of each line of rules: which elements become which, which are moved, which fields are written.

Everything found here is an upper bound. What a rule is not said to do, it cannot do, in no world: the search of
`model.logic.satisfy` has excluded it. What it is said to do it may do, or the search could not exclude it.
"""

from __future__ import annotations

from collections.abc import Iterator, Set
from dataclasses import dataclass, field

from powderdsl.model.expressions.operators import ELEMENT_HERE, member, negation
from powderdsl.model.logic.satisfy import Facts, satisfiable
from powderdsl.model.text import one_line
from powderdsl.model.types import (
    HERE,
    Assign,
    Expr,
    Moment,
    Move,
    Offset,
    Pass,
    Rule,
    Ruleset,
    Swap,
    Transform,
    footprint,
    substeps,
    writes_of,
)

MAX_QUESTION = 20_000
"""Nodes evaluated for one question, after which the answer is that it may be."""

Condition = tuple[Expr, Offset]
Pairs = Set[tuple[int, int]]
Ids = Set[int]


@dataclass(frozen=True, order=True)
class RuleLine:
    """A rule as it stands in a file. Loops and symmetries make many rules of one; they are one line."""

    file: str
    line: int
    pack: str
    pass_name: str
    text: str

    def __str__(self) -> str:
        return f"{self.file}:{self.line}"


@dataclass
class Found:
    """Effects of the rules of one line, by ids. `pairs` are (before, after), never of one element."""

    line: RuleLine
    fires: bool = False
    pairs: Pairs = frozenset()
    moves: Ids = frozenset()
    writes: list[Assign] = field(default_factory=list)


@dataclass
class Asked:
    """A substep, and how to ask about its rules."""

    moment: Moment
    facts: Facts
    lets: dict[str, Expr]

    def may(self, rule: Rule, *more: Condition) -> bool:
        """Whether the rule may happen while these conditions hold too. False is a proof."""
        first = ((rule.mask, HERE), *more)
        if not satisfiable(self.facts, first, self.lets):
            return False
        rivals = self.rivals(rule)
        return not rivals or satisfiable(self.facts, (*first, *rivals), self.lets)

    def elements(self, rule: Rule, at: Offset, apart: Offset | None = None, known: Ids = frozenset()) -> Ids:
        """The ids that may be at a place where the rule happens, but not at the place `apart`; `known` are not asked."""
        found = set()
        for number in self.facts.ids:
            more = [] if apart is None else [is_not(number, apart)]
            if number not in known and self.may(rule, is_(number, at), *more):
                found.add(number)
        return found

    def rivals(self, rule: Rule) -> list[Condition]:
        """The conditions that must not hold for the rule to happen, by the substep's conflict policy.

        Under ``drop_both`` no other rule may claim its cells; under ``first_wins`` no transform before it may. An
        earlier swap or move that is wanted may itself be dropped, so that says nothing.
        """
        policy = self.moment.policy
        if policy in ("prove", "overwrite") or isinstance(rule, Assign):
            return []
        found: list[Condition] = []
        cells = footprint(rule)
        if isinstance(rule, Swap) or (isinstance(rule, Move) and rule.leaving is not None):
            # pairs of one rule that share a cell: none of them happens
            dy, dx = rule.offset
            found += [(negation(rule.mask), rule.offset), (negation(rule.mask), (-dy, -dx))]
        for other in self.moment.rules:
            if isinstance(other, Assign):
                continue
            if other is rule:
                if policy == "first_wins":
                    break
                continue
            if policy == "drop_both" or isinstance(other, Transform):
                for y, x in cells:
                    found += [(negation(other.mask), (y - dy, x - dx)) for dy, dx in footprint(other)]
        return found


def is_(number: int, at: Offset = HERE) -> Condition:
    return member(ELEMENT_HERE, (number,)), at


def is_not(number: int, at: Offset = HERE) -> Condition:
    return negation(member(ELEMENT_HERE, (number,))), at


def facts_of(ruleset: Ruleset) -> Facts:
    """Facts about cells, for questions to `model.logic.satisfy`."""
    return Facts(
        tuple(element.id for element in ruleset.elements),
        {prop.name: prop for prop in ruleset.properties},
        {field.name: field for field in ruleset.fields},
        ruleset.side_multiple,
    )


def find_changes(ruleset: Ruleset, facts: Facts, *, together: bool = True) -> list[Found]:
    """Effects of each line, in the order in which the lines first run; `together`: also of several at once."""
    found: dict[RuleLine, Found] = {}
    for pass_, moment in substeps(ruleset.passes):
        asked = Asked(moment, facts, moment.values)
        for rule in moment.rules:
            line = rule_line(rule, pass_)
            effects = found.setdefault(line, Found(line))
            if asked.may(rule):
                effects.fires = True
                effects.writes += writes_of(rule)
                _look_at(rule, asked, effects)
        rules, pairs = _together(asked) if together else ([], set())
        for rule in rules:
            found[rule_line(rule, pass_)].pairs |= pairs
    return list(found.values())


def line_effects(ruleset: Ruleset) -> list[Found]:
    """Effects of each line by itself."""
    return find_changes(ruleset, facts_of(ruleset), together=False)


def reactions(ruleset: Ruleset) -> Iterator[tuple[RuleLine, list[int], list[int]]]:
    """The lines that turn elements into others by themselves, with the ids before and after, ascending."""
    for effects in line_effects(ruleset):
        if effects.pairs:
            before, after = zip(*effects.pairs, strict=True)
            yield effects.line, sorted(set(before)), sorted(set(after))


def moved_ids(ruleset: Ruleset) -> frozenset[int]:
    """The elements that some rule may move or push aside."""
    return frozenset(number for effects in line_effects(ruleset) for number in effects.moves)


def unchanging_ids(ruleset: Ruleset) -> frozenset[int]:
    """The elements that no rule moves or turns into anything: they stay in place permanently."""
    ids = {element.id for element in ruleset.elements}
    for effects in line_effects(ruleset):
        ids -= effects.moves | {before for before, _ in effects.pairs}
    return frozenset(ids)


def rule_line(rule: Rule, pass_: Pass) -> RuleLine:
    """Where a rule stands."""
    return RuleLine(rule.span.source.name, rule.span.line, pass_.pack, pass_.name, one_line(rule.span))


def _look_at(rule: Rule, asked: Asked, found: Found) -> None:
    """Add to `found` what a rule that may happen moves and turns into something else."""
    if isinstance(rule, Transform):
        found.pairs |= set(_becomes(rule, asked, found.pairs))
    elif isinstance(rule, (Swap, Move)):
        left = rule.leaving if isinstance(rule, Move) else None
        found.moves |= asked.elements(rule, rule.offset, HERE, found.moves)
        if left is None:
            found.moves |= asked.elements(rule, HERE, rule.offset, found.moves)
        else:
            found.moves |= asked.elements(rule, HERE, known=found.moves | {left.value})
        if isinstance(rule, Move):
            # what it moves to is lost; of a row that leaves nothing behind, one is lost, and one is there twice
            lost = asked.elements(rule, rule.offset)
            found.pairs |= _pairs(lost, lost if left is None else {left.value})


def _pairs(before: Ids, after: Ids) -> Pairs:
    return {(a, b) for a in before for b in after if a != b}


def _becomes(rule: Transform, asked: Asked, known: Pairs = frozenset()) -> Iterator[tuple[int, int]]:
    """The pairs (before, after) of a transform that are not known yet."""
    firsts, lasts = asked.elements(rule, HERE), {rule.target.value}
    if rule.target.op != "const":
        candidates = asked.facts.ids
        lasts = {number for number in candidates if asked.may(rule, (member(rule.target, (number,)), HERE))}
    for before, after in sorted(_pairs(firsts, lasts) - known):
        if asked.may(rule, is_(before), (member(rule.target, (after,)), HERE)):
            yield before, after


def _together(asked: Asked) -> tuple[list[Rule], Pairs]:
    """Rules of a substep whose effects mix, and what they may do then to elements.

    Under ``overwrite`` several rules may claim one cell: anything of theirs may be lost or stay. Moves of different
    kinds form rows, where one goes to the place that another leaves: the first of a row leaves its element behind, and
    the last overwrites one.
    """
    policy, rules = asked.moment.policy, asked.moment.rules
    moves = [rule for rule in rules if isinstance(rule, Move)]
    kinds = {rule.offset if rule.leaving is None else rule.leaving.value for rule in moves}
    mixed: list[Rule] = [*moves] if policy == "prove" and len(kinds) > 1 else []
    if policy == "overwrite":
        mixed = [rule for rule in rules if not isinstance(rule, Assign)]
    live = [rule for rule in mixed if asked.may(rule)]
    lost: Ids = set()
    made: Ids = set()
    for rule in live:
        cells = footprint(rule) if policy == "overwrite" else footprint(rule)[1:]
        there = {number for at in cells for number in asked.elements(rule, at)}
        lost |= there
        if isinstance(rule, Transform):
            made |= {after for _, after in _becomes(rule, asked)}
        elif isinstance(rule, Move) and rule.leaving is not None:
            made |= {rule.leaving.value}
        if policy == "overwrite" or (isinstance(rule, Move) and rule.leaving is None):
            made |= there
    return live, _pairs(lost, made)
