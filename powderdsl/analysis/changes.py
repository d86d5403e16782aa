"""Effects of each line of rules: which elements become which, which are moved, which fields are written.

All results are upper bounds: an effect that is not listed cannot happen in any world, because the search of
`model.logic.satisfy` has excluded it. A listed effect may happen, or the search could not exclude it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence, Set
from dataclasses import dataclass, field, replace
from typing import TypeVar

from powderdsl.model.expressions.operators import ELEMENT_HERE, FALSE, member, negation
from powderdsl.model.logic.satisfy import Conditions, Facts, Lets, satisfiable
from powderdsl.model.text import one_line
from powderdsl.model.types import (
    ELEMENT,
    FLAG,
    HERE,
    Assign,
    Expr,
    Move,
    Offset,
    Pass,
    Rule,
    Ruleset,
    Substep,
    Swap,
    Transform,
    alike,
    footprint,
    integer,
    minus,
    substeps,
    writes_of,
)

MAX_QUESTION = 20_000
"""Maximum number of nodes evaluated for one question; beyond it, the effect counts as possible."""

T = TypeVar("T")

Condition = tuple[Expr, Offset]
Pairs = Set[tuple[int, int]]
Ids = Set[int]


@dataclass(frozen=True, order=True)
class RuleLine:
    """A rule as written in a file. The copies that loops and symmetries make of a rule are one line."""

    file: str
    line: int
    pack: str
    pass_name: str
    text: str

    def __str__(self) -> str:
        return f"{self.file}:{self.line}"


@dataclass
class LineEffects:
    """Effects of the rules of one line, by ids. `pairs` are (before, after) with different elements."""

    line: RuleLine
    fires: bool = False
    pairs: Pairs = frozenset()
    moves: Ids = frozenset()
    writes: list[Assign] = field(default_factory=list)


@dataclass
class SubstepSearch:
    """Searches for cells in which rules of a substep happen."""

    substep: Substep
    facts: Facts
    lets: dict[str, Expr]

    def may(self, rule: Rule, *more: Condition) -> bool:
        """True if the rule may fire while further conditions hold. False is a proof that it cannot."""
        first = ((rule.mask, HERE), *more)
        if not satisfiable(self.facts, first, self.lets):
            return False
        rivals = self.rivals(rule)
        return not rivals or satisfiable(self.facts, (*first, *rivals), self.lets)

    def elements(self, rule: Rule, at: Offset, apart: Offset | None = None, known: Ids = frozenset()) -> Ids:
        """The ids that may be at a place where the rule fires, but not at the place `apart`; skip `known` ids."""
        ids = set()
        for number in self.facts.ids:
            more = [] if apart is None else [element_is_not(number, apart)]
            if number not in known and self.may(rule, element_is(number, at), *more):
                ids.add(number)
        return ids

    def rivals(self, rule: Rule) -> list[Condition]:
        """The conditions that must not hold for the rule to happen, by the substep's conflict policy.

        Under ``drop_both`` no other rule may claim its cells; under ``first_wins`` no transform before it may. An
        earlier swap or move that is wanted may itself be dropped, so that says nothing.
        """
        policy = self.substep.policy
        if policy in ("prove", "overwrite") or isinstance(rule, Assign):
            return []
        conditions: list[Condition] = []
        cells = footprint(rule)
        if isinstance(rule, Swap) or (isinstance(rule, Move) and rule.leaving is not None):
            # pairs of one rule that share a cell: neither fires
            dy, dx = rule.offset
            conditions += [(negation(rule.mask), rule.offset), (negation(rule.mask), (-dy, -dx))]
        for other in self.substep.rules:
            if isinstance(other, Assign):
                continue
            if other is rule:
                if policy == "first_wins":
                    break
                continue
            if policy == "drop_both" or isinstance(other, Transform):
                for y, x in cells:
                    conditions += [(negation(other.mask), (y - dy, x - dx)) for dy, dx in footprint(other)]
        return conditions


def element_is(number: int, at: Offset = HERE) -> Condition:
    return member(ELEMENT_HERE, (number,)), at


def element_is_not(number: int, at: Offset = HERE) -> Condition:
    return negation(member(ELEMENT_HERE, (number,))), at


def facts_of(ruleset: Ruleset) -> Facts:
    """Facts about cells, for questions to `model.logic.satisfy`."""
    return Facts(
        tuple(element.id for element in ruleset.elements),
        {prop.name: prop for prop in ruleset.properties},
        {field.name: field for field in ruleset.fields},
        ruleset.side_multiple,
    )


def find_changes(ruleset: Ruleset, facts: Facts, *, together: bool = True) -> list[LineEffects]:
    """Effects of each line, in the order in which the lines first run; `together`: also of several at once."""
    effects_of: dict[RuleLine, LineEffects] = {}
    for pass_, substep in substeps(ruleset.passes):
        search = SubstepSearch(substep, facts, substep.values)
        for rule in substep.rules:
            line = rule_line(rule, pass_)
            effects = effects_of.setdefault(line, LineEffects(line))
            if search.may(rule):
                effects.fires = True
                effects.writes += writes_of(rule)
                _add_effects(rule, search, effects)
        rules, pairs = _joint_effects(search) if together else ([], set())
        for rule in rules:
            effects_of[rule_line(rule, pass_)].pairs |= pairs
    return list(effects_of.values())


def may_rise_and_fall(ruleset: Ruleset, facts: Facts, number: int) -> tuple[bool, bool]:
    """True if some rule may turn other elements into an element and this one into others. Faster than `find_changes`."""
    rises = falls = False
    for _, substep in substeps(ruleset.passes):
        search = SubstepSearch(substep, facts, substep.values)
        for rule in substep.rules:
            if isinstance(rule, Transform):
                same = member(rule.target, (number,))
                rises = rises or search.may(rule, element_is_not(number), (same, HERE))
                falls = falls or search.may(rule, element_is(number), (negation(same), HERE))
            elif isinstance(rule, Move):
                lost = search.may(rule, element_is(number, rule.offset))
                other = search.may(rule, element_is_not(number, rule.offset))
                mixed, left = lost and other, rule.leaving and rule.leaving.value
                rises |= mixed if left is None else left == number and other
                falls |= mixed if left is None else left != number and lost
        if not (rises and falls):
            pairs = _joint_effects(search)[1]
            rises |= any(after == number for _, after in pairs)
            falls |= any(before == number for before, _ in pairs)
        if rises and falls:
            break
    return rises, falls


def line_effects(ruleset: Ruleset) -> list[LineEffects]:
    """Effects of each line by itself."""
    return find_changes(ruleset, facts_of(ruleset), together=False)


def reactions(ruleset: Ruleset) -> Iterator[tuple[RuleLine, list[int], list[int]]]:
    """The lines that transform elements without help from other lines, with the ids before and after, ascending."""
    for effects in line_effects(ruleset):
        if effects.pairs:
            before, after = zip(*effects.pairs, strict=True)
            yield effects.line, sorted(set(before)), sorted(set(after))


def moved_ids(ruleset: Ruleset) -> frozenset[int]:
    """The elements that some rule may move or push aside."""
    return frozenset(number for effects in line_effects(ruleset) for number in effects.moves)


def unchanging_ids(ruleset: Ruleset) -> frozenset[int]:
    """The elements that no rule moves or transforms: they stay in place permanently."""
    ids = {element.id for element in ruleset.elements}
    for effects in line_effects(ruleset):
        ids -= effects.moves | {before for before, _ in effects.pairs}
    return frozenset(ids)


def rule_line(rule: Rule, pass_: Pass) -> RuleLine:
    return RuleLine(rule.span.source.name, rule.span.line, pass_.pack, pass_.name, one_line(rule.span))


def _add_effects(rule: Rule, search: SubstepSearch, effects: LineEffects) -> None:
    """Add the elements to `effects` that a rule, which may fire, moves or transforms."""
    if isinstance(rule, Transform):
        effects.pairs |= set(_becomes(rule, search, effects.pairs))
    elif isinstance(rule, (Swap, Move)):
        left = rule.leaving if isinstance(rule, Move) else None
        effects.moves |= search.elements(rule, rule.offset, HERE, effects.moves)
        if left is None:
            effects.moves |= search.elements(rule, HERE, rule.offset, effects.moves)
        else:
            effects.moves |= search.elements(rule, HERE, known=effects.moves | {left.value})
        if isinstance(rule, Move):
            # the target's content is lost; in a row that leaves nothing behind, one element is lost and one doubled
            lost = search.elements(rule, rule.offset)
            effects.pairs |= _pairs(lost, lost if left is None else {left.value})


def _pairs(before: Ids, after: Ids) -> Pairs:
    return {(a, b) for a in before for b in after if a != b}


def _becomes(rule: Transform, search: SubstepSearch, known: Pairs = frozenset()) -> Iterator[tuple[int, int]]:
    """The pairs (before, after) of a transform that have not been found yet."""
    firsts, lasts = search.elements(rule, HERE), {rule.target.value}
    if rule.target.op != "const":
        candidates = search.facts.ids
        lasts = {number for number in candidates if search.may(rule, (member(rule.target, (number,)), HERE))}
    for before, after in sorted(_pairs(firsts, lasts) - known):
        if search.may(rule, element_is(before), (member(rule.target, (after,)), HERE)):
            yield before, after


def _joint_effects(search: SubstepSearch) -> tuple[list[Rule], Pairs]:
    """The rules of a substep whose effects mix, and the pairs (before, after) that the mixture may bring about.

    Under ``overwrite`` several rules may claim one cell: any of their elements may be lost or stay. Moves of different
    kinds form rows, in which one element moves to the place that another leaves: the first of a row leaves its element
    behind, and the last overwrites one.
    """
    policy, rules = search.substep.policy, search.substep.rules
    moves = [rule for rule in rules if isinstance(rule, Move)]
    kinds = {rule.offset if rule.leaving is None else rule.leaving.value for rule in moves}
    mixing: list[Rule] = [*moves] if policy == "prove" and len(kinds) > 1 else []
    if policy == "overwrite":
        mixing = [rule for rule in rules if not isinstance(rule, Assign)]
    live = [rule for rule in mixing if search.may(rule)]
    lost: Ids = set()
    gained: Ids = set()
    for rule in live:
        cells = footprint(rule) if policy == "overwrite" else footprint(rule)[1:]
        there = {number for at in cells for number in search.elements(rule, at)}
        lost |= there
        if isinstance(rule, Transform):
            gained |= {after for _, after in _becomes(rule, search)}
        elif isinstance(rule, Move) and rule.leaving is not None:
            gained |= {rule.leaving.value}
        if policy == "overwrite" or (isinstance(rule, Move) and rule.leaving is None):
            gained |= there
    return live, _pairs(lost, gained)


# Worlds that lack an element: no cell contains it and no field names it.

MAX_NEEDS = 6
"""Maximum number of needs stored for a line: the smallest ones."""


@dataclass(frozen=True)
class Requirements:
    """The elements that a line depends on. An element of each of `needs` must exist, or the line cannot fire.

    `copies`: ids that it creates only where they already exist.
    """

    needs: tuple[frozenset[int], ...]
    copies: frozenset[int]


def find_requirements(ruleset: Ruleset, facts: Facts) -> dict[RuleLine, Requirements]:
    named_ids = named_by_fields(ruleset)
    by_line: dict[RuleLine, Requirements] = {}
    for pass_ in ruleset.passes:
        lets: Lets = {}
        for substep in pass_.substeps:
            search = SubstepSearch(substep, facts, substep.values)
            for rule in substep.rules:
                if search.may(rule):
                    requirements = _requirements(rule, search, lets | search.lets, named_ids)
                    line = rule_line(rule, pass_)
                    if line in by_line:
                        requirements = _shared_requirements(by_line[line], requirements)
                    by_line[line] = requirements
            lets |= search.lets
    return by_line


def _requirements(rule: Rule, search: SubstepSearch, lets: Lets, named: frozenset[int]) -> Requirements:
    """The requirements of one rule. `lets` has the values of its substep and of earlier ones of the pass."""
    nodes = list(_nodes_of(rule, lets))
    reads_names = any(node.op in ("field", "let") and node.kind == ELEMENT for node in nodes)
    sets = [frozenset(node.value) for node in nodes if node.op == "member"]
    candidates = [frozenset({number}) for number in search.facts.ids]
    candidates += sorted(dict.fromkeys(sets), key=_by_size)
    needs: list[frozenset[int]] = []
    copies: set[int] = set()
    for ids in candidates:
        if any(known <= ids for known in needs) or (reads_names and ids & named):
            continue
        world = ReducedWorld(search, ids, lets)
        if not world.may(rule):
            needs.append(ids)
        if len(ids) == 1 and not world.may_make(rule):
            copies |= ids
    return Requirements(tuple(sorted(needs, key=_by_size)), frozenset(copies))


def _shared_requirements(first: Requirements, second: Requirements) -> Requirements:
    """The requirements of a line of two rules: an element that the first or the second rule needs must exist."""
    joined = dict.fromkeys(a | b for a in first.needs for b in second.needs)
    least = [ids for ids in joined if not any(other < ids for other in joined)]
    return Requirements(tuple(sorted(least, key=_by_size)[:MAX_NEEDS]), first.copies & second.copies)


def _by_size(ids: frozenset[int]) -> tuple[int, list[int]]:
    return len(ids), sorted(ids)


def named_by_fields(ruleset: Ruleset) -> frozenset[int]:
    """The ids that a field or a value under `let` may name although no cell ever contained them."""
    fields = [*ruleset.fields, *(item for pass_ in ruleset.passes for item in pass_.scratch)]
    ids = {int(value) for item in fields if item.kind == ELEMENT for value in item.defaults}
    for _, substep in substeps(ruleset.passes):
        values = [*substep.values.values(), *(w.value for rule in substep.rules for w in writes_of(rule))]
        nodes = [node for value in values if value.kind == ELEMENT for node in value.walk()]
        ids |= {int(node.value) for node in nodes if node.op == "const" and node.kind == ELEMENT}
    return frozenset(ids)


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


class ReducedWorld:
    """A substep in a world that has lacked some elements since the step began.

    Competing rules are ignored, which makes more effects possible.
    """

    def __init__(self, search: SubstepSearch, absent: frozenset[int], lets: Lets):
        self.absent = absent
        facts = replace(search.facts, ids=tuple(i for i in search.facts.ids if i not in absent))
        self.search = SubstepSearch(replace(search.substep, rules=()), facts, {})
        for name, value in lets.items():
            reduced = self.rewrite(value)
            if name in search.lets:
                self.search.lets[name] = reduced
            elif value.kind == FLAG and not self._is_possible(reduced):
                self.search.lets[name] = FALSE  # it was false when an earlier substep computed it

    def _is_possible(self, *conditions: Expr) -> bool:
        """True if a cell of this world may fulfill all conditions."""
        facts = self.search.facts
        return bool(facts.ids) and satisfiable(facts, [(c, HERE) for c in conditions], self.search.lets)

    def may(self, rule: Rule) -> bool:
        return self._is_possible(self.rewrite(rule.mask))

    def may_make(self, rule: Rule) -> bool:
        """True if the rule may create an element that the world lacks."""
        if isinstance(rule, Transform):
            target = member(self.rewrite(rule.target), tuple(self.absent))
            return self._is_possible(self.rewrite(rule.mask), target)
        left = rule.leaving if isinstance(rule, Move) else None
        return left is not None and left.value in self.absent and self.may(rule)

    def rewrite(self, expr: Expr) -> Expr:
        """The expression in this world: a count is 0 if no cell can fulfill its condition."""
        args = tuple(self.rewrite(arg) for arg in expr.args)
        if expr.op == "count" and not self._is_possible(*args):
            return Expr("const", integer(0, 0), value=0)
        return replace(expr, args=args)


# Overlaps: two rules meet in one cell, so that their order or the conflict policy decides the result

OUTCOMES = {
    "first wins": "both claim a cell at once: the first one applies",
    "both dropped": "both claim a cell at once: neither applies",
    "overwritten": "both claim a cell at once: the later one overwrites the other",
    "last writes": "both write a field of a cell at once: the last one wins",
    "cut off": "both change a number of a cell at once: at the bounds of its range the order matters",
    "first in turn": "both may transform a cell: the one that runs first does",
}
"""Outcomes for two rules that meet, in words."""

_BY_POLICY = {"first_wins": "first wins", "drop_both": "both dropped", "overwrite": "overwritten"}

MAX_LINES = 64
"""Maximum number of lines that transform cells for which all pairs in different substeps are compared."""


@dataclass(frozen=True)
class Overlap:
    """Two lines that may meet in one cell. `outcome` is one of OUTCOMES; `field` is the field that both write, if any.

    Both may be the same line, from which a loop or a symmetry makes several rules.
    """

    outcome: str
    first: RuleLine
    second: RuleLine
    field: str = ""


Candidate = tuple[Overlap, Iterable[Conditions], Lets]
"""Two lines, the conditions for each way in which they could meet, and the values under `let`."""


def find_overlaps(ruleset: Ruleset, facts: Facts) -> tuple[Overlap, ...]:
    """The pairs of lines that may meet, in the order in which they run."""
    overlaps: dict[Overlap, None] = {}
    for overlap, ways, lets in _candidates(ruleset, facts):
        if overlap not in overlaps and any(satisfiable(facts, way, lets) for way in ways):
            overlaps[overlap] = None
    return tuple(overlaps)


def _candidates(ruleset: Ruleset, facts: Facts) -> Iterator[Candidate]:
    for pass_, substep in substeps(ruleset.passes):
        search = SubstepSearch(substep, facts, substep.values)
        live = [rule for rule in substep.rules if search.may(rule)]
        if substep.policy != "prove":
            yield from _claims(search, pass_)
        yield from _writes(live, search, pass_)
    yield from _in_turn(ruleset)


def _claims(search: SubstepSearch, pass_: Pass) -> Iterator[Candidate]:
    """Rules of one substep that may claim the same cell, where a policy decides."""
    # Rules that are always dropped meet others too: only the conditions count here.
    movers = [rule for rule in search.substep.rules if not isinstance(rule, Assign)]
    for i, second in enumerate(movers):
        for first in movers[: i + 1]:
            outcome, same = _BY_POLICY[search.substep.policy], first is second
            if same and outcome == "first wins":
                outcome = "both dropped"
            if (same and isinstance(first, Move) and first.leaving is None) or (
                outcome == "first wins" and alike(first, second)
            ):
                continue  # cells of one rule that share a place move in rows
            overlap = Overlap(outcome, rule_line(first, pass_), rule_line(second, pass_))
            shifts = {minus(a, b): None for a in footprint(first) for b in footprint(second)}
            ways = (((first.mask, HERE), (second.mask, at)) for at in shifts if not (same and at == HERE))
            yield overlap, ways, search.lets


def _ordered_pairs(items: Sequence[T]) -> Iterator[tuple[T, T]]:
    """All pairs of items, ordered by the second item: the order in which both have run."""
    return ((first, second) for number, second in enumerate(items) for first in items[:number])


def _writes(rules: list[Rule], search: SubstepSearch, pass_: Pass) -> Iterator[Candidate]:
    """Writes of one field in one substep whose order affects the result. Rounding of floats is ignored."""
    keeps_apart = search.substep.policy in ("drop_both", "first_wins")
    for kind in (True, False):
        chosen = [rule for rule in rules if isinstance(rule, Assign) == kind]
        writes = [(write, rule) for rule in chosen for write in writes_of(rule)]
        for (a, first), (b, second) in _ordered_pairs(writes):
            outcome = order_matters(a, b)
            if not outcome:
                continue
            own = not kind and a.offset in footprint(first) and b.offset in footprint(second)
            if keeps_apart and own and first is not second:
                continue  # rules that fire never share a cell
            overlap = Overlap(outcome, rule_line(first, pass_), rule_line(second, pass_), a.field)
            yield overlap, [((first.mask, HERE), (second.mask, minus(a.offset, b.offset)))], search.lets


def order_matters(a: Assign, b: Assign) -> str:
    """The key of OUTCOMES if these two write the same cell, or an empty text."""
    if a.field != b.field or (a.op == b.op == ":=" and a.value == b.value):
        return ""
    if ":=" in (a.op, b.op):
        return "last writes"
    (low, high), (other_low, other_high) = a.change, b.change
    opposite = (high > 0 and other_low < 0) or (low < 0 and other_high > 0)
    return "cut off" if a.value.kind.name == "int" and opposite else ""


def _in_turn(ruleset: Ruleset) -> Iterator[Candidate]:
    """Transforms of different substeps that could happen to one cell of one world, with different results."""
    rules: list[tuple[int, RuleLine, Expr, Expr]] = []
    lets: Lets = {}
    for number, (pass_, substep) in enumerate(substeps(ruleset.passes)):
        lets |= {f"{name}@{number}": _number_lets(value, number) for name, value in substep.values.items()}
        for rule in substep.rules:
            if isinstance(rule, Transform):
                rules.append((number, rule_line(rule, pass_), rule.target, _number_lets(rule.mask, number)))
    if len({line for _, line, _, _ in rules}) > MAX_LINES:
        return
    for (other, first, earlier, other_mask), (number, second, target, mask) in _ordered_pairs(rules):
        if other != number and (earlier != target or target.op != "const"):
            changing = [element_is_not(end.value) for end in (target, earlier) if end.op == "const"]
            way = [(other_mask, HERE), (mask, HERE), *changing]
            yield Overlap("first in turn", first, second), [way], lets


def _number_lets(expr: Expr, number: int) -> Expr:
    """The expression with the substep's number added to names under `let`, which different substeps may share."""
    if expr.op == "let":
        return replace(expr, value=f"{expr.value}@{number}")
    args = tuple(_number_lets(arg, number) for arg in expr.args)
    return replace(expr, args=args) if args else expr
