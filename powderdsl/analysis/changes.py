"""Effects of each line of rules: which elements become which, which are moved, which fields are written.

Everything found here is an upper bound. What a rule is not said to do, it cannot do, in no world: the search of
`model.logic.satisfy` has excluded it. What it is said to do it may do, or the search could not exclude it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

from powderdsl.diagnostics import Span
from powderdsl.model.expressions.operators import ELEMENT_HERE, member, negation
from powderdsl.model.logic.satisfy import Facts, satisfiable
from powderdsl.model.text import one_line
from powderdsl.model.types import Assign, Expr, Moment, Move, Offset, Pass, Rule, Ruleset, Swap, Transform

HERE: Offset = (0, 0)

MAX_QUESTION = 20_000
"""Nodes evaluated for one question, after which the answer is that it may be."""

MAX_PAIRS = 1024
"""Pairs of elements that are asked about one at a time where a rule computes what a cell becomes."""

Condition = tuple[Expr, Offset]
Pairs = set[tuple[int, int]]


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
    pairs: Pairs = field(default_factory=set)
    moves: set[int] = field(default_factory=set)
    writes: list[Assign] = field(default_factory=list)


@dataclass
class Asked:
    """A substep, and how to ask about its rules."""

    moment: Moment
    facts: Facts
    lets: dict[str, Expr]

    @classmethod
    def of(cls, moment: Moment, facts: Facts) -> Asked:
        return cls(moment, facts, {let.name: let.value for let in moment.lets})

    def may(self, rule: Rule, *more: Condition) -> bool:
        """Whether the rule may happen while these conditions hold too. False is a proof."""
        assert rule.mask is not None
        first = ((rule.mask, HERE), *more)
        if not satisfiable(self.facts, first, self.lets):
            return False
        rivals = self.rivals(rule)
        return not rivals or satisfiable(self.facts, (*first, *rivals), self.lets)

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
            assert rule.mask is not None
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


def footprint(rule: Rule) -> tuple[Offset, ...]:
    """The cells that a rule claims, seen from the cell where its condition holds."""
    return (HERE, rule.offset) if isinstance(rule, (Swap, Move)) else (HERE,)


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


def find_changes(ruleset: Ruleset, facts: Facts) -> list[Found]:
    """Effects of each line, in the order in which the lines first run."""
    found: dict[RuleLine, Found] = {}
    for pass_, moment in ruleset.substeps():
        asked = Asked.of(moment, facts)
        for rule in moment.rules:
            line = rule_line(rule, pass_)
            _look_at(rule, asked, found.setdefault(line, Found(line)))
        for rule, pairs in (*_chains(asked), *_overwritten(asked)):
            found[rule_line(rule, pass_)].pairs |= pairs
    return list(found.values())


def rule_line(rule: Rule, pass_: Pass) -> RuleLine:
    """Where a rule stands."""
    return RuleLine(rule.span.source.name, rule.span.line, pass_.pack, pass_.name, one_line(rule.span))


def _look_at(rule: Rule, asked: Asked, found: Found) -> None:
    """Add to `found` what one rule of a substep may do."""
    if not asked.may(rule):
        return
    found.fires = True
    match rule:
        case Assign():
            found.writes.append(rule)
            return
        case Transform():
            found.pairs |= set(becomes(rule, asked, found.pairs))
        case Swap() | Move(leaving=None):
            found.moves |= _pushed(rule, asked, found.moves)
            found.moves |= {
                a for a in _left(asked, found.moves) if asked.may(rule, is_(a), is_not(a, rule.offset))
            }
            if isinstance(rule, Move):  # of a row one is lost, and one is there twice
                targets = overwritten(rule, asked)
                found.pairs |= {(x, y) for x in targets for y in targets if x != y}
        case Move(leaving=Expr(value=left)):
            found.moves |= _pushed(rule, asked, found.moves)
            found.moves |= {a for a in _left(asked, found.moves) if a != left and asked.may(rule, is_(a))}
            found.pairs |= {(x, left) for x in overwritten(rule, asked) if x != left}
    found.writes += rule.effects


def _left(asked: Asked, known: set[int]) -> Iterable[int]:
    """Elements that are still to be asked about."""
    return [number for number in asked.facts.ids if number not in known]


def _pushed(rule: Swap | Move, asked: Asked, known: set[int]) -> set[int]:
    """Elements that may be at the place where another element goes."""
    return {a for a in _left(asked, known) if asked.may(rule, is_(a, rule.offset), is_not(a))}


def overwritten(rule: Move, asked: Asked) -> list[int]:
    """Elements at the place where something moves to, which are lost if they do not move away themselves."""
    return [number for number in asked.facts.ids if asked.may(rule, is_(number, rule.offset))]


def becomes(rule: Transform, asked: Asked, known: Pairs) -> Iterator[tuple[int, int]]:
    """The pairs (before, after) of a transform that are not known yet."""
    ids = asked.facts.ids
    if rule.target.op == "const":
        after = int(rule.target.value)
        for before in ids:
            if before != after and (before, after) not in known and asked.may(rule, is_(before)):
                yield before, after
        return
    firsts = [number for number in ids if asked.may(rule, is_(number))]
    lasts = [number for number in ids if asked.may(rule, (member(rule.target, (number,)), HERE))]
    few = len(firsts) * len(lasts) <= MAX_PAIRS
    for before in firsts:
        for after in lasts:
            if before == after or (before, after) in known:
                continue
            if not few or asked.may(rule, is_(before), (member(rule.target, (after,)), HERE)):
                yield before, after


def _chains(asked: Asked) -> Iterator[tuple[Move, Pairs]]:
    """Effects of moves of different kinds together, where one goes to the place that another leaves.

    Of such a row the first leaves its element behind and the last overwrites one: these need not be of one rule.
    """
    moves = [rule for rule in asked.moment.rules if isinstance(rule, Move)]
    kinds = {rule.offset if rule.leaving is None else rule.leaving.value for rule in moves}
    if asked.moment.policy != "prove" or len(kinds) < 2:
        return
    live = [rule for rule in moves if asked.may(rule)]
    lost = {number for rule in live for number in overwritten(rule, asked)}
    left = {int(rule.leaving.value) for rule in live if rule.leaving is not None}
    left |= {number for rule in live if rule.leaving is None for number in overwritten(rule, asked)}
    pairs = {(before, after) for before in lost for after in left if before != after}
    for rule in live:
        yield rule, pairs


def _overwritten(asked: Asked) -> list[tuple[Rule, Pairs]]:
    """Effects of rules that overwrite each other: in a cell that several claim anything of theirs may be lost or stay."""
    if asked.moment.policy != "overwrite":
        return []
    live = [rule for rule in asked.moment.rules if not isinstance(rule, Assign) and asked.may(rule)]
    there = {
        number
        for rule in live
        for at in footprint(rule)
        for number in asked.facts.ids
        if asked.may(rule, is_(number, at))
    }
    made = {after for rule in live if isinstance(rule, Transform) for _, after in becomes(rule, asked, set())}
    made |= {int(rule.leaving.value) for rule in live if isinstance(rule, Move) and rule.leaving is not None}
    pairs = {(before, after) for before in there for after in there | made if before != after}
    return [(rule, pairs) for rule in live]


# Effects without budgets and policies


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


def _before(rule: Transform, facts: Facts, lets: dict[str, Expr]) -> set[int]:
    """The elements that the rule may change; one that becomes itself is not changed."""
    same = rule.target.value if rule.target.op == "const" else None
    return {
        number
        for number in facts.ids
        if number != same and satisfiable(facts, [is_(number), (rule.mask, HERE)], lets)
    }


def _after(rule: Transform, facts: Facts, lets: dict[str, Expr]) -> set[int]:
    if rule.target.op == "const":
        return {int(rule.target.value)}
    return {
        number
        for number in facts.ids
        if satisfiable(facts, [(rule.mask, HERE), (member(rule.target, (number,)), HERE)], lets)
    }


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
                    and any(
                        satisfiable(facts, [is_(number, at), (rule.mask, HERE)], lets)
                        for at in footprint(rule)
                    )
                }
    return frozenset(found)


def unchanging_ids(ruleset: Ruleset) -> frozenset[int]:
    """The elements that no rule moves or turns into anything: they stay in place permanently."""
    changed = {number for reaction in reactions(ruleset) for number in reaction.before}
    everything = frozenset(element.id for element in ruleset.elements)
    return everything - moved_ids(ruleset) - changed
